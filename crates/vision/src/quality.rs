//! Whether a picture can be trusted at all: how wide its sharpest edges are, and how much of it is white or black beyond telling.

use std::fmt;
use std::ops::RangeInclusive;

use image::RgbImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::Region;

/// Every so many rows and columns are looked at, and fewer where more than so many would be.
const LINE_STEP: u32 = 12;
const MOST_LINES: u32 = 125;
/// Widths of the two derivatives of Gaussians that an edge is measured with, px.
const FILTERS_PX: [f64; 2] = [1.0, 3.0];
/// Taps on each side of the wider filter.
const REACH: usize = 9;
/// Grey levels that an edge rises by, at least: noise rises less.
const RISE: f64 = 28.0;
/// Edges that must be there in a direction: fewer do not tell.
const EDGES: usize = 60;
/// Share of the edges that are sharper than the one that counts: most edges of a sharp picture are not sharp.
const SHARPEST: f64 = 0.15;
/// Blur from which recesses are not to be seen any more, in diameters of the head in the middle of those looked for: of 20 screws of
/// four rendered faces, heads of about 28 px, 18 are found with 1.5 px added, 6 with 2 px, none with 2.5 px.
const BLUR_LIMIT: f64 = 0.054;
/// Levels from which a pixel is white, up to which it is black, beyond telling.
const WHITE: u8 = 252;
const BLACK: u8 = 6;
/// Share of a picture that may be white or black beyond telling.
const CLIPPED_LIMIT: f64 = 0.6;

/// Why nothing in a picture is to be acted on: a person should look at it, or take another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "why")]
pub enum Doubt {
    /// Even its sharpest edges are blurred.
    Blurred {
        /// Their standard deviation, px.
        sigma_px: f64,
        /// What would do for the heads looked for, px.
        limit_px: f64,
    },
    /// Most of it is white beyond telling.
    OverExposed {
        /// Share of its pixels, 0 to 1.
        share: f64,
    },
    /// Most of it is black beyond telling.
    UnderExposed {
        /// Share of its pixels, 0 to 1.
        share: f64,
    },
    /// The networks could not be run on it: what is listed is not all.
    NotSeen {
        /// What their engine says.
        reason: String,
    },
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Doubt::Blurred { sigma_px, limit_px } => write!(
                f,
                "too blurred to be trusted: its sharpest edges are blurred by {sigma_px:.1} px ({limit_px:.1} would do); focus, or take it again"
            ),
            Doubt::OverExposed { share } => write!(
                f,
                "too bright to be trusted: {:.0} % of it is white beyond telling; expose it less",
                100.0 * share
            ),
            Doubt::UnderExposed { share } => write!(
                f,
                "too dark to be trusted: {:.0} % of it is black beyond telling; expose it more",
                100.0 * share
            ),
            Doubt::NotSeen { reason } => write!(f, "not looked at: {reason}"),
        }
    }
}

/// What speaks against trusting a part of a picture in which heads of some diameters are looked for; nothing where it has too few
/// edges to tell.
pub fn doubts(picture: &RgbImage, region: Region, head_px: &RangeInclusive<f64>) -> Vec<Doubt> {
    let lines = Lines::of(picture, region);
    let mut doubts = Vec::new();
    let limit_px = BLUR_LIMIT * (head_px.start() * head_px.end()).sqrt();
    if let Some(sigma_px) = lines.blur_px().filter(|s| *s > limit_px) {
        doubts.push(Doubt::Blurred { sigma_px, limit_px });
    }
    let [white, black] = lines.clipped();
    if white > CLIPPED_LIMIT {
        doubts.push(Doubt::OverExposed { share: white });
    }
    if black > CLIPPED_LIMIT {
        doubts.push(Doubt::UnderExposed { share: black });
    }
    doubts
}

/// Rows and columns of a picture, as the lowest and the highest value of the colours of each pixel.
struct Lines {
    rows: Vec<Vec<[u8; 2]>>,
    columns: Vec<Vec<[u8; 2]>>,
}

impl Lines {
    fn of(picture: &RgbImage, region: Region) -> Self {
        let (right, bottom) = (
            region.u_px.saturating_add(region.width_px).min(picture.width()),
            region.v_px.saturating_add(region.height_px).min(picture.height()),
        );
        let value = |u: u32, v: u32| {
            let [r, g, b] = picture.get_pixel(u, v).0;
            [r.min(g).min(b), r.max(g).max(b)]
        };
        let (us, vs) = (region.u_px..right, region.v_px..bottom);
        let every = |range: std::ops::Range<u32>| {
            let step = (range.len() as u32 / MOST_LINES).max(LINE_STEP) as usize;
            range.skip(step / 2).step_by(step)
        };
        Self {
            rows: every(vs.clone())
                .map(|v| us.clone().map(|u| value(u, v)).collect())
                .collect(),
            columns: every(us).map(|u| vs.clone().map(|v| value(u, v)).collect()).collect(),
        }
    }

    /// Standard deviation of the blur of the sharpest edges, px, in the direction where it is larger.
    fn blur_px(&self) -> Option<f64> {
        [&self.rows, &self.columns]
            .into_iter()
            .filter_map(|lines| {
                let mut widths: Vec<f64> = lines.par_iter().flat_map_iter(|line| edge_widths(line)).collect();
                let at = (SHARPEST * widths.len() as f64) as usize;
                (widths.len() >= EDGES).then(|| *widths.select_nth_unstable_by(at, f64::total_cmp).1)
            })
            .reduce(f64::max)
    }

    /// Shares of the pixels that are white, and black, beyond telling.
    fn clipped(&self) -> [f64; 2] {
        let all = self.rows.iter().flatten();
        let (mut n, mut white, mut black) = (0u32, 0u32, 0u32);
        for [low, high] in all {
            n += 1;
            white += u32::from(*low >= WHITE);
            black += u32::from(*high <= BLACK);
        }
        [white, black].map(|k| f64::from(k) / f64::from(n.max(1)))
    }
}

/// Blur of each edge along a line: a step blurred by `s` answers derivatives of Gaussians of widths `a` and `b` as
/// sqrt(s² + b²) to sqrt(s² + a²) (Zhuo and Sim, 2011).
fn edge_widths(line: &[[u8; 2]]) -> Vec<f64> {
    let grey: Vec<f32> = line
        .iter()
        .map(|[low, high]| 0.5 * (f32::from(*low) + f32::from(*high)))
        .collect();
    let [narrow, wide] = FILTERS_PX.map(|sigma| derivative(&grey, sigma));
    let [a2, b2] = FILTERS_PX.map(|s| s * s);
    let mut widths = Vec::new();
    for i in REACH + 1..grey.len().saturating_sub(REACH + 1) {
        let here = narrow[i].abs();
        if here <= narrow[i - 1].abs() || here < narrow[i + 1].abs() || narrow[i] * wide[i] <= 0.0 {
            continue;
        }
        let ratio2 = (f64::from(here) / f64::from(wide[i].abs())).powi(2);
        if ratio2 <= 1.0 + 1e-3 {
            continue; // wider than can be told, or part of something else
        }
        let s2 = ((b2 - ratio2 * a2) / (ratio2 - 1.0)).max(0.0);
        let rise = f64::from(here) * (std::f64::consts::TAU * (s2 + a2)).sqrt();
        if rise >= RISE {
            widths.push(s2.sqrt());
        }
    }
    widths
}

/// A line through the derivative of a Gaussian; zero at its ends.
fn derivative(line: &[f32], sigma: f64) -> Vec<f32> {
    let kernel: Vec<f32> = (1..=REACH)
        .map(|k| {
            let x = k as f64 / sigma;
            (x * (-0.5 * x * x).exp() / (sigma * sigma * std::f64::consts::TAU.sqrt())) as f32
        })
        .collect();
    let mut out = vec![0f32; line.len()];
    for i in REACH..line.len().saturating_sub(REACH) {
        out[i] = kernel
            .iter()
            .enumerate()
            .map(|(k, w)| w * (line[i + k + 1] - line[i - k - 1]))
            .sum();
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADS: RangeInclusive<f64> = 20.0..=40.0;

    /// Dark and bright stripes, slanted, with edges blurred by `sigma_px`.
    fn stripes(sigma_px: f64) -> RgbImage {
        RgbImage::from_fn(600, 600, |u, v| {
            let across = (f64::from(u) + f64::from(v)) / std::f64::consts::SQRT_2;
            // logistic step, nearly that of a Gaussian of the same spread
            let edge = |at: f64| 1.0 / (1.0 + (-(at) * 1.702 / sigma_px.max(0.05)).exp());
            let phase = across.rem_euclid(80.0);
            let level = 60.0 + 120.0 * (edge(phase - 20.0) - edge(phase - 60.0));
            image::Rgb([level as u8; 3])
        })
    }

    fn whole(picture: &RgbImage) -> Region {
        Region {
            u_px: 0,
            v_px: 0,
            width_px: picture.width(),
            height_px: picture.height(),
        }
    }

    #[test]
    fn blur_is_measured_and_said() {
        for sigma_px in [0.6, 1.0, 2.2, 3.0, 4.0] {
            let picture = stripes(sigma_px);
            // across a slanted edge a line is longer
            let along_lines = sigma_px * std::f64::consts::SQRT_2;
            let measured = Lines::of(&picture, whole(&picture)).blur_px().expect("edges");
            assert!(
                (measured - along_lines).abs() < 0.2 * along_lines + 0.25,
                "{sigma_px}: {measured}"
            );
            let said = doubts(&picture, whole(&picture), &HEADS);
            assert_eq!(!said.is_empty(), sigma_px > 1.5, "{sigma_px}: {said:?}");
        }
        let text = doubts(&stripes(3.0), whole(&stripes(3.0)), &HEADS)[0].to_string();
        assert!(text.starts_with("too blurred to be trusted"), "{text}");
    }

    #[test]
    fn nothing_to_go_by_is_no_doubt_but_white_and_black_are() {
        let flat = |level| RgbImage::from_pixel(300, 200, image::Rgb([level; 3]));
        assert_eq!(doubts(&flat(120), whole(&flat(120)), &HEADS), []);
        assert!(
            matches!(doubts(&flat(255), whole(&flat(255)), &HEADS)[..], [Doubt::OverExposed { share }] if share == 1.0)
        );
        assert!(
            matches!(doubts(&flat(2), whole(&flat(2)), &HEADS)[..], [Doubt::UnderExposed { share }] if share == 1.0)
        );
        let outside = Region {
            u_px: 400,
            ..whole(&flat(255))
        };
        assert_eq!(doubts(&flat(255), outside, &HEADS), []);
    }
}
