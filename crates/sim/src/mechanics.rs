//! Where the tool of an arm really is: what the controller does not know of its own arm.

use crate::draw::{draw, normal, signed};
use cell::motion::{A2_MM, C2_MM, C3_MM, Links, model_angles};
use geometry::{Base, Flange, Tool, Transform};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// How far an arm departs from its data sheet. The defaults leave a raw error of 1 to 2 mm at the tool.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ArmErrors {
    /// Standard deviation of every length between two joints, mm.
    pub link_mm: f64,
    /// Standard deviation of every angle between two joint axes and of every joint zero, degrees.
    pub zero_deg: f64,
    /// Factor on the elasticity of the gears under gravity; 1 is a GP25 of usual stiffness.
    pub gravity: f64,
    /// Amplitude of the gears' ripple at the tool, each of J1 to J3, mm.
    pub ripple_mm: f64,
    /// Lost motion of each gear, seen at the tool, mm.
    pub hysteresis_mm: f64,
    /// Repeatability, three standard deviations, mm.
    pub repeatability_mm: f64,
}

impl ArmErrors {
    /// An arm as its data sheet says.
    pub const NONE: Self = Self {
        link_mm: 0.0,
        zero_deg: 0.0,
        gravity: 0.0,
        ripple_mm: 0.0,
        hysteresis_mm: 0.0,
        repeatability_mm: 0.0,
    };
}

impl Default for ArmErrors {
    fn default() -> Self {
        Self {
            link_mm: 0.3,
            zero_deg: 0.02,
            gravity: 1.0,
            ripple_mm: 0.06,
            hysteresis_mm: 0.008,
            repeatability_mm: 0.02,
        }
    }
}

/// Teeth passages of the gear per turn of the joint, J1 to J3: each ripples once a turn of its motor and twice.
const GEAR_RATIO: [f64; 3] = [102.0, 120.0, 98.0];
/// Reach over which a gear's angle error is quoted at the tool, mm.
const LEVER_MM: f64 = 1200.0;
/// Stiffness of J2, J3 and J5, N m/rad.
const STIFFNESS_NM_RAD: [f64; 3] = [1.3e6, 0.9e6, 1.6e5];
/// Weights: upper arm, forearm, wrist with tool, N, and how far out they act, as a share of their link.
const UPPER_ARM_N: f64 = 55.0 * 9.81;
const FOREARM_N: f64 = 48.0 * 9.81;
const TOOL_N: f64 = 14.0 * 9.81;
/// Distance of the tool's weight from J5, mm.
const TOOL_ARM_MM: f64 = 230.0;

/// The body of one arm, drawn from a seed.
#[derive(Clone, Debug)]
pub(crate) struct Body {
    seed: u64,
    links: Links,
    zero_rad: [f64; 6],
    gravity: f64,
    /// (amplitude rad, phase rad) of the first and second harmonic of J1 to J3.
    ripple: [[(f64, f64); 2]; 3],
    hysteresis_rad: f64,
    repeat_sigma_mm: f64,
    flange_from_bit: Transform<Flange, Tool>,
    /// What the jig's marker is off the bit's tip, mm.
    jig_offset_mm: [f64; 3],
}

impl Body {
    pub(crate) fn sample(seed: u64, errors: &ArmErrors, nominal_tool: Transform<Flange, Tool>) -> Self {
        let mut rng = draw(seed, &[1]);
        let zero = errors.zero_deg.to_radians();
        let mut small = |length_mm: f64, angle_rad: f64| {
            let mut v = [0.0; 6];
            v.iter_mut().for_each(|x| *x = normal(&mut rng));
            Isometry3::from_parts(
                Translation3::new(v[0] * length_mm, v[1] * length_mm, v[2] * length_mm),
                UnitQuaternion::from_scaled_axis(Vector3::new(v[3], v[4], v[5]) * angle_rad),
            )
        };
        // The foot is what the base frame means: no error there.
        let mut links = Links::NOMINAL;
        for link in &mut links.0[1..] {
            *link *= small(errors.link_mm, zero);
        }
        let flange_from_bit = Transform::from_isometry(*nominal_tool.isometry() * small(errors.link_mm, zero));
        let zero_rad = std::array::from_fn(|_| normal(&mut rng) * zero);
        let ripple = std::array::from_fn(|_| {
            let amplitude = errors.ripple_mm / LEVER_MM * rng.random_range(0.7..1.2);
            [
                (amplitude, rng.random_range(0.0..TAU)),
                (amplitude * rng.random_range(0.15..0.4), rng.random_range(0.0..TAU)),
            ]
        });
        Self {
            seed,
            links,
            zero_rad,
            gravity: errors.gravity * rng.random_range(0.8..1.2),
            ripple,
            hysteresis_rad: errors.hysteresis_mm / LEVER_MM,
            repeat_sigma_mm: errors.repeatability_mm / 3.0,
            flange_from_bit,
            jig_offset_mm: std::array::from_fn(|_| 0.03 * signed(&mut rng)),
        }
    }

    /// Pose of the real tool point for encoder angles.
    ///
    /// `came_from` is the sign of each joint's last motion (lost motion), `visit` counts the moves (repeatability).
    pub(crate) fn tool(
        &self,
        joints_rad: [f64; 6],
        came_from: [f64; 6],
        visit: u64,
        jig: bool,
    ) -> Transform<Base, Tool> {
        let mut q = joints_rad;
        for j in 0..6 {
            q[j] += self.zero_rad[j] + came_from[j] * self.hysteresis_rad;
        }
        for (j, harmonics) in self.ripple.iter().enumerate() {
            for (k, (amplitude, phase)) in harmonics.iter().enumerate() {
                q[j] += amplitude * (joints_rad[j] * GEAR_RATIO[j] * (k + 1) as f64 + phase).sin();
            }
        }
        let mut model = model_angles(q);
        let sag = self.sag_rad(model);
        model[1] += sag[0];
        model[2] += sag[1];
        model[4] += sag[2];
        let mut pose = self.links.flange(model) * self.flange_from_bit;
        if jig {
            pose = pose * Transform::<Tool, Tool>::from_parts(self.jig_offset_mm, UnitQuaternion::identity());
        }
        let mut rng = draw(self.seed, &[2, visit]);
        let jitter = Vector3::new(normal(&mut rng), normal(&mut rng), normal(&mut rng)) * self.repeat_sigma_mm;
        Transform::from_isometry(Translation3::from(jitter) * pose.isometry())
    }

    /// How far gravity turns J2, J3 and J5, rad: weights times levers over the gears' stiffness. Positive angles lean forward.
    fn sag_rad(&self, model: [f64; 6]) -> [f64; 3] {
        let (upper, fore) = (model[1], model[1] + model[2]);
        // Horizontal distances in the plane of the arm, mm.
        let elbow = C2_MM * upper.sin();
        let wrist = A2_MM * fore.cos() + C3_MM * fore.sin();
        let mid_fore = A2_MM * fore.cos() + 0.4 * C3_MM * fore.sin();
        let tool_way = TOOL_ARM_MM * (fore.sin() * model[4].cos() + fore.cos() * model[4].sin() * model[3].cos());
        let j3 = FOREARM_N * mid_fore + TOOL_N * (wrist + tool_way);
        let j2 = UPPER_ARM_N * 0.45 * elbow + (FOREARM_N + TOOL_N) * elbow + j3;
        let j5 = TOOL_N * TOOL_ARM_MM * (fore.sin() * model[4].cos() * model[3].cos() + fore.cos() * model[4].sin());
        let [k2, k3, k5] = STIFFNESS_NM_RAD.map(|k| k * 1000.0 / self.gravity.max(1e-9));
        [j2 / k2, j3 / k3, j5 / k5]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout;
    use cell::motion::Gp25;
    use geometry::Point;

    const TIP: Point<Tool> = Point::new(0.0, 0.0, 0.0);

    /// Raw errors over the lattice, mm.
    fn errors(seed: u64, errors: &ArmErrors) -> Vec<Vector3<f64>> {
        let arm = Gp25::new(layout::flange_from_tool());
        let body = Body::sample(seed, errors, layout::flange_from_tool());
        let mut found = Vec::new();
        for i in 0..5 {
            for j in 0..10 {
                for k in 0..8 {
                    let at = Point::new(
                        950.0 + 100.0 * f64::from(i),
                        -450.0 + 100.0 * f64::from(j),
                        150.0 + 100.0 * f64::from(k),
                    );
                    let q = arm.inverse(layout::tool_at(at)).expect("in reach");
                    let visit = found.len() as u64;
                    found.push((body.tool(q, [1.0; 6], visit, false) * TIP).vector() - at.vector());
                }
            }
        }
        found
    }

    #[test]
    fn the_raw_error_is_one_to_two_millimetres() {
        for seed in 0..6 {
            let all = errors(seed, &ArmErrors::default());
            let rms = (all.iter().map(|e| e.norm_squared()).sum::<f64>() / all.len() as f64).sqrt();
            assert!((0.5..3.0).contains(&rms), "seed {seed}: {rms:.2} mm");
            // what a rigid move cannot take away is what calibration is for
            let mean = all.iter().sum::<Vector3<f64>>() / all.len() as f64;
            let spread = (all.iter().map(|e| (e - mean).norm_squared()).sum::<f64>() / all.len() as f64).sqrt();
            assert!((0.1..1.5).contains(&spread), "seed {seed}: {spread:.2} mm");
        }
        assert_ne!(errors(1, &ArmErrors::default()), errors(2, &ArmErrors::default()));
    }

    #[test]
    fn ripple_and_repeatability_are_as_stated() {
        let none = ArmErrors {
            ripple_mm: 0.0,
            repeatability_mm: 0.0,
            hysteresis_mm: 0.0,
            ..ArmErrors::default()
        };
        let smooth = errors(4, &none);
        let ripple = errors(
            4,
            &ArmErrors {
                ripple_mm: 0.06,
                ..none
            },
        );
        let worst = smooth
            .iter()
            .zip(&ripple)
            .map(|(a, b)| (a - b).norm())
            .fold(0.0, f64::max);
        assert!((0.05..0.2).contains(&worst), "{worst:.3} mm");
        let again = errors(
            4,
            &ArmErrors {
                repeatability_mm: 0.02,
                ..none
            },
        );
        let worst = smooth
            .iter()
            .zip(&again)
            .map(|(a, b)| (a - b).norm())
            .fold(0.0, f64::max);
        assert!((0.005..0.04).contains(&worst), "{worst:.3} mm");
    }

    #[test]
    fn the_tool_hangs_down_under_its_weight() {
        let none = ArmErrors {
            link_mm: 0.0,
            zero_deg: 0.0,
            ripple_mm: 0.0,
            repeatability_mm: 0.0,
            hysteresis_mm: 0.0,
            gravity: 1.0,
        };
        for e in errors(1, &none) {
            assert!((-2.0..-0.1).contains(&e.z), "sags by {:.2} mm", -e.z);
        }
        let stiff = errors(1, &ArmErrors { gravity: 0.0, ..none });
        assert!(stiff.iter().all(|e| e.norm() < 1e-3), "without gravity nothing is left");
    }
}
