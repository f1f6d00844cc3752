//! A Gaussian process of what a rigid motion leaves, across and along the viewing ray, with the ripple of the arm's gears.
//!
//! A camera measures worse along the ray than across it, and what it measures there has other causes: the two have their own
//! kernels, chosen by likelihood. Gears add waves that are far shorter than the distance of calibrated points, but they are waves of
//! the joint angle: see [`Ripple`].

use crate::arm::Arm;
use crate::ripple::{self, Ripple, Wave};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Isometry3, Point3, Vector3};
use serde::{Deserialize, Serialize};
use std::rc::Rc;

/// Length in which places are measured, mm.
const UNIT_MM: f64 = 500.0;
/// Prior standard deviation of the affine part, mm over [`UNIT_MM`]: more than any camera and arm are off, little enough to compute with.
const AFFINE_MM: f64 = 10.0;
/// Points by which a kernel is chosen; more say little more and take their number to the third power of time.
const KERNEL_POINTS: usize = 180;
/// What changes over less than points are apart cannot be told from noise, and could not be baked, mm.
const SHORTEST_MM: f64 = 120.0;
/// With more points than this, half of them tell how true sigma is.
const MANY_POINTS: usize = 150;
/// Points that the process rests on.
pub(crate) const MOST_POINTS: usize = 400;
/// Left-out errors of more sigmas than this are outliers.
const MAX_SCORE: f64 = 4.0;
/// A point that was doubted is believed again if what all others say of it is no more sigmas off.
const GOOD_SCORE: f64 = 3.5;
/// Where the search for kernels starts: across and along the ray.
const START: [Kernel; 2] = [
    Kernel {
        smooth_mm: 0.3,
        length_mm: 400.0,
        noise_mm: 0.06,
    },
    Kernel {
        smooth_mm: 0.3,
        length_mm: 400.0,
        noise_mm: 0.1,
    },
];
/// Rounds of rejection.
const ROUNDS: usize = 6;
/// Lost motion that is to be expected of a joint, to either side, rad: a hundredth of a millimetre or two at the tool.
const LOST_RAD: f64 = 2e-5;
/// A map that is as sure as this is sure enough, however well the camera measures: a seventh of what the paper reaches, mm.
const SURE_MM: f64 = 0.05;
/// Distance of the nodes of the baked correction, mm; of its variance, twice that.
const NODE_MM: f64 = 32.0;
/// How far beyond the points the correction is baked, mm.
const MARGIN_MM: f64 = 80.0;

/// Squared-exponential kernel over an affine one, with noise; mm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Kernel {
    /// Standard deviation of what is smooth but not affine.
    pub(crate) smooth_mm: f64,
    /// Distance over which it changes.
    pub(crate) length_mm: f64,
    /// Standard deviation of one measurement.
    pub(crate) noise_mm: f64,
}

impl Kernel {
    fn of(&self, a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
        let length = self.length_mm / UNIT_MM;
        self.smooth_mm.powi(2) * (-0.5 * (a - b).norm_squared() / (length * length)).exp()
            + AFFINE_MM.powi(2) * (1.0 + a.dot(b))
    }

    fn matrix(&self, places: &[Vector3<f64>]) -> DMatrix<f64> {
        let n = places.len();
        let mut k = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in 0..=i {
                let value = self.of(&places[i], &places[j]);
                (k[(i, j)], k[(j, i)]) = (value, value);
            }
            k[(i, i)] += self.noise_mm.powi(2);
        }
        k
    }

    fn factor(&self, places: &[Vector3<f64>]) -> Option<Cholesky<f64, Dyn>> {
        self.matrix(places).cholesky()
    }

    /// The kernel of least cost, searched from here.
    fn best(self, cost: impl Fn(Self) -> f64, trials: usize) -> Self {
        let kernel = |x: &Vector3<f64>| Self {
            smooth_mm: x[0].clamp(-7.0, 3.0).exp(),
            length_mm: x[1].exp().clamp(SHORTEST_MM, 8000.0),
            noise_mm: x[2].exp().clamp(crate::lattice::FLOOR_MM, 10.0),
        };
        let at = Vector3::new(self.smooth_mm.ln(), self.length_mm.ln(), self.noise_mm.ln());
        kernel(&simplex(|x| cost(kernel(x)), at, trials))
    }
}

/// The lowest place that a simplex finds in so many trials (Nelder and Mead 1965).
fn simplex(cost: impl Fn(&Vector3<f64>) -> f64, start: Vector3<f64>, trials: usize) -> Vector3<f64> {
    let corner = |k: usize| {
        start
            + if k == 0 {
                Vector3::zeros()
            } else {
                Vector3::ith(k - 1, 0.4)
            }
    };
    let mut corners: Vec<(f64, Vector3<f64>)> = (0..4).map(|k| (cost(&corner(k)), corner(k))).collect();
    for _ in 0..trials {
        corners.sort_by(|a, b| a.0.total_cmp(&b.0));
        if corners[3].0 - corners[0].0 < 1e-4 {
            break;
        }
        let middle = (corners[0].1 + corners[1].1 + corners[2].1) / 3.0;
        let along = |t: f64| middle + (corners[3].1 - middle) * t;
        let try_at = |t: f64| (cost(&along(t)), along(t));
        let mirrored = try_at(-1.0);
        if mirrored.0 < corners[0].0 {
            let farther = try_at(-2.0);
            corners[3] = if farther.0 < mirrored.0 { farther } else { mirrored };
        } else if mirrored.0 < corners[2].0 {
            corners[3] = mirrored;
        } else {
            let nearer = try_at(0.5);
            if nearer.0 < corners[3].0 {
                corners[3] = nearer;
            } else {
                let best = corners[0].1;
                for c in &mut corners[1..] {
                    let at = (c.1 + best) / 2.0;
                    *c = (cost(&at), at);
                }
            }
        }
    }
    corners.sort_by(|a, b| a.0.total_cmp(&b.0));
    corners[0].1
}

/// What a fit chose, and all that a map file needs to make it again from its points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Choice {
    /// Places of the points that it rests on among all that are believed.
    pub(crate) points: Vec<usize>,
    pub(crate) across: Kernel,
    pub(crate) along: Kernel,
    /// The arm whose flaws (lengths, axes, zeros, bending) it takes out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) flawed: Option<Arm>,
    pub(crate) ripple: Option<Ripple>,
    /// True error over stated sigma, across and along: the process knows nothing of what it cannot model.
    pub(crate) scale: [f64; 2],
}

/// How an arm stood at a point: J1 to J3.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stance {
    pub(crate) joints_rad: [f64; 3],
    /// The sign of each joint's last motion; 0 if unknown.
    pub(crate) came_from: [f64; 3],
}

/// Trusted points, with what the rigid motion leaves of them.
pub(crate) struct Points {
    pub(crate) motion: Isometry3<f64>,
    centre: Vector3<f64>,
    /// Places in the camera's frame from the centre, in [`UNIT_MM`].
    places: Vec<Vector3<f64>>,
    command: Vec<Vector3<f64>>,
    /// How the arm stood at each, where that is known.
    stances: Option<Vec<Stance>>,
    /// Two directions across the ray and the one along it, in the base frame.
    frames: Vec<[Vector3<f64>; 3]>,
    /// Residuals along these.
    residuals: [DVector<f64>; 3],
}

/// Two directions across the ray to a camera point, and the ray, in the base frame.
fn ray_frame(motion: &Isometry3<f64>, camera: &Vector3<f64>) -> [Vector3<f64>; 3] {
    let ray = camera.normalize();
    let right = Vector3::y().cross(&ray).normalize();
    [right, ray.cross(&right), ray].map(|d| motion.rotation * d)
}

impl Points {
    fn new(
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
    fn along_rays(&self, columns: usize, displacement: impl Fn(usize) -> Vec<Vector3<f64>>) -> DMatrix<f64> {
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
    fn flaws(&self, arm: Option<&Arm>) -> Flaws {
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
    fn only(&self, picks: &[usize]) -> Self {
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
    fn wave(&self, turns: &Turns, wave: Wave) -> DMatrix<f64> {
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
struct Flaws {
    placed: usize,
    columns: DMatrix<f64>,
}

/// How a commanded point is missed, mm, by the lost motion that is to be expected of each joint.
fn lost_motion(arm: &Arm, command: Vector3<f64>, came_from: [f64; 3]) -> [Vector3<f64>; 3] {
    let levers = arm.pose(command).levers;
    std::array::from_fn(|j| levers[j] * (came_from[j] * LOST_RAD))
}

/// Joint angles at every point, and how each joint moves it.
struct Turns {
    joints_rad: Vec<[f64; 3]>,
    levers: Vec<[Vector3<f64>; 3]>,
}

impl Turns {
    fn new(arm: &Arm, command: &[Vector3<f64>], stances: &[Stance]) -> Self {
        Self {
            joints_rad: stances.iter().map(|s| s.joints_rad).collect(),
            levers: command.iter().map(|c| arm.pose(*c).levers).collect(),
        }
    }
}

/// What one kernel says of the residuals that it stands for, and of the columns along them.
struct Part {
    /// Half of the log determinant of its covariance, and half of the square of the residuals under it.
    cost: f64,
    /// Columns under it: with each other, and with the residuals.
    inner: DMatrix<f64>,
    seen: DVector<f64>,
}

impl Part {
    fn new(points: &Points, kernel: Kernel, axes: &[usize], columns: &DMatrix<f64>) -> Option<Self> {
        let n = points.places.len();
        let factor = kernel.factor(&points.places)?;
        let l = factor.l_dirty();
        let log_det: f64 = (0..n).map(|i| l[(i, i)].ln()).sum();
        let m = columns.ncols();
        let mut part = Self {
            cost: 0.0,
            inner: DMatrix::zeros(m, m),
            seen: DVector::zeros(m),
        };
        for &a in axes {
            let mut both = columns.rows(a * n, n).into_owned().insert_column(m, 0.0);
            both.set_column(m, &points.residuals[a]);
            if !l.solve_lower_triangular_mut(&mut both) {
                return None;
            }
            let (own, residual) = (both.columns(0, m), both.column(m));
            part.cost += log_det + 0.5 * residual.norm_squared();
            part.inner += own.tr_mul(&own);
            part.seen += own.tr_mul(&residual);
        }
        Some(part)
    }

    /// Minus the log likelihood of all residuals, whatever the columns' coefficients.
    fn cost_with(&self, other: &Self) -> f64 {
        let m = self.seen.len();
        let inner = &self.inner + &other.inner + DMatrix::identity(m, m);
        let seen = &self.seen + &other.seen;
        let Some(factor) = inner.cholesky() else {
            return 1e12;
        };
        let l = factor.l_dirty();
        let log_det: f64 = (0..m).map(|i| l[(i, i)].ln()).sum();
        self.cost + other.cost + log_det - 0.5 * seen.dot(&factor.solve(&seen))
    }
}

/// The covariance of all residuals, inverted: one block across (twice), one along, and as a correction of low rank what the arm's flaws
/// and the waves do, in units of what is expected of each.
struct System {
    blocks: Rc<[DMatrix<f64>; 2]>,
    /// Effects of flaws and waves, and the blocks' inverse times them.
    columns: DMatrix<f64>,
    solved: DMatrix<f64>,
    /// Covariance of their coefficients.
    small: DMatrix<f64>,
}

impl System {
    fn new(points: &Points, kernels: [Kernel; 2], columns: DMatrix<f64>) -> Option<Self> {
        let [across, along] = kernels.map(|k| k.factor(&points.places).map(|f| f.inverse()));
        Self::over(Rc::new([across?, along?]), columns)
    }

    /// The same kernels with other columns.
    fn with(&self, columns: DMatrix<f64>) -> Option<Self> {
        Self::over(Rc::clone(&self.blocks), columns)
    }

    fn over(blocks: Rc<[DMatrix<f64>; 2]>, columns: DMatrix<f64>) -> Option<Self> {
        let mut system = Self {
            blocks,
            solved: DMatrix::zeros(columns.nrows(), 0),
            small: DMatrix::zeros(0, 0),
            columns,
        };
        system.solved = system.block_times(&system.columns);
        let m = system.columns.ncols();
        let inner = system.columns.tr_mul(&system.solved) + DMatrix::identity(m, m);
        system.small = inner.cholesky()?.inverse();
        Some(system)
    }

    /// The blocks' inverse times columns.
    fn block_times(&self, columns: &DMatrix<f64>) -> DMatrix<f64> {
        let n = self.blocks[0].nrows();
        let mut product = DMatrix::zeros(columns.nrows(), columns.ncols());
        for (a, block) in [&self.blocks[0], &self.blocks[0], &self.blocks[1]]
            .into_iter()
            .enumerate()
        {
            product.rows_mut(a * n, n).copy_from(&(block * columns.rows(a * n, n)));
        }
        product
    }

    /// The whole inverse times a column.
    fn times(&self, column: &DVector<f64>) -> DVector<f64> {
        let plain = self.block_times(&DMatrix::from_column_slice(column.len(), 1, column.as_slice()));
        let plain = DVector::from_column_slice(plain.as_slice());
        &plain - &self.solved * (&self.small * (self.solved.transpose() * column))
    }

    /// Diagonal of the whole inverse.
    fn diagonal(&self) -> DVector<f64> {
        let n = self.blocks[0].nrows();
        let less = &self.solved * &self.small;
        DVector::from_fn(3 * n, |i, _| {
            let block = &self.blocks[i / n / 2];
            block[(i % n, i % n)] - less.row(i).dot(&self.solved.row(i))
        })
    }

    /// Errors of every residual predicted from all others, with their variance.
    fn left_out(&self, residuals: &DVector<f64>) -> (DVector<f64>, DVector<f64>) {
        let diagonal = self.diagonal();
        (
            self.times(residuals).component_div(&diagonal),
            diagonal.map(|d| 1.0 / d),
        )
    }

    /// Squares of the errors, in sigmas, of a point that is not among those of the system, along the directions of its ray.
    fn surprise(
        &self,
        points: &Points,
        kernels: [Kernel; 2],
        weights: &DVector<f64>,
        alone: &Points,
        columns: &DMatrix<f64>,
    ) -> [f64; 3] {
        let n = points.places.len();
        let coefficients = self.columns.tr_mul(weights);
        let at = &alone.places[0];
        [0, 1, 2].map(|a| {
            let (kernel, block) = (kernels[a / 2], &self.blocks[a / 2]);
            let k = DVector::from_fn(n, |i, _| kernel.of(at, &points.places[i]));
            let own = columns.row(a).transpose();
            let said = k.dot(&weights.rows(a * n, n)) + own.dot(&coefficients);
            let open = own - self.solved.rows(a * n, n).tr_mul(&k);
            let variance =
                kernel.of(at, at) - k.dot(&(block * &k)) + kernel.noise_mm.powi(2) + open.dot(&(&self.small * &open));
            (alone.residuals[a][0] - said).powi(2) / variance.max(1e-12)
        })
    }

    /// Twice the log of how much likelier the residuals are with one more wave, for each of several, two columns each.
    fn gains(&self, weights: &DVector<f64>, waves: &DMatrix<f64>) -> Vec<f64> {
        let solved = self.block_times(waves);
        let crossed = self.solved.tr_mul(waves);
        let less = &self.small * &crossed;
        let seen = waves.tr_mul(weights);
        let gain = |k: usize| {
            let two = |m: &DMatrix<f64>| m.columns(2 * k, 2).into_owned();
            let inner = two(waves).tr_mul(&two(&solved)) - two(&crossed).tr_mul(&two(&less));
            let with = inner + DMatrix::identity(2, 2);
            let seen = seen.rows(2 * k, 2);
            let Some(factor) = with.clone().cholesky() else {
                return 0.0;
            };
            seen.dot(&factor.solve(&seen)) - with.determinant().ln()
        };
        (0..waves.ncols() / 2).map(gain).collect()
    }
}

fn stacked(parts: &[DVector<f64>; 3]) -> DVector<f64> {
    let n = parts[0].len();
    DVector::from_fn(3 * n, |i, _| parts[i / n][i % n])
}

fn side_by_side(points: &Points, turns: &Turns, waves: &[Wave]) -> DMatrix<f64> {
    let mut all = DMatrix::zeros(3 * points.places.len(), 2 * waves.len());
    for (k, wave) in waves.iter().enumerate() {
        all.columns_mut(2 * k, 2).copy_from(&points.wave(turns, *wave));
    }
    all
}

/// Evenly spread picks of `most` of `n`.
fn picks(n: usize, most: usize) -> Vec<usize> {
    let taken = n.min(most);
    (0..taken).map(|k| k * n / taken.max(1)).collect()
}

/// The likeliest kernels, whatever the columns' coefficients.
fn kernels(points: &Points, columns: &DMatrix<f64>, start: [Kernel; 2], trials: usize) -> Option<[Kernel; 2]> {
    let n = points.places.len();
    let picks = picks(n, KERNEL_POINTS);
    let points = points.only(&picks);
    let rows: Vec<usize> = (0..3).flat_map(|a| picks.iter().map(move |i| a * n + i)).collect();
    let columns = columns.select_rows(&rows);
    let part = |kernel: Kernel, axes: &[usize]| Part::new(&points, kernel, axes, &columns);
    let cost = |part: Option<Part>, other: &Part| part.map_or(1e12, |p| p.cost_with(other));
    let along = part(start[1], &[2])?;
    let across = start[0].best(|k| cost(part(k, &[0, 1]), &along), trials);
    let other = part(across, &[0, 1])?;
    let along = start[1].best(|k| cost(part(k, &[2]), &other), trials);
    Some([across, along])
}

/// What a fit found out.
pub(crate) struct Fitted {
    pub(crate) choice: Choice,
    /// Which of the points are believed.
    pub(crate) keep: Vec<bool>,
    /// Error of each believed point, predicted from the others, in the base frame.
    pub(crate) left_out: Vec<Vector3<f64>>,
    pub(crate) gp: Gp,
}

/// Fits to points, of which `keep` says which to believe at first; `stances` tell how the arm stood at every point, where the pairs
/// have joint angles. `None` if there is nothing smooth about them.
pub(crate) fn fit(
    camera: &[Vector3<f64>],
    command: &[Vector3<f64>],
    stances: Option<&[Stance]>,
    arm: Option<Arm>,
    mut keep: Vec<bool>,
) -> Option<Fitted> {
    let chosen = |keep: &[bool]| -> Vec<usize> { (0..keep.len()).filter(|&i| keep[i]).collect() };
    let points_of = |used: &[usize]| {
        let of = |all: &[Vector3<f64>]| -> Vec<Vector3<f64>> { used.iter().map(|&i| all[i]).collect() };
        let (camera, command) = (of(camera), of(command));
        let stances = stances.map(|s| used.iter().map(|&i| s[i]).collect());
        let motion = crate::rigid::kabsch(&camera, &command, &vec![1.0; used.len()]);
        Points::new(motion, &camera, &command, stances)
    };
    let mut both = START;
    for round in 0.. {
        let used = chosen(&keep);
        let points = points_of(&used);
        let flaws = points.flaws(arm.as_ref()).columns;
        both = kernels(&points, &flaws, both, 60)?;
        let system = System::new(&points, both, flaws)?;
        let (errors, variances) = system.left_out(&stacked(&points.residuals));
        let n = used.len();
        let square = |a: usize, i: usize| errors[a * n + i].powi(2) / variances[a * n + i];
        let mut scores: Vec<(f64, usize)> = (0..n)
            .map(|i| (score([square(0, i), square(1, i), square(2, i)]), i))
            .filter(|(score, _)| *score > MAX_SCORE)
            .collect();
        if scores.is_empty() || n < 12 || round == ROUNDS {
            break;
        }
        // an outlier makes its neighbours look bad: the worse half first
        scores.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (_, i) in &scores[..scores.len().div_ceil(2)] {
            keep[used[*i]] = false;
        }
    }
    let mut used = chosen(&keep);
    let mut points = points_of(&used);
    let (mut ripple, found) = waves(&points, arm.as_ref(), both)?;
    both = found;
    // what gross outliers made look bad may be good after all
    let doubted = chosen(&keep.iter().map(|k| !k).collect::<Vec<_>>());
    if !doubted.is_empty() {
        let system = System::new(&points, both, columns(&points, arm.as_ref(), ripple.as_ref()))?;
        let weights = system.times(&stacked(&points.residuals));
        for i in doubted {
            let of = |all: &[Vector3<f64>]| vec![all[i]];
            let mut alone = Points::new(points.motion, &of(camera), &of(command), stances.map(|s| vec![s[i]]));
            alone.places = vec![(camera[i] - points.centre) / UNIT_MM];
            let own = columns(&alone, arm.as_ref(), ripple.as_ref());
            keep[i] = score(system.surprise(&points, both, &weights, &alone, &own)) < GOOD_SCORE;
        }
        if chosen(&keep) != used {
            used = chosen(&keep);
            points = points_of(&used);
            (ripple, both) = waves(&points, arm.as_ref(), both)?;
        }
    }
    let system = System::new(&points, both, columns(&points, arm.as_ref(), ripple.as_ref()))?;
    let (errors, _) = system.left_out(&stacked(&points.residuals));
    let n = used.len();
    let choice = Choice {
        points: Vec::new(), // the caller knows which of his these are
        across: both[0],
        along: both[1],
        ripple,
        scale: scales(&points, arm.as_ref(), both)?,
        flawed: arm,
    };
    let left_out = (0..n)
        .map(|i| (0..3).map(|a| points.frames[i][a] * -errors[a * n + i]).sum())
        .collect();
    let gp = Gp::bake(&points, &choice)?;
    Some(Fitted {
        choice,
        keep,
        left_out,
        gp,
    })
}

/// True error over stated sigma, across and along the ray, at points that had no say in kernels and waves.
fn scales(points: &Points, arm: Option<&Arm>, start: [Kernel; 2]) -> Option<[f64; 2]> {
    let n = points.places.len();
    let folds = if n > MANY_POINTS { 2 } else { 4 };
    let mut squares = [Vec::new(), Vec::new()];
    for fold in 0..folds {
        let (held, used): (Vec<usize>, Vec<usize>) = (0..n).partition(|i| i % folds == fold);
        let used = points.only(&used);
        let (ripple, both) = waves(&used, arm, start)?;
        let system = System::new(&used, both, columns(&used, arm, ripple.as_ref()))?;
        let weights = system.times(&stacked(&used.residuals));
        for i in held {
            let alone = points.only(&[i]);
            let own = columns(&alone, arm, ripple.as_ref());
            let [a, b, along] = system.surprise(&used, both, &weights, &alone, &own);
            squares[0].extend([a, b]);
            squares[1].push(along);
        }
    }
    Some(squares.map(|s| crate::rigid::quantile(s, 0.6827).sqrt().clamp(0.5, 3.0)))
}

/// How many sigmas an error is, of its squares in sigmas: across the ray, twice, and along it.
fn score(squares: [f64; 3]) -> f64 {
    (0.5 * (squares[0] + squares[1])).max(squares[2]).sqrt()
}

/// What flaws and waves do to points: a column for each.
fn columns(points: &Points, arm: Option<&Arm>, ripple: Option<&Ripple>) -> DMatrix<f64> {
    let flaws = points.flaws(arm).columns;
    match (ripple, &points.stances) {
        (Some(ripple), Some(stances)) => {
            let turns = Turns::new(&ripple.arm, &points.command, stances);
            beside(&flaws, &side_by_side(points, &turns, &ripple.waves))
        }
        _ => flaws,
    }
}

fn beside(left: &DMatrix<f64>, right: &DMatrix<f64>) -> DMatrix<f64> {
    let mut both = left.clone().resize_horizontally(left.ncols() + right.ncols(), 0.0);
    both.columns_mut(left.ncols(), right.ncols()).copy_from(right);
    both
}

/// Finds the waves that make the residuals likelier and left-out errors smaller, one after the other; the kernels follow what each
/// leaves.
fn waves(points: &Points, arm: Option<&Arm>, start: [Kernel; 2]) -> Option<(Option<Ripple>, [Kernel; 2])> {
    let (Some(arm), Some(stances)) = (arm, &points.stances) else {
        return Some((None, start));
    };
    let mut ripple = Ripple::of(arm.clone());
    let turns = Turns::new(arm, &points.command, stances);
    let flaws = points.flaws(Some(arm)).columns;
    let with = |waves: &[Wave]| beside(&flaws, &side_by_side(points, &turns, waves));
    let residuals = stacked(&points.residuals);
    let square = |system: &System| system.left_out(&residuals).0.norm_squared();
    let mut both = start;
    let mut system = System::new(points, both, flaws.clone())?;
    let mut least = square(&system);
    while ripple.waves.len() < ripple::MOST_WAVES {
        let weights = system.times(&residuals);
        let gains = |waves: &[Wave]| system.gains(&weights, &side_by_side(points, &turns, waves));
        let free = |wave: &Wave| {
            let near = |w: &Wave| w.joint == wave.joint && (w.cycles - wave.cycles).abs() < ripple::APART;
            !ripple.waves.iter().any(near)
        };
        let candidates: Vec<Wave> = ripple::candidates().filter(free).collect();
        // some at a time: all of them would not fit into the processor's memory
        let gained = candidates.chunks(32).flat_map(gains).zip(candidates.iter().copied());
        let (gained, wave) = ripple::refined(gained.max_by(|a, b| a.0.total_cmp(&b.0))?, &gains);
        if gained <= 0.0 {
            break;
        }
        let mut more = ripple.clone();
        more.waves.push(wave);
        let kernels = kernels(points, &with(&more.waves), both, 15)?;
        let mut now = System::new(points, kernels, with(&more.waves))?;
        // with the new one the others are clearer than they were
        for k in 0..more.waves.len() - 1 {
            let mut others = more.waves.clone();
            let own = others.remove(k);
            let without = now.with(with(&others))?;
            let weights = without.times(&residuals);
            let gains = |waves: &[Wave]| without.gains(&weights, &side_by_side(points, &turns, waves));
            more.waves[k] = ripple::refined((gains(&[own])[0], own), &gains).1;
        }
        now = now.with(with(&more.waves))?;
        let left = square(&now);
        if left > least {
            break;
        }
        (ripple, both, least, system) = (more, kernels, left, now);
    }
    both = kernels(points, &with(&ripple.waves), both, 40)?;
    Some((Some(ripple).filter(|r| !r.waves.is_empty()), both))
}

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

    fn bake(points: &Points, choice: &Choice) -> Option<Self> {
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
