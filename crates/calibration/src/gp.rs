//! A Gaussian process of what a rigid motion leaves, across and along the viewing ray, with the ripple of the arm's gears.
//!
//! A camera measures worse along the ray than across it, and what it measures there has other causes: the two have their own
//! kernels, chosen by likelihood. Gears add waves that are far shorter than the distance of calibrated points, but they are waves of
//! the joint angle: see [`Ripple`].

mod baked;
mod points;

use crate::arm::Arm;
use crate::ripple::{self, Ripple, Wave};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Vector3};
use serde::{Deserialize, Serialize};
use std::rc::Rc;

pub(crate) use baked::Gp;
pub(crate) use points::Stance;
use points::{Points, Turns, UNIT_MM};

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
