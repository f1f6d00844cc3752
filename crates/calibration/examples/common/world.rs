//! A GP25 and a pair of cameras with the errors of real ones, drawn from a seed: fast enough for hundreds of calibrations.
//!
//! Arm: lengths, axes and zeros, gravity, ripple of any frequency in every joint, lost motion, repeatability,
//! warming up. Cameras: a lens that its model misses smoothly, depth with bias and noise. Captures: misses and gross outliers.

use calibration::{Pair, Target, Volume, lattice, scattered};
use geometry::{Camera, Pixel, Point};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Lengths of a GP25: shoulder out and up, upper arm, elbow and forearm, flange, mm.
const SHOULDER_MM: [f64; 3] = [150.0, 0.0, 505.0];
const UPPER_MM: [f64; 3] = [0.0, 0.0, 760.0];
const FOREARM_MM: [f64; 3] = [-200.0, 0.0, 795.0];
/// From the centre of the wrist to the marker in the tool's frame: flange and jig, mm.
const TOOL_MM: [f64; 3] = [0.0, -40.0, 400.0];
/// Pixels a radian of the colour camera, and the middle of its picture.
const FOCAL_PX: f64 = 4638.0;
const MIDDLE_PX: [f64; 2] = [2051.5, 1502.5];
/// Distance of the middle of the volume from the camera, mm.
const DISTANCE_MM: f64 = 1580.0;
/// Time of a visit, s.
const VISIT_S: f64 = 5.92;
/// How long arm and cameras run before a capture, in which they warm up for the better part, and how long warming up takes, s.
const BEFORE_S: f64 = 1800.0;
const WARM_UP_S: f64 = 1500.0;

/// How bad arm and cameras are: everything at the tool, mm.
#[derive(Clone, Copy)]
pub struct Severity {
    pub link_mm: f64,
    pub zero_rad: f64,
    pub ripple_mm: f64,
    pub hysteresis_mm: f64,
    pub repeat_mm: f64,
    pub warm_mm: f64,
    pub lens_px: f64,
    pub depth_bias_mm: f64,
    /// Noise of one frame, each axis across the ray, and depth.
    pub noise_px: f64,
    pub noise_depth_mm: f64,
}

impl Severity {
    /// A new arm and cameras as their data sheets say: one frame of depth is sure to 0.1 mm.
    pub const NOMINAL: Self = Self {
        link_mm: 0.25,
        zero_rad: 2e-4,
        ripple_mm: 0.05,
        hysteresis_mm: 0.012,
        repeat_mm: 0.007,
        warm_mm: 0.03,
        lens_px: 0.4,
        depth_bias_mm: 0.25,
        noise_px: 0.06,
        noise_depth_mm: 0.1,
    };
    /// Twice as bad in everything.
    pub const SEVERE: Self = Self {
        link_mm: 0.5,
        zero_rad: 4e-4,
        ripple_mm: 0.1,
        hysteresis_mm: 0.024,
        repeat_mm: 0.014,
        warm_mm: 0.06,
        lens_px: 0.8,
        depth_bias_mm: 0.5,
        noise_px: 0.12,
        noise_depth_mm: 0.25,
    };
}

pub fn gauss(rng: &mut Pcg64Mcg) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (TAU * b).cos()
}

pub fn gauss3(rng: &mut Pcg64Mcg) -> Vector3<f64> {
    Vector3::from_fn(|_, _| gauss(rng))
}

/// A wave of a joint's angle.
#[derive(Clone, Copy)]
struct Wave {
    cycles: f64,
    swing_rad: f64,
    phase_rad: f64,
}

/// A smooth field over the picture or the volume: a few slow cosines of each component.
struct Field(Vec<(Vector3<f64>, f64, Vector3<f64>)>);

impl Field {
    /// `size` is the standard deviation of each component; a wave is at least as long as twice the unit of place.
    fn draw(rng: &mut Pcg64Mcg, size: Vector3<f64>) -> Self {
        let terms = 6;
        Self(
            (0..terms)
                .map(|_| {
                    let slow = gauss3(rng).normalize() * rng.random_range(0.5..3.0);
                    let size = gauss3(rng).component_mul(&size) * (2.0 / f64::from(terms)).sqrt();
                    (slow, rng.random_range(0.0..TAU), size)
                })
                .collect(),
        )
    }

    fn at(&self, place: Vector3<f64>) -> Vector3<f64> {
        self.0
            .iter()
            .map(|(slow, phase, size)| size * (slow.dot(&place) + phase).cos())
            .sum()
    }
}

/// One cell: an arm that carries the marker, and the cameras that see it.
pub struct World {
    severity: Severity,
    base_from_camera: Isometry3<f64>,
    /// What the camera has moved since.
    pub bump: Isometry3<f64>,
    links: [Isometry3<f64>; 4],
    zeros_rad: [f64; 6],
    /// Turn of J2 and J3 for each mm that the forearm and the load reach out.
    sag: [f64; 2],
    waves: [Vec<Wave>; 6],
    warm: Vector3<f64>,
    lens: Field,
    radial: [f64; 2],
}

impl World {
    pub fn new(seed: u64, severity: Severity) -> Self {
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let small = |rng: &mut Pcg64Mcg, mm: f64, rad: f64| {
            let (t, r) = (gauss3(rng) * mm, gauss3(rng) * rad);
            Isometry3::new(t, r)
        };
        // z of the camera along x of the base, its y down
        let looking = Matrix3::from_columns(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
        let looking = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(looking));
        let stands = Isometry3::from_parts(Translation3::new(1150.0 - DISTANCE_MM, 0.0, 540.0), looking);
        let base_from_camera = stands * small(rng, 4.0, 5e-3);
        let links = std::array::from_fn(|_| small(rng, severity.link_mm, 0.5 * severity.zero_rad));
        let zeros_rad = std::array::from_fn(|_| severity.zero_rad * gauss(rng));
        let sag = [1.2e-6, 1.0e-6].map(|s: f64| s * rng.random_range(0.6..1.6));
        let waves = std::array::from_fn(|joint| {
            let first = rng.random_range(35.0..75.0);
            // the second wave: an overtone, or that of another stage of the gear
            let second = if rng.random_range(0.0..1.0) < 0.5 {
                2.0 * first
            } else {
                rng.random_range(80.0..150.0)
            };
            let third = rng.random_range(20.0..200.0);
            // gears of the wrist are as good as the others; their levers are shorter
            let shares: &[(f64, f64)] = if joint < 3 {
                &[(first, 1.0), (second, 0.5), (third, 0.25)]
            } else {
                &[(first, 0.7), (second, 0.3)]
            };
            let wave = |&(cycles, share): &(f64, f64)| Wave {
                cycles,
                swing_rad: share * severity.ripple_mm / 1200.0 * rng.random_range(0.6..1.4),
                phase_rad: rng.random_range(0.0..TAU),
            };
            shares.iter().map(wave).collect()
        });
        let depth = severity.depth_bias_mm;
        let across = severity.lens_px * DISTANCE_MM / FOCAL_PX;
        Self {
            severity,
            base_from_camera,
            bump: Isometry3::identity(),
            links,
            zeros_rad,
            sag,
            waves,
            warm: gauss3(rng) * severity.warm_mm,
            lens: Field::draw(rng, Vector3::new(across, across, depth)),
            radial: [across * gauss(rng), depth * gauss(rng)],
        }
    }

    /// The paper's volume.
    pub fn volume() -> Volume {
        Volume::between(Point::new(950.0, -450.0, 150.0), Point::new(1350.0, 450.0, 900.0))
    }

    /// Where the marker really is, base frame, for encoder angles; `came_from` is the sign of each joint's last motion.
    fn tool(&self, q: [f64; 6], came_from: [f64; 6], warmth: f64) -> Vector3<f64> {
        let lost_rad = self.severity.hysteresis_mm / 1200.0;
        let mut turned = q;
        for (j, t) in turned.iter_mut().enumerate() {
            *t += self.zeros_rad[j] + came_from[j] * lost_rad;
        }
        for (j, waves) in self.waves.iter().enumerate() {
            turned[j] += waves
                .iter()
                .map(|w| w.swing_rad * (w.cycles * q[j] + w.phase_rad).sin())
                .sum::<f64>();
        }
        let elbow = 760.0 * q[1].sin();
        let load = 300.0 + forearm_out(q);
        turned[1] += self.sag[0] * (load + elbow);
        turned[2] -= self.sag[1] * load;
        let turn = |axis: Vector3<f64>, angle: f64| UnitQuaternion::from_scaled_axis(axis * angle);
        let along = turned[1] - turned[2] + FRAC_PI_2;
        let step = |link: &Isometry3<f64>, rotation, mm: [f64; 3]| {
            Isometry3::from_parts(Translation3::identity(), rotation) * Translation3::from(Vector3::from(mm)) * link
        };
        let [shoulder, upper, forearm, tool] = &self.links;
        let lower_turn = turn(Vector3::y(), along - turned[1]);
        let wrist = turn(Vector3::z(), turned[3]) * turn(Vector3::y(), turned[4]) * turn(Vector3::z(), turned[5]);
        let pose = step(shoulder, turn(Vector3::z(), turned[0]), SHOULDER_MM)
            * step(upper, turn(Vector3::y(), turned[1]), UPPER_MM)
            * step(forearm, lower_turn, FOREARM_MM)
            * step(tool, wrist, TOOL_MM);
        pose.translation.vector + self.warm * warmth
    }

    /// What the cameras say of a place in the camera's frame, without noise.
    fn seen(&self, true_camera: Vector3<f64>) -> Vector3<f64> {
        let at = true_camera;
        let ray = Vector3::new(at.x / at.z, at.y / at.z, 0.0) * 3.5;
        let field = self.lens.at(ray + Vector3::z() * ((at.z - DISTANCE_MM) / 300.0));
        let r2 = ray.norm_squared();
        let shift = ray * (self.radial[0] * r2) + Vector3::new(field.x, field.y, 0.0);
        let z = at.z + field.z + self.radial[1] * r2;
        (at + shift) * (z / at.z)
    }

    /// What the cameras say, without noise, of the marker that was told to go to a place when everything is warm.
    pub fn sight(&self, command: Vector3<f64>) -> Point<Camera> {
        Point::from_vector(self.look_with(self.tool(joints(command), [0.0; 6], 1.0)))
    }

    fn look_with(&self, base: Vector3<f64>) -> Vector3<f64> {
        let camera = self.bump * (self.base_from_camera.inverse() * Point3::from(base));
        self.seen(camera.coords)
    }

    /// A visit at a time, s, from where the arm was: a row of a capture with so many frames.
    fn visit(&self, target: &Target, from: [f64; 6], t_s: f64, frames: usize, rng: &mut Pcg64Mcg) -> Pair {
        let q = joints(target.command.vector());
        let came_from = std::array::from_fn(|j| (q[j] - from[j]).signum());
        let warmth = 1.0 - (-(BEFORE_S + t_s) / WARM_UP_S).exp();
        let tool = self.tool(q, came_from, warmth) + gauss3(rng) * self.severity.repeat_mm;
        let seen = self.look_with(tool);
        let [du, dv, dz] = gauss3(rng).map(|g| g / (frames as f64).sqrt()).into();
        let pixel = |a: usize, noise: f64| FOCAL_PX * seen[a] / seen.z + MIDDLE_PX[a] + self.severity.noise_px * noise;
        let depth_mm = seen.z + self.severity.noise_depth_mm * dz;
        Pair {
            t_s,
            joints_rad: Some(q),
            ..row(target, pixel(0, du), pixel(1, dv), depth_mm)
        }
    }

    /// A capture over scattered points, as `calibrate plan` has them; a few markers are missed.
    pub fn capture(&self, seed: u64, points: usize, frames: usize) -> Vec<Pair> {
        let plan = scattered(&Self::volume(), points).unwrap_or_default();
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let mut from = joints(Self::volume().min.vector());
        plan.iter()
            .map(|target| {
                let mut pair = self.visit(target, from, VISIT_S * target.id as f64, frames, rng);
                from = pair.joints_rad.unwrap_or(from);
                if rng.random_range(0.0..1.0) < 0.04 {
                    miss(&mut pair);
                }
                pair
            })
            .collect()
    }

    /// The paper's lattice with one frame a point, misses, a corner that nobody saw, and 0.75 % gross outliers; with their ids.
    pub fn lattice(&self, seed: u64) -> (Vec<Pair>, Vec<u64>) {
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let mut outliers = Vec::new();
        let mut from = joints(Self::volume().min.vector());
        let pairs = lattice(&Self::volume(), 50.0)
            .unwrap_or_default()
            .iter()
            .map(|target| {
                let mut pair = self.visit(target, from, VISIT_S * target.id as f64, 1, rng);
                from = pair.joints_rad.unwrap_or(from);
                let hidden = target.node.is_some_and(|[i, j, k]| i < 3 && j < 4 && k < 3);
                if hidden || rng.random_range(0.0..1.0) < 0.03 {
                    miss(&mut pair);
                } else if rng.random_range(0.0..1.0) < 0.0075 {
                    spoil(&mut pair, rng);
                    outliers.push(pair.id);
                }
                pair
            })
            .collect();
        (pairs, outliers)
    }

    /// Pairs anywhere in the volume, long after the start: everything is warm.
    pub fn fresh(&self, seed: u64, points: usize, frames: usize) -> Vec<Pair> {
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let mut from = joints(Self::volume().min.vector());
        let visit = |id| {
            let target = Target {
                id,
                node: None,
                command: Point::from_vector(anywhere(rng)),
            };
            let pair = self.visit(&target, from, 7200.0, frames, rng);
            from = pair.joints_rad.unwrap_or(from);
            pair
        };
        (0..points as u64).map(visit).collect()
    }
}

/// A place in the volume.
pub fn anywhere(rng: &mut Pcg64Mcg) -> Vector3<f64> {
    World::volume()
        .at(std::array::from_fn(|_| rng.random_range(0.0..1.0)))
        .vector()
}

fn miss(pair: &mut Pair) {
    (pair.valid, pair.camera, pair.pixel, pair.depth_mm) = (false, None, None, None);
}

/// A reflection for the marker, or the background's depth: 1.5 to 60 mm off, across the ray or along it.
pub fn spoil(pair: &mut Pair, rng: &mut Pcg64Mcg) {
    let (Some(pixel), Some(depth)) = (pair.pixel, pair.depth_mm) else {
        return;
    };
    let off_mm = 1.5 * 40f64.powf(rng.random_range(0.0..1.0));
    let target = Target {
        id: pair.id,
        node: pair.node,
        command: pair.command,
    };
    let spoiled = if rng.random_range(0.0..1.0) < 0.5 {
        let side = if rng.random_range(0.0..1.0) < 0.5 { 1.0 } else { -1.0 };
        row(&target, pixel.u_px, pixel.v_px, depth + side * off_mm)
    } else {
        let angle: f64 = rng.random_range(0.0..TAU);
        let off_px = off_mm * FOCAL_PX / depth;
        row(
            &target,
            pixel.u_px + off_px * angle.cos(),
            pixel.v_px + off_px * angle.sin(),
            depth,
        )
    };
    *pair = Pair {
        t_s: pair.t_s,
        joints_rad: pair.joints_rad,
        ..spoiled
    };
}

fn row(target: &Target, u_px: f64, v_px: f64, depth_mm: f64) -> Pair {
    let along = |px: f64, a: usize| (px - MIDDLE_PX[a]) / FOCAL_PX * depth_mm;
    Pair {
        id: target.id,
        node: target.node,
        t_s: 0.0,
        command: target.command,
        pixel: Some(Pixel::new(u_px, v_px)),
        depth_mm: Some(depth_mm),
        camera: Some(Point::new(along(u_px, 0), along(v_px, 1), depth_mm)),
        joints_rad: None,
        valid: true,
    }
}

/// How far the forearm reaches out, mm.
fn forearm_out(q: [f64; 6]) -> f64 {
    let along = q[1] - q[2] + FRAC_PI_2;
    795.0 * along.sin() - 200.0 * along.cos()
}

/// Encoder angles that bring the marker to a place, with the tool along x of the base, rad.
pub fn joints(command: Vector3<f64>) -> [f64; 6] {
    let tool = Matrix3::from_columns(&[Vector3::z(), -Vector3::y(), Vector3::x()]);
    let wrist = command - tool * Vector3::from(TOOL_MM);
    let (out, up) = (wrist.x.hypot(wrist.y) - SHOULDER_MM[0], wrist.z - SHOULDER_MM[2]);
    let (upper, lower) = (UPPER_MM[2], FOREARM_MM[0].hypot(FOREARM_MM[2]));
    let bend = FOREARM_MM[0].atan2(FOREARM_MM[2]);
    let cos = (out * out + up * up - upper * upper - lower * lower) / (2.0 * upper * lower);
    let elbow = cos.clamp(-1.0, 1.0).acos();
    let j1 = wrist.y.atan2(wrist.x);
    let j2 = out.atan2(up) - (lower * elbow.sin()).atan2(upper + lower * elbow.cos());
    let j3 = FRAC_PI_2 - (elbow - bend);
    let turn = |axis: Vector3<f64>, angle: f64| *Rotation3::from_scaled_axis(axis * angle).matrix();
    let forearm = turn(Vector3::z(), j1) * turn(Vector3::y(), j2 - j3 + FRAC_PI_2);
    let rest = forearm.transpose() * tool;
    let j5 = rest[(2, 2)].clamp(-1.0, 1.0).acos();
    [
        j1,
        j2,
        j3,
        rest[(1, 2)].atan2(rest[(0, 2)]),
        j5,
        rest[(2, 1)].atan2(-rest[(2, 0)]),
    ]
}
