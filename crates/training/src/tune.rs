//! After training: thresholds from costs, sigma factors from errors, on faces that no network has learned from.

use geometry::{Pixel, RgbdFrame};
use scene::{FaceId, FaceTruth, FaceView, Prepared, Unit};
use serde::{Deserialize, Serialize};
use vision::{Corrections, Cue, Detector, Model, Options, Screw, Settings, Thresholds, Verdict, cross, outer_circle};

/// Cost of a screw that is not found, in units of one miss.
const MISS: f64 = 1.0;
/// Cost of something taken for a screw: the bit goes where it must not.
const FALSE_FIND: f64 = 3.0;
/// Cost of a look by a person: unattended, the unit is excluded for it.
const LOOK: f64 = 0.4;

/// What was chosen, and by which figures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tuning {
    /// Limits between the verdicts.
    pub thresholds: Thresholds,
    /// Sigma factors.
    pub corrections: Corrections,
    /// Faces.
    pub faces: u64,
    /// Detectable screws on them.
    pub screws: usize,
    /// Of these, without any candidate.
    pub without_candidate: usize,
    /// Expected cost a face at the chosen thresholds, in misses.
    pub cost_a_face: f64,
}

/// A face with what is on it.
struct Shot {
    frame: RgbdFrame,
    truth: FaceTruth,
}

/// The face that a seed stands for, rendered: also what evaluation uses.
fn shot(seed: u64) -> Option<Shot> {
    let unit = Unit::sample(seed);
    let view = FaceView::sample(&unit, FaceId::ALL[(seed % 5) as usize], seed)?;
    let prepared = Prepared::new(&view);
    let truth = prepared.truth();
    let picture = prepared.render(None);
    let frame = RgbdFrame {
        color: picture.color,
        depth: Some(picture.depth),
        camera: Some(view.camera),
        t_s: 0.0,
    };
    Some(Shot { frame, truth })
}

/// Chooses thresholds and sigma factors on `faces` rendered faces from `first_seed` on.
pub fn tune(model: &Model, first_seed: u64, faces: u64, done: &dyn Fn(u64)) -> Tuning {
    let shots: Vec<Shot> = (0..faces)
        .filter_map(|k| {
            let shot = shot(first_seed + k);
            done(k + 1);
            shot
        })
        .collect();
    let mut corrections = Corrections::default();
    cue_factors(model, &shots, &mut corrections);
    // every candidate speaks: thresholds come from what they say
    let open = Thresholds {
        accept: 0.005,
        review: 0.004,
        other: 0.999_99,
        ..model.settings.thresholds
    };
    let detector = with(
        model,
        Settings {
            thresholds: open,
            corrections,
            ..Settings::default()
        },
    );
    let (mut scores, mut unfound, mut screws) = (Vec::new(), 0, 0);
    let (mut ratios, mut depth_ratios) = (Vec::new(), Vec::new());
    for shot in &shots {
        let found = detector.detect(&shot.frame, &Options::default()).screws;
        screws += shot.truth.screws.iter().filter(|s| s.detectable).count();
        for truth in shot.truth.screws.iter().filter(|s| s.detectable) {
            let near = |s: &&Screw| s.pixel.distance_px(&truth.pixel) < 0.5 * truth.head_d_px;
            match found
                .iter()
                .filter(|s| s.verdict != Verdict::Other)
                .filter(near)
                .max_by(|a, b| a.score.total_cmp(&b.score))
            {
                Some(find) => {
                    scores.push((find.score, true));
                    let error = errors(find.pixel, truth.pixel);
                    ratios.extend(error.map(|e| e / find.sigma_px));
                    if let (Some(point), Some(sigma)) = (find.camera, find.sigma_depth_mm) {
                        depth_ratios.push((point.z_mm() - truth.point.z_mm()).abs() / sigma);
                    }
                }
                None => unfound += 1,
            }
        }
        for find in found.iter().filter(|s| s.verdict != Verdict::Other) {
            let near = |s: &&scene::ScrewTruth| s.pixel.distance_px(&find.pixel) < 0.5 * s.head_d_px;
            if !shot.truth.screws.iter().any(|s| near(&s)) {
                scores.push((find.score, false));
            }
        }
    }
    corrections.fused_sigma *= one_sigma(ratios);
    corrections.depth_sigma *= one_sigma(depth_ratios);
    let (accept, review, cost) = choose(&scores);
    Tuning {
        thresholds: Thresholds {
            accept: accept as f32,
            review: review as f32,
            ..model.settings.thresholds
        },
        corrections,
        faces,
        screws,
        without_candidate: unfound,
        cost_a_face: (cost + MISS * unfound as f64) / shots.len().max(1) as f64,
    }
}

fn with(model: &Model, settings: Settings) -> Detector {
    let mut model = model.clone();
    model.settings = settings;
    Detector::new(model)
}

fn errors(found: Pixel, truth: Pixel) -> [f64; 2] {
    [(found.u_px - truth.u_px).abs(), (found.v_px - truth.v_px).abs()]
}

/// The factor that brings 68.3 % of errors within one sigma.
fn one_sigma(mut ratios: Vec<f64>) -> f64 {
    if ratios.len() < 20 {
        return 1.0;
    }
    ratios.sort_by(f64::total_cmp);
    ratios[(0.6827 * ratios.len() as f64) as usize].clamp(0.2, 10.0)
}

/// Each cue alone against truth.
fn cue_factors(model: &Model, shots: &[Shot], corrections: &mut Corrections) {
    let detector = with(model, model.settings.clone());
    let (mut circles, mut crosses, mut learned) = (Vec::new(), Vec::new(), Vec::new());
    for shot in shots {
        let picture = &shot.frame.color;
        for find in detector.detect(&shot.frame, &Options::default()).screws {
            let near = |s: &&scene::ScrewTruth| s.detectable && s.pixel.distance_px(&find.pixel) < 0.5 * s.head_d_px;
            let Some(truth) = shot.truth.screws.iter().find(near) else {
                continue;
            };
            if let Some(c) = outer_circle(picture, find.pixel, find.diameter_px) {
                circles.extend(errors(c.center.pixel, truth.pixel).map(|e| e / c.center.sigma_px));
            }
            if let Some(c) = cross(picture, find.pixel, find.diameter_px) {
                crosses.extend(errors(c.center.pixel, truth.pixel).map(|e| e / c.center.sigma_px));
            }
            if find.cues == [Cue::Learned] {
                learned.extend(errors(find.pixel, truth.pixel).map(|e| e / find.sigma_px));
            }
        }
    }
    corrections.circle_sigma = one_sigma(circles);
    corrections.cross_sigma = one_sigma(crosses);
    corrections.learned_sigma = one_sigma(learned);
}

/// Thresholds of least cost over all candidates: accepted and false, dropped and true, and looks in between.
fn choose(scores: &[(f64, bool)]) -> (f64, f64, f64) {
    let grid: Vec<f64> = (-48..=48)
        .map(|k| 1.0 / (1.0 + (-0.125 * f64::from(k)).exp()))
        .collect();
    let mut best = (0.5, 0.3, f64::INFINITY);
    for (i, &accept) in grid.iter().enumerate().filter(|(_, a)| **a >= 0.3) {
        for &review in &grid[..=i] {
            let cost: f64 = scores
                .iter()
                .map(|&(score, real)| match (score >= accept, score >= review, real) {
                    (true, _, true) | (false, false, false) => 0.0,
                    (true, _, false) => FALSE_FIND,
                    (false, true, _) => LOOK,
                    (false, false, true) => MISS,
                })
                .sum();
            if cost < best.2 - 1e-9 {
                best = (accept, review, cost);
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_follow_the_costs() {
        // true screws at 0.9, decoys at 0.2, one doubtful pair in the middle: a look is cheaper than either mistake
        let mut scores = vec![(0.9, true); 50];
        scores.extend(vec![(0.2, false); 50]);
        scores.extend([(0.6, true), (0.6, false)]);
        let (accept, review, cost) = choose(&scores);
        assert!(
            accept > 0.6 && accept <= 0.9 && review <= 0.6 && review > 0.2,
            "{accept} {review}"
        );
        assert!((cost - 2.0 * LOOK).abs() < 1e-9);
    }

    #[test]
    fn one_sigma_of_a_half_normal() {
        let ratios = (0..1000).map(|k| 2.0 * f64::from(k) / 1000.0 / 0.6827).collect();
        assert!((one_sigma(ratios) - 2.0).abs() < 0.01);
    }
}
