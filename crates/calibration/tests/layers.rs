//! After a bump, after a crash, after the needle: what few points restore.

mod arm;

use arm::{World, gp, pairs};
use calibration::{Between, Check, CorrectError, Hull, Map, MapError, Mark, Moved, RealignError, verify};
use geometry::Point;
use nalgebra::{Isometry3, Vector3};

/// A camera pushed by 1 mm and turned by 2 mrad about its own place.
fn bumped() -> World {
    World {
        bump: Isometry3::new(
            Vector3::new(0.6, -0.7, 0.4),
            2e-3 * Vector3::new(0.5, 0.7, -0.5).normalize(),
        ),
        ..World::untouched()
    }
}

fn fitted(seed: u64) -> Map {
    Map::fit(&pairs(seed, 120), &gp()).expect("a map").0
}

fn p999(errors: &[f64]) -> f64 {
    errors[(0.999 * errors.len() as f64) as usize]
}

#[test]
fn ten_points_restore_the_map_after_a_bump() -> Result<(), Box<dyn std::error::Error>> {
    let (map, world) = (fitted(1), bumped());
    let as_fitted = p999(&World::untouched().errors(&map, 7));
    assert!(p999(&world.errors(&map, 7)) > 1.5, "the bump does harm");
    for seed in 20..26 {
        let (realigned, told) = map.realign(&world.pairs(seed, 10), Moved::Pose, "2026-01-02T03:04:05Z")?;
        let now = p999(&world.errors(&realigned, 7));
        assert!(
            now < 0.25 && now < as_fitted + 0.15,
            "{seed}: {now} after, {as_fitted} as fitted"
        );
        assert!((told.turn_rad - 2e-3).abs() < 2e-4, "{told}");
        assert!(
            told.outliers.is_empty() && told.before.total.rms_mm > 4.0 * told.after.total.rms_mm,
            "{told}"
        );
    }
    Ok(())
}

#[test]
fn one_gross_outlier_does_no_harm() -> Result<(), Box<dyn std::error::Error>> {
    let (map, world) = (fitted(2), bumped());
    for (moved, n, bad) in [(Moved::Pose, 10, 3), (Moved::Pose, 9, 0), (Moved::PoseAndZeros, 20, 11)] {
        for off_mm in [2.0, 40.0] {
            let mut fresh = world.pairs(31, n);
            let camera = fresh[bad].camera.expect("seen").vector();
            fresh[bad].camera = Some(Point::from_vector(camera + off_mm * Vector3::new(0.6, -0.6, 0.5)));
            let (realigned, told) = map.realign(&fresh, moved, "")?;
            assert_eq!(told.outliers, [bad as u64], "{moved:?}, {off_mm} mm");
            assert!(p999(&world.errors(&realigned, 8)) < 0.3, "{told}");
        }
    }
    // five points and a shift alone
    let pushed = World {
        bump: Isometry3::translation(0.5, 0.8, -0.3),
        ..World::untouched()
    };
    let mut fresh = pushed.pairs(5, 5);
    let camera = fresh[2].camera.expect("seen").vector();
    fresh[2].camera = Some(Point::from_vector(camera + Vector3::new(9.0, 0.0, 12.0)));
    let (realigned, told) = map.realign(&fresh, Moved::Shift, "")?;
    assert_eq!(told.outliers, [2]);
    assert!(p999(&pushed.errors(&realigned, 8)) < 0.3, "{told}");
    Ok(())
}

#[test]
fn twenty_points_restore_the_map_after_a_crash() -> Result<(), Box<dyn std::error::Error>> {
    let map = fitted(3);
    let world = World {
        zeros: [1.0e-3, -1.5e-3, 1.2e-3],
        ..bumped()
    };
    let fresh = world.pairs(41, 20);
    let (pose, _) = map.realign(&fresh, Moved::Pose, "")?;
    let (all, told) = map.realign(&fresh, Moved::PoseAndZeros, "")?;
    let (pose, all) = (p999(&world.errors(&pose, 9)), p999(&world.errors(&all, 9)));
    assert!(all < 0.3 && all < pose, "{all} with zeros, {pose} without; {told}");
    Ok(())
}

#[test]
fn sigma_of_a_realigned_map_holds_what_few_points_leave_open() -> Result<(), Box<dyn std::error::Error>> {
    let (map, world) = (fitted(4), bumped());
    let (mut within, mut n) = ([0.0, 0.0], 0.0);
    for seed in 50..70 {
        let (realigned, _) = map.realign(&world.pairs(seed, 8), Moved::Pose, "")?;
        let told = verify(&realigned, &world.pairs(seed + 100, 200), 0.5);
        within[0] += told.within_one_sigma * 200.0;
        within[1] += told.within_two_sigma * 200.0;
        n += 200.0;
    }
    let [one, two] = within.map(|w| w / n);
    assert!(
        (0.62..0.76).contains(&one) && (0.92..0.985).contains(&two),
        "{one} {two}"
    );
    Ok(())
}

#[test]
fn a_realigned_map_survives_its_file_and_a_second_realignment() -> Result<(), Box<dyn std::error::Error>> {
    let (map, world) = (fitted(5), bumped());
    let (realigned, told) = map.realign(&world.pairs(1, 12), Moved::Pose, "2026-01-02T03:04:05Z")?;
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("map.json");
    realigned.save(&path)?;
    let back = Map::load(&path)?;
    assert_eq!(back.realigned(), Some(&told));
    let at = world.sight([0.1, 0.4, -0.8]);
    assert!(back.apply(at).base.distance_mm(realigned.apply(at).base) < 1e-9);
    // what other tools are told of the camera's pose has moved with it
    let rigid = |map: &Map, world: &World| (map.base_from_camera() * world.sight([0.1, 0.4, -0.8])).vector();
    let moved = rigid(&realigned, &world) - rigid(&map, &World::untouched());
    assert!(moved.norm() < 0.3, "{moved:?}");
    // the camera is put back: the second realignment stands alone
    let (again, _) = back.realign(&pairs(99, 12), Moved::Pose, "")?;
    assert!(p999(&World::untouched().errors(&again, 3)) < 0.25);
    Ok(())
}

#[test]
fn what_is_no_bump_is_refused() {
    let map = fitted(6);
    let few = map.realign(&bumped().pairs(1, 5), Moved::Pose, "");
    assert!(
        matches!(few, Err(RealignError::TooFew { have: 5, need: 7, .. })),
        "{few:?}"
    );
    let mut shuffled = bumped().pairs(1, 12);
    let first = shuffled[0].command;
    for k in 0..11 {
        shuffled[k].command = shuffled[k + 1].command;
    }
    shuffled[11].command = first;
    let wrong = map.realign(&shuffled, Moved::Pose, "");
    assert!(matches!(wrong, Err(RealignError::Disagree { .. })), "{wrong:?}");
    let mut nan = bumped().pairs(1, 12);
    nan[4].command = Point::new(f64::NAN, 0.0, 0.0);
    assert!(matches!(
        map.realign(&nan, Moved::Pose, ""),
        Err(RealignError::NotFinite { id: 4 })
    ));
}

#[test]
fn needle_marks_are_taken_out_where_they_are_and_fade_beyond() -> Result<(), Box<dyn std::error::Error>> {
    let map = fitted(7);
    let world = World::untouched();
    let at = |joints| {
        let camera = world.sight(joints);
        (camera, map.apply(camera).base)
    };
    let (camera, target) = at([0.1, 0.4, -0.8]);
    assert_eq!(map.apply(camera).hull, Hull::Inside);
    let off = Vector3::new(0.3, -0.2, 0.1);
    let mark = |id, target: Point<geometry::Base>, off| Mark {
        id,
        target,
        mark: Point::from_vector(target.vector() + off),
    };
    let beside = Point::from_vector(target.vector() + Vector3::new(0.0, 60.0, 0.0));
    let marks = [mark(1, target, off), mark(2, beside, -off)];
    for between in [Between::Interpolated, Between::Nearest] {
        let corrected = map.correct(&marks, between, 100.0)?;
        let now = corrected.apply(camera).base.vector() - target.vector();
        assert!((now + off).norm() < 1e-3, "{between:?}: {now:?}");
        // nothing is said of places beyond the reach
        let (far, before) = at([-0.4, 0.4, -0.8]);
        assert!(before.distance_mm(target) > 200.0);
        assert!(corrected.apply(far).base.distance_mm(before) < 1e-9);
    }
    // the layer has no steps
    let smooth = map.correct(&marks, Between::Interpolated, 100.0)?;
    let mut last = None;
    for k in 0..400 {
        let (camera, before) = at([0.1 + 0.0005 * f64::from(k), 0.4, -0.8]);
        let shift = smooth.apply(camera).base.vector() - before.vector();
        if let Some(last) = last {
            let step: Vector3<f64> = shift - last;
            assert!(step.norm() < 0.03, "{k}: {step:?}");
        }
        last = Some(shift);
    }
    assert_eq!(
        map.correct(&[], Between::Nearest, 100.0).err(),
        Some(CorrectError::None)
    );
    let gross = map.correct(&[mark(1, target, 20.0 * off)], Between::Nearest, 100.0);
    assert!(matches!(gross.err(), Some(CorrectError::TooFar { id: 1, .. })));
    Ok(())
}

#[test]
fn a_cell_refuses_a_map_that_failed_its_check() -> Result<(), Box<dyn std::error::Error>> {
    let (map, world) = (fitted(8), bumped());
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("map.json");
    let check = |map: &Map, world: &World, date: &str| {
        let told = verify(map, &world.pairs(60, 20), 0.5);
        map.with_check(Check {
            date: date.into(),
            passed: told.passed,
            p95_mm: told.figures.total.p95_mm,
        })
    };
    let identity = map.identity().clone();
    check(&map, &World::untouched(), "2026-02-01T00:00:00Z").save(&path)?;
    assert_eq!(Map::load_for(&path, &identity)?.known_good_on(), "2026-02-01T00:00:00Z");
    let failed = check(&map, &world, "2026-03-01T00:00:00Z");
    failed.save(&path)?;
    let refused = Map::load_for(&path, &identity);
    assert!(matches!(refused, Err(MapError::FailedCheck { .. })), "{refused:?}");
    // realigned, it is as good as new
    let (again, _) = failed.realign(&world.pairs(61, 12), Moved::Pose, "2026-03-02T00:00:00Z")?;
    again.save(&path)?;
    assert_eq!(Map::load_for(&path, &identity)?.known_good_on(), "2026-03-02T00:00:00Z");
    Ok(())
}
