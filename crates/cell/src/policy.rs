//! What to do about a screw that does not come out: try on, fetch a person, mill its head off, or leave it, and why, in words.
//!
//! Milling is the only thing here that destroys. It needs everything at once: a policy that wants it, a product description that says what
//! lies behind the sheet (not known means no), enough room there, and the plant's own controller, which is asked right before every cut.

use crate::plan::SafeTarget;
use crate::program::{FaceId, Region};
use geometry::{Base, Point};
use serde::{Deserialize, Serialize};

/// Room that has to be left under the deepest cut, mm.
const MARGIN_MM: f64 = 5.0;

/// What the unit is taken apart for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// Its parts are used again: a spoilt cover costs its value.
    Reuse,
    /// Its material.
    #[default]
    Material,
}

/// When a head may be milled off; `[destructive]` in the cell file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Destructive {
    /// Whether anything is milled at all.
    pub mill: bool,
    /// What the unit is taken apart for.
    pub target: Target,
    /// What a cover loses by a milled hole where parts are used again, in any currency.
    pub part_value: f64,
    /// What an hour of a person costs, in the same.
    pub person_per_hour: f64,
    /// How long a person takes for a screw, the way to the cell included, s.
    pub person_s: f64,
}

impl Default for Destructive {
    fn default() -> Self {
        Self {
            mill: false,
            target: Target::Material,
            part_value: 4.0,
            person_per_hour: 40.0,
            person_s: 90.0,
        }
    }
}

/// What to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Choice {
    /// Go on with what does no harm.
    Retry,
    /// Call a person.
    Person,
    /// Mill the head off.
    Mill,
    /// Leave it: the unit is handed out with it.
    Reject,
}

/// A choice with its reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ruling {
    /// What.
    pub choice: Choice,
    /// Why, in words.
    pub because: String,
    /// Where the cutter would go, in the arm's base: before the head, at it, and where it ends. Empty if nothing is milled.
    pub path: Vec<Point<Base>>,
}

/// What is known when the choice is made.
#[derive(Clone, Copy, Debug)]
pub struct Case<'a> {
    /// The face that the screw sits in.
    pub face: &'a FaceId,
    /// What the product description says of it.
    pub region: Option<&'a Region>,
    /// Whether something harmless is left to try.
    pub can_retry: bool,
    /// How deep the cutter would go, mm.
    pub depth_mm: f64,
    /// Whether the plant's controller permits milling now.
    pub permitted: bool,
    /// Whether a person can be called.
    pub person: bool,
}

impl Destructive {
    /// Chooses.
    ///
    /// # Arguments
    /// * `place` – where the screw is, for the path.
    pub fn choose(&self, case: &Case<'_>, place: &SafeTarget) -> Ruling {
        if case.can_retry {
            return Ruling {
                choice: Choice::Retry,
                because: "something that does no harm is left to try".into(),
                path: Vec::new(),
            };
        }
        let Some(bar) = self.bar(case) else {
            let person_cost = self.person_per_hour * self.person_s / 3600.0;
            if self.target == Target::Reuse && case.person && self.part_value > person_cost {
                let because = format!(
                    "the hole would cost {:.2}, a person {person_cost:.2}: parts are to be used again",
                    self.part_value
                );
                return without_milling(Choice::Person, because);
            }
            let (tip, axis) = (place.tip(), place.approach());
            return Ruling {
                choice: Choice::Mill,
                because: format!(
                    "nothing harmless is left, {:.0} mm are free behind the {}, and the controller permits it",
                    case.region.and_then(|r| r.clear_mm).unwrap_or(0.0),
                    case.face
                ),
                path: vec![place.standoff(), tip, tip.moved(axis, case.depth_mm)],
            };
        };
        let choice = if case.person { Choice::Person } else { Choice::Reject };
        without_milling(choice, format!("nothing harmless is left, and it is not milled: {bar}"))
    }

    /// Why nothing is milled here, if so.
    fn bar(&self, case: &Case<'_>) -> Option<String> {
        if !self.mill {
            return Some("the cell file does not allow it".into());
        }
        let face = case.face;
        let Some(region) = case.region else {
            return Some(format!(
                "the product description does not say what lies behind the {face}"
            ));
        };
        if let Some(forbidden) = region.forbidden {
            return Some(format!("{forbidden} behind the {face}"));
        }
        let Some(clear_mm) = region.clear_mm else {
            return Some(format!(
                "the product description does not say how much is free behind the {face}"
            ));
        };
        let needed_mm = case.depth_mm + MARGIN_MM;
        if clear_mm < needed_mm {
            return Some(format!(
                "{clear_mm:.0} mm are free behind the {face}, {needed_mm:.0} are needed"
            ));
        }
        (!case.permitted).then(|| "the plant's controller does not permit it now".into())
    }
}

fn without_milling(choice: Choice, because: String) -> Ruling {
    Ruling {
        choice,
        because,
        path: Vec::new(),
    }
}
