//! A Gaussian process of what a rigid motion leaves, across and along the viewing ray, with the ripple of the arm's gears.
//!
//! A camera measures worse along the ray than across it, and what it measures there has other causes: the two have their own
//! kernels, chosen by likelihood. Gears add waves that are far shorter than the distance of calibrated points, but they are waves of
//! the joint angle: see [`Ripple`].

use crate::arm::Arm;
use crate::ripple::{self, Ripple, Wave};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Isometry3, Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Length in which places are measured, mm.
const UNIT_MM: f64 = 500.0;
/// Prior standard deviation of the affine part, mm over [`UNIT_MM`]: more than any camera and arm are off, little enough to compute with.
const AFFINE_MM: f64 = 10.0;
/// Points by which a kernel is chosen; more say little more and take their number to the third power of time.
const KERNEL_POINTS: usize = 180;
/// Points that the process rests on.
pub(crate) const MOST_POINTS: usize = 400;
/// Left-out errors of more sigmas than this are outliers.
const MAX_SCORE: f64 = 4.0;
/// Rounds of rejection.
const ROUNDS: usize = 6;
/// A map that is as sure as this is sure enough, however well the camera measures: a seventh of what the paper reaches, mm.
const SURE_MM: f64 = 0.05;
/// Distance of the nodes of the baked correction, mm; of its variance, twice that.
const NODE_MM: f64 = 40.0;
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

    /// Minus the log likelihood of independent components.
    fn cost(&self, places: &[Vector3<f64>], components: &[DVector<f64>]) -> f64 {
        let Some(factor) = self.factor(places) else {
            return 1e12;
        };
        let l = factor.l_dirty();
        let log_det: f64 = (0..places.len()).map(|i| l[(i, i)].ln()).sum();
        components.iter().map(|y| 0.5 * y.dot(&factor.solve(y)) + log_det).sum()
    }

    /// The likeliest kernel, searched from `start`.
    fn likeliest(start: Self, places: &[Vector3<f64>], components: &[DVector<f64>], trials: usize) -> Self {
        let kernel = |x: &Vector3<f64>| Self {
            smooth_mm: x[0].clamp(-7.0, 3.0).exp(),
            length_mm: x[1].clamp(3.5, 9.0).exp(),
            noise_mm: x[2].exp().clamp(crate::lattice::FLOOR_MM, 10.0),
        };
        let at = Vector3::new(start.smooth_mm.ln(), start.length_mm.ln(), start.noise_mm.ln());
        kernel(&simplex(|x| kernel(x).cost(places, components), at, trials))
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
    pub(crate) ripple: Option<Ripple>,
    /// True error over stated sigma, across and along: the process knows nothing of what it cannot model.
    pub(crate) scale: [f64; 2],
}

/// Trusted points, with what the rigid motion leaves of them.
pub(crate) struct Points {
    pub(crate) motion: Isometry3<f64>,
    centre: Vector3<f64>,
    /// Places in the camera's frame from the centre, in [`UNIT_MM`].
    places: Vec<Vector3<f64>>,
    command: Vec<Vector3<f64>>,
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
    fn new(motion: Isometry3<f64>, camera: &[Vector3<f64>], command: &[Vector3<f64>]) -> Self {
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
            frames,
            residuals,
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
                let along = lever.dot(&self.frames[i][a]);
                effect[(a * n + i, 0)] = along * cos;
                effect[(a * n + i, 1)] = along * sin;
            }
        }
        effect
    }
}

/// Joint angles at every point, and how each joint moves it.
struct Turns {
    joints_rad: Vec<[f64; 3]>,
    levers: Vec<[Vector3<f64>; 3]>,
}

impl Turns {
    fn new(arm: &Arm, command: &[Vector3<f64>], joints_rad: &[[f64; 3]]) -> Self {
        Self {
            joints_rad: joints_rad.to_vec(),
            levers: command.iter().map(|c| arm.pose(*c).levers).collect(),
        }
    }
}

/// The covariance of all residuals, inverted: one block across (twice), one along, and the waves as a correction of low rank.
struct System {
    blocks: [DMatrix<f64>; 2],
    /// Effects of the waves, and the blocks' inverse times them.
    waves: DMatrix<f64>,
    solved: DMatrix<f64>,
    /// Inverse of what the waves add.
    small: DMatrix<f64>,
}

impl System {
    fn new(points: &Points, kernels: [Kernel; 2], waves: DMatrix<f64>) -> Option<Self> {
        let [across, along] = kernels.map(|k| k.factor(&points.places).map(|f| f.inverse()));
        let blocks = [across?, along?];
        let mut system = Self {
            blocks,
            solved: DMatrix::zeros(waves.nrows(), 0),
            small: DMatrix::zeros(0, 0),
            waves,
        };
        system.solved = system.block_times(&system.waves);
        let m = system.waves.ncols();
        let inner = system.waves.transpose() * &system.solved + DMatrix::identity(m, m) / ripple::PRIOR_RAD.powi(2);
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

    /// Twice the log of how much likelier the residuals are with one more wave.
    fn gain(&self, weights: &DVector<f64>, wave: &DMatrix<f64>) -> f64 {
        let crossed = self.solved.transpose() * wave;
        let inner = wave.transpose() * self.block_times(wave) - crossed.transpose() * &self.small * &crossed;
        let seen = wave.transpose() * weights;
        let prior = 1.0 / ripple::PRIOR_RAD.powi(2);
        let with = &inner + DMatrix::identity(2, 2) * prior;
        let Some(factor) = with.clone().cholesky() else {
            return 0.0;
        };
        seen.dot(&factor.solve(&seen)) - (with.determinant() / (prior * prior)).ln()
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

/// Kernels that fit best to what waves leave of the residuals.
fn kernels(points: &Points, residuals: &[DVector<f64>; 3], start: [Kernel; 2], trials: usize) -> [Kernel; 2] {
    let picks = picks(points.places.len(), KERNEL_POINTS);
    let places: Vec<_> = picks.iter().map(|&i| points.places[i]).collect();
    let part = |a: usize| DVector::from_fn(picks.len(), |k, _| residuals[a][picks[k]]);
    [
        Kernel::likeliest(start[0], &places, &[part(0), part(1)], trials),
        Kernel::likeliest(start[1], &places, &[part(2)], trials),
    ]
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

/// Fits to points; `joints` are J1 to J3 of every point, where the pairs have them. `None` if there is nothing smooth about them.
pub(crate) fn fit(camera: &[Vector3<f64>], command: &[Vector3<f64>], joints: Option<&[[f64; 3]]>) -> Option<Fitted> {
    let mut keep = vec![true; camera.len()];
    let start = [
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
    let chosen = |keep: &[bool]| -> Vec<usize> { (0..keep.len()).filter(|&i| keep[i]).collect() };
    let points_of = |used: &[usize]| {
        let of = |all: &[Vector3<f64>]| -> Vec<Vector3<f64>> { used.iter().map(|&i| all[i]).collect() };
        let (camera, command) = (of(camera), of(command));
        let motion = crate::rigid::kabsch(&camera, &command, &vec![1.0; used.len()]);
        Points::new(motion, &camera, &command)
    };
    let mut both = start;
    for _ in 0..ROUNDS {
        let used = chosen(&keep);
        let points = points_of(&used);
        both = kernels(&points, &points.residuals, both, 60);
        let system = System::new(&points, both, DMatrix::zeros(3 * used.len(), 0))?;
        let (errors, variances) = system.left_out(&stacked(&points.residuals));
        let n = used.len();
        let mut scores: Vec<(f64, usize)> = (0..n)
            .map(|i| {
                let square = |a: usize| errors[a * n + i].powi(2) / variances[a * n + i];
                ((0.5 * (square(0) + square(1))).max(square(2)).sqrt(), i)
            })
            .filter(|(score, _)| *score > MAX_SCORE)
            .collect();
        if scores.is_empty() || n < 12 {
            break;
        }
        // an outlier makes its neighbours look bad: the worse half first
        scores.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (_, i) in &scores[..scores.len().div_ceil(2)] {
            keep[used[*i]] = false;
        }
    }
    let used = chosen(&keep);
    let points = points_of(&used);
    let of_used: Option<Vec<[f64; 3]>> = joints.map(|q| used.iter().map(|&i| q[i]).collect());
    let mut ripple = of_used
        .as_ref()
        .and_then(|q| Arm::of(&points.command, q).map(Ripple::of));
    let mut all = DMatrix::zeros(3 * used.len(), 0);
    if let (Some(ripple), Some(joints)) = (&mut ripple, &of_used) {
        let turns = Turns::new(&ripple.arm, &points.command, joints);
        both = waves(&points, &turns, ripple, both)?;
        all = side_by_side(&points, &turns, &ripple.waves);
    }
    let system = System::new(&points, both, all)?;
    let (errors, variances) = system.left_out(&stacked(&points.residuals));
    let n = used.len();
    let relative = |a: usize| (0..n).map(move |i| (a, i));
    let quantile = |parts: &[usize]| {
        let z = parts.iter().flat_map(|&a| relative(a));
        let z: Vec<f64> = z
            .map(|(a, i)| (errors[a * n + i].powi(2) / variances[a * n + i]).sqrt())
            .collect();
        crate::rigid::quantile(z, 0.6827).clamp(0.5, 3.0)
    };
    let choice = Choice {
        points: Vec::new(), // the caller knows which of his these are
        across: both[0],
        along: both[1],
        ripple: ripple.filter(|r| !r.waves.is_empty()),
        scale: [quantile(&[0, 1]), quantile(&[2])],
    };
    let left_out = (0..n)
        .map(|i| (0..3).map(|a| points.frames[i][a] * -errors[a * n + i]).sum())
        .collect();
    let gp = Gp::bake(&points, of_used.as_deref(), &choice)?;
    Some(Fitted {
        choice,
        keep,
        left_out,
        gp,
    })
}

/// Finds the waves that make left-out errors smaller, one after the other; the kernels follow what each leaves.
fn waves(points: &Points, turns: &Turns, ripple: &mut Ripple, start: [Kernel; 2]) -> Option<[Kernel; 2]> {
    let residuals = stacked(&points.residuals);
    let n = points.places.len();
    let square = |system: &System| system.left_out(&residuals).0.norm_squared();
    let mut both = start;
    let mut system = System::new(points, both, DMatrix::zeros(3 * n, 0))?;
    let mut least = square(&system);
    while ripple.waves.len() < ripple::MOST_WAVES {
        let weights = system.times(&residuals);
        let gain = |wave: Wave| system.gain(&weights, &points.wave(turns, wave));
        let free = |wave: &Wave| {
            let near = |w: &Wave| w.joint == wave.joint && (w.cycles - wave.cycles).abs() < ripple::APART;
            !ripple.waves.iter().any(near)
        };
        let found = ripple::candidates().filter(free).map(|w| (gain(w), w));
        let (gained, wave) = ripple::refined(found.max_by(|a, b| a.0.total_cmp(&b.0))?, &gain);
        let mut more = ripple.clone();
        more.waves.push(wave);
        let columns = side_by_side(points, turns, &more.waves);
        let with = System::new(points, both, columns.clone())?;
        let swing = &columns * (columns.transpose() * with.times(&residuals)) * ripple::PRIOR_RAD.powi(2);
        let rest = [0, 1, 2].map(|a| DVector::from_fn(n, |i, _| points.residuals[a][i] - swing[a * n + i]));
        let kernels = kernels(points, &rest, both, 40);
        let with = System::new(points, kernels, columns)?;
        let left = square(&with);
        if gained < ripple::LEAST_GAIN || left > ripple::LESS * least {
            break;
        }
        (*ripple, both, least, system) = (more, kernels, left, with);
    }
    Some(both)
}

/// A fitted process, ready for queries.
#[derive(Clone, Debug)]
pub(crate) struct Gp {
    motion: Isometry3<f64>,
    low: Vector3<f64>,
    counts: [usize; 3],
    /// Correction along the directions of the ray at each node, mm.
    correction: Vec<Vector3<f64>>,
    /// Variance of the map across and along at every second node, mm².
    variance: Vec<[f64; 2]>,
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
        joints: Option<&[[f64; 3]]>,
        choice: &Choice,
    ) -> Option<Self> {
        let motion = crate::rigid::kabsch(camera, command, &vec![1.0; camera.len()]);
        Self::bake(&Points::new(motion, camera, command), joints, choice)
    }

    fn bake(points: &Points, joints: Option<&[[f64; 3]]>, choice: &Choice) -> Option<Self> {
        let n = points.places.len();
        let columns = match (&choice.ripple, joints) {
            (Some(ripple), Some(joints)) => {
                let turns = Turns::new(&ripple.arm, &points.command, joints);
                side_by_side(points, &turns, &ripple.waves)
            }
            _ => DMatrix::zeros(3 * n, 0),
        };
        let system = System::new(points, [choice.across, choice.along], columns)?;
        let weights = system.times(&stacked(&points.residuals));
        let swings = system.waves.transpose() * &weights * ripple::PRIOR_RAD.powi(2);
        let margin = Vector3::repeat(MARGIN_MM / UNIT_MM);
        let (first, node) = (points.places[0], NODE_MM / UNIT_MM);
        let (low, high) = points
            .places
            .iter()
            .fold((first, first), |(l, h), p| (l.inf(p), h.sup(p)));
        let (low, high) = (low - margin, high + margin);
        // an even number of steps: the variance has every second node
        let counts: [usize; 3] = ((high - low) / (2.0 * node)).map(|e| 2 * e.ceil() as usize + 1).into();
        let place = |x: usize, y: usize, z: usize| low + Vector3::new(x as f64, y as f64, z as f64) * node;
        let kernel = [choice.across, choice.along];
        let mut correction = Vec::with_capacity(counts.iter().product());
        let mut variance = Vec::new();
        for z in 0..counts[2] {
            for y in 0..counts[1] {
                for x in 0..counts[0] {
                    let at = place(x, y, z);
                    let k = kernel.map(|k| DVector::from_fn(n, |i, _| k.of(&at, &points.places[i])));
                    let part = |a: usize, k: &DVector<f64>| k.dot(&weights.rows(a * n, n));
                    correction.push(Vector3::new(part(0, &k[0]), part(1, &k[0]), part(2, &k[1])));
                    if x % 2 + y % 2 + z % 2 == 0 {
                        let of = |c: usize| (kernel[c].of(&at, &at) - k[c].dot(&(&system.blocks[c] * &k[c]))).max(0.0);
                        variance.push([of(0), of(1)]);
                    }
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
            swings: (0..swings.len() / 2)
                .map(|k| [swings[2 * k], swings[2 * k + 1]])
                .collect(),
            noise_mm: kernel.map(|k| k.noise_mm),
            scale: choice.scale,
        })
    }

    /// Where a camera point is in the base frame; outside the baked box, as at its border.
    pub(crate) fn at(&self, camera: Vector3<f64>) -> Answer {
        let place: [f64; 3] = std::array::from_fn(|a| {
            ((camera[a] - self.low[a]) / NODE_MM).clamp(0.0, self.counts[a] as f64 - 1.000_001)
        });
        let local = self.cubic(place);
        let frame = ray_frame(&self.motion, &camera);
        let mut base = (self.motion * Point3::from(camera)).coords;
        base += frame[0] * local.x + frame[1] * local.y + frame[2] * local.z;
        if let Some(ripple) = &self.ripple {
            base += ripple.shift(base, &self.swings);
        }
        let variance = self.linear(place);
        Answer {
            base,
            leverage: [0, 1]
                .map(|c| variance[c] / self.noise_mm[c].max(SURE_MM).powi(2))
                .into_iter()
                .fold(0.0, f64::max),
            sigma_mm: [0, 1].map(|c| self.scale[c] * (variance[c] + self.noise_mm[c].powi(2)).sqrt()),
        }
    }

    /// Catmull-Rom between the nodes: its first derivative has no steps.
    fn cubic(&self, place: [f64; 3]) -> Vector3<f64> {
        let taps = place.map(|p| {
            let (i, t) = (p as usize, p.fract());
            let (t2, t3) = (t * t, t * t * t);
            let weights = [
                0.5 * (-t3 + 2.0 * t2 - t),
                0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
                0.5 * (-3.0 * t3 + 4.0 * t2 + t),
                0.5 * (t3 - t2),
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

    fn linear(&self, place: [f64; 3]) -> [f64; 2] {
        let counts = self.counts.map(|n| n.div_ceil(2));
        let at = place.map(|p| p / 2.0);
        let mut sum = [0.0; 2];
        for corner in 0..8 {
            let (mut index, mut weight) = (0, 1.0);
            for a in (0..3).rev() {
                let step = corner >> a & 1;
                let (i, t) = (at[a] as usize, at[a].fract());
                index = index * counts[a] + (i + step).min(counts[a] - 1);
                weight *= if step == 1 { t } else { 1.0 - t };
            }
            let value = self.variance[index];
            sum = [0, 1].map(|c| sum[c] + weight * value[c]);
        }
        sum
    }
}
