//! Outdoor units and their pictures: procedural products, wear, renderer, camera noise, exact truth.

pub mod bake;
pub mod fastener;
mod form;
mod noise;
pub mod relief;
pub mod shade;
mod texture;
mod wear;
mod backdrop;
mod layer;
mod layout;
mod marker;
mod paint;
mod product;
mod render;
mod sensor;
mod shape;
mod truth;
mod view;

pub use marker::{MarkerView, render_marker};
pub use product::{
    Cover, CoverId, Exclusion, FaceDesign, FaceId, Placed, Screw, ScrewId, Theme, Unit, UnitOptions,
};
pub use render::{Prepared, Rendered, render};
pub use sensor::Sensor;
pub use truth::{DecoyTruth, FaceTruth, ScrewTruth, truth};
pub use view::{FaceView, Roi, camera};
