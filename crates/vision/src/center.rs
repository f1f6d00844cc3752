//! The centre of a screw to a fraction of a pixel: outer circle, cross edges, the learned centre and, where there is depth, the relief, fused by
//! their sigmas.
//!
//! Circle and cross are the cues of the paper's Algorithm 1 (grey, equalised, outer circle, cross edges). Each runs alone too, so that an
//! evaluation can say what each of them buys.

use std::f64::consts::TAU;

use geometry::Pixel;
use image::RgbImage;
use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use crate::Corrections;
use crate::model::CueFactors;
use crate::picture::Patch;

/// Cues that differ by more than so many sigmas are not of the same thing.
const GATE_SIGMAS: f64 = 3.5;

/// What a centre rests on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cue {
    /// The votes of the fine networks.
    Learned,
    /// The outline of the head.
    Circle,
    /// The fourfold symmetry of the recess.
    Cross,
    /// The disc that stands out of the sheet, in the depth.
    Relief,
}

/// A centre by one cue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CueCenter {
    /// Where.
    pub pixel: Pixel,
    /// Standard error along each axis, px.
    pub sigma_px: f64,
}

/// The outline of a head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Circle {
    /// Its centre.
    pub center: CueCenter,
    /// Mean diameter, px.
    pub diameter_px: f64,
    /// Share of the outline that was found, 0 to 1.
    pub coverage: f64,
}

/// The recess of a cross screw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cross {
    /// Its centre.
    pub center: CueCenter,
    /// Direction of one wing in the image, 0 to a quarter turn, rad.
    pub angle_rad: f64,
    /// Share of the pattern that repeats every quarter turn beyond chance: 0 none, 1 all.
    pub symmetry: f64,
}

/// The fused centre.
#[derive(Clone, Debug, PartialEq)]
pub struct Fused {
    /// Where, and how sure.
    pub center: CueCenter,
    /// The cues that agreed.
    pub cues: Vec<Cue>,
}

/// Rays from the centre on which the outline is looked for.
const RAYS: usize = 64;

/// An edge met by a ray, patch px from the ray's origin.
#[derive(Clone, Copy)]
struct Edge {
    ray: usize,
    radius: f64,
    strength: f64,
}

/// Finds the outline of a head near a place: edges along rays vote for a circle, a low-order ellipse is fitted to those that agree.
///
/// # Arguments
/// * `start` – the centre so far, good to about 0.2 diameters.
/// * `diameter_px` – the diameter so far, good to about 25 %.
///
/// # Returns
/// `None` where less than 40 % of an outline is there.
pub fn outer_circle(picture: &RgbImage, start: Pixel, diameter_px: f64) -> Option<Circle> {
    let plain = patch(picture, start, diameter_px, 0.85, 0.035)?;
    let equalised = plain.clone().equalised();
    let radius = 0.5 * diameter_px;
    let local = plain.local(start);
    let [mut x, mut y, mut r] = vote(&edges(&equalised, local, radius, 0.6..1.5), local, radius)?;
    let mut fit = None;
    for pass in 0..4 {
        // Equalising bends the grey scale and with it an edge's place: it helps to see the outline, not to measure it.
        let (patch, tolerance) = match pass {
            0 => (&equalised, 0.12),
            _ => (&plain, 0.07),
        };
        let edges = edges(patch, [x, y], r, 0.75..1.25);
        let found = fit_outline(&edges, r, tolerance)?;
        (x, y, r) = (x + found.dx, y + found.dy, found.radius);
        fit = Some(found);
    }
    let fit = fit?;
    let off = (x - local[0]).hypot(y - local[1]);
    if fit.coverage < 0.4 || off > 0.6 * radius || !(0.6..1.6).contains(&(r / radius)) {
        return None;
    }
    Some(Circle {
        center: CueCenter {
            pixel: plain.to_image([x, y]),
            sigma_px: fit.sigma.max(0.03),
        },
        diameter_px: 2.0 * r,
        coverage: fit.coverage,
    })
}

fn patch(picture: &RgbImage, at: Pixel, diameter_px: f64, half: f64, blur: f64) -> Option<Patch> {
    let inside = (-0.5..f64::from(picture.width())).contains(&at.u_px)
        && (-0.5..f64::from(picture.height())).contains(&at.v_px)
        && (6.0..2000.0).contains(&diameter_px);
    inside.then(|| {
        Patch::cut(picture, at, (half * diameter_px).ceil() as usize + 3).blurred((blur * diameter_px).max(0.5))
    })
}

/// The strongest sub-pixel edges of either sign on each ray, between `span` times `radius`.
fn edges(patch: &Patch, [x, y]: [f64; 2], radius: f64, span: std::ops::Range<f64>) -> Vec<Edge> {
    const A_RAY: usize = 3;
    /// Change of grey (0 to 1) a pixel below which there is no edge.
    const FAINTEST: f64 = 0.008;
    let step = (radius / 60.0).max(0.25);
    let count = ((span.end - span.start) * radius / step).ceil() as usize + 1;
    let mut edges: Vec<Edge> = Vec::with_capacity(RAYS * A_RAY);
    let mut slope = vec![0f64; count];
    for ray in 0..RAYS {
        let (sin, cos) = (TAU * ray as f64 / RAYS as f64).sin_cos();
        for (k, slope) in slope.iter_mut().enumerate() {
            let r = span.start * radius + k as f64 * step;
            let at = |r: f64| f64::from(patch.sample(x + r * cos, y + r * sin));
            *slope = (at(r + 0.75) - at(r - 0.75)).abs() / 1.5;
        }
        let mut own: Vec<Edge> = Vec::new();
        for k in 1..count.saturating_sub(1) {
            let (a, b, c) = (slope[k - 1], slope[k], slope[k + 1]);
            if b > FAINTEST && b >= a && b > c {
                let shift = 0.5 * (a - c) / (a - 2.0 * b + c).min(-1e-12);
                own.push(Edge {
                    ray,
                    radius: span.start * radius + (k as f64 + shift) * step,
                    strength: b,
                });
            }
        }
        own.sort_by(|a, b| b.strength.total_cmp(&a.strength));
        own.truncate(A_RAY);
        edges.extend(own);
    }
    // A glint must not outvote the rest of the outline.
    let mut strengths: Vec<f64> = edges.iter().map(|e| e.strength).collect();
    if !strengths.is_empty() {
        let middle = strengths.len() / 2;
        let typical = *strengths.select_nth_unstable_by(middle, f64::total_cmp).1;
        edges
            .iter_mut()
            .for_each(|e| e.strength = e.strength.min(2.5 * typical));
    }
    edges
}

/// The circle that most edges vote for: centre and radius, patch px.
fn vote(edges: &[Edge], [x, y]: [f64; 2], radius: f64) -> Option<[f64; 3]> {
    let points: Vec<[f64; 3]> = edges
        .iter()
        .map(|e| {
            let (sin, cos) = (TAU * e.ray as f64 / RAYS as f64).sin_cos();
            [e.radius * cos, e.radius * sin, e.strength]
        })
        .collect();
    let tolerance = (0.09 * radius).max(1.0);
    // The radii of a trial centre's edges go into a histogram; its best window is that centre's best circle.
    let bin = 0.5 * tolerance;
    let mut histogram = vec![0f64; (1.8 * radius / bin).ceil() as usize + 3];
    let reach = (0.3 * radius / (0.5 * tolerance)).ceil() as i64;
    let mut best = (0.0, [0.0; 3]);
    for j in -reach..=reach {
        for i in -reach..=reach {
            let (dx, dy) = (0.5 * tolerance * i as f64, 0.5 * tolerance * j as f64);
            histogram.fill(0.0);
            for [px, py, strength] in &points {
                let r = (px - dx).hypot(py - dy) / bin;
                let k = r as usize;
                if k + 1 < histogram.len() {
                    let t = r - k as f64;
                    histogram[k] += strength * (1.0 - t);
                    histogram[k + 1] += strength * t;
                }
            }
            // A centre far from the expected one needs a little more support.
            let prior = 1.0 - 0.3 * (dx * dx + dy * dy) / (0.3 * radius).powi(2);
            for k in 1..histogram.len() - 1 {
                let r = k as f64 * bin;
                let votes = 0.5 * histogram[k - 1] + histogram[k] + 0.5 * histogram[k + 1];
                let score = votes * prior * (-0.5 * ((r / radius - 1.0) / 0.15).powi(2)).exp();
                if score > best.0 {
                    best = (score, [x + dx, y + dy, r]);
                }
            }
        }
    }
    (best.0 > 0.0).then_some(best.1)
}

/// Result of [`fit_outline`]: correction of the centre, mean radius, standard error of the centre along an axis.
pub(crate) struct Outline {
    pub dx: f64,
    pub dy: f64,
    pub radius: f64,
    /// Amplitude of the ellipse's second harmonic, px: half the difference of its semi-axes.
    pub flattening: f64,
    /// Direction of the long axis, rad.
    pub direction_rad: f64,
    pub sigma: f64,
    pub coverage: f64,
}

/// Fits `r(t) = radius + dx cos t + dy sin t + a cos 2t + b sin 2t`, a low-order ellipse, to the edges near `radius`, robustly (Tukey).
/// The last two terms only where most of the outline is there.
fn fit_outline(edges: &[Edge], radius: f64, tolerance: f64) -> Option<Outline> {
    let limit = (tolerance * radius).max(1.0);
    let mut nearest: [Option<Edge>; RAYS] = [None; RAYS];
    for edge in edges {
        let cost = |e: &Edge| (e.radius - radius).abs() / (limit * e.strength);
        let slot = &mut nearest[edge.ray];
        if (edge.radius - radius).abs() < 1.5 * limit && slot.is_none_or(|held| cost(edge) < cost(&held)) {
            *slot = Some(*edge);
        }
    }
    let points: Vec<(f64, f64, f64)> = nearest
        .iter()
        .flatten()
        .map(|e| (TAU * e.ray as f64 / RAYS as f64, e.radius, e.strength))
        .collect();
    fit_harmonics(&points, RAYS, radius, limit)
}

/// The fit behind [`fit_outline`]: `points` are (angle, radius, weight), `rays` is how many there could be.
pub(crate) fn fit_harmonics(points: &[(f64, f64, f64)], rays: usize, radius: f64, limit: f64) -> Option<Outline> {
    if points.len() < rays / 4 {
        return None;
    }
    let mut p = SVector::<f64, 5>::zeros();
    p[0] = radius;
    let row = |t: f64| SVector::<f64, 5>::new(1.0, t.cos(), t.sin(), (2.0 * t).cos(), (2.0 * t).sin());
    let mut elliptic = points.len() * 4 >= rays * 3;
    let (mut sigma, mut inliers) = (f64::INFINITY, 0);
    let mut scale = limit;
    for _ in 0..8 {
        let mut a = SMatrix::<f64, 5, 5>::zeros();
        let mut b = SVector::<f64, 5>::zeros();
        let (mut squares, mut weights) = (0.0, 0.0);
        inliers = 0;
        for &(t, r, strength) in points {
            let mut row = row(t);
            let residual = r - row.dot(&p);
            if residual.abs() >= scale {
                continue;
            }
            let tukey = (1.0 - (residual / scale).powi(2)).powi(2);
            let weight = strength * tukey;
            if !elliptic {
                (row[3], row[4]) = (0.0, 0.0);
            }
            a += row * row.transpose() * weight;
            b += row * (r * weight);
            squares += tukey * residual * residual;
            weights += tukey;
            inliers += usize::from(tukey > 0.1);
        }
        if inliers * 4 < rays {
            return None;
        }
        elliptic = elliptic && inliers * 4 >= rays * 3;
        if !elliptic {
            (a[(3, 3)], a[(4, 4)]) = (1.0, 1.0); // holds the two terms at zero
            for k in 0..3 {
                for h in 3..5 {
                    (a[(k, h)], a[(h, k)]) = (0.0, 0.0);
                }
            }
            (a[(3, 4)], a[(4, 3)]) = (0.0, 0.0);
            (b[3], b[4]) = (0.0, 0.0);
        }
        let inverse = a.try_inverse()?;
        p = inverse * b;
        let variance = squares / (weights - 3.0).max(1.0);
        // Scaled so that an even ring of points of mean weight counts each as one; neighbours share their blur.
        let mean_weight = a[(0, 0)] / weights.max(1.0);
        sigma = (1.5 * variance * mean_weight * 0.5 * (inverse[(1, 1)] + inverse[(2, 2)])).sqrt();
        scale = (4.0 * variance.sqrt()).clamp(0.3, limit);
    }
    let coverage = inliers as f64 / rays as f64;
    (p.iter().all(|v| v.is_finite()) && p[0] > 0.0).then(|| Outline {
        dx: p[1],
        dy: p[2],
        radius: p[0],
        flattening: p[3].hypot(p[4]),
        direction_rad: 0.5 * p[4].atan2(p[3]),
        sigma,
        coverage,
    })
}

/// Angles and rings of the polar sampling on which the cross is matched; a quarter turn is a whole number of angles.
const ANGLES: usize = 64;
/// The recess, in head diameters.
const RECESS: std::ops::Range<f64> = 0.04..0.28;

/// How much grey and edges count: edges alone lock on rust and scratches, grey alone on shadows.
const LAYER_WEIGHTS: [f64; 2] = [0.8, 0.2];

/// Polar pattern of the recess around a trial centre.
struct Pattern<'a> {
    layers: [&'a Patch; 2],
    radii: Vec<f64>,
    directions: Vec<[f64; 2]>,
}

impl Pattern<'_> {
    /// Share of the pattern's angular variance that repeats every quarter turn, over grey and edges.
    ///
    /// Ring means are taken out first: a dome or a concentric ring says nothing about a cross.
    fn symmetry(&self, [x, y]: [f64; 2]) -> f64 {
        const QUARTER: usize = ANGLES / 4;
        let mut score = 0.0;
        for (patch, weight) in self.layers.into_iter().zip(LAYER_WEIGHTS) {
            let (mut repeated, mut total) = (0.0, 1e-9);
            for &r in &self.radii {
                let mut ring = [0f64; ANGLES];
                for (value, [cos, sin]) in ring.iter_mut().zip(&self.directions) {
                    *value = f64::from(patch.sample(x + r * cos, y + r * sin));
                }
                let mean = ring.iter().sum::<f64>() / ANGLES as f64;
                for k in 0..QUARTER {
                    let four = [ring[k], ring[k + QUARTER], ring[k + 2 * QUARTER], ring[k + 3 * QUARTER]];
                    let common = four.iter().sum::<f64>() / 4.0 - mean;
                    repeated += r * 4.0 * common * common;
                    total += r * four.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
                }
            }
            score += weight * repeated / total;
        }
        score
    }

    /// Direction of the darker of the two wing pairs' axes, modulo a quarter turn.
    fn angle(&self, [x, y]: [f64; 2]) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for &r in &self.radii {
            for (k, [cos, sin]) in self.directions.iter().enumerate() {
                let dark = -f64::from(self.layers[0].sample(x + r * cos, y + r * sin)) * r;
                let four = 4.0 * TAU * k as f64 / ANGLES as f64;
                re += dark * four.cos();
                im += dark * four.sin();
            }
        }
        (0.25 * im.atan2(re)).rem_euclid(TAU / 4.0)
    }
}

/// Finds the centre of a cross recess near a place: where the pattern repeats best under quarter turns.
///
/// Works whichever part is bright, needs no template of the recess, and gives nothing on what has no fourfold symmetry.
///
/// # Arguments
/// * `start` – the centre so far, good to about 0.15 diameters.
/// * `diameter_px` – of the head, good to about 25 %.
pub fn cross(picture: &RgbImage, start: Pixel, diameter_px: f64) -> Option<Cross> {
    let grey = patch(picture, start, diameter_px, 0.6, 0.03)?.equalised();
    let edges = grey.gradient();
    let step = (diameter_px / 37.0).max(0.5);
    let rings = ((RECESS.end - RECESS.start) * diameter_px / step).ceil().max(4.0);
    let pattern = Pattern {
        layers: [&grey, &edges],
        radii: (0..=rings as usize)
            .map(|k| diameter_px * (RECESS.start + (RECESS.end - RECESS.start) * k as f64 / rings))
            .collect(),
        directions: (0..ANGLES)
            .map(|k| {
                let (sin, cos) = (TAU * k as f64 / ANGLES as f64).sin_cos();
                [cos, sin]
            })
            .collect(),
    };
    let local = grey.local(start);
    let reach = (0.16 * diameter_px / step).round() as i64;
    let mut best = (f64::NEG_INFINITY, local);
    for j in -reach..=reach {
        for i in -reach..=reach {
            let at = [local[0] + step * i as f64, local[1] + step * j as f64];
            let score = pattern.symmetry(at);
            if score > best.0 {
                best = (score, at);
            }
        }
    }
    let mut at = best.1;
    let mut curvature = 0.0;
    for h in [0.6 * step, 0.5 * step, 0.5 * step] {
        let peak = paraboloid(|dx, dy| pattern.symmetry([at[0] + dx, at[1] + dy]), h)?;
        at = [
            at[0] + peak.dx.clamp(-1.5 * h, 1.5 * h),
            at[1] + peak.dy.clamp(-1.5 * h, 1.5 * h),
        ];
        curvature = peak.curvature;
    }
    let chance = 0.25; // a quarter of the harmonics of noise are multiples of four
    let share = pattern.symmetry(at);
    let symmetry = (share - chance) / (1.0 - chance);
    let off = (at[0] - local[0]).hypot(at[1] - local[1]);
    if symmetry < MIN_SYMMETRY || off > 0.2 * diameter_px {
        return None;
    }
    // Least squares: variance = 2 * residual / (samples * curvature), about 9 px² to an independent sample
    // (what makes the stated errors true on rendered faces).
    let samples = 0.5 * TAU * (RECESS.end * diameter_px).powi(2) / 9.0;
    let sigma_px = (2.0 * (1.0 - share) / (samples * curvature)).sqrt();
    Some(Cross {
        center: CueCenter {
            pixel: grey.to_image(at),
            sigma_px: sigma_px.max(0.03),
        },
        angle_rad: pattern.angle(at),
        symmetry,
    })
}

/// Below this the recess is buried, worn off, or no cross: what is found is rust as often as not.
const MIN_SYMMETRY: f64 = 0.25;

pub(crate) struct Peak {
    pub dx: f64,
    pub dy: f64,
    /// Smaller of the two principal curvatures, with its sign turned: positive at a maximum.
    pub curvature: f64,
}

/// Maximum of the paraboloid through a 3 x 3 grid of spacing `h`; `None` where there is no maximum.
pub(crate) fn paraboloid(value: impl Fn(f64, f64) -> f64, h: f64) -> Option<Peak> {
    let mut v = [[0f64; 3]; 3];
    for (j, row) in v.iter_mut().enumerate() {
        for (i, v) in row.iter_mut().enumerate() {
            *v = value((i as f64 - 1.0) * h, (j as f64 - 1.0) * h);
        }
    }
    let column = |i: usize| v[0][i] + v[1][i] + v[2][i];
    let row = |j: usize| v[j][0] + v[j][1] + v[j][2];
    let gx = (column(2) - column(0)) / (6.0 * h);
    let gy = (row(2) - row(0)) / (6.0 * h);
    let hxx = (column(2) - 2.0 * column(1) + column(0)) / (3.0 * h * h);
    let hyy = (row(2) - 2.0 * row(1) + row(0)) / (3.0 * h * h);
    let hxy = (v[2][2] - v[2][0] - v[0][2] + v[0][0]) / (4.0 * h * h);
    let det = hxx * hyy - hxy * hxy;
    if hxx >= 0.0 || det <= 1e-12 {
        return None;
    }
    let middle = 0.5 * (hxx + hyy);
    let half = (0.25 * (hxx - hyy).powi(2) + hxy * hxy).sqrt();
    Some(Peak {
        dx: (hxy * gy - hyy * gx) / det,
        dy: (hxy * gx - hxx * gy) / det,
        curvature: -(middle + half),
    })
}

/// Fuses the cues by inverse variance; one that contradicts the others is left out.
///
/// # Arguments
/// * `cues` – each at most once.
/// * `diameter_px` – of the head.
/// * `parallax_px` – where something one head diameter below the rim appears, seen from the rim ([`parallax_px`](crate::parallax_px));
///   zero where that is not known.
///
/// # Returns
/// `None` without any cue. Where two cues contradict each other and no third decides, the surer one stays, with a sigma that says so.
pub fn fuse(
    cues: &[(Cue, CueCenter)],
    diameter_px: f64,
    parallax_px: [f64; 2],
    corrections: &Corrections,
) -> Option<Fused> {
    let [du, dv] = parallax_px;
    let corrected = |&(cue, center): &(Cue, CueCenter)| {
        let CueFactors {
            below_rim,
            sigma,
            floor,
        } = corrections.of(cue);
        let center = CueCenter {
            pixel: Pixel::new(center.pixel.u_px - below_rim * du, center.pixel.v_px - below_rim * dv),
            sigma_px: (sigma * center.sigma_px).hypot(floor * diameter_px),
        };
        (cue, center)
    };
    let mut held: Vec<(Cue, CueCenter)> = cues.iter().map(corrected).collect();
    let mut dispute = 0f64;
    while held.len() > 1 {
        let all = mean(&held)?;
        let misfit = |i: usize| {
            let mut others = held.clone();
            let (_, own) = others.remove(i);
            let rest = mean(&others).unwrap_or(all);
            own.pixel.distance_px(&rest.pixel) / own.sigma_px.hypot(rest.sigma_px)
        };
        // Of two, both misfit alike: the less sure one goes.
        let (worst, by) = (0..held.len()).map(|i| (i, misfit(i))).max_by(|a, b| {
            let sigma = |i: usize| held[i].1.sigma_px;
            (a.1.total_cmp(&b.1)).then(sigma(a.0).total_cmp(&sigma(b.0)))
        })?;
        if by <= GATE_SIGMAS {
            break;
        }
        let (_, dropped) = held.remove(worst);
        if held.len() == 1 {
            dispute = 0.25 * dropped.pixel.distance_px(&held[0].1.pixel);
        }
    }
    let mut center = mean(&held)?;
    center.sigma_px = center.sigma_px.hypot(dispute);
    Some(Fused {
        center,
        cues: held.iter().map(|(cue, _)| *cue).collect(),
    })
}

/// Mean by inverse variance; its sigma grows with the cues' disagreement (Birge ratio).
fn mean(cues: &[(Cue, CueCenter)]) -> Option<CueCenter> {
    let weight = |c: &CueCenter| c.sigma_px.max(1e-3).powi(-2);
    let sum: f64 = cues.iter().map(|(_, c)| weight(c)).sum();
    if cues.is_empty() || !sum.is_finite() {
        return None;
    }
    let u = cues.iter().map(|(_, c)| weight(c) * c.pixel.u_px).sum::<f64>() / sum;
    let v = cues.iter().map(|(_, c)| weight(c) * c.pixel.v_px).sum::<f64>() / sum;
    let pixel = Pixel::new(u, v);
    let square: f64 = cues
        .iter()
        .map(|(_, c)| weight(c) * c.pixel.distance_px(&pixel).powi(2))
        .sum();
    let freedom = 2.0 * (cues.len() as f64 - 1.0);
    let birge = if freedom > 0.0 {
        (square / freedom).max(1.0)
    } else {
        1.0
    };
    Some(CueCenter {
        pixel,
        sigma_px: (birge / sum).sqrt(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Screw, draw};

    #[test]
    fn the_cross_is_found_to_a_fraction_of_a_pixel() {
        let (mut sum, mut worst) = (0.0, 0f64);
        let mut sigmas = 0.0;
        for k in 0..24u32 {
            let f = |m: f64| (f64::from(k + 1) * m).fract();
            let screw = Screw {
                at: Pixel::new(50.0 + f(0.618), 47.0 + f(0.755)),
                diameter_px: 20.0 + 20.0 * f(0.57),
                angle_rad: TAU * f(0.324),
                bright: k % 4 == 0,
                noise: 0.03,
                seed: u64::from(k),
                ..Screw::default()
            };
            let picture = draw(100, 100, &[screw]);
            let start = Pixel::new(50.0 + 2.0 * f(0.31) - 1.0, 47.0 + 2.0 * f(0.47) - 1.0);
            let found = cross(&picture, start, screw.diameter_px * (0.85 + 0.3 * f(0.23))).expect("a plain cross");
            let off = found.center.pixel.distance_px(&screw.at);
            let turn = (found.angle_rad - screw.angle_rad).rem_euclid(TAU / 4.0);
            assert!(off < 0.3, "{k}: off by {off} {found:?} {screw:?}");
            assert!(
                screw.bright || turn.min(TAU / 4.0 - turn) < 0.1,
                "{k}: {found:?} {screw:?}"
            );
            sum += off * off;
            sigmas += 2.0 * found.center.sigma_px.powi(2);
            worst = worst.max(off);
        }
        let ratio = (sum / sigmas).sqrt();
        assert!(
            (0.3..3.0).contains(&ratio),
            "stated sigma against true error: {ratio}, worst {worst}"
        );
    }

    #[test]
    fn the_circle_is_found_when_a_third_of_it_is_hidden() {
        for (k, hidden) in [0.0, 0.0, 0.2, 0.33].into_iter().enumerate() {
            let screw = Screw {
                at: Pixel::new(49.3 + 0.17 * k as f64, 50.8),
                diameter_px: 30.0,
                hidden,
                noise: 0.02,
                seed: k as u64,
                ..Screw::default()
            };
            let picture = draw(100, 100, &[screw]);
            let found = outer_circle(&picture, Pixel::new(51.5, 49.0), 33.0).expect("a plain head");
            let off = found.center.pixel.distance_px(&screw.at);
            assert!(off < if hidden > 0.0 { 0.4 } else { 0.2 }, "{hidden}: {off} {found:?}");
            assert!((found.diameter_px - 30.0).abs() < 0.8, "{found:?}");
            assert!(found.center.sigma_px < 0.3, "{found:?}");
        }
    }

    #[test]
    fn nothing_round_nor_crossed_gives_no_cue() {
        let flat = draw(100, 100, &[]);
        assert!(outer_circle(&flat, Pixel::new(50.0, 50.0), 30.0).is_none());
        assert!(cross(&flat, Pixel::new(50.0, 50.0), 30.0).is_none());
        let slotted = Screw {
            at: Pixel::new(50.0, 50.0),
            slot: true,
            ..Screw::default()
        };
        let picture = draw(100, 100, &[slotted]);
        let (two, four) = (
            cross(&picture, slotted.at, 30.0).map_or(0.0, |c| c.symmetry),
            cross(&draw(100, 100, &[Screw { slot: false, ..slotted }]), slotted.at, 30.0).map_or(0.0, |c| c.symmetry),
        );
        assert!(two < 0.5 && four > 0.8, "slot {two}, cross {four}");
        let tiny = RgbImage::new(1, 1);
        assert!(outer_circle(&tiny, Pixel::new(0.0, 0.0), 30.0).is_none());
        assert!(cross(&tiny, Pixel::new(0.0, 0.0), 30.0).is_none());
    }

    fn at(u: f64, sigma_px: f64) -> CueCenter {
        CueCenter {
            pixel: Pixel::new(u, 0.0),
            sigma_px,
        }
    }

    #[test]
    fn fusion_weighs_and_gates() {
        let corrections = Corrections::default();
        let fused = |cues: &[(Cue, CueCenter)], parallax_px: f64, corrections: &Corrections| {
            fuse(cues, 28.0, [parallax_px, 0.0], corrections).expect("cues")
        };
        let (learned, cross) = ((Cue::Learned, at(0.1, 0.4)), (Cue::Cross, at(0.0, 0.1)));
        let all = fused(&[learned, (Cue::Circle, at(0.8, 0.05)), cross], 0.0, &corrections);
        assert_eq!(all.cues, [Cue::Learned, Cue::Circle, Cue::Cross]);
        assert!(all.center.pixel.u_px < 0.06, "the circle has a floor: {all:?}");
        let gated = fused(&[learned, (Cue::Circle, at(6.0, 0.05)), cross], 0.0, &corrections);
        assert_eq!(gated.cues, [Cue::Learned, Cue::Cross]);
        let dispute = fused(&[(Cue::Learned, at(8.0, 0.4)), cross], 0.0, &corrections);
        assert_eq!(dispute.cues, [Cue::Cross]);
        assert!(dispute.center.sigma_px > 1.5, "{dispute:?}");
        // the outline lies deeper: seen from aside, it is off, and the fusion knows by how much
        let deep = Corrections {
            below_rim: [0.0, 0.2, 0.0],
            ..Corrections::default()
        };
        let aside = fused(
            &[(Cue::Learned, at(0.0, 0.4)), (Cue::Circle, at(2.0, 0.05))],
            10.0,
            &deep,
        );
        assert!(
            aside.cues.len() == 2 && aside.center.pixel.u_px.abs() < 1e-9,
            "{aside:?}"
        );
        assert!(fuse(&[], 28.0, [0.0; 2], &corrections).is_none());
    }
}
