//! Anti-aliased screws with exactly known centres, for tests.

use geometry::Pixel;
use image::{Rgb, RgbImage};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Screw {
    pub at: Pixel,
    pub diameter_px: f64,
    pub angle_rad: f64,
    /// The recess is brighter than the head.
    pub bright: bool,
    /// One slot in place of a cross.
    pub slot: bool,
    /// Share of the width that something straight covers, from the left.
    pub hidden: f64,
    /// Standard deviation, 0 to 1.
    pub noise: f64,
    pub seed: u64,
}

impl Default for Screw {
    fn default() -> Self {
        Self {
            at: Pixel::new(0.0, 0.0),
            diameter_px: 30.0,
            angle_rad: 0.4,
            bright: false,
            slot: false,
            hidden: 0.0,
            noise: 0.0,
            seed: 0,
        }
    }
}

/// Draws the screws on a grey sheet, blurred as by a lens, noise as the first screw says.
pub(crate) fn draw(width: u32, height: u32, screws: &[Screw]) -> RgbImage {
    const SUB: u32 = 6;
    const BLUR_PX: f64 = 0.6;
    let offset = |k: u32| (f64::from(k) + 0.5) / f64::from(SUB) - 0.5;
    let mut random = screws.first().map_or(1, |s| s.seed.wrapping_mul(2) + 1);
    let mut value = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let mut sum = 0.0;
            for j in 0..SUB {
                for i in 0..SUB {
                    // Sub-samples spread over more than the pixel stand for the lens's blur.
                    let spread = 1.0 + 2.0 * BLUR_PX;
                    let (u, v) = (f64::from(x) + spread * offset(i), f64::from(y) + spread * offset(j));
                    sum += screws.iter().find_map(|s| shade(s, u, v)).unwrap_or(0.42);
                }
            }
            value.push(sum / f64::from(SUB * SUB));
        }
    }
    let noise = screws.first().map_or(0.0, |s| s.noise);
    let mut picture = RgbImage::new(width, height);
    for (pixel, value) in picture.pixels_mut().zip(value) {
        let noisy = value + noise * gaussian(&mut random);
        *pixel = Rgb([(255.0 * noisy).round() as u8; 3]);
    }
    picture
}

fn shade(screw: &Screw, u: f64, v: f64) -> Option<f64> {
    let (dx, dy) = (u - screw.at.u_px, v - screw.at.v_px);
    let r = screw.diameter_px / 2.0;
    if dx.hypot(dy) > r || dx < (2.0 * screw.hidden - 1.0) * r {
        return None;
    }
    let (sin, cos) = screw.angle_rad.sin_cos();
    let (a, b) = (dx * cos + dy * sin, dy * cos - dx * sin);
    let (long, short) = (0.56 * r, 0.13 * r);
    let wing = |a: f64, b: f64| a.abs() < long && b.abs() < short;
    let recess = wing(a, b) || (!screw.slot && wing(b, a));
    let (head, dark) = if screw.bright { (0.55, 0.85) } else { (0.75, 0.15) };
    // Light from the upper left makes a gradient over the head.
    Some(if recess {
        dark
    } else {
        head - 0.1 * (dx + dy) / screw.diameter_px
    })
}

/// Normal deviates from a small generator (xorshift, Irwin-Hall).
pub(crate) fn gaussian(state: &mut u64) -> f64 {
    (0..12)
        .map(|_| {
            *state ^= *state << 13;
            *state ^= *state >> 7;
            *state ^= *state << 17;
            (*state >> 11) as f64 / (1u64 << 53) as f64
        })
        .sum::<f64>()
        - 6.0
}
