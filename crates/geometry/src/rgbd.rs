//! One shot: colour, registered depth, and the camera that made it.

use crate::{CameraModel, DepthMap};
use image::RgbImage;

/// A colour picture with its registered depth.
#[derive(Clone, Debug)]
pub struct RgbdFrame {
    /// Colour, sRGB, 8 bit.
    pub color: RgbImage,
    /// Depth registered to the colour picture, if there is a depth camera.
    pub depth: Option<DepthMap>,
    /// Intrinsics of the colour camera, if known.
    pub camera: Option<CameraModel>,
    /// Time of the exposure in the cell's clock, s.
    pub t_s: f64,
}
