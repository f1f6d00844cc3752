//! Where an arm's first three joints are when its tool is at a place, and how the tool moves when each turns.
//!
//! For a Yaskawa GP25 by its kinematics; for any other arm by a regression on the joint angles of the pairs themselves. Both
//! rest on a tool that keeps its direction, as it does while a marker is shown to the camera.

use nalgebra::{DMatrix, Matrix3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_2;

/// Lengths of the Yaskawa GP25 (Brandstötter et al. 2014), mm.
const A1_MM: f64 = 150.0;
const A2_MM: f64 = -200.0;
const C1_MM: f64 = 505.0;
const C2_MM: f64 = 760.0;
const C3_MM: f64 = 795.0;
/// Scatter of the vector from wrist to marker beyond which the pairs are not of this arm, or the tool was turned, mm.
const SAME_TOOL_MM: f64 = 0.5;
/// Degree of the polynomials of another arm.
const DEGREE: usize = 6;
/// Distances over which the angles of another arm change that are tried, in half widths of the volume.
const LENGTHS: [f64; 6] = [0.7, 1.0, 1.5, 2.2, 3.3, 5.0];
/// Places between the points that the polynomials go through too.
const BETWEEN: usize = 600;
/// Points that angles between points rest on: more make no better, and take the third power of their number.
const ENOUGH: usize = 250;
/// Variance of an angle's noise against that of the angle: encoders have next to none.
const NUGGET: f64 = 1e-10;
/// Joint angles that a polynomial tells no better than this cannot place a wave of a hundred cycles a turn, rad.
const GOOD_ENOUGH_RAD: f64 = 1.5e-3;
/// What is expected of an arm's flaws before anything is measured: of its lengths, mm, of its axes and zeros, rad, and of what bends J2
/// and J3 for each metre that their load reaches out, rad.
const LINK_MM: f64 = 0.5;
const TURN_RAD: f64 = 5e-4;
const BEND_RAD: f64 = 2e-3;

/// J1 to J3 over places of the tool.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub(crate) enum Arm {
    /// A GP25.
    Gp25 {
        /// From the centre of the wrist to the commanded point, base frame, mm.
        wrist_to_tool_mm: Vector3<f64>,
    },
    /// Another arm.
    Learned(Polynomial),
}

/// J1 to J3 at a place, rad, and how the place moves when each turns, mm/rad.
pub(crate) struct Pose {
    pub(crate) joints_rad: [f64; 3],
    pub(crate) levers: [Vector3<f64>; 3],
}

impl Arm {
    /// The arm whose commands and joint angles these are; `None` if its tool did not keep its direction, or they are too few to learn from.
    pub(crate) fn of(command: &[Vector3<f64>], joints: &[[f64; 3]]) -> Option<Self> {
        let learned = |_| Polynomial::fit(command, joints).map(Arm::Learned);
        Self::gp25(command, joints).map_or_else(learned, Some)
    }

    /// A GP25, or how far the pairs' angles are from those of one with a tool that keeps its direction, mm.
    pub(crate) fn gp25(command: &[Vector3<f64>], joints: &[[f64; 3]]) -> Result<Self, f64> {
        let offsets: Vec<_> = command.iter().zip(joints).map(|(p, q)| p - wrist(*q)).collect();
        let n = offsets.len().max(1) as f64;
        let mean = offsets.iter().sum::<Vector3<f64>>() / n;
        let scatter = (offsets.iter().map(|o| (o - mean).norm_squared()).sum::<f64>() / n).sqrt();
        if scatter < SAME_TOOL_MM {
            Ok(Arm::Gp25 { wrist_to_tool_mm: mean })
        } else {
            Err(scatter)
        }
    }

    /// Joints and levers for a commanded point.
    pub(crate) fn pose(&self, command: Vector3<f64>) -> Pose {
        match self {
            Arm::Gp25 { wrist_to_tool_mm } => {
                let joints_rad = joints(command - wrist_to_tool_mm);
                let levers = [0, 1, 2].map(|joint| lever(command, joints_rad, joint));
                Pose { joints_rad, levers }
            }
            Arm::Learned(polynomial) => polynomial.pose(command),
        }
    }

    /// How a commanded point is missed, mm, by each flaw that an arm has, in the size that is to be expected: every link longer and
    /// turned, J2 and J3 bent by what they carry. Nothing is known of the flaws of another arm.
    pub(crate) fn flaws(&self, command: Vector3<f64>) -> Vec<Vector3<f64>> {
        let Arm::Gp25 { wrist_to_tool_mm } = self else {
            return Vec::new();
        };
        let wrist = command - wrist_to_tool_mm;
        let joints_rad @ [j1, j2, j3] = joints(wrist);
        let turn = |axis: Vector3<f64>, angle: f64| UnitQuaternion::from_scaled_axis(axis * angle);
        let column = turn(Vector3::z(), j1);
        let upper = column * turn(Vector3::y(), j2);
        let forearm = column * turn(Vector3::y(), j2 - j3 + FRAC_PI_2);
        let shoulder = column * Vector3::new(A1_MM, 0.0, C1_MM);
        let elbow = shoulder + upper * Vector3::new(0.0, 0.0, C2_MM);
        let mut flaws = Vec::with_capacity(20);
        for (link, end) in [(column, shoulder), (upper, elbow), (forearm, wrist)] {
            for axis in [Vector3::x(), Vector3::y(), Vector3::z()].map(|a| link * a) {
                flaws.push(axis * LINK_MM);
                flaws.push(axis.cross(&(command - end)) * TURN_RAD);
            }
        }
        // with its sign: an elbow may lean back behind the base's axis
        let radial = column * Vector3::x();
        let out = |of: Vector3<f64>| radial.dot(&of) / 1000.0;
        let [_, lower, upper] = [0, 1, 2].map(|joint| lever(command, joints_rad, joint));
        flaws.push(lower * (BEND_RAD * (out(elbow) - out(shoulder))));
        flaws.push(lower * (BEND_RAD * (out(wrist) - out(elbow))));
        flaws.push(upper * (BEND_RAD * (out(wrist) - out(elbow))));
        flaws
    }
}

impl std::fmt::Display for Arm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Arm::Gp25 { .. } => write!(f, "joint angles by the kinematics of a GP25"),
            Arm::Learned(p) => write!(
                f,
                "joint angles by regression on the pairs' own (left out: {:.2} mrad)",
                1e3 * p.error_rad
            ),
        }
    }
}

/// J1 to J3 for a wrist of a GP25, rad.
fn joints(wrist: Vector3<f64>) -> [f64; 3] {
    let (out, up) = (wrist.x.hypot(wrist.y) - A1_MM, wrist.z - C1_MM);
    let (lower, bend) = (A2_MM.hypot(C3_MM), A2_MM.atan2(C3_MM));
    let cos = (out * out + up * up - C2_MM * C2_MM - lower * lower) / (2.0 * C2_MM * lower);
    let elbow = cos.clamp(-1.0, 1.0).acos();
    let shoulder = out.atan2(up) - (lower * elbow.sin()).atan2(C2_MM + lower * elbow.cos());
    [wrist.y.atan2(wrist.x), shoulder, FRAC_PI_2 - (elbow - bend)]
}

/// How the commanded point moves when a joint of a GP25 turns, mm/rad.
fn lever(command: Vector3<f64>, joints: [f64; 3], joint: usize) -> Vector3<f64> {
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

/// Centre of a GP25's wrist at J1 to J3, base frame, mm.
fn wrist([j1, j2, j3]: [f64; 3]) -> Vector3<f64> {
    let (lower, bend) = (A2_MM.hypot(C3_MM), A2_MM.atan2(C3_MM));
    let forearm = j2 - j3 + FRAC_PI_2 + bend;
    let out = A1_MM + C2_MM * j2.sin() + lower * forearm.sin();
    let up = C1_MM + C2_MM * j2.cos() + lower * forearm.cos();
    Vector3::new(j1.cos() * out, j1.sin() * out, up)
}

/// Angles between points, as smooth as they come: a Gaussian process without noise over a plane.
struct Smooth<'a> {
    places: &'a [Vector3<f64>],
    length: f64,
    /// Of 1, x, y, z.
    plane: DMatrix<f64>,
    weights: DMatrix<f64>,
}

impl<'a> Smooth<'a> {
    /// With the root mean square of what it says of points left out, of the worst joint, rad.
    fn new(places: &'a [Vector3<f64>], joints: &[[f64; 3]], length: f64) -> Option<(Self, f64)> {
        let n = places.len();
        let design = DMatrix::from_fn(n, 4, |i, k| if k == 0 { 1.0 } else { places[i][k - 1] });
        let known = DMatrix::from_fn(n, 3, |i, j| joints[i][j]);
        let plane = design.clone().svd(true, true).solve(&known, 1e-12).ok()?;
        let mut smooth = Self {
            places,
            length,
            plane,
            weights: DMatrix::zeros(0, 0),
        };
        let mut kernel = DMatrix::from_fn(n, n, |i, j| smooth.kernel(&places[i], &places[j]));
        kernel += DMatrix::identity(n, n) * NUGGET;
        let inverse = kernel.cholesky()?.inverse();
        smooth.weights = &inverse * (known - design * &smooth.plane);
        let worst = (0..3).map(|j| {
            let left_out = |i: usize| (smooth.weights[(i, j)] / inverse[(i, i)]).powi(2);
            ((0..n).map(left_out).sum::<f64>() / n as f64).sqrt()
        });
        let worst = worst.fold(0.0, f64::max);
        Some((smooth, worst))
    }

    fn kernel(&self, a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
        (-0.5 * (a - b).norm_squared() / (self.length * self.length)).exp()
    }

    fn at(&self, place: Vector3<f64>) -> [f64; 3] {
        let near: Vec<f64> = self.places.iter().map(|p| self.kernel(p, &place)).collect();
        [0, 1, 2].map(|j| {
            let plane = self.plane[(0, j)] + (0..3).map(|k| self.plane[(k + 1, j)] * place[k]).sum::<f64>();
            let bend: f64 = near.iter().enumerate().map(|(i, k)| k * self.weights[(i, j)]).sum();
            plane + bend
        })
    }
}

/// J1 to J3 as polynomials of the commanded point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Polynomial {
    centre_mm: Vector3<f64>,
    /// Length in which places are measured from the centre.
    unit_mm: f64,
    /// A row a term, in the order of [`powers`].
    coefficients_rad: Vec<[f64; 3]>,
    /// Root mean square of what was left out, of the worst joint.
    error_rad: f64,
}

/// Exponents of the terms up to a degree.
fn powers(degree: usize) -> impl Iterator<Item = [usize; 3]> {
    (0..=degree).flat_map(move |x| (0..=degree - x).flat_map(move |y| (0..=degree - x - y).map(move |z| [x, y, z])))
}

impl Polynomial {
    /// Through smooth interpolated angles, of which there are more than there are points; `None` if these say too little.
    fn fit(command: &[Vector3<f64>], joints: &[[f64; 3]]) -> Option<Self> {
        let n = command.len();
        let centre_mm = command.iter().sum::<Vector3<f64>>() / n.max(1) as f64;
        let unit_mm = command.iter().map(|c| (c - centre_mm).amax()).fold(1.0, f64::max);
        let mut polynomial = Self {
            centre_mm,
            unit_mm,
            coefficients_rad: Vec::new(),
            error_rad: 0.0,
        };
        let taken: Vec<usize> = (0..n.min(ENOUGH)).map(|k| k * n / n.min(ENOUGH)).collect();
        let places: Vec<_> = taken.iter().map(|&i| (command[i] - centre_mm) / unit_mm).collect();
        let angles: Vec<_> = taken.iter().map(|&i| joints[i]).collect();
        let (smooth, left_out_rad) = LENGTHS
            .into_iter()
            .filter_map(|length| Smooth::new(&places, &angles, length))
            .min_by(|a, b| a.1.total_cmp(&b.1))?;
        // between two points there is no extrapolation
        let halfway = (0..BETWEEN).map(|k| {
            let (i, j) = (k % n, (k * 7919 + k / n + 1) % n);
            0.5 * (command[i] + command[j])
        });
        let dense: Vec<_> = command.iter().copied().chain(halfway).collect();
        let rows: Vec<Vec<f64>> = dense.iter().map(|c| polynomial.terms(*c)).collect();
        let terms = rows.first()?.len();
        let design = DMatrix::from_fn(rows.len(), terms, |i, k| rows[i][k]);
        let known: Vec<[f64; 3]> = dense.iter().map(|c| smooth.at((c - centre_mm) / unit_mm)).collect();
        let known = DMatrix::from_fn(rows.len(), 3, |i, j| known[i][j]);
        let solved = design.clone().svd(true, true).solve(&known, 1e-12).ok()?;
        let missed = (&design * &solved - &known)
            .row_iter()
            .map(|r| r.norm_squared())
            .sum::<f64>()
            / rows.len() as f64;
        polynomial.coefficients_rad = (0..terms).map(|k| [0, 1, 2].map(|j| solved[(k, j)])).collect();
        polynomial.error_rad = left_out_rad.hypot(missed.sqrt());
        (polynomial.error_rad < GOOD_ENOUGH_RAD).then_some(polynomial)
    }

    /// Value of every term at a place.
    fn terms(&self, command: Vector3<f64>) -> Vec<f64> {
        let at = (command - self.centre_mm) / self.unit_mm;
        let power = |a: usize, k: usize| at[a].powi(k as i32);
        powers(DEGREE)
            .map(|[x, y, z]| power(0, x) * power(1, y) * power(2, z))
            .collect()
    }

    fn pose(&self, command: Vector3<f64>) -> Pose {
        let at = (command - self.centre_mm) / self.unit_mm;
        // powers of each coordinate, and their derivatives
        let mut power = [[1.0; DEGREE + 1]; 3];
        let mut slope = [[0.0; DEGREE + 1]; 3];
        for a in 0..3 {
            for k in 1..=DEGREE {
                power[a][k] = power[a][k - 1] * at[a];
                slope[a][k] = k as f64 * power[a][k - 1];
            }
        }
        let mut angle = Vector3::zeros();
        let mut per_mm = Matrix3::zeros();
        for ([x, y, z], c) in powers(DEGREE).zip(&self.coefficients_rad) {
            let c = Vector3::from(*c);
            let [px, py, pz] = [power[0][x], power[1][y], power[2][z]];
            angle += c * (px * py * pz);
            let gradient = Vector3::new(slope[0][x] * py * pz, px * slope[1][y] * pz, px * py * slope[2][z]);
            per_mm += c * gradient.transpose();
        }
        // joints that turn without moving the tool (a stretched arm) have no lever that could be known
        let moves = (per_mm / self.unit_mm).try_inverse().unwrap_or_else(Matrix3::zeros);
        Pose {
            joints_rad: angle.into(),
            levers: [0, 1, 2].map(|j| moves.column(j).into_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn joints_lead_back_to_the_command(j1 in -1.0..1.0f64, j2 in -0.3..1.2f64, j3 in -1.1..0.8f64) {
            let arm = Arm::Gp25 { wrist_to_tool_mm: Vector3::new(300.0, 40.0, 0.0) };
            let command = wrist([j1, j2, j3]) + Vector3::new(300.0, 40.0, 0.0);
            let back = arm.pose(command).joints_rad;
            for (a, b) in back.iter().zip([j1, j2, j3]) {
                prop_assert!((a - b).abs() < 1e-9, "{back:?}");
            }
        }

        #[test]
        fn levers_are_derivatives(j1 in -1.0..1.0f64, j2 in -0.3..1.2f64, j3 in -1.1..0.8f64, joint in 0usize..3) {
            // the tool turns with the arm: about its axis each joint moves the whole of it
            let q = [j1, j2, j3];
            let step = 1e-6;
            let mut more = q;
            more[joint] += step;
            let moved = (wrist(more) - wrist(q)) / step;
            let sign = if joint == 2 { -1.0 } else { 1.0 }; // J3 turns the other way round; a swing's sign takes that up
            prop_assert!((moved - sign * lever(wrist(q), q, joint)).norm() < 1e-2);
        }
    }

    #[test]
    fn another_arm_is_learned_from_its_own_angles() {
        // the zeros and one direction of a GP25 are others: its kinematics no longer fit
        let other = |[j1, j2, j3]: [f64; 3]| [0.4 - j1, j2 + 0.2, j3 - 0.3];
        let (mut command, mut joints) = (Vec::new(), Vec::new());
        for k in 0..160u32 {
            let part = |step: f64| (f64::from(k) * step).fract();
            let q = [
                -0.4 + 0.8 * part(0.8191725),
                0.3 + 0.7 * part(0.6710436),
                -0.9 + 1.0 * part(0.5497005),
            ];
            command.push(wrist(q) + Vector3::new(300.0, 40.0, 0.0));
            joints.push(other(q));
        }
        let arm = Arm::of(&command, &joints).expect("an arm");
        assert!(matches!(arm, Arm::Learned(_)), "{arm}");
        let q = [0.1, 0.7, -0.3];
        let at = wrist(q) + Vector3::new(300.0, 40.0, 0.0);
        let pose = arm.pose(at);
        for (a, b) in pose.joints_rad.iter().zip(other(q)) {
            assert!((a - b).abs() < 1e-3, "{:?} {arm}", pose.joints_rad);
        }
        // levers are those of the wrist, whose tool keeps its direction; J1 turns the other way round
        for (joint, sign) in [(0, -1.0), (1, 1.0), (2, 1.0)] {
            let mut more = q;
            more[joint] += 1e-6;
            let moved = (wrist(more) - wrist(q)) / 1e-6 * sign;
            assert!(
                (moved - pose.levers[joint]).norm() < 10.0,
                "{joint}: {moved} {}",
                pose.levers[joint]
            );
        }
        assert!(Arm::of(&command[..12], &joints[..12]).is_none());
    }
}
