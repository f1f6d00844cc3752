//! Image to screws (coarse, fine, centre, locate), and image to calibration marker. Inference only: `training` makes the models.
//!
//! The first two steps of the way of one unit: `RgbdFrame` → [`Detector::detect`] → [`Screw`] (pixel ± σ, and `Point<Camera>` where
//! there is depth); a calibration map takes it from there. It is Algorithm 1 of the paper: a high-recall network over the whole
//! picture ([`coarse_map`], [`candidates`]), a high-precision one, or the mean of several, on gamma-corrected clips, and one that looks closer
//! ([`look`]), the centre from outer circle, cross edges, the networks' votes and what stands out in the depth ([`outer_circle`], [`cross`],
//! [`relief()`], [`fuse`]), and the depth of the recess rim ([`locate`]).
//!
//! ```
//! use geometry::RgbdFrame;
//! use vision::{Detector, Options, Verdict};
//! # fn main() -> Result<(), vision::ModelError> {
//! let detector = Detector::embedded()?;
//! let frame = RgbdFrame {
//!     color: image::RgbImage::from_pixel(320, 240, image::Rgb([120; 3])),
//!     depth: None,
//!     camera: None,
//!     t_s: 0.0,
//! };
//! for screw in &detector.detect(&frame, &Options::default()).screws {
//!     if screw.verdict == Verdict::Screw {
//!         println!("{:.1} {:.1} ± {:.2} px", screw.pixel.u_px, screw.pixel.v_px, screw.sigma_px);
//!     }
//! }
//! # Ok(())
//! # }
//! ```

mod center;
mod clip;
mod coarse;
mod components;
mod detect;
mod fine;
pub mod layout;
mod locate;
mod marker;
mod model;
mod overlay;
mod picture;
mod quality;
mod relief;
mod report;
#[cfg(test)]
mod synthetic;

pub use center::{Circle, Cross, Cue, CueCenter, Fused, cross, fuse, outer_circle};
pub use clip::Clip;
pub use coarse::{Candidate, ProbabilityMap, candidates, coarse_map};
pub use detect::{Detections, Detector, Drive, Options, Region, Screw, Timing, Verdict};
pub use fine::{Evidence, look};
pub use locate::{DepthSource, Located, RIM_TERMS, RimProfile, facings, locate, parallax_px};
pub use marker::{LocatedMarker, Marker, MarkerError, MarkerSpec, find_marker, locate_marker};
pub use model::{
    Corrections, EMBEDDED_MODEL, Model, ModelError, Networks, Settings, Thresholds, decode_model, encode_model,
    model_id,
};
pub use overlay::{overlay, verdict_color};
pub use quality::{Doubt, doubts};
pub use relief::relief;
pub use report::{Hull, ImageReport, Mapped, ScrewReport};
