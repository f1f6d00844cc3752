//! What the program asks of a cell's devices. The simulated cell and every driver stand behind these traits.
//!
//! Rules that every implementation and every caller keeps: a move or a start is never sent twice (after a time-out the
//! state is read); `reset` is believed only when the state agrees; hold waits behind nothing; stale state is an error;
//! errors keep the device's raw code and text. Emergency stop, fences and servo enable belong to the safety PLC: they are
//! only observed here.

use async_trait::async_trait;
use geometry::{Base, CameraModel, DepthMap, RgbImage, Tool, Transform};
use serde::{Deserialize, Serialize};
use std::{fmt, sync::Arc};

/// A device that did not do what was asked.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DeviceError {
    /// No answer in time. The state must be read before anything else is asked.
    #[error("{device}: no answer to {action} within {timeout_s} s; its state is unknown until it is read")]
    Timeout {
        /// Name of the device.
        device: String,
        /// What was asked.
        action: String,
        /// How long was waited, s.
        timeout_s: f64,
    },
    /// The device refused or failed, in its own words.
    #[error("{device}: {action} failed with code {code} ({text})")]
    Fault {
        /// Name of the device.
        device: String,
        /// What was asked.
        action: String,
        /// The device's raw code.
        code: i64,
        /// The device's text.
        text: String,
    },
    /// The last known state is too old to act on.
    #[error("{device}: state is {age_s:.2} s old, too old to act on")]
    Stale {
        /// Name of the device.
        device: String,
        /// Age of the state, s.
        age_s: f64,
    },
    /// The target cannot be reached or is not allowed; nothing has moved.
    #[error("{device}: target refused: {reason}")]
    Refused {
        /// Name of the device.
        device: String,
        /// Why.
        reason: String,
    },
    /// The device is held, stopped or in alarm; a person has to release it.
    #[error("{device}: not ready ({state}); clear it at the device, then start again")]
    NotReady {
        /// Name of the device.
        device: String,
        /// What it said.
        state: String,
    },
}

/// Part of a picture, in pixels of the whole picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Region {
    /// Left column, px.
    pub x_px: u32,
    /// Top row, px.
    pub y_px: u32,
    /// Width, px.
    pub width_px: u32,
    /// Height, px.
    pub height_px: u32,
}

/// A colour picture as it came from the camera.
#[derive(Clone, Debug)]
pub struct ColorFrame {
    /// The pixels of `region`.
    pub image: RgbImage,
    /// Where they lie in the whole picture.
    pub region: Region,
    /// Time of exposure, cell clock, s.
    pub t_s: f64,
}

/// A depth picture registered to the colour camera.
#[derive(Clone, Debug)]
pub struct DepthFrame {
    /// Depth; its (0, 0) belongs to the corner of `region` (whose origin is a multiple of the map's step).
    pub map: DepthMap,
    /// Which part of the colour picture it covers.
    pub region: Region,
    /// Time of exposure, cell clock, s.
    pub t_s: f64,
}

/// A colour camera.
#[async_trait]
pub trait ColorCamera: Send + Sync {
    /// Intrinsics of the whole picture.
    fn intrinsics(&self) -> CameraModel;
    /// Exposes and hands over the picture, or only a region of it.
    async fn grab(&self, region: Option<Region>) -> Result<ColorFrame, DeviceError>;
}

/// A depth camera whose pictures are registered to the colour camera.
#[async_trait]
pub trait DepthCamera: Send + Sync {
    /// Measures depth, or only of a region of the colour picture.
    async fn grab(&self, region: Option<Region>) -> Result<DepthFrame, DeviceError>;
}

/// Who commands a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ArmMode {
    /// Teach pendant.
    Teach,
    /// Playback from the pendant.
    Play,
    /// This software.
    Remote,
}

/// What a robot says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmState {
    /// Who commands it.
    pub mode: ArmMode,
    /// Drives on.
    pub servo_on: bool,
    /// Moving or running a job.
    pub running: bool,
    /// Held by button or command.
    pub hold: bool,
    /// Alarm code and text.
    pub alarm: Option<(i64, String)>,
    /// Emergency stop, as observed.
    pub emergency_stop: bool,
    /// Commanded pose of the tool in the robot's base.
    pub base_from_tool: Transform<Base, Tool>,
    /// Joint angles from the encoders, rad.
    pub joints_rad: [f64; 6],
    /// Age of this state, s.
    pub age_s: f64,
}

/// How a move is made.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// All joints together: fastest.
    Joint,
    /// Straight line of the tool point at this speed.
    Linear {
        /// Speed of the tool point, mm/s.
        speed_mm_s: f64,
    },
}

/// A move that was accepted; hand it to [`RobotArm::wait`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ticket(pub u64);

/// A six-axis robot arm.
#[async_trait]
pub trait RobotArm: Send + Sync {
    /// Name in messages, such as "arm_a".
    fn name(&self) -> &str;
    /// Reads the state now.
    async fn state(&self) -> Result<ArmState, DeviceError>;
    /// Asks for a move of the tool to a pose in the robot's base. Returns at once; refused targets move nothing.
    async fn move_to(&self, base_from_tool: Transform<Base, Tool>, motion: Motion) -> Result<Ticket, DeviceError>;
    /// Waits until the running bit is off *and* the pose is the target's, or the time is over.
    async fn wait(&self, ticket: Ticket, timeout_s: f64) -> Result<ArmState, DeviceError>;
    /// Starts a job stored on the controller.
    async fn run_job(&self, job: &str) -> Result<Ticket, DeviceError>;
    /// Holds at once.
    async fn hold(&self) -> Result<(), DeviceError>;
    /// Clears an alarm or hold. Believe the state, not this answer; never starts a motion.
    async fn reset(&self) -> Result<(), DeviceError>;
}

/// What the driver's spindle carries. All end at the same length from the flange: a map holds for each of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Bit {
    /// The cross bit.
    #[default]
    Cross,
    /// A bit that cuts its own grip into a worn or filled recess.
    Extractor,
    /// A cutter that takes the head off: destructive.
    Mill,
}

impl Bit {
    /// Name, as in the tag [`tags::bit`] and in the job that mounts it.
    pub fn name(self) -> &'static str {
        match self {
            Bit::Cross => "cross",
            Bit::Extractor => "extractor",
            Bit::Mill => "mill",
        }
    }
}

/// A bounded programme of the driver.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveProgram {
    /// Axial force on the bit, N.
    pub axial_force_n: f64,
    /// Longest time of impacting, s.
    pub max_time_s: f64,
    /// Torque that is never exceeded, N m.
    pub max_torque_nm: f64,
    /// Stroke after which the screw counts as out, mm; of a mill: how deep it goes.
    pub stroke_mm: f64,
    /// With which bit; it is mounted first if the driver carries another.
    #[serde(default)]
    pub bit: Bit,
}

/// How a drive programme ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DriveEnd {
    /// The screw came out.
    Removed,
    /// The bit slipped out of the recess.
    CamOut,
    /// The screw did not turn within time and torque.
    Seized,
    /// The bit did not find the recess.
    MissedHead,
    /// The programme did not end in time.
    TimeOut,
}

/// What the driver measured.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DriveResult {
    /// How it ended.
    pub end: DriveEnd,
    /// Time it took, s.
    pub time_s: f64,
    /// Highest torque, N m.
    pub peak_torque_nm: f64,
    /// Stroke of the bit, mm.
    pub stroke_mm: f64,
}

/// A pneumatic impact driver with a cross bit, spring and cone.
#[async_trait]
pub trait DriverTool: Send + Sync {
    /// Runs one bounded programme where the bit stands now.
    async fn drive(&self, program: DriveProgram) -> Result<DriveResult, DeviceError>;
}

/// Value of a named tag of the cell's I/O.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TagValue {
    /// A switch or a lamp.
    Bool(bool),
    /// A measured value or a set point.
    Number(f64),
    /// A name.
    Text(String),
}

/// Named inputs and outputs of the cell: see [`tags`].
#[async_trait]
pub trait CellIo: Send + Sync {
    /// Reads a tag.
    async fn read(&self, tag: &str) -> Result<TagValue, DeviceError>;
    /// Writes a tag.
    async fn write(&self, tag: &str, value: TagValue) -> Result<(), DeviceError>;
    /// Waits until a tag has a value.
    async fn wait_for(&self, tag: &str, value: TagValue, timeout_s: f64) -> Result<(), DeviceError>;
}

/// Tags that the program uses.
pub mod tags {
    /// Bool, input: the loading switch; a unit stands on the table.
    pub const LOADED: &str = "switch/loaded";
    /// Bool, output: ask the infeed for the next unit.
    pub const FEED: &str = "infeed/next";
    /// Bool, output: discharge the unit.
    pub const DISCHARGE: &str = "outfeed/discharge";
    /// Bool, output: magnet of the table.
    pub const MAGNET: &str = "table/magnet";
    /// Text, output: turn this face to the camera (`front`, `left`, `right`, `top`).
    pub const PRESENT: &str = "table/present";
    /// Text, input: the face that stands before the camera, empty while turning.
    pub const PRESENTED: &str = "table/presented";
    /// Bool, input: the gripper of the second arm holds a cover.
    pub const GRIPPER_HOLDING: &str = "gripper/holding";
    /// Bool, input: safety chain closed (observed only).
    pub const SAFETY_OK: &str = "safety/ok";
    /// Bool, input: the plant's controller permits milling now; without it nothing is milled.
    pub const MILL_PERMITTED: &str = "safety/mill_permitted";
    /// Text, input: the bit that this arm's driver carries ([`Bit::name`](super::Bit::name)).
    pub fn bit(arm: &str) -> String {
        format!("{arm}/bit")
    }
}

/// What the model-number reader read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelNumber(pub String);

/// A reader of the unit's model number.
#[async_trait]
pub trait ModelReader: Send + Sync {
    /// Reads the plate; `None` if it cannot be read (dirty, missing).
    async fn read(&self) -> Result<Option<ModelNumber>, DeviceError>;
}

/// The plant's own systems: told of every finished unit.
#[async_trait]
pub trait PlantLink: Send + Sync {
    /// Reports a finished unit's record as JSON.
    async fn report(&self, record_json: &str) -> Result<(), DeviceError>;
}

/// The cell's clock. Simulated cells run on simulated seconds.
pub trait Clock: Send + Sync {
    /// Seconds since the cell was switched on.
    fn now_s(&self) -> f64;
    /// Lets the time pass that is budgeted for computing. A simulated clock moves on by it (so that a run does not depend on
    /// the machine that computes it); on a real clock that time has passed by itself.
    fn pass(&self, _budget_s: f64) {}
}

/// Jobs that are stored on the arms' controllers and that the program starts by name.
pub mod jobs {
    /// Clear of the table and of the camera's view.
    pub const HOME: &str = "HOME";
    /// Grips a cover and pulls it with bounded force. Ends in any case: [`GRIPPER_HOLDING`](super::tags::GRIPPER_HOLDING)
    /// says afterwards whether the cover came off (true) or stayed (false). `PULL_TOP`, `PULL_FRONT`, `PULL_RIGHT`.
    pub fn pull(cover: &str) -> String {
        format!("PULL_{}", cover.to_uppercase())
    }
    /// Lays the held cover aside; the gripper is empty afterwards.
    pub const DROP: &str = "DROP";
    /// Changes the driver's bit at the magazine; the tag [`bit`](super::tags::bit) says afterwards which it carries. `MOUNT_CROSS`,
    /// `MOUNT_EXTRACTOR`, `MOUNT_MILL`.
    pub fn mount(bit: super::Bit) -> String {
        format!("MOUNT_{}", bit.name().to_uppercase())
    }
}

/// A picture that a person is asked about.
#[derive(Clone, Debug)]
pub struct Question {
    /// What is asked, in words.
    pub text: String,
    /// The picture.
    pub image: RgbImage,
    /// Which part of the whole picture it shows.
    pub region: Region,
    /// Heads that are in doubt, px of the whole picture.
    pub doubtful: Vec<[f64; 2]>,
}

/// A person at a screen.
#[async_trait]
pub trait Operator: Send + Sync {
    /// Shows the picture and asks for a click on every cross screw that still stands.
    ///
    /// # Returns
    /// The middles of the recesses, px of the whole picture; none if the person sees none.
    ///
    /// # Errors
    /// [`DeviceError::Timeout`] if nobody answers in time.
    async fn point_at_screws(&self, question: &Question, timeout_s: f64) -> Result<Vec<[f64; 2]>, DeviceError>;
}

/// A robot arm with its place in the cell.
#[derive(Clone)]
pub struct Arm {
    /// The robot.
    pub robot: Arc<dyn RobotArm>,
    /// Driver on its flange, if it carries one.
    pub driver: Option<Arc<dyn DriverTool>>,
}

/// All devices of one cell.
#[derive(Clone)]
pub struct Devices {
    /// Colour camera.
    pub color: Arc<dyn ColorCamera>,
    /// Depth camera.
    pub depth: Arc<dyn DepthCamera>,
    /// Arms, the first one is used first.
    pub arms: Vec<Arm>,
    /// Named I/O.
    pub io: Arc<dyn CellIo>,
    /// Model-number reader.
    pub reader: Arc<dyn ModelReader>,
    /// Plant link.
    pub plant: Arc<dyn PlantLink>,
    /// A person who may be asked, if there is one.
    pub operator: Option<Arc<dyn Operator>>,
    /// Clock.
    pub clock: Arc<dyn Clock>,
}

impl fmt::Debug for Devices {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Devices")
            .field("arms", &self.arms.len())
            .finish_non_exhaustive()
    }
}
