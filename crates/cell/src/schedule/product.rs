//! A product as data: faces with their screws, covers, and what has to be off before what.

use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::path::Path;

/// The shipped outdoor unit, with the paper's precedence.
const OUTDOOR_UNIT: &str = include_str!("../../products/outdoor_unit.toml");

/// A product description that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ProductError {
    /// The file could not be read.
    #[error("cannot read the product {path}: {source}; check the path")]
    Read {
        /// File.
        path: String,
        /// Cause.
        source: std::io::Error,
    },
    /// The text is no product.
    #[error("{origin} is not a product description: {reason}")]
    Syntax {
        /// File.
        origin: String,
        /// Where and why.
        reason: String,
    },
    /// Its parts contradict each other.
    #[error("{origin}: {key}: {reason}")]
    Value {
        /// File.
        origin: String,
        /// Key, with the name of its face or cover.
        key: String,
        /// What to change.
        reason: String,
    },
}

/// Faces with screws, covers, and what holds what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Product {
    /// What it is.
    pub product: String,
    /// Side that faces the camera after loading.
    pub loaded: String,
    /// Durations that differ from the defaults.
    #[serde(default)]
    pub times_s: TimesS,
    /// Faces with screws.
    #[serde(default)]
    pub faces: Vec<Face>,
    /// Covers.
    #[serde(default)]
    pub covers: Vec<Cover>,
}

/// How long things take, s. **Assumed**, but for the ways between screws, which come from the arm's kinematics.
///
/// The defaults add up to the paper's parts (section 5.3) when everything is done one after the other by one arm: handling
/// 45 = 14 + 10 + 7 turns of 3.0; inspection 30 = 2 looks at 5 faces, 3.0 each; covers 45 = 3 times 10.5 + 4.5; screws 80 for the shipped
/// unit. Loading, discharge, picture, pull and laying aside are those of the simulated cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TimesS {
    /// Feeding a unit onto the table and clamping it.
    pub load: f64,
    /// Turning another side to the camera.
    pub turn: f64,
    /// Taking the unit away.
    pub discharge: f64,
    /// Picture and depth: the view has to be clear.
    pub picture: f64,
    /// From the picture to places of screws: nothing stands still meanwhile.
    pub process: f64,
    /// One screw from the stand-off and back to it: straight in, impact driver, straight out.
    pub drive: f64,
    /// Gripping, loosening and pulling a cover.
    pub pull: f64,
    /// Laying a cover aside: the table is free meanwhile.
    pub lay_aside: f64,
}

impl Default for TimesS {
    fn default() -> Self {
        Self {
            load: 14.0,
            turn: 3.0,
            discharge: 10.0,
            picture: 1.9,
            process: 1.1,
            drive: 1.5,
            pull: 10.5,
            lay_aside: 4.5,
        }
    }
}

/// A face with screws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Face {
    /// Its name, unique among the faces.
    pub name: String,
    /// Side of the table that is turned to the camera for it.
    pub side: String,
    /// Distance of its plane from the arms' bases when it is presented, mm.
    #[serde(default = "depth_mm")]
    pub depth_mm: f64,
    /// Its screws, mm: across (to the left of the middle of the table, base y) and up from the arms' feet (base z).
    pub screws_mm: Vec<[f64; 2]>,
    /// Covers that have to be off before.
    #[serde(default)]
    pub after_covers: Vec<String>,
    /// Arms that may work here; empty: every arm with a driver that reaches.
    #[serde(default)]
    pub arms: Vec<String>,
}

/// Distance of a presented face from the arms' bases, mm: 1500 before the camera, as the simulated cell is drawn.
fn depth_mm() -> f64 {
    1070.0
}

/// A cover.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cover {
    /// Its name, unique among the covers.
    pub name: String,
    /// Side of the table that is turned to the arms for it.
    pub side: String,
    /// How far across the table it is swept when it is pulled, mm.
    pub width_mm: f64,
    /// Faces whose screws hold it: they have to be out, and looked at again.
    #[serde(default)]
    pub held_by: Vec<String>,
    /// Covers that have to be off before.
    #[serde(default)]
    pub after_covers: Vec<String>,
    /// Several ways to free it: at least one has to be done before.
    #[serde(default)]
    pub requires_any: Vec<AnyOf>,
    /// Covers that come off together with it.
    #[serde(default)]
    pub takes_along: Vec<String>,
    /// Arms that may pull it; empty: every arm with a gripper.
    #[serde(default)]
    pub arms: Vec<String>,
}

/// One of several ways: all of these.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AnyOf {
    /// Faces whose screws are out and looked at again.
    #[serde(default)]
    pub faces: Vec<String>,
    /// Covers that are off.
    #[serde(default)]
    pub covers: Vec<String>,
}

impl Product {
    /// The shipped outdoor unit: 40 screws on five faces, the paper's precedence.
    ///
    /// # Errors
    /// None for the shipped text; the type is that of [`Product::parse`].
    pub fn outdoor_unit() -> Result<Self, ProductError> {
        Self::parse(OUTDOOR_UNIT, "the built-in outdoor_unit.toml")
    }

    /// Reads a description: JSON if the file's name ends so, else TOML.
    ///
    /// # Errors
    /// [`ProductError`] with file and key.
    pub fn read(path: &Path) -> Result<Self, ProductError> {
        let origin = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| ProductError::Read {
            path: origin.clone(),
            source,
        })?;
        Self::parse(&text, &origin)
    }

    /// Reads a description from text; `origin` names it in messages, and says by its ending whether it is JSON.
    ///
    /// # Errors
    /// [`ProductError::Syntax`] with line and key, [`ProductError::Value`] for names that do not exist and numbers that mean nothing.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ProductError> {
        let is_json = Path::new(origin)
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("json"));
        let product: Result<Self, String> = if is_json {
            serde_json::from_str(text).map_err(|e| e.to_string())
        } else {
            toml::from_str(text).map_err(|e| e.to_string())
        };
        let product = product.map_err(|reason| ProductError::Syntax {
            origin: origin.into(),
            reason,
        })?;
        product.check().map_err(|(key, reason)| ProductError::Value {
            origin: origin.into(),
            key,
            reason,
        })?;
        Ok(product)
    }

    /// Number of screws.
    pub fn screws(&self) -> usize {
        self.faces.iter().map(|face| face.screws_mm.len()).sum()
    }

    fn check(&self) -> Result<(), (String, String)> {
        let t = &self.times_s;
        for (key, value) in [
            ("load", t.load),
            ("turn", t.turn),
            ("discharge", t.discharge),
            ("picture", t.picture),
            ("drive", t.drive),
            ("pull", t.pull),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err((format!("times_s.{key}"), format!("is {value}; give seconds above 0")));
            }
        }
        for (key, value) in [("process", t.process), ("lay_aside", t.lay_aside)] {
            if !(value.is_finite() && value >= 0.0) {
                return Err((format!("times_s.{key}"), format!("is {value}; give seconds, 0 or more")));
            }
        }
        if self.faces.is_empty() && self.covers.is_empty() {
            return Err((
                "faces".into(),
                "there is nothing to do; add [[faces]] or [[covers]]".into(),
            ));
        }
        let mut faces = HashSet::new();
        for face in &self.faces {
            if !faces.insert(face.name.as_str()) {
                return Err((format!("faces.{}", face.name), "is there twice; rename one".into()));
            }
            if face.screws_mm.is_empty() {
                let reason = "is empty; list the screws, or leave the face out".into();
                return Err((format!("faces.{}.screws_mm", face.name), reason));
            }
            let mut numbers = face.screws_mm.iter().flatten().chain([&face.depth_mm]);
            if !numbers.all(|v| v.is_finite()) {
                return Err((format!("faces.{}", face.name), "has a place that is no number".into()));
            }
        }
        let mut covers = HashSet::new();
        for name in self
            .covers
            .iter()
            .flat_map(|c| std::iter::once(&c.name).chain(&c.takes_along))
        {
            if !covers.insert(name.as_str()) {
                let reason = "comes off twice: by itself or along with others; keep one".into();
                return Err((format!("covers.{name}"), reason));
            }
        }
        let known = |key: String, names: &[String], of: &HashSet<&str>, what: &str| {
            let missing = names.iter().find(|name| !of.contains(name.as_str()));
            missing.map_or(Ok(()), |name| {
                Err((key, format!("names '{name}', which is no {what} of this product")))
            })
        };
        for face in &self.faces {
            let key = format!("faces.{}.after_covers", face.name);
            known(key, &face.after_covers, &covers, "cover")?;
        }
        for cover in &self.covers {
            let key = |name: &str| format!("covers.{}.{name}", cover.name);
            if !(cover.width_mm.is_finite() && cover.width_mm > 0.0) {
                return Err((key("width_mm"), format!("is {}; give mm above 0", cover.width_mm)));
            }
            known(key("held_by"), &cover.held_by, &faces, "face")?;
            known(key("after_covers"), &cover.after_covers, &covers, "cover")?;
            for any in &cover.requires_any {
                known(key("requires_any.faces"), &any.faces, &faces, "face")?;
                known(key("requires_any.covers"), &any.covers, &covers, "cover")?;
            }
        }
        self.check_possible()
    }

    /// Everything can be done in some order: whatever never becomes free is named.
    fn check_possible(&self) -> Result<(), (String, String)> {
        let (mut faces, mut covers) = (HashSet::new(), HashSet::new());
        loop {
            let before = faces.len() + covers.len();
            let is_off = |names: &[String], done: &HashSet<&str>| names.iter().all(|n| done.contains(n.as_str()));
            for face in &self.faces {
                if is_off(&face.after_covers, &covers) {
                    faces.insert(face.name.as_str());
                }
            }
            for cover in &self.covers {
                let any = cover.requires_any.is_empty()
                    || cover
                        .requires_any
                        .iter()
                        .any(|way| is_off(&way.faces, &faces) && is_off(&way.covers, &covers));
                if any && is_off(&cover.held_by, &faces) && is_off(&cover.after_covers, &covers) {
                    covers.insert(cover.name.as_str());
                    covers.extend(cover.takes_along.iter().map(String::as_str));
                }
            }
            if faces.len() + covers.len() == before {
                break;
            }
        }
        let never = "can never be done: what has to be off before waits for it in turn; break the circle".to_string();
        if let Some(face) = self.faces.iter().find(|f| !faces.contains(f.name.as_str())) {
            return Err((format!("faces.{}", face.name), never));
        }
        match self.covers.iter().find(|c| !covers.contains(c.name.as_str())) {
            Some(cover) => Err((format!("covers.{}", cover.name), never)),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shipped_product_loads() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("products");
        let mut count = 0;
        for entry in std::fs::read_dir(folder).expect("products") {
            let path = entry.expect("entry").path();
            let product = Product::read(&path).unwrap_or_else(|e| panic!("{e}"));
            assert!(product.screws() >= 20, "{}", path.display());
            assert!(product.faces.iter().all(|f| (4..=20).contains(&f.screws_mm.len())));
            count += 1;
        }
        assert!(count >= 2);
    }

    #[test]
    fn json_is_read_too() {
        let product = Product::outdoor_unit().expect("built-in");
        let text = serde_json::to_string(&product).expect("as text");
        assert_eq!(Product::parse(&text, "unit.json").expect("parsed"), product);
    }

    #[test]
    fn mistakes_are_named() {
        let wrong = |from: &str, to: &str| {
            assert!(OUTDOOR_UNIT.contains(from), "{from}");
            let text = OUTDOOR_UNIT.replacen(from, to, 1);
            Product::parse(&text, "x.toml").expect_err("refused").to_string()
        };
        assert!(wrong("held_by", "holds").contains("holds"));
        let unknown = wrong("held_by = [\"top\"", "held_by = [\"roof\"");
        assert!(
            unknown.contains("covers.top.held_by") && unknown.contains("roof"),
            "{unknown}"
        );
        let circle = wrong("after_covers = [\"top\"]", "after_covers = [\"front\"]");
        assert!(circle.contains("faces.front_inner"), "{circle}");
    }
}
