//! Light and how surfaces answer it: a few area lights, a soft environment for metals to reflect, GGX and diffuse.
//!
//! Everything is in one frame: x right, y down, third axis out of the face toward the viewer. Radiance is relative: a white matt
//! sheet in the middle of the face, seen square on, has about 1.

use crate::relief::Material;
use rand::RngExt;

type Rgb = [f32; 3];
type Vec3 = [f32; 3];

fn dot(a: Vec3, b: Vec3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn unit(a: Vec3) -> Vec3 {
    let scale = 1.0 / dot(a, a).sqrt().max(1e-9);
    a.map(|v| v * scale)
}

fn mix(a: Rgb, b: Rgb, t: f32) -> Rgb {
    [
        a[0] + t * (b[0] - a[0]),
        a[1] + t * (b[1] - a[1]),
        a[2] + t * (b[2] - a[2]),
    ]
}

/// Where a light stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Emitter {
    /// So far that it comes from one direction everywhere (unit vector toward the light).
    Distant {
        /// Unit vector toward the light.
        toward: Vec3,
    },
    /// A lamp near the face: direction and strength change over it.
    Near {
        /// Its place, mm from the middle of the face.
        position_mm: Vec3,
    },
}

/// One area light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Where it stands.
    pub emitter: Emitter,
    /// Radiance it gives a white matt surface facing it in the middle of the face.
    pub strength: Rgb,
    /// Tangent of its angular radius seen from the middle of the face: 0.005 (sun) to 0.6 (large soft box).
    pub softness: f32,
}

/// What of a light arrives at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Incoming {
    /// Unit vector toward the light.
    pub toward: Vec3,
    /// Radiance that a white matt surface facing it would have.
    pub strength: Rgb,
    /// Tangent of its angular radius from here.
    pub softness: f32,
}

impl Light {
    /// The light as seen from a point of the face.
    pub fn at(&self, position_mm: Vec3) -> Incoming {
        match self.emitter {
            Emitter::Distant { toward } => Incoming {
                toward,
                strength: self.strength,
                softness: self.softness,
            },
            Emitter::Near { position_mm: lamp } => {
                let to = [
                    lamp[0] - position_mm[0],
                    lamp[1] - position_mm[1],
                    lamp[2] - position_mm[2],
                ];
                let ratio = dot(lamp, lamp) / dot(to, to).max(1.0);
                // An extended lamp falls off more slowly than a point.
                let ratio = ratio.min(6.0);
                Incoming {
                    toward: unit(to),
                    strength: self.strength.map(|v| v * ratio),
                    softness: self.softness * ratio.sqrt(),
                }
            }
        }
    }
}

/// A bright or dark region of the surroundings, as a lobe on the sphere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lobe {
    /// Unit vector to its middle.
    pub toward: Vec3,
    /// Sharpness: 2 (a third of the sky) to 200 (a lamp).
    pub sharpness: f32,
    /// Radiance added in its middle.
    pub radiance: Rgb,
}

/// What surrounds the unit, as metals reflect it.
#[derive(Clone, Debug, PartialEq)]
pub struct Environment {
    /// Direction in which the surroundings turn from `dark` to `bright`.
    pub up: Vec3,
    /// Radiance opposite to `up`.
    pub dark: Rgb,
    /// Radiance toward `up`.
    pub bright: Rgb,
    /// Soft boxes, windows, ceiling lamps.
    pub lobes: Vec<Lobe>,
    /// Radiance of the sheet itself, seen by what faces sideways.
    pub bounce: Rgb,
}

impl Environment {
    /// Radiance from a direction, blurred by a rough surface's lobe (`spread`: twice the squared GGX alpha).
    fn reflected(&self, direction: Vec3, spread: f32) -> Rgb {
        let t = (0.5 + 0.5 * dot(direction, self.up)).clamp(0.0, 1.0);
        let mut sum = mix(self.dark, self.bright, t * t * (3.0 - 2.0 * t));
        for lobe in &self.lobes {
            let sharpness = lobe.sharpness / (1.0 + lobe.sharpness * spread);
            let x = sharpness * (dot(direction, lobe.toward) - 1.0);
            if x < -12.0 {
                continue;
            }
            let weight = x.exp() * sharpness / lobe.sharpness;
            for (a, b) in sum.iter_mut().zip(lobe.radiance) {
                *a += weight * b;
            }
        }
        // The sheet fills what lies below its own horizon.
        let below = (-direction[2] / (0.1 + spread) * 0.5 + 0.5).clamp(0.0, 1.0);
        mix(sum, self.bounce, below)
    }

    /// Radiance of a white matt surface under the surroundings alone.
    fn diffuse(&self, normal: Vec3) -> Rgb {
        let t = (0.5 + 0.33 * dot(normal, self.up)).clamp(0.0, 1.0);
        let mut sum = mix(self.dark, self.bright, t);
        for lobe in &self.lobes {
            // Solid angle of the lobe over pi, times a cosine widened by the lobe's own width.
            let wrap = 1.0 / (1.0 + lobe.sharpness);
            let cosine = ((dot(normal, lobe.toward) + wrap) / (1.0 + wrap)).max(0.0);
            let weight = 2.0 / lobe.sharpness * cosine;
            for (a, b) in sum.iter_mut().zip(lobe.radiance) {
                *a += weight * b;
            }
        }
        mix(sum, self.bounce, 0.5 - 0.5 * normal[2])
    }
}

/// All light on one face.
#[derive(Clone, Debug, PartialEq)]
pub struct Lighting {
    /// Lights that cast shadows.
    pub lights: Vec<Light>,
    /// The rest.
    pub environment: Environment,
}

/// Linear RGB of a black body, luminance about 1.
fn black_body(kelvin: f32) -> Rgb {
    // Fit to the Planckian locus in linear sRGB, 2500 to 10000 K, divided by its luminance.
    let t = (kelvin / 1000.0).clamp(2.5, 10.0);
    let red = if t < 6.6 { 1.0 } else { (t / 6.6).powf(-0.75) };
    let green = if t < 6.6 {
        (0.39 * (t * 10.0).ln() - 0.632).clamp(0.0, 1.0).powf(2.0)
    } else {
        (t / 6.6).powf(-0.4)
    };
    let blue = if t > 6.6 {
        1.0
    } else {
        (0.543 * (t * 10.0 - 10.0).ln() - 1.196).clamp(0.0, 1.0).powf(2.0)
    };
    let luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue;
    [red / luminance, green / luminance, blue / luminance]
}

fn direction(azimuth: f32, elevation: f32) -> Vec3 {
    [
        azimuth.cos() * elevation.cos(),
        azimuth.sin() * elevation.cos(),
        elevation.sin(),
    ]
}

impl Lighting {
    /// Light as it may be in a plant: from flat to harsh, even to uneven, warm to cold.
    pub fn sample<R: RngExt + ?Sized>(rng: &mut R) -> Lighting {
        use std::f32::consts::TAU;
        let base_kelvin = rng.random_range(3000.0..8000.0_f32);
        let colour = |rng: &mut R| {
            let body = black_body(base_kelvin * rng.random_range(0.8..1.25_f32));
            // Cameras balance most of the cast away.
            mix(body, [1.0; 3], rng.random_range(0.55..0.98))
        };
        // Share of the light that comes from the surroundings: 0.15 is harsh, 0.85 shadowless.
        let ambient = if rng.random_bool(0.6) {
            rng.random_range(0.12..0.4_f32)
        } else {
            rng.random_range(0.4..0.8_f32)
        };
        let count = if rng.random_bool(0.35) {
            1
        } else {
            rng.random_range(2..=4)
        };
        let mut lights = Vec::with_capacity(count);
        for i in 0..count {
            let azimuth = rng.random_range(0.0..TAU);
            let elevation = rng.random_range(0.42..1.35_f32);
            let toward = direction(azimuth, elevation);
            let softness = (0.012_f32.ln() + rng.random::<f32>() * (0.45_f32 / 0.012).ln()).exp();
            let power = if i == 0 { 1.0 } else { rng.random_range(0.1..0.9_f32) };
            let tint = colour(rng);
            let emitter = if rng.random_bool(0.45) {
                let distance = rng.random_range(900.0..3000.0_f32);
                Emitter::Near {
                    position_mm: toward.map(|v| v * distance),
                }
            } else {
                Emitter::Distant { toward }
            };
            lights.push(Light {
                emitter,
                strength: tint.map(|v| v * power),
                softness,
            });
        }
        let level = rng.random_range(0.35..1.0_f32);
        let dark_tint = colour(rng);
        let bright_tint = colour(rng);
        let dark = rng.random_range(0.03..0.8_f32) * level;
        let mut lobes = Vec::new();
        for _ in 0..rng.random_range(2..=6) {
            let azimuth = rng.random_range(0.0..TAU);
            let elevation = rng.random_range(0.15..1.5_f32);
            let sharpness = rng.random_range(1.0..4.5_f32).exp();
            let power = rng.random_range(0.3..2.5_f32) * if sharpness > 20.0 { 3.0 } else { 1.0 };
            let tint = colour(rng);
            lobes.push(Lobe {
                toward: direction(azimuth, elevation),
                sharpness,
                radiance: tint.map(|v| v * power),
            });
        }
        let up = direction(rng.random_range(0.0..TAU), rng.random_range(-0.2..1.3));
        let sheet = rng.random_range(0.1..0.7_f32);
        let mut lighting = Lighting {
            lights,
            environment: Environment {
                up,
                dark: dark_tint.map(|v| v * dark),
                bright: bright_tint.map(|v| v * level),
                lobes,
                bounce: [sheet; 3],
            },
        };
        lighting.balance(ambient);
        lighting
    }

    /// Even light from all sides, no shadows: for tests and for comparing materials.
    pub fn overcast() -> Lighting {
        Lighting {
            lights: Vec::new(),
            environment: Environment {
                up: [0.0, 0.0, 1.0],
                dark: [1.0; 3],
                bright: [1.0; 3],
                lobes: Vec::new(),
                bounce: [0.5; 3],
            },
        }
    }

    /// Scales lights and surroundings so that a white matt sheet has radiance 1, `ambient` of it from the surroundings.
    fn balance(&mut self, ambient: f32) {
        let up = [0.0, 0.0, 1.0];
        let luminance = |c: Rgb| 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
        let mut direct = 0.0;
        for light in &self.lights {
            let incoming = light.at([0.0; 3]);
            direct += luminance(incoming.strength) * incoming.toward[2].max(0.0);
        }
        let scale = (1.0 - ambient) / direct.max(1e-6);
        for light in &mut self.lights {
            light.strength = light.strength.map(|v| v * scale);
        }
        let around = luminance(self.environment.diffuse(up));
        let scale = ambient / around.max(1e-6);
        let environment = &mut self.environment;
        environment.dark = environment.dark.map(|v| v * scale);
        environment.bright = environment.bright.map(|v| v * scale);
        for lobe in &mut environment.lobes {
            lobe.radiance = lobe.radiance.map(|v| v * scale);
        }
    }

    /// Radiance that a surface sends toward the viewer.
    ///
    /// `normal` and `view` (toward the camera) are unit vectors, `visibility` the share of each light of [`Lighting::lights`]
    /// that reaches the point (missing entries count as 1), `open` the share of the surroundings.
    pub fn radiance(
        &self,
        material: &Material,
        normal: Vec3,
        view: Vec3,
        visibility: &[f32],
        open: f32,
        position_mm: Vec3,
    ) -> Rgb {
        let facing = dot(normal, view).clamp(0.02, 1.0);
        let rough = material.roughness.clamp(0.05, 1.0);
        let alpha = rough * rough;
        let metal = material.metallic;
        let specular: Rgb = std::array::from_fn(|i| 0.04 + metal * (material.albedo[i] - 0.04));
        let matt: Rgb = std::array::from_fn(|i| material.albedo[i] * (1.0 - metal) * 0.96);

        // Surroundings: split-sum approximation of the GGX lobe.
        let mirror: Vec3 = std::array::from_fn(|i| 2.0 * facing * normal[i] - view[i]);
        let glossy = self.environment.reflected(mirror, 2.0 * alpha * alpha * facing);
        let soft = self.environment.diffuse(normal);
        let shine = 1.0 - rough;
        let a = (shine * shine).min((-6.43 * facing).exp()) * shine + 0.0425 - 0.0275 * rough;
        let scale = -1.04 * a + 1.04 - 0.572 * rough;
        let bias = 1.04 * a - 0.04 + 0.022 * rough;
        // Rough metals lose energy in the single-bounce model; give it back.
        let regain = 1.0 + metal * 0.6 * alpha;
        let mut out: Rgb = std::array::from_fn(|i| {
            matt[i] * soft[i] * open + (specular[i] * scale + bias) * regain * glossy[i] * open
        });

        for (k, light) in self.lights.iter().enumerate() {
            let seen = visibility.get(k).copied().unwrap_or(1.0);
            if seen <= 0.0 {
                continue;
            }
            let incoming = light.at(position_mm);
            let cosine = dot(normal, incoming.toward);
            let soft = incoming.softness.min(0.9);
            // A wide light still grazes what turns slightly away.
            let lit = ((cosine + 0.5 * soft) / (1.0 + 0.5 * soft)).max(0.0);
            if lit <= 0.0 {
                continue;
            }
            let half = unit([
                incoming.toward[0] + view[0],
                incoming.toward[1] + view[1],
                incoming.toward[2] + view[2],
            ]);
            let nh = dot(normal, half).clamp(0.0, 1.0);
            let vh = dot(view, half).clamp(0.0, 1.0);
            let wide = (alpha + 0.3 * soft).min(1.0);
            let w2 = wide * wide;
            let d = nh * nh * (w2 - 1.0) + 1.0;
            let k = 0.5 * alpha + 0.02;
            let masking = 1.0 / ((facing * (1.0 - k) + k) * (lit * (1.0 - k) + k));
            let lobe = (0.25 * w2 / (d * d) * masking * lit * regain).min(60.0);
            let grazing = (1.0 - vh).powi(5);
            for i in 0..3 {
                let fresnel = specular[i] + (1.0 - specular[i]) * grazing;
                out[i] += seen * incoming.strength[i] * (matt[i] * lit + fresnel * lobe);
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    const UP: Vec3 = [0.0, 0.0, 1.0];

    fn material(albedo: f32, roughness: f32, metallic: f32) -> Material {
        Material {
            albedo: [albedo; 3],
            roughness,
            metallic,
        }
    }

    #[test]
    fn a_white_sheet_has_radiance_about_one() {
        for seed in 0..200 {
            let lighting = Lighting::sample(&mut Pcg64Mcg::seed_from_u64(seed));
            let white = lighting.radiance(&material(1.0, 1.0, 0.0), UP, UP, &[], 1.0, [0.0; 3]);
            let luminance = 0.2126 * white[0] + 0.7152 * white[1] + 0.0722 * white[2];
            assert!((0.8..1.4).contains(&luminance), "seed {seed}: {white:?}");
        }
    }

    #[test]
    fn nothing_sends_back_more_than_it_gets() {
        // Under even light every surface is at most as bright as the light.
        let flat = Lighting::overcast();
        for roughness in [0.1, 0.3, 0.6, 1.0] {
            for slant in [0.0_f32, 0.5, 1.0] {
                let view = [slant.sin(), 0.0, slant.cos()];
                for metallic in [0.0, 1.0] {
                    let out = flat.radiance(&material(1.0, roughness, metallic), UP, view, &[], 1.0, [0.0; 3])[0];
                    assert!((0.55..1.12).contains(&out), "{roughness} {slant} {metallic}: {out}");
                }
            }
        }
    }

    #[test]
    fn a_shadow_and_a_hollow_darken() {
        let lighting = Lighting::sample(&mut Pcg64Mcg::seed_from_u64(7));
        let zinc = material(0.7, 0.4, 1.0);
        let lit = lighting.radiance(&zinc, UP, UP, &[], 1.0, [0.0; 3]);
        let shadow = lighting.radiance(&zinc, UP, UP, &[0.0; 8], 1.0, [0.0; 3]);
        let hollow = lighting.radiance(&zinc, UP, UP, &[0.0; 8], 0.3, [0.0; 3]);
        assert!(lit[1] > shadow[1] && shadow[1] > hollow[1]);
    }

    #[test]
    fn a_near_lamp_fades_with_distance() {
        let lamp = Light {
            emitter: Emitter::Near {
                position_mm: [-500.0, 0.0, 1000.0],
            },
            strength: [1.0; 3],
            softness: 0.05,
        };
        let near = lamp.at([-400.0, 0.0, 0.0]);
        let far = lamp.at([400.0, 0.0, 0.0]);
        assert!(near.strength[0] > far.strength[0]);
        assert!((lamp.at([0.0; 3]).strength[0] - 1.0).abs() < 1e-5);
    }
}
