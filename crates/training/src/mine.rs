//! Hard examples: what half-trained networks fall for on whole faces of units that they have not seen.

use crate::face::{face_of, shot};
use crate::samples::{Classes, PATCH_PX, Patch, crop, labels, only};
use geometry::Pixel;
use nn::{Engine, NnError};
use scene::Unit;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use vision::layout::Class;
use vision::{Thresholds, candidates, coarse_map, look};

/// Something with a higher probability of a cross that is none was fallen for.
const FALLEN_FOR: f32 = 0.1;
/// A screw with a lower probability was as good as missed.
const MISSED: f32 = 0.5;

/// What went wrong at a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mistake {
    /// There is nothing.
    Nothing,
    /// There is a fastener of another drive, or a hole, rivet, cap or mark.
    Other,
    /// There is a screw, which scored low or had no candidate.
    Missed,
}

/// A line of the manifest: enough to look at the place again (`unscrew synth --seed`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mined {
    /// Seed of the unit and its view.
    pub seed: u64,
    /// Place in the picture, px.
    pub pixel: [f64; 2],
    /// Diameter there, px.
    pub diameter_px: f64,
    /// The networks' probability of a cross.
    pub cross: f32,
    /// What went wrong.
    pub mistake: Mistake,
}

/// Looks at one face of each unit with the networks, and cuts out a patch of each place where they are wrong.
///
/// # Errors
/// [`NnError`] where an engine from outside fails.
pub fn mine(
    coarse: &Engine,
    fine: &[Engine],
    seeds: Range<u64>,
    done: &dyn Fn(u64),
) -> Result<(Vec<Patch>, Vec<Mined>), NnError> {
    let (mut patches, mut manifest) = (Vec::new(), Vec::new());
    for seed in seeds.clone() {
        done(seed - seeds.start + 1);
        let Some(shot) = shot(&Unit::sample(seed), face_of(seed), seed) else {
            continue;
        };
        let picture = &shot.frame.color;
        if picture.width().min(picture.height()) < PATCH_PX as u32 {
            continue;
        }
        let all = labels(&shot.truth);
        let map = coarse_map(coarse, picture)?;
        let places: Vec<_> = candidates(&map, &Thresholds::default())
            .iter()
            .map(|c| c.pixel)
            .collect();
        let seen: Vec<(Pixel, f64, f32)> = look(fine, None, picture, &places)?
            .iter()
            .map(|e| {
                (
                    Pixel::new(e.center.u_px, e.center.v_px),
                    e.diameter_px,
                    e.of(Class::Cross),
                )
            })
            .collect();
        for (pixel, diameter_px, cross, mistake) in mistakes(&all, &seen) {
            let empty = (mistake == Mistake::Nothing).then_some((pixel, diameter_px, only(Class::Background)));
            let known: Vec<_> = all.iter().copied().chain(empty).collect();
            patches.push(crop(picture, &known, pixel, true));
            manifest.push(Mined {
                seed,
                pixel: [pixel.u_px, pixel.v_px],
                diameter_px,
                cross,
                mistake,
            });
        }
    }
    Ok((patches, manifest))
}

/// Where what was seen (place, diameter, probability of a cross) is not what is there.
fn mistakes(all: &[(Pixel, f64, Classes)], seen: &[(Pixel, f64, f32)]) -> Vec<(Pixel, f64, f32, Mistake)> {
    let mut wrong = Vec::new();
    for &(pixel, diameter_px, cross) in seen.iter().filter(|s| s.2 > FALLEN_FOR) {
        let here = all.iter().filter(|(p, d, _)| p.distance_px(&pixel) < 0.5 * d);
        match here.min_by(|a, b| a.0.distance_px(&pixel).total_cmp(&b.0.distance_px(&pixel))) {
            None => wrong.push((pixel, diameter_px, cross, Mistake::Nothing)),
            // what cannot be told is no mistake
            Some((_, _, 0)) => {}
            Some((p, d, classes)) if *classes != only(Class::Cross) => wrong.push((*p, *d, cross, Mistake::Other)),
            Some(_) => {}
        }
    }
    for (pixel, d, _) in all.iter().filter(|l| l.2 == only(Class::Cross)) {
        let finds = seen.iter().filter(|s| s.0.distance_px(pixel) < 0.5 * d);
        let cross = finds.map(|s| s.2).fold(0.0, f32::max);
        if cross < MISSED {
            wrong.push((*pixel, *d, cross, Mistake::Missed));
        }
    }
    wrong
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_mistakes_are_mined() {
        let at = |u: f64| Pixel::new(u, 50.0);
        let all = [
            (at(50.0), 24.0, only(Class::Cross)),
            (at(100.0), 24.0, only(Class::Cross)),
            (at(150.0), 24.0, only(Class::Torx)),
            (at(200.0), 24.0, 0),
            (at(250.0), 24.0, only(Class::OtherFeature)),
            (at(300.0), 24.0, only(Class::Cross)),
        ];
        let seen = [
            (at(51.0), 24.0, 0.9),   // right
            (at(99.0), 24.0, 0.2),   // low
            (at(152.0), 24.0, 0.4),  // fallen for
            (at(201.0), 24.0, 0.9),  // cannot be told
            (at(250.0), 24.0, 0.01), // right
            (at(400.0), 20.0, 0.3),  // nothing is there
        ];
        let wrong = mistakes(&all, &seen);
        let of = |mistake: Mistake| {
            let those = wrong.iter().filter(|w| w.3 == mistake);
            those.map(|w| w.0.u_px).collect::<Vec<_>>()
        };
        assert_eq!(of(Mistake::Nothing), [400.0]);
        assert_eq!(of(Mistake::Other), [150.0]);
        assert_eq!(of(Mistake::Missed), [100.0, 300.0]);
    }
}
