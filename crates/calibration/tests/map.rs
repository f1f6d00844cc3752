//! Maps on synthetic cells whose truth is known: what is recovered, what outliers and holes do, whether sigma is true.

use calibration::{
    FitError, Hull, Identity, Map, MapError, Method, Pair, Settings, Volume, camera_identity, lattice, verify,
};
use geometry::{Base, Camera, CameraModel, Pixel, Point, Transform};
use nalgebra::{UnitQuaternion, Vector3};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

fn volume() -> Volume {
    Volume::between(Point::new(950.0, -450.0, 150.0), Point::new(1350.0, 450.0, 900.0))
}

/// A camera that looks at the volume from its front, 1.5 m away.
fn camera_from_base() -> Transform<Camera, Base> {
    let base_from_camera: Transform<Base, Camera> = Transform::from_parts(
        [-400.0, 30.0, 620.0],
        UnitQuaternion::from_euler_angles(-1.62, 0.05, -1.58),
    );
    base_from_camera.inverse()
}

/// An arm and a lens with the errors of real ones: bending, zero errors, ripple of the gears, a lens model that is a little off.
fn warped(p: Point<Base>) -> Point<Base> {
    let [x, y, z] = [
        (p.x_mm() - 1150.0) / 450.0,
        p.y_mm() / 450.0,
        (p.z_mm() - 525.0) / 375.0,
    ];
    let ripple = (p.y_mm() / 55.0).sin() * 0.05;
    Point::new(
        p.x_mm() + 0.8 * y * z + 0.5 * x * x - 0.3 * y * y * y + ripple,
        p.y_mm() - 0.6 * x * y + 0.4 * z * z + 0.2 * y * y * y,
        p.z_mm() - 0.9 * y * y + 0.3 * x * z - 0.2 * z * z * x + ripple,
    )
}

fn pair(id: u64, node: Option<[i32; 3]>, command: Point<Base>, camera: Point<Camera>) -> Pair {
    Pair {
        id,
        node,
        t_s: 6.0 * id as f64,
        command,
        pixel: Some(Pixel::new(
            2050.0 + 4600.0 * camera.x_mm() / camera.z_mm(),
            1500.0 + 4600.0 * camera.y_mm() / camera.z_mm(),
        )),
        depth_mm: Some(camera.z_mm()),
        camera: Some(camera),
        joints_rad: None,
        valid: true,
    }
}

fn gauss(rng: &mut Pcg64Mcg) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// What the camera measures of a point: noise across the ray and more along it.
fn measured(true_camera: Point<Camera>, rng: &mut Pcg64Mcg, lateral_mm: f64, depth_mm: f64) -> Point<Camera> {
    let c = true_camera.vector();
    let z = c.z + depth_mm * gauss(rng);
    let shift = Vector3::new(lateral_mm * gauss(rng), lateral_mm * gauss(rng), 0.0);
    Point::from_vector(c * (z / c.z) + shift)
}

fn anywhere(rng: &mut Pcg64Mcg) -> Point<Base> {
    let (min, extent) = (volume().min.to_array(), volume().extent_mm());
    let mut at = |a: usize| min[a] + extent[a] * rng.random_range(0.0..1.0);
    Point::new(at(0), at(1), at(2))
}

fn perfect(spacing_mm: f64, world: impl Fn(Point<Base>) -> Point<Base>) -> Vec<Pair> {
    let targets = lattice(&volume(), spacing_mm).expect("a lattice");
    targets
        .iter()
        .map(|t| pair(t.id, t.node, t.command, camera_from_base() * world(t.command)))
        .collect()
}

fn noisy_lattice(seed: u64, lateral_mm: f64, depth_mm: f64) -> Vec<Pair> {
    let rng = &mut Pcg64Mcg::seed_from_u64(seed);
    let mut pairs = perfect(50.0, warped);
    for pair in &mut pairs {
        let seen = measured(pair.camera.expect("seen"), rng, lateral_mm, depth_mm);
        *pair = self::pair(pair.id, pair.node, pair.command, seen);
    }
    pairs
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn a_rigid_world_is_recovered(roll in -3.0..3.0f64, pitch in -1.4..1.4f64, yaw in -3.0..3.0f64, x in -900.0..900.0f64, seed in 0u64..1000) {
        let camera_from_base: Transform<Camera, Base> =
            Transform::from_parts([x, 100.0, 2500.0], UnitQuaternion::from_euler_angles(roll, pitch, yaw));
        let targets = lattice(&volume(), 150.0).expect("a lattice");
        let pairs: Vec<Pair> = targets.iter().map(|t| pair(t.id, t.node, t.command, camera_from_base * t.command)).collect();
        let query = anywhere(&mut Pcg64Mcg::seed_from_u64(seed));
        for method in [Method::Rigid, Method::Affine, Method::Lattice, Method::Gp] {
            let (map, report) = Map::fit(&pairs, &Settings { method, ..Settings::default() }).expect("a map");
            let found = map.apply(camera_from_base * query);
            prop_assert!(found.base.distance_mm(query) < 1e-6, "{method:?}: {:?}", found.base);
            prop_assert_eq!(found.hull, Hull::Inside);
            prop_assert!(report.rejected.is_empty());
        }
    }
}

#[test]
fn a_quadratic_warp_is_recovered() {
    let bend = |p: Point<Base>| {
        let [x, y, z] = [
            (p.x_mm() - 1150.0) / 450.0,
            p.y_mm() / 450.0,
            (p.z_mm() - 525.0) / 375.0,
        ];
        Point::new(
            p.x_mm() + 2.0 * y * z + x * x,
            p.y_mm() - 1.5 * x * y,
            p.z_mm() - 3.0 * y * y + x * z,
        )
    };
    let rng = &mut Pcg64Mcg::seed_from_u64(5);
    let scattered: Vec<Pair> = (0..200)
        .map(|id| {
            let command = anywhere(rng);
            pair(id, None, command, camera_from_base() * bend(command))
        })
        .collect();
    for pairs in [perfect(100.0, bend), scattered] {
        let (map, _) = Map::fit(&pairs, &Settings::default()).expect("a map");
        let (affine, _) = Map::fit(
            &pairs,
            &Settings {
                method: Method::Affine,
                ..Settings::default()
            },
        )
        .expect("a map");
        let (mut worst, mut worst_affine) = (0.0f64, 0.0f64);
        for _ in 0..500 {
            let truth = anywhere(rng);
            let seen = camera_from_base() * bend(truth);
            let found = map.apply(seen);
            if found.hull == Hull::Inside {
                worst = worst.max(found.base.distance_mm(truth));
            }
            worst_affine = worst_affine.max(affine.apply(seen).base.distance_mm(truth));
        }
        assert!(worst < 0.02, "{worst}");
        assert!(worst_affine > 1.0, "the warp must be worth correcting: {worst_affine}");
    }
}

/// 0.75 % outliers, 3 % misses and a missing corner, as a night's capture has them.
fn spoiled(seed: u64) -> (Vec<Pair>, Vec<u64>) {
    let mut pairs = noisy_lattice(seed, 0.05, 0.12);
    let rng = &mut Pcg64Mcg::seed_from_u64(seed ^ 0xbad);
    let mut outliers = Vec::new();
    for pair in &mut pairs {
        let node = pair.node.expect("on the lattice");
        let missed = rng.random_range(0.0..1.0) < 0.03;
        if missed || (node[0] < 3 && node[1] < 4 && node[2] < 3) {
            pair.valid = false;
            pair.camera = None;
        } else if rng.random_range(0.0..1.0) < 0.0075 {
            let seen = pair.camera.expect("seen").vector();
            let size = 2.0 * 50f64.powf(rng.random_range(0.0..1.0));
            let off = Vector3::from_fn(|_, _| gauss(rng)).normalize() * size;
            *pair = self::pair(pair.id, pair.node, pair.command, Point::from_vector(seen + off));
            outliers.push(pair.id);
        }
    }
    (pairs, outliers)
}

#[test]
fn outliers_and_holes_do_no_harm() {
    let (pairs, outliers) = spoiled(11);
    assert!(outliers.len() > 12);
    let worst_of = |method: Method, as_published: bool| {
        let (map, report) = Map::fit(
            &pairs,
            &Settings {
                method,
                as_published,
                ..Settings::default()
            },
        )
        .expect("a map");
        let rng = &mut Pcg64Mcg::seed_from_u64(3);
        let (mut inside, mut worst) = (0, 0.0f64);
        for _ in 0..4000 {
            let truth = anywhere(rng);
            let found = map.apply(camera_from_base() * warped(truth));
            if found.hull == Hull::Inside {
                inside += 1;
                worst = worst.max(found.base.distance_mm(truth));
            }
        }
        (worst, inside, report)
    };
    for method in [Method::Lattice, Method::Gp] {
        let (worst, inside, report) = worst_of(method, false);
        assert!(worst < 0.35, "{worst}");
        assert!(inside > 3900, "most of the volume stays usable: {inside}");
        let rejected: Vec<u64> = report.rejected.iter().map(|r| r.id).collect();
        assert!(
            outliers.iter().all(|id| rejected.contains(id)),
            "missed one of {outliers:?}: {rejected:?}"
        );
        assert!(rejected.len() <= outliers.len() + 3, "lost good pairs: {rejected:?}");
        assert!(report.held_out.total.max_mm < 0.8);
    }
    let (published, ..) = worst_of(Method::Lattice, true);
    assert!(
        published > 5.0,
        "without rejection the same pairs must be harmful: {published}"
    );
}

#[test]
fn the_missing_corner_is_not_inside() {
    let (pairs, _) = spoiled(12);
    let lattice = Settings {
        method: Method::Lattice,
        ..Settings::default()
    };
    let (map, report) = Map::fit(&pairs, &lattice).expect("a map");
    assert!(
        report.neighbourhoods.len() > 1,
        "the fallback was needed: {:?}",
        report.neighbourhoods
    );
    let at = |x, y, z| map.apply(camera_from_base() * warped(Point::new(x, y, z)));
    let middle = at(1150.0, 0.0, 500.0);
    assert_eq!(middle.hull, Hull::Inside);
    let corner = at(965.0, -440.0, 160.0);
    assert_ne!(corner.hull, Hull::Inside);
    assert!(
        corner.sigma_depth_mm > 1.2 * middle.sigma_depth_mm,
        "{corner:?} {middle:?}"
    );
    // extrapolated over 150 mm, and still near
    assert!(corner.base.distance_mm(Point::new(965.0, -440.0, 160.0)) < 1.5);
    assert_eq!(at(1370.0, 0.0, 500.0).hull, Hull::Edge);
    assert_eq!(at(1420.0, 0.0, 500.0).hull, Hull::Outside);
    assert_eq!(map.apply(Point::new(f64::NAN, 0.0, 1500.0)).hull, Hull::Outside);
    let far = map.apply(Point::new(9e5, -3e5, 40.0));
    assert!(far.hull == Hull::Outside && far.base.is_finite());
}

#[test]
fn stated_sigma_is_true() {
    // fresh, noisy observations: 68 % of the error components within sigma
    let rng = &mut Pcg64Mcg::seed_from_u64(77);
    let scattered: Vec<Pair> = (0..150)
        .map(|id| {
            let command = anywhere(rng);
            pair(
                id,
                None,
                command,
                measured(camera_from_base() * warped(command), rng, 0.06, 0.15),
            )
        })
        .collect();
    for pairs in [noisy_lattice(21, 0.06, 0.15), scattered] {
        let (map, _) = Map::fit(&pairs, &Settings::default()).expect("a map");
        let (mut lateral, mut depth, n) = (0, 0, 4000);
        for _ in 0..n {
            let truth = anywhere(rng);
            let found = map.apply(measured(camera_from_base() * warped(truth), rng, 0.06, 0.15));
            let error = found.base.vector() - truth.vector();
            let ray = (truth.vector() - Vector3::new(-400.0, 30.0, 620.0)).normalize();
            let across = ray.cross(&Vector3::z()).normalize();
            lateral += usize::from(error.dot(&across).abs() < found.sigma_lateral_mm);
            depth += usize::from(error.dot(&ray).abs() < found.sigma_depth_mm);
        }
        for within in [lateral, depth] {
            let share = within as f64 / f64::from(n);
            assert!((0.60..0.78).contains(&share), "{} pairs: {share}", pairs.len());
        }
    }
}

#[test]
fn a_map_survives_its_file_and_knows_its_cell() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("left.map.json");
    let identity = Identity {
        arm: "left".into(),
        camera: camera_identity(&CameraModel::pinhole(4104, 3006, 4638.0, 4638.0)),
    };
    let settings = Settings {
        identity: identity.clone(),
        date: "2026-11-22T01:30:00Z".into(),
        method: Method::Lattice,
        ..Settings::default()
    };
    let (pairs, _) = spoiled(13);
    let (map, report) = Map::fit(&pairs, &settings).expect("a map");
    map.save(&path).expect("saved");
    let back = Map::load_for(&path, &identity).expect("loaded");
    assert_eq!(back.settings(), &settings);
    assert_eq!(back.held_out().n, report.n_used);
    assert_eq!(back.pairs_sha256(), map.pairs_sha256());
    let rng = &mut Pcg64Mcg::seed_from_u64(1);
    for _ in 0..200 {
        let seen = camera_from_base() * anywhere(rng);
        let (a, b) = (map.apply(seen), back.apply(seen));
        assert!(
            a.base.distance_mm(b.base) < 1e-9 && a.hull == b.hull && (a.sigma_depth_mm - b.sigma_depth_mm).abs() < 1e-9
        );
    }

    let other = Identity {
        camera: camera_identity(&CameraModel::pinhole(4104, 3006, 4639.0, 4638.0)),
        ..identity.clone()
    };
    assert!(matches!(
        Map::load_for(&path, &other),
        Err(MapError::WrongCamera { .. })
    ));
    let other = Identity {
        arm: "right".into(),
        ..identity
    };
    assert!(matches!(Map::load_for(&path, &other), Err(MapError::WrongArm { .. })));
    let text = std::fs::read_to_string(&path).expect("text");
    let refused = |text: &str| {
        std::fs::write(&path, text).expect("written");
        Map::load(&path).expect_err("must be refused")
    };
    assert!(matches!(
        refused(&text.replacen("\"version\":2", "\"version\":5", 1)),
        MapError::Version { found: 5, .. }
    ));
    assert!(matches!(refused(&text[..text.len() / 2]), MapError::Format { .. }));
    assert!(matches!(
        refused("{\"format\":\"other\",\"version\":1}"),
        MapError::Format { .. }
    ));
    assert!(matches!(Map::load(dir.path()), Err(MapError::Read { .. })));
}

#[test]
fn verification_passes_and_fails() {
    let rng = &mut Pcg64Mcg::seed_from_u64(31);
    let (map, _) = Map::fit(&noisy_lattice(30, 0.03, 0.06), &Settings::default()).expect("a map");
    let bump: Transform<Camera, Camera> =
        Transform::from_parts([1.0, 0.0, 0.3], UnitQuaternion::from_euler_angles(0.0, 0.002, 0.0));
    let (mut fresh, mut bumped) = (Vec::new(), Vec::new());
    for id in 0..20 {
        let command = anywhere(rng);
        let seen = measured(camera_from_base() * warped(command), rng, 0.03, 0.06);
        fresh.push(pair(id, None, command, seen));
        bumped.push(pair(id, None, command, bump * seen));
    }
    let good = verify(&map, &fresh, 0.35);
    assert!(good.passed && good.figures.n == 20, "{good}");
    let bad = verify(&map, &bumped, 0.35);
    assert!(!bad.passed && bad.to_string().contains("FAILED: 95 %"), "{bad}");
    assert!(Vector3::from(bad.mean_error_mm).norm() > 0.8);
}

#[test]
fn what_cannot_be_meant_is_refused_in_words() {
    let pairs = perfect(150.0, warped);
    let error = |change: &dyn Fn(&mut Pair)| {
        let mut changed = pairs.clone();
        changed.iter_mut().for_each(change);
        Map::fit(&changed, &Settings::default()).expect_err("must be refused")
    };
    let camera = |p: &mut Pair, f: &dyn Fn([f64; 3]) -> [f64; 3]| {
        let [x, y, z] = f(p.camera.expect("seen").to_array());
        p.camera = Some(Point::new(x, y, z));
    };
    let metres = error(&|p| {
        camera(p, &|c| c.map(|v| v / 1000.0));
        p.depth_mm = p.depth_mm.map(|d| d / 1000.0);
    });
    assert!(
        matches!(metres, FitError::Metres { column: "cam_*_mm", .. }),
        "{metres}"
    );
    let metres = error(&|p| p.command = Point::from_vector(p.command.vector() / 1000.0));
    assert!(
        matches!(metres, FitError::Metres { column: "cmd_*_mm", .. }),
        "{metres}"
    );
    let metres = error(&|p| p.depth_mm = p.depth_mm.map(|d| d / 1000.0));
    assert!(
        matches!(metres, FitError::Metres { column: "depth_mm", .. }),
        "{metres}"
    );
    let swapped = error(&|p| camera(p, &|[x, y, z]| [z, y, x]));
    assert!(
        matches!(swapped, FitError::Swapped { second: "cam_x_mm", .. }),
        "{swapped}"
    );
    let swapped = error(&|p| p.pixel = p.pixel.map(|px| Pixel::new(px.v_px, px.u_px)));
    assert!(matches!(swapped, FitError::Swapped { first: "u_px", .. }), "{swapped}");
    let swapped = error(&|p| camera(p, &|[x, y, z]| [y, x, z]));
    assert!(
        matches!(swapped, FitError::Swapped { first: "cam_x_mm", .. }),
        "{swapped}"
    );
    let mirrored = error(&|p| p.command = Point::new(p.command.y_mm(), p.command.x_mm(), p.command.z_mm()));
    assert!(matches!(mirrored, FitError::Mirrored { .. }), "{mirrored}");
    let flat = error(&|p| p.valid = p.node.is_some_and(|n| n[0] == 1));
    assert!(matches!(flat, FitError::Coplanar { .. }), "{flat}");
    let few = error(&|p| p.valid = p.id < 12);
    assert!(matches!(few, FitError::TooFew { have: 12, need: 20, .. }), "{few}");
    let double = error(&|p| p.id = p.id.min(100));
    assert!(matches!(double, FitError::DuplicateId { id: 100 }), "{double}");
    let nan = error(&|p| {
        if p.id == 5 {
            camera(p, &|[x, y, _]| [x, y, f64::NAN]);
        }
    });
    assert!(matches!(nan, FitError::NotFinite { id: 5 }), "{nan}");
    let mut shifted = pairs.clone();
    let commands: Vec<_> = pairs.iter().map(|p| p.command).collect();
    shifted
        .iter_mut()
        .enumerate()
        .for_each(|(i, p)| p.command = commands[(i * 37) % commands.len()]);
    assert!(matches!(
        Map::fit(&shifted, &Settings::default()),
        Err(FitError::NotRigid { .. })
    ));
}

#[test]
fn the_same_pairs_give_the_same_map() {
    let (pairs, _) = spoiled(14);
    let bytes = |name: &str| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join(name);
        let (map, _) = Map::fit(&pairs, &Settings::default()).expect("a map");
        map.save(&path).expect("saved");
        std::fs::read(&path).expect("bytes")
    };
    assert_eq!(bytes("a"), bytes("b"));
}

#[test]
fn a_coarse_lattice_is_enough_to_start_with() {
    // what a first run takes the time for: 7 x 4 x 6 nodes at 150 mm, one missed and one outlier
    let rng = &mut Pcg64Mcg::seed_from_u64(41);
    let mut pairs = perfect(150.0, warped);
    for p in &mut pairs {
        let shift = if p.id == 60 { 9.0 } else { 0.0 };
        let seen = measured(p.camera.expect("seen"), rng, 0.05, 0.1)
            .moved(geometry::Direction::new(1.0, 0.0, 0.0).expect("a direction"), shift);
        *p = pair(p.id, p.node, p.command, seen);
        p.valid = p.id != 31;
    }
    let (map, report) = Map::fit(&pairs, &Settings::default()).expect("a map");
    assert_eq!(report.rejected.iter().map(|r| r.id).collect::<Vec<_>>(), [60]);
    let mut inside = 0;
    for _ in 0..2000 {
        let truth = anywhere(rng);
        let found = map.apply(camera_from_base() * warped(truth));
        inside += usize::from(found.hull == Hull::Inside);
        assert!(found.base.distance_mm(truth) < 0.35, "{found:?}");
    }
    assert!(inside > 1900, "{inside}");

    // the least that is accepted: 3 x 3 x 3, seven of them missed
    let mut few = perfect(500.0, warped);
    few.iter_mut().filter(|p| p.id % 4 == 1).for_each(|p| p.valid = false);
    let (map, _) = Map::fit(&few, &Settings::default()).expect("a map");
    let found = map.apply(camera_from_base() * warped(Point::new(1150.0, 0.0, 500.0)));
    assert!(
        found.base.distance_mm(Point::new(1150.0, 0.0, 500.0)) < 1.0,
        "{found:?}"
    );
}
