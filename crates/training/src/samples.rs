//! Patches to learn from: cut out of rendered faces, with a label for every item in them.

use crate::TrainError;
use geometry::{Pixel, RgbImage};
use image::imageops;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use scene::{FaceId, FaceTruth, FaceView, Prepared, Roi, Unit, UnitOptions};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use vision::layout::Class;

/// Side of a patch, px: a clip with room to shift, turn and scale it.
pub const PATCH_PX: usize = 112;

/// A set of classes, one bit a channel: what a label leaves open is a set of more than one.
pub type Classes = u8;

/// The set of one class.
pub fn only(class: Class) -> Classes {
    1 << class.channel()
}

/// Every fastener: what a photograph labelled "screw" of unknown drive may be.
pub fn any_fastener() -> Classes {
    Class::ALL.iter().filter(|c| c.is_fastener()).map(|&c| only(c)).sum()
}

/// An item in a patch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Label {
    /// Centre in the patch, px.
    pub u_px: f32,
    /// Centre in the patch, px.
    pub v_px: f32,
    /// Diameter, px.
    pub diameter_px: f32,
    /// What it may be; 0: cannot be told, learn nothing from it.
    pub classes: Classes,
    /// True if centre and diameter are exact.
    pub exact: bool,
}

/// A patch of [`PATCH_PX`]² pixels with everything that is in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Patch {
    /// RGB, row by row.
    pub rgb: Vec<u8>,
    /// Items; the first one is what the patch was cut for, if `focused`.
    pub labels: Vec<Label>,
    /// False for a patch of background.
    pub focused: bool,
    /// What is known of places without a label.
    pub elsewhere: Classes,
}

/// The class of a decoy.
pub fn decoy_class(kind: scene::fastener::Decoy) -> Class {
    use scene::fastener::Drive;
    match kind.drive() {
        Some(Drive::Cross) => Class::Cross,
        Some(Drive::Slotted) => Class::Slotted,
        Some(Drive::HexSocket) => Class::HexSocket,
        Some(Drive::Torx) => Class::Torx,
        Some(Drive::HexHead) => Class::HexHead,
        None => Class::OtherFeature,
    }
}

/// Labels of a face in picture pixels.
pub fn labels(truth: &FaceTruth) -> Vec<(Pixel, f64, Classes)> {
    let screws = truth
        .screws
        .iter()
        .map(|s| (s.pixel, s.head_d_px, if s.detectable { only(Class::Cross) } else { 0 }));
    let decoys = truth.decoys.iter().map(|d| {
        (
            d.pixel,
            d.d_px,
            if d.visible_fraction > 0.5 {
                only(decoy_class(d.kind))
            } else {
                0
            },
        )
    });
    screws.chain(decoys).collect()
}

/// Cuts the patch around a place, shifted at random, with the labels that lie in it.
pub fn cut(view: &Prepared, all: &[(Pixel, f64, Classes)], center: Pixel, focused: bool) -> Patch {
    let roi = Roi::around(&view.view().camera, center, PATCH_PX as u32);
    let picture = view.render(Some(roi)).color;
    from_picture(
        &picture,
        all,
        [f64::from(roi.x_px), f64::from(roi.y_px)],
        center,
        focused,
    )
}

/// The patch that a picture of [`PATCH_PX`]² pixels is, whose first pixel is `corner`, with the labels that lie in it, nearest to `center` first.
fn from_picture(
    picture: &RgbImage,
    all: &[(Pixel, f64, Classes)],
    corner: [f64; 2],
    center: Pixel,
    focused: bool,
) -> Patch {
    let margin = 24.0;
    let mut near: Vec<(f64, Label)> = all
        .iter()
        .map(|(p, d, classes)| {
            let label = Label {
                u_px: (p.u_px - corner[0]) as f32,
                v_px: (p.v_px - corner[1]) as f32,
                diameter_px: *d as f32,
                classes: *classes,
                exact: *classes != only(Class::Background), // nothing has no centre
            };
            (p.distance_px(&center), label)
        })
        .filter(|(_, l)| {
            let inside = |c: f32| f64::from(c) > -margin && f64::from(c) < PATCH_PX as f64 + margin;
            inside(l.u_px) && inside(l.v_px)
        })
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    Patch {
        rgb: picture.as_raw().clone(),
        labels: near.into_iter().map(|n| n.1).collect(),
        focused,
        elsewhere: only(Class::Background),
    }
}

/// Cuts the patch around a place out of a picture of at least [`PATCH_PX`] pixels a side, with the labels that lie in it.
pub(crate) fn crop(picture: &RgbImage, all: &[(Pixel, f64, Classes)], center: Pixel, focused: bool) -> Patch {
    let side = PATCH_PX as u32;
    let corner = |c: f64, size: u32| (c.round() as i64 - i64::from(side / 2)).clamp(0, i64::from(size - side)) as u32;
    let (x, y) = (
        corner(center.u_px, picture.width()),
        corner(center.v_px, picture.height()),
    );
    let part = imageops::crop_imm(picture, x, y, side, side).to_image();
    from_picture(&part, all, [f64::from(x), f64::from(y)], center, focused)
}

/// Views of a unit as training sees them: one of every face.
pub fn views(seed: u64) -> Vec<FaceView> {
    let options = UnitOptions::default();
    let unit = Unit::sample_with(seed, &options);
    FaceId::ALL
        .into_iter()
        .enumerate()
        .filter_map(|(k, face)| FaceView::sample(&unit, face, seed.wrapping_mul(0x9E37_79B9).wrapping_add(k as u64)))
        .collect()
}

/// Patches of units `seeds`: every item of every face, and `background` places a face where nothing was put.
///
/// With a `work` folder, each unit's patches are kept there, and taken from there where they are already.
///
/// # Errors
/// [`TrainError`] if a file of the work folder cannot be read or written, or if another renderer made it.
pub fn rendered(
    seeds: std::ops::Range<u64>,
    background: usize,
    work: Option<&Path>,
    done: &(dyn Fn(u64) + Sync),
) -> Result<Vec<Patch>, TrainError> {
    let count = AtomicU64::new(0);
    let file = |folder: &Path, seed: u64| folder.join(format!("unit-{seed:06}-{background}.patches"));
    if let Some((folder, first)) = work.zip(seeds.clone().next())
        && let Some(kept) = read(&file(folder, first))?
        && kept != unit(first, background)
    {
        return Err(TrainError::OtherRenderer { folder: folder.into() });
    }
    let per_unit: Vec<Vec<Patch>> = seeds
        .into_par_iter()
        .map(|seed| {
            let kept = work.map(|folder| read(&file(folder, seed))).transpose()?.flatten();
            let patches = match (kept, work) {
                (Some(kept), _) => kept,
                (None, None) => unit(seed, background),
                (None, Some(folder)) => {
                    let patches = unit(seed, background);
                    write(&file(folder, seed), &patches)?;
                    patches
                }
            };
            done(count.fetch_add(1, Ordering::Relaxed) + 1);
            Ok(patches)
        })
        .collect::<Result<_, TrainError>>()?;
    Ok(per_unit.into_iter().flatten().collect())
}

/// Patches of one unit.
fn unit(seed: u64, background: usize) -> Vec<Patch> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0x9A7C);
    let mut patches = Vec::new();
    for mut view in views(seed) {
        // some screws are out already: what they leave must not be taken for one
        let out: Vec<_> = view
            .design
            .screws
            .iter()
            .map(|s| s.id)
            .filter(|_| rng.random_bool(0.06))
            .collect();
        view.removed_screws = out;
        let prepared = Prepared::new(&view);
        let truth = prepared.truth();
        let all = labels(&truth);
        for (p, _, classes) in &all {
            if *classes != 0 {
                let jitter = |rng: &mut Pcg64Mcg| rng.random_range(-12.0..12.0);
                let center = Pixel::new(p.u_px + jitter(&mut rng), p.v_px + jitter(&mut rng));
                patches.push(cut(&prepared, &all, center, true));
            }
        }
        let (w, h) = (f64::from(view.camera.width_px), f64::from(view.camera.height_px));
        for _ in 0..background {
            // mostly on the unit
            let center = if rng.random_bool(0.8) {
                let at = |rng: &mut Pcg64Mcg, size: f64| rng.random_range(-0.52..0.52) * size;
                let (x, y) = (at(&mut rng, view.design.width_mm), at(&mut rng, view.design.height_mm));
                view.camera
                    .project(view.camera_point(x, y, 0.0))
                    .unwrap_or(Pixel::new(w / 2.0, h / 2.0))
            } else {
                Pixel::new(rng.random_range(0.0..w), rng.random_range(0.0..h))
            };
            patches.push(cut(&prepared, &all, center, false));
        }
    }
    patches
}

/// Patches of a file; `None` where there is none.
fn read(path: &Path) -> Result<Option<Vec<Patch>>, TrainError> {
    match std::fs::read(path) {
        Ok(bytes) => postcard::from_bytes(&bytes)
            .map(Some)
            .map_err(|_| TrainError::Damaged { path: path.into() }),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(TrainError::Data {
            path: path.into(),
            source,
        }),
    }
}

fn write(path: &Path, patches: &[Patch]) -> Result<(), TrainError> {
    let bytes = postcard::to_allocvec(patches).map_err(|_| TrainError::Damaged { path: path.into() })?;
    Ok(geometry::write_aside(path, &bytes)?)
}
