//! Finds drawn on their picture: ring, cross hair and score, coloured by verdict.

use image::{Rgb, RgbImage};

use crate::{Detections, Screw, Verdict};

/// Digits 0 to 9 and the point, five rows of three columns, the left column in bit 2.
const GLYPHS: [[u8; 5]; 11] = [
    [7, 5, 5, 5, 7],
    [2, 6, 2, 2, 7],
    [7, 1, 7, 4, 7],
    [7, 1, 7, 1, 7],
    [5, 5, 7, 1, 1],
    [7, 4, 7, 1, 7],
    [7, 4, 7, 5, 7],
    [7, 1, 1, 2, 2],
    [7, 5, 7, 5, 7],
    [7, 5, 7, 1, 7],
    [0, 0, 0, 0, 2],
];

/// The colour of a verdict: green to act on, orange to look at, blue for another drive.
pub fn verdict_color(verdict: Verdict) -> [u8; 3] {
    match verdict {
        Verdict::Screw => [40, 220, 60],
        Verdict::Review => [255, 150, 0],
        Verdict::Other => [60, 150, 255],
    }
}

/// The picture with its finds: a ring around the head, a cross hair open in the middle, the score beside it.
pub fn overlay(picture: &RgbImage, detections: &Detections) -> RgbImage {
    let mut out = picture.clone();
    for screw in &detections.screws {
        draw(&mut out, screw);
    }
    out
}

fn draw(out: &mut RgbImage, screw: &Screw) {
    let color = Rgb(verdict_color(screw.verdict));
    let (u, v) = (screw.pixel.u_px, screw.pixel.v_px);
    let radius = 0.5 * screw.diameter_px;
    if !(u.is_finite() && v.is_finite() && radius.is_finite()) {
        return;
    }
    let (ring, width) = (1.25 * radius + 2.0, (radius / 12.0).clamp(1.5, 6.0));
    let reach = (ring + width + 0.3 * radius).ceil() as i64;
    for y in v as i64 - reach..=v as i64 + reach {
        for x in u as i64 - reach..=u as i64 + reach {
            let (dx, dy) = (x as f64 - u, y as f64 - v);
            let r = dx.hypot(dy);
            let on_ring = width - (r - ring).abs() * 2.0;
            let hair = 1.2 - dx.abs().min(dy.abs()) * 2.0;
            let on_hair = if r > 0.45 * radius && r < 0.3 * radius + ring {
                hair
            } else {
                0.0
            };
            blend(out, x, y, color, on_ring.max(on_hair));
        }
    }
    let scale = (radius / 9.0).round().clamp(1.0, 8.0) as i64;
    let text = format!("{:.2}", screw.score);
    let (mut x, y) = ((u + ring + width) as i64 + 2, (v - ring) as i64);
    for character in text.chars() {
        let glyph = character.to_digit(10).map_or(GLYPHS[10], |d| GLYPHS[d as usize]);
        for (row, bits) in glyph.iter().enumerate() {
            for column in 0..3i64 {
                if bits >> (2 - column) & 1 == 1 {
                    for k in 0..scale * scale {
                        let (px, py) = (x + column * scale + k % scale, y + row as i64 * scale + k / scale);
                        blend(out, px, py, color, 1.0);
                    }
                }
            }
        }
        x += 4 * scale;
    }
}

/// Mixes a colour into a pixel, if it is one.
fn blend(out: &mut RgbImage, x: i64, y: i64, color: Rgb<u8>, share: f64) {
    let share = share.clamp(0.0, 1.0);
    if share == 0.0 || x < 0 || y < 0 || x >= i64::from(out.width()) || y >= i64::from(out.height()) {
        return;
    }
    let pixel = out.get_pixel_mut(x as u32, y as u32);
    for (to, from) in pixel.0.iter_mut().zip(color.0) {
        *to = (f64::from(*to) * (1.0 - share) + f64::from(from) * share).round() as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Drive, Timing};
    use geometry::Pixel;

    #[test]
    fn a_find_is_ringed_and_its_middle_left_open() {
        let at = |u, v| Screw {
            pixel: Pixel::new(u, v),
            sigma_px: 0.2,
            diameter_px: 30.0,
            score: 0.98,
            fits: 0.98,
            drive: Drive::Cross,
            verdict: Verdict::Screw,
            cues: vec![],
            angle_rad: None,
            camera: None,
            normal: None,
            top_normal: None,
            sigma_lateral_mm: None,
            sigma_depth_mm: None,
        };
        let picture = RgbImage::new(160, 120);
        let detections = Detections {
            doubts: Vec::new(),
            screws: vec![at(60.0, 60.0), at(159.0, 0.0), at(f64::NAN, 0.0), at(-500.0, 9000.0)],
            timing_ms: Timing::default(),
            model: String::new(),
            size_px: (160, 120),
        };
        let drawn = overlay(&picture, &detections);
        let green = verdict_color(Verdict::Screw);
        assert_eq!(drawn.get_pixel(60, 60).0, [0, 0, 0]);
        assert_eq!(drawn.get_pixel(60 + 21, 60).0, green);
        assert!(drawn.get_pixel(60, 60 - 10).0[1] > 100);
        let text = (84..130).flat_map(|x| (35..55).map(move |y| (x, y)));
        assert!(text.filter(|&(x, y)| drawn.get_pixel(x, y).0 == green).count() > 20);
    }
}
