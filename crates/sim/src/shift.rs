//! A shift without pictures: a finder that knows the truth and cameras that show nothing, so that many units take seconds. What is tried out
//! is who moves when.

use crate::world::{Shared, lock, until};
use crate::*;
use async_trait::async_trait;
use calibration::{Map, Pair, Settings, Volume, lattice};
use cell::device::{ColorCamera, ColorFrame, DepthCamera, DepthFrame, DeviceError, Region};
use cell::record::UnitRecord;
use cell::run::{Finder, Runner, Silent};
use cell::{CellConfig, Journal, Program};
use geometry::{CameraModel, DepthMap, RgbImage, RgbdFrame};

/// Time of a picture and of a depth picture, s: those of the simulated cameras.
const PICTURE_S: [f64; 2] = [0.5, 1.4];

struct Blank(Shared);

impl Blank {
    /// Waits as the real camera would, and is interlocked as it is.
    async fn expose(&self, takes_s: f64, region: Option<Region>) -> Result<(Region, f64), DeviceError> {
        let (region, t_s, until_s) = self.begin(takes_s, region)?;
        until(&self.0, until_s).await;
        Ok((region, t_s))
    }

    fn begin(&self, takes_s: f64, region: Option<Region>) -> Result<(Region, f64, f64), DeviceError> {
        let world = lock(&self.0);
        if let Some(arm) = world.arm_in_view() {
            return Err(DeviceError::Refused {
                device: "camera".into(),
                reason: format!("{} stands in the view", arm.name),
            });
        }
        let camera = world.stated_camera;
        let whole = Region {
            x_px: 0,
            y_px: 0,
            width_px: camera.width_px,
            height_px: camera.height_px,
        };
        let region = region.unwrap_or(whole);
        let pixels = |r: &Region| f64::from(r.width_px) * f64::from(r.height_px);
        let share = 0.25 + 0.75 * pixels(&region) / pixels(&whole);
        Ok((region, world.now_s(), world.now_s() + takes_s * share))
    }
}

#[async_trait]
impl ColorCamera for Blank {
    fn intrinsics(&self) -> CameraModel {
        lock(&self.0).stated_camera
    }
    async fn grab(&self, region: Option<Region>) -> Result<ColorFrame, DeviceError> {
        let (region, t_s) = self.expose(PICTURE_S[0], region).await?;
        Ok(ColorFrame {
            image: RgbImage::new(region.width_px, region.height_px),
            region,
            t_s,
        })
    }
}

#[async_trait]
impl DepthCamera for Blank {
    async fn grab(&self, region: Option<Region>) -> Result<DepthFrame, DeviceError> {
        let (region, t_s) = self.expose(PICTURE_S[1], region).await?;
        let (width, height) = (region.width_px as usize / 2, region.height_px as usize / 2);
        Ok(DepthFrame {
            map: DepthMap {
                width: width as u32,
                height: height as u32,
                step: 2,
                depth_mm: vec![0.0; width * height],
            },
            region,
            t_s,
        })
    }
}

/// Finds what stands there.
struct Truth(Shared);

impl Finder for Truth {
    fn find(&self, frame: &RgbdFrame, _: f64) -> Result<Vec<vision::Screw>, DeviceError> {
        let mut world = lock(&self.0);
        let (Some(camera), Some(truth)) = (frame.camera, world.truth()) else {
            return Ok(Vec::new());
        };
        let standing = truth.screws.iter().filter(|s| !world.is_out(s.id));
        let screws = standing.filter_map(|s| {
            let pixel = camera.project(s.point)?;
            camera.contains(pixel).then(|| vision::Screw {
                pixel,
                sigma_px: 0.2,
                diameter_px: s.head_d_px,
                score: 0.99,
                fits: 0.99,
                drive: vision::Drive::Cross,
                verdict: vision::Verdict::Screw,
                cues: Vec::new(),
                angle_rad: None,
                camera: Some(s.point),
                normal: Some(s.axis),
                top_normal: Some(s.axis),
                sigma_lateral_mm: Some(0.1),
                sigma_depth_mm: Some(0.1),
            })
        });
        Ok(screws.collect())
    }
    fn model(&self) -> String {
        "truth".into()
    }
}

/// A map that is right, of an arm that has no errors.
fn map(world: &Shared, arm: usize) -> Map {
    let [low, high] = layout::volume(arm);
    let base_from_camera = lock(world).arms[arm].base_from_camera;
    let camera_from_base = base_from_camera.inverse();
    let pairs: Vec<Pair> = lattice(&Volume::between(low, high), 100.0)
        .expect("a lattice")
        .into_iter()
        .map(|t| Pair {
            id: t.id,
            node: t.node,
            t_s: 0.0,
            command: t.command,
            pixel: None,
            depth_mm: None,
            camera: Some(camera_from_base * t.command),
            joints_rad: None,
            valid: true,
        })
        .collect();
    Map::fit(&pairs, &Settings::default()).expect("a map").0
}

/// Takes units apart; returns their records and how near the arms came to each other, mm.
fn shift(units: u64, seed: u64, arms: usize) -> (Vec<UnitRecord>, f64) {
    let none = ArmErrors::NONE;
    let mut simulated = SimulatedCell::new(SimSettings {
        units_seed: seed,
        excluded_share: 0.0,
        arms: none,
        ..SimSettings::default()
    });
    let world = simulated.world.clone();
    simulated.devices.color = Arc::new(Blank(world.clone()));
    simulated.devices.depth = Arc::new(Blank(world.clone()));
    let mut config = CellConfig::simulated();
    config.work.arms = arms;
    config.journal.jpeg_quality = 1;
    let folder = tempfile::tempdir().expect("folder");
    let mut runner = Runner::new(
        simulated.devices.clone(),
        Arc::new(Truth(world.clone())),
        vec![map(&world, 0), map(&world, 1)],
        Program::paper().expect("built-in"),
        config,
        Journal::open(folder.path()).expect("journal"),
    )
    .expect("runner");
    runner.start().expect("started");
    let runtime = tokio::runtime::Builder::new_current_thread().build().expect("runtime");
    let records = (0..units).map(|_| runtime.block_on(runner.run_unit(&Silent)).expect("a record"));
    (records.collect(), simulated.nearest_arms_mm())
}

fn mean(records: &[UnitRecord], of: impl Fn(&UnitRecord) -> f64) -> f64 {
    records.iter().map(of).sum::<f64>() / records.len() as f64
}

#[test]
fn two_arms_are_quicker_than_one_and_keep_their_distance() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|n| n.parse().ok()).unwrap_or(default);
    let (units, seed) = (number("UNITS", 4), number("SEED", 7_100_000));
    let margin_mm = CellConfig::simulated().motion.margin_mm;
    let cycle = |arms: usize| {
        let (records, nearest_mm) = shift(units, seed, arms);
        let t = |of: fn(&cell::record::Times) -> f64| mean(&records, |r| of(&r.times));
        println!(
            "{arms} arm(s): {:.1} s a unit (handling {:.1}, screws {:.1}, covers {:.1}, inspection {:.1}, recovery {:.1}); {:.1} screws out; arms {nearest_mm:.0} mm apart at least; {:?}",
            t(cell::record::Times::cycle_s),
            t(|t| t.handling_s),
            t(|t| t.screws_s),
            t(|t| t.covers_s),
            t(|t| t.inspection_s),
            t(|t| t.recovery_s),
            mean(&records, |r| r.screws_out() as f64),
            records
                .iter()
                .map(|r| r.outcome.as_ref().map(cell::Outcome::word))
                .collect::<Vec<_>>(),
        );
        assert!(nearest_mm >= margin_mm, "{nearest_mm} mm");
        t(cell::record::Times::cycle_s)
    };
    let (one_s, two_s) = (cycle(1), cycle(2));
    assert!(two_s < 0.93 * one_s, "{two_s} s after {one_s} s");
}
