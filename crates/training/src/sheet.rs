//! Random crops of what is learned from, side by side, to be looked at: could they be mistaken for one another?

use crate::samples::{PATCH_PX, Patch, rendered};
use crate::{TrainError, TrainSettings, pictures, real};
use geometry::RgbImage;
use image::imageops;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Part of a patch that is shown, px, and how much larger.
const SHOWN_PX: u32 = 64;
const LARGER: u32 = 2;
/// Crops along a row, and rows of each origin.
const COLUMNS: u32 = 12;
const ROWS: u32 = 2;

/// Rows of random crops: real ones, rendered ones, those of the pictures from elsewhere if `settings` name any.
///
/// # Errors
/// [`TrainError`] that names the file or folder that cannot be read.
pub fn crop_sheet(settings: &TrainSettings) -> Result<RgbImage, TrainError> {
    let mut rng = Pcg64Mcg::seed_from_u64(settings.seed);
    let mut origins = vec![real::patches(&settings.data, settings.seed)?];
    let units = settings.first_unit..settings.first_unit + settings.units;
    origins.push(rendered(units, settings.background, settings.work.as_deref(), &|_| {})?);
    if let Some(folder) = &settings.pictures {
        origins.push(pictures::patches(folder, settings.seed)?.0);
    }
    let side = SHOWN_PX * LARGER;
    let (gap, height) = (8, ROWS * side);
    let mut sheet = RgbImage::from_pixel(
        COLUMNS * side,
        origins.len() as u32 * (height + gap) - gap,
        image::Rgb([255; 3]),
    );
    for (k, patches) in (0u32..).zip(&origins) {
        let shown: Vec<&Patch> = patches.iter().filter(|p| p.focused).collect();
        for cell in 0..COLUMNS * ROWS {
            let Some(patch) = shown.choose(&mut rng) else { continue };
            let (x, y) = (cell % COLUMNS * side, k * (height + gap) + cell / COLUMNS * side);
            imageops::replace(&mut sheet, &crop(patch, &mut rng), i64::from(x), i64::from(y));
        }
    }
    Ok(sheet)
}

/// The middle of a patch, turned by a random number of quarter turns.
fn crop(patch: &Patch, rng: &mut Pcg64Mcg) -> RgbImage {
    let side = PATCH_PX as u32;
    let whole = RgbImage::from_raw(side, side, patch.rgb.clone()).unwrap_or_default();
    let label = patch
        .labels
        .first()
        .map_or([side as f32 / 2.0; 2], |l| [l.u_px, l.v_px]);
    let corner =
        label.map(|c| (c.round() as i64 - i64::from(SHOWN_PX / 2)).clamp(0, i64::from(side - SHOWN_PX)) as u32);
    let mut part = imageops::crop_imm(&whole, corner[0], corner[1], SHOWN_PX, SHOWN_PX).to_image();
    for _ in 0..rng.random_range(0..4) {
        part = imageops::rotate90(&part);
    }
    imageops::resize(
        &part,
        SHOWN_PX * LARGER,
        SHOWN_PX * LARGER,
        imageops::FilterType::CatmullRom,
    )
}
