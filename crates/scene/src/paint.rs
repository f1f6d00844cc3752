//! What sheets, plastic, cables and walls look like from near: colour, dirt, rust, print.

use crate::noise::{Grain, Noise};
use crate::relief::Material;
use crate::shape::{Bounds, Xy};
use rand::RngExt;

/// Kind of a surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Coat {
    /// Paint on steel.
    Painted,
    /// Galvanised steel.
    Zinc,
    /// Plastic or rubber.
    Plastic,
    /// Concrete, plaster, table top.
    Mineral,
}

/// A surface with its wear.
#[derive(Clone, Debug)]
pub(crate) struct Paint {
    pub coat: Coat,
    pub albedo: [f32; 3],
    pub roughness: f32,
    /// Grime, 0 to 1.
    pub dirt: f32,
    /// Rust patches, 0 to 1.
    pub rust: f32,
    pub cloud: Noise,
    pub fine: Noise,
}

impl Paint {
    pub fn new<R: RngExt + ?Sized>(coat: Coat, albedo: [f32; 3], roughness: f32, rng: &mut R) -> Self {
        Self {
            coat,
            albedo,
            roughness,
            dirt: 0.0,
            rust: 0.0,
            cloud: Noise::new(Grain::Cloud, 160.0, rng),
            fine: Noise::new(Grain::Even, 1.6, rng),
        }
    }

    pub fn metallic(&self) -> f32 {
        if self.coat == Coat::Zinc { 1.0 } else { 0.0 }
    }

    /// Material at a place.
    pub fn at(&self, p: Xy) -> Material {
        let cloud = self.cloud.at(p[0], p[1]);
        let fine = self.fine.at(p[0], p[1]);
        let shade = 1.0 + 0.05 * (cloud - 0.5) + 0.03 * (fine - 0.5);
        Material {
            albedo: self.albedo.map(|a| a * shade),
            roughness: self.roughness,
            metallic: self.metallic(),
        }
    }
}

/// A label or print on a layer.
#[derive(Clone, Debug)]
pub(crate) struct Decal {
    pub bounds: Bounds,
}
