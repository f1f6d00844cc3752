//! The ripple of the gears of J1 to J3: a wave of the joint's angle, seen through the lever from the joint's axis to the tool.
//!
//! A reducer turns a little ahead and behind once or a few times for each turn of its input: some 40 to 130 waves a turn of the joint,
//! 30 to 100 mm long where the tool is. No smooth map over calibrated points can follow that, but a sine of the joint's angle can, and
//! a hundred points are enough to find it.

use crate::arm::Arm;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Standard deviation of a wave's cosine and sine before anything is measured, rad: a tenth of a millimetre at the tool.
pub(crate) const PRIOR_RAD: f64 = 1e-4;
/// Waves that may be kept.
pub(crate) const MOST_WAVES: usize = 8;
/// Waves of one joint are at least so many cycles a turn apart.
pub(crate) const APART: f64 = 2.0;

/// A wave of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Wave {
    /// 0 to 2: J1 to J3.
    pub(crate) joint: usize,
    /// Waves for one turn of the joint.
    pub(crate) cycles: f64,
}

/// The waves of an arm whose tool keeps its direction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Ripple {
    #[serde(flatten)]
    pub(crate) arm: Arm,
    pub(crate) waves: Vec<Wave>,
}

impl Ripple {
    /// No waves yet.
    pub(crate) fn of(arm: Arm) -> Self {
        Self { arm, waves: Vec::new() }
    }

    /// What the waves add to a commanded point; `swings` are the cosine and sine of each, rad.
    pub(crate) fn shift(&self, command: Vector3<f64>, swings: &[[f64; 2]]) -> Vector3<f64> {
        let pose = self.arm.pose(command);
        let waves = self.waves.iter().zip(swings);
        waves
            .map(|(wave, swing)| {
                let (sin, cos) = (wave.cycles * pose.joints_rad[wave.joint]).sin_cos();
                pose.levers[wave.joint] * (swing[0] * cos + swing[1] * sin)
            })
            .sum()
    }
}

impl std::fmt::Display for Ripple {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let waves = self
            .waves
            .iter()
            .map(|w| format!("J{} {:.1}", w.joint + 1, w.cycles))
            .collect::<Vec<_>>();
        write!(f, "{} waves a turn, {}", waves.join(", "), self.arm)
    }
}

/// All waves that are looked for.
pub(crate) fn candidates() -> impl Iterator<Item = Wave> {
    (0..3).flat_map(|joint| {
        (12..320).map(move |k| Wave {
            joint,
            cycles: 0.5 * f64::from(k),
        })
    })
}

/// The best wave near one, with what it gains.
pub(crate) fn refined(from: (f64, Wave), gains: &impl Fn(&[Wave]) -> Vec<f64>) -> (f64, Wave) {
    let mut best = from;
    for step in [0.25, 0.125, 0.06] {
        let beside = [-step, step].map(|by| Wave {
            cycles: best.1.cycles + by,
            ..best.1
        });
        for (gained, wave) in gains(&beside).into_iter().zip(beside) {
            if gained > best.0 {
                best = (gained, wave);
            }
        }
    }
    best
}
