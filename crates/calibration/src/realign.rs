//! After a bump or a crash: a few fresh pairs say how the camera, and the arm's joint zeros, stand to the map now.
//!
//! A camera that was bumped sees every point as if the world had moved: that is taken out before the map is asked, so that what
//! the map knows of the arm stays where the arm is. Joint zeros that a crash has changed are taken out after it.

use crate::{Figures, Map, Pair, arm::Arm, rigid};
use geometry::{Camera, Point};
use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::fmt;

/// What has moved since the map was fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Moved {
    /// The camera, without turning: 5 points.
    Shift,
    /// The camera: 10 points.
    Pose,
    /// The camera, and the zeros of J2 and J3: 20 points with joint angles. (What J1's zero does, the camera's pose does too.)
    PoseAndZeros,
}

impl Moved {
    /// Name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Shift => "shift",
            Self::Pose => "pose",
            Self::PoseAndZeros => "pose-and-zeros",
        }
    }

    /// What these pairs can tell: the more of them, the more; joint zeros only where the joints were written down.
    pub fn for_pairs(pairs: &[Pair]) -> Self {
        let valid = || pairs.iter().filter(|p| p.valid);
        match valid().count() {
            0..8 => Self::Shift,
            18.. if valid().all(|p| p.joints_rad.is_some()) => Self::PoseAndZeros,
            _ => Self::Pose,
        }
    }

    fn fewest_pairs(self) -> usize {
        match self {
            Self::Shift => 4,
            Self::Pose => 7,
            Self::PoseAndZeros => 16,
        }
    }

    fn unknowns(self) -> usize {
        match self {
            Self::Shift => 3,
            Self::Pose => 6,
            Self::PoseAndZeros => 8,
        }
    }
}

/// Why a map was not realigned, and what to do about it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RealignError {
    /// Not enough fresh pairs with a marker.
    #[error(
        "{have} pairs with a marker are too few for '{moved}', which needs {need}; visit more points, or ask for less"
    )]
    TooFew {
        /// Pairs with a marker.
        have: usize,
        /// Pairs that are needed.
        need: usize,
        /// What was to be found.
        moved: &'static str,
    },
    /// Joint zeros without joint angles.
    #[error(
        "joint zeros need the joint angles of a GP25 (columns q1_rad to q6_rad, tool in one direction): realign with 'pose'"
    )]
    NoJoints,
    /// A pair with NaN or an infinite number.
    #[error("pair {id} is valid but holds a number that is not finite; mark it as not valid")]
    NotFinite {
        /// The id.
        id: u64,
    },
    /// The pairs do not agree on one motion.
    #[error("no motion explains the fresh pairs: half of them stay off by more than {median_mm:.2} mm; calibrate anew")]
    Disagree {
        /// Median of what is left, mm.
        median_mm: f64,
    },
}

/// What a realignment found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Realignment {
    /// What was taken to have moved.
    pub moved: Moved,
    /// When, RFC 3339.
    pub date: String,
    /// Fresh pairs that it rests on.
    pub n_used: usize,
    /// Ids of those that contradict the others.
    pub outliers: Vec<u64>,
    /// How far the camera has moved, mm.
    pub shift_mm: f64,
    /// How far it has turned, rad.
    pub turn_rad: f64,
    /// Change of the zeros of J2 and J3, rad.
    pub zeros_rad: Option<[f64; 2]>,
    /// Errors of the map at the fresh pairs as it was.
    pub before: Figures,
    /// Errors of the realigned map, each pair predicted from the others.
    pub after: Figures,
}

impl fmt::Display for Realignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "the camera stands {:.2} mm and {:.2} mrad from where it stood ({} points, '{}')",
            self.shift_mm,
            1e3 * self.turn_rad,
            self.n_used,
            self.moved.name()
        )?;
        if let Some([j2, j3]) = self.zeros_rad {
            writeln!(
                f,
                "the zeros of J2 and J3 are off by {:+.3} and {:+.3} mrad",
                1e3 * j2,
                1e3 * j3
            )?;
        }
        for id in &self.outliers {
            writeln!(
                f,
                "pair {id} contradicts the others and was left out: look at its picture"
            )?;
        }
        write!(
            f,
            "error before: rms {:.3} mm, at most {:.3}; after, each pair predicted from the others: rms {:.3} mm, at most {:.3}",
            self.before.total.rms_mm, self.before.total.max_mm, self.after.total.rms_mm, self.after.total.max_mm
        )
    }
}

/// The layer that a map file keeps: what to do to a camera point before, and to a base point after the map.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Layer {
    pub(crate) told: Realignment,
    then_from_now: Isometry3<f64>,
    /// Turns of J2 and J3, and the arm that they turn.
    zeros: Option<([f64; 2], Arm)>,
    /// Covariance of shift (mm), turn (rad) and zeros (rad), row by row.
    covariance: Vec<f64>,
}

impl Layer {
    /// Where the camera as it stood would have seen what it sees now.
    pub(crate) fn then_from_now(&self) -> Isometry3<f64> {
        self.then_from_now
    }

    /// A point as the camera would have seen it when the map was fitted.
    pub(crate) fn before(&self, camera: Point<Camera>) -> Point<Camera> {
        Point::from_vector((self.then_from_now * Point3::from(camera.vector())).coords)
    }

    /// What the joint zeros add to a base point.
    pub(crate) fn after(&self, base: Vector3<f64>) -> Vector3<f64> {
        self.zeros.as_ref().map_or_else(Vector3::zeros, |(turns, arm)| {
            let levers = levers(arm, base);
            levers[0] * turns[0] + levers[1] * turns[1]
        })
    }

    /// Variance that it adds along each axis across the ray, and along it, mm².
    pub(crate) fn variance(&self, rotation: &Matrix3<f64>, camera: Vector3<f64>, base: Vector3<f64>) -> [f64; 2] {
        let n = self.told.moved.unknowns();
        let arm = self.zeros.as_ref().map(|z| &z.1);
        let jacobian = jacobian(self.told.moved, rotation, camera, arm.map(|a| levers(a, base)));
        let covariance = DMatrix::from_row_slice(n, n, &self.covariance);
        let own = &jacobian * covariance * jacobian.transpose();
        let ray = rotation * camera.normalize();
        let along = (0..3).flat_map(|i| (0..3).map(move |j| (i, j)));
        let along: f64 = along.map(|(i, j)| ray[i] * own[(i, j)] * ray[j]).sum();
        [0.5 * (own.trace() - along).max(0.0), along.max(0.0)]
    }
}

/// Turns beyond which a zero is no longer a zero that has slipped, and a camera no longer bumped, rad: what is expected before measuring.
const ZERO_PRIOR_RAD: f64 = 2e-3;
const TURN_PRIOR_RAD: f64 = 0.05;
/// Errors of more sigmas than this are outliers.
const MAX_SCORE: f64 = 4.5;
/// If half of the pairs stay off by more, the world has not moved as one, mm.
const DISAGREE_MM: f64 = 2.0;

fn levers(arm: &Arm, base: Vector3<f64>) -> [Vector3<f64>; 2] {
    let [_, lower, upper] = arm.pose(base).levers;
    [lower, upper]
}

/// How the mapped point moves with shift, turn and zeros: 3 rows, base frame.
fn jacobian(
    moved: Moved,
    rotation: &Matrix3<f64>,
    camera: Vector3<f64>,
    levers: Option<[Vector3<f64>; 2]>,
) -> DMatrix<f64> {
    let mut out = DMatrix::zeros(3, moved.unknowns());
    out.view_mut((0, 0), (3, 3)).copy_from(rotation);
    if moved != Moved::Shift {
        out.view_mut((0, 3), (3, 3))
            .copy_from(&(rotation * -camera.cross_matrix()));
    }
    if let (Moved::PoseAndZeros, Some(levers)) = (moved, levers) {
        out.set_column(6, &DVector::from_column_slice(levers[0].as_slice()));
        out.set_column(7, &DVector::from_column_slice(levers[1].as_slice()));
    }
    out
}

/// A fresh pair as the fit sees it.
struct Fresh {
    camera: Vector3<f64>,
    command: Vector3<f64>,
    /// Weights: one over sigma across and along the ray, in the base frame.
    whitening: Matrix3<f64>,
}

/// Shift, turn and zeros, solved for.
struct Solution {
    then_from_now: Isometry3<f64>,
    turns: [f64; 2],
    covariance: DMatrix<f64>,
}

impl Map {
    /// The map as it is true now, from fresh pairs taken after a bump or a crash; one gross outlier among them does no harm.
    ///
    /// # Arguments
    /// * `moved` – what may have moved.
    /// * `date` – when the pairs were taken, RFC 3339.
    ///
    /// # Errors
    /// [`RealignError`].
    pub fn realign(&self, pairs: &[Pair], moved: Moved, date: &str) -> Result<(Self, Realignment), RealignError> {
        let fitted = self.without_realignment(); // what moved before has no say in what has moved now
        let mut usable = Vec::new();
        for pair in pairs.iter().filter(|p| p.valid) {
            match pair.camera.filter(|c| c.is_finite() && pair.command.is_finite()) {
                Some(camera) => usable.push((pair, camera)),
                None => return Err(RealignError::NotFinite { id: pair.id }),
            }
        }
        let need = moved.fewest_pairs();
        if usable.len() < need {
            return Err(RealignError::TooFew {
                have: usable.len(),
                need,
                moved: moved.name(),
            });
        }
        let arm = (moved == Moved::PoseAndZeros).then(|| {
            let command: Vec<_> = usable.iter().map(|(p, _)| p.command.vector()).collect();
            let joints: Option<Vec<_>> = usable
                .iter()
                .map(|(p, _)| p.joints_rad.map(|q| [q[0], q[1], q[2]]))
                .collect();
            Arm::of(&command, &joints?)
        });
        let arm = match arm {
            Some(found) => Some(found.or_else(|| self.arm().cloned()).ok_or(RealignError::NoJoints)?),
            None => None,
        };
        let rotation = *fitted
            .base_from_camera()
            .isometry()
            .rotation
            .to_rotation_matrix()
            .matrix();
        let fresh: Vec<Fresh> = usable
            .iter()
            .map(|(pair, camera)| {
                let mapped = fitted.apply(*camera);
                let ray = rotation * camera.vector().normalize();
                let along = ray * ray.transpose();
                let (across, depth) = (mapped.sigma_lateral_mm.max(1e-3), mapped.sigma_depth_mm.max(1e-3));
                Fresh {
                    camera: camera.vector(),
                    command: pair.command.vector(),
                    whitening: (Matrix3::identity() - along) / across + along / depth,
                }
            })
            .collect();
        let all: Vec<usize> = (0..fresh.len()).collect();
        let mut used = fitted.agreeing(&fresh, moved)?;
        let mut solution = fitted.solve(&fresh, &used, moved, &rotation, arm.as_ref());
        for _ in 0..3 {
            // a least median start may have thrown out good points, or kept a bad one
            let scores: Vec<f64> = all
                .iter()
                .map(|&i| fitted.left(&fresh[i], &solution, arm.as_ref()).1)
                .collect();
            let scale = rigid::median(scores.clone()).max(1.0);
            let again: Vec<usize> = all.iter().copied().filter(|&i| scores[i] < MAX_SCORE * scale).collect();
            if again == used || again.len() < need {
                break;
            }
            used = again;
            solution = fitted.solve(&fresh, &used, moved, &rotation, arm.as_ref());
        }
        let figures = |errors: Vec<(Vector3<f64>, usize)>| {
            let with_ray = |(error, i): (Vector3<f64>, usize)| (error, rotation * fresh[i].camera.normalize());
            Figures::of(&errors.into_iter().map(with_ray).collect::<Vec<_>>())
        };
        let error_as_it_was =
            |i: usize| self.apply(Point::from_vector(fresh[i].camera)).base.vector() - fresh[i].command;
        let left_out = |i: usize| {
            let others: Vec<usize> = used.iter().copied().filter(|&k| k != i).collect();
            let without = fitted.solve(&fresh, &others, moved, &rotation, arm.as_ref());
            -fitted.left(&fresh[i], &without, arm.as_ref()).0
        };
        let told = Realignment {
            moved,
            date: date.to_owned(),
            n_used: used.len(),
            outliers: all
                .iter()
                .filter(|i| !used.contains(i))
                .map(|&i| usable[i].0.id)
                .collect(),
            shift_mm: solution.then_from_now.translation.vector.norm(),
            turn_rad: solution.then_from_now.rotation.angle(),
            zeros_rad: arm.as_ref().map(|_| solution.turns),
            before: figures(used.iter().map(|&i| (error_as_it_was(i), i)).collect()),
            after: figures(used.iter().map(|&i| (left_out(i), i)).collect()),
        };
        let n = moved.unknowns();
        let layer = Layer {
            told: told.clone(),
            then_from_now: solution.then_from_now,
            zeros: arm.map(|arm| (solution.turns, arm)),
            covariance: (0..n * n).map(|k| solution.covariance[(k / n, k % n)]).collect(),
        };
        Ok((fitted.with_layer(layer), told))
    }

    /// The pairs that most of them agree with on one motion.
    fn agreeing(&self, fresh: &[Fresh], moved: Moved) -> Result<Vec<usize>, RealignError> {
        let mapped = |f: &Fresh| self.apply(Point::from_vector(f.camera)).base.vector();
        let said: Vec<_> = fresh.iter().map(mapped).collect();
        let left: Vec<f64> = if moved == Moved::Shift {
            let off = |a: usize| rigid::median(said.iter().zip(fresh).map(|(s, f)| f.command[a] - s[a]).collect());
            let shift = Vector3::from_fn(|a, _| off(a));
            said.iter()
                .zip(fresh)
                .map(|(s, f)| (f.command - s - shift).norm())
                .collect()
        } else {
            let command: Vec<_> = fresh.iter().map(|f| f.command).collect();
            let (motion, _) = rigid::least_median(&said, &command);
            let left = |(s, t): (&Vector3<f64>, &Vector3<f64>)| (motion * Point3::from(*s) - Point3::from(*t)).norm();
            said.iter().zip(&command).map(left).collect()
        };
        let median_mm = rigid::median(left.clone());
        if median_mm > DISAGREE_MM {
            return Err(RealignError::Disagree { median_mm });
        }
        let limit_mm = (5.0 * median_mm).max(0.3);
        Ok((0..fresh.len()).filter(|&i| left[i] < limit_mm).collect())
    }

    /// What a solution leaves of a pair: command less what is said, base frame, mm, and in sigmas.
    fn left(&self, fresh: &Fresh, solution: &Solution, arm: Option<&Arm>) -> (Vector3<f64>, f64) {
        let then = solution.then_from_now * Point3::from(fresh.camera);
        let mut said = self.apply(Point::from_vector(then.coords)).base.vector();
        if let Some(arm) = arm {
            let levers = levers(arm, said);
            said += levers[0] * solution.turns[0] + levers[1] * solution.turns[1];
        }
        let left = fresh.command - said;
        (left, (fresh.whitening * left).norm() / 3f64.sqrt())
    }

    /// Least squares over some of the pairs, with what is expected of turns before measuring.
    fn solve(
        &self,
        fresh: &[Fresh],
        used: &[usize],
        moved: Moved,
        rotation: &Matrix3<f64>,
        arm: Option<&Arm>,
    ) -> Solution {
        let n = moved.unknowns();
        let mut solution = Solution {
            then_from_now: Isometry3::identity(),
            turns: [0.0; 2],
            covariance: DMatrix::zeros(n, n),
        };
        let prior = |k: usize| match k {
            0..3 => 0.0,
            3..6 => TURN_PRIOR_RAD.powi(-2),
            _ => ZERO_PRIOR_RAD.powi(-2),
        };
        for _ in 0..4 {
            let mut normal = DMatrix::from_diagonal(&DVector::from_fn(n, |k, _| prior(k)));
            let mut right = DVector::from_fn(n, |k, _| if k >= 6 { -prior(k) * solution.turns[k - 6] } else { 0.0 });
            for f in used.iter().map(|&i| &fresh[i]) {
                let (left, _) = self.left(f, &solution, arm);
                let then = (solution.then_from_now * Point3::from(f.camera)).coords;
                let jacobian = f.whitening * jacobian(moved, rotation, then, arm.map(|a| levers(a, f.command)));
                normal += jacobian.transpose() * &jacobian;
                right += jacobian.transpose() * (f.whitening * left);
            }
            let Some(factor) = normal.cholesky() else { break };
            let step = factor.solve(&right);
            let turn = if n > 3 {
                Vector3::new(step[3], step[4], step[5])
            } else {
                Vector3::zeros()
            };
            let move_ = Isometry3::from_parts(
                Translation3::new(step[0], step[1], step[2]),
                UnitQuaternion::from_scaled_axis(turn),
            );
            solution.then_from_now = move_ * solution.then_from_now;
            if n > 6 {
                solution.turns = [solution.turns[0] + step[6], solution.turns[1] + step[7]];
            }
            solution.covariance = factor.inverse();
        }
        solution
    }
}
