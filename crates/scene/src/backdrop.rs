//! What stands around the unit: wall, floor, the magnetic table, clamps, other hardware.

use crate::layer::{Layer, Sheetwork};
use crate::paint::{Coat, Paint};
use crate::product::FaceDesign;
use crate::shape::Shape;
use rand_pcg::Pcg64Mcg;

/// Adds the surroundings of a face.
pub(crate) fn surround(sheetwork: &mut Sheetwork, _design: &FaceDesign, rng: &mut Pcg64Mcg) {
    let paint = Paint::new(Coat::Mineral, [0.3, 0.3, 0.29], 0.9, rng);
    sheetwork.layers.push(Layer::new(
        Shape::rect([0.0, 0.0], [9000.0, 9000.0], 0.0),
        -700.0,
        0.0,
        0.0,
        paint,
    ));
}
