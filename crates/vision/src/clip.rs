//! A clip of the picture around a candidate, and what the fine networks see of it.

use geometry::{Pixel, space};
use image::RgbImage;

use crate::layout::{CLIP_CENTER_PX, CLIP_PX, FINE_INPUT_CHANNELS, network_value};

/// Luminance (0 to 1, sRGB) that the gamma correction gives a clip's median.
const MEDIAN_LUMA: f64 = 0.45;
/// Half side of the square in which a pixel's contrast is measured, px: about a recess.
const CONTRAST_REACH_PX: usize = 9;
/// Contrast that is as good as none (of 2): noise is not to look like a recess.
const CONTRAST_FLOOR: f32 = 0.03;

/// A square of the picture around a candidate; outside the picture its border is repeated.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Place of the picture under clip pixel [`CLIP_CENTER_PX`].
    middle: [f64; 2],
    /// Picture pixels per clip pixel along each axis, negative where mirrored.
    step: [f64; 2],
    rgb: Vec<u8>,
}

impl Clip {
    /// Cuts a clip of [`CLIP_PX`] a side such that `center`, rounded, is its pixel [`CLIP_CENTER_PX`].
    pub fn cut(picture: &RgbImage, center: Pixel<space::Clip>) -> Self {
        Self::mirrored(picture, center, [1, 1])
    }

    /// As [`cut`](Self::cut), mirrored about that pixel along the axes whose sign is -1.
    pub(crate) fn mirrored(picture: &RgbImage, center: Pixel<space::Clip>, sign: [i64; 2]) -> Self {
        let middle = [center.u_px, center.v_px].map(|c| c.round() as i64);
        let (width, height) = (i64::from(picture.width()), i64::from(picture.height()));
        let mut rgb = Vec::with_capacity(CLIP_PX * CLIP_PX * 3);
        let raw = picture.as_raw();
        let source = |axis: usize, c: i64, size: i64| {
            (middle[axis] + sign[axis] * (c - CLIP_CENTER_PX as i64)).clamp(0, size - 1)
        };
        for y in 0..CLIP_PX as i64 {
            let v = source(1, y, height);
            for x in 0..CLIP_PX as i64 {
                let at = 3 * (v * width + source(0, x, width)) as usize;
                rgb.extend_from_slice(&raw[at..at + 3]);
            }
        }
        Self {
            middle: middle.map(|c| c as f64),
            step: sign.map(|s| s as f64),
            rgb,
        }
    }

    /// As [`mirrored`](Self::mirrored), enlarged by `scale` about `center`, between pixels (bilinear).
    pub(crate) fn enlarged(picture: &RgbImage, center: Pixel<space::Clip>, scale: f64, sign: [i64; 2]) -> Self {
        let middle = [center.u_px, center.v_px];
        let step = sign.map(|s| s as f64 / scale);
        let size = [picture.width(), picture.height()].map(|n| n as usize);
        // of the two pixels around each place of an axis, the first one's index, and the second one's share
        let between = |axis: usize| -> [(usize, f32); CLIP_PX] {
            let [last, most] = [size[axis].saturating_sub(2), size[axis].saturating_sub(1).min(1)].map(|n| n as f64);
            std::array::from_fn(|c| {
                let at = middle[axis] + step[axis] * (c as f64 - CLIP_CENTER_PX as f64);
                let first = at.floor().clamp(0.0, last);
                (first as usize, (at - first).clamp(0.0, most) as f32)
            })
        };
        let (columns, rows) = (between(0), between(1));
        let left = columns[0].0.min(columns[CLIP_PX - 1].0);
        let right = columns[0].0.max(columns[CLIP_PX - 1].0) + 2;
        let raw = picture.as_raw();
        let row = |v: usize| {
            let begin = v.min(size[1] - 1) * size[0];
            &raw[3 * (begin + left)..3 * (begin + right.min(size[0]))]
        };
        let mut between_rows = vec![0f32; 3 * (right - left)];
        let mut rgb = Vec::with_capacity(CLIP_PX * CLIP_PX * 3);
        for (v, down) in rows {
            for ((to, &top), &bottom) in between_rows.iter_mut().zip(row(v)).zip(row(v + 1)) {
                *to = f32::from(top) + down * (f32::from(bottom) - f32::from(top));
            }
            for (u, along) in columns {
                let pair = &between_rows[3 * (u - left)..][..6];
                rgb.extend([0, 1, 2].map(|c| (pair[c] + along * (pair[c + 3] - pair[c]) + 0.5) as u8));
            }
        }
        Self { middle, step, rgb }
    }

    /// Where a place of the picture lies in the clip.
    pub(crate) fn to_clip(&self, place: Pixel<space::Clip>) -> [f64; 2] {
        let along = |axis: usize, c: f64| CLIP_CENTER_PX as f64 + (c - self.middle[axis]) / self.step[axis];
        [along(0, place.u_px), along(1, place.v_px)]
    }

    /// Where a place of the clip lies in the picture.
    pub(crate) fn to_picture(&self, place: Pixel<space::Clip>) -> Pixel<space::Clip> {
        let along = |axis: usize, c: f64| self.middle[axis] + self.step[axis] * (c - CLIP_CENTER_PX as f64);
        Pixel::new(along(0, place.u_px), along(1, place.v_px))
    }

    /// The exponent that brings the clip's median luminance to 0.45, between 0.4 and 2.5.
    pub fn gamma(&self) -> f64 {
        let mut histogram = [0usize; 256];
        for pixel in self.rgb.chunks_exact(3) {
            let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(u32::from);
            histogram[((54 * r + 183 * g + 19 * b) >> 8) as usize] += 1;
        }
        let (mut below, mut median) = (0, 0);
        while below + histogram[median] <= CLIP_PX * CLIP_PX / 2 && median < 255 {
            below += histogram[median];
            median += 1;
        }
        let median = (median as f64 / 255.0).clamp(0.01, 0.99);
        (MEDIAN_LUMA.ln() / median.ln()).clamp(0.4, 2.5)
    }

    /// What the fine network sees, row by row: RGB, gamma corrected, -1 to 1, then the local contrast; `out` has [`CLIP_PX`]² x
    /// [`FINE_INPUT_CHANNELS`] values.
    pub fn network_input(&self, out: &mut [f32]) {
        let gamma = self.gamma();
        let table: [f32; 256] = std::array::from_fn(|v| {
            let corrected = 255.0 * (v as f64 / 255.0).powf(gamma);
            network_value(corrected.round() as u8)
        });
        let mut luma = Vec::with_capacity(CLIP_PX * CLIP_PX);
        for (to, from) in out.chunks_exact_mut(FINE_INPUT_CHANNELS).zip(self.rgb.chunks_exact(3)) {
            for (to, &from) in to.iter_mut().zip(from) {
                *to = table[usize::from(from)];
            }
            // as measured: the correction for a bright panel leaves nothing of a black head's recess
            let [r, g, b] = [from[0], from[1], from[2]].map(network_value);
            luma.push(0.3 * r + 0.6 * g + 0.1 * b);
        }
        let contrast = local_contrast(&luma);
        for (to, contrast) in out.chunks_exact_mut(FINE_INPUT_CHANNELS).zip(contrast) {
            to[3] = contrast;
        }
    }
}

/// How far each pixel's luminance, as measured, is from the mean of the pixels around it, in their standard deviations: a recess in a black head
/// looks as one in a bright head does.
fn local_contrast(luma: &[f32]) -> Vec<f32> {
    const SIDE: usize = CLIP_PX + 1;
    let mut sums = vec![[0f32; 2]; SIDE * SIDE]; // of luminance and its square, over all pixels above and to the left
    for y in 0..CLIP_PX {
        let mut row = [0f32; 2];
        for x in 0..CLIP_PX {
            let value = luma[y * CLIP_PX + x];
            row = [row[0] + value, row[1] + value * value];
            let above = sums[y * SIDE + x + 1];
            sums[(y + 1) * SIDE + x + 1] = [row[0] + above[0], row[1] + above[1]];
        }
    }
    let ends = |c: usize| {
        (
            c.saturating_sub(CONTRAST_REACH_PX),
            (c + CONTRAST_REACH_PX + 1).min(CLIP_PX),
        )
    };
    let pixels = (0..CLIP_PX * CLIP_PX).map(|i| (i / CLIP_PX, i % CLIP_PX));
    pixels
        .map(|(y, x)| {
            let ((top, bottom), (left, right)) = (ends(y), ends(x));
            let n = ((bottom - top) * (right - left)) as f32;
            let [mean, square] = [0, 1].map(|k| {
                let at = |y: usize, x: usize| sums[y * SIDE + x][k];
                (at(bottom, right) - at(top, right) - at(bottom, left) + at(top, left)) / n
            });
            let variance = (square - mean * mean).max(0.0);
            (luma[y * CLIP_PX + x] - mean) / (variance + CONTRAST_FLOOR * CONTRAST_FLOOR).sqrt()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mirrored_clip_shows_the_same_place() {
        let picture = RgbImage::from_fn(120, 100, |x, y| image::Rgb([x as u8, y as u8, 0]));
        let center = Pixel::new(61.4, 47.8);
        for sign in [[1, 1], [-1, 1], [1, -1], [-1, -1]] {
            let clip = Clip::mirrored(&picture, center, sign);
            let at = clip.to_clip(center);
            assert!((at[0] - 32.0).hypot(at[1] - 32.0) < 0.75);
            assert!(clip.to_picture(Pixel::new(at[0], at[1])).distance_px(&center) < 1e-9);
            for (x, y) in [(3, 5), (32, 32), (60, 11)] {
                let there = clip.to_picture(Pixel::new(f64::from(x), f64::from(y)));
                let at = 3 * (y as usize * CLIP_PX + x as usize);
                assert_eq!([clip.rgb[at], clip.rgb[at + 1]], [there.u_px as u8, there.v_px as u8]);
            }
        }
    }

    #[test]
    fn an_enlarged_clip_shows_the_same_place() {
        // two ramps: a pixel's colour tells where it is from
        let picture = RgbImage::from_fn(120, 100, |x, y| image::Rgb([2 * x as u8, 2 * y as u8, 0]));
        let center = Pixel::new(61.4, 47.8);
        for (scale, sign) in [(1.4, [1, 1]), (1.7, [-1, 1]), (0.9, [1, -1]), (2.3, [-1, -1])] {
            let clip = Clip::enlarged(&picture, center, scale, sign);
            assert_eq!(clip.to_clip(center), [CLIP_CENTER_PX as f64; 2]);
            for (x, y) in [(13i32, 15i32), (32, 32), (50, 21)] {
                let there = clip.to_picture(Pixel::new(f64::from(x), f64::from(y)));
                let along = f64::from(x - 32) / scale * sign[0] as f64;
                assert!((there.u_px - center.u_px - along).abs() < 1e-9, "{scale} {sign:?}");
                let at = 3 * (y as usize * CLIP_PX + x as usize);
                for (value, place) in [(clip.rgb[at], there.u_px), (clip.rgb[at + 1], there.v_px)] {
                    assert!(
                        (f64::from(value) - 2.0 * place).abs() <= 0.51,
                        "{scale} {sign:?}: {value} {place}"
                    );
                }
            }
        }
        let whole = Pixel::new(61.0, 47.0);
        assert_eq!(Clip::enlarged(&picture, whole, 1.0, [1, 1]), Clip::cut(&picture, whole));
        let corner = Clip::enlarged(&picture, Pixel::new(0.0, 99.0), 1.5, [1, 1]);
        assert_eq!(corner.rgb[3 * (63 * CLIP_PX)..][..3], [0, 198, 0]); // the border goes on
        for (width, height) in [(1, 1), (1, 9), (9, 1)] {
            let small = RgbImage::from_pixel(width, height, image::Rgb([7; 3]));
            let clip = Clip::enlarged(&small, Pixel::new(0.3, 0.0), 1.5, [1, -1]);
            assert!(clip.rgb.iter().all(|&value| value == 7));
        }
    }

    #[test]
    fn gamma_evens_out_dark_and_bright_clips() {
        let at = Pixel::new(40.0, 40.0);
        for (value, expected) in [(30u8, 0.4), (115, 1.0), (190, 2.5)] {
            let picture = RgbImage::from_pixel(80, 80, image::Rgb([value; 3]));
            let gamma = Clip::cut(&picture, at).gamma();
            assert!((gamma - expected).abs() < 0.05, "{value}: {gamma}");
        }
        let mut input = vec![0f32; CLIP_PX * CLIP_PX * FINE_INPUT_CHANNELS];
        Clip::cut(&RgbImage::from_pixel(80, 80, image::Rgb([60; 3])), at).network_input(&mut input);
        for pixel in input.chunks_exact(FINE_INPUT_CHANNELS) {
            assert!(
                pixel[..3].iter().all(|v| (v - (2.0 * 0.45 - 1.0)).abs() < 0.05) && pixel[3].abs() < 1e-3,
                "{pixel:?}"
            );
        }
    }

    #[test]
    fn the_recess_of_a_black_head_is_seen_as_that_of_a_bright_one() {
        // a bright panel, a head with a ring as recess, four levels or forty darker than the head
        let contrast = |head: u8, recess: u8| {
            let picture = RgbImage::from_fn(80, 80, |x, y| {
                let r = (f64::from(x) - 40.0).hypot(f64::from(y) - 40.0);
                image::Rgb(
                    [if r > 24.0 {
                        210
                    } else if (4.0..7.0).contains(&r) {
                        recess
                    } else {
                        head
                    }; 3],
                )
            });
            let mut input = vec![0f32; CLIP_PX * CLIP_PX * FINE_INPUT_CHANNELS];
            Clip::cut(&picture, Pixel::new(40.0, 40.0)).network_input(&mut input);
            let at = |x: usize| input[(CLIP_CENTER_PX * CLIP_PX + x) * FINE_INPUT_CHANNELS + 3];
            at(CLIP_CENTER_PX) - at(CLIP_CENTER_PX + 5)
        };
        let (bright, black, none) = (contrast(160, 120), contrast(20, 14), contrast(20, 20));
        assert!(
            bright > 1.5 && black > 0.4 * bright && none.abs() < 0.01,
            "{bright} {black} {none}"
        );
    }
}
