//! Pictures with exact truth from elsewhere as patches: what `path_traced.py` makes, or anyone's own in the same form.

use crate::TrainError;
use crate::samples::{Classes, PATCH_PX, Patch, crop, decoy_class, only};
use geometry::{Pixel, RgbImage, read_color, sha256_hex};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use scene::fastener::Decoy;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use vision::layout::Class;

/// Patches of a picture that are cut anywhere.
const ANYWHERE: usize = 12;

/// What is learned from of a truth file; the rest is ignored.
#[derive(Deserialize)]
struct TruthFile {
    rgb: String,
    screws: Vec<FileScrew>,
    negatives: Vec<FileNegative>,
}

#[derive(Deserialize)]
struct FileScrew {
    u: f64,
    v: f64,
    head_d_px: f64,
    detectable: bool,
}

#[derive(Deserialize)]
struct FileNegative {
    kind: String,
    u: f64,
    v: f64,
    d_px: f64,
    #[serde(default = "shown")]
    visible: bool,
}

fn shown() -> bool {
    true
}

/// Patches of every item of the pictures of a folder (`truth/*.json`, and the `rgb` that each names), and some of what is between
/// them; and an identity of the whole folder.
///
/// # Errors
/// [`TrainError`] that names the file that is missing, is too small or is not of that form.
pub fn patches(folder: &Path, seed: u64) -> Result<(Vec<Patch>, String), TrainError> {
    let truth = folder.join("truth");
    let unreadable = |path: &Path, source| TrainError::Data {
        path: path.into(),
        source,
    };
    let mut files: Vec<PathBuf> = std::fs::read_dir(&truth)
        .and_then(|entries| entries.map(|e| Ok(e?.path())).collect())
        .map_err(|source| unreadable(&truth, source))?;
    files.retain(|path| path.extension().is_some_and(|e| e == "json"));
    files.sort();
    let texts: Vec<String> = files
        .iter()
        .map(|path| std::fs::read_to_string(path).map_err(|source| unreadable(path, source)))
        .collect::<Result<_, _>>()?;
    let per_picture: Vec<(Vec<Patch>, String)> = files
        .par_iter()
        .zip(&texts)
        .enumerate()
        .map(|(k, (path, text))| {
            let malformed = |reason: String| TrainError::Truth {
                path: path.clone(),
                reason,
            };
            let file: TruthFile = serde_json::from_str(text).map_err(|e| malformed(e.to_string()))?;
            let picture = read_color(&folder.join(&file.rgb))?;
            if picture.width().min(picture.height()) < PATCH_PX as u32 {
                return Err(malformed(format!("its picture is smaller than {PATCH_PX} pixels")));
            }
            let mut rng = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x9E37_79B9) ^ k as u64);
            let id = sha256_hex(picture.as_raw()) + text;
            Ok((of_picture(&picture, &labels(&file), &mut rng), id))
        })
        .collect::<Result<_, TrainError>>()?;
    let (patches, ids): (Vec<Vec<Patch>>, Vec<String>) = per_picture.into_iter().unzip();
    Ok((patches.concat(), sha256_hex(ids.concat().as_bytes())))
}

fn labels(file: &TruthFile) -> Vec<(Pixel, f64, Classes)> {
    let screws = file.screws.iter().map(|s| {
        let classes = if s.detectable { only(Class::Cross) } else { 0 };
        (Pixel::new(s.u, s.v), s.head_d_px, classes)
    });
    let others = file.negatives.iter().map(|n| {
        // of what has a name that is not known nothing is learned
        let known = Decoy::ALL.into_iter().find(|d| n.visible && d.name() == n.kind);
        let classes = known.map_or(0, |decoy| only(decoy_class(decoy)));
        (Pixel::new(n.u, n.v), n.d_px, classes)
    });
    screws.chain(others).collect()
}

fn of_picture(picture: &RgbImage, labels: &[(Pixel, f64, Classes)], rng: &mut Pcg64Mcg) -> Vec<Patch> {
    let mut patches: Vec<Patch> = labels
        .iter()
        .filter(|label| label.2 != 0)
        .map(|(p, ..)| crop(picture, labels, *p, true))
        .collect();
    for _ in 0..ANYWHERE {
        let [u, v] = [picture.width(), picture.height()].map(|size| rng.random_range(0.0..f64::from(size)));
        patches.push(crop(picture, labels, Pixel::new(u, v), false));
    }
    patches
}
