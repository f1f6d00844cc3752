//! A cell of a few lines, every device in one mutex: what the tests need to see what was asked of the devices, and in which order.

#![allow(dead_code)] // each test file uses its own part

use async_trait::async_trait;
use calibration::{Map, Pair, Settings, Volume, lattice};
use cell::device::*;
use cell::journal::Journal;
use cell::program::Program;
use cell::run::{Finder, Runner};
use geometry::{Base, Camera, CameraModel, DepthMap, Direction, Pixel, Point, RgbImage, RgbdFrame, Tool, Transform};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};

pub const FACES: [&str; 5] = ["front", "left", "right", "top", "front_inner"];

/// A head on a face.
#[derive(Clone, Debug)]
pub struct Head {
    /// Across the face, mm: x right, y down from the camera's axis.
    pub at_mm: [f64; 2],
    pub verdict: vision::Verdict,
    pub stands: bool,
    /// How bursts at it end; then `Removed`.
    pub ends: VecDeque<DriveEnd>,
    pub bursts: usize,
}

pub fn screw(x_mm: f64, y_mm: f64) -> Head {
    Head {
        at_mm: [x_mm, y_mm],
        verdict: vision::Verdict::Screw,
        stands: true,
        ends: VecDeque::new(),
        bursts: 0,
    }
}

pub fn screw_that_ends(x_mm: f64, y_mm: f64, ends: &[DriveEnd]) -> Head {
    Head {
        ends: ends.iter().copied().collect(),
        ..screw(x_mm, y_mm)
    }
}

#[derive(Debug)]
pub struct World {
    pub t_s: f64,
    pub loaded: bool,
    pub presented: String,
    pub holding: bool,
    pub faces: BTreeMap<String, Vec<Head>>,
    /// Tilt of a face about the camera's y, rad.
    pub tilt_rad: BTreeMap<String, f64>,
    /// Lean of the heads of a face against it, rad.
    pub lean_rad: BTreeMap<String, f64>,
    /// Covers that are off.
    pub off: Vec<String>,
    /// What was asked, in order.
    pub log: Vec<String>,
    /// Every pose of a tool that was commanded.
    pub poses: Vec<Transform<Base, Tool>>,
    pub pose: [Transform<Base, Tool>; 2],
    /// The answer to this move (counted from 1) is lost although the arm goes.
    pub lose_answer_of_move: Option<usize>,
    /// The answer to this burst is lost; whether the screw comes out follows its `ends`.
    pub lose_answer_of_burst: Option<usize>,
    /// The driver says "removed" for this burst, but the screw stands.
    pub lie_at_burst: Option<usize>,
    /// The call of this name with this number never returns: the program dies there. The flag says whether it took effect.
    pub die_at: Option<(&'static str, usize, bool)>,
    pub calls: BTreeMap<&'static str, usize>,
    /// The safety chain is closed.
    pub safe: bool,
    /// It opens at this burst.
    pub unsafe_at_burst: Option<usize>,
    /// The bit of the first arm.
    pub bit: String,
    /// The plant's controller permits milling.
    pub mill_permitted: bool,
    /// Where a person clicks, by face, on the face, mm.
    pub clicks: BTreeMap<String, Vec<[f64; 2]>>,
}

/// The world, and word of the program's death.
#[derive(Clone)]
pub struct Fake(pub Arc<Mutex<World>>, pub Arc<tokio::sync::Notify>);

impl Fake {
    pub fn new(faces: &[(&str, Vec<Head>)]) -> Self {
        let mut all: BTreeMap<String, Vec<Head>> = FACES.iter().map(|f| ((*f).to_owned(), Vec::new())).collect();
        for (face, heads) in faces {
            all.insert((*face).to_owned(), heads.clone());
        }
        let rest = cell::plan::tool_pose(Point::new(300.0, 0.0, 900.0), Direction::new(1.0, 0.0, 0.0).expect("x"));
        Self(
            Arc::new(Mutex::new(World {
                t_s: 0.0,
                loaded: false,
                presented: String::new(),
                holding: false,
                faces: all,
                tilt_rad: BTreeMap::new(),
                lean_rad: BTreeMap::new(),
                off: Vec::new(),
                log: Vec::new(),
                poses: Vec::new(),
                pose: [rest, rest],
                lose_answer_of_move: None,
                lose_answer_of_burst: None,
                lie_at_burst: None,
                die_at: None,
                calls: BTreeMap::new(),
                safe: true,
                unsafe_at_burst: None,
                bit: "cross".into(),
                mill_permitted: false,
                clicks: BTreeMap::new(),
            })),
            Arc::new(tokio::sync::Notify::new()),
        )
    }

    /// A unit with two screws on every face.
    pub fn whole() -> Self {
        let two = || vec![screw(-100.0, -80.0), screw(120.0, 60.0)];
        Self::new(&FACES.map(|face| (face, two())))
    }

    pub fn world(&self) -> MutexGuard<'_, World> {
        self.0.lock().expect("no test panics while it holds the world")
    }

    pub fn devices(&self) -> Devices {
        let arm = |index: usize| Arm {
            robot: Arc::new(FakeArm {
                fake: self.clone(),
                index,
                name: ["arm_a", "arm_b"][index].into(),
            }),
            driver: (index == 0).then(|| Arc::new(self.clone()) as Arc<dyn DriverTool>),
        };
        Devices {
            color: Arc::new(self.clone()),
            depth: Arc::new(FakeDepth(self.clone())),
            arms: vec![arm(0), arm(1)],
            io: Arc::new(self.clone()),
            reader: Arc::new(self.clone()),
            plant: Arc::new(self.clone()),
            clock: Arc::new(self.clone()),
            operator: Some(Arc::new(self.clone())),
        }
    }

    /// Notes a call; true if the program dies in it, with whether it took effect.
    fn call(&self, name: &'static str, s: f64) -> (usize, Option<bool>) {
        let mut world = self.world();
        world.t_s += s;
        let n = world.calls.entry(name).or_default();
        *n += 1;
        let n = *n;
        let dies = world.die_at.filter(|(at, k, _)| *at == name && *k == n).map(|d| d.2);
        (n, dies)
    }

    /// A call that never returns.
    async fn die(&self) -> ! {
        self.1.notify_one();
        std::future::pending::<()>().await;
        unreachable!("pending never ends")
    }

    pub fn calls(&self, name: &str) -> usize {
        self.world().calls.get(name).copied().unwrap_or(0)
    }
    pub fn standing(&self) -> usize {
        self.world().faces.values().flatten().filter(|h| h.stands).count()
    }
    /// Entries of the log that begin with any of these.
    pub fn entries(&self, of: &[&str]) -> Vec<String> {
        let world = self.world();
        world
            .log
            .iter()
            .filter(|l| of.iter().any(|o| l.starts_with(o)))
            .cloned()
            .collect()
    }
}

/// Where its arms stand, whatever they are told: before the middle of a face, and every way from there is free.
pub fn rest_rad() -> [f64; 6] {
    let drawing = cell::motion::CellDrawing::default();
    let arm = cell::motion::ArmMotion::new(&drawing, "arm_a").expect("a drawn arm");
    let ahead = Direction::new(1.0, 0.0, 0.0).expect("x");
    let rest = cell::plan::tool_pose(Point::new(800.0, 0.0, 600.0), ahead);
    arm.arm().inverse(rest).expect("in reach")
}

/// A cell whose arms rest there.
pub fn config() -> cell::CellConfig {
    let mut config = cell::CellConfig::simulated();
    config.motion.arms[0].home_rad = rest_rad();
    config
}

/// A runner of the paper's program that has been started.
pub fn started(
    fake: &Fake,
    folder: &Path,
    finder: impl Finder + 'static,
    map: Map,
    config: cell::CellConfig,
) -> Runner {
    let program = Program::paper().expect("built-in program");
    let journal = Journal::open(folder).expect("journal");
    let runner = Runner::new(fake.devices(), Arc::new(finder), vec![map], program, config, journal).expect("runner");
    runner.start().expect("started");
    runner
}

pub fn camera() -> CameraModel {
    CameraModel::pinhole(1024, 768, 1100.0, 1100.0)
}

/// The camera stands 1.5 m before the faces and looks along the base's x.
pub fn base_from_camera() -> Transform<Base, Camera> {
    let columns = [-Vector3::y(), -Vector3::z(), Vector3::x()];
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&columns));
    Transform::from_parts([-400.0, 0.0, 500.0], UnitQuaternion::from_rotation_matrix(&rotation))
}

pub fn volume() -> Volume {
    Volume::between(Point::new(950.0, -300.0, 250.0), Point::new(1250.0, 300.0, 750.0))
}

/// A map fitted to pairs that are right to the last digit.
pub fn map() -> Map {
    map_that_is_off(0.0)
}

/// A map that sends the arm so far too high.
pub fn map_that_is_off(by_mm: f64) -> Map {
    let pairs: Vec<Pair> = lattice(&volume(), 100.0)
        .expect("a lattice")
        .into_iter()
        .map(|t| {
            let camera = base_from_camera().inverse() * t.command;
            Pair {
                id: t.id,
                node: t.node,
                t_s: 0.0,
                command: t.command.moved(Direction::new(0.0, 0.0, 1.0).expect("up"), by_mm),
                pixel: self::camera().project(camera),
                depth_mm: Some(camera.z_mm()),
                camera: Some(camera),
                joints_rad: None,
                valid: true,
            }
        })
        .collect();
    Map::fit(&pairs, &Settings::default()).expect("a map").0
}

/// Where a place on the presented face is.
fn on_face(at_mm: [f64; 2], tilt_rad: f64) -> Point<Camera> {
    Point::new(at_mm[0], at_mm[1], 1500.0 + at_mm[0] * tilt_rad.tan())
}

/// The face's normal for that tilt, towards the camera.
fn normal(tilt_rad: f64) -> Vector3<f64> {
    Vector3::new(tilt_rad.sin(), 0.0, -tilt_rad.cos())
}

fn timeout(device: &str, action: &str) -> DeviceError {
    DeviceError::Timeout {
        device: device.into(),
        action: action.into(),
        timeout_s: 1.0,
    }
}

impl Clock for Fake {
    fn now_s(&self) -> f64 {
        self.world().t_s
    }
    fn pass(&self, budget_s: f64) {
        self.world().t_s += budget_s;
    }
}

fn whole(region: Option<Region>) -> Region {
    region.unwrap_or(Region {
        x_px: 0,
        y_px: 0,
        width_px: camera().width_px,
        height_px: camera().height_px,
    })
}

#[async_trait]
impl ColorCamera for Fake {
    fn intrinsics(&self) -> CameraModel {
        camera()
    }
    async fn grab(&self, region: Option<Region>) -> Result<ColorFrame, DeviceError> {
        self.call("grab", 0.3);
        let mut world = self.world();
        let region = whole(region);
        // a face, or what is around a few heads
        let what = if 4 * region.width_px > camera().width_px {
            "picture"
        } else {
            "look"
        };
        let entry = format!("{what} {}", world.presented);
        world.log.push(entry);
        let mut image = RgbImage::from_pixel(region.width_px, region.height_px, image::Rgb([120, 120, 118]));
        let tilt = world.tilt_rad.get(&world.presented).copied().unwrap_or(0.0);
        for head in world
            .faces
            .get(&world.presented)
            .into_iter()
            .flatten()
            .filter(|h| h.stands)
        {
            if let Some(pixel) = camera().project(on_face(head.at_mm, tilt)) {
                paint(&mut image, region, pixel);
            }
        }
        Ok(ColorFrame {
            image,
            region,
            t_s: world.t_s,
        })
    }
}

/// A head is a bright pixel; green and blue say where in it the centre is, in hundredths.
fn paint(image: &mut RgbImage, region: Region, at: Pixel) {
    let (u, v) = (at.u_px.floor(), at.v_px.floor());
    let (x, y) = (u - f64::from(region.x_px), v - f64::from(region.y_px));
    if x >= 0.0 && y >= 0.0 && x < f64::from(region.width_px) && y < f64::from(region.height_px) {
        let part = |c: f64| (100.0 * (c - c.floor())).round() as u8;
        image.put_pixel(x as u32, y as u32, image::Rgb([255, part(at.u_px), part(at.v_px)]));
    }
}

/// Finds what is painted: the picture alone decides, as with a real detector.
#[derive(Clone, Copy, Debug, Default)]
pub struct PixelFinder {
    /// Heads that it overlooks, from the top left.
    pub overlooks: usize,
}

impl Finder for PixelFinder {
    fn find(&self, frame: &RgbdFrame, _: f64) -> Result<Vec<vision::Screw>, DeviceError> {
        let Some(camera) = frame.camera else {
            return Ok(Vec::new());
        };
        let heads = frame.color.enumerate_pixels().filter(|(_, _, p)| p.0[0] == 255);
        let screws = heads.skip(self.overlooks).map(|(x, y, p)| {
            let pixel = Pixel::new(
                f64::from(x) + f64::from(p.0[1]) / 100.0,
                f64::from(y) + f64::from(p.0[2]) / 100.0,
            );
            let plane = frame.depth.as_ref().and_then(|d| d.plane_at(pixel, 0.0, 20.0));
            vision::Screw {
                pixel,
                sigma_px: 0.2,
                diameter_px: 9.0 / camera.pixel_mm(1500.0),
                score: 0.95,
                fits: 0.95,
                drive: vision::Drive::Cross,
                verdict: vision::Verdict::Screw,
                cues: Vec::new(),
                angle_rad: None,
                camera: plane.map(|plane| camera.unproject(pixel, plane.depth_mm)),
                normal: None,
                top_normal: None,
                sigma_lateral_mm: Some(0.1),
                sigma_depth_mm: Some(0.1),
            }
        });
        Ok(screws.collect())
    }
    fn model(&self) -> String {
        "pixels".into()
    }
}

struct FakeDepth(Fake);

#[async_trait]
impl DepthCamera for FakeDepth {
    async fn grab(&self, region: Option<Region>) -> Result<DepthFrame, DeviceError> {
        let mut world = self.0.world();
        world.t_s += 0.5;
        let region = whole(region);
        let tilt = world.tilt_rad.get(&world.presented).copied().unwrap_or(0.0);
        let cover = world.presented.clone();
        let deeper = if world.off.contains(&cover) { 60.0 } else { 0.0 };
        let n = normal(tilt);
        let map = DepthMap {
            width: region.width_px / 2,
            height: region.height_px / 2,
            step: 2,
            depth_mm: Vec::new(),
        };
        let depth_mm = (0..map.width * map.height)
            .map(|k| {
                let p = map.color_pixel(k % map.width, k / map.width);
                let p = Pixel::new(p.u_px + f64::from(region.x_px), p.v_px + f64::from(region.y_px));
                let [x, y] = camera().ray(p);
                (1500.0 * n.z / (n.x * x + n.y * y + n.z) + deeper) as f32
            })
            .collect();
        Ok(DepthFrame {
            map: DepthMap { depth_mm, ..map },
            region,
            t_s: world.t_s,
        })
    }
}

impl Finder for Fake {
    fn find(&self, frame: &RgbdFrame, odds: f64) -> Result<Vec<vision::Screw>, DeviceError> {
        let world = self.world();
        let tilt = world.tilt_rad.get(&world.presented).copied().unwrap_or(0.0);
        let lean = world.lean_rad.get(&world.presented).copied().unwrap_or(0.0);
        let Some(part) = frame.camera else {
            return Ok(Vec::new());
        };
        let fits = 0.95 * odds / (0.95 * odds + 0.05);
        let heads = world.faces.get(&world.presented).cloned().unwrap_or_default();
        let screws = heads
            .iter()
            .filter(|h| h.stands)
            .filter_map(|head| {
                let point = on_face(head.at_mm, tilt);
                let pixel = part.project(point)?;
                part.contains(pixel).then(|| vision::Screw {
                    pixel,
                    sigma_px: 0.2,
                    diameter_px: 9.0 / part.pixel_mm(point.z_mm()),
                    score: fits,
                    fits,
                    drive: vision::Drive::Cross,
                    verdict: head.verdict,
                    cues: Vec::new(),
                    angle_rad: None,
                    camera: frame.depth.as_ref().map(|_| point),
                    normal: Direction::from_vector(normal(tilt + lean)),
                    top_normal: Direction::from_vector(normal(tilt + lean)),
                    sigma_lateral_mm: Some(0.1),
                    sigma_depth_mm: Some(0.1),
                })
            })
            .collect();
        Ok(screws)
    }
    fn model(&self) -> String {
        "fake".into()
    }
}

struct FakeArm {
    fake: Fake,
    index: usize,
    name: String,
}

#[async_trait]
impl RobotArm for FakeArm {
    fn name(&self) -> &str {
        &self.name
    }
    async fn state(&self) -> Result<ArmState, DeviceError> {
        self.fake.call("state", 0.01);
        Ok(ArmState {
            mode: ArmMode::Remote,
            servo_on: true,
            running: false,
            hold: false,
            alarm: None,
            emergency_stop: false,
            base_from_tool: self.fake.world().pose[self.index],
            joints_rad: rest_rad(),
            age_s: 0.01,
        })
    }
    async fn move_to(&self, base_from_tool: Transform<Base, Tool>, _: Motion) -> Result<Ticket, DeviceError> {
        let (n, dies) = self.fake.call("move", 0.4);
        if dies == Some(false) {
            self.fake.die().await;
        }
        {
            let mut world = self.fake.world();
            world.log.push(format!("move {}", self.name));
            world.poses.push(base_from_tool);
            world.pose[self.index] = base_from_tool;
        }
        if dies == Some(true) {
            self.fake.die().await;
        }
        if self.fake.world().lose_answer_of_move == Some(n) {
            return Err(timeout(&self.name, "move"));
        }
        Ok(Ticket(n as u64))
    }
    async fn wait(&self, _: Ticket, _: f64) -> Result<ArmState, DeviceError> {
        self.state().await
    }
    async fn run_job(&self, job: &str) -> Result<Ticket, DeviceError> {
        if job == jobs::HOME {
            return Ok(Ticket(0));
        }
        if let Some(bit) = job.strip_prefix("MOUNT_") {
            let mut world = self.fake.world();
            world.log.push(job.to_owned());
            world.bit = bit.to_lowercase();
            return Ok(Ticket(0));
        }
        let (n, dies) = self.fake.call("job", 5.0);
        if dies == Some(false) {
            self.fake.die().await;
        }
        {
            let mut world = self.fake.world();
            world.log.push(job.to_owned());
            if job == jobs::DROP {
                world.holding = false;
            } else if let Some(cover) = job.strip_prefix("PULL_").map(str::to_lowercase) {
                let holds: &[&str] = match cover.as_str() {
                    "front" => &["front", "front_inner", "left"],
                    other => &[FACES
                        .iter()
                        .copied()
                        .find(|f| *f == other)
                        .expect("a cover that is a face")],
                };
                let held = holds.iter().any(|f| world.faces[*f].iter().any(|h| h.stands));
                if !held && !world.off.contains(&cover) {
                    world.holding = true;
                    world.off.push(cover);
                }
            }
        }
        if dies == Some(true) {
            self.fake.die().await;
        }
        Ok(Ticket(n as u64))
    }
    async fn hold(&self) -> Result<(), DeviceError> {
        Ok(())
    }
    async fn reset(&self) -> Result<(), DeviceError> {
        self.fake.call("reset", 0.1);
        Ok(())
    }
}

#[async_trait]
impl DriverTool for Fake {
    async fn drive(&self, program: DriveProgram) -> Result<DriveResult, DeviceError> {
        let (n, dies) = self.call("drive", 2.0);
        if dies == Some(false) {
            self.die().await;
        }
        let end = {
            let mut world = self.world();
            let tilt = world.tilt_rad.get(&world.presented).copied().unwrap_or(0.0);
            let tip = base_from_camera().inverse() * (world.pose[0] * Point::new(0.0, 0.0, 0.0));
            let lie = world.lie_at_burst == Some(n);
            let face = world.presented.clone();
            let heads = world.faces.get_mut(&face).expect("a face");
            // the spring takes 3 mm along the axis
            let meets = |h: &Head| {
                let off = tip.vector() - on_face(h.at_mm, tilt).vector();
                let along = normal(tilt) * off.dot(&normal(tilt));
                along.norm() < 3.0 && (off - along).norm() < 0.75
            };
            let met = heads.iter_mut().find(|h| h.stands && meets(h));
            let end = match met {
                None => DriveEnd::MissedHead,
                Some(head) => {
                    head.bursts += 1;
                    let end = head.ends.pop_front().unwrap_or(DriveEnd::Removed);
                    head.stands = end != DriveEnd::Removed || lie;
                    end
                }
            };
            world.log.push(format!(
                "drive {face} {:.0} N {:.1} s",
                program.axial_force_n, program.max_time_s
            ));
            assert_eq!(program.bit.name(), world.bit, "the bit is mounted before it is used");
            if world.unsafe_at_burst == Some(n) {
                world.safe = false;
            }
            end
        };
        if dies == Some(true) {
            self.die().await;
        }
        if self.world().lose_answer_of_burst == Some(n) {
            return Err(timeout("driver", "drive"));
        }
        Ok(DriveResult {
            end,
            time_s: 2.0,
            peak_torque_nm: 5.0,
            stroke_mm: 10.0,
        })
    }
}

#[async_trait]
impl CellIo for Fake {
    async fn read(&self, tag: &str) -> Result<TagValue, DeviceError> {
        let world = self.world();
        Ok(match tag {
            tags::LOADED => TagValue::Bool(world.loaded),
            tags::PRESENTED => TagValue::Text(world.presented.clone()),
            tags::GRIPPER_HOLDING => TagValue::Bool(world.holding),
            tags::SAFETY_OK => TagValue::Bool(world.safe),
            tags::MILL_PERMITTED => TagValue::Bool(world.mill_permitted),
            "arm_a/bit" | "arm_b/bit" => TagValue::Text(world.bit.clone()),
            _ => TagValue::Bool(false),
        })
    }
    async fn write(&self, tag: &str, value: TagValue) -> Result<(), DeviceError> {
        let mut world = self.world();
        match (tag, value) {
            (tags::FEED, _) => {
                world.t_s += 10.0;
                world.loaded = true;
            }
            (tags::DISCHARGE, _) => {
                world.t_s += 8.0;
                world.loaded = false;
                world.presented.clear();
                world.log.push("discharge".into());
            }
            (tags::PRESENT, TagValue::Text(face)) => {
                world.t_s += 3.0;
                world.log.push(format!("present {face}"));
                world.presented = face;
            }
            _ => {}
        }
        Ok(())
    }
    async fn wait_for(&self, tag: &str, value: TagValue, _: f64) -> Result<(), DeviceError> {
        if CellIo::read(self, tag).await? == value {
            Ok(())
        } else {
            Err(timeout("io", tag))
        }
    }
}

#[async_trait]
impl Operator for Fake {
    async fn point_at_screws(&self, question: &Question, _: f64) -> Result<Vec<[f64; 2]>, DeviceError> {
        let world = self.world();
        let clicks = world.clicks.get(&world.presented).cloned().unwrap_or_default();
        let tilt = world.tilt_rad.get(&world.presented).copied().unwrap_or(0.0);
        let camera = camera();
        let pixels = clicks.into_iter().filter_map(|at| camera.project(on_face(at, tilt)));
        let whole = pixels.map(|p| [p.u_px, p.v_px]);
        let region = question.region;
        Ok(whole
            .filter(|p| p[0] >= f64::from(region.x_px) && p[1] >= f64::from(region.y_px))
            .collect())
    }
}

#[async_trait]
impl ModelReader for Fake {
    async fn read(&self) -> Result<Option<ModelNumber>, DeviceError> {
        Ok(Some(ModelNumber("CU-X22".into())))
    }
}

#[async_trait]
impl PlantLink for Fake {
    async fn report(&self, _: &str) -> Result<(), DeviceError> {
        self.call("report", 0.0);
        Ok(())
    }
}
