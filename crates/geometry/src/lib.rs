//! Frames, points, transforms, the camera model, RGB-D frames and their files; rates with bounds.
//!
//! Everything else is built on this crate; it uses none of the others. A point knows its frame by type, a transform is
//! named by both ends (`base_from_camera`), pixels of the whole image and of a clip are different types, and lengths are
//! millimetres, angles radians. Pixel (0, 0) is the centre of the top-left pixel; the camera looks along +z, x right, y down.
//!
//! ```
//! use geometry::{Base, Camera, CameraModel, Point, Transform};
//! let camera = CameraModel::pinhole(4104, 3006, 4638.0, 4638.0);
//! let hole: Point<Camera> = Point::new(100.0, -50.0, 1500.0);
//! let pixel = camera.project(hole).expect("in front of the camera");
//! let back = camera.unproject(pixel, 1500.0);
//! assert!(back.distance_mm(hole) < 1e-6);
//! let base_from_camera: Transform<Base, Camera> = Transform::identity();
//! let _in_base: Point<Base> = base_from_camera * hole;
//! ```

mod camera;
mod depth;
mod files;
mod frame;
mod rate;
mod rgbd;

pub use camera::CameraModel;
pub use depth::{DepthMap, SurfaceSample};
pub use files::{
    FileError, read_camera_info, read_color, read_depth, read_rgbd, sha256_hex, write_aside, write_camera_info,
    write_depth_png, write_jpeg, write_png,
};
pub use frame::{Base, Camera, Direction, Face, Flange, Frame, Pixel, Point, Table, Tool, Transform, Unit, space};
pub use rate::{Rate, wilson, wilson_share};
pub use rgbd::RgbdFrame;

/// Re-exported so that users of the crate see the same version.
pub use image::{GrayImage, RgbImage};
