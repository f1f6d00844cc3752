//! What sheets, plastic, cables and walls look like from near: colour, dirt, rust, print.

use crate::noise::{Grain, Noise, smoothstep};
use crate::print::Print;
use crate::relief::Material;
use crate::shape::{Bounds, Xy};
use crate::texture::{Surface, Texture};
use rand::RngExt;
use std::sync::Arc;

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

/// Rust on a sheet: where and what of.
#[derive(Clone)]
struct Rust {
    amount: f32,
    place: Noise,
    grain: Noise,
    body: Texture,
}

/// A surface with its wear.
#[derive(Clone)]
pub(crate) struct Paint {
    pub coat: Coat,
    pub albedo: [f32; 3],
    pub roughness: f32,
    /// Grime, 0 to 1, and its colour.
    pub dirt: f32,
    pub soil: [f32; 3],
    /// Where grime gathers: it grows by 1 over this many mm downward from `low_y`; 0 for no gradient.
    pub fall: [f32; 2],
    rust: Option<Rust>,
    cloud: Noise,
    patch: Noise,
    patch2: Noise,
    fine: Noise,
}

impl std::fmt::Debug for Paint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?} {:?}", self.coat, self.albedo)
    }
}

fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    std::array::from_fn(|k| a[k] + t * (b[k] - a[k]))
}

impl Paint {
    pub fn new<R: RngExt + ?Sized>(coat: Coat, albedo: [f32; 3], roughness: f32, rng: &mut R) -> Self {
        let feature_mm = rng.random_range(110.0..240.0) * if coat == Coat::Mineral { 2.5 } else { 1.0 };
        Self {
            coat,
            albedo,
            roughness,
            dirt: 0.0,
            soil: [0.13, 0.11, 0.085],
            fall: [0.0, 1e6],
            rust: None,
            cloud: Noise::new(Grain::Cloud, feature_mm, rng),
            patch: Noise::new(Grain::Cloud, 0.37 * feature_mm, rng),
            patch2: Noise::new(Grain::Cloud, 0.61 * feature_mm, rng),
            fine: Noise::new(Grain::Even, if coat == Coat::Zinc { 4.0 } else { 1.4 }, rng),
        }
    }

    /// For what lies around the face: its grain is coarser, so that the noise reaches that far.
    pub fn far<R: RngExt + ?Sized>(mut self, rng: &mut R) -> Self {
        self.fine = Noise::new(Grain::Even, 5.0, rng);
        self
    }

    /// With grime of this amount, and rust.
    pub fn worn<R: RngExt + ?Sized>(mut self, dirt: f32, soil: [f32; 3], rust: f32, rng: &mut R) -> Self {
        self.dirt = dirt;
        self.soil = soil;
        if rust > 0.02 {
            self.rust = Some(Rust {
                amount: rust,
                place: Noise::new(Grain::Cloud, rng.random_range(50.0..150.0), rng),
                grain: Noise::new(Grain::Cloud, 14.0, rng),
                body: Texture::new(Surface::Rust, rng.random_range(0.12..0.3), rng),
            });
        }
        self
    }

    pub fn metallic(&self) -> f32 {
        if self.coat == Coat::Zinc { 0.75 } else { 0.0 }
    }

    /// Material at a place, `inset_mm` from the nearest edge of its sheet, where dirt gathers and rust starts.
    pub fn at(&self, p: Xy, inset_mm: f32) -> Material {
        let [x, y] = p;
        let cloud = self.cloud.at(x, y);
        let fine = self.fine.at(x, y);
        let mut out = Material {
            albedo: self.albedo,
            roughness: self.roughness,
            metallic: self.metallic(),
        };
        let shade = match self.coat {
            Coat::Painted => 1.0 + 0.05 * (cloud - 0.5) + 0.025 * (fine - 0.5),
            Coat::Plastic => 1.0 + 0.04 * (cloud - 0.5),
            Coat::Zinc => {
                // spangle: crystals that shine differently
                let crystal = (fine * 6.0) as u32 as f32 / 6.0;
                out.roughness = (out.roughness + 0.07 * (crystal - 0.4)).clamp(0.15, 0.9);
                1.0 + 0.06 * (crystal - 0.5) + 0.12 * (cloud - 0.5)
            }
            Coat::Mineral => 1.0 + 0.5 * (cloud - 0.5) + 0.2 * (fine - 0.5),
        };
        out.albedo = out.albedo.map(|a| (a * shade).min(0.95));
        if self.dirt > 0.01 {
            // two turned copies: the table's repeats do not show
            let patch = 0.55 * self.patch.at(x, y) + 0.45 * self.patch2.at(x, y);
            let edge = 0.5 * (-inset_mm / 2.5).exp() * self.dirt;
            let gradient = ((y - self.fall[0]) / self.fall[1]).clamp(-0.6, 1.0);
            let film = 0.35 * self.dirt * smoothstep(0.25, 0.95, cloud + 0.45 * gradient) + edge * (0.4 + 0.6 * fine);
            let amount = self.dirt * (1.0 + 0.8 * gradient);
            let spots = smoothstep(0.84 - 0.24 * amount, 1.1 - 0.2 * amount, patch) * (0.75 + 0.25 * fine);
            let specks = 0.6 * smoothstep(0.985 - 0.03 * amount, 1.0, fine) * smoothstep(0.3, 0.7, cloud);
            let cover = (film + 0.62 * spots + self.dirt * specks).min(0.92);
            out.albedo = mix(out.albedo, self.soil, cover);
            out.roughness += cover * (0.9 - out.roughness);
            out.metallic *= 1.0 - cover;
        }
        if let Some(rust) = &self.rust {
            let ragged = rust.grain.at(x, y);
            let level = 0.6 * rust.place.at(x, y)
                + 0.4 * cloud
                + 0.1 * (ragged - 0.5)
                + 0.42 * (0.3 + 0.7 * rust.amount) * (-inset_mm / 2.2).exp();
            let edge = 1.0 - 0.2 * rust.amount;
            if level > edge - 0.06 {
                // a yellow halo around the closed rust
                let halo = 0.55 * smoothstep(edge - 0.06, edge + 0.01, level);
                let body = smoothstep(edge, edge + 0.015, level);
                out.albedo = mix(out.albedo, [0.36, 0.17, 0.065], halo * (0.5 + 0.5 * cloud));
                out.albedo = mix(out.albedo, rust.body.at(x, y), body);
                out.roughness += (halo.max(body)) * (0.92 - out.roughness);
                out.metallic *= 1.0 - halo.max(body);
            }
        }
        out
    }
}

/// Something on a layer that is flat: print, run-off, stain, scratch.
#[derive(Clone, Debug)]
pub(crate) enum Decal {
    /// A label or print.
    Label {
        print: Arc<Print>,
        center: Xy,
        /// (cos, sin) of its turn.
        turn: Xy,
        gloss: f32,
    },
    /// Run-off below a source: starts at `from`, `length` mm down.
    Streak {
        from: Xy,
        length: f32,
        width: f32,
        color: [f32; 3],
        strength: f32,
        ragged: Noise,
    },
    /// A blot with ragged edges.
    Stain {
        center: Xy,
        radius: f32,
        color: [f32; 3],
        strength: f32,
        ragged: Noise,
    },
    /// A scratch through the paint.
    Scratch {
        from: Xy,
        to: Xy,
        width: f32,
        color: [f32; 3],
        metallic: f32,
        strength: f32,
    },
}

impl Decal {
    pub fn bounds(&self) -> Bounds {
        match self {
            Decal::Label { print, center, .. } => {
                let r = 0.5 * print.width_mm().hypot(print.height_mm());
                Bounds::around(*center, [r; 2])
            }
            Decal::Streak {
                from, length, width, ..
            } => Bounds {
                low: [from[0] - 2.0 * width, from[1] - width],
                high: [from[0] + 2.0 * width, from[1] + length],
            },
            Decal::Stain { center, radius, .. } => Bounds::around(*center, [1.5 * radius; 2]),
            Decal::Scratch { from, to, width, .. } => Bounds::of_points([*from, *to]).grown(*width),
        }
    }

    /// Lays it over a material.
    pub fn lay(&self, p: Xy, under: &mut Material) {
        match self {
            Decal::Label {
                print,
                center,
                turn,
                gloss,
            } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                let (x, y) = (turn[0] * dx + turn[1] * dy, turn[0] * dy - turn[1] * dx);
                if let Some((color, cover)) = print.at(x, y) {
                    // what soiled the sheet has soiled the label too, but less
                    let soil = mix([1.0; 3], under.albedo.map(|a| (a / 0.6).min(1.0)), 0.15);
                    let color = std::array::from_fn(|k| color[k] * soil[k]);
                    under.albedo = mix(under.albedo, color, cover);
                    under.metallic *= 1.0 - cover;
                    under.roughness += cover * (gloss - under.roughness);
                }
            }
            Decal::Streak {
                from,
                length,
                width,
                color,
                strength,
                ragged,
            } => {
                let (dx, dy) = (p[0] - from[0], p[1] - from[1]);
                if dy < -0.5 * width || dy > *length {
                    return;
                }
                let t = (dy / length).max(0.0);
                // threads: noise drawn out downward
                let thread = ragged.at(dx, 0.12 * dy);
                let half = width * (0.5 + 0.6 * t) * (0.6 + 0.8 * ragged.at(dx * 0.3 + 50.0, 0.03 * dy));
                let across = 1.0 - smoothstep(0.3 * half, half, dx.abs());
                let cover = strength * across * (1.0 - t).powf(0.8) * smoothstep(0.15, 0.75, thread);
                let cover = cover.clamp(0.0, 0.9);
                under.albedo = mix(under.albedo, *color, cover);
                under.roughness += cover * (0.85 - under.roughness);
                under.metallic *= 1.0 - cover;
            }
            Decal::Stain {
                center,
                radius,
                color,
                strength,
                ragged,
            } => {
                let r = (p[0] - center[0]).hypot(p[1] - center[1]) / radius;
                let level = 1.15 - r + 0.9 * (ragged.at(p[0] - center[0], p[1] - center[1]) - 0.5);
                let cover = strength * smoothstep(0.1, 0.6, level);
                under.albedo = mix(under.albedo, *color, cover);
                under.roughness += cover * (0.9 - under.roughness);
                under.metallic *= 1.0 - cover;
            }
            Decal::Scratch {
                from,
                to,
                width,
                color,
                metallic,
                strength,
            } => {
                let (ex, ey) = (to[0] - from[0], to[1] - from[1]);
                let t = (((p[0] - from[0]) * ex + (p[1] - from[1]) * ey) / (ex * ex + ey * ey)).clamp(0.0, 1.0);
                let bow = 0.04 * ex.hypot(ey) * t * (1.0 - t);
                let d = (p[0] - from[0] - t * ex + bow).hypot(p[1] - from[1] - t * ey);
                let cover = strength * (1.0 - smoothstep(0.2 * width, 0.6 * width, d));
                under.albedo = mix(under.albedo, *color, cover);
                under.metallic += cover * (metallic - under.metallic);
            }
        }
    }
}
