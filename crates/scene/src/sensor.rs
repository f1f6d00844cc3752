//! From light to file: lens blur, exposure, mosaic, noise, tone, compression; and the depth camera.
//!
//! Every pixel depends on its own place in the whole picture only, so that a region has the pixels of the whole.

use crate::render::{BLOCK, Block, Prepared, Rendered};
use crate::shape::nearest;
use crate::view::Roi;
use geometry::{DepthMap, RgbImage};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use std::collections::VecDeque;

/// Settings of one exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// Factor on the light: a white sheet square to the light reaches this share of full scale.
    pub exposure: f32,
    /// Blur of lens and focus in the middle of the picture, px (one standard deviation).
    pub blur_px: f32,
    /// How much more blur there is in the corners, as a factor less one.
    pub corner_blur: f32,
    /// Sideways spread of red and blue against green, per unit of image radius.
    pub chromatic: [f32; 2],
    /// Loss of light in the corners, 0 to 1.
    pub vignetting: f32,
    /// Electrons at full scale: fewer is noisier.
    pub full_well: f32,
    /// Noise of the read-out, electrons.
    pub read_noise: f32,
    /// What the white balance gets wrong: factors on red, green and blue.
    pub white_balance: [f32; 3],
    /// Saturation of colours, 1 true.
    pub saturation: f32,
    /// Contrast of the tone curve, 0 none.
    pub contrast: f32,
    /// Sharpening in the camera, 0 none.
    pub sharpening: f32,
    /// Quality of the JPEG that the camera hands over; `None`: not compressed.
    pub jpeg_quality: Option<u8>,
    /// Depth noise at 1.5 m, mm.
    pub depth_noise_mm: f32,
    /// Slowly varying error of the depth camera, mm.
    pub depth_bias_mm: f32,
    /// Half side of stereo's matching window, in its own pixels: all that it sees counts as one depth.
    pub depth_window_px: i64,
    /// Seed of that error: belongs to the camera, not to the exposure.
    pub depth_seed: u64,
    /// Seed of this exposure's noise.
    pub noise_seed: u64,
}

impl Sensor {
    /// Settings as a cell's camera may have them.
    pub fn sample(seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let sharp = rng.random_bool(0.7);
        Self {
            exposure: (0.6f32.ln() + rng.random::<f32>() * (1.25f32 / 0.6).ln()).exp(),
            blur_px: if sharp {
                rng.random_range(0.45..0.8)
            } else {
                rng.random_range(0.8..1.3)
            },
            corner_blur: rng.random_range(0.05..0.45),
            chromatic: [rng.random_range(-1.6e-4..1.6e-4), rng.random_range(-1.6e-4..1.6e-4)],
            vignetting: rng.random_range(0.05..0.35),
            full_well: rng.random_range(3500.0..11_000.0),
            read_noise: rng.random_range(2.5..9.0),
            white_balance: [rng.random_range(0.93..1.08), 1.0, rng.random_range(0.9..1.1)],
            saturation: rng.random_range(0.8..1.15),
            contrast: rng.random_range(0.0..0.35),
            sharpening: rng.random_range(0.0..0.8),
            jpeg_quality: Some(rng.random_range(80..=97)),
            depth_noise_mm: 0.28,
            depth_bias_mm: rng.random_range(0.1..0.35),
            depth_seed: rng.random(),
            noise_seed: rng.random(),
            depth_window_px: rng.random_range(0..=3),
        }
    }
}

/// A well-mixed 64-bit value from a place.
#[inline]
fn hash(seed: u64, x: i64, y: i64) -> u64 {
    let mut z = seed ^ (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A normal deviate from 64 random bits: sum of four uniform ones.
#[inline]
fn normal(bits: u64) -> f32 {
    let part = |k: u32| ((bits >> k) & 0xffff) as f32;
    // variance of a uniform 16-bit value is 65536²/12
    (part(0) + part(16) + part(32) + part(48) - 2.0 * 65535.0) * (1.0 / 37_837.0)
}

#[inline]
fn share(bits: u64) -> f32 {
    (bits >> 40) as f32 / 16_777_216.0
}

/// Taps to either side of the blur's middle.
const TAPS: usize = 4;
const WIDTHS: usize = 24;
const SHIFTS: usize = 17;

/// Blur kernels for every width and sideways shift.
struct Kernels {
    table: Vec<[f32; 2 * TAPS + 1]>,
    low: f32,
    step: f32,
}

impl Kernels {
    fn new(low: f32, high: f32) -> Self {
        let step = ((high - low) / (WIDTHS - 1) as f32).max(1e-4);
        let table = (0..WIDTHS * SHIFTS)
            .map(|k| {
                let sigma = low + step * (k / SHIFTS) as f32;
                let shift = ((k % SHIFTS) as f32 - (SHIFTS / 2) as f32) / 16.0;
                let mut taps: [f32; 2 * TAPS + 1] = std::array::from_fn(|t| {
                    let d = t as f32 - TAPS as f32 - shift;
                    (-0.5 * d * d / (sigma * sigma)).exp()
                });
                let sum: f32 = taps.iter().sum();
                taps.iter_mut().for_each(|t| *t /= sum);
                taps
            })
            .collect();
        Self { table, low, step }
    }

    #[inline]
    fn get(&self, sigma: f32, shift: f32) -> &[f32; 2 * TAPS + 1] {
        let width = (((sigma - self.low) / self.step + 0.5) as usize).min(WIDTHS - 1);
        let shift = (shift * 16.0 + (SHIFTS / 2) as f32 + 0.5).clamp(0.0, (SHIFTS - 1) as f32) as usize;
        &self.table[width * SHIFTS + shift]
    }
}

/// Blocks of the picture, kept only while a band needs them.
struct Store<'a> {
    prepared: &'a Prepared,
    first_column: i64,
    columns: usize,
    first_row: i64,
    rows: VecDeque<Vec<Block>>,
}

impl<'a> Store<'a> {
    /// For the pixel columns from `x0` up to but not including `x1`.
    fn new(prepared: &'a Prepared, x0: i64, x1: i64) -> Self {
        let side = BLOCK as i64;
        let first_column = x0.div_euclid(side);
        Self {
            prepared,
            first_column,
            columns: ((x1 - 1).div_euclid(side) - first_column + 1) as usize,
            first_row: 0,
            rows: VecDeque::new(),
        }
    }

    /// Makes the blocks of the pixel rows from `y0` up to but not including `y1`; forgets those above.
    fn need(&mut self, y0: i64, y1: i64) {
        let side = BLOCK as i64;
        let (first, end) = (y0.div_euclid(side), (y1 - 1).div_euclid(side) + 1);
        if self.rows.is_empty() {
            self.first_row = first;
        }
        while self.first_row < first && !self.rows.is_empty() {
            self.rows.pop_front();
            self.first_row += 1;
        }
        let next = self.first_row + self.rows.len() as i64;
        let count = (end - next).max(0) as usize;
        let columns = self.columns;
        let (prepared, first_column) = (self.prepared, self.first_column);
        let mut blocks: Vec<Block> = (0..count * columns)
            .into_par_iter()
            .map(|k| {
                let (row, column) = ((k / columns) as i64, (k % columns) as i64);
                prepared.block((first_column + column) * side, (next + row) * side)
            })
            .collect();
        while blocks.len() >= columns && columns > 0 {
            let rest = blocks.split_off(columns);
            self.rows.push_back(blocks);
            blocks = rest;
        }
    }

    #[inline]
    fn place(&self, x: i64, y: i64) -> (&Block, usize) {
        let side = BLOCK as i64;
        let (column, row) = (
            x.div_euclid(side) - self.first_column,
            y.div_euclid(side) - self.first_row,
        );
        let inside = (y.rem_euclid(side) * side + x.rem_euclid(side)) as usize;
        (&self.rows[row as usize][column as usize], inside)
    }

    #[inline]
    fn color(&self, x: i64, y: i64) -> [f32; 3] {
        let (block, i) = self.place(x, y);
        block.color[i]
    }

    #[inline]
    fn depth(&self, x: i64, y: i64) -> f32 {
        let (block, i) = self.place(x, y);
        block.depth_mm[i]
    }
}

fn srgb(v: f32) -> f32 {
    if v < 0.003_130_8 {
        12.92 * v
    } else {
        1.055 * v.powf(1.0 / 2.4) - 0.055
    }
}

/// Entries of the tone curve's table, spaced evenly over the square root of the light.
const TONES: usize = 2048;

/// Everything about an exposure that does not change from pixel to pixel.
struct Development<'a> {
    sensor: &'a Sensor,
    kernels: Kernels,
    tone: Vec<f32>,
    center: [f32; 2],
    /// 1 / (half diagonal, px).
    inverse_radius: f32,
}

/// Sensitivity of the sensor's red, green and blue pixels.
const SENSITIVITY: [f32; 3] = [0.62, 1.0, 0.7];

impl<'a> Development<'a> {
    fn new(prepared: &'a Prepared) -> Self {
        let view = prepared.view();
        let sensor = &view.sensor;
        let low = sensor.blur_px.clamp(0.2, 1.6);
        let tone = (0..=TONES)
            .map(|k| {
                let root = k as f32 / TONES as f32;
                let v = srgb(root * root);
                let curved = v * v * (3.0 - 2.0 * v);
                255.0 * (v + sensor.contrast * (curved - v))
            })
            .collect();
        let (w, h) = (view.camera.width_px as f32, view.camera.height_px as f32);
        Self {
            sensor,
            kernels: Kernels::new(low, low * (1.0 + 1.1 * sensor.corner_blur)),
            tone,
            center: [view.camera.cx_px as f32, view.camera.cy_px as f32],
            inverse_radius: 2.0 / (w * w + h * h).sqrt(),
        }
    }

    #[inline]
    fn tone(&self, v: f32) -> f32 {
        let at = v.clamp(0.0, 1.0).sqrt() * TONES as f32;
        let i = (at as usize).min(TONES - 1);
        self.tone[i] + (at - i as f32) * (self.tone[i + 1] - self.tone[i])
    }

    /// Squared distance from the middle of the picture, 1 in the corners.
    #[inline]
    fn radius2(&self, x: i64, y: i64) -> f32 {
        let dx = (x as f32 - self.center[0]) * self.inverse_radius;
        let dy = (y as f32 - self.center[1]) * self.inverse_radius;
        dx * dx + dy * dy
    }

    /// The 8-bit picture of a rectangle.
    fn develop(&self, store: &Store, x0: i64, y0: i64, width: usize, height: usize) -> Vec<u8> {
        const SHARPEN: usize = 1;
        const DEMOSAIC: usize = 2;
        let s = self.sensor;
        // raw mosaic with the margin that later steps need
        let margin = SHARPEN + DEMOSAIC;
        let (rw, rh) = (width + 2 * margin, height + 2 * margin);
        let (rx, ry) = (x0 - margin as i64, y0 - margin as i64);
        // across: each column needs two of the three colours
        let lines = rh + 2 * TAPS;
        let mut across = vec![[0.0f32; 2]; rw * lines];
        let mut line = vec![[0.0f32; 3]; rw + 2 * TAPS];
        for row in 0..lines {
            let y = ry + row as i64 - TAPS as i64;
            for (k, c) in line.iter_mut().enumerate() {
                *c = store.color(rx + k as i64 - TAPS as i64, y);
            }
            for column in 0..rw {
                let x = rx + column as i64;
                let sigma = s.blur_px * (1.0 + s.corner_blur * self.radius2(x, y));
                let dx = x as f32 - self.center[0];
                // even columns hold red and green, odd ones green and blue
                let even = x & 1 == 0;
                let side = if even { s.chromatic[0] } else { s.chromatic[1] } * dx;
                let tinted = self.kernels.get(sigma, side);
                let plain = self.kernels.get(sigma, 0.0);
                let channel = if even { 0 } else { 2 };
                let (mut a, mut b) = (0.0, 0.0);
                for t in 0..2 * TAPS + 1 {
                    let c = &line[column + t];
                    a += tinted[t] * c[channel];
                    b += plain[t] * c[1];
                }
                across[row * rw + column] = [a, b];
            }
        }
        let mut raw = vec![0.0f32; rw * rh];
        for row in 0..rh {
            let y = ry + row as i64;
            for column in 0..rw {
                let x = rx + column as i64;
                let r2 = self.radius2(x, y);
                let sigma = s.blur_px * (1.0 + s.corner_blur * r2);
                let channel = bayer(x, y);
                let slot = usize::from(channel == 1);
                let dy = y as f32 - self.center[1];
                let side = match channel {
                    0 => s.chromatic[0] * dy,
                    2 => s.chromatic[1] * dy,
                    _ => 0.0,
                };
                let taps = self.kernels.get(sigma, side);
                let mut v = 0.0;
                for t in 0..2 * TAPS + 1 {
                    v += taps[t] * across[(row + t) * rw + column][slot];
                }
                let light = v * s.exposure * (1.0 - s.vignetting * r2) * SENSITIVITY[channel];
                let electrons = light.max(0.0) * s.full_well;
                let noise = normal(hash(s.noise_seed, x, y)) * (electrons + s.read_noise * s.read_noise).sqrt();
                let counted = ((electrons + noise) / s.full_well).clamp(-0.02, 1.0);
                raw[row * rw + column] = nearest(counted * 4095.0) * (1.0 / 4095.0) / SENSITIVITY[channel];
            }
        }
        // colours at every pixel (Malvar, He, Cutler 2004), balanced and toned
        let (tw, th) = (width + 2 * SHARPEN, height + 2 * SHARPEN);
        let mut toned = vec![[0.0f32; 3]; tw * th];
        let white = s.white_balance;
        for row in 0..th {
            for column in 0..tw {
                let (x, y) = (rx + (column + DEMOSAIC) as i64, ry + (row + DEMOSAIC) as i64);
                let at = |dx: isize, dy: isize| {
                    raw[(row as isize + DEMOSAIC as isize + dy) as usize * rw
                        + (column as isize + DEMOSAIC as isize + dx) as usize]
                };
                let own = at(0, 0);
                let near = (at(-1, 0) + at(1, 0), at(0, -1) + at(0, 1));
                let far = (at(-2, 0) + at(2, 0), at(0, -2) + at(0, 2));
                let rgb = if bayer(x, y) == 1 {
                    let diagonal = at(-1, -1) + at(1, -1) + at(-1, 1) + at(1, 1);
                    let h = 0.125 * (5.0 * own + 4.0 * near.0 - diagonal - far.0 + 0.5 * far.1);
                    let v = 0.125 * (5.0 * own + 4.0 * near.1 - diagonal - far.1 + 0.5 * far.0);
                    if y & 1 == 0 { [h, own, v] } else { [v, own, h] }
                } else {
                    let diagonal = at(-1, -1) + at(1, -1) + at(-1, 1) + at(1, 1);
                    let green = 0.125 * (4.0 * own + 2.0 * (near.0 + near.1) - far.0 - far.1);
                    let other = 0.125 * (6.0 * own + 2.0 * diagonal - 1.5 * (far.0 + far.1));
                    if y & 1 == 0 {
                        [own, green, other]
                    } else {
                        [other, green, own]
                    }
                };
                let balanced: [f32; 3] = std::array::from_fn(|k| rgb[k].min(1.0) * white[k]);
                let grey = 0.3 * balanced[0] + 0.59 * balanced[1] + 0.11 * balanced[2];
                toned[row * tw + column] = balanced.map(|v| self.tone(grey + s.saturation * (v - grey)));
            }
        }
        let luma = |c: &[f32; 3]| 0.3 * c[0] + 0.59 * c[1] + 0.11 * c[2];
        let lumas: Vec<f32> = toned.iter().map(luma).collect();
        let mut out = Vec::with_capacity(3 * width * height);
        for row in 0..height {
            for column in 0..width {
                let i = (row + SHARPEN) * tw + column + SHARPEN;
                let cross = lumas[i - 1] + lumas[i + 1] + lumas[i - tw] + lumas[i + tw];
                let corners = lumas[i - tw - 1] + lumas[i - tw + 1] + lumas[i + tw - 1] + lumas[i + tw + 1];
                let mean = 0.25 * lumas[i] + 0.125 * cross + 0.0625 * corners;
                let detail = s.sharpening * 1.5 * (lumas[i] - mean);
                for v in toned[i] {
                    out.push((v + detail + 0.5).clamp(0.0, 255.0) as u8);
                }
            }
        }
        out
    }
}

/// Colour of the mosaic at a pixel (RGGB): 0 red, 1 green, 2 blue.
#[inline]
fn bayer(x: i64, y: i64) -> usize {
    (x & 1) as usize + (y & 1) as usize
}

/// The picture of a region; `real` with everything a real camera adds.
pub(crate) fn expose(prepared: &Prepared, roi: Roi, real: bool) -> Rendered {
    let camera = &prepared.view().camera;
    let sensor = &prepared.view().sensor;
    let (x0, y0) = (i64::from(roi.x_px), i64::from(roi.y_px));
    let (x1, y1) = (x0 + i64::from(roi.width_px), y0 + i64::from(roi.height_px));
    // Compression works on blocks of 8 pixels counted from the picture's corner.
    let (cx0, cy0) = (x0 & !7, y0 & !7);
    let cx1 = ((x1 + 7) & !7).min(i64::from(camera.width_px));
    let cy1 = ((y1 + 7) & !7).min(i64::from(camera.height_px));
    let (width, height) = ((cx1 - cx0) as usize, (cy1 - cy0) as usize);
    const APRON: i64 = 8;
    const BAND: i64 = 128;
    let development = Development::new(prepared);
    let mut store = Store::new(prepared, cx0 - APRON, cx1 + APRON);
    let mut bytes = vec![0u8; 3 * width * height];
    let depth_eye = DepthEye { sensor, real };
    let (i0, j0) = (x0 / 2, y0 / 2);
    let (i1, j1) = (x1 / 2, y1 / 2);
    let mut depth_mm = vec![0.0f32; ((i1 - i0) * (j1 - j0)).max(0) as usize];
    let mut y = cy0;
    while y < cy1 {
        let end = (y + BAND).min(cy1);
        store.need(y - APRON, end + APRON);
        let store = &store;
        let band = &mut bytes[3 * width * (y - cy0) as usize..3 * width * (end - cy0) as usize];
        // Strips of rows, each in tiles that stay in the cache.
        const STRIP: usize = 32;
        band.par_chunks_mut(3 * width * STRIP)
            .enumerate()
            .for_each(|(k, strip)| {
                let top = y + (k * STRIP) as i64;
                let rows = strip.len() / (3 * width);
                let mut left = 0;
                while left < width {
                    let columns = (width - left).min(256);
                    let tile = if real {
                        development.develop(store, cx0 + left as i64, top, columns, rows)
                    } else {
                        ideal(store, sensor, cx0 + left as i64, top, columns, rows)
                    };
                    for row in 0..rows {
                        let to = 3 * (row * width + left);
                        strip[to..to + 3 * columns].copy_from_slice(&tile[3 * row * columns..3 * (row + 1) * columns]);
                    }
                    left += columns;
                }
            });
        // depth rows whose two pixel rows lie in this band and in the region
        let columns = (i1 - i0).max(0) as usize;
        let first = ((y + 1) / 2).max(j0);
        let last = (end / 2).min(j1);
        if columns > 0 && last > first {
            let rows = &mut depth_mm[(first - j0) as usize * columns..(last - j0) as usize * columns];
            rows.par_chunks_mut(columns).enumerate().for_each(|(r, row)| {
                for (c, z) in row.iter_mut().enumerate() {
                    *z = depth_eye.measure(store, i0 + c as i64, first + r as i64);
                }
            });
        }
        y = end;
    }
    let mut color = RgbImage::from_raw(width as u32, height as u32, bytes).unwrap_or_default();
    if let Some(quality) = sensor.jpeg_quality.filter(|_| real) {
        color = compress(color, quality);
    }
    let cut = (x0 - cx0, y0 - cy0);
    if cut != (0, 0) || (roi.width_px, roi.height_px) != color.dimensions() {
        color = image::imageops::crop_imm(&color, cut.0 as u32, cut.1 as u32, roi.width_px, roi.height_px).to_image();
    }
    Rendered {
        color,
        depth: DepthMap {
            width: (i1 - i0).max(0) as u32,
            height: (j1 - j0).max(0) as u32,
            step: 2,
            depth_mm,
        },
        origin: [roi.x_px, roi.y_px],
    }
}

/// A rectangle as a perfect camera would record it.
fn ideal(store: &Store, sensor: &Sensor, x0: i64, y0: i64, width: usize, height: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(3 * width * height);
    for y in 0..height as i64 {
        for x in 0..width as i64 {
            for v in store.color(x0 + x, y0 + y) {
                out.push((255.0 * srgb((v * sensor.exposure).clamp(0.0, 1.0)) + 0.5) as u8);
            }
        }
    }
    out
}

/// What compression leaves of a picture.
fn compress(picture: RgbImage, quality: u8) -> RgbImage {
    let mut bytes = Vec::new();
    let encoded = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(&picture);
    match encoded.and_then(|()| image::load_from_memory_with_format(&bytes, image::ImageFormat::Jpeg)) {
        Ok(back) => back.into_rgb8(),
        // In memory it cannot fail; the picture as it was is the best answer if it does.
        Err(_) => picture,
    }
}

/// The depth camera, already registered to the colour camera.
struct DepthEye<'a> {
    sensor: &'a Sensor,
    real: bool,
}

impl DepthEye<'_> {
    /// Depth at a pixel of half the resolution; 0 where there is no measurement.
    fn measure(&self, store: &Store, i: i64, j: i64) -> f32 {
        let s = self.sensor;
        let (x, y) = (2 * i, 2 * j);
        let (mut sum, mut light) = (0.0, 0.0);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            sum += store.depth(x + dx, y + dy);
            light += store.color(x + dx, y + dy)[1];
        }
        let z = 0.25 * sum;
        if !self.real {
            return z;
        }
        let seen = self.window(store, x, y, z);
        let light = 0.25 * light * s.exposure;
        let mut spread = 0.0f32;
        for (dx, dy) in [(-3, 0), (4, 0), (0, -3), (0, 4), (-2, -2), (3, -2), (-2, 3), (3, 3)] {
            spread = spread.max((store.depth(x + dx, y + dy) - z).abs());
        }
        let bits = hash(s.noise_seed ^ 0xD0_77, i, j);
        let chance = share(bits);
        // blotches without a match
        let blotch = smooth_noise(s.noise_seed ^ 0xB1_07, i as f32 / 9.0, j as f32 / 9.0);
        if (spread > 8.0 && chance < 0.85)
            || (light > 1.5 && chance < 0.8)
            || (light < 0.004 && chance < 0.75)
            || chance < 0.0025
            || blotch > 0.965
            || z > 4500.0
        {
            return 0.0;
        }
        let grow = (z / 1500.0) * (z / 1500.0);
        // matching windows overlap: neighbours share part of their noise
        let own = normal(hash(s.noise_seed ^ 0x5EED, i, j));
        let mut around = 0.0;
        for (di, dj) in [(-1, 0), (1, 0), (0, -1), (0, 1)] {
            around += normal(hash(s.noise_seed ^ 0x5EED, i + di, j + dj));
        }
        let noise = s.depth_noise_mm * grow * (0.8 * own + 0.3 * around);
        let bias = s.depth_bias_mm
            * (2.0 * smooth_noise(s.depth_seed, i as f32 / 420.0, j as f32 / 420.0) - 1.0
                + 0.5 * (2.0 * smooth_noise(s.depth_seed ^ 1, i as f32 / 130.0, j as f32 / 130.0) - 1.0));
        seen + noise + bias
    }

    /// Mean depth of what the matching window sees, without what lies far before or behind: matching keeps to steep edges.
    fn window(&self, store: &Store, x: i64, y: i64, z: f32) -> f32 {
        const SAME_MM: f32 = 8.0;
        let half = self.sensor.depth_window_px;
        let (mut sum, mut n) = (z, 1.0);
        for dy in (-half..=half).filter(|_| half > 0) {
            for dx in -half..=half {
                let there = store.depth(x + 2 * dx, y + 2 * dy);
                if (there - z).abs() < SAME_MM {
                    sum += there;
                    n += 1.0;
                }
            }
        }
        sum / n
    }
}

/// Smooth noise over the plane, 0 to 1, knots one apart.
fn smooth_noise(seed: u64, x: f32, y: f32) -> f32 {
    // places are not negative
    let (ix, iy) = (x as i32 as f32, y as i32 as f32);
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (ease(x - ix), ease(y - iy));
    let knot = |dx: i64, dy: i64| share(hash(seed, ix as i64 + dx, iy as i64 + dy));
    let top = knot(0, 0) + fx * (knot(1, 0) - knot(0, 0));
    let bottom = knot(0, 1) + fx * (knot(1, 1) - knot(0, 1));
    top + fy * (bottom - top)
}
