//! Heads without their recess.

use super::between;
use crate::fastener::Head;
use crate::noise::{Grain, Noise, smoothstep};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

/// Profile of a head's top over its radius.
pub(super) struct Profile {
    pub(super) height: f32,
    pub(super) edge: f32,
    pub(super) power: f32,
    pub(super) bevel: f32,
}

impl Profile {
    /// Height at `rho` (0 middle, 1 rim).
    pub(super) fn at(&self, rho: f32) -> f32 {
        let dome = (1.0 - rho.powf(self.power)).max(0.0).sqrt();
        let mut height = self.height * (self.edge + (1.0 - self.edge) * dome);
        if self.bevel > 0.0 && rho > 1.0 - self.bevel {
            height = height.min(self.height * (self.edge + 0.4 * (1.0 - rho) / self.bevel));
        }
        height
    }
}

pub(super) fn hexagon(u: f32, v: f32) -> f32 {
    let a = u.abs();
    a.max(0.5 * a + 0.866_025_4 * v.abs())
}

/// Top of a hexagon of half width `flat`: flat with the corners chamfered.
pub(super) fn hex_top(u: f32, v: f32, flat: f32, height: f32, chamfer: f32) -> Option<f32> {
    if hexagon(u, v) > flat {
        return None;
    }
    let r = (u * u + v * v).sqrt();
    Some(height - ((r - flat * chamfer).max(0.0) * 0.6) - 0.3 * (hexagon(u, v) - flat + 0.2).max(0.0))
}

/// Concentric turning marks and the waviness of pressing, as a height.
pub(super) fn marks(radius: f32, rng: &mut Pcg64Mcg) -> impl Fn(f32, f32) -> f32 + 'static {
    let turned = if rng.random_bool(0.5) {
        between(rng, 0.002, 0.008)
    } else {
        0.0
    };
    let rings: Vec<f32> = (0..64).map(|_| between(rng, -1.0, 1.0)).collect();
    let wave = Noise::new(Grain::Cloud, radius * between(rng, 0.5, 1.2), rng);
    let depth = between(rng, 0.01, 0.07);
    let grain = Noise::new(Grain::Even, 0.25, rng);
    let grain_depth = between(rng, 0.0, 0.02);
    move |u, v| {
        let r = (u * u + v * v).sqrt() / (0.13 * radius.max(1.0) / 3.0);
        turned * rings[r as usize % 64] + depth * (wave.at(u, v) - 0.5) + grain_depth * (grain.at(u, v) - 0.5)
    }
}

/// A head without its recess.
pub(super) struct HeadShape {
    pub(super) profile: Profile,
    pub(super) top_radius: f32,
    pub(super) washer: Option<[f32; 3]>,
    pub(super) hex: Option<[f32; 4]>,
}

impl HeadShape {
    /// Height above the seat and part (1: washer or flange), `None` outside.
    pub(super) fn top(&self, u: f32, v: f32) -> Option<(f32, u8)> {
        let r = (u * u + v * v).sqrt();
        let mut top = None;
        if let Some([radius, thickness, slope]) = self.washer
            && r < radius
        {
            let edge = ((radius - r) / 0.3).min(1.0);
            let rise = slope * (1.0 - r / radius).max(0.0);
            top = Some((thickness * (0.4 + 0.6 * edge) + rise, 1));
        }
        let above = top.map_or(0.0, |t| t.0);
        let head = if let Some([flat, height, chamfer, dish]) = self.hex {
            hex_top(u, v, flat, height, chamfer).map(|h| {
                let hollow = if dish > 0.0 {
                    dish * (1.0 - smoothstep(0.62, 0.78, r / flat))
                } else {
                    0.0
                };
                h - hollow
            })
        } else {
            (r < self.top_radius).then(|| self.profile.at(r / self.top_radius))
        };
        match head {
            Some(height) if height > above || self.washer.is_none() => Some((height.max(above), 0)),
            _ => top,
        }
    }
}

pub(super) fn head_shape(head: Head, radius: f32, rng: &mut Pcg64Mcg) -> HeadShape {
    let d = 2.0 * radius;
    let dome = |height: f32, edge: f32, power: f32, bevel: f32| Profile {
        height,
        edge,
        power,
        bevel,
    };
    match head {
        Head::Pan => HeadShape {
            profile: dome(
                d * between(rng, 0.3, 0.4),
                between(rng, 0.2, 0.45),
                between(rng, 2.3, 4.5),
                0.0,
            ),
            top_radius: radius,
            washer: None,
            hex: None,
        },
        Head::Truss => HeadShape {
            profile: dome(
                d * between(rng, 0.19, 0.27),
                between(rng, 0.08, 0.2),
                between(rng, 1.9, 2.4),
                0.0,
            ),
            top_radius: radius,
            washer: None,
            hex: None,
        },
        Head::Binding => HeadShape {
            profile: dome(
                d * between(rng, 0.24, 0.32),
                between(rng, 0.25, 0.45),
                between(rng, 2.2, 3.0),
                between(rng, 0.12, 0.25),
            ),
            top_radius: radius,
            washer: None,
            hex: None,
        },
        Head::Washer => {
            let inner = radius * between(rng, 0.62, 0.8);
            let thickness = between(rng, 0.6, 1.2);
            HeadShape {
                profile: dome(
                    thickness + 2.0 * inner * between(rng, 0.3, 0.4),
                    between(rng, 0.4, 0.55),
                    between(rng, 2.3, 4.0),
                    0.0,
                ),
                top_radius: inner,
                washer: Some([radius, thickness, between(rng, 0.0, 0.3)]),
                hex: None,
            }
        }
        Head::HexFlange => {
            let flat = radius * between(rng, 0.62, 0.74);
            let height = d * between(rng, 0.3, 0.42);
            let dish = if rng.random_bool(0.5) {
                between(rng, 0.15, 0.5)
            } else {
                0.0
            };
            HeadShape {
                profile: dome(height, 0.5, 3.0, 0.0),
                top_radius: flat,
                washer: Some([radius, between(rng, 0.5, 0.9), between(rng, 0.5, 1.0)]),
                hex: Some([flat, height, between(rng, 0.88, 1.0), dish]),
            }
        }
    }
}
