//! The paper's last step: a needle on millimetre paper shows what is left, and a layer over the map takes it out.

use crate::Map;
use geometry::{Base, Point};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// A target that the map sent the needle to, and where the needle stood.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mark {
    /// Its number.
    pub id: u64,
    /// Where the needle should have touched.
    pub target: Point<Base>,
    /// Where it did.
    pub mark: Point<Base>,
}

/// What holds between the targets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Between {
    /// The nearest target's correction, as in the paper: it jumps half way to the next.
    Nearest,
    /// The mean of the targets around, the nearer the more; it fades out within the reach.
    #[default]
    Interpolated,
}

/// Why marks give no correction, and what to do about it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CorrectError {
    /// Nothing to correct by.
    #[error("no marks: give at least one target with where the needle touched")]
    None,
    /// A mark that is no mark of its target.
    #[error(
        "mark {id} is {off_mm:.1} mm from its target; a correction is for what is left after calibrating, at most {MOST_MM} mm: check the row, or calibrate anew"
    )]
    TooFar {
        /// The mark.
        id: u64,
        /// How far, mm.
        off_mm: f64,
    },
    /// A number that is not finite.
    #[error("mark {id} holds a number that is not finite; remove the row")]
    NotFinite {
        /// The mark.
        id: u64,
    },
    /// Two marks with the same id.
    #[error("mark {id} occurs twice; a target is touched once")]
    Twice {
        /// The mark.
        id: u64,
    },
    /// A reach that is none.
    #[error("a reach of {reach_mm} mm is none; give a positive number of millimetres")]
    Reach {
        /// What was given.
        reach_mm: f64,
    },
}

/// Largest correction, mm.
const MOST_MM: f64 = 3.0;

/// The layer that a map file keeps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Layer {
    marks: Vec<Mark>,
    between: Between,
    reach_mm: f64,
}

impl Layer {
    /// What to add to a mapped point, mm.
    pub(crate) fn at(&self, base: Vector3<f64>) -> Vector3<f64> {
        let off = |m: &Mark| m.target.vector() - m.mark.vector();
        let far = |m: &Mark| (m.target.vector() - base).norm() / self.reach_mm;
        let near = self
            .marks
            .iter()
            .map(|m| (far(m), off(m)))
            .filter(|(far, _)| *far < 1.0);
        match self.between {
            Between::Nearest => near
                .min_by(|a, b| a.0.total_cmp(&b.0))
                .map_or_else(Vector3::zeros, |(_, off)| off),
            Between::Interpolated => {
                let (mut sum, mut total, mut nearest) = (Vector3::zeros(), 0.0, 1.0f64);
                for (far, off) in near {
                    // exact at a target, and each target's say ends smoothly at its reach (Shepard 1968, Franke 1982)
                    let weight = ((1.0 - far) / far.max(1e-6)).powi(2);
                    sum += off * weight;
                    total += weight;
                    nearest = nearest.min(far);
                }
                if total == 0.0 {
                    return Vector3::zeros();
                }
                // beyond the outermost targets it fades, without a step
                let fade = (1.0 - nearest * nearest).powi(2);
                sum / total * fade
            }
        }
    }
}

impl Map {
    /// The map with what a needle's marks show taken out; a layer that it had before is replaced.
    ///
    /// # Arguments
    /// * `reach_mm` – how far from a target its mark still says something.
    ///
    /// # Errors
    /// [`CorrectError`].
    pub fn correct(&self, marks: &[Mark], between: Between, reach_mm: f64) -> Result<Self, CorrectError> {
        if marks.is_empty() {
            return Err(CorrectError::None);
        }
        if !(reach_mm > 0.0 && reach_mm.is_finite()) {
            return Err(CorrectError::Reach { reach_mm });
        }
        let mut ids = std::collections::HashSet::new();
        for m in marks {
            let off_mm = m.target.distance_mm(m.mark);
            if !off_mm.is_finite() {
                return Err(CorrectError::NotFinite { id: m.id });
            }
            if off_mm > MOST_MM {
                return Err(CorrectError::TooFar { id: m.id, off_mm });
            }
            if !ids.insert(m.id) {
                return Err(CorrectError::Twice { id: m.id });
            }
        }
        Ok(self.with_correction(Layer {
            marks: marks.to_vec(),
            between,
            reach_mm,
        }))
    }
}
