//! Is the map good, in millimetres, where is it not, and what limits it? Asked of the pairs alone.
//!
//! Every figure here is of pairs predicted by a map that was fitted without them.

use crate::{Figures, FitError, FitReport, Hull, Map, MappedPoint, Pair, Settings, Spread, lattice::split};
use geometry::{Base, Camera, Point};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::collections::HashSet;

/// A tenth of the pairs is left out at a time.
const FOLDS: usize = 10;
/// Numbers of points that are tried for "how many do I need?".
const NUMBERS: [usize; 10] = [30, 45, 60, 80, 100, 150, 200, 300, 600, 1200];
/// Points along each side of the grid on which two halves are compared.
const GRID: usize = 7;

/// A visit with what a map says that was fitted without it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Judged {
    /// The pair.
    pub id: u64,
    /// When it was visited, s.
    pub t_s: f64,
    /// Where the arm was told to go.
    pub command: Point<Base>,
    /// What the map says of it; `None` where the marker was missed.
    pub mapped: Option<MappedPoint>,
    /// What it says less the command, base frame, mm.
    pub error_mm: [f64; 3],
    /// Across the viewing ray, mm.
    pub lateral_mm: f64,
    /// Along it, away from the camera, mm.
    pub depth_mm: f64,
    /// True if the fit over all pairs believed it.
    pub used: bool,
}

/// Held-out errors of maps from fewer points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WithFewer {
    /// Points that the map was fitted to.
    pub points: usize,
    /// Their mean distance, mm.
    pub spacing_mm: f64,
    /// Errors at the others.
    pub figures: Figures,
}

/// How the errors go with time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drift {
    /// Along x, y and z of the base, mm/h.
    pub mm_per_h: [f64; 3],
    /// Standard error of each, mm/h.
    pub sigma_mm_per_h: [f64; 3],
    /// From first to last visit, h.
    pub hours: f64,
}

impl Drift {
    /// The largest over the whole capture, mm, and in standard errors.
    pub fn largest(&self) -> (f64, f64) {
        (0..3)
            .map(|a| {
                (
                    self.mm_per_h[a].abs() * self.hours,
                    self.mm_per_h[a].abs() / self.sigma_mm_per_h[a].max(1e-12),
                )
            })
            .fold((0.0, 0.0), |best, now| if now.1 > best.1 { now } else { best })
    }
}

/// What was found out about a capture and the map from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Diagnosis {
    /// The fit over all pairs.
    pub fit: FitReport,
    /// Every visit, in the order of the file.
    pub visits: Vec<Judged>,
    /// Errors of the believed pairs, each predicted without it.
    pub held_out: Figures,
    /// Share of the error components within one stated sigma (0.683 if sigma is right), and within the stated 95 % interval.
    pub coverage: [f64; 2],
    /// How far apart two maps are, each from half of the pairs, over a grid in the calibrated volume.
    pub split_half: Option<Spread>,
    /// The same held-out errors with fewer points, fewest first.
    pub fewer: Vec<WithFewer>,
    /// The errors' course over the capture, where it took time.
    pub drift: Option<Drift>,
    /// Errors in eight parts of the volume: low or high x (bit 0), y (bit 1), z (bit 2).
    pub octants: [Figures; 8],
    /// What limits the accuracy and what to do, in words, the gravest first.
    pub advice: Vec<String>,
}

/// Asks the pairs everything.
///
/// # Errors
/// As [`Map::fit`].
pub fn diagnose(pairs: &[Pair], settings: &Settings) -> Result<(Map, Diagnosis), FitError> {
    let (map, fit) = Map::fit(pairs, settings)?;
    let doubted: HashSet<u64> = fit.rejected.iter().map(|r| r.id).collect();
    let valid: Vec<usize> = (0..pairs.len()).filter(|&i| pairs[i].valid).collect();
    let believed: Vec<usize> = valid
        .iter()
        .copied()
        .filter(|&i| !doubted.contains(&pairs[i].id))
        .collect();
    // what a fold leaves out is spread over the volume, also where the file is in the order of a lattice
    let order = spread(&valid);
    let mut visits: Vec<Judged> = pairs
        .iter()
        .map(|p| Judged {
            id: p.id,
            t_s: p.t_s,
            command: p.command,
            mapped: None,
            error_mm: [0.0; 3],
            lateral_mm: 0.0,
            depth_mm: 0.0,
            used: p.valid && !doubted.contains(&p.id),
        })
        .collect();
    for fold in 0..FOLDS {
        let left_out: Vec<usize> = order.iter().copied().skip(fold).step_by(FOLDS).collect();
        let others = only(pairs, |i| !left_out.contains(&i));
        let (without, _) = Map::fit(&others, settings)?;
        for i in left_out {
            judge(&without, &pairs[i], &mut visits[i]);
        }
    }
    let errors = |of: &dyn Fn(&Judged) -> bool| -> Vec<(Vector3<f64>, Vector3<f64>)> {
        let of = believed.iter().filter(|&&i| of(&visits[i]));
        of.filter_map(|&i| Some((Vector3::from(visits[i].error_mm), map.ray(pairs[i].camera?))))
            .collect()
    };
    let middle = map.volume().at([0.5; 3]);
    let octant = |p: Point<Base>| {
        let (p, m) = (p.to_array(), middle.to_array());
        (0..3).filter(|&a| p[a] > m[a]).map(|a| 1 << a).sum::<usize>()
    };
    let held_out = Figures::of(&errors(&|_| true));
    let mut fewer = fewer(pairs, &believed, settings);
    fewer.push(WithFewer {
        points: believed.len() - believed.len() / FOLDS,
        spacing_mm: fit.spacing_mm,
        figures: held_out,
    });
    let mut diagnosis = Diagnosis {
        held_out,
        coverage: coverage(believed.iter().map(|&i| &visits[i])),
        split_half: split_half(pairs, &believed, settings, &map),
        fewer,
        drift: drift(believed.iter().map(|&i| &visits[i])),
        octants: std::array::from_fn(|k| Figures::of(&errors(&|v| octant(v.command) == k))),
        advice: Vec::new(),
        fit,
        visits,
    };
    diagnosis.advice = advice(&diagnosis);
    Ok((map, diagnosis))
}

/// The capture as if the marker had been missed at all other visits: where the arm came from is known all the same.
fn only(pairs: &[Pair], chosen: impl Fn(usize) -> bool) -> Vec<Pair> {
    let all = pairs.iter().enumerate();
    all.map(|(i, p)| Pair {
        valid: p.valid && chosen(i),
        ..p.clone()
    })
    .collect()
}

fn judge(map: &Map, pair: &Pair, visit: &mut Judged) {
    let Some(camera) = pair.camera else { return };
    let mapped = map.apply(camera);
    let error = mapped.base.vector() - pair.command.vector();
    visit.mapped = Some(mapped);
    visit.error_mm = error.into();
    (visit.lateral_mm, visit.depth_mm) = split(error, map.ray(camera));
}

/// Places in an order in which every stretch is spread over all of them.
fn spread(places: &[usize]) -> Vec<usize> {
    let key = |k: usize| (k as f64 * 0.618_033_988_749_895).fract();
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|&a, &b| key(a).total_cmp(&key(b)));
    order.into_iter().map(|k| places[k]).collect()
}

fn coverage<'a>(visits: impl Iterator<Item = &'a Judged>) -> [f64; 2] {
    let (mut within, mut n) = ([0usize; 2], 0usize);
    for visit in visits {
        let Some(mapped) = visit.mapped else { continue };
        n += 2;
        let inside = crate::report::within(&mapped, visit.lateral_mm, visit.depth_mm);
        within = [within[0] + inside[0], within[1] + inside[1]];
    }
    within.map(|w| w as f64 / n.max(1) as f64)
}

/// Two maps from every other pair, compared where both know something.
fn split_half(pairs: &[Pair], believed: &[usize], settings: &Settings, map: &Map) -> Option<Spread> {
    let order = spread(believed);
    let half = |first: usize| {
        let own: HashSet<usize> = order.iter().copied().skip(first).step_by(2).collect();
        only(pairs, |i| own.contains(&i))
    };
    let (a, _) = Map::fit(&half(0), settings).ok()?;
    let (b, _) = Map::fit(&half(1), settings).ok()?;
    let camera_from_base = map.base_from_camera().inverse();
    let apart: Vec<f64> = grid(map)
        .map(|p| camera_from_base * p)
        .map(|c: Point<Camera>| (a.apply(c), b.apply(c)))
        .filter(|(a, b)| a.hull != Hull::Outside && b.hull != Hull::Outside)
        .map(|(a, b)| a.base.distance_mm(b.base))
        .collect();
    (!apart.is_empty()).then(|| Spread::of(&apart))
}

fn grid(map: &Map) -> impl Iterator<Item = Point<Base>> {
    let volume = map.volume();
    let at = move |k: usize| (k as f64 + 0.5) / GRID as f64;
    (0..GRID * GRID * GRID).map(move |k| volume.at([at(k % GRID), at(k / GRID % GRID), at(k / GRID / GRID)]))
}

fn fewer(pairs: &[Pair], believed: &[usize], settings: &Settings) -> Vec<WithFewer> {
    let order = spread(believed);
    let mut out = Vec::new();
    // something has to be left to predict
    for points in NUMBERS.into_iter().filter(|&n| n + 20 <= order.len()) {
        // every `stride`-th of the spread order, so that the fit and what it is asked are both spread
        let picked: HashSet<usize> = (0..points).map(|k| order[k * order.len() / points]).collect();
        let Ok((map, report)) = Map::fit(&only(pairs, |i| picked.contains(&i)), settings) else {
            continue;
        };
        let errors: Vec<_> = order
            .iter()
            .filter(|i| !picked.contains(i))
            .filter_map(|&i| {
                let p = &pairs[i];
                let camera = p.camera?;
                Some((map.apply(camera).base.vector() - p.command.vector(), map.ray(camera)))
            })
            .collect();
        out.push(WithFewer {
            points,
            spacing_mm: report.spacing_mm,
            figures: Figures::of(&errors),
        });
    }
    out
}

/// A straight line through the errors over time, by least squares.
fn drift<'a>(visits: impl Iterator<Item = &'a Judged>) -> Option<Drift> {
    let rows: Vec<(f64, [f64; 3])> = visits.map(|v| (v.t_s / 3600.0, v.error_mm)).collect();
    let n = rows.len() as f64;
    let mean_t = rows.iter().map(|r| r.0).sum::<f64>() / n.max(1.0);
    let spread_t = rows.iter().map(|r| (r.0 - mean_t).powi(2)).sum::<f64>();
    let span = |best: fn(f64, f64) -> f64| rows.iter().map(|r| r.0).reduce(best);
    let hours = span(f64::max)? - span(f64::min)?;
    if n < 20.0 || hours <= 0.0 {
        return None;
    }
    let line = |a: usize| {
        let mean = rows.iter().map(|r| r.1[a]).sum::<f64>() / n;
        let slope = rows.iter().map(|r| (r.0 - mean_t) * (r.1[a] - mean)).sum::<f64>() / spread_t;
        let left = rows
            .iter()
            .map(|r| (r.1[a] - mean - slope * (r.0 - mean_t)).powi(2))
            .sum::<f64>();
        (slope, (left / (n - 2.0) / spread_t).sqrt())
    };
    let lines = [line(0), line(1), line(2)];
    Some(Drift {
        mm_per_h: lines.map(|l| l.0),
        sigma_mm_per_h: lines.map(|l| l.1),
        hours,
    })
}

fn advice(d: &Diagnosis) -> Vec<String> {
    let mut words = d.fit.notes.clone();
    let rms = d.held_out.total.rms_mm;
    if let Some(drift) = d.drift
        && let (mm, sigmas) = drift.largest()
        && sigmas > 4.0
        && mm > 0.5 * rms
    {
        words.push(format!(
            "the errors drift by {mm:.2} mm over the capture: let arm and camera warm up first, and visit in random order"
        ));
    }
    let worst = (0..8)
        .filter(|&k| d.octants[k].n >= 5)
        .max_by(|&a, &b| d.octants[a].total.rms_mm.total_cmp(&d.octants[b].total.rms_mm));
    if let Some(k) = worst
        && d.octants[k].total.rms_mm > 1.6 * rms
    {
        let side = |bit: usize, name: &str| format!("{} {name}", if k >> bit & 1 == 1 { "high" } else { "low" });
        words.push(format!(
            "at {}, {} and {} the error is {:.1} times as large as elsewhere: visit more points there",
            side(0, "x"),
            side(1, "y"),
            side(2, "z"),
            d.octants[k].total.rms_mm / rms
        ));
    }
    if !(0.90..=0.99).contains(&d.coverage[1]) {
        words.push(format!(
            "the stated 95 % interval holds {:.0} % of the errors: {}",
            100.0 * d.coverage[1],
            if d.coverage[1] < 0.9 {
                "there are more outliers than the fit could know"
            } else {
                "sigma is too careful"
            }
        ));
    }
    if let [.., half, last] = d.fewer.as_slice()
        && last.figures.total.rms_mm > 0.9 * half.figures.total.rms_mm
    {
        words.push(format!(
            "{} points do nearly as well as {} (rms {:.3} and {:.3} mm): fewer would do, and what is left is measurement and ripple of the gears; average more frames a point",
            half.points, last.points, half.figures.total.rms_mm, last.figures.total.rms_mm
        ));
    } else if let Some(last) = d.fewer.last() {
        words.push(format!(
            "the error still falls with the number of points (rms {:.3} mm with {}): more points would help",
            last.figures.total.rms_mm, last.points
        ));
    }
    words
}

/// Share of places in the calibrated volume that are inside, not at an edge of what was visited.
pub fn volume_covered(map: &Map) -> f64 {
    let camera_from_base = map.base_from_camera().inverse();
    let places: Vec<Point<Base>> = grid(map).collect();
    let inside = places
        .iter()
        .filter(|&&p| map.apply(camera_from_base * p).hull == Hull::Inside);
    inside.count() as f64 / places.len() as f64
}
