//! Outdoor units and their pictures: procedural products, wear, renderer, camera noise, exact truth.
//!
//! This crate stands in for the world. `training` draws labelled pictures from it, `sim` puts its units before the
//! simulated camera; nothing that decides (`vision`, `calibration`, `cell`) may use it. A [`Unit`] is drawn from a seed: its
//! faces are stacked sheets with ribs, openings, labels and cables, and on them screws and what may be taken for screws,
//! each an item that is baked into a relief when it is first seen. A [`FaceView`] puts one face before a camera, [`render`]
//! photographs it, [`truth`] says what is in the picture. Everything follows from seeds; a region of a picture costs only
//! its share and has the pixels of the whole.
//!
//! ```
//! use scene::{FaceId, FaceView, Prepared, Roi, Unit};
//! let unit = Unit::sample(7);
//! let view = FaceView::sample(&unit, FaceId::Front, 1).expect("every unit has a front");
//! let prepared = Prepared::new(&view);
//! let screw = &prepared.truth().screws[0];
//! let clip = prepared.render(Some(Roi::around(&view.camera, screw.pixel, 96)));
//! assert_eq!(clip.color.dimensions(), (96, 96));
//! ```

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
