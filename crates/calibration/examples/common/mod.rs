//! What the examples and the benchmark share.

#![allow(dead_code)] // each uses its part

pub mod world;

use calibration::Method;
use std::fmt;

/// The methods that are compared: name, method, whether exactly as published.
pub const METHODS: [(&str, Method, bool); 6] = [
    ("gp", Method::Gp, false),
    ("lattice, robust", Method::Lattice, false),
    ("lattice, as published", Method::Lattice, true),
    ("thin-plate spline", Method::Tps, false),
    ("affine", Method::Affine, false),
    ("rigid hand-eye", Method::Rigid, false),
];

/// 3D errors, mm.
#[derive(Clone, Default)]
pub struct Errors(pub Vec<f64>);

impl Errors {
    pub fn rms(&self) -> f64 {
        (self.0.iter().map(|e| e * e).sum::<f64>() / self.0.len().max(1) as f64).sqrt()
    }

    /// The error that a share of all does not exceed (nearest rank); NaN of nothing.
    pub fn at(&self, share: f64) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        let rank = ((sorted.len() as f64 * share).ceil() as usize).max(1) - 1;
        sorted.get(rank).copied().unwrap_or(f64::NAN)
    }

    pub fn over(&self, limit_mm: f64) -> f64 {
        let beyond = self.0.iter().filter(|e| **e > limit_mm).count();
        beyond as f64 / self.0.len().max(1) as f64
    }
}

impl fmt::Display for Errors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "rms {:.3}  p95 {:.3}  p99.9 {:.3}  max {:.3} mm  {:6.2} % over 0.35 mm  (n = {})",
            self.rms(),
            self.at(0.95),
            self.at(0.999),
            self.at(1.0),
            100.0 * self.over(0.35),
            self.0.len()
        )
    }
}
