//! Frames as types: points, directions and transforms that cannot be mixed up.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::{fmt, marker::PhantomData, ops::Mul};

/// A coordinate frame. Implemented by empty marker types only.
pub trait Frame: Copy + Clone + fmt::Debug + PartialEq + Send + Sync + 'static {
    /// Name in messages.
    const NAME: &'static str;
}

macro_rules! frames {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Copy, Clone, Debug, PartialEq, Eq)]
        pub struct $name;
        impl Frame for $name { const NAME: &'static str = $text; }
    )*};
}
frames! {
    /// The colour camera: x right, y down, z forward.
    Camera = "camera";
    /// A robot's base: x forward, y left, z up.
    Base = "base";
    /// A robot's flange.
    Flange = "flange";
    /// The tip of the bit, or the middle of the calibration marker.
    Tool = "tool";
    /// The magnetic table.
    Table = "table";
    /// An outdoor unit.
    Unit = "unit";
    /// One face of a unit: x right, y down, z into the sheet (heights above it are negative).
    Face = "face";
}

/// A point in frame `F`, mm.
#[derive(Copy, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Point<F: Frame> {
    mm: [f64; 3],
    #[serde(skip)]
    frame: PhantomData<F>,
}

impl<F: Frame> Point<F> {
    /// A point from its coordinates, mm.
    pub const fn new(x_mm: f64, y_mm: f64, z_mm: f64) -> Self {
        Self {
            mm: [x_mm, y_mm, z_mm],
            frame: PhantomData,
        }
    }
    /// x, mm.
    pub const fn x_mm(&self) -> f64 {
        self.mm[0]
    }
    /// y, mm.
    pub const fn y_mm(&self) -> f64 {
        self.mm[1]
    }
    /// z, mm.
    pub const fn z_mm(&self) -> f64 {
        self.mm[2]
    }
    /// The three coordinates, mm.
    pub const fn to_array(self) -> [f64; 3] {
        self.mm
    }
    /// As a bare vector, mm: for algebra inside one frame.
    pub fn vector(&self) -> Vector3<f64> {
        Vector3::from(self.mm)
    }
    /// From a bare vector, mm.
    pub fn from_vector(v: Vector3<f64>) -> Self {
        Self::new(v.x, v.y, v.z)
    }
    /// Distance to another point of the same frame, mm.
    pub fn distance_mm(&self, other: Self) -> f64 {
        (self.vector() - other.vector()).norm()
    }
    /// This point moved by `distance_mm` along `direction`.
    pub fn moved(&self, direction: Direction<F>, distance_mm: f64) -> Self {
        Self::from_vector(self.vector() + direction.vector() * distance_mm)
    }
    /// True if no coordinate is NaN or infinite.
    pub fn is_finite(&self) -> bool {
        self.mm.iter().all(|v| v.is_finite())
    }
}

impl<F: Frame> fmt::Debug for Point<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "({:.3}, {:.3}, {:.3}) mm in {}",
            self.mm[0],
            self.mm[1],
            self.mm[2],
            F::NAME
        )
    }
}

/// A unit vector in frame `F`.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Direction<F: Frame> {
    unit: [f64; 3],
    #[serde(skip)]
    frame: PhantomData<F>,
}

impl<F: Frame> Direction<F> {
    /// The direction of a vector; `None` if it has no length.
    pub fn new(x: f64, y: f64, z: f64) -> Option<Self> {
        Self::from_vector(Vector3::new(x, y, z))
    }
    /// The direction of a bare vector; `None` if it has no length.
    pub fn from_vector(v: Vector3<f64>) -> Option<Self> {
        let unit = v.try_normalize(1e-12)?;
        Some(Self {
            unit: unit.into(),
            frame: PhantomData,
        })
    }
    /// As a bare unit vector.
    pub fn vector(&self) -> Vector3<f64> {
        Vector3::from(self.unit)
    }
    /// Angle to another direction, rad.
    pub fn angle_rad(&self, other: Self) -> f64 {
        self.vector().angle(&other.vector())
    }
}

/// A rigid transform: `base_from_camera: Transform<Base, Camera>` takes camera points to base points.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Transform<To: Frame, From: Frame> {
    isometry: Isometry3<f64>,
    #[serde(skip)]
    ends: PhantomData<(To, From)>,
}

impl<To: Frame, From: Frame> Transform<To, From> {
    /// No motion: both frames coincide.
    pub fn identity() -> Self {
        Self::from_isometry(Isometry3::identity())
    }
    /// From a bare isometry (translation in mm).
    pub fn from_isometry(isometry: Isometry3<f64>) -> Self {
        Self {
            isometry,
            ends: PhantomData,
        }
    }
    /// From a translation (mm) and a rotation.
    pub fn from_parts(translation_mm: [f64; 3], rotation: UnitQuaternion<f64>) -> Self {
        Self::from_isometry(Isometry3::from_parts(Translation3::from(translation_mm), rotation))
    }
    /// The bare isometry, translation in mm.
    pub fn isometry(&self) -> &Isometry3<f64> {
        &self.isometry
    }
    /// The way back.
    pub fn inverse(&self) -> Transform<From, To> {
        Transform::from_isometry(self.isometry.inverse())
    }
}

impl<To: Frame, From: Frame> Mul<Point<From>> for Transform<To, From> {
    type Output = Point<To>;
    fn mul(self, p: Point<From>) -> Point<To> {
        let q = self.isometry * Point3::from(p.vector());
        Point::new(q.x, q.y, q.z)
    }
}

impl<To: Frame, From: Frame> Mul<Direction<From>> for Transform<To, From> {
    type Output = Direction<To>;
    fn mul(self, d: Direction<From>) -> Direction<To> {
        let v = self.isometry * d.vector();
        Direction {
            unit: v.into(),
            frame: PhantomData,
        }
    }
}

impl<To: Frame, Mid: Frame, From: Frame> Mul<Transform<Mid, From>> for Transform<To, Mid> {
    type Output = Transform<To, From>;
    fn mul(self, other: Transform<Mid, From>) -> Transform<To, From> {
        Transform::from_isometry(self.isometry * other.isometry)
    }
}

/// The two spaces that pixels live in.
pub mod space {
    /// Pixels of the whole image.
    #[derive(Copy, Clone, Debug, PartialEq, Eq)]
    pub struct Image;
    /// Pixels of a clip cut out of it.
    #[derive(Copy, Clone, Debug, PartialEq, Eq)]
    pub struct Clip;
}

/// A pixel position, sub-pixel; (0, 0) is the centre of the top-left pixel of the space `S`.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pixel<S = space::Image> {
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
    #[serde(skip)]
    space: PhantomData<S>,
}

impl<S> Pixel<S> {
    /// A pixel position.
    pub const fn new(u_px: f64, v_px: f64) -> Self {
        Self {
            u_px,
            v_px,
            space: PhantomData,
        }
    }
    /// Distance to another pixel, px.
    pub fn distance_px(&self, other: &Pixel<S>) -> f64 {
        (self.u_px - other.u_px).hypot(self.v_px - other.v_px)
    }
}

impl Pixel<space::Clip> {
    /// The same place in the whole image, for a clip whose pixel (0, 0) is at `origin` and which is `scale` clip pixels per image pixel.
    pub fn to_image(&self, origin: Pixel<space::Image>, scale: f64) -> Pixel<space::Image> {
        Pixel::new(origin.u_px + self.u_px / scale, origin.v_px + self.v_px / scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn there_and_back(x in -2e3..2e3, y in -2e3..2e3, z in -2e3..2e3, r in -3.0..3.0f64, p in -1.5..1.5f64, w in -3.0..3.0f64) {
            let base_from_camera: Transform<Base, Camera> =
                Transform::from_parts([10.0, -200.0, 3000.0], UnitQuaternion::from_euler_angles(r, p, w));
            let point = Point::new(x, y, z);
            prop_assert!((base_from_camera.inverse() * (base_from_camera * point)).distance_mm(point) < 1e-8);
        }
    }

    #[test]
    fn a_point_is_three_numbers_in_json() -> Result<(), serde_json::Error> {
        let p: Point<Base> = Point::new(1.0, 2.0, 3.0);
        assert_eq!(serde_json::to_string(&p)?, "[1.0,2.0,3.0]");
        assert_eq!(serde_json::from_str::<Point<Base>>("[1.0,2.0,3.0]")?, p);
        Ok(())
    }
}
