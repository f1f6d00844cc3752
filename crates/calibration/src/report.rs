//! Is the map good, in millimetres, and where is it not?

use crate::{Hull, Level, Map, MappedPoint, Pair, rigid::quantile};
use geometry::{Base, Camera, Transform};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::fmt;

/// How a set of errors is spread, mm.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Root mean square, mm.
    pub rms_mm: f64,
    /// 95 % are at most this, mm.
    pub p95_mm: f64,
    /// 99 % are at most this, mm.
    pub p99_mm: f64,
    /// 99.9 % are at most this, mm.
    pub p999_mm: f64,
    /// The largest, mm.
    pub max_mm: f64,
}

impl Spread {
    pub(crate) fn of(values: &[f64]) -> Self {
        let n = values.len().max(1) as f64;
        let at = |q| quantile(values.to_vec(), q);
        Self {
            rms_mm: (values.iter().map(|v| v * v).sum::<f64>() / n).sqrt(),
            p95_mm: at(0.95),
            p99_mm: at(0.99),
            p999_mm: at(0.999),
            max_mm: at(1.0),
        }
    }
}

/// Errors of a map at points that it was not fitted to: as 3D distance, across and along the viewing ray.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Points.
    pub n: usize,
    /// 3D distance.
    pub total: Spread,
    /// Distance across the viewing ray.
    pub lateral: Spread,
    /// Distance along the viewing ray.
    pub depth: Spread,
    /// Root mean square along x, y and z of the base, mm.
    pub axis_rms_mm: [f64; 3],
}

impl Figures {
    /// From errors in the base frame and the directions of the rays that they belong to.
    pub(crate) fn of(errors: &[(Vector3<f64>, Vector3<f64>)]) -> Self {
        let split: Vec<_> = errors.iter().map(|(e, ray)| crate::lattice::split(*e, *ray)).collect();
        let n = errors.len().max(1) as f64;
        let axis = |a: usize| (errors.iter().map(|(e, _)| e[a] * e[a]).sum::<f64>() / n).sqrt();
        Self {
            n: errors.len(),
            total: Spread::of(&errors.iter().map(|(e, _)| e.norm()).collect::<Vec<_>>()),
            lateral: Spread::of(&split.iter().map(|s| s.0).collect::<Vec<_>>()),
            depth: Spread::of(&split.iter().map(|s| s.1.abs()).collect::<Vec<_>>()),
            axis_rms_mm: [axis(0), axis(1), axis(2)],
        }
    }
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let line = |s: &Spread| {
            format!(
                "{:9.3} {:9.3} {:9.3} {:9.3} {:9.3}",
                s.rms_mm, s.p95_mm, s.p99_mm, s.p999_mm, s.max_mm
            )
        };
        writeln!(
            f,
            "  error, mm                  rms       p95       p99     p99.9       max"
        )?;
        writeln!(f, "  3D                   {}", line(&self.total))?;
        writeln!(f, "  across the ray       {}", line(&self.lateral))?;
        writeln!(f, "  along the ray        {}", line(&self.depth))?;
        let [x, y, z] = self.axis_rms_mm;
        write!(f, "  rms along x, y, z of the base: {x:.3}, {y:.3}, {z:.3} mm")
    }
}

/// A pair that the fit did not believe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rejected {
    /// The pair.
    pub id: u64,
    /// How far it lies from the map, 3D, mm.
    pub residual_mm: f64,
    /// Across the viewing ray, mm.
    pub lateral_mm: f64,
    /// Along the viewing ray, away from the camera, mm.
    pub depth_mm: f64,
}

/// What a fit found out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FitReport {
    /// Pairs that were given.
    pub n_pairs: usize,
    /// Visits that missed the marker.
    pub n_invalid: usize,
    /// Pairs that the map rests on.
    pub n_used: usize,
    /// Pairs that were not believed, worst first.
    pub rejected: Vec<Rejected>,
    /// Distance between neighbouring points, mm.
    pub spacing_mm: f64,
    /// Each used pair predicted as if it had not been used.
    pub held_out: Figures,
    /// The same pairs under the rigid motion alone: what the local map is worth.
    pub rigid_only: Figures,
    /// Neighbourhoods at each level of the fallback (none where the method has no neighbourhoods).
    pub neighbourhoods: Vec<(Level, usize)>,
    /// What the user should know, in words.
    pub notes: Vec<String>,
}

impl FitReport {
    pub(crate) fn remark(&mut self) {
        let share = |n: usize, of: usize| 100.0 * n as f64 / of.max(1) as f64;
        let (bad, missed) = (
            share(self.rejected.len(), self.n_pairs),
            share(self.n_invalid, self.n_pairs),
        );
        if bad > 3.0 {
            self.notes.push(format!(
                "{bad:.1} % of the pairs were rejected; look at their pictures: is the marker dirty, reflecting or partly hidden?"
            ));
        }
        if missed > 5.0 {
            self.notes.push(format!(
                "the marker was missed at {missed:.1} % of the visits; check the light, the colour thresholds and the view"
            ));
        }
        let thin: usize = self
            .neighbourhoods
            .iter()
            .filter(|(l, _)| *l >= Level::Linear)
            .map(|(_, n)| n)
            .sum();
        if thin > 0 {
            self.notes.push(format!(
                "{thin} neighbourhoods hold too few points for second order; sigma is larger there: visit the missing points again"
            ));
        }
        if self.held_out.depth.rms_mm > 2.0 * self.held_out.lateral.rms_mm {
            self.notes.push(format!(
                "depth limits the accuracy ({:.3} mm along the ray, {:.3} mm across): average several depth frames a point",
                self.held_out.depth.rms_mm, self.held_out.lateral.rms_mm
            ));
        }
    }
}

impl fmt::Display for FitReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} pairs: {} used, {} without marker, {} rejected; neighbours are {:.0} mm apart",
            self.n_pairs,
            self.n_used,
            self.n_invalid,
            self.rejected.len(),
            self.spacing_mm
        )?;
        writeln!(f, "each pair predicted as if it had not been used:\n{}", self.held_out)?;
        let rigid = self.rigid_only.total;
        write!(
            f,
            "a rigid motion alone: rms {:.3} mm, p99.9 {:.3} mm",
            rigid.rms_mm, rigid.p999_mm
        )?;
        for r in self.rejected.iter().take(10) {
            let Rejected {
                id,
                residual_mm,
                lateral_mm,
                depth_mm,
            } = r;
            write!(
                f,
                "\n  rejected {id}: off by {residual_mm:.2} mm ({lateral_mm:.2} across, {depth_mm:+.2} along the ray)"
            )?;
        }
        if self.rejected.len() > 10 {
            write!(f, "\n  and {} more", self.rejected.len() - 10)?;
        }
        self.notes.iter().try_for_each(|note| write!(f, "\nnote: {note}"))
    }
}

/// What fresh pairs say about a map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verification {
    /// The figure that decides: 95 % of the errors must be at most this, mm.
    pub limit_mm: f64,
    /// True if they are, and no point lies outside the calibrated volume.
    pub passed: bool,
    /// Points inside, at the edge of and outside the calibrated volume.
    pub inside: usize,
    /// Points at the edge of the calibrated volume.
    pub edge: usize,
    /// Points outside the calibrated volume.
    pub outside: usize,
    /// Probability that a map which is as good as its sigma says fails at these points all the same.
    pub false_alarm: f64,
    /// Visits without a marker.
    pub n_invalid: usize,
    /// Errors of the map at the fresh pairs (noise of the measurement included).
    pub figures: Figures,
    /// Share of error components within the stated sigma; 0.68 if sigma is right.
    pub within_one_sigma: f64,
    /// Share of error components within the stated 95 % interval.
    pub within_two_sigma: f64,
    /// Mean error in the base frame, mm: a bump of the camera shows here.
    pub mean_error_mm: [f64; 3],
    /// The worst pairs, worst first, at most ten.
    pub worst: Vec<Rejected>,
}

/// Checks a map against pairs that it was not fitted to: passes if 95 % of the 3D errors are at most `limit_mm` and no point is outside.
pub fn verify(map: &Map, pairs: &[Pair], limit_mm: f64) -> Verification {
    let mut hulls = [0usize; 3];
    let (mut errors, mut worst, mut beyond) = (Vec::new(), Vec::new(), Vec::new());
    let (mut within_one, mut within_two) = (0, 0);
    for pair in pairs.iter().filter(|p| p.valid) {
        let Some(camera) = pair.camera else { continue };
        let mapped = map.apply(camera);
        let error = mapped.base.vector() - pair.command.vector();
        let ray = map.ray(camera);
        let (lateral_mm, depth_mm) = crate::lattice::split(error, ray);
        let [one, two] = within(&mapped, lateral_mm, depth_mm);
        (within_one, within_two) = (within_one + one, within_two + two);
        hulls[mapped.hull as usize] += 1;
        beyond.push(beyond_limit(mapped.sigma_lateral_mm, mapped.sigma_depth_mm, limit_mm));
        errors.push((error, ray));
        worst.push(Rejected {
            id: pair.id,
            residual_mm: error.norm(),
            lateral_mm,
            depth_mm,
        });
    }
    worst.sort_by(|a, b| b.residual_mm.total_cmp(&a.residual_mm));
    worst.truncate(10);
    let n = errors.len().max(1) as f64;
    let figures = Figures::of(&errors);
    let outside = hulls[Hull::Outside as usize];
    Verification {
        limit_mm,
        passed: figures.n > 0 && outside == 0 && figures.total.p95_mm <= limit_mm,
        inside: hulls[Hull::Inside as usize],
        edge: hulls[Hull::Edge as usize],
        outside,
        false_alarm: more_than_a_twentieth(&beyond),
        n_invalid: pairs.iter().filter(|p| !p.valid).count(),
        figures,
        within_one_sigma: within_one as f64 / (2.0 * n),
        within_two_sigma: within_two as f64 / (2.0 * n),
        mean_error_mm: (errors.iter().map(|(e, _)| e).sum::<Vector3<f64>>() / n).into(),
        worst,
    }
}

/// How many of the two parts of an error, across the ray and along it, lie within one stated sigma, and within the stated 95 % interval.
pub(crate) fn within(mapped: &MappedPoint, lateral_mm: f64, depth_mm: f64) -> [usize; 2] {
    // the length of two components is within 1.515 sigma in 68.27 % of cases, within 2.448 sigma in 95 %
    [(1.5151, 1.0), (2.4477, 1.96)].map(|(across, along)| {
        usize::from(lateral_mm <= across * mapped.sigma_lateral_mm)
            + usize::from(depth_mm.abs() <= along * mapped.sigma_depth_mm)
    })
}

/// Errors of one rigid motion, such as another tool's hand-eye calibration, at pairs.
pub fn rigid_figures(base_from_camera: &Transform<Base, Camera>, pairs: &[Pair]) -> Figures {
    let seen = pairs
        .iter()
        .filter(|p| p.valid)
        .filter_map(|p| Some((p.command, p.camera?)));
    let rotation = base_from_camera.isometry().rotation;
    let errors: Vec<_> = seen
        .map(|(command, camera)| {
            let error = (*base_from_camera * camera).vector() - command.vector();
            (error, rotation * camera.vector().normalize())
        })
        .collect();
    Figures::of(&errors)
}

/// Probability that a 3D error with these sigmas (across the ray, along each axis; along it) is larger than a limit.
fn beyond_limit(lateral_mm: f64, depth_mm: f64, limit_mm: f64) -> f64 {
    const STEPS: usize = 400;
    const MOST: f64 = 6.0;
    let step = MOST / STEPS as f64;
    let at = |k: usize| {
        let z = (k as f64 + 0.5) * step;
        let room = limit_mm.powi(2) - (depth_mm * z).powi(2);
        // across the ray: the length of two normal components
        let across = if room > 0.0 {
            (-room / (2.0 * lateral_mm.max(1e-9).powi(2))).exp()
        } else {
            1.0
        };
        (-0.5 * z * z).exp() * across
    };
    (0..STEPS).map(at).sum::<f64>() * step * (2.0 / std::f64::consts::PI).sqrt()
}

/// Probability that so many of the errors are beyond the limit that less than 95 % are within.
fn more_than_a_twentieth(beyond: &[f64]) -> f64 {
    let n = beyond.len();
    let allowed = n - (0.95 * n as f64).ceil() as usize;
    // distribution of the number beyond: one error after the other
    let mut count = vec![0.0; n + 1];
    count[0] = 1.0;
    for (k, p) in beyond.iter().enumerate() {
        for m in (0..=k).rev() {
            count[m + 1] += count[m] * p;
            count[m] *= 1.0 - p;
        }
    }
    count[allowed + 1..].iter().sum()
}

impl fmt::Display for Verification {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            limit_mm,
            figures,
            inside,
            edge,
            outside,
            n_invalid,
            ..
        } = self;
        let p95 = figures.total.p95_mm;
        let verdict = match (figures.n, *outside) {
            (0, _) => "FAILED: no pair with a marker".to_string(),
            (_, 1..) => format!("FAILED: {outside} points lie outside the calibrated volume"),
            _ if self.passed => format!("passed: 95 % within {p95:.3} mm, limit {limit_mm:.3} mm"),
            _ => format!("FAILED: 95 % within {p95:.3} mm, limit {limit_mm:.3} mm"),
        };
        writeln!(f, "{verdict}")?;
        writeln!(
            f,
            "{} points ({inside} inside, {edge} edge, {outside} outside), {n_invalid} without marker",
            figures.n
        )?;
        writeln!(
            f,
            "a map as good as its sigma would fail here in {:.1} % of cases",
            100.0 * self.false_alarm
        )?;
        writeln!(f, "{figures}")?;
        let [x, y, z] = self.mean_error_mm;
        writeln!(f, "  mean error: {x:+.3}, {y:+.3}, {z:+.3} mm")?;
        write!(
            f,
            "  within the stated sigma: {:.0} % (68 % expected); within the 95 % interval: {:.0} %",
            100.0 * self.within_one_sigma,
            100.0 * self.within_two_sigma
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn false_alarms_come_as_often_as_stated() {
        // 20 points; one may be beyond
        let all_alike = [0.05; 20];
        let expected = 1.0 - 0.95f64.powi(20) - 20.0 * 0.05 * 0.95f64.powi(19);
        assert!((more_than_a_twentieth(&all_alike) - expected).abs() < 1e-12);
        assert_eq!(more_than_a_twentieth(&[]), 0.0);
        // Maxwell: 3D error of equal sigmas, 2.7955 sigma holds 95 %
        assert!((beyond_limit(0.1, 0.1, 0.279_55) - 0.05).abs() < 1e-4);
        // depth alone: a normal distribution
        assert!((beyond_limit(1e-6, 0.1, 0.196) - 0.05).abs() < 1e-3);
    }
}
