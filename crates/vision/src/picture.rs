//! Pictures as the stages need them: row source for the networks, pyramid level, grey patch.

use std::borrow::Cow;
use std::ops::RangeInclusive;

use geometry::{Pixel, space};
use image::RgbImage;
use nn::RowSource;
use rayon::prelude::*;

use crate::layout::{TRAINED_HEAD_PX, network_value};

/// An 8-bit colour picture as the coarse network reads it.
pub(crate) struct Rows<'a>(pub &'a RgbImage);

impl RowSource for Rows<'_> {
    fn height(&self) -> usize {
        self.0.height() as usize
    }

    fn width(&self) -> usize {
        self.0.width() as usize
    }

    fn channels(&self) -> usize {
        3
    }

    fn row(&self, y: usize, out: &mut [f32]) {
        let row = 3 * self.0.width() as usize;
        for (to, &from) in out.iter_mut().zip(&self.0.as_raw()[y * row..]) {
            *to = network_value(from);
        }
    }

    fn bytes(&self, y: usize) -> Option<&[u8]> {
        let row = 3 * self.0.width() as usize;
        Some(&self.0.as_raw()[y * row..][..row])
    }
}

/// A picture at one scale of the pyramid, or a part of it.
pub(crate) struct Level<'a> {
    pub picture: Cow<'a, RgbImage>,
    /// Level pixels per image pixel.
    pub scale: f64,
    /// Image pixel on which level pixel (0, 0) is centred.
    origin: Pixel,
}

impl<'a> Level<'a> {
    /// The picture at that scale; `corner` is where its first pixel lies in the whole image.
    pub fn new(picture: Cow<'a, RgbImage>, corner: Pixel, scale: f64) -> Self {
        let half = 0.5 / scale - 0.5; // pixel areas stay aligned
        Self {
            picture: if scale == 1.0 {
                picture
            } else {
                Cow::Owned(resample(&picture, scale))
            },
            scale,
            origin: Pixel::new(corner.u_px + half, corner.v_px + half),
        }
    }

    pub fn to_image(&self, pixel: Pixel<space::Clip>) -> Pixel {
        pixel.to_image(self.origin, self.scale)
    }
}

/// The largest head of a level, px: within the trained band, but for what a guess of its size may be off.
const LARGEST_HEAD_PX: f64 = 0.95 * *TRAINED_HEAD_PX.end();

/// The scales at which every head of these diameters, px, falls into the band that the networks are trained for.
pub(crate) fn pyramid_scales(head_px: &RangeInclusive<f64>) -> Vec<f64> {
    let (smallest, largest) = (head_px.start().max(1.0), head_px.end().max(head_px.start().max(1.0)));
    if TRAINED_HEAD_PX.contains(&smallest) && TRAINED_HEAD_PX.contains(&largest) {
        return vec![1.0];
    }
    // An octave a level leaves a margin in the trained band: below, since the larger a head, the better it is judged.
    let levels = (largest / smallest).log2().ceil().max(1.0);
    let step = (largest / smallest).powf(1.0 / levels);
    (0..levels as usize)
        .map(|k| LARGEST_HEAD_PX / (smallest * step.powf(k as f64 + 1.0)))
        .collect()
}

/// Where the value of one output pixel comes from along one axis.
struct Taps {
    first: i64,
    weights: Vec<f32>,
}

/// Area averaging when shrinking, Catmull-Rom when enlarging, pixel areas aligned, exact scale.
pub(crate) fn resample(picture: &RgbImage, scale: f64) -> RgbImage {
    let size = |n: u32| ((f64::from(n) * scale).ceil() as u32).max(1);
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    if width == 0 || height == 0 {
        return picture.clone();
    }
    let (across, down) = (taps(size(picture.width()), scale), taps(size(picture.height()), scale));
    let raw = picture.as_raw();
    let row_bytes = 3 * across.len();
    let mut out = vec![0u8; row_bytes * down.len()];
    out.par_chunks_mut(row_bytes).zip(&down).for_each_init(
        || vec![0f32; 3 * width],
        |sum, (out, tap)| {
            sum.fill(0.0);
            for (k, weight) in tap.weights.iter().enumerate() {
                let y = (tap.first + k as i64).clamp(0, height as i64 - 1) as usize;
                for (to, &from) in sum.iter_mut().zip(&raw[3 * width * y..]) {
                    *to += weight * f32::from(from);
                }
            }
            for (pixel, tap) in out.chunks_exact_mut(3).zip(&across) {
                let mut value = [0.5f32; 3];
                for (k, weight) in tap.weights.iter().enumerate() {
                    let x = (tap.first + k as i64).clamp(0, width as i64 - 1) as usize;
                    for c in 0..3 {
                        value[c] += weight * sum[3 * x + c];
                    }
                }
                for c in 0..3 {
                    pixel[c] = value[c] as u8; // saturates
                }
            }
        },
    );
    RgbImage::from_raw(across.len() as u32, down.len() as u32, out).unwrap_or_else(|| picture.clone())
}

fn taps(outputs: u32, scale: f64) -> Vec<Taps> {
    (0..outputs)
        .map(|i| {
            let (low, high) = (f64::from(i) / scale, f64::from(i + 1) / scale);
            let (first, mut weights): (i64, Vec<f32>) = if scale < 1.0 {
                let first = low.floor() as i64;
                let cover = |k: i64| (high.min(k as f64 + 1.0) - low.max(k as f64)).max(0.0) as f32;
                (first, (first..=high.floor() as i64).map(cover).collect())
            } else {
                let at = 0.5 * (low + high) - 0.5;
                let first = at.floor() as i64 - 1;
                (first, (0..4).map(|k| catmull_rom(at - (first + k) as f64)).collect())
            };
            let sum: f32 = weights.iter().sum();
            weights.iter_mut().for_each(|w| *w /= sum);
            Taps { first, weights }
        })
        .collect()
}

fn catmull_rom(x: f64) -> f32 {
    let x = x.abs();
    let weight = if x < 1.0 {
        (1.5 * x - 2.5) * x * x + 1.0
    } else if x < 2.0 {
        ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    } else {
        0.0
    };
    weight as f32
}

/// A square of grey values, 0 to 1, around a place in an image; outside the image its border is repeated.
#[derive(Clone)]
pub(crate) struct Patch {
    pub side: usize,
    pub grey: Vec<f32>,
    /// Image pixel of the patch's pixel (0, 0).
    corner: [i64; 2],
}

impl Patch {
    /// Cuts the luma (Rec. 709) out of the picture.
    pub fn cut(picture: &RgbImage, center: Pixel, half: usize) -> Self {
        let luma = |[r, g, b]: [f32; 3]| (0.2126 * r + 0.7152 * g + 0.0722 * b) / 255.0;
        Self::cut_as(picture, center, half, luma)
    }

    /// Cuts a function of the colour (0 to 255) out of the picture.
    pub fn cut_as(picture: &RgbImage, center: Pixel, half: usize, grey_of: impl Fn([f32; 3]) -> f32) -> Self {
        let side = 2 * half + 1;
        let corner = [center.u_px, center.v_px].map(|c| c.round() as i64 - half as i64);
        let mut grey = Vec::with_capacity(side * side);
        let (width, height) = (i64::from(picture.width()), i64::from(picture.height()));
        for y in 0..side as i64 {
            let v = (corner[1] + y).clamp(0, height - 1) as u32;
            for x in 0..side as i64 {
                let u = (corner[0] + x).clamp(0, width - 1) as u32;
                grey.push(grey_of(picture.get_pixel(u, v).0.map(f32::from)));
            }
        }
        Self { side, grey, corner }
    }

    /// Histogram equalisation: every grey level becomes the share of pixels that are not brighter. The gain is limited to
    /// about 4, or else the noise of an even sheet would be blown up to full contrast.
    pub fn equalised(mut self) -> Self {
        const BINS: usize = 256;
        const MAX_GAIN: f32 = 4.0;
        let bin = |value: f32| ((value * (BINS - 1) as f32).round().max(0.0) as usize).min(BINS - 1);
        let mut share = [0f32; BINS];
        for &value in &self.grey {
            share[bin(value)] += 1.0 / self.grey.len() as f32;
        }
        // What is over the limit goes to all levels alike.
        let limit = MAX_GAIN / BINS as f32;
        let over: f32 = share.iter().map(|s| (s - limit).max(0.0)).sum();
        let mut sum = 0.0;
        for value in &mut share {
            let here = value.min(limit) + over / BINS as f32;
            *value = sum + 0.5 * here; // the middle of a level's ranks
            sum += here;
        }
        for value in &mut self.grey {
            // Between two levels, as the blurred patch has values between them.
            let level = *value * (BINS - 1) as f32;
            let low = (level.max(0.0) as usize).min(BINS - 2);
            let t = (level - low as f32).clamp(0.0, 1.0);
            *value = share[low] * (1.0 - t) + share[low + 1] * t;
        }
        self
    }

    /// Gaussian blur, separable, borders repeated.
    pub fn blurred(mut self, sigma_px: f64) -> Self {
        let reach = (3.0 * sigma_px).ceil() as i64;
        let mut kernel: Vec<f32> = (-reach..=reach)
            .map(|k| (-0.5 * (k as f64 / sigma_px).powi(2)).exp() as f32)
            .collect();
        let sum: f32 = kernel.iter().sum();
        kernel.iter_mut().for_each(|k| *k /= sum);
        let side = self.side as i64;
        for (step_x, step_y) in [(1, 0), (0, 1)] {
            let from = self.grey.clone();
            for y in 0..side {
                for x in 0..side {
                    let mut value = 0.0;
                    for (k, weight) in kernel.iter().enumerate() {
                        let k = k as i64 - reach;
                        let (x, y) = ((x + k * step_x).clamp(0, side - 1), (y + k * step_y).clamp(0, side - 1));
                        value += weight * from[(y * side + x) as usize];
                    }
                    self.grey[(y * side + x) as usize] = value;
                }
            }
        }
        self
    }

    /// Magnitude of the gradient (central differences).
    pub fn gradient(&self) -> Self {
        let last = self.side - 1;
        let at = |x: usize, y: usize| self.grey[y * self.side + x];
        let mut grey = Vec::with_capacity(self.grey.len());
        for y in 0..self.side {
            for x in 0..self.side {
                let dx = at((x + 1).min(last), y) - at(x.saturating_sub(1), y);
                let dy = at(x, (y + 1).min(last)) - at(x, y.saturating_sub(1));
                grey.push(0.5 * dx.hypot(dy));
            }
        }
        Self {
            side: self.side,
            grey,
            corner: self.corner,
        }
    }

    /// Bilinear, in the patch's own pixels.
    #[inline]
    pub fn sample(&self, x: f64, y: f64) -> f32 {
        let limit = self.side as f64 - 1.001;
        let (x, y) = (x.clamp(0.0, limit), y.clamp(0.0, limit));
        let (ix, iy) = (x as usize, y as usize);
        let (fx, fy) = ((x - ix as f64) as f32, (y - iy as f64) as f32);
        let i = iy * self.side + ix;
        let top = self.grey[i] + fx * (self.grey[i + 1] - self.grey[i]);
        let bottom = self.grey[i + self.side] + fx * (self.grey[i + self.side + 1] - self.grey[i + self.side]);
        top + fy * (bottom - top)
    }

    /// The patch's own coordinates of an image pixel.
    pub fn local(&self, pixel: Pixel) -> [f64; 2] {
        [pixel.u_px - self.corner[0] as f64, pixel.v_px - self.corner[1] as f64]
    }

    /// The image pixel at the patch's own coordinates.
    pub fn to_image(&self, [x, y]: [f64; 2]) -> Pixel {
        Pixel::new(x + self.corner[0] as f64, y + self.corner[1] as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_head_falls_into_the_trained_band_at_some_scale() {
        assert_eq!(pyramid_scales(&(20.0..=40.0)), [1.0]);
        for range in [15.0..=80.0, 5.0..=9.0, 60.0..=61.0, 100.0..=100.0, 10.0..=400.0] {
            let scales = pyramid_scales(&range);
            let (mut head, end) = (*range.start(), *range.end());
            while head <= end {
                assert!(
                    scales.iter().any(|s| TRAINED_HEAD_PX.contains(&(head * s))),
                    "{head} of {range:?}: {scales:?}"
                );
                head += 0.5;
            }
        }
        assert_eq!(pyramid_scales(&(15.0..=80.0)).len(), 3);
        assert!(pyramid_scales(&(0.0..=f64::MIN_POSITIVE)).iter().all(|s| s.is_finite()));
    }

    #[test]
    fn resampling_keeps_places_and_mean() {
        // A ramp: the value at an image pixel must be found at the mapped level pixel.
        let ramp = RgbImage::from_fn(90, 60, |x, y| image::Rgb([40 + x as u8 + y as u8, x as u8 * 2, 7]));
        for scale in [0.31, 0.5, 1.7] {
            let level = Level::new(Cow::Borrowed(&ramp), Pixel::new(0.0, 0.0), scale);
            for at in [[10u32, 9], [14, 12]] {
                let pixel = level.to_image(Pixel::new(f64::from(at[0]), f64::from(at[1])));
                let found = level.picture.get_pixel(at[0], at[1]).0;
                assert!(
                    (f64::from(found[0]) - (40.0 + pixel.u_px + pixel.v_px)).abs() < 1.01,
                    "{scale}: {found:?}"
                );
                assert!((f64::from(found[1]) - 2.0 * pixel.u_px).abs() < 1.01 && found[2] == 7);
            }
        }
    }

    #[test]
    fn equalising_spreads_the_grey_levels() {
        let dim = RgbImage::from_fn(41, 41, |x, _| image::Rgb([100 + x as u8; 3]));
        let patch = Patch::cut(&dim, Pixel::new(20.0, 20.0), 20).equalised();
        let (low, high) = (patch.sample(0.0, 20.0), patch.sample(40.0, 20.0));
        let gain = (high - low) * 255.0 / 40.0;
        assert!((3.5..5.0).contains(&gain), "{gain}");
    }
}
