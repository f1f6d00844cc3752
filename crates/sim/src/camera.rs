//! Colour and depth camera: pictures of whatever stands before them now.
//!
//! A picture is refused while an arm's tool stands in the view: as in a real cell, the trigger is interlocked with the arms.
//! On an empty table with the marker jig on an arm, the picture shows the marker where that arm's tool really is.

use crate::draw::{draw, mix, signed};
use crate::faults::Fault;
use crate::world::{LastShot, Shared, World, lock, until};
use async_trait::async_trait;
use cell::device::{ColorCamera, ColorFrame, DepthCamera, DepthFrame, DeviceError, Region};
use geometry::{CameraModel, Tool, Transform};
use nalgebra::UnitQuaternion;
use rand::RngExt;
use scene::{FaceView, MarkerView, Rendered, Roi, Sensor};

/// Time of a whole colour picture: exposure and transfer, s.
const COLOR_S: f64 = 0.5;
/// Time of a whole depth picture, s.
const DEPTH_S: f64 = 1.4;
/// Part of these times that a region does not save.
const FIXED_SHARE: f64 = 0.25;
/// How long a caller waits for a camera that does not answer, s.
const TIMEOUT_S: f64 = 3.0;

pub(crate) struct ColorHandle(pub(crate) Shared);
pub(crate) struct DepthHandle(pub(crate) Shared);

/// What stands before the camera.
enum Subject {
    Face(Box<FaceView>),
    Marker(Box<MarkerView>),
}

fn refuse(device: &str, reason: String) -> DeviceError {
    DeviceError::Refused {
        device: device.into(),
        reason,
    }
}

fn whole(camera: &CameraModel) -> Region {
    Region {
        x_px: 0,
        y_px: 0,
        width_px: camera.width_px,
        height_px: camera.height_px,
    }
}

fn check(device: &str, camera: &CameraModel, region: Option<Region>) -> Result<Region, DeviceError> {
    let Some(r) = region else { return Ok(whole(camera)) };
    let inside = r.width_px > 0
        && r.height_px > 0
        && u64::from(r.x_px) + u64::from(r.width_px) <= u64::from(camera.width_px)
        && u64::from(r.y_px) + u64::from(r.height_px) <= u64::from(camera.height_px);
    if !inside {
        let (w, h) = (camera.width_px, camera.height_px);
        return Err(refuse(
            device,
            format!("{r:?} is empty or leaves the picture of {w} x {h} px"),
        ));
    }
    Ok(r)
}

fn share(camera: &CameraModel, r: Region) -> f64 {
    let part =
        f64::from(r.width_px) * f64::from(r.height_px) / (f64::from(camera.width_px) * f64::from(camera.height_px));
    FIXED_SHARE + (1.0 - FIXED_SHARE) * part
}

/// What a picture would show now, with a fresh exposure.
fn subject(world: &mut World, device: &str) -> Result<Subject, DeviceError> {
    if let Some(arm) = world.arm_in_view() {
        return Err(refuse(
            device,
            format!("{} stands in the view; send it home first", arm.name),
        ));
    }
    world.exposures += 1;
    if world.unit.is_some() {
        let view = world.view();
        return view
            .map(|v| Subject::Face(Box::new(v)))
            .ok_or_else(|| refuse(device, "the table is turning; wait until a face is presented".into()));
    }
    let now_s = world.now_s();
    let Some(arm) = world.arms.iter().find(|arm| arm.jig) else {
        return Err(refuse(
            device,
            "nothing stands before the camera: no unit, and no arm carries the jig".into(),
        ));
    };
    let mut camera_from_marker: Transform<geometry::Camera, Tool> = arm.camera_from_true_tool(now_s);
    let seed = world.seed();
    let scene_seed = *world.jig_seed.get_or_insert_with(|| green_jig(seed));
    let exposure = world.exposures;
    let mut rng = draw(seed, &[90, exposure]);
    let mut moved = |low: f64, high: f64| {
        let way = [0.0; 3].map(|_: f64| signed(&mut rng).signum() * rng.random_range(low..high));
        let shift: Transform<geometry::Camera, geometry::Camera> =
            Transform::from_parts([way[0], way[1], 0.2 * way[2]], UnitQuaternion::identity());
        camera_from_marker = shift * camera_from_marker;
    };
    if world.faults.happens(Fault::MarkerHidden) {
        moved(3000.0, 3001.0);
    } else if world.faults.happens(Fault::MarkerGlare) {
        moved(8.0, 40.0);
    }
    Ok(Subject::Marker(Box::new(MarkerView {
        camera: world.true_camera,
        camera_from_marker,
        scene_seed,
        sensor: Sensor {
            noise_seed: mix(seed, &[92, exposure]),
            ..Sensor::sample(mix(seed, &[93]))
        },
    })))
}

/// Jigs come with discs of several colours; this cell has a green one, as the marker finder expects unless told otherwise.
fn green_jig(seed: u64) -> u64 {
    let camera = scene::camera(seed);
    let middle = camera.project(geometry::Point::new(0.0, 0.0, 1500.0));
    let green = |scene_seed: u64| {
        let view = MarkerView {
            camera,
            camera_from_marker: Transform::from_parts([0.0, 0.0, 1500.0], UnitQuaternion::identity()),
            scene_seed,
            sensor: Sensor::sample(seed),
        };
        let roi = middle.map(|pixel| Roi::around(&camera, pixel, 8));
        let sum = scene::render_marker(&view, roi)
            .color
            .pixels()
            .fold([0u32; 3], |sum, p| std::array::from_fn(|c| sum[c] + u32::from(p.0[c])));
        sum[1] > sum[0] && sum[1] > sum[2]
    };
    let mut candidates = (0..64).map(|k| mix(seed, &[91, k]));
    candidates.find(|s| green(*s)).unwrap_or(mix(seed, &[91, 0]))
}

fn shoot(subject: &Subject, roi: Option<Roi>) -> Rendered {
    match subject {
        Subject::Face(view) => scene::render(view, roi),
        Subject::Marker(view) => scene::render_marker(view, roi),
    }
}

fn roi(region: Option<Region>) -> Option<Roi> {
    region.map(|r| Roi {
        x_px: r.x_px,
        y_px: r.y_px,
        width_px: r.width_px,
        height_px: r.height_px,
    })
}

/// State of everything that can be seen, the arm with the jig included.
fn seen(world: &World) -> u64 {
    let jig = world.arms.iter().find(|a| a.jig && world.unit.is_none());
    let place = jig.map(|a| a.camera_from_true_tool(world.now_s()) * geometry::Point::new(0.0, 0.0, 0.0));
    let bits = place.map_or([0; 3], |p| p.to_array().map(f64::to_bits));
    mix(world.state_number(), &bits)
}

#[async_trait]
impl ColorCamera for ColorHandle {
    fn intrinsics(&self) -> CameraModel {
        lock(&self.0).stated_camera
    }

    async fn grab(&self, region: Option<Region>) -> Result<ColorFrame, DeviceError> {
        const NAME: &str = "color camera";
        let (subject, whole_region, t_s, state, until_s) = {
            let mut world = lock(&self.0);
            let whole_region = check(NAME, &world.stated_camera, region)?;
            if world.faults.happens(Fault::CameraTimeout) {
                world.pass(TIMEOUT_S);
                return Err(DeviceError::Timeout {
                    device: NAME.into(),
                    action: "grab".into(),
                    timeout_s: TIMEOUT_S,
                });
            }
            let subject = subject(&mut world, NAME)?;
            let t_s = world.now_s();
            let takes_s = COLOR_S * share(&world.stated_camera, whole_region);
            (subject, whole_region, t_s, seen(&world), t_s + takes_s)
        };
        until(&self.0, until_s).await;
        if lock(&self.0).faults.happens(Fault::CameraDroppedFrame) {
            return Err(DeviceError::Fault {
                device: NAME.into(),
                action: "grab".into(),
                code: -1011,
                text: "incomplete frame: packets lost".into(),
            });
        }
        // Rendering takes real time: nobody waits for the world meanwhile.
        let rendered = shoot(&subject, roi(region));
        let image = rendered.color.clone();
        // The depth camera is triggered together with this one; its picture of the same moment is kept for whoever asks next.
        lock(&self.0).last_shot = Some(LastShot {
            state,
            region: roi(region),
            rendered,
        });
        Ok(ColorFrame {
            image,
            region: whole_region,
            t_s,
        })
    }
}

#[async_trait]
impl DepthCamera for DepthHandle {
    async fn grab(&self, region: Option<Region>) -> Result<DepthFrame, DeviceError> {
        const NAME: &str = "depth camera";
        let (subject, whole_region, t_s, state, until_s) = {
            let mut world = lock(&self.0);
            let whole_region = check(NAME, &world.stated_camera, region)?;
            let subject = subject(&mut world, NAME)?;
            let t_s = world.now_s();
            let takes_s = DEPTH_S * share(&world.stated_camera, whole_region);
            (subject, whole_region, t_s, seen(&world), t_s + takes_s)
        };
        until(&self.0, until_s).await;
        let (kept, missing) = {
            let mut world = lock(&self.0);
            let missing = world.faults.happens(Fault::DepthMissing);
            // Taken, not copied: a second depth picture is a new exposure with new noise.
            let kept = world
                .last_shot
                .take()
                .filter(|s| s.state == state && s.region == roi(region));
            (kept, missing)
        };
        let mut map = match kept {
            Some(shot) => shot.rendered.depth,
            None => shoot(&subject, roi(region)).depth,
        };
        if missing {
            // A bright reflection blinds the matcher over the middle third.
            let (w, h) = (map.width as usize, map.height as usize);
            for row in h / 3..2 * h / 3 {
                map.depth_mm[row * w..(row + 1) * w].fill(0.0);
            }
        }
        Ok(DepthFrame {
            map,
            region: whole_region,
            t_s,
        })
    }
}
