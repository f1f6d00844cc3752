//! A synthetic GP25 with rippling gears and a bending arm, and a camera that sees its tool.

#![allow(dead_code)] // each test file uses its part

use calibration::{Hull, Map, Method, Pair, Settings};
use geometry::{Base, Camera, Point, Transform};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::{FRAC_PI_2, TAU};

pub fn camera_from_base() -> Transform<Camera, Base> {
    let base_from_camera: Transform<Base, Camera> = Transform::from_parts(
        [-400.0, 30.0, 620.0],
        UnitQuaternion::from_euler_angles(-1.62, 0.05, -1.58),
    );
    base_from_camera.inverse()
}

/// Centre of a GP25's wrist: upper arm 760 mm, forearm 795 mm that is 200 mm above the elbow, shoulder 150 mm out and 505 mm up.
pub fn wrist([j1, j2, j3]: [f64; 3]) -> Vector3<f64> {
    let along = j2 - j3 + FRAC_PI_2;
    let forearm = [
        795.0 * along.sin() - 200.0 * along.cos(),
        795.0 * along.cos() + 200.0 * along.sin(),
    ];
    let (out, up) = (
        150.0 + 760.0 * j2.sin() + forearm[0],
        505.0 + 760.0 * j2.cos() + forearm[1],
    );
    Vector3::new(j1.cos() * out, j1.sin() * out, up)
}

pub fn tool(joints: [f64; 3]) -> Vector3<f64> {
    wrist(joints) + Vector3::new(300.0, 40.0, 0.0)
}

/// Where the tool is when it is told to go where these joints bring it: ripple of 0.1 mrad, and a bend of the arm.
pub fn true_tool(joints: [f64; 3]) -> Point<Base> {
    let [j1, j2, j3] = joints;
    let wave = |angle: f64, cycles: f64, phase: f64| 1e-4 * (cycles * angle + phase).sin();
    let rippled = [
        j1 + wave(j1, 38.6, 0.4),
        j2 + wave(j2, 41.0, 1.0),
        j3 + wave(j3, 43.0, 2.0),
    ];
    let p = tool(rippled);
    let [x, y, z] = [(p.x - 1150.0) / 450.0, p.y / 450.0, (p.z - 525.0) / 375.0];
    Point::from_vector(
        p + Vector3::new(
            0.5 * y * z + 0.3 * x * x,
            0.3 * z * z - 0.4 * x * y,
            -0.5 * y * y + 0.2 * x * z,
        ),
    )
}

pub fn gauss(rng: &mut Pcg64Mcg) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (TAU * b).cos()
}

/// Joints that bring the tool somewhere into the cell's volume.
pub fn anywhere(rng: &mut Pcg64Mcg) -> [f64; 3] {
    loop {
        let joints = [
            rng.random_range(-0.7..0.7),
            rng.random_range(0.2..1.2),
            rng.random_range(-1.2..0.4),
        ];
        let p = tool(joints);
        if (950.0..1350.0).contains(&p.x) && p.y.abs() < 450.0 && (150.0..900.0).contains(&p.z) {
            return joints;
        }
    }
}

/// What has happened since the map was fitted.
#[derive(Clone, Copy)]
pub struct World {
    /// How the camera's points have moved.
    pub bump: Isometry3<f64>,
    /// By how much J1 to J3 are off, rad.
    pub zeros: [f64; 3],
}

impl World {
    pub fn untouched() -> Self {
        Self {
            bump: Isometry3::identity(),
            zeros: [0.0; 3],
        }
    }

    /// Where the camera sees the tool that was told to go where these joints bring it.
    pub fn sight(&self, joints: [f64; 3]) -> Point<Camera> {
        let turned = [0, 1, 2].map(|j| joints[j] + self.zeros[j]);
        let then = (camera_from_base() * true_tool(turned)).vector();
        Point::from_vector((self.bump * Point3::from(then)).coords)
    }

    /// Pairs at random places, noise of 0.02 mm across and 0.05 mm along the ray.
    pub fn pairs(&self, seed: u64, n: u64) -> Vec<Pair> {
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        (0..n)
            .map(|id| {
                let joints @ [j1, j2, j3] = anywhere(rng);
                let camera = noisy(self.sight(joints), rng, 0.02, 0.05);
                Pair {
                    id,
                    node: None,
                    t_s: 6.0 * id as f64,
                    command: Point::from_vector(tool(joints)),
                    pixel: None,
                    depth_mm: Some(camera.z_mm()),
                    camera: Some(camera),
                    joints_rad: Some([j1, j2, j3, 0.0, 0.0, 0.0]),
                    valid: true,
                }
            })
            .collect()
    }

    /// 3D errors of a map at 1000 places that it was not fitted to, measured without noise; smallest first.
    pub fn errors(&self, map: &Map, seed: u64) -> Vec<f64> {
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let places = (0..1000).map(|_| anywhere(rng)).collect::<Vec<_>>();
        let found = places.into_iter().map(|joints| {
            let found = map.apply(self.sight(joints));
            (found, Point::from_vector(tool(joints)))
        });
        let mut errors: Vec<f64> = found
            .filter(|(found, _)| found.hull == Hull::Inside)
            .map(|(found, command)| found.base.distance_mm(command))
            .collect();
        errors.sort_by(f64::total_cmp);
        errors
    }
}

/// What the camera measures of the tool there.
pub fn seen(joints: [f64; 3], rng: &mut Pcg64Mcg, across_mm: f64, along_mm: f64) -> Point<Camera> {
    noisy(World::untouched().sight(joints), rng, across_mm, along_mm)
}

fn noisy(at: Point<Camera>, rng: &mut Pcg64Mcg, across_mm: f64, along_mm: f64) -> Point<Camera> {
    let c = at.vector();
    let ray = c.normalize();
    let noise = Vector3::new(gauss(rng), gauss(rng), gauss(rng)) * across_mm;
    Point::from_vector(c + noise + ray * (along_mm * gauss(rng)))
}

pub fn pairs(seed: u64, n: u64) -> Vec<Pair> {
    World::untouched().pairs(seed, n)
}

pub fn gp() -> Settings {
    Settings {
        method: Method::Gp,
        ..Settings::default()
    }
}

/// 3D errors of a map at places that it was not fitted to, measured without noise.
pub fn errors(map: &Map, seed: u64) -> Vec<f64> {
    World::untouched().errors(map, seed)
}
