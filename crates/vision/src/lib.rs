//! Image to screws: coarse, fine, centre, locate; image to calibration marker.

pub mod layout;
mod model;

pub use model::{Corrections, Model, ModelError, Settings, Thresholds, decode_model, encode_model, model_id};
