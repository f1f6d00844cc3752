//! A fitted process, baked on a grid of nodes so that a query takes less than a microsecond.

use super::points::{LOST_RAD, Points, UNIT_MM, ray_frame};
use super::{Choice, Kernel, Stance, System, columns, stacked};
use crate::ripple::{self, Ripple, Wave};
use nalgebra::{DMatrix, DVector, Isometry3, Point3, Vector3};

/// A map that is as sure as this is sure enough, however well the camera measures: a seventh of what the paper reaches, mm.
const SURE_MM: f64 = 0.05;
/// Distance of the nodes of the baked correction, mm; of its variance, twice that.
const NODE_MM: f64 = 32.0;
/// How far beyond the points the correction is baked, mm.
const MARGIN_MM: f64 = 80.0;

/// The process without baking: slow, and true everywhere.
struct Exact<'a> {
    points: &'a Points,
    choice: &'a Choice,
    kernels: [Kernel; 2],
    system: System,
    weights: DVector<f64>,
    /// Of every column, in units of what is expected of it: flaws that a place tells, lost motion, waves.
    coefficients: DVector<f64>,
    placed: usize,
    flawed: usize,
    /// Covariance of the placed flaws, and the columns of each component that reach them.
    open: DMatrix<f64>,
    reach: [DMatrix<f64>; 3],
}

/// A place as [`Exact`] sees it.
struct At {
    place: Vector3<f64>,
    base: Vector3<f64>,
    frame: [Vector3<f64>; 3],
    /// Covariance with every point, across and along.
    near: [DVector<f64>; 2],
    /// What the placed flaws do there: a row a component.
    flaws: DMatrix<f64>,
}

impl<'a> Exact<'a> {
    fn new(points: &'a Points, choice: &'a Choice) -> Option<Self> {
        let n = points.places.len();
        let flaws = points.flaws(choice.flawed.as_ref());
        let (placed, flawed) = (flaws.placed, flaws.columns.ncols());
        let kernels = [choice.across, choice.along];
        let columns = columns(points, choice.flawed.as_ref(), choice.ripple.as_ref());
        let system = System::new(points, kernels, columns)?;
        let weights = system.times(&stacked(&points.residuals));
        Some(Self {
            points,
            choice,
            kernels,
            coefficients: system.columns.tr_mul(&weights),
            weights,
            placed,
            flawed,
            open: system.small.view((0, 0), (placed, placed)).into_owned(),
            reach: [0, 1, 2].map(|a| system.solved.view((a * n, 0), (n, placed)).into_owned()),
            system,
        })
    }

    /// Cosine and sine of each wave, rad.
    fn swings(&self) -> Vec<[f64; 2]> {
        let waves = self.coefficients.rows_range(self.flawed..) * ripple::PRIOR_RAD;
        (0..waves.len() / 2).map(|k| [waves[2 * k], waves[2 * k + 1]]).collect()
    }

    /// A place in the camera's frame, from the centre of the points, in [`UNIT_MM`].
    fn at(&self, place: Vector3<f64>) -> At {
        let points = self.points;
        let camera = points.centre + place * UNIT_MM;
        let base = (points.motion * Point3::from(camera)).coords;
        let frame = ray_frame(&points.motion, &camera);
        let moved = self.choice.flawed.as_ref().map_or_else(Vec::new, |arm| arm.flaws(base));
        At {
            near: self
                .kernels
                .map(|k| DVector::from_fn(points.places.len(), |i, _| k.of(&place, &points.places[i]))),
            flaws: DMatrix::from_fn(3, self.placed, |a, k| moved[k].dot(&frame[a])),
            place,
            base,
            frame,
        }
    }

    /// The smooth part of the correction, along the directions of the ray, mm.
    fn correction(&self, at: &At) -> Vector3<f64> {
        let n = self.points.places.len();
        Vector3::from_fn(|a, _| {
            at.near[a / 2].dot(&self.weights.rows(a * n, n))
                + at.flaws.row(a).tr_dot(&self.coefficients.rows(0, self.placed))
        })
    }

    /// Variance at each place, mm²: of the smooth part, across and along the ray, and of what is too short for the nodes: of waves, and of
    /// lost motion, since nobody knows from where the joints will come.
    fn variances(&self, places: Vec<At>) -> Vec<[f64; 4]> {
        // many places at once: a product of matrices is far faster than one column at a time
        let solved = [0, 1].map(|c| {
            let near: Vec<_> = places.iter().map(|at| at.near[c].clone()).collect();
            &self.system.blocks[c] * DMatrix::from_columns(&near)
        });
        let of = |(k, at): (usize, &At)| {
            let smooth = |c: usize| {
                let own = self.kernels[c].of(&at.place, &at.place);
                (own - at.near[c].dot(&solved[c].column(k))).max(0.0)
            };
            // what is not known of the flaws, as far as it is not what the kernels take it for
            let flaws = |a: usize| {
                let left = at.flaws.row(a).transpose() - self.reach[a].tr_mul(&at.near[a / 2]);
                left.dot(&(&self.open * &left))
            };
            let short = self.short(at);
            [
                smooth(0) + 0.5 * (flaws(0) + flaws(1)),
                smooth(1) + flaws(2),
                0.5 * (short[0] + short[1]),
                short[2],
            ]
        };
        places.iter().enumerate().map(of).collect()
    }

    /// Variance of lost motion and waves along the directions of the ray, mm².
    fn short(&self, at: &At) -> [f64; 3] {
        let Some(arm) = &self.choice.flawed else {
            return [0.0; 3];
        };
        let levers = arm.pose(at.base).levers;
        let waves = self.choice.ripple.as_ref().map_or(&[][..], |r| &r.waves);
        [0, 1, 2].map(|a| {
            let lever = |j: usize| levers[j].dot(&at.frame[a]).powi(2);
            let lost = |j: usize| (LOST_RAD * self.coefficients[self.placed + j]).powi(2);
            // whatever the phase
            let wave = |(w, wave): (usize, &Wave)| {
                let k = self.flawed + 2 * w;
                let open = 0.5 * (self.system.small[(k, k)] + self.system.small[(k + 1, k + 1)]);
                lever(wave.joint) * open * ripple::PRIOR_RAD.powi(2)
            };
            (0..3).map(|j| lever(j) * lost(j)).sum::<f64>() + waves.iter().enumerate().map(wave).sum::<f64>()
        })
    }
}

/// A fitted process, ready for queries.
#[derive(Clone, Debug)]
pub(crate) struct Gp {
    motion: Isometry3<f64>,
    low: Vector3<f64>,
    counts: [usize; 3],
    /// Correction along the directions of the ray at each node, mm.
    correction: Vec<Vector3<f64>>,
    /// Variance at every second node, mm²: of what is smooth, across and along, and of ripple and lost motion, across and along.
    variance: Vec<[f64; 4]>,
    ripple: Option<Ripple>,
    /// Cosine and sine of each wave, rad.
    swings: Vec<[f64; 2]>,
    noise_mm: [f64; 2],
    scale: [f64; 2],
}

/// What the process says about a camera point.
pub(crate) struct Answer {
    pub(crate) base: Vector3<f64>,
    /// Standard deviation along each axis across the ray, and along it, of map and one measurement, mm.
    pub(crate) sigma_mm: [f64; 2],
    /// Variance of the map in units of the variance of one measurement, the larger of the two.
    pub(crate) leverage: f64,
}

impl Gp {
    /// From points and what a fit chose.
    pub(crate) fn again(
        camera: &[Vector3<f64>],
        command: &[Vector3<f64>],
        stances: Option<Vec<Stance>>,
        choice: &Choice,
    ) -> Option<Self> {
        let motion = crate::rigid::kabsch(camera, command, &vec![1.0; camera.len()]);
        Self::bake(&Points::new(motion, camera, command, stances), choice)
    }

    pub(super) fn bake(points: &Points, choice: &Choice) -> Option<Self> {
        let exact = Exact::new(points, choice)?;
        let margin = Vector3::repeat(MARGIN_MM / UNIT_MM);
        let (first, node) = (points.places[0], NODE_MM / UNIT_MM);
        let (low, high) = points
            .places
            .iter()
            .fold((first, first), |(l, h), p| (l.inf(p), h.sup(p)));
        let (low, high) = (low - margin, high + margin);
        // an even number of steps: the variance has every second node
        let counts: [usize; 3] = ((high - low) / (2.0 * node)).map(|e| 2 * e.ceil() as usize + 1).into();
        let mut correction = Vec::with_capacity(counts.iter().product());
        let mut variance = Vec::new();
        for z in 0..counts[2] {
            for y in 0..counts[1] {
                let place = |x: usize| low + Vector3::new(x as f64, y as f64, z as f64) * node;
                let row: Vec<At> = (0..counts[0]).map(|x| exact.at(place(x))).collect();
                correction.extend(row.iter().map(|at| exact.correction(at)));
                if y % 2 + z % 2 == 0 {
                    variance.extend(exact.variances(row.into_iter().step_by(2).collect()));
                }
            }
        }
        Some(Self {
            motion: points.motion,
            low: points.centre + low * UNIT_MM,
            counts,
            correction,
            variance,
            ripple: choice.ripple.clone(),
            swings: exact.swings(),
            noise_mm: [choice.across, choice.along].map(|k| k.noise_mm),
            scale: choice.scale,
        })
    }

    /// How far places of the camera's frame are from where they would be without baking, mm.
    pub(crate) fn baking_errors(
        &self,
        camera: &[Vector3<f64>],
        command: &[Vector3<f64>],
        stances: Option<Vec<Stance>>,
        choice: &Choice,
        asked: &[Vector3<f64>],
    ) -> Option<Vec<f64>> {
        let points = Points::new(self.motion, camera, command, stances);
        let exact = Exact::new(&points, choice)?;
        let error = |at: &Vector3<f64>| {
            let correction = exact.correction(&exact.at((at - points.centre) / UNIT_MM));
            (self.shifted(*at, correction) - self.at(*at).base).norm()
        };
        Some(asked.iter().map(error).collect())
    }

    /// Where a camera point is in the base frame if the smooth part of its correction, along its ray, is this.
    fn shifted(&self, camera: Vector3<f64>, correction: Vector3<f64>) -> Vector3<f64> {
        let frame = ray_frame(&self.motion, &camera);
        let mut base = (self.motion * Point3::from(camera)).coords;
        base += frame[0] * correction.x + frame[1] * correction.y + frame[2] * correction.z;
        if let Some(ripple) = &self.ripple {
            base += ripple.shift(base, &self.swings);
        }
        base
    }

    /// Where a camera point is in the base frame; outside the baked box, as at its border.
    pub(crate) fn at(&self, camera: Vector3<f64>) -> Answer {
        let place: [f64; 3] = std::array::from_fn(|a| {
            ((camera[a] - self.low[a]) / NODE_MM).clamp(0.0, self.counts[a] as f64 - 1.000_001)
        });
        let base = self.shifted(camera, self.cubic(place));
        let variance = self.linear(place);
        Answer {
            base,
            leverage: [0, 1]
                .map(|c| variance[c] / self.noise_mm[c].max(SURE_MM).powi(2))
                .into_iter()
                .fold(0.0, f64::max),
            sigma_mm: [0, 1].map(|c| self.scale[c] * (variance[c] + variance[c + 2] + self.noise_mm[c].powi(2)).sqrt()),
        }
    }

    /// The cubics through four nodes along each axis (Lagrange): four times as close as those whose slope has no steps at the nodes, which
    /// here are smaller than anything that can be measured.
    fn cubic(&self, place: [f64; 3]) -> Vector3<f64> {
        let taps = place.map(|p| {
            let (i, t) = (p as usize, p.fract());
            let weights = [
                -t * (t - 1.0) * (t - 2.0) / 6.0,
                (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
                -(t + 1.0) * t * (t - 2.0) / 2.0,
                (t + 1.0) * t * (t - 1.0) / 6.0,
            ];
            (i, weights)
        });
        let [nx, ny, nz] = self.counts;
        // one beyond the border: the border
        let node = |i: usize, k: usize, n: usize| (i + k).saturating_sub(1).min(n - 1);
        let mut sum = Vector3::zeros();
        for (kz, wz) in taps[2].1.iter().enumerate() {
            for (ky, wy) in taps[1].1.iter().enumerate() {
                let row = (node(taps[2].0, kz, nz) * ny + node(taps[1].0, ky, ny)) * nx;
                let mut along = Vector3::zeros();
                for (kx, wx) in taps[0].1.iter().enumerate() {
                    along += self.correction[row + node(taps[0].0, kx, nx)] * *wx;
                }
                sum += along * (wy * wz);
            }
        }
        sum
    }

    fn linear(&self, place: [f64; 3]) -> [f64; 4] {
        let counts = self.counts.map(|n| n.div_ceil(2));
        let at = place.map(|p| p / 2.0);
        let mut sum = [0.0; 4];
        for corner in 0..8 {
            let (mut index, mut weight) = (0, 1.0);
            for a in (0..3).rev() {
                let step = corner >> a & 1;
                let (i, t) = (at[a] as usize, at[a].fract());
                index = index * counts[a] + (i + step).min(counts[a] - 1);
                weight *= if step == 1 { t } else { 1.0 - t };
            }
            let value = self.variance[index];
            sum = [0, 1, 2, 3].map(|c| sum[c] + weight * value[c]);
        }
        sum
    }
}
