//! Real photographs as patches: e-waste crops and photographs of appliances, carried in `crates/training/data`.

use crate::TrainError;
use crate::boxes::{BoxKind, DrawnBox, boxed_pictures};
use crate::samples::{Classes, Label, PATCH_PX, Patch, any_fastener, only};
use geometry::{RgbImage, read_color};
use image::imageops::{self, FilterType};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use sha2::{Digest, Sha256};
use std::ops::RangeInclusive;
use std::path::Path;
use vision::layout::Class;

/// Crops along a row of an atlas.
const COLUMNS: u32 = 50;
/// Side of a crop in an atlas, px.
const CROP_PX: u32 = 64;
/// Head of a crop's screw, px: it nearly fills the crop.
const CROP_HEAD_PX: f64 = 52.0;

/// True if a group of near-duplicates is kept for measuring.
pub fn held_out(group: &str) -> bool {
    Sha256::digest(group.as_bytes())[0].is_multiple_of(5)
}

/// Every crop of the training groups at a few sizes, and every labelled item of the training photographs.
pub fn patches(data: &Path, seed: u64) -> Result<Vec<Patch>, TrainError> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut patches = crops(data, false, 22.0..=40.0, &mut rng)?;
    patches.extend(photographs(&data.join("photographs"), &mut rng)?);
    Ok(patches)
}

/// The e-waste crops: those of the training groups, or those held out, with heads of those diameters, px.
pub fn crops(
    data: &Path,
    held: bool,
    heads_px: RangeInclusive<f64>,
    rng: &mut Pcg64Mcg,
) -> Result<Vec<Patch>, TrainError> {
    let index = text(&data.join("ewaste.csv"))?;
    let background = only(Class::Background) | only(Class::OtherFeature);
    let mut patches = Vec::new();
    for (class, item, elsewhere) in [
        ("screw", any_fastener(), 0),
        ("hole", background, 0),
        ("other", background, background),
    ] {
        let atlas = read_color(&data.join(format!("ewaste_{class}.jpg")))?;
        for line in index.lines().skip(1) {
            let mut fields = line.split(',');
            let (Some(kind), Some(tile), Some(group)) = (fields.next(), fields.next(), fields.next()) else {
                continue;
            };
            let (true, Ok(tile)) = (kind == class && held_out(group) == held, tile.parse::<u32>()) else {
                continue;
            };
            let (x, y) = (tile % COLUMNS * CROP_PX, tile / COLUMNS * CROP_PX);
            let crop = imageops::crop_imm(&atlas, x, y, CROP_PX, CROP_PX).to_image();
            let head_px = rng.random_range(heads_px.clone());
            patches.push(place(&crop, head_px, item, elsewhere));
        }
    }
    Ok(patches)
}

/// A crop shrunk to a head's size, in the middle of a patch; around it the crop's mirror image.
fn place(crop: &RgbImage, head_px: f64, classes: Classes, elsewhere: Classes) -> Patch {
    let side = (f64::from(CROP_PX) * head_px / CROP_HEAD_PX).round() as u32;
    let small = imageops::resize(crop, side, side, FilterType::Triangle);
    let low = (PATCH_PX as i64 - i64::from(side)) / 2;
    let mirrored = |c: i64| {
        let period = 2 * i64::from(side);
        let r = (c - low).rem_euclid(period);
        r.min(period - 1 - r) as u32
    };
    let mut rgb = Vec::with_capacity(PATCH_PX * PATCH_PX * 3);
    for y in 0..PATCH_PX as i64 {
        for x in 0..PATCH_PX as i64 {
            rgb.extend_from_slice(&small.get_pixel(mirrored(x), mirrored(y)).0);
        }
    }
    let middle = (low as f64 + f64::from(side) / 2.0 - 0.5) as f32;
    let label = Label {
        u_px: middle,
        v_px: middle,
        diameter_px: head_px as f32,
        classes,
        exact: false,
    };
    Patch {
        rgb,
        labels: vec![label],
        focused: true,
        elsewhere,
    }
}

fn photographs(folder: &Path, rng: &mut Pcg64Mcg) -> Result<Vec<Patch>, TrainError> {
    let mut patches = Vec::new();
    for photograph in boxed_pictures(folder)? {
        let picture = read_color(&photograph.path)?;
        let boxes: Vec<Labelled> = photograph
            .boxes(picture.dimensions())
            .into_iter()
            .map(Labelled::from)
            .collect();
        // not everything that turns is labelled on the hard drives: their background teaches nothing
        let elsewhere = if photograph.scene.starts_with("harddrive") {
            0
        } else {
            only(Class::Background) | only(Class::OtherFeature)
        };
        let mut heads: Vec<f64> = boxes.iter().map(|b| b.diameter_px).collect();
        heads.sort_by(f64::total_cmp);
        let Some(&typical) = heads.get(heads.len() / 2) else {
            continue;
        };
        for _ in 0..3 {
            for target in &boxes {
                let scale = rng.random_range(20.0..40.0) / target.diameter_px;
                patches.push(cut(
                    &picture,
                    &boxes,
                    [target.u_px, target.v_px],
                    scale,
                    elsewhere,
                    true,
                ));
            }
        }
        if elsewhere != 0 {
            for _ in 0..12 {
                let at = [f64::from(picture.width()), f64::from(picture.height())].map(|n| rng.random_range(0.0..n));
                let scale = (rng.random_range(20.0..40.0) / typical).min(2.0);
                patches.push(cut(&picture, &boxes, at, scale, elsewhere, false));
            }
        }
    }
    Ok(patches)
}

struct Labelled {
    u_px: f64,
    v_px: f64,
    diameter_px: f64,
    classes: Classes,
}

impl From<DrawnBox> for Labelled {
    fn from(DrawnBox { kind, low, high }: DrawnBox) -> Self {
        Self {
            u_px: 0.5 * (low[0] + high[0]),
            v_px: 0.5 * (low[1] + high[1]),
            diameter_px: ((high[0] - low[0]) * (high[1] - low[1])).sqrt(),
            classes: match kind {
                BoxKind::Cross => only(Class::Cross),
                // of the hexagons of the photographs it is not said which
                BoxKind::Other => only(Class::HexSocket) | only(Class::HexHead) | only(Class::Torx),
                BoxKind::Hidden => 0,
            },
        }
    }
}

fn cut(picture: &RgbImage, boxes: &[Labelled], at: [f64; 2], scale: f64, elsewhere: Classes, focused: bool) -> Patch {
    let half = PATCH_PX as f64 / 2.0 / scale;
    let last = [f64::from(picture.width() - 1), f64::from(picture.height() - 1)];
    // shrinking: mean over the source pixels that fall on one
    let taps = (1.0 / scale).ceil().clamp(1.0, 6.0) as usize;
    let mut rgb = Vec::with_capacity(PATCH_PX * PATCH_PX * 3);
    for y in 0..PATCH_PX {
        for x in 0..PATCH_PX {
            let mut sum = [0.0; 3];
            for k in 0..taps * taps {
                let sub = |i: usize| (i as f64 + 0.5) / taps as f64 - 0.5;
                let u = (at[0] - half + (x as f64 + 0.5 + sub(k % taps)) / scale - 0.5).clamp(0.0, last[0]);
                let v = (at[1] - half + (y as f64 + 0.5 + sub(k / taps)) / scale - 0.5).clamp(0.0, last[1]);
                let value = imageops::interpolate_bilinear(picture, u as f32, v as f32).unwrap_or(image::Rgb([0; 3]));
                for (s, c) in sum.iter_mut().zip(value.0) {
                    *s += f64::from(c);
                }
            }
            rgb.extend(sum.map(|s| (s / (taps * taps) as f64).round() as u8));
        }
    }
    let mut labels: Vec<(f64, Label)> = boxes
        .iter()
        .map(|b| {
            let label = Label {
                u_px: ((b.u_px - at[0] + half) * scale) as f32,
                v_px: ((b.v_px - at[1] + half) * scale) as f32,
                diameter_px: (b.diameter_px * scale) as f32,
                classes: b.classes,
                exact: false,
            };
            ((b.u_px - at[0]).hypot(b.v_px - at[1]), label)
        })
        .collect();
    labels.sort_by(|a, b| a.0.total_cmp(&b.0));
    Patch {
        rgb,
        labels: labels.into_iter().map(|l| l.1).collect(),
        focused,
        elsewhere,
    }
}

fn text(path: &Path) -> Result<String, TrainError> {
    std::fs::read_to_string(path).map_err(|source| TrainError::Data {
        path: path.into(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_group_is_on_one_side() {
        let held = (0..1000).filter(|k| held_out(&format!("screw{k:04}"))).count();
        assert!((150..250).contains(&held), "{held} of 1000");
    }
}
