//! After training: thresholds from costs, sigma factors from errors, on faces that no network has learned from.

use crate::face::{Shot, face_of, shot};
use geometry::Pixel;
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use nn::NnError;
use scene::Unit;
use serde::{Deserialize, Serialize};
use vision::layout::{Class, STRIDE};
use vision::{
    Corrections, CueCenter, Detector, Evidence, Model, Options, ProbabilityMap, RIM_TERMS, RimProfile, Screw, Settings,
    Thresholds, Verdict, candidates, coarse_map, cross, facings, look, outer_circle, parallax_px, relief,
};

/// Share of a normal distribution within one sigma.
const ONE_SIGMA: f64 = 0.6827;
/// Errors below which a factor is not measured.
const ENOUGH: usize = 20;
/// Faces that the cues' factors are measured on; more need not be held in memory at once.
const CUE_FACES: usize = 40;
/// A cue farther off than this has met something else, in head diameters.
const GROSS: f64 = 0.15;
/// Sigma of the outer circle against what it is on our own pictures: on path-traced plates kept apart, where light and shadow are another
/// renderer's, it is off by so much more than it says than the learned centre is (`docs/detection.md`).
const OUTLINE_ELSEWHERE: f64 = 2.0;
/// Scores below this are left out of the calibration: hundreds of candidates that are surely nothing would rule a curve that is there for
/// the doubtful ones.
const DOUBTFUL_FROM: f64 = 0.02;
/// Odds of stage 1's threshold in those of the least likely screw of the tuning faces, and the range it is kept to.
const COARSE_MARGIN: f32 = 0.2;
const COARSE_RANGE: [f32; 2] = [0.05, 0.5];
/// Cost of a screw that is not found, in units of one miss: its cover stays, and the face is looked at again or the unit fails.
const MISS: f64 = 1.0;
/// Cost of something taken for a screw: a burst of 2 s that meets nothing, the way to it, and perhaps a mark on a part that is scrap; a cover that
/// stays for a missed screw costs 35 s in the mean (simulated cell, 162 units). What is likelier something else than not is never acted on: that
/// alone asks for 0.4 beside what a look costs, and is more than the seconds say.
const FALSE_FIND: f64 = 0.4;
/// Cost of a look by a person; unattended, the head is left alone until its cover tells.
const LOOK: f64 = 0.2;

/// What was chosen, and by which figures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tuning {
    /// Limits between the verdicts.
    pub thresholds: Thresholds,
    /// Sigma factors and the scores' calibration.
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

/// Chooses thresholds, sigma factors and the scores' calibration on `faces` rendered faces from `first_seed` on.
///
/// # Errors
/// [`NnError`] where an engine from outside fails.
pub fn tune(model: &Model, first_seed: u64, faces: u64, done: &dyn Fn(u64)) -> Result<Tuning, NnError> {
    let mut shots = (first_seed..first_seed + faces).filter_map(|seed| {
        done(seed - first_seed + 1);
        shot(&Unit::sample(seed), face_of(seed), seed)
    });
    let kept: Vec<Shot> = shots.by_ref().take(CUE_FACES).collect();
    let mut corrections = Corrections::default();
    cue_factors(model, &kept, &mut corrections)?;
    // every candidate speaks, uncalibrated: what they say is what is calibrated
    let open = Settings {
        thresholds: Thresholds {
            accept: 0.001,
            review: 0.000_9,
            other: 0.999_99,
            ..model.settings.thresholds
        },
        corrections,
        ..Settings::default()
    };
    let detector = with(model, open);
    let (mut scores, mut unfound, mut screws) = (Vec::new(), 0, 0);
    let (mut centers, mut rims, mut peaks) = (Vec::new(), Vec::new(), Vec::new());
    for shot in kept.into_iter().chain(shots) {
        let found = detector.detect(&shot.frame, &Options::default()).screws;
        screws += shot.truth.screws.iter().filter(|s| s.detectable).count();
        let map = coarse_map(&model.coarse, &shot.frame.color)?;
        for truth in shot.truth.screws.iter().filter(|s| s.detectable) {
            peaks.push(peak(&map, truth.pixel, 0.4 * truth.head_d_px));
            let near = |s: &&Screw| s.pixel.distance_px(&truth.pixel) < 0.5 * truth.head_d_px;
            let finds = found.iter().filter(|s| s.verdict != Verdict::Other).filter(near);
            let Some(find) = finds.max_by(|a, b| a.score.total_cmp(&b.score)) else {
                unfound += 1;
                continue;
            };
            scores.push(Score::of(find, &shot, true));
            let error = errors(find.pixel, truth.pixel);
            centers.extend(error.map(|off_px| (off_px, find.sigma_px, scores.len() - 1)));
            let (Some(depth), Some(camera)) = (&shot.frame.depth, &shot.frame.camera) else {
                continue;
            };
            rims.extend(
                RimProfile::of(depth, camera, find.pixel, find.diameter_px).map(|profile| Rim {
                    height_mm: profile.sheet.depth_mm - truth.point.z_mm(),
                    profile,
                }),
            );
        }
        for find in found.iter().filter(|s| s.verdict != Verdict::Other) {
            let near = |s: &&scene::ScrewTruth| s.pixel.distance_px(&find.pixel) < 0.5 * s.head_d_px;
            if !shot.truth.screws.iter().any(|s| near(&s)) {
                scores.push(Score::of(find, &shot, false));
            }
        }
    }
    rim_heights(&rims, &mut corrections);
    corrections.score = calibration(&scores, corrections.score);
    let measured: Vec<Score> = scores.iter().copied().filter(|s| s.rise_mm.is_some()).collect();
    corrections.raised_score = calibration(&measured, corrections.raised_score);
    let scores: Vec<(f64, bool)> = scores
        .iter()
        .map(|s| (corrections.probability(s.said, s.rise_mm), s.real))
        .collect();
    let centers: Vec<(f64, f64, f64)> = centers
        .into_iter()
        .map(|(off_px, sigma_px, of)| (off_px, sigma_px, scores[of].0))
        .collect();
    corrections.center_sigma = center_sigma(&centers);
    // with scores that are probabilities, least expected cost is a matter of the costs alone
    let (accept, review) = (1.0 - LOOK / FALSE_FIND, LOOK / MISS);
    Ok(Tuning {
        thresholds: Thresholds {
            accept: accept as f32,
            review: review as f32,
            coarse: coarse_threshold(&peaks).unwrap_or(model.settings.thresholds.coarse),
            ..model.settings.thresholds
        },
        corrections,
        faces,
        screws,
        without_candidate: unfound,
        cost_a_face: (cost(&scores, accept, review) + MISS * unfound as f64) / faces.max(1) as f64,
    })
}

/// The second highest probability of stage 1's cells near a place: from two cells on there is a candidate.
fn peak(map: &ProbabilityMap, at: Pixel, reach_px: f64) -> f32 {
    let stride = STRIDE as f64;
    let cells = |c: f64, size: usize| {
        let low = ((c - reach_px) / stride).ceil().max(0.0) as usize;
        low..size.min((((c + reach_px) / stride).floor() + 1.0).max(0.0) as usize)
    };
    let mut highest = [0f32; 2];
    for y in cells(at.v_px, map.height) {
        for x in cells(at.u_px, map.width) {
            let p = map.probability[y * map.width + x];
            highest = [highest[0].max(p), highest[1].max(p.min(highest[0]))];
        }
    }
    highest[1]
}

/// Stage 1's threshold: well below what it says of the least likely screw, and never so high that it decides by itself.
fn coarse_threshold(peaks: &[f32]) -> Option<f32> {
    let least = peaks
        .iter()
        .copied()
        .reduce(f32::min)
        .filter(|_| peaks.len() >= ENOUGH)?;
    let odds = COARSE_MARGIN * least / (1.0 - least).max(1e-6);
    Some((odds / (1.0 + odds)).clamp(COARSE_RANGE[0], COARSE_RANGE[1]))
}

/// [`Corrections::center_sigma`] under which errors along an axis (error, sigma of the fused cues, px; score) are likeliest, as ones
/// with tails (Student's t, 4 degrees of freedom: a few gross ones do not rule), then scaled so
/// that the shares within it and within 1.96 of it are off alike from a normal distribution's.
fn center_sigma(errors: &[(f64, f64, f64)]) -> [f64; 3] {
    let start = Corrections::default().center_sigma;
    if errors.len() < ENOUGH {
        return start;
    }
    let mut weights = Vector3::from(start);
    let terms = |&(_, sigma_px, score): &(f64, f64, f64)| Vector3::from(Corrections::centre_terms(sigma_px, score));
    for _ in 0..50 {
        // Fisher scoring: the information of a t distribution's scale is 2 nu / (nu + 3)
        let (mut slope, mut information) = (Vector3::zeros(), Matrix3::identity() * 1e-3);
        for error in errors {
            let terms = terms(error);
            let square = (error.0 / weights.dot(&terms).exp()).powi(2);
            slope += (1.0 - 5.0 * square / (4.0 + square)) * terms;
            information += 8.0 / 7.0 * terms * terms.transpose();
        }
        let Some(inverse) = information.try_inverse() else {
            break;
        };
        weights -= (inverse * slope).map(|step| step.clamp(-0.5, 0.5));
    }
    // errors have longer tails than a normal distribution's: one sigma and 1.96 of it are to be off alike
    let ratio = |error: &(f64, f64, f64)| error.0 / weights.dot(&terms(error)).exp();
    let ratios: Vec<f64> = errors.iter().map(ratio).collect();
    let two_sigma = quantile(ratios.clone(), 0.95) / 1.96;
    weights.x += 0.5 * (one_sigma(ratios).ln() + two_sigma.max(0.1).ln());
    weights.into()
}

/// What the networks said of a find, and whether they were right.
#[derive(Clone, Copy)]
struct Score {
    said: f64,
    /// How far it rises above its sheet, mm.
    rise_mm: Option<f64>,
    real: bool,
}

impl Score {
    fn of(find: &Screw, shot: &Shot, real: bool) -> Self {
        let space = shot.frame.depth.as_ref().zip(shot.frame.camera.as_ref());
        let profile = space.and_then(|(depth, camera)| RimProfile::of(depth, camera, find.pixel, find.diameter_px));
        Self {
            said: find.score,
            rise_mm: profile.map(|profile| profile.rise_mm()),
            real,
        }
    }

    fn terms<const N: usize>(&self) -> SVector<f64, N> {
        let terms = Corrections::score_terms(self.said, self.rise_mm.unwrap_or(0.0));
        SVector::from_fn(|k, _| terms[k])
    }
}

/// A recess rim in the depth of a face.
struct Rim {
    profile: RimProfile,
    /// Its true height above the sheet as measured, mm.
    height_mm: f64,
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
fn one_sigma(ratios: Vec<f64>) -> f64 {
    if ratios.len() < ENOUGH {
        return 1.0;
    }
    quantile(ratios, ONE_SIGMA).clamp(0.1, 20.0)
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[(share * values.len() as f64) as usize]
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// A cue's centre on one screw.
struct CueError {
    /// Off the truth, px.
    off_px: [f64; 2],
    /// Where something one head diameter below the rim appears, from the rim, px.
    parallax_px: [f64; 2],
    diameter_px: f64,
    /// What the cue says of itself, px.
    sigma_px: f64,
}

/// Each cue alone against truth, from where a detection starts it.
fn cue_factors(model: &Model, shots: &[Shot], corrections: &mut Corrections) -> Result<(), NnError> {
    let mut cues: [Vec<CueError>; 4] = Default::default();
    for shot in shots {
        let picture = &shot.frame.color;
        let places: Vec<_> = candidates(&coarse_map(&model.coarse, picture)?, &model.settings.thresholds)
            .iter()
            .map(|c| c.pixel)
            .collect();
        let evidence = look(&model.fine, model.close.as_ref(), picture, &places)?;
        let at = |e: &Evidence| Pixel::new(e.center.u_px, e.center.v_px);
        let detectable = shot.truth.screws.iter().filter(|s| s.detectable);
        let found: Vec<_> = detectable
            .filter_map(|truth| {
                let near =
                    |e: &&Evidence| at(e).distance_px(&truth.pixel) < 0.5 * truth.head_d_px && e.of(Class::Cross) > 0.5;
                let finds = evidence.iter().filter(near);
                let find = finds.max_by(|a, b| a.of(Class::Cross).total_cmp(&b.of(Class::Cross)))?;
                Some((truth, find))
            })
            .collect();
        let heads: Vec<_> = found.iter().map(|(_, e)| (at(e), e.diameter_px)).collect();
        let (Some(depth), Some(camera)) = (&shot.frame.depth, &shot.frame.camera) else {
            continue;
        };
        for ((truth, find), normal) in found.iter().zip(facings(depth, camera, &heads)) {
            let (at, diameter_px) = (at(find), find.diameter_px);
            let parallax_px = normal.map_or([0.0; 2], |normal| parallax_px(camera, at, normal, diameter_px));
            let learned = CueCenter {
                pixel: at,
                sigma_px: find.sigma_px,
            };
            let circle = outer_circle(picture, at, diameter_px).map(|c| c.center);
            let crossed = cross(picture, at, diameter_px).map(|c| c.center);
            let profile = RimProfile::of(depth, camera, at, diameter_px);
            let raised = profile.and_then(|profile| relief(depth, &profile.sheet, at, diameter_px));
            for (errors, cue) in cues.iter_mut().zip([Some(learned), circle, crossed, raised]) {
                errors.extend(cue.map(|cue| CueError {
                    off_px: [cue.pixel.u_px - truth.pixel.u_px, cue.pixel.v_px - truth.pixel.v_px],
                    parallax_px,
                    diameter_px,
                    sigma_px: cue.sigma_px,
                }));
            }
        }
    }
    let [learned, circle, cross, relief] = cues.each_ref().map(|errors| below_rim(errors));
    corrections.below_rim = [learned, circle, cross];
    if cues[3].len() >= ENOUGH {
        corrections.relief_below_rim = relief;
    }
    let below = [learned, circle, cross, relief];
    // errors along the axes without the parallax, each with the centre that it is of
    let rests: [Vec<(f64, &CueError)>; 4] = std::array::from_fn(|cue| {
        let of = |e| [0, 1].map(|k| (off_axis_px(e, below[cue], k), e));
        cues[cue].iter().flat_map(of).collect()
    });
    let in_sigmas = |cue: usize| one_sigma(rests[cue].iter().map(|(off_px, e)| off_px / e.sigma_px).collect());
    (corrections.learned_sigma, corrections.cross_sigma) = (in_sigmas(0), in_sigmas(2));
    // what is seen best is still off by as much as recesses are eccentric; the rest by what it says beyond that
    let outlined = |cue: usize| {
        let half = median(cues[cue].iter().map(|e| e.sigma_px).collect());
        let (sure, others): (Vec<_>, Vec<_>) = rests[cue].iter().partition(|(_, e)| e.sigma_px <= half);
        if sure.len() < ENOUGH {
            return None;
        }
        let floor = quantile(
            sure.iter().map(|(off_px, e)| off_px / e.diameter_px).collect(),
            ONE_SIGMA,
        );
        let beyond = |(off_px, e): &(f64, &CueError)| {
            (off_px.powi(2) - (floor * e.diameter_px).powi(2)).max(0.0).sqrt() / e.sigma_px
        };
        Some([floor, one_sigma(others.iter().map(beyond).collect())])
    };
    if let Some(factors) = outlined(1) {
        [corrections.eccentricity, corrections.circle_sigma] = factors.map(|factor| OUTLINE_ELSEWHERE * factor);
    }
    if let Some(factors) = outlined(3) {
        [corrections.relief_floor, corrections.relief_sigma] = factors;
    }
    Ok(())
}

/// How far a cue is off along an axis, without the parallax of what lies so far below the rim, px.
fn off_axis_px(error: &CueError, below_rim: f64, axis: usize) -> f64 {
    (error.off_px[axis] - below_rim * error.parallax_px[axis]).abs()
}

/// Weights of what stereo measures around a recess, and how far the rim's true height is off what they give.
fn rim_heights(rims: &[Rim], corrections: &mut Corrections) {
    if rims.len() < ENOUGH {
        return;
    }
    let usual = SVector::<f64, RIM_TERMS>::from(corrections.rim_height);
    let mut weights = usual;
    let off = |rim: &Rim, weights: &SVector<f64, RIM_TERMS>| rim.height_mm - rim.profile.height_mm(&(*weights).into());
    for _ in 0..20 {
        let scale = 1.4826 * median(rims.iter().map(|rim| off(rim, &weights).abs()).collect());
        // what the heads leave open stays as usual
        let mut square = SMatrix::<f64, RIM_TERMS, RIM_TERMS>::identity();
        let mut right = usual;
        for rim in rims {
            // errors beyond twice the scale count linearly (Huber 1964)
            let weight = (2.0 * scale / off(rim, &weights).abs().max(1e-9)).min(1.0);
            let terms = SVector::from(rim.profile.terms);
            square += weight * terms * terms.transpose();
            right += weight * rim.height_mm * terms;
        }
        let Some(inverse) = square.try_inverse() else { return };
        weights = inverse * right;
    }
    let head_mm = |rim: &Rim| rim.profile.terms[RIM_TERMS - 1];
    let spread = |of: &dyn Fn(&Rim) -> f64| 1.4826 * median(rims.iter().map(|rim| of(rim).abs()).collect());
    corrections.rim_height = weights.into();
    corrections.rim_spread = spread(&|rim| off(rim, &weights) / head_mm(rim));
    let ratio = |rim: &Rim| off(rim, &weights).abs() / rim.profile.sigma_mm(corrections.rim_spread);
    corrections.depth_sigma = one_sigma(rims.iter().map(ratio).collect());
    let usual = median(rims.iter().map(|rim| rim.height_mm / head_mm(rim)).collect());
    corrections.usual_height = [usual, spread(&|rim| rim.height_mm / head_mm(rim) - usual)];
}

/// How far below the rim a cue rests, in head diameters: least squares over all but the gross errors.
fn below_rim(errors: &[CueError]) -> f64 {
    let fair = errors
        .iter()
        .filter(|e| e.off_px[0].hypot(e.off_px[1]) < GROSS * e.diameter_px);
    let sum = |of: &dyn Fn(&CueError) -> f64| fair.clone().map(of).sum::<f64>();
    let dot = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
    let square = sum(&|e| dot(e.parallax_px, e.parallax_px));
    if errors.len() < ENOUGH || square < 1e-9 {
        return 0.0;
    }
    sum(&|e| dot(e.off_px, e.parallax_px)) / square
}

/// [`Corrections::score`], or with five terms [`Corrections::raised_score`], by which the scores are likeliest, with targets that guard
/// against overconfidence (Platt 1999).
fn calibration<const N: usize>(scores: &[Score], start: [f64; N]) -> [f64; N] {
    let start = SVector::<f64, N>::from(start);
    let scores: Vec<_> = scores.iter().filter(|s| s.said >= DOUBTFUL_FROM).collect();
    let real = scores.iter().filter(|s| s.real).count() as f64;
    let not = scores.len() as f64 - real;
    if real < 10.0 || not < 10.0 {
        return start.into();
    }
    let targets = [1.0 / (not + 2.0), (real + 1.0) / (real + 2.0)];
    // a little weight on the slopes' staying where they are, none on the constant's
    let stay = SVector::<f64, N>::from_fn(|k, _| if k == 2 { 1e-6 } else { 0.1 });
    let mut curve = start;
    for _ in 0..100 {
        // Newton's step on the cross-entropy
        let (mut slope, mut bend) = (
            stay.component_mul(&(curve - start)),
            SMatrix::<f64, N, N>::from_diagonal(&stay),
        );
        for score in &scores {
            let terms = score.terms::<N>();
            let p = 1.0 / (1.0 + (-terms.dot(&curve)).exp());
            slope += (p - targets[usize::from(score.real)]) * terms;
            bend += (p * (1.0 - p)).max(1e-9) * terms * terms.transpose();
        }
        let Some(inverse) = bend.try_inverse() else { break };
        curve -= (inverse * slope).map(|step| step.clamp(-0.5, 0.5));
        // a higher score is never less probable
        (curve[0], curve[1]) = (curve[0].clamp(0.1, 4.0), curve[1].clamp(0.1, 4.0));
    }
    curve.into()
}

/// Cost of all candidates at thresholds: false ones accepted, true ones dropped, and looks in between.
fn cost(scores: &[(f64, bool)], accept: f64, review: f64) -> f64 {
    scores
        .iter()
        .map(|&(score, real)| match (score >= accept, score >= review, real) {
            (true, _, true) | (false, false, false) => 0.0,
            (true, _, false) => FALSE_FIND,
            (false, true, _) => LOOK,
            (false, false, true) => MISS,
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calibrated_scores_are_probabilities_and_thresholds_follow_the_costs() {
        // true odds of what a network says as p: steep where it says no, flat where it says yes, and heads rise while marks do not
        let truth = Corrections {
            score: [1.6, 0.7, 0.4],
            raised_score: [1.6, 0.7, -1.5, 1.9, -0.3],
            ..Corrections::default()
        };
        let samples = |rises_mm: &[Option<f64>]| -> Vec<Score> {
            let places = (1..80).flat_map(|k| rises_mm.iter().map(move |&rise_mm| (f64::from(k) / 80.0, rise_mm)));
            let scores = places.flat_map(|(said, rise_mm)| {
                let real = (2000.0 * truth.probability(said, rise_mm)).round() as usize;
                (0..2000).map(move |i| Score {
                    said,
                    rise_mm,
                    real: i < real,
                })
            });
            scores.collect()
        };
        let (flat, raised) = (samples(&[None]), samples(&[Some(0.0), Some(2.0), Some(3.5)]));
        let found = Corrections {
            score: calibration(&flat, Corrections::default().score),
            raised_score: calibration(&raised, Corrections::default().raised_score),
            ..Corrections::default()
        };
        let scores: Vec<_> = flat.iter().chain(&raised).collect();
        for score in &scores {
            let [is, should] = [found, truth].map(|c| c.probability(score.said, score.rise_mm));
            assert!(
                (is - should).abs() < 0.01,
                "{} {:?}: {is} for {should}",
                score.said,
                score.rise_mm
            );
        }
        let calibrated: Vec<(f64, bool)> = scores
            .iter()
            .map(|s| (found.probability(s.said, s.rise_mm), s.real))
            .collect();
        let (accept, review) = (1.0 - LOOK / FALSE_FIND, LOOK / MISS);
        let best = cost(&calibrated, accept, review);
        for off in [-0.1, 0.1] {
            assert!(cost(&calibrated, accept + off, review) > best);
            assert!(cost(&calibrated, accept, review + off) > best);
        }
    }

    #[test]
    fn sigma_of_centres_grows_with_doubt_as_their_errors_do() {
        // errors of a normal distribution, deciles, whose sigma is 1.5 times what the cues say, and four times that for doubtful finds
        let quantiles = [0.063, 0.189, 0.319, 0.454, 0.598, 0.755, 0.935, 1.15, 1.44, 1.96];
        let mut errors = Vec::new();
        for sigma in [0.2, 0.3, 0.5] {
            for (doubt, score) in [(1.0, 0.999), (4.0, 0.6)] {
                errors.extend(quantiles.map(|q| (q * 1.5 * doubt * sigma, sigma, score)));
            }
        }
        let corrections = Corrections {
            center_sigma: center_sigma(&errors),
            ..Corrections::default()
        };
        for (sigma, doubt, score) in [(0.25, 1.0, 0.999), (0.4, 4.0, 0.6)] {
            let (is, should) = (corrections.centre_px(sigma, score), 1.5 * doubt * sigma);
            assert!((is / should).ln().abs() < 0.15, "{is} for {should}");
        }
    }

    #[test]
    fn one_sigma_of_a_half_normal() {
        let ratios = (0..1000).map(|k| 2.0 * f64::from(k) / 1000.0 / 0.6827).collect();
        assert!((one_sigma(ratios) - 2.0).abs() < 0.01);
    }
}
