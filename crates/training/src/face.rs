//! The rendered face that a seed stands for: what tuning and evaluation look at.

use geometry::RgbdFrame;
use scene::{FaceId, FaceTruth, FaceView, Prepared, Unit};

/// A face of a product, as the cell's camera sees it, with everything that is on it.
pub struct Shot {
    /// Colour, depth and camera.
    pub frame: RgbdFrame,
    /// What is on it.
    pub truth: FaceTruth,
}

/// The face of an outdoor unit that a seed stands for.
pub fn face_of(seed: u64) -> FaceId {
    FaceId::ALL[(seed % FaceId::ALL.len() as u64) as usize]
}

/// A drive of the scene by the detector's name for it.
pub fn drive_seen(drive: scene::fastener::Drive) -> vision::Drive {
    match drive {
        scene::fastener::Drive::Cross => vision::Drive::Cross,
        scene::fastener::Drive::Slotted => vision::Drive::Slotted,
        scene::fastener::Drive::HexSocket => vision::Drive::HexSocket,
        scene::fastener::Drive::Torx => vision::Drive::Torx,
        scene::fastener::Drive::HexHead => vision::Drive::HexHead,
    }
}

/// Renders a face; `None` where the product does not have it.
pub fn shot(product: &Unit, face: FaceId, seed: u64) -> Option<Shot> {
    Some(of(FaceView::sample(product, face, seed)?))
}

/// Renders a face from which every screw has been taken out: their holes are left, and all that may be taken for a screw.
pub fn shot_without_screws(product: &Unit, face: FaceId, seed: u64) -> Option<Shot> {
    let mut view = FaceView::sample(product, face, seed)?;
    view.removed_screws = view.design.screws.iter().map(|s| s.id).collect();
    Some(of(view))
}

fn of(view: FaceView) -> Shot {
    let prepared = Prepared::new(&view);
    let truth = prepared.truth();
    let picture = prepared.render(None);
    let frame = RgbdFrame {
        color: picture.color,
        depth: Some(picture.depth),
        camera: Some(view.camera),
        t_s: 0.0,
    };
    Shot { frame, truth }
}
