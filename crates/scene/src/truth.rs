//! What is really in a picture: for scoring and for training, never for deciding.

use crate::fastener::{Decoy, Drive, Head, Item, Kind, Plating};
use crate::product::ScrewId;
use crate::render::{Prepared, Spot};
use crate::view::FaceView;
use geometry::{Camera, CameraModel, Direction, FileError, Pixel, Point, write_aside};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A screw in a picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScrewTruth {
    /// Which.
    pub id: ScrewId,
    /// Centre of the recess in the plane of its rim.
    pub pixel: Pixel,
    /// The same place in the camera's frame, mm.
    pub point: Point<Camera>,
    /// The screw's axis, out of the head.
    pub axis: Direction<Camera>,
    /// Diameter of the head, mm.
    pub head_d_mm: f64,
    /// Diameter of the head in the picture, px.
    pub head_d_px: f64,
    /// Share of the head that nothing hides and that lies in the picture, 0 to 1.
    pub visible_fraction: f64,
    /// Share of the slot that nothing hides, 0 to 1.
    pub slot_visible_fraction: f64,
    /// Share of the slot that is filled or painted over, 0 to 1.
    pub slot_fill: f64,
    /// Share of the head under dirt, 0 to 1.
    pub head_cover: f64,
    /// At least half of the head and 40 % of the slot show, and the slot is not buried in mud on a dirty head.
    pub detectable: bool,
    /// What wear it shows, in words: `clean`, `rust_heavy`, `mud_slot`, ...
    pub wear: Vec<String>,
    /// Shape of the head.
    pub head: Head,
    /// Surface.
    pub plating: Plating,
}

/// Something that is no cross screw, in a picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DecoyTruth {
    /// What it is.
    pub kind: Decoy,
    /// What drives it, if it is a fastener.
    pub drive: Option<Drive>,
    /// Its middle.
    pub pixel: Pixel,
    /// Its diameter, px.
    pub d_px: f64,
    /// Share of it that nothing hides, 0 to 1.
    pub visible_fraction: f64,
}

/// Everything that is in a picture of a face.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FaceTruth {
    /// The camera.
    pub camera: CameraModel,
    /// Cross screws.
    pub screws: Vec<ScrewTruth>,
    /// Everything that may be taken for one.
    pub decoys: Vec<DecoyTruth>,
}

impl FaceTruth {
    /// Writes `truth_NNNN.json` into a folder; returns its path.
    ///
    /// # Errors
    /// [`FileError::Write`] with the file's name.
    pub fn save(&self, dir: &Path, index: usize) -> Result<PathBuf, FileError> {
        let path = dir.join(format!("truth_{index:04}.json"));
        let text = serde_json::to_vec_pretty(self).map_err(|e| FileError::Encode {
            path: path.clone(),
            reason: e.to_string(),
        })?;
        write_aside(&path, &text)?;
        Ok(path)
    }
}

/// What is in the picture of a view. [`Prepared::truth`] saves work where the view is rendered too.
pub fn truth(view: &FaceView) -> FaceTruth {
    Prepared::new(view).truth()
}

impl Prepared {
    /// What is in the picture.
    pub fn truth(&self) -> FaceTruth {
        let view = self.view();
        let mut screws = Vec::new();
        let mut decoys = Vec::new();
        let ids = view.design.screws.iter().map(|s| Some(s.id));
        for (spot, id) in self.spots.iter().zip(ids.chain(std::iter::repeat(None))) {
            let item = &spot.placed.item;
            match item.kind {
                Kind::Screw { head, .. } => {
                    if let Some(id) = id
                        && let Some(screw) = self.screw_truth(spot, id, head)
                    {
                        screws.push(screw);
                    }
                }
                Kind::Decoy(kind) => {
                    let relief = self.relief(spot);
                    let center = relief.rim_center_mm;
                    let at = self.face_point(spot, center);
                    if let Some(pixel) = view.camera.project(at) {
                        let radius = 0.5 * item.diameter_mm;
                        decoys.push(DecoyTruth {
                            kind,
                            drive: kind.drive(),
                            pixel,
                            d_px: item.diameter_mm / view.camera.pixel_mm(at.z_mm()),
                            visible_fraction: self.seen_share(spot, center, radius),
                        });
                    }
                }
            }
        }
        FaceTruth {
            camera: view.camera,
            screws,
            decoys,
        }
    }

    fn face_point(&self, spot: &Spot, local_mm: [f32; 3]) -> Point<Camera> {
        let placed = &spot.placed;
        self.view().camera_point(
            placed.at_mm[0] + f64::from(local_mm[0]),
            placed.at_mm[1] + f64::from(local_mm[1]),
            placed.height_mm + f64::from(local_mm[2]),
        )
    }

    fn screw_truth(&self, spot: &Spot, id: ScrewId, head: Head) -> Option<ScrewTruth> {
        let view = self.view();
        let item = &spot.placed.item;
        let relief = self.relief(spot);
        let point = self.face_point(spot, relief.rim_center_mm);
        let pixel = view.camera.project(point)?;
        // A little ahead along the axis gives its direction in the camera's frame.
        let ahead: [f32; 3] = std::array::from_fn(|k| relief.rim_center_mm[k] + 100.0 * relief.axis[k]);
        let axis = Direction::from_vector(self.face_point(spot, ahead).vector() - point.vector())?;
        let Kind::Screw { recess_width_mm, .. } = item.kind else {
            return None;
        };
        let visible_fraction = self.seen_share(spot, relief.rim_center_mm, 0.5 * item.diameter_mm);
        let slot_visible_fraction = self.seen_share(spot, relief.rim_center_mm, 0.45 * recess_width_mm)
            * f64::from(relief.slot_visible.clamp(0.0, 1.0));
        let slot_fill = f64::from(relief.slot_fill);
        let head_cover = f64::from(relief.head_cover);
        let buried = slot_fill > 0.8 && head_cover > 0.4;
        Some(ScrewTruth {
            id,
            pixel,
            point,
            axis,
            head_d_mm: item.diameter_mm,
            head_d_px: item.diameter_mm / view.camera.pixel_mm(point.z_mm()),
            visible_fraction,
            slot_visible_fraction,
            slot_fill,
            head_cover,
            detectable: visible_fraction >= 0.5 && slot_visible_fraction >= 0.4 && !buried,
            wear: wear_tags(item, slot_fill, visible_fraction),
            head,
            plating: item.plating,
        })
    }

    /// Share of a disc around a place of an item that no sheet or cable hides and that lies in the picture.
    fn seen_share(&self, spot: &Spot, center_mm: [f32; 3], radius_mm: f64) -> f64 {
        const RINGS: usize = 6;
        let (mut seen, mut all) = (0, 0);
        for ring in 0..RINGS {
            // rings of equal area, the same number of points on each
            let r = radius_mm * ((ring as f64 + 0.5) / RINGS as f64).sqrt();
            for k in 0..16 {
                let angle = (k as f64 + 0.5 * (ring % 2) as f64) * std::f64::consts::TAU / 16.0;
                let local = [
                    center_mm[0] + (r * angle.cos()) as f32,
                    center_mm[1] + (r * angle.sin()) as f32,
                    center_mm[2],
                ];
                all += 1;
                let at = self.face_point(spot, local);
                let inside = self
                    .view()
                    .camera
                    .project(at)
                    .is_some_and(|p| self.view().camera.contains(p));
                if inside && !self.hidden(spot, local) {
                    seen += 1;
                }
            }
        }
        f64::from(seen) / f64::from(all)
    }
}

/// What a person would say of a screw.
fn wear_tags(item: &Item, slot_fill: f64, visible_fraction: f64) -> Vec<String> {
    let w = &item.wear;
    let mut tags = Vec::new();
    let mut say = |condition: bool, tag: &str| {
        if condition {
            tags.push(tag.to_string());
        }
    };
    say(w.rust > 0.6, "rust_heavy");
    say(w.rust > 0.2 && w.rust <= 0.6, "rust");
    say(w.white_rust > 0.35, "white_rust");
    say(w.dirt > 0.35, "dirt");
    say(w.dust > 0.35, "dust");
    say(slot_fill > 0.5 || w.mud_in_slot > 0.4, "mud_slot");
    say(w.paint_over > 0.3, "painted_over");
    say(w.worn_slot > 0.35, "camout");
    say(w.bent_head > 0.3, "bent");
    say(item.tilt_rad > 2f64.to_radians() || item.lift_mm > 0.4, "askew");
    say(w.web > 0.3, "web");
    say(w.chipped > 0.4, "chipped");
    say(visible_fraction < 0.97, "part_covered");
    if tags.is_empty() {
        tags.push("clean".into());
    }
    tags
}
