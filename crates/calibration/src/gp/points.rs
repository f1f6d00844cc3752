//! Calibrated points as the process sees them: residuals along the directions of their rays, and what flaws and gears of the arm do to each.

use crate::arm::Arm;
use crate::ripple::{self, Wave};
use nalgebra::{DMatrix, DVector, Isometry3, Point3, Vector3};

/// Length in which places are measured, mm.
pub(super) const UNIT_MM: f64 = 500.0;
/// Lost motion that is to be expected of a joint, to either side, rad: a hundredth of a millimetre or two at the tool.
pub(super) const LOST_RAD: f64 = 2e-5;

/// How an arm stood at a point: J1 to J3.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stance {
    pub(crate) joints_rad: [f64; 3],
    /// The sign of each joint's last motion; 0 if unknown.
    pub(crate) came_from: [f64; 3],
}

/// Trusted points, with what the rigid motion leaves of them.
pub(super) struct Points {
    pub(super) motion: Isometry3<f64>,
    pub(super) centre: Vector3<f64>,
    /// Places in the camera's frame from the centre, in [`UNIT_MM`].
    pub(super) places: Vec<Vector3<f64>>,
    pub(super) command: Vec<Vector3<f64>>,
    /// How the arm stood at each, where that is known.
    pub(super) stances: Option<Vec<Stance>>,
    /// Two directions across the ray and the one along it, in the base frame.
    pub(super) frames: Vec<[Vector3<f64>; 3]>,
    /// Residuals along these.
    pub(super) residuals: [DVector<f64>; 3],
}

/// Two directions across the ray to a camera point, and the ray, in the base frame.
pub(super) fn ray_frame(motion: &Isometry3<f64>, camera: &Vector3<f64>) -> [Vector3<f64>; 3] {
    let ray = camera.normalize();
    let right = Vector3::y().cross(&ray).normalize();
    [right, ray.cross(&right), ray].map(|d| motion.rotation * d)
}

impl Points {
    pub(super) fn new(
        motion: Isometry3<f64>,
        camera: &[Vector3<f64>],
        command: &[Vector3<f64>],
        stances: Option<Vec<Stance>>,
    ) -> Self {
        let centre = camera.iter().sum::<Vector3<f64>>() / camera.len().max(1) as f64;
        let frames: Vec<_> = camera.iter().map(|c| ray_frame(&motion, c)).collect();
        let left: Vec<Vector3<f64>> = camera
            .iter()
            .zip(command)
            .map(|(c, t)| t - (motion * Point3::from(*c)).coords)
            .collect();
        let residuals = [0, 1, 2].map(|a| DVector::from_fn(left.len(), |i, _| left[i].dot(&frames[i][a])));
        Self {
            motion,
            centre,
            places: camera.iter().map(|c| (c - centre) / UNIT_MM).collect(),
            command: command.to_vec(),
            stances,
            frames,
            residuals,
        }
    }

    /// What displacements of every point are along the directions of its ray, one below the other.
    pub(super) fn along_rays(&self, columns: usize, displacement: impl Fn(usize) -> Vec<Vector3<f64>>) -> DMatrix<f64> {
        let n = self.places.len();
        let mut effect = DMatrix::zeros(3 * n, columns);
        for i in 0..n {
            for (k, moved) in displacement(i).into_iter().enumerate() {
                for a in 0..3 {
                    effect[(a * n + i, k)] = moved.dot(&self.frames[i][a]);
                }
            }
        }
        effect
    }

    /// What the flaws of an arm do to every point: those that a place tells, and the lost motion of J1 to J3, which is another
    /// according to where each joint came from.
    pub(super) fn flaws(&self, arm: Option<&Arm>) -> Flaws {
        let (Some(arm), Some(stances)) = (arm, &self.stances) else {
            return Flaws {
                placed: 0,
                columns: DMatrix::zeros(3 * self.places.len(), 0),
            };
        };
        let placed = self.command.first().map_or(0, |c| arm.flaws(*c).len());
        let columns = self.along_rays(placed + 3, |i| {
            let mut flaws = arm.flaws(self.command[i]);
            flaws.extend(lost_motion(arm, self.command[i], stances[i].came_from));
            flaws
        });
        Flaws { placed, columns }
    }

    /// Some of the points.
    pub(super) fn only(&self, picks: &[usize]) -> Self {
        Self {
            motion: self.motion,
            centre: self.centre,
            places: picks.iter().map(|&i| self.places[i]).collect(),
            command: picks.iter().map(|&i| self.command[i]).collect(),
            stances: self.stances.as_ref().map(|s| picks.iter().map(|&i| s[i]).collect()),
            frames: picks.iter().map(|&i| self.frames[i]).collect(),
            residuals: [0, 1, 2].map(|a| DVector::from_fn(picks.len(), |k, _| self.residuals[a][picks[k]])),
        }
    }

    /// What a wave of a joint does to every point, cosine and sine, along the directions of its ray, one below the other.
    pub(super) fn wave(&self, turns: &Turns, wave: Wave) -> DMatrix<f64> {
        let n = self.places.len();
        let mut effect = DMatrix::zeros(3 * n, 2);
        for i in 0..n {
            let lever = turns.levers[i][wave.joint];
            let (sin, cos) = (wave.cycles * turns.joints_rad[i][wave.joint]).sin_cos();
            for a in 0..3 {
                let along = ripple::PRIOR_RAD * lever.dot(&self.frames[i][a]);
                effect[(a * n + i, 0)] = along * cos;
                effect[(a * n + i, 1)] = along * sin;
            }
        }
        effect
    }
}

/// What flaws do to points: columns of those that a place tells, and then of lost motion.
pub(super) struct Flaws {
    pub(super) placed: usize,
    pub(super) columns: DMatrix<f64>,
}

/// How a commanded point is missed, mm, by the lost motion that is to be expected of each joint.
pub(super) fn lost_motion(arm: &Arm, command: Vector3<f64>, came_from: [f64; 3]) -> [Vector3<f64>; 3] {
    let levers = arm.pose(command).levers;
    std::array::from_fn(|j| levers[j] * (came_from[j] * LOST_RAD))
}

/// Joint angles at every point, and how each joint moves it.
pub(super) struct Turns {
    pub(super) joints_rad: Vec<[f64; 3]>,
    pub(super) levers: Vec<[Vector3<f64>; 3]>,
}

impl Turns {
    pub(super) fn new(arm: &Arm, command: &[Vector3<f64>], stances: &[Stance]) -> Self {
        Self {
            joints_rad: stances.iter().map(|s| s.joints_rad).collect(),
            levers: command.iter().map(|c| arm.pose(*c).levers).collect(),
        }
    }
}
