//! The cell as its program meets it.

use crate::world::lock;
use crate::*;
use cell::device::*;
use geometry::{Base, Point, Tool, Transform};
use nalgebra::{UnitQuaternion, Vector3};
use scene::FaceId;

const PROGRAM: DriveProgram = DriveProgram {
    axial_force_n: 150.0,
    max_time_s: 2.5,
    max_torque_nm: 12.0,
    stroke_mm: 10.0,
    bit: cell::device::Bit::Cross,
};

fn run<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread()
        .build()
        .expect("runtime")
        .block_on(future)
}

/// Arms as in the data sheet, units as new.
fn easy() -> SimSettings {
    SimSettings {
        wear: 0.0,
        excluded_share: 0.0,
        arms: ArmErrors::NONE,
        ..SimSettings::default()
    }
}

async fn load(cell: &SimulatedCell) -> Result<(), DeviceError> {
    let io = &cell.devices.io;
    io.write(tags::FEED, TagValue::Bool(true)).await?;
    io.wait_for(tags::LOADED, TagValue::Bool(true), 60.0).await?;
    io.write(tags::MAGNET, TagValue::Bool(true)).await
}

async fn present(cell: &SimulatedCell, face: &str) -> Result<(), DeviceError> {
    let io = &cell.devices.io;
    io.write(tags::PRESENT, TagValue::Text(face.into())).await?;
    io.wait_for(tags::PRESENTED, TagValue::Text(face.into()), 30.0).await
}

async fn job(arm: &Arm, name: &str) -> Result<(), DeviceError> {
    let ticket = arm.robot.run_job(name).await?;
    arm.robot.wait(ticket, 60.0).await.map(|_| ())
}

/// Drives every screw of the presented face that stands, going by the truth.
async fn drive_all(cell: &SimulatedCell, arm: usize) -> Result<(), DeviceError> {
    let targets: Vec<Transform<Base, Tool>> = {
        let mut world = lock(&cell.world);
        let truth = world.truth().expect("a face is presented");
        let base_from_camera = world.arms[arm].base_from_camera;
        let aim = |s: &scene::ScrewTruth| {
            let inward = -(base_from_camera * s.axis).vector();
            let lean = UnitQuaternion::rotation_between(&Vector3::x(), &inward).expect("not backwards");
            Transform::from_parts((base_from_camera * s.point).to_array(), lean * layout::approach())
        };
        truth.screws.iter().map(aim).collect()
    };
    let tool = &cell.devices.arms[arm];
    for target in targets {
        let ticket = tool.robot.move_to(target, Motion::Joint).await?;
        tool.robot.wait(ticket, 10.0).await?;
        tool.driver.as_ref().expect("a driver").drive(PROGRAM).await?;
    }
    job(tool, jobs::HOME).await
}

#[test]
fn a_cover_stays_while_a_screw_holds_it() -> Result<(), DeviceError> {
    let cell = SimulatedCell::new(easy());
    run(async {
        load(&cell).await?;
        for face in ["front", "left", "right", "top"] {
            present(&cell, face).await?;
            if face == "top" {
                // too early: its screws stand
                job(&cell.devices.arms[1], &jobs::pull("top")).await?;
                assert_eq!(
                    cell.devices.io.read(tags::GRIPPER_HOLDING).await?,
                    TagValue::Bool(false)
                );
                assert!(
                    present(&cell, "front_inner").await.is_err(),
                    "the inner front is still closed"
                );
            }
            drive_all(&cell, 0).await?;
        }
        job(&cell.devices.arms[1], &jobs::pull("top")).await?;
        assert_eq!(cell.devices.io.read(tags::GRIPPER_HOLDING).await?, TagValue::Bool(true));
        job(&cell.devices.arms[1], jobs::DROP).await?;
        assert_eq!(
            cell.devices.io.read(tags::GRIPPER_HOLDING).await?,
            TagValue::Bool(false)
        );
        present(&cell, "front_inner").await?;
        drive_all(&cell, 0).await?;
        for cover in ["front", "right"] {
            present(&cell, cover).await?;
            job(&cell.devices.arms[1], &jobs::pull(cover)).await?;
            assert_eq!(
                cell.devices.io.read(tags::GRIPPER_HOLDING).await?,
                TagValue::Bool(true),
                "{cover}"
            );
            job(&cell.devices.arms[1], jobs::DROP).await?;
        }
        cell.devices.io.write(tags::DISCHARGE, TagValue::Bool(true)).await?;
        cell.devices
            .io
            .wait_for(tags::LOADED, TagValue::Bool(false), 60.0)
            .await?;
        let score = cell.score();
        assert_eq!(score.units.len(), 1);
        let unit = &score.units[0];
        assert_eq!(unit.standing(), 0, "{:?}", unit.screws);
        assert!(unit.screws.iter().all(|s| s.attempts >= 1));
        let pulls = score
            .actions
            .iter()
            .filter(|a| matches!(a.kind, ActionKind::Pull { .. }))
            .count();
        assert_eq!(pulls, 4);
        let total_s = cell.devices.clock.now_s();
        assert!(
            (100.0..220.0).contains(&total_s),
            "{total_s:.0} s for a unit without looking"
        );
        Ok(())
    })
}

#[test]
fn what_cannot_be_reached_is_refused_and_nothing_moves() -> Result<(), DeviceError> {
    let cell = SimulatedCell::new(easy());
    run(async {
        load(&cell).await?;
        present(&cell, "front").await?;
        let arm = &cell.devices.arms[0].robot;
        let before = arm.state().await?;
        let bad = [
            Point::new(2500.0, 0.0, 500.0),
            Point::new(f64::NAN, 0.0, 500.0),
            Point::new(1060.0, 0.0, 20.0),
            Point::new(1250.0, 0.0, 500.0),
        ];
        for at in bad {
            let error = arm
                .move_to(layout::tool_at(at), Motion::Joint)
                .await
                .expect_err("refused");
            assert!(matches!(error, DeviceError::Refused { .. }), "{at:?}: {error}");
        }
        let after = arm.state().await?;
        assert!(!after.running);
        assert_eq!(before.joints_rad, after.joints_rad);
        Ok(())
    })
}

#[test]
fn a_wait_that_times_out_leaves_a_readable_state() -> Result<(), DeviceError> {
    let cell = SimulatedCell::new(easy());
    run(async {
        let arm = &cell.devices.arms[0].robot;
        let at = Point::new(1000.0, 200.0, 400.0);
        let ticket = arm.move_to(layout::tool_at(at), Motion::Joint).await?;
        assert!(matches!(arm.wait(ticket, 0.1).await, Err(DeviceError::Timeout { .. })));
        let state = arm.state().await?;
        assert!(state.running, "it is on its way");
        assert!(matches!(
            arm.move_to(layout::tool_at(at), Motion::Joint).await,
            Err(DeviceError::NotReady { .. })
        ));
        let state = arm.wait(ticket, 10.0).await?;
        assert!(!state.running);
        assert!((state.base_from_tool * Point::new(0.0, 0.0, 0.0)).distance_mm(at) < 1e-3);
        // a hold stops at once, and only a reset lets the arm go on
        let ticket = arm.run_job(jobs::HOME).await?;
        arm.hold().await?;
        assert!(arm.wait(ticket, 10.0).await.is_err());
        assert!(arm.state().await?.hold && !arm.state().await?.running);
        assert!(arm.run_job(jobs::HOME).await.is_err());
        arm.reset().await?;
        assert!(!arm.state().await?.hold);
        arm.run_job(jobs::HOME).await?;
        assert!(arm.run_job("NO_SUCH_JOB").await.is_err());
        Ok(())
    })
}

#[test]
fn faults_happen_only_by_name() -> Result<(), DeviceError> {
    let with = |name: &str| SimSettings {
        faults: Faults::none().with(name, 1.0).expect("known"),
        ..easy()
    };
    run(async {
        let to = layout::tool_at(Point::new(1000.0, 0.0, 500.0));
        let lost = SimulatedCell::new(with("arm_timeout_after_move"));
        let arm = &lost.devices.arms[0].robot;
        assert!(matches!(
            arm.move_to(to, Motion::Joint).await,
            Err(DeviceError::Timeout { .. })
        ));
        let at = arm.state().await?.base_from_tool * Point::new(0.0, 0.0, 0.0);
        assert!(
            at.distance_mm(Point::new(1000.0, 0.0, 500.0)) < 300.0,
            "the arm moved although no answer came"
        );

        let alarm = SimulatedCell::new(SimSettings {
            faults: Faults::none()
                .with("arm_alarm", 1.0)
                .and_then(|f| f.with("reset_lies", 1.0))
                .expect("known"),
            ..easy()
        });
        let arm = &alarm.devices.arms[0].robot;
        let ticket = arm.move_to(to, Motion::Joint).await?;
        assert!(arm.wait(ticket, 10.0).await.is_err());
        assert!(arm.state().await?.alarm.is_some());
        arm.reset().await?;
        assert!(
            arm.state().await?.alarm.is_some(),
            "the reset said success and cleared nothing"
        );

        let slow = SimulatedCell::new(with("io_delay"));
        load(&slow).await?;
        let quick = SimulatedCell::new(easy());
        load(&quick).await?;
        assert!(slow.devices.clock.now_s() > 2.0 * quick.devices.clock.now_s());

        let mute = SimulatedCell::new(with("camera_timeout"));
        load(&mute).await?;
        present(&mute, "front").await?;
        assert!(matches!(
            mute.devices.color.grab(None).await,
            Err(DeviceError::Timeout { .. })
        ));
        Ok(())
    })
}

const REGION: Region = Region {
    x_px: 1900,
    y_px: 1400,
    width_px: 320,
    height_px: 240,
};

/// A unit's first looks, as bytes.
async fn look(settings: SimSettings) -> Result<(Vec<u8>, Vec<u32>, f64), DeviceError> {
    let cell = SimulatedCell::new(settings);
    load(&cell).await?;
    present(&cell, "front").await?;
    let color = cell.devices.color.grab(Some(REGION)).await?;
    let first = cell.devices.depth.grab(Some(REGION)).await?;
    let second = cell.devices.depth.grab(Some(REGION)).await?;
    assert_ne!(
        first.map.depth_mm, second.map.depth_mm,
        "a second depth picture has noise of its own"
    );
    assert_eq!((color.image.width(), color.image.height()), (320, 240));
    assert_eq!((first.map.width, first.map.height, first.map.step), (160, 120, 2));
    let depth = [first.map.depth_mm, second.map.depth_mm].concat();
    let bits = depth.iter().map(|z| z.to_bits()).collect();
    Ok((color.image.into_raw(), bits, cell.devices.clock.now_s()))
}

#[test]
fn the_same_seed_gives_the_same_pictures() -> Result<(), DeviceError> {
    run(async {
        let first = look(SimSettings::default()).await?;
        assert_eq!(first, look(SimSettings::default()).await?);
        let other = SimSettings {
            units_seed: 2,
            ..SimSettings::default()
        };
        assert_ne!(first.0, look(other).await?.0);
        Ok(())
    })
}

/// Middle of everything green.
fn green_centre(picture: &geometry::RgbImage) -> (f64, f64) {
    let green = |p: &[u8; 3]| p[1] > p[0].saturating_add(20) && p[1] > p[2].saturating_add(20);
    let pixels = picture.enumerate_pixels().filter(|(_, _, p)| green(&p.0));
    let (n, u, v) = pixels.fold((0.0, 0.0, 0.0), |(n, u, v), (x, y, _)| {
        (n + 1.0, u + f64::from(x), v + f64::from(y))
    });
    (u / n, v / n)
}

#[test]
fn the_camera_shows_the_marker_where_the_tool_really_is() -> Result<(), DeviceError> {
    let cell = SimulatedCell::new(SimSettings::default());
    run(async {
        assert!(cell.devices.color.grab(None).await.is_err(), "nothing to see");
        cell.mount_jig(Some(0));
        let arm = &cell.devices.arms[0].robot;
        let ticket = arm
            .move_to(layout::tool_at(Point::new(1100.0, 100.0, 500.0)), Motion::Joint)
            .await?;
        arm.wait(ticket, 10.0).await?;
        let (pixel, depth_mm) = {
            let world = lock(&cell.world);
            let p = world.arms[0].camera_from_true_tool(world.now_s()) * Point::new(0.0, 0.0, 0.0);
            (world.true_camera.project(p).expect("in view"), p.z_mm())
        };
        let region = Region {
            x_px: (pixel.u_px as u32 - 100) & !1,
            y_px: (pixel.v_px as u32 - 100) & !1,
            width_px: 200,
            height_px: 200,
        };
        let color = cell.devices.color.grab(Some(region)).await?;
        let depth = cell.devices.depth.grab(Some(region)).await?;
        // a green disc on a white paddle
        let [r, g, b] = color.image.get_pixel(100, 100).0;
        assert!(g > r.saturating_add(25) && g > b.saturating_add(25), "{r} {g} {b}");
        let (u, v) = green_centre(&color.image);
        let off = (u + f64::from(region.x_px) - pixel.u_px).hypot(v + f64::from(region.y_px) - pixel.v_px);
        assert!(off < 1.0, "{off} px off");
        let middle = depth
            .map
            .plane_at(geometry::Pixel::new(100.0, 100.0), 0.0, 20.0)
            .expect("depth");
        assert!(
            (middle.depth_mm - depth_mm).abs() < 3.0,
            "{} against {depth_mm}",
            middle.depth_mm
        );
        // an arm without the jig in the view keeps the cameras from firing
        cell.mount_jig(Some(1));
        assert!(cell.devices.color.grab(None).await.is_err());
        Ok(())
    })
}

#[test]
fn faces_stand_inside_the_calibrated_volume() {
    for units_seed in 0..12 {
        let cell = SimulatedCell::new(SimSettings {
            units_seed,
            ..SimSettings::default()
        });
        run(load(&cell)).expect("loaded");
        let mut world = lock(&cell.world);
        for face in FaceId::ALL {
            world.unit.as_mut().expect("loaded").presented = Some(face);
            let view = world.view().expect("presented");
            for screw in &view.design.screws {
                let at = view.camera_point(screw.placed.at_mm[0], screw.placed.at_mm[1], screw.placed.height_mm);
                for arm in 0..2 {
                    let p = (world.arms[arm].base_from_camera * at).to_array();
                    let [low, high] = layout::volume(arm).map(|c| c.to_array());
                    assert!(
                        (0..3).all(|a| p[a] > low[a] && p[a] < high[a]),
                        "{face:?} of {units_seed}: {p:?}"
                    );
                }
                let pixel = view.camera.project(at).expect("before the camera");
                assert!(view.camera.contains(pixel));
            }
        }
    }
}

#[test]
fn the_world_goes_on_where_its_log_ends() -> Result<(), DeviceError> {
    let folder = tempfile::tempdir().expect("folder");
    let log = folder.path().join("world.jsonl");
    let settings = easy();
    let before = {
        let cell = SimulatedCell::open(settings.clone(), &log).expect("new log");
        run(async {
            load(&cell).await?;
            present(&cell, "right").await?;
            drive_all(&cell, 0).await
        })?;
        assert_eq!(cell.log_error(), None);
        cell.score()
    };
    // a line that a crash cut off
    let text = std::fs::read_to_string(&log).expect("log");
    std::fs::write(&log, format!("{text}{{\"t_s\": 3")).expect("write");
    let cell = SimulatedCell::open(settings.clone(), &log).expect("old log");
    let after = cell.score();
    // numbers in text may lose their last bit
    assert_eq!(before.actions.len(), after.actions.len());
    let removed = |score: &Score| {
        score.units[0]
            .screws
            .iter()
            .map(|s| (s.removed, s.attempts))
            .collect::<Vec<_>>()
    };
    assert_eq!(removed(&before), removed(&after));
    assert!(removed(&after).iter().any(|s| s.0));
    let state = run(cell.devices.io.read(tags::PRESENTED))?;
    assert_eq!(state, TagValue::Text("right".into()));
    let other = SimSettings {
        units_seed: 99,
        ..settings
    };
    assert!(matches!(
        SimulatedCell::open(other, &log),
        Err(LogError::OtherUnits { .. })
    ));
    std::fs::write(&log, "not json\n").expect("write");
    assert!(matches!(
        SimulatedCell::open(easy(), &log),
        Err(LogError::Line { line: 1, .. })
    ));
    Ok(())
}

#[test]
fn settings_are_read_from_a_cell_file() {
    let table: toml::Table = toml::from_str("seed = 4\nwear = 0.5\n[faults]\ngripper_slip = 0.1").expect("toml");
    let settings = SimSettings::from_table(&table).expect("known keys");
    assert_eq!((settings.seed, settings.wear), (4, 0.5));
    assert_eq!(settings.faults.rate(Fault::GripperSlip), 0.1);
    for (text, word) in [
        ("sead = 4", "sead"),
        ("wear = -1.0", "wear"),
        ("[faults]\nx = 0.1", "camera_timeout"),
    ] {
        let table: toml::Table = toml::from_str(text).expect("toml");
        let error = SimSettings::from_table(&table).expect_err("refused").to_string();
        assert!(error.contains(word) && error.contains("[simulated]"), "{error}");
    }
}
