//! Outdoor units and their pictures: procedural products, wear, renderer, camera noise, exact truth.

mod backdrop;
pub mod bake;
pub mod fastener;
mod form;
mod layer;
mod layout;
mod marker;
mod noise;
mod paint;
mod print;
mod product;
pub mod relief;
mod render;
mod sensor;
pub mod shade;
mod shape;
mod texture;
mod truth;
mod view;
mod wear;

pub use marker::{MarkerView, render_marker};
pub use product::{Cover, CoverId, Exclusion, FaceDesign, FaceId, Placed, Screw, ScrewId, Theme, Unit, UnitOptions};
pub use render::{Prepared, Rendered, render};
pub use sensor::Sensor;
pub use truth::{DecoyTruth, FaceTruth, ScrewTruth, truth};
pub use view::{FaceView, Roi, camera};
