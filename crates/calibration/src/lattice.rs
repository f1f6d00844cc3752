//! The paper's Algorithm 2: a global map, then second-order interpolation among the 27 lattice points around its estimate;
//! and what keeps it true on real data: rejection of outliers and a fallback where the neighbourhood is thin.
//!
//! Away from a lattice the nearest points take the place of the 27 (the same code on a grid laid over the points).

use crate::rigid::{Points, kabsch, median};
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Terms of a polynomial in three variables up to degree 1, 2 and 3.
pub(crate) const LINEAR: usize = 4;
pub(crate) const QUADRATIC: usize = 10;
pub(crate) const CUBIC: usize = 20;

/// Largest leverage that still counts as interpolation: beyond it the fit is less certain than a single measurement.
pub(crate) const MAX_LEVERAGE: f64 = 1.2;

type Basis = [f64; CUBIC];

fn basis(u: Vector3<f64>) -> Basis {
    let [x, y, z] = [u.x, u.y, u.z];
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let quadratic = [1.0, x, y, z, xx, yy, zz, x * y, x * z, y * z];
    let cubic = [
        xx * x,
        yy * y,
        zz * z,
        xx * y,
        xx * z,
        yy * x,
        yy * z,
        zz * x,
        zz * y,
        x * y * z,
    ];
    std::array::from_fn(|t| {
        if t < QUADRATIC {
            quadratic[t]
        } else {
            cubic[t - QUADRATIC]
        }
    })
}

/// A polynomial R³ → R³ fitted by least squares, with what is needed to say how certain it is.
#[derive(Clone, Debug, Default)]
pub(crate) struct Surface {
    coefficients: Vec<Vector3<f64>>,
    /// Inverse of the Cholesky factor of the normal matrix, lower triangle row by row.
    root: Vec<f64>,
}

impl Surface {
    /// Fits `terms` coefficients to rows of (position, value, weight). `None` if the rows do not determine them; with
    /// `forced`, the smallest coefficients that fit, as a pseudo-inverse gives them.
    fn fit(rows: impl Iterator<Item = (Vector3<f64>, Vector3<f64>, f64)>, terms: usize, forced: bool) -> Option<Self> {
        let mut normal = [[0.0; CUBIC]; CUBIC];
        let mut right = [Vector3::zeros(); CUBIC];
        for (at, value, weight) in rows {
            let b = basis(at);
            for r in 0..terms {
                let wb = weight * b[r];
                for c in 0..=r {
                    normal[r][c] += wb * b[c];
                }
                right[r] += value * wb;
            }
        }
        if forced {
            let trace: f64 = (0..terms).map(|t| normal[t][t]).sum();
            (0..terms).for_each(|t| normal[t][t] += 1e-9 * trace.max(1e-9));
        }
        // Cholesky in place, then forward substitution of the right side and of the identity
        for c in 0..terms {
            let diagonal = normal[c][c];
            let pivot = diagonal - (0..c).map(|k| normal[c][k].powi(2)).sum::<f64>();
            if pivot.is_nan() || pivot <= 1e-10 * diagonal.max(1e-30) {
                return None;
            }
            normal[c][c] = pivot.sqrt();
            for r in c + 1..terms {
                let dot: f64 = (0..c).map(|k| normal[r][k] * normal[c][k]).sum();
                normal[r][c] = (normal[r][c] - dot) / normal[c][c];
            }
        }
        let mut inverse = [[0.0; CUBIC]; CUBIC];
        for c in 0..terms {
            inverse[c][c] = 1.0 / normal[c][c];
            for r in c + 1..terms {
                let dot: f64 = (c..r).map(|k| normal[r][k] * inverse[k][c]).sum();
                inverse[r][c] = -dot / normal[r][r];
            }
        }
        let forward: Vec<Vector3<f64>> = (0..terms)
            .map(|r| (0..=r).map(|c| right[c] * inverse[r][c]).sum())
            .collect();
        Some(Self {
            coefficients: (0..terms)
                .map(|c| (c..terms).map(|r| forward[r] * inverse[r][c]).sum())
                .collect(),
            root: (0..terms).flat_map(|r| inverse[r][..=r].to_vec()).collect(),
        })
    }

    fn at(&self, b: &Basis) -> Vector3<f64> {
        self.coefficients.iter().zip(b).map(|(c, b)| c * *b).sum()
    }

    /// Variance of the fit at a position in units of the variance of one measurement; 0 for no fit.
    fn leverage(&self, b: &Basis) -> f64 {
        let mut row = 0;
        (1..=self.coefficients.len())
            .map(|n| {
                let dot: f64 = self.root[row..row + n].iter().zip(b).map(|(r, b)| r * b).sum();
                row += n;
                dot * dot
            })
            .sum()
    }
}

/// Coordinates in which neighbours are one apart: nodes of the lattice, or a mesh over scattered points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Grid {
    origin_mm: Vector3<f64>,
    nodes_per_mm: Matrix3<f64>,
    pub(crate) lattice: bool,
}

impl Grid {
    /// From the lattice nodes of the pairs if they have them, otherwise from the density of the points.
    pub(crate) fn over(nodes: &[Option<[i32; 3]>], command: &[Vector3<f64>]) -> Self {
        Self::from_nodes(nodes, command).unwrap_or_else(|| Self::scattered(command))
    }

    fn from_nodes(nodes: &[Option<[i32; 3]>], command: &[Vector3<f64>]) -> Option<Self> {
        let rows: Vec<_> = nodes
            .iter()
            .zip(command)
            .filter_map(|(n, c)| Some((n.map(|n| Vector3::from(n).map(f64::from))?, *c)))
            .collect();
        let complete = rows.len() * 10 >= nodes.len() * 9 && (0..3).all(|a| span(rows.iter().map(|r| r.0[a])) >= 2.0);
        if !complete {
            return None;
        }
        let fit = Surface::fit(rows.iter().map(|(n, c)| (*n, *c, 1.0)), LINEAR, false)?;
        let c = &fit.coefficients;
        let mm_per_node = Matrix3::from_columns(&[c[1], c[2], c[3]]);
        let grid = Self {
            origin_mm: c[0],
            nodes_per_mm: mm_per_node.try_inverse()?,
            lattice: true,
        };
        let off = median(rows.iter().map(|(n, c)| (grid.at(*c) - n).norm()).collect());
        (off < 0.1).then_some(grid)
    }

    fn scattered(command: &[Vector3<f64>]) -> Self {
        let (low, high) = bounds(command);
        let extent = (high - low).map(|e| e.max(1e-6));
        let spacing = (extent.product() / command.len().max(1) as f64).cbrt();
        let nodes = extent.map(|e| (e / spacing).round().max(2.0));
        Self {
            origin_mm: low,
            nodes_per_mm: Matrix3::from_diagonal(&nodes.component_div(&extent)),
            lattice: false,
        }
    }

    pub(crate) fn at(&self, base: Vector3<f64>) -> Vector3<f64> {
        self.nodes_per_mm * (base - self.origin_mm)
    }

    /// Mean distance of neighbours, mm.
    pub(crate) fn spacing_mm(&self) -> f64 {
        1.0 / self.nodes_per_mm.determinant().abs().cbrt().max(1e-12)
    }
}

/// How much support a local fit has, from the published case down.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// Second order among the 27 points around (the nearest points where there is no lattice).
    Local,
    /// Second order among more and farther points, because the 27 are incomplete.
    Wide,
    /// First order among the nearest points.
    Linear,
    /// The global map alone.
    Global,
}

/// All levels, the published one first.
pub(crate) const LEVELS: [Level; 4] = [Level::Local, Level::Wide, Level::Linear, Level::Global];

/// Points of the published neighbourhood.
const NEIGHBOURS: usize = 27;
/// Fewest of the 27 for ten coefficients with enough left over to notice anything.
const MIN_LOCAL: usize = 18;
/// Points of the wide neighbourhood.
const WIDE: usize = 60;
/// Points by which an outlier is judged.
const JURY: usize = 40;

#[derive(Clone, Debug)]
struct Cell {
    level: Level,
    surface: Surface,
    members: Vec<u32>,
}

/// Which shape the map may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    /// Scale and shear beside the motion.
    pub(crate) affine: bool,
    /// Local interpolation over it.
    pub(crate) local: bool,
    /// Exactly as published: no checks of support, no blending between neighbourhoods.
    pub(crate) published: bool,
}

/// What the model says at one point, before it is scaled to mm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimate {
    pub(crate) base: Vector3<f64>,
    /// Share and leverage of each level in [`LEVELS`].
    pub(crate) share: [f64; 4],
    pub(crate) variance: [f64; 4],
    /// Distance outside the box of the accepted points, in nodes (0 inside).
    pub(crate) outside: f64,
    /// Distance to the nearest accepted point, in nodes; infinite beyond 2.
    pub(crate) nearest: f64,
}

/// A fitted map from camera to base, ready for queries.
#[derive(Clone, Debug)]
pub(crate) struct Model {
    pub(crate) shape: Shape,
    pub(crate) grid: Grid,
    /// The rigid motion: the direction of rays in the base frame.
    pub(crate) motion: Isometry3<f64>,
    linear: Matrix3<f64>,
    offset: Vector3<f64>,
    smooth: Surface,
    low: Vector3<f64>,
    high: Vector3<f64>,
    counts: [usize; 3],
    cells: Vec<Cell>,
    support: Support,
}

impl Model {
    /// Fits to points that are all trusted.
    pub(crate) fn bake(shape: Shape, grid: Grid, camera: &[Vector3<f64>], command: &[Vector3<f64>]) -> Self {
        let n = command.len();
        let motion = kabsch(camera, command, &vec![1.0; n]);
        let (low, high) = bounds(&command.iter().map(|c| grid.at(*c)).collect::<Vec<_>>());
        let mut model = Self {
            shape,
            motion,
            linear: motion.rotation.to_rotation_matrix().into_inner(),
            offset: motion.translation.vector,
            smooth: Surface::default(),
            // commands are exact: a lattice's bounds are whole numbers but for rounding
            counts: (high - low).map(|e| (e.round() as usize + 1).max(3)).into(),
            low,
            high,
            cells: Vec::new(),
            support: Support::default(),
            grid,
        };
        if shape.affine {
            let centre = camera.iter().sum::<Vector3<f64>>() / n.max(1) as f64;
            let scaled = |c: &Vector3<f64>| (c - centre) / 500.0;
            let rows = camera.iter().zip(command).map(|(c, t)| (scaled(c), *t, 1.0));
            if let Some(fit) = Surface::fit(rows, LINEAR, false) {
                let c = &fit.coefficients;
                model.linear = Matrix3::from_columns(&[c[1], c[2], c[3]]) / 500.0;
                model.offset = c[0] - model.linear * centre;
            }
        }
        let terms = match n {
            _ if shape.published || !shape.local => LINEAR,
            80.. => CUBIC,
            30.. => QUADRATIC,
            _ => LINEAR,
        };
        let rough: Vec<_> = camera.iter().map(|c| model.linear * c + model.offset).collect();
        let keep = shape.affine && terms > LINEAR;
        let rows = rough.iter().zip(command).map(|(r, t)| {
            let value = if keep { t - r } else { Vector3::zeros() };
            (model.unit(model.clamped(model.grid.at(*r))), value, 1.0)
        });
        // below second order the coefficients stay zero and only the certainty is of use
        model.smooth = Surface::fit(rows, terms, false).unwrap_or_default();
        let nodes: Vec<_> = command.iter().map(|c| model.grid.at(*c)).collect();
        model.support = Support::over(&nodes, model.low, model.counts);
        if shape.local {
            let features = model.features(camera, command);
            model.cells = model.centres().map(|c| model.cell(c, &nodes, &features)).collect();
        }
        model
    }

    /// Where each point lies in the grid by the rough map, and what the global map leaves of it, mm.
    fn features(&self, camera: &[Vector3<f64>], command: &[Vector3<f64>]) -> Vec<(Vector3<f64>, Vector3<f64>)> {
        camera
            .iter()
            .zip(command)
            .map(|(c, t)| {
                let rough = self.linear * c + self.offset;
                let at = self.clamped(self.grid.at(rough));
                (at, t - rough - self.smooth.at(&basis(self.unit(at))))
            })
            .collect()
    }

    /// A polynomial runs away outside its data: positions stop one node beyond the box.
    fn clamped(&self, at: Vector3<f64>) -> Vector3<f64> {
        at.zip_zip_map(&self.low, &self.high, |v, low, high| v.clamp(low - 1.0, high + 1.0))
    }

    /// The box of the points as -1..1.
    fn unit(&self, at: Vector3<f64>) -> Vector3<f64> {
        (at - (self.low + self.high) / 2.0).component_div(&((self.high - self.low) / 2.0).map(|h| h.max(1e-9)))
    }

    /// Centres of the neighbourhoods: every node that has neighbours on both sides.
    fn centres(&self) -> impl Iterator<Item = Vector3<f64>> + use<> {
        let ([nx, ny, nz], low) = (self.counts.map(|n| n - 2), self.low);
        (0..nx * ny * nz).map(move |c| {
            let index = Vector3::new(c / (ny * nz), c / nz % ny, c % nz);
            low + index.map(|i| i as f64 + 1.0)
        })
    }

    fn cell(&self, centre: Vector3<f64>, nodes: &[Vector3<f64>], features: &[(Vector3<f64>, Vector3<f64>)]) -> Cell {
        let fit = |members: &[u32], terms: usize, forced: bool| {
            let rows = members.iter().map(|&m| {
                let (at, value) = features[m as usize];
                (at - centre, value, 1.0)
            });
            Surface::fit(rows, terms, forced)
        };
        let block = || -> Vec<u32> {
            let within = |p: &Vector3<f64>| (p - centre).amax() < 1.01;
            (0..nodes.len() as u32)
                .filter(|&i| within(&nodes[i as usize]))
                .collect()
        };
        if self.shape.published {
            let members = if self.grid.lattice {
                block()
            } else {
                nearest(nodes, centre, NEIGHBOURS, None)
            };
            let surface = fit(&members, QUADRATIC, true)
                .filter(|_| !members.is_empty())
                .unwrap_or_default();
            return Cell {
                level: Level::Local,
                surface,
                members,
            };
        }
        // corners of the region that this neighbourhood answers for: half way to the next, or to the border
        let reach = |axis: usize, side: f64| {
            let border = if side < 0.0 { self.low[axis] } else { self.high[axis] };
            if (centre[axis] - border).abs() < 1.5 {
                side
            } else {
                0.5 * side
            }
        };
        let supported = |surface: &Surface| {
            (0..8).all(|corner| {
                let side = |a: usize| if corner >> a & 1 == 0 { -1.0 } else { 1.0 };
                let at = Vector3::from_fn(|a, _| reach(a, side(a)));
                surface.leverage(&basis(at)) <= MAX_LEVERAGE
            })
        };
        for level in LEVELS {
            let (members, terms, fewest) = match level {
                Level::Local if self.grid.lattice => (block(), QUADRATIC, MIN_LOCAL),
                Level::Local => (nearest(nodes, centre, NEIGHBOURS, None), QUADRATIC, MIN_LOCAL),
                Level::Wide => (nearest(nodes, centre, WIDE, None), QUADRATIC, MIN_LOCAL),
                Level::Linear => (nearest(nodes, centre, NEIGHBOURS, None), LINEAR, 8),
                Level::Global => break,
            };
            if members.len() < fewest {
                continue;
            }
            if let Some(surface) = fit(&members, terms, false).filter(|s| supported(s)) {
                return Cell {
                    level,
                    surface,
                    members,
                };
            }
        }
        Cell {
            level: Level::Global,
            surface: Surface::default(),
            members: Vec::new(),
        }
    }

    /// The neighbourhoods that answer for a position, with their weights: the nearest one as published, otherwise the eight
    /// around, so that the map has no steps.
    fn around(&self, at: Vector3<f64>) -> impl Iterator<Item = (&Cell, Vector3<f64>, f64)> {
        let mut first = [0usize; 3];
        let mut toward = [0.0; 3];
        for a in 0..3 {
            let last = self.counts[a] - 3;
            let g = at[a] - self.low[a] - 1.0;
            let whole = if self.shape.published { g.round() } else { g.floor() };
            first[a] = (whole.max(0.0) as usize).min(last);
            let t = (g - first[a] as f64).clamp(0.0, 1.0);
            toward[a] = if self.shape.published || first[a] == last {
                0.0
            } else {
                t
            };
        }
        let [_, ny, nz] = self.counts.map(|n| n - 2);
        let corners = if self.cells.is_empty() { 0 } else { 8 };
        (0..corners).filter_map(move |corner| {
            let step = [corner >> 2 & 1, corner >> 1 & 1, corner & 1];
            let weight: f64 = (0..3)
                .map(|a| if step[a] == 1 { toward[a] } else { 1.0 - toward[a] })
                .product();
            if weight <= 0.0 {
                return None;
            }
            let index: [usize; 3] = std::array::from_fn(|a| first[a] + step[a]);
            let centre = self.low + Vector3::from(index.map(|i| i as f64 + 1.0));
            let cell = self.cells.get((index[0] * ny + index[1]) * nz + index[2])?;
            Some((cell, at - centre, weight))
        })
    }

    pub(crate) fn estimate(&self, camera: Vector3<f64>) -> Estimate {
        self.estimate_without(camera, None)
    }

    /// The estimate as if point `left_out` (its index and what the global map leaves of it) had not been fitted.
    fn estimate_without(&self, camera: Vector3<f64>, left_out: Option<(u32, Vector3<f64>)>) -> Estimate {
        let rough = self.linear * camera + self.offset;
        let at = self.clamped(self.grid.at(rough));
        let b = basis(self.unit(at));
        let global = rough + self.smooth.at(&b);
        let global_leverage = self.smooth.leverage(&b);
        let (mut local, mut share, mut variance) = (Vector3::zeros(), [0.0; 4], [0.0; 4]);
        let mut weights = 0.0;
        for (cell, d, weight) in self.around(at) {
            let b = basis(d);
            let mut value = cell.surface.at(&b);
            let mut h = cell.surface.leverage(&b);
            if let Some((i, target)) = left_out
                && cell.members.contains(&i)
            {
                let rest = (1.0 - h).max(1e-3);
                value = target - (target - value) / rest;
                h /= rest;
            }
            if cell.level == Level::Global {
                h = global_leverage;
            }
            local += value * weight;
            share[cell.level as usize] += weight;
            variance[cell.level as usize] += weight * h;
            weights += weight;
        }
        if weights == 0.0 {
            let mut h = global_leverage;
            if let Some((_, target)) = left_out {
                let rest = (1.0 - h).max(1e-3);
                local = target - target / rest;
                h /= rest;
            }
            share[Level::Global as usize] = 1.0;
            variance[Level::Global as usize] = h;
        }
        let base = global + local;
        let node = self.grid.at(base);
        let outside = (0..3)
            .map(|a| (self.low[a] - node[a]).max(node[a] - self.high[a]))
            .fold(0.0, f64::max);
        Estimate {
            base,
            share,
            variance,
            outside,
            nearest: self.support.nearest(node),
        }
    }

    /// The estimate for every point as if it had not been fitted (exact for the local fits).
    pub(crate) fn leave_one_out(&self, camera: &[Vector3<f64>], command: &[Vector3<f64>]) -> Vec<Estimate> {
        let features = self.features(camera, command);
        (0u32..)
            .zip(camera.iter().zip(features))
            .map(|(i, (c, (_, y)))| self.estimate_without(*c, Some((i, y))))
            .collect()
    }

    /// For a level of the fallback: the error at points left out, each with the leverage of its fit. At most about 400 points.
    pub(crate) fn leave_one_out_at(
        &self,
        level: Level,
        camera: &[Vector3<f64>],
        command: &[Vector3<f64>],
    ) -> Vec<(usize, Vector3<f64>, f64)> {
        let features = self.features(camera, command);
        let nodes: Vec<_> = command.iter().map(|c| self.grid.at(*c)).collect();
        let (count, terms) = match level {
            Level::Local => (NEIGHBOURS, QUADRATIC),
            Level::Wide => (WIDE, QUADRATIC),
            Level::Linear => (NEIGHBOURS, LINEAR),
            Level::Global => (0, 0),
        };
        let mut errors = Vec::new();
        for i in (0..nodes.len()).step_by(nodes.len().div_ceil(400).max(1)) {
            let (at, value) = features[i];
            if terms == 0 {
                let h = self.smooth.leverage(&basis(self.unit(at))).min(0.999);
                errors.push((i, value / (1.0 - h), h / (1.0 - h)));
                continue;
            }
            let members = nearest(&nodes, nodes[i], count, Some(i as u32));
            let rows = members
                .iter()
                .map(|&m| (features[m as usize].0 - at, features[m as usize].1, 1.0));
            if let Some(fit) = Surface::fit(rows, terms, false) {
                let b = basis(Vector3::zeros());
                errors.push((i, value - fit.at(&b), fit.leverage(&b)));
            }
        }
        errors
    }

    pub(crate) fn levels(&self) -> [usize; 4] {
        LEVELS.map(|level| self.cells.iter().filter(|c| c.level == level).count())
    }

    /// Direction of the viewing ray of a camera point, in the base frame.
    pub(crate) fn ray(&self, camera: Vector3<f64>) -> Vector3<f64> {
        self.motion.rotation * camera.try_normalize(1e-9).unwrap_or(Vector3::z())
    }
}

/// Splits an error into across (length) and along the ray.
pub(crate) fn split(error: Vector3<f64>, ray: Vector3<f64>) -> (f64, f64) {
    let depth = error.dot(&ray);
    ((error - ray * depth).norm(), depth)
}

/// Scores below which a pair is believed; a Gaussian error exceeds either in one of 100,000.
const MAX_SCORE: f64 = 4.5;
/// No camera measures better than this, mm: keeps perfect data from being judged by its rounding.
pub(crate) const FLOOR_MM: f64 = 2e-3;

/// Decides which points to believe: each is predicted from its neighbours by a robust local fit, and rejected if it lies too
/// far off, across or along the viewing ray. Returns a flag for each.
pub(crate) fn believable(points: &Points, motion: &Isometry3<f64>, grid: &Grid) -> Vec<bool> {
    let Points { camera, command, .. } = points;
    let off: Vec<f64> = camera
        .iter()
        .zip(command)
        .map(|(c, t)| (motion * Point3::from(*c) - Point3::from(*t)).norm())
        .collect();
    let gross_mm = (8.0 * median(off.clone())).max(3.0);
    let mut keep: Vec<bool> = off.iter().map(|o| *o <= gross_mm).collect();
    let nodes: Vec<_> = command.iter().map(|c| grid.at(*c)).collect();
    let rays: Vec<_> = camera.iter().map(|c| (motion.rotation * c).normalize()).collect();
    for _ in 0..5 {
        let chosen: Vec<usize> = (0..keep.len()).filter(|&i| keep[i]).collect();
        let pick = |all: &[Vector3<f64>]| -> Vec<Vector3<f64>> { chosen.iter().map(|&i| all[i]).collect() };
        let shape = Shape {
            affine: true,
            local: false,
            published: false,
        };
        let model = Model::bake(shape, grid.clone(), &pick(camera), &pick(command));
        let features = model.features(camera, command);
        let jury_nodes = pick(&nodes);
        let predictions: Vec<(f64, f64)> = (0..keep.len())
            .map(|i| {
                let own = chosen.binary_search(&i).ok().map(|at| at as u32);
                let jury: Vec<usize> = nearest(&jury_nodes, nodes[i], JURY, own)
                    .into_iter()
                    .map(|m| chosen[m as usize])
                    .collect();
                let (predicted, leverage) = robust_prediction(i, &jury, &nodes, &features, &rays);
                let (lateral, depth) = split(features[i].1 - predicted, rays[i]);
                let s = (1.0 + leverage).sqrt();
                (lateral / s, depth / s)
            })
            .collect();
        let of = |get: fn(&(f64, f64)) -> f64| -> Vec<f64> { chosen.iter().map(|&i| get(&predictions[i])).collect() };
        // medians of |N(0,1)| and of a Rayleigh length
        let depth_mm = (median(of(|p| p.1.abs())) / 0.6745).max(FLOOR_MM);
        let lateral_mm = (median(of(|p| p.0)) / 1.1774).max(FLOOR_MM);
        let verdict: Vec<bool> = predictions
            .iter()
            .map(|(lateral, depth)| *lateral <= (MAX_SCORE + 0.4) * lateral_mm && depth.abs() <= MAX_SCORE * depth_mm)
            .collect();
        let settled = verdict == keep;
        keep = verdict;
        if settled {
            break;
        }
    }
    keep
}

/// The value at point `i` by its jury, by reweighted least squares that outliers among them do not move, and its leverage.
fn robust_prediction(
    i: usize,
    jury: &[usize],
    nodes: &[Vector3<f64>],
    features: &[(Vector3<f64>, Vector3<f64>)],
    rays: &[Vector3<f64>],
) -> (Vector3<f64>, f64) {
    let middle = Vector3::from_fn(|a, _| median(jury.iter().map(|&j| features[j].1[a]).collect()));
    let radius = jury.iter().map(|&j| (nodes[j] - nodes[i]).norm()).fold(1e-9, f64::max);
    let place = |j: usize| (nodes[j] - nodes[i]) / radius;
    let most = match jury.len() {
        25.. => QUADRATIC,
        8.. => LINEAR,
        _ => 1,
    };
    let origin = basis(Vector3::zeros());
    let mut best = (middle, 1.0);
    let mut current: Option<Surface> = None;
    for round in 0..6 {
        let errors: Vec<(f64, f64)> = jury
            .iter()
            .map(|&j| {
                let value = current.as_ref().map_or(middle, |s| s.at(&basis(place(j))));
                let (lateral, depth) = split(features[j].1 - value, rays[j]);
                (lateral, depth.abs())
            })
            .collect();
        let scale = |get: fn(&(f64, f64)) -> f64, normal: f64| {
            (median(errors.iter().map(get).collect()) / normal).max(FLOOR_MM)
        };
        let (sl, sd) = (scale(|e| e.0, 1.1774), scale(|e| e.1, 0.6745));
        // begin with first order and a wide limit: a curved neighbourhood is no outlier
        let (terms, limit) = if round < 2 {
            (most.min(LINEAR), 8.0)
        } else {
            (most, 5.0)
        };
        let weight = |e: &(f64, f64)| {
            let r2 = ((e.0 / sl).powi(2) + (e.1 / sd).powi(2)) / (limit * limit);
            (1.0 - r2).max(0.0).powi(2)
        };
        let rows = jury
            .iter()
            .zip(&errors)
            .map(|(&j, e)| (place(j), features[j].1, weight(e)));
        let Some(fit) = Surface::fit(rows, terms, false) else {
            break;
        };
        let leverage = fit.leverage(&origin);
        // a one-sided jury cannot extrapolate at second order
        if leverage > 3.0 && round > 1 {
            break;
        }
        best = (fit.at(&origin), leverage);
        current = Some(fit);
    }
    best
}

/// Indices of the `count` points nearest to `at`, those at the same distance as the last included, without `skip`.
fn nearest(points: &[Vector3<f64>], at: Vector3<f64>, count: usize, skip: Option<u32>) -> Vec<u32> {
    let distances: Vec<f64> = points.iter().map(|p| (p - at).norm_squared()).collect();
    let others = (0u32..).zip(&distances).filter(|(i, _)| Some(*i) != skip);
    let mut sorted: Vec<f64> = others.clone().map(|(_, d)| *d).collect();
    let count = count.min(sorted.len());
    if count == 0 {
        return Vec::new();
    }
    let limit = *sorted.select_nth_unstable_by(count - 1, f64::total_cmp).1;
    others
        .filter(|(_, d)| **d <= limit * (1.0 + 1e-6))
        .map(|(i, _)| i)
        .collect()
}

/// The accepted points in bins of one node, to find the nearest quickly.
#[derive(Clone, Debug, Default)]
struct Support {
    low: Vector3<f64>,
    counts: [usize; 3],
    starts: Vec<u32>,
    points: Vec<Vector3<f64>>,
}

impl Support {
    fn over(nodes: &[Vector3<f64>], low: Vector3<f64>, counts: [usize; 3]) -> Self {
        let mut support = Self {
            low,
            counts,
            ..Self::default()
        };
        let bin = |p: &Vector3<f64>| {
            let index: [usize; 3] =
                std::array::from_fn(|a| ((p[a] - low[a]).round().max(0.0) as usize).min(counts[a] - 1));
            (index[0] * counts[1] + index[1]) * counts[2] + index[2]
        };
        let mut binned: Vec<(usize, Vector3<f64>)> = nodes.iter().map(|p| (bin(p), *p)).collect();
        binned.sort_by_key(|(b, _)| *b);
        support.starts = (0..=counts.iter().product())
            .map(|b| binned.partition_point(|(own, _)| *own < b) as u32)
            .collect();
        support.points = binned.into_iter().map(|(_, p)| p).collect();
        support
    }

    /// Distance to the nearest point, exact up to 2, infinite beyond.
    fn nearest(&self, at: Vector3<f64>) -> f64 {
        let near = self.nearest_within(at, 1);
        if near <= 1.0 {
            return near;
        }
        let wide = self.nearest_within(at, 3);
        if wide <= 2.0 { wide } else { f64::INFINITY }
    }

    fn nearest_within(&self, at: Vector3<f64>, reach: i64) -> f64 {
        let range = |a: usize| {
            let middle = (at[a] - self.low[a]).round() as i64;
            (middle.saturating_sub(reach)).max(0)..=(middle.saturating_add(reach)).min(self.counts[a] as i64 - 1)
        };
        let mut best = f64::INFINITY;
        for x in range(0) {
            for y in range(1) {
                for z in range(2) {
                    let bin = ((x as usize * self.counts[1]) + y as usize) * self.counts[2] + z as usize;
                    let (from, to) = (self.starts[bin] as usize, self.starts[bin + 1] as usize);
                    best = self.points[from..to]
                        .iter()
                        .map(|p| (p - at).norm_squared())
                        .fold(best, f64::min);
                }
            }
        }
        best.sqrt()
    }
}

fn bounds(points: &[Vector3<f64>]) -> (Vector3<f64>, Vector3<f64>) {
    let first = points.first().copied().unwrap_or_default();
    points
        .iter()
        .fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)))
}

fn span(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    high - low
}
