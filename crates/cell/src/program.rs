//! The order of work as data: which face is presented, what is taken off it, and what has to be off before.

use serde::{Deserialize, Serialize};
use std::{collections::HashSet, fmt, path::Path};

/// The paper's seven steps (section 5.2), as shipped.
pub const PAPER_PROGRAM: &str = include_str!("program.toml");

/// A program that cannot be followed.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// The file could not be read.
    #[error("cannot read the program {path}: {source}; check the path")]
    Read {
        /// File.
        path: String,
        /// Cause.
        source: std::io::Error,
    },
    /// The text is no program.
    #[error("{origin} is not a program: {reason}")]
    Syntax {
        /// File, or "program".
        origin: String,
        /// Where and why.
        reason: String,
    },
    /// The steps contradict each other.
    #[error("{origin}: step '{step}': {reason}")]
    Step {
        /// File, or "program".
        origin: String,
        /// Name of the step.
        step: String,
        /// What to change.
        reason: String,
    },
}

/// Name of a face of the unit, as in the table's I/O: `front`, `left`, `right`, `top`, `front_inner`, or a product's own.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FaceId(pub String);

impl fmt::Display for FaceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl From<&str> for FaceId {
    fn from(name: &str) -> Self {
        Self(name.into())
    }
}

/// A whole program: the steps in the order in which they are done.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Program {
    /// What it takes apart, for the record.
    pub product: String,
    /// Faces that are looked at before anything is touched, so that exclusion comes before the first action. Costs a turn of
    /// the table and a picture each; empty: each face is judged when it is presented, before anything on it is touched.
    #[serde(default)]
    pub survey: Vec<FaceId>,
    /// The steps.
    pub steps: Vec<Step>,
    /// What lies behind its faces: of a face that is not named nothing is known.
    #[serde(default)]
    pub regions: Vec<Region>,
}

/// What lies behind the sheet of a face.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// The face.
    pub face: FaceId,
    /// Free depth behind the sheet at every screw, by the product's drawing, mm; left out: not known.
    #[serde(default)]
    pub clear_mm: Option<f64>,
    /// Something that must never be cut, if it lies there.
    #[serde(default)]
    pub forbidden: Option<Forbidden>,
}

/// Something that must never be cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Forbidden {
    /// Pipes and valves under pressure.
    Refrigerant,
    /// Capacitors that may be charged.
    Capacitor,
    /// Cables.
    Wiring,
}

impl fmt::Display for Forbidden {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Refrigerant => "refrigerant pipes lie",
            Self::Capacitor => "capacitors lie",
            Self::Wiring => "cables lie",
        })
    }
}

/// One step: a face, and the work on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Name, unique in the program.
    pub name: String,
    /// Face that is turned to the camera.
    pub present: FaceId,
    /// What is done there.
    pub work: Work,
    /// Steps that have to be done before.
    #[serde(default)]
    pub requires: Vec<String>,
}

/// The work of a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Work {
    /// Take out every screw of the face.
    Screws {
        /// Fewest screws that the product has here: finding fewer excludes the unit before it is touched here.
        #[serde(default)]
        least: usize,
    },
    /// Pull a cover off.
    Cover {
        /// Its name: part of the job's name.
        cover: String,
        /// Arm that pulls it.
        by: String,
        /// The face's own screws are taken out within this step, before the pull.
        #[serde(default)]
        screws_first: bool,
        /// Fewest screws that the product has on this face, if they are taken out here.
        #[serde(default)]
        least: usize,
        /// Faces whose screws hold it: looked at again for missed screws if it does not come off.
        #[serde(default)]
        held_by: Vec<FaceId>,
        /// Covers that come off together with it.
        #[serde(default)]
        takes_along: Vec<String>,
    },
}

impl Step {
    /// True if screws are taken out in this step.
    pub fn has_screws(&self) -> bool {
        match self.work {
            Work::Screws { .. } => true,
            Work::Cover { screws_first, .. } => screws_first,
        }
    }

    /// Fewest screws that have to be found on the face.
    pub fn least_screws(&self) -> usize {
        match self.work {
            Work::Screws { least } | Work::Cover { least, .. } => least,
        }
    }
}

impl Program {
    /// The paper's seven steps.
    ///
    /// # Errors
    /// None for the shipped text; the type is that of [`Program::parse`].
    pub fn paper() -> Result<Self, ProgramError> {
        Self::parse(PAPER_PROGRAM, "the built-in program")
    }

    /// What is known of what lies behind a face.
    pub fn region(&self, face: &FaceId) -> Option<&Region> {
        self.regions.iter().find(|region| region.face == *face)
    }

    /// Reads a program file.
    ///
    /// # Errors
    /// [`ProgramError`], with the file's name.
    pub fn read(path: &Path) -> Result<Self, ProgramError> {
        let origin = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| ProgramError::Read {
            path: origin.clone(),
            source,
        })?;
        Self::parse(&text, &origin)
    }

    /// Reads a program from TOML; `origin` names it in messages.
    ///
    /// # Errors
    /// [`ProgramError::Syntax`] with line and key, [`ProgramError::Step`] if a step requires one that does not come before it.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ProgramError> {
        let program: Self = toml::from_str(text).map_err(|e| ProgramError::Syntax {
            origin: origin.into(),
            reason: e.to_string(),
        })?;
        program.check(origin)?;
        Ok(program)
    }

    fn check(&self, origin: &str) -> Result<(), ProgramError> {
        let bad = |step: &str, reason: String| {
            Err(ProgramError::Step {
                origin: origin.into(),
                step: step.into(),
                reason,
            })
        };
        if self.steps.is_empty() {
            return bad("-", "there are no steps; add at least one [[steps]]".into());
        }
        let mut done = HashSet::new();
        for step in &self.steps {
            if step.name.is_empty() || step.present.0.is_empty() {
                return bad(&step.name, "name and present must not be empty".into());
            }
            for required in &step.requires {
                if !done.contains(required.as_str()) {
                    return bad(
                        &step.name,
                        format!(
                            "requires '{required}', which does not come before it; reorder the steps or correct the name"
                        ),
                    );
                }
            }
            if !done.insert(step.name.as_str()) {
                return bad(&step.name, "there are two steps of this name; rename one".into());
            }
        }
        Ok(())
    }

    /// Every cover that is off when the program is through.
    pub fn covers(&self) -> Vec<&str> {
        let mut covers = Vec::new();
        for step in &self.steps {
            if let Work::Cover { cover, takes_along, .. } = &step.work {
                covers.push(cover.as_str());
                covers.extend(takes_along.iter().map(String::as_str));
            }
        }
        covers
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_s_order() {
        let program = Program::paper().expect("built-in program");
        let names: Vec<&str> = program.steps.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(
            names,
            [
                "front screws",
                "left screws",
                "right screws",
                "top cover",
                "front inner screws",
                "front cover",
                "right cover"
            ]
        );
        assert_eq!(program.covers(), ["top", "front", "left", "right"]);
        assert!(program.steps[3].has_screws() && !program.steps[5].has_screws());
    }

    #[test]
    fn toml_round_trip() {
        let program = Program::paper().expect("built-in program");
        let text = toml::to_string(&program).expect("as text");
        assert_eq!(Program::parse(&text, "round trip").expect("parsed"), program);
    }

    #[test]
    fn unknown_keys_and_wrong_order_are_refused() {
        let unknown = PAPER_PROGRAM.replacen("present =", "presents =", 1);
        let error = Program::parse(&unknown, "x.toml").expect_err("unknown key").to_string();
        assert!(error.contains("presents") && error.contains("x.toml"), "{error}");
        let unknown = PAPER_PROGRAM.replacen("screws_first", "screws_frist", 1);
        let error = Program::parse(&unknown, "x.toml").expect_err("unknown key").to_string();
        assert!(error.contains("screws_frist"), "{error}");
        let order = PAPER_PROGRAM.replacen("requires = [\"top cover\"]", "requires = [\"front cover\"]", 1);
        let error = Program::parse(&order, "x.toml").expect_err("order").to_string();
        assert!(
            error.contains("front inner screws") && error.contains("front cover"),
            "{error}"
        );
    }
}
