//! The calibration jig's marker as the camera sees it.

use crate::render::Rendered;
use crate::sensor::Sensor;
use crate::view::Roi;
use geometry::{Camera, CameraModel, Tool, Transform};

/// A picture of the calibration jig: a white paddle with one coloured disc, whose middle is the origin of the tool frame
/// (z points into the paddle, away from the camera when seen square on; the paddle's handle leaves along +y).
#[derive(Clone, Debug)]
pub struct MarkerView {
    /// The colour camera.
    pub camera: CameraModel,
    /// Where the marker is.
    pub camera_from_marker: Transform<Camera, Tool>,
    /// Seed of the jig (colour, size), of light and of the background: the same for every picture of one calibration.
    pub scene_seed: u64,
    /// Camera settings, and the seed of this exposure's noise.
    pub sensor: Sensor,
}

/// Renders the calibration jig, or only a region of its picture.
pub fn render_marker(view: &MarkerView, roi: Option<Roi>) -> Rendered {
    let design = crate::layout::jig(view.scene_seed);
    let face = crate::view::FaceView {
        design: std::sync::Arc::new(design),
        camera: view.camera,
        camera_from_face: Transform::from_isometry(*view.camera_from_marker.isometry()),
        scene_seed: view.scene_seed,
        sensor: view.sensor.clone(),
        removed_screws: Vec::new(),
    };
    crate::render::render(&face, roi)
}
