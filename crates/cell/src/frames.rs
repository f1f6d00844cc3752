//! Frames as they were decided on, kept beside the journal without loss, so that a shift can be decided again.
//!
//! Colour is a PNG. Depth is the very `f32` that the program worked with: a 16-bit grey PNG of twice its height, the high halves of the
//! numbers above the low halves. The high halves (sign, exponent, most of the mantissa) hardly change from pixel to pixel and cost
//! next to nothing; the low ones are the camera's noise, which nothing compresses.

use crate::capture::Shot;
use crate::device::Region;
use crate::store::{self, Sha, StoreError};
use geometry::{CameraModel, DepthMap, RgbdFrame};
use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageEncoder};
use serde::{Deserialize, Serialize};
use std::io::Cursor;
use std::path::Path;

/// Folder of the frames in a run's folder.
pub const FRAME_FOLDER: &str = "frames";
const EXTENSION: &str = "png";

/// A kept frame: what [`load`] needs to give the very shot back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeptFrame {
    /// Colour.
    pub color: Sha,
    /// Registered depth, if it was taken.
    pub depth: Option<KeptDepth>,
    /// Part of the whole picture that it shows.
    pub region: Region,
    /// Camera of that part.
    pub camera: Option<CameraModel>,
    /// Time of the exposure, cell clock, s.
    pub t_s: f64,
}

/// Depth of a kept frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeptDepth {
    /// Its numbers.
    pub sha256: Sha,
    /// Colour pixels per depth pixel.
    pub step: u32,
}

/// Keeps a shot in a run's folder.
///
/// # Errors
/// [`StoreError::Write`].
pub fn keep(run: &Path, shot: &Shot) -> Result<KeptFrame, StoreError> {
    let folder = run.join(FRAME_FOLDER);
    let frame = &shot.frame;
    let png = |bytes: &[u8], width, height, kind| {
        let mut out = Cursor::new(Vec::new());
        PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Sub)
            .write_image(bytes, width, height, kind)
            .map_err(|e| StoreError::Write {
                path: folder.clone(),
                reason: e.to_string(),
            })?;
        Ok(out.into_inner())
    };
    let (width, height) = frame.color.dimensions();
    let color = png(frame.color.as_raw(), width, height, ExtendedColorType::Rgb8)?;
    let depth = match &frame.depth {
        None => None,
        Some(map) => {
            let halves = halves(&map.depth_mm);
            let bytes = png(&halves, map.width, 2 * map.height, ExtendedColorType::L16)?;
            Some(KeptDepth {
                sha256: store::keep(&folder, EXTENSION, &bytes)?,
                step: map.step,
            })
        }
    };
    Ok(KeptFrame {
        color: store::keep(&folder, EXTENSION, &color)?,
        depth,
        region: shot.region,
        camera: frame.camera,
        t_s: frame.t_s,
    })
}

/// The shot that was kept, bit by bit.
///
/// # Errors
/// [`StoreError::Read`] or [`StoreError::Damaged`].
pub fn load(run: &Path, kept: &KeptFrame) -> Result<Shot, StoreError> {
    let folder = run.join(FRAME_FOLDER);
    let picture = |sha: &Sha| {
        let bytes = store::read(&folder, sha, EXTENSION)?;
        PngDecoder::new(Cursor::new(bytes))
            .and_then(DynamicImage::from_decoder)
            .map_err(|e| damaged(&folder, sha, e.to_string()))
    };
    let color = picture(&kept.color)?.into_rgb8();
    let depth = match &kept.depth {
        None => None,
        Some(depth) => {
            let stacked = picture(&depth.sha256)?.into_luma16();
            let (width, height) = (stacked.width(), stacked.height() / 2);
            let (high, low) = stacked.as_raw().split_at((width * height) as usize);
            let together = |(h, l): (&u16, &u16)| f32::from_bits(u32::from(*h) << 16 | u32::from(*l));
            let map = DepthMap {
                width,
                height,
                step: depth.step,
                depth_mm: high.iter().zip(low).map(together).collect(),
            };
            if DepthMap::step_between(color.dimensions(), (map.width, map.height)) != Some(map.step) {
                let reason = "its depth does not belong to its colour";
                return Err(damaged(&folder, &depth.sha256, reason.into()));
            }
            Some(map)
        }
    };
    Ok(Shot {
        region: kept.region,
        frame: RgbdFrame {
            color,
            depth,
            camera: kept.camera,
            t_s: kept.t_s,
        },
    })
}

fn damaged(folder: &Path, sha: &Sha, reason: String) -> StoreError {
    StoreError::Damaged {
        path: store::path_of(folder, sha, EXTENSION),
        reason,
    }
}

/// High halves of all numbers, then the low halves, in the byte order that the encoder takes for 16 bits.
fn halves(values: &[f32]) -> Vec<u8> {
    let part = |shift: u32| {
        values
            .iter()
            .flat_map(move |z| ((z.to_bits() >> shift) as u16).to_ne_bytes())
    };
    part(16).chain(part(0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::RgbImage;

    #[test]
    fn a_frame_comes_back_bit_by_bit_and_a_damaged_one_does_not() {
        let run = tempfile::tempdir().expect("folder");
        let depth_mm = (0..12 * 8).map(|k| match k % 7 {
            0 => 0.0,
            1 => f32::NAN,
            _ => 1500.0 + (k as f32).sin() * 0.3,
        });
        let shot = Shot {
            region: Region {
                x_px: 8,
                y_px: 16,
                width_px: 24,
                height_px: 16,
            },
            frame: RgbdFrame {
                color: RgbImage::from_fn(24, 16, |x, y| image::Rgb([x as u8, y as u8, (x * y) as u8])),
                depth: Some(DepthMap {
                    width: 12,
                    height: 8,
                    step: 2,
                    depth_mm: depth_mm.collect(),
                }),
                camera: Some(CameraModel::pinhole(24, 16, 100.0, 100.0)),
                t_s: 3.25,
            },
        };
        let kept = keep(run.path(), &shot).expect("kept");
        assert_eq!(keep(run.path(), &shot).expect("kept"), kept);
        let back = load(run.path(), &kept).expect("there");
        assert_eq!((back.region, &back.frame.color), (shot.region, &shot.frame.color));
        let bits = |s: &Shot| -> Vec<u32> {
            let map = s.frame.depth.as_ref().expect("depth");
            map.depth_mm.iter().map(|z| z.to_bits()).collect()
        };
        assert_eq!(bits(&back), bits(&shot));
        assert_eq!((back.frame.camera, back.frame.t_s), (shot.frame.camera, shot.frame.t_s));
        let text = serde_json::to_string(&kept).expect("JSON");
        assert_eq!(serde_json::from_str::<KeptFrame>(&text).expect("back"), kept);
        let path = store::path_of(&run.path().join(FRAME_FOLDER), &kept.color, EXTENSION);
        std::fs::write(&path, b"something else").expect("written");
        let error = load(run.path(), &kept).expect_err("damaged").to_string();
        assert!(error.contains("restore it from a copy"), "{error}");
        std::fs::remove_file(&path).expect("removed");
        let error = load(run.path(), &kept).expect_err("gone").to_string();
        assert!(error.contains("whole folder"), "{error}");
    }
}
