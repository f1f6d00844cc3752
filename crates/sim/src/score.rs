//! The simulator's truth, for reports and evaluation only: nothing that decides may read it.

use cell::device::{Bit, DriveEnd};
use scene::{CoverId, Exclusion, FaceId, ScrewId, Theme};
use serde::{Deserialize, Serialize};

/// One thing that really happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Action {
    /// Cell clock, s.
    pub t_s: f64,
    /// Unit that stood on the table, counted from 0.
    pub unit: Option<u64>,
    /// What happened.
    pub kind: ActionKind,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum ActionKind {
    /// A unit came to stand on the table.
    Loaded {
        /// What it was drawn from.
        seed: u64,
        /// Whether anything spoils it that the paper excluded units for: [`UnitScore::exclusion`]; not in logs of versions before.
        #[serde(default)]
        spoilt: Option<bool>,
    },
    /// A face came to stand before the camera.
    Presented {
        /// Which.
        face: FaceId,
    },
    /// The driver ran.
    Drive {
        /// On which arm.
        arm: String,
        /// The nearest standing screw, if one was within 12 mm.
        screw: Option<ScrewId>,
        /// How the bit stood to it.
        aim: Option<Aim>,
        /// How it ended.
        end: DriveEnd,
        /// How long impacts of at least the screw's torque went on, s.
        #[serde(default)]
        impacts_s: f64,
    },
    /// A person was shown a picture.
    Asked {
        /// How many clicks came back.
        clicks: usize,
    },
    /// The bit of a driver was changed.
    Mounted {
        /// On which arm.
        arm: String,
        /// It carries this one now.
        bit: Bit,
    },
    /// The gripper pulled at a cover.
    Pull {
        /// With which arm.
        arm: String,
        /// At which cover.
        cover: CoverId,
        /// Whether it came off.
        off: bool,
        /// Screws that still held it.
        held_by: usize,
    },
    /// The gripper laid its cover aside.
    LaidAside,
    /// The unit left the table.
    Discharged,
}

/// How the bit really stood to a screw.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Aim {
    /// Distance of the bit's tip from the screw's axis, mm.
    pub lateral_mm: f64,
    /// How far the tip stood off the rim of the recess, mm; negative: inside.
    pub depth_mm: f64,
    /// Angle between bit and screw, rad.
    pub tilt_rad: f64,
}

/// What became of one screw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScrewScore {
    /// Which.
    pub id: ScrewId,
    /// On which face.
    pub face: FaceId,
    /// Whether it is out.
    pub removed: bool,
    /// Whether it is rusted solid.
    pub seized: bool,
    /// How often the driver ran on it.
    pub attempts: u32,
    /// Whether a camera could have seen it when its face was worked on; `None` if it was not.
    pub detectable: Option<bool>,
}

/// What became of one unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UnitScore {
    /// Counted from 0.
    pub index: u64,
    /// What it was drawn from.
    pub seed: u64,
    /// Model number on its plate.
    pub model: String,
    /// What it has been through.
    pub theme: Theme,
    /// Why it could not be done at all, if so.
    pub exclusion: Option<Exclusion>,
    /// When it came, s.
    pub loaded_s: f64,
    /// When it left, s.
    pub discharged_s: Option<f64>,
    /// Every screw.
    pub screws: Vec<ScrewScore>,
    /// Covers that came off.
    pub covers_off: Vec<CoverId>,
}

impl UnitScore {
    /// Screws still in.
    pub fn standing(&self) -> usize {
        self.screws.iter().filter(|s| !s.removed).count()
    }
}

/// Everything that really happened so far.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Every unit, in order; the one on the table is the last.
    pub units: Vec<UnitScore>,
    /// Every physical action, in order.
    pub actions: Vec<Action>,
}
