//! One shot of one face: from where, through which lens, under which light, in which state of disassembly.

use crate::product::{FaceDesign, FaceId, ScrewId, Unit};
use crate::sensor::Sensor;
use geometry::{Camera, CameraModel, Face, Point, Transform};
use nalgebra::UnitQuaternion;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::Arc;

/// Part of a picture, in pixels of the whole picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Roi {
    /// Left column, px.
    pub x_px: u32,
    /// Top row, px.
    pub y_px: u32,
    /// Width, px.
    pub width_px: u32,
    /// Height, px.
    pub height_px: u32,
}

impl Roi {
    /// The square of `side_px` around a pixel, moved inside the picture where it would leave it; its corner is even, so
    /// that depth of half resolution is aligned with it.
    pub fn around(camera: &CameraModel, pixel: geometry::Pixel, side_px: u32) -> Self {
        let place = |c: f64, n: u32| {
            let low = (c - 0.5 * f64::from(side_px) + 0.5).round().max(0.0) as u32;
            low.min(n.saturating_sub(side_px)) & !1
        };
        Self {
            x_px: place(pixel.u_px, camera.width_px),
            y_px: place(pixel.v_px, camera.height_px),
            width_px: side_px.min(camera.width_px),
            height_px: side_px.min(camera.height_px),
        }
    }
}

/// A face in front of the camera.
///
/// Frame of the face for [`camera_from_face`](Self::camera_from_face): x right, y down, z *into* the sheet (so that axes
/// are right-handed and parallel to the camera's when seen square on); a height above the face is a negative z.
#[derive(Clone, Debug)]
pub struct FaceView {
    /// What is seen.
    pub design: Arc<FaceDesign>,
    /// The colour camera.
    pub camera: CameraModel,
    /// Where the face is.
    pub camera_from_face: Transform<Camera, Face>,
    /// Seed of light, background and clutter around the unit: the same for shots that follow one another.
    pub scene_seed: u64,
    /// Camera settings, and the seed of this exposure's noise.
    pub sensor: Sensor,
    /// Screws that are out: an empty hole is left.
    pub removed_screws: Vec<ScrewId>,
}

/// The colour camera of the paper's cell: 4104 x 3006 pixels of 3.45 µm behind a 16 mm lens, each one a little different.
pub fn camera(seed: u64) -> CameraModel {
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0xCA3E_7A00);
    let fx_px = 4638.0 + rng.random_range(-25.0..25.0);
    CameraModel {
        cx_px: 2051.5 + rng.random_range(-18.0..18.0),
        cy_px: 1502.5 + rng.random_range(-18.0..18.0),
        distortion: [
            rng.random_range(-0.085..-0.03),
            rng.random_range(0.02..0.1),
            rng.random_range(-4e-4..4e-4),
            rng.random_range(-4e-4..4e-4),
            0.0,
        ],
        ..CameraModel::pinhole(4104, 3006, fx_px, fx_px * (1.0 + rng.random_range(-4e-4..4e-4)))
    }
}

impl FaceView {
    /// A face as it may stand before the camera: turned by at most 4° in the picture, tilted by at most 6°, about 1.35 to
    /// 1.65 m away, wholly in the picture. `None` if the unit does not have that face.
    pub fn sample(unit: &Unit, face: FaceId, seed: u64) -> Option<Self> {
        let design = unit.face(face)?.clone();
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let camera = camera(rng.random());
        let distance_mm: f64 = rng.random_range(1350.0..1650.0);
        // far enough for the whole face, turned and tilted
        let across = |size: f64, other: f64, field_px: f64| (size + 0.07 * other) * 1.1 * camera.fx_px / field_px;
        let distance_mm = distance_mm
            .max(across(design.width_mm, design.height_mm, 4104.0))
            .max(across(design.height_mm, design.width_mm, 3006.0));
        let yaw_rad: f64 = rng.random_range(-1.0..1.0f64) * 4f64.to_radians();
        let tilt_rad: f64 = rng.random_range(0.0..1.0f64).sqrt() * 6f64.to_radians();
        let toward: f64 = rng.random_range(0.0..std::f64::consts::TAU);
        let rotation = UnitQuaternion::from_scaled_axis(nalgebra::Vector3::new(
            tilt_rad * toward.cos(),
            tilt_rad * toward.sin(),
            0.0,
        )) * UnitQuaternion::from_axis_angle(&nalgebra::Vector3::z_axis(), yaw_rad);
        // What is left of the field of view around the turned face.
        let room = |field_px: f64, size: f64, other: f64| {
            let reach = 0.5 * (size * yaw_rad.cos() + other * yaw_rad.abs().sin()) * 1.05;
            (0.5 * field_px / camera.fx_px * distance_mm - reach).clamp(0.0, 140.0)
        };
        let (rx, ry) = (
            room(4104.0, design.width_mm, design.height_mm),
            room(3006.0, design.height_mm, design.width_mm),
        );
        let offset = [
            rng.random_range(-1.0..1.0) * rx,
            rng.random_range(-1.0..1.0) * ry,
            distance_mm,
        ];
        let mut sensor = Sensor::sample(rng.random());
        let scene_seed = rng.random();
        // The exposure is set up for the product: dark ones get more light, though not all they would need.
        sensor.exposure *= (0.5 / design.brightness().max(0.03)).powf(0.55);
        Some(Self {
            design,
            camera,
            camera_from_face: Transform::from_parts(offset, rotation),
            scene_seed,
            sensor,
            removed_screws: Vec::new(),
        })
    }

    /// A place on the face in the camera's frame: x right, y down from its middle, height out of it, mm.
    pub fn camera_point(&self, x_mm: f64, y_mm: f64, height_mm: f64) -> Point<Camera> {
        self.camera_from_face * Point::new(x_mm, y_mm, -height_mm)
    }

    /// Where every item (screws that are still there first, then decoys) is in the picture: for choosing regions to render.
    pub fn item_pixels(&self) -> Vec<geometry::Pixel> {
        let screws = self.design.screws.iter();
        let there = screws
            .filter(|s| !self.removed_screws.contains(&s.id))
            .map(|s| &s.placed);
        there
            .chain(&self.design.decoys)
            .filter_map(|p| {
                self.camera
                    .project(self.camera_point(p.at_mm[0], p.at_mm[1], p.height_mm))
            })
            .collect()
    }
}
