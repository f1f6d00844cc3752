//! The Gaussian process on a synthetic arm with rippling gears: what a hundred points give, what outliers do, whether sigma is true.

mod arm;

use arm::{World, anywhere, camera_from_base, errors, gauss, gp, pairs, seen, tool, true_tool};
use calibration::{ArmModel, FitError, Hull, Map, Method, Pair, Settings};
use geometry::{Base, Camera, Point};
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

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
fn the_ripple_of_an_arm_that_nobody_knows_is_taken_out_too() -> Result<(), Box<dyn std::error::Error>> {
    // joint zeros and one direction as no GP25 has them: only the pairs' own angles tell where the joints are
    let other: Vec<Pair> = pairs(1, 150)
        .into_iter()
        .map(|p| Pair {
            joints_rad: p
                .joints_rad
                .map(|[a, b, c, rest @ ..]| [0.4 - a, b + 0.2, c - 0.3, rest[0], rest[1], rest[2]]),
            ..p
        })
        .collect();
    let without: Vec<Pair> = other
        .iter()
        .map(|p| Pair {
            joints_rad: None,
            ..p.clone()
        })
        .collect();
    let rms = |pairs: &[Pair]| -> Result<(f64, String), Box<dyn std::error::Error>> {
        let (map, report) = Map::fit(pairs, &gp())?;
        let errors = errors(&map, 77);
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        Ok((rms, report.notes.join("; ")))
    };
    let ((learned, notes), (smooth, _)) = (rms(&other)?, rms(&without)?);
    assert!(notes.contains("by regression on the pairs' own"), "{notes}");
    assert!(learned < 0.5 * smooth, "{learned} {smooth} {notes}");
    Ok(())
}

#[test]
fn pairs_of_another_arm_are_no_gp25() {
    let wanted = Settings {
        arm_model: ArmModel::Gp25,
        ..gp()
    };
    assert!(Map::fit(&pairs(1, 100), &wanted).is_ok());
    let mut degrees = pairs(1, 100);
    for pair in &mut degrees {
        pair.joints_rad = pair.joints_rad.map(|q| q.map(f64::to_degrees));
    }
    let refused = Map::fit(&degrees, &wanted);
    assert!(matches!(refused, Err(FitError::NotThisArm { scatter_mm }) if scatter_mm > 10.0));
    // joint angles that nothing can be made of are no reason to refuse where no arm was named
    assert!(Map::fit(&degrees, &gp()).is_ok());
}

#[test]
fn the_side_that_joints_come_from_is_taken_out() -> Result<(), Box<dyn std::error::Error>> {
    // 0.05 mm at the tool, to the side that J1 came from: mostly from one, as in a tour
    let lost_rad = 4e-5;
    let (mut with, mut before) = (pairs(8, 120), 0.0);
    with.sort_by(|a, b| a.command.y_mm().total_cmp(&b.command.y_mm()));
    for k in (3..with.len()).step_by(4) {
        with.swap(k, k - 3);
    }
    let rng = &mut Pcg64Mcg::seed_from_u64(3);
    for (k, pair) in with.iter_mut().enumerate() {
        let [j1, j2, j3, ..] = pair.joints_rad.expect("joints");
        let turned = World {
            zeros: [if j1 > before { lost_rad } else { -lost_rad }, 0.0, 0.0],
            ..World::untouched()
        };
        before = j1;
        let noise = Vector3::new(0.02 * gauss(rng), 0.02 * gauss(rng), 0.05 * gauss(rng));
        pair.camera = Some(Point::from_vector(turned.sight([j1, j2, j3]).vector() + noise));
        (pair.id, pair.t_s) = (k as u64, 6.0 * k as f64);
    }
    // the same pairs as if nobody knew in which order they were visited
    let mut shuffled = with.clone();
    for (k, pair) in shuffled.iter_mut().enumerate() {
        pair.t_s = (k as f64 * 0.618_033_988_749_895).fract();
    }
    let rms = |pairs: &[Pair]| -> Result<f64, FitError> {
        let errors = errors(&Map::fit(pairs, &gp())?.0, 12);
        Ok((errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt())
    };
    let (known, unknown) = (rms(&with)?, rms(&shuffled)?);
    assert!(
        known < 0.8 * unknown,
        "{known} where the order is known, {unknown} where not"
    );
    Ok(())
}

#[test]
fn baking_moves_answers_by_less_than_five_micrometres() -> Result<(), Box<dyn std::error::Error>> {
    let (map, report) = Map::fit(&pairs(4, 120), &gp())?;
    assert!(report.notes.iter().any(|n| n.contains("waves a turn")), "{report}");
    let rng = &mut Pcg64Mcg::seed_from_u64(6);
    let places: Vec<_> = (0..500)
        .map(|_| camera_from_base() * true_tool(anywhere(rng)))
        .collect();
    let errors = map.baking_errors_mm(&places);
    assert_eq!(errors.len(), places.len());
    let most = errors.iter().copied().fold(0.0, f64::max);
    assert!(most > 0.0 && most < 0.005, "{most} mm");
    Ok(())
}

#[test]
fn one_gross_outlier_in_ten_is_found() -> Result<(), Box<dyn std::error::Error>> {
    for seed in 0..10 {
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
