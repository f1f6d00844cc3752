//! The ripple of the gears of J1 to J3: a wave of the joint's angle, seen through the lever from the joint's axis to the tool.
//!
//! A reducer turns a little ahead and behind once or a few times for each turn of its input: some 40 to 130 waves a turn of the joint,
//! 30 to 100 mm long where the tool is. No smooth map over calibrated points can follow that, but a sine of the joint's angle can, and
//! a hundred points are enough to find it.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_2;

/// Standard deviation of a wave's cosine and sine before anything is measured, rad.
pub(crate) const PRIOR_RAD: f64 = 3e-4;
/// Waves that may be kept.
pub(crate) const MOST_WAVES: usize = 8;
/// Twice the log likelihood that a wave has to gain.
pub(crate) const LEAST_GAIN: f64 = 5.0;
/// Share of the square of the left-out errors that may be left with it.
pub(crate) const LESS: f64 = 0.99;
/// Waves of one joint are at least so many cycles a turn apart.
pub(crate) const APART: f64 = 2.0;

/// Lengths of the Yaskawa GP25 (Brandstötter et al. 2014), mm.
const A1_MM: f64 = 150.0;
const A2_MM: f64 = -200.0;
const C1_MM: f64 = 505.0;
const C2_MM: f64 = 760.0;
const C3_MM: f64 = 795.0;
/// Scatter of the vector from wrist to marker beyond which the pairs are not of this arm, or the tool was turned, mm.
const SAME_TOOL_MM: f64 = 0.5;

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
    /// From the centre of the wrist to the commanded point, base frame, mm.
    wrist_to_tool_mm: Vector3<f64>,
    pub(crate) waves: Vec<Wave>,
}

impl Ripple {
    /// Of commands and joint angles of a GP25 whose tool kept its direction; `None` if they are not that.
    pub(crate) fn of_arm(command: &[Vector3<f64>], joints: &[[f64; 3]]) -> Option<Self> {
        let offsets: Vec<_> = command.iter().zip(joints).map(|(p, q)| p - wrist(*q)).collect();
        let n = offsets.len().max(1) as f64;
        let mean = offsets.iter().sum::<Vector3<f64>>() / n;
        let scatter = (offsets.iter().map(|o| (o - mean).norm_squared()).sum::<f64>() / n).sqrt();
        (scatter < SAME_TOOL_MM).then_some(Self {
            wrist_to_tool_mm: mean,
            waves: Vec::new(),
        })
    }

    /// J1 to J3 for a commanded point, rad.
    pub(crate) fn joints(&self, command: Vector3<f64>) -> [f64; 3] {
        let wrist = command - self.wrist_to_tool_mm;
        let (out, up) = (wrist.x.hypot(wrist.y) - A1_MM, wrist.z - C1_MM);
        let (lower, bend) = (A2_MM.hypot(C3_MM), A2_MM.atan2(C3_MM));
        let cos = (out * out + up * up - C2_MM * C2_MM - lower * lower) / (2.0 * C2_MM * lower);
        let elbow = cos.clamp(-1.0, 1.0).acos();
        let shoulder = out.atan2(up) - (lower * elbow.sin()).atan2(C2_MM + lower * elbow.cos());
        [wrist.y.atan2(wrist.x), shoulder, FRAC_PI_2 - (elbow - bend)]
    }

    /// How the commanded point moves when a joint turns, mm/rad.
    pub(crate) fn lever(&self, command: Vector3<f64>, joints: [f64; 3], joint: usize) -> Vector3<f64> {
        let (sin, cos) = joints[0].sin_cos();
        let shoulder = Vector3::new(A1_MM * cos, A1_MM * sin, C1_MM);
        let across = Vector3::new(-sin, cos, 0.0);
        match joint {
            0 => Vector3::z().cross(&command),
            1 => across.cross(&(command - shoulder)),
            _ => {
                let (s, c) = joints[1].sin_cos();
                across.cross(&(command - shoulder - C2_MM * Vector3::new(s * cos, s * sin, c)))
            }
        }
    }

    /// What the waves add to a commanded point; `swings` are the cosine and sine of each, rad.
    pub(crate) fn shift(&self, command: Vector3<f64>, swings: &[[f64; 2]]) -> Vector3<f64> {
        let joints = self.joints(command);
        let waves = self.waves.iter().zip(swings);
        waves
            .map(|(wave, swing)| {
                let (sin, cos) = (wave.cycles * joints[wave.joint]).sin_cos();
                self.lever(command, joints, wave.joint) * (swing[0] * cos + swing[1] * sin)
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
        write!(f, "{} waves a turn", waves.join(", "))
    }
}

/// Centre of the wrist at J1 to J3, base frame, mm.
fn wrist([j1, j2, j3]: [f64; 3]) -> Vector3<f64> {
    let (lower, bend) = (A2_MM.hypot(C3_MM), A2_MM.atan2(C3_MM));
    let forearm = j2 - j3 + FRAC_PI_2 + bend;
    let out = A1_MM + C2_MM * j2.sin() + lower * forearm.sin();
    let up = C1_MM + C2_MM * j2.cos() + lower * forearm.cos();
    Vector3::new(j1.cos() * out, j1.sin() * out, up)
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
pub(crate) fn refined(from: (f64, Wave), gain: &impl Fn(Wave) -> f64) -> (f64, Wave) {
    let mut best = from;
    for step in [0.25, 0.125, 0.06] {
        for cycles in [best.1.cycles - step, best.1.cycles + step] {
            let wave = Wave {
                joint: best.1.joint,
                cycles,
            };
            let gained = gain(wave);
            if gained > best.0 {
                best = (gained, wave);
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn joints_lead_back_to_the_command(j1 in -1.0..1.0f64, j2 in -0.3..1.2f64, j3 in -1.1..0.8f64) {
            let ripple = Ripple { wrist_to_tool_mm: Vector3::new(300.0, 40.0, 0.0), waves: Vec::new() };
            let command = wrist([j1, j2, j3]) + ripple.wrist_to_tool_mm;
            let back = ripple.joints(command);
            for (a, b) in back.iter().zip([j1, j2, j3]) {
                prop_assert!((a - b).abs() < 1e-9, "{back:?}");
            }
        }

        #[test]
        fn levers_are_derivatives(j1 in -1.0..1.0f64, j2 in -0.3..1.2f64, j3 in -1.1..0.8f64, joint in 0usize..3) {
            // the tool turns with the arm: about its axis each joint moves the whole of it
            let ripple = Ripple { wrist_to_tool_mm: Vector3::zeros(), waves: Vec::new() };
            let q = [j1, j2, j3];
            let step = 1e-6;
            let mut more = q;
            more[joint] += step;
            let moved = (wrist(more) - wrist(q)) / step;
            let sign = if joint == 2 { -1.0 } else { 1.0 }; // J3 turns the other way round; a swing's sign takes that up
            prop_assert!((moved - sign * ripple.lever(wrist(q), q, joint)).norm() < 1e-2);
        }
    }
}
