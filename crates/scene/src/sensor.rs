//! From light to file: exposure, lens, mosaic, noise, tone, compression.

use crate::render::{BLOCK, Block, Prepared, Rendered};
use crate::view::Roi;
use geometry::{DepthMap, RgbImage};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

/// Settings of one exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// Factor on the light.
    pub exposure: f32,
    /// Quality of the JPEG that the camera hands over; `None`: not compressed.
    pub jpeg_quality: Option<u8>,
    /// Seed of this exposure's noise.
    pub noise_seed: u64,
}

impl Sensor {
    /// Settings as a cell's camera may have them.
    pub fn sample(seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        Self {
            exposure: rng.random_range(0.6..1.1),
            jpeg_quality: Some(rng.random_range(80..=97)),
            noise_seed: rng.random(),
        }
    }
}

pub(crate) fn expose(prepared: &Prepared, roi: Roi, _real: bool) -> Rendered {
    let sensor = &prepared.view().sensor;
    let side = BLOCK as i64;
    let (x0, y0) = (i64::from(roi.x_px) / side, i64::from(roi.y_px) / side);
    let (x1, y1) = (
        i64::from(roi.x_px + roi.width_px - 1) / side,
        i64::from(roi.y_px + roi.height_px - 1) / side,
    );
    let columns = (x1 - x0 + 1) as usize;
    let blocks: Vec<Block> = (0..columns * (y1 - y0 + 1) as usize)
        .into_par_iter()
        .map(|k| prepared.block((x0 + (k % columns) as i64) * side, (y0 + (k / columns) as i64) * side))
        .collect();
    let place = |x: u32, y: u32| {
        let (bx, by) = (
            x as usize / BLOCK - x0 as usize,
            y as usize / BLOCK - y0 as usize,
        );
        (by * columns + bx, (y as usize % BLOCK) * BLOCK + x as usize % BLOCK)
    };
    let color = RgbImage::from_fn(roi.width_px, roi.height_px, |x, y| {
        let (b, i) = place(roi.x_px + x, roi.y_px + y);
        let c = blocks[b].color[i];
        image::Rgb(c.map(|v| {
            let v = (v * 0.6 * sensor.exposure).clamp(0.0, 1.0);
            let s = if v < 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
            (255.0 * s + 0.5) as u8
        }))
    });
    let (i0, j0) = (roi.x_px / 2, roi.y_px / 2);
    let (i1, j1) = ((roi.x_px + roi.width_px) / 2, (roi.y_px + roi.height_px) / 2);
    let depth = DepthMap {
        width: i1 - i0,
        height: j1 - j0,
        step: 2,
        depth_mm: (0..(i1 - i0) * (j1 - j0))
            .map(|k| {
                let (i, j) = (i0 + k % (i1 - i0), j0 + k / (i1 - i0));
                let mut sum = 0.0;
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let x = (2 * i + dx).clamp(roi.x_px, roi.x_px + roi.width_px - 1);
                    let y = (2 * j + dy).clamp(roi.y_px, roi.y_px + roi.height_px - 1);
                    let (b, i) = place(x, y);
                    sum += blocks[b].depth_mm[i];
                }
                0.25 * sum
            })
            .collect(),
    };
    Rendered {
        color,
        depth,
        origin: [roi.x_px, roi.y_px],
    }
}
