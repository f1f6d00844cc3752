//! The Gaussian process on a synthetic arm with rippling gears: what a hundred points give, what outliers do, whether sigma is true.

use calibration::{Hull, Map, Method, Pair, Settings};
use geometry::{Base, Camera, Point, Transform};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::{FRAC_PI_2, TAU};

fn camera_from_base() -> Transform<Camera, Base> {
    let base_from_camera: Transform<Base, Camera> = Transform::from_parts(
        [-400.0, 30.0, 620.0],
        UnitQuaternion::from_euler_angles(-1.62, 0.05, -1.58),
    );
    base_from_camera.inverse()
}

/// Centre of a GP25's wrist: upper arm 760 mm, forearm 795 mm that is 200 mm above the elbow, shoulder 150 mm out and 505 mm up.
fn wrist([j1, j2, j3]: [f64; 3]) -> Vector3<f64> {
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

fn tool(joints: [f64; 3]) -> Vector3<f64> {
    wrist(joints) + Vector3::new(300.0, 40.0, 0.0)
}

/// Where the tool is when it is told to go where these joints bring it: ripple of 0.1 mrad, and a bend of the arm.
fn true_tool(joints: [f64; 3]) -> Point<Base> {
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

fn gauss(rng: &mut Pcg64Mcg) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (TAU * b).cos()
}

/// Joints that bring the tool somewhere into the cell's volume.
fn anywhere(rng: &mut Pcg64Mcg) -> [f64; 3] {
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

/// What the camera measures of the tool there.
fn seen(joints: [f64; 3], rng: &mut Pcg64Mcg, across_mm: f64, along_mm: f64) -> Point<Camera> {
    let c = (camera_from_base() * true_tool(joints)).vector();
    let ray = c.normalize();
    let noise = Vector3::new(gauss(rng), gauss(rng), gauss(rng)) * across_mm;
    Point::from_vector(c + noise + ray * (along_mm * gauss(rng)))
}

fn pairs(seed: u64, n: u64) -> Vec<Pair> {
    let rng = &mut Pcg64Mcg::seed_from_u64(seed);
    (0..n)
        .map(|id| {
            let joints @ [j1, j2, j3] = anywhere(rng);
            let camera = seen(joints, rng, 0.02, 0.05);
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

fn gp() -> Settings {
    Settings {
        method: Method::Gp,
        ..Settings::default()
    }
}

/// 3D errors of a map at places that it was not fitted to, measured without noise.
fn errors(map: &Map, seed: u64) -> Vec<f64> {
    let rng = &mut Pcg64Mcg::seed_from_u64(seed);
    let places = (0..1000).map(|_| anywhere(rng)).collect::<Vec<_>>();
    let found = places.into_iter().map(|joints| {
        let found = map.apply(camera_from_base() * true_tool(joints));
        (found, Point::from_vector(tool(joints)))
    });
    found
        .filter(|(found, _)| found.hull == Hull::Inside)
        .map(|(found, command)| found.base.distance_mm(command))
        .collect()
}

#[test]
fn joint_angles_take_the_ripple_out() -> Result<(), Box<dyn std::error::Error>> {
    let with = pairs(1, 150);
    let without: Vec<Pair> = with
        .iter()
        .map(|p| Pair {
            joints_rad: None,
            ..p.clone()
        })
        .collect();
    let rms = |pairs: &[Pair], method| -> Result<f64, calibration::FitError> {
        let (map, _) = Map::fit(pairs, &Settings { method, ..gp() })?;
        let errors = errors(&map, 77);
        assert!(errors.len() > 800, "{} inside", errors.len());
        Ok((errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt())
    };
    let (rippled, smooth, lattice) = (
        rms(&with, Method::Gp)?,
        rms(&without, Method::Gp)?,
        rms(&with, Method::Lattice)?,
    );
    assert!(rippled < 0.045, "{rippled}");
    assert!(
        rippled < 0.6 * smooth && smooth < 1.05 * lattice,
        "{rippled} {smooth} {lattice}"
    );
    Ok(())
}

#[test]
fn one_gross_outlier_in_ten_is_found() -> Result<(), Box<dyn std::error::Error>> {
    for seed in 0..5 {
        let mut pairs = pairs(10 + seed, 100);
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        for pair in pairs.iter_mut().step_by(10) {
            let shift = Vector3::new(gauss(rng), gauss(rng), gauss(rng)).normalize() * rng.random_range(2.0..60.0);
            pair.camera = pair.camera.map(|c| Point::from_vector(c.vector() + shift));
            pair.depth_mm = pair.camera.map(|c| c.z_mm());
        }
        let (_, report) = Map::fit(&pairs, &gp())?;
        let caught = report.rejected.iter().filter(|r| r.id % 10 == 0).count();
        assert_eq!(caught, 10, "seed {seed}: {:?}", report.rejected);
        assert!(report.rejected.len() <= 12, "seed {seed}: {:?}", report.rejected);
    }
    Ok(())
}

#[test]
fn sigma_covers_map_and_measurement() -> Result<(), Box<dyn std::error::Error>> {
    let (mut within, mut all) = ([0; 2], 0);
    for seed in 20..26 {
        let (map, _) = Map::fit(&pairs(seed, 120), &gp())?;
        let rng = &mut Pcg64Mcg::seed_from_u64(seed + 1000);
        for _ in 0..300 {
            let joints = anywhere(rng);
            let found = map.apply(seen(joints, rng, 0.02, 0.05));
            if found.hull != Hull::Inside {
                continue;
            }
            let error = found.base.vector() - tool(joints);
            let ray = map.base_from_camera() * (camera_from_base() * true_tool(joints));
            let origin = map.base_from_camera() * Point::<Camera>::new(0.0, 0.0, 0.0);
            let ray = (ray.vector() - origin.vector()).normalize();
            let along = error.dot(&ray);
            let across = (error - ray * along).norm();
            all += 1;
            // 95 % of lengths of two components lie within 2.448 sigma
            within[0] += usize::from(across < 2.448 * found.sigma_lateral_mm);
            within[1] += usize::from(along.abs() < 1.96 * found.sigma_depth_mm);
        }
    }
    for count in within {
        let share = count as f64 / f64::from(all);
        assert!((0.92..0.98).contains(&share), "{within:?} of {all}");
    }
    Ok(())
}

#[test]
fn a_file_gives_the_same_answers() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("map.json");
    // more than the process rests on
    let (map, report) = Map::fit(&pairs(3, 450), &gp())?;
    assert!(report.n_used > 440);
    map.save(&path)?;
    let back = Map::load(&path)?;
    let rng = &mut Pcg64Mcg::seed_from_u64(5);
    for _ in 0..50 {
        let at = seen(anywhere(rng), rng, 0.02, 0.05);
        let (a, b) = (map.apply(at), back.apply(at));
        let off = a.base.distance_mm(b.base);
        assert!(off < 1e-6 && a.hull == b.hull, "{off} mm");
        assert!((a.sigma_depth_mm - b.sigma_depth_mm).abs() < 1e-6);
    }
    Ok(())
}

#[test]
fn what_no_point_supports_is_not_inside() -> Result<(), Box<dyn std::error::Error>> {
    // nothing was visited in one eighth of the volume
    let corner = |p: &Point<Base>| p.x_mm() > 1150.0 && p.y_mm() > 0.0 && p.z_mm() > 525.0;
    let pairs: Vec<Pair> = pairs(7, 150).into_iter().filter(|p| !corner(&p.command)).collect();
    let (map, _) = Map::fit(&pairs, &gp())?;
    let rng = &mut Pcg64Mcg::seed_from_u64(9);
    let (mut inside, mut supported, mut deep, mut deep_inside) = (0, 0, 0, 0);
    for _ in 0..2000 {
        let joints = anywhere(rng);
        let at = Point::from_vector(tool(joints));
        let hull = map.apply(camera_from_base() * true_tool(joints)).hull;
        if !corner(&at) {
            supported += 1;
            inside += usize::from(hull == Hull::Inside);
        } else if at.x_mm() > 1250.0 && at.y_mm() > 150.0 && at.z_mm() > 650.0 {
            deep += 1;
            deep_inside += usize::from(hull == Hull::Inside);
        }
    }
    assert!(inside * 100 > supported * 85, "{inside} of {supported}");
    assert!(deep > 20 && deep_inside == 0, "{deep_inside} of {deep}");
    Ok(())
}
