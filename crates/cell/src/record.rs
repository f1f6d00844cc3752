//! What is known of a unit: the events of its way, and the record that they add up to.
//!
//! The record is a fold over the events ([`UnitRecord::apply`]) and nothing else, so that what the journal holds after a crash
//! is what the program knows.

use crate::device::{Bit, DriveEnd, DriveProgram};
use crate::frames::KeptFrame;
use crate::look::{self, Decision, SecondLook};
use crate::policy::Ruling;
use crate::program::FaceId;
use geometry::{Base, Camera, Direction, Point};
use serde::{Deserialize, Serialize};
use std::fmt;

pub use calibration::Hull;
pub use vision::Verdict;

/// A candidate on a face.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Found {
    /// Centre of the recess in the picture, px.
    pub u_px: f64,
    /// Centre of the recess in the picture, px.
    pub v_px: f64,
    /// Its standard error, px.
    pub sigma_px: f64,
    /// Diameter of the head, px.
    pub diameter_px: f64,
    /// How sure the detector is, 0 to 1.
    pub score: f64,
    /// Kind of drive: `cross`, `slotted`, `hex_socket`, `torx`, `hex_head`, `unknown`.
    pub drive: String,
    /// What may be done with it.
    pub verdict: Verdict,
    /// Where it is in the camera's frame, if depth was measured there.
    pub camera_mm: Option<Point<Camera>>,
    /// Where it is in the base of the arm that reaches it.
    pub base_mm: Option<Point<Base>>,
    /// Standard error across the view, mm.
    pub sigma_lateral_mm: Option<f64>,
    /// Standard error along the view, mm.
    pub sigma_depth_mm: Option<f64>,
    /// Where it lies with respect to the calibrated volume.
    pub hull: Option<Hull>,
    /// Tilt of the sheet around it against the camera's axis, rad.
    pub tilt_rad: Option<f64>,
    /// Why it is not acted on; `None` for a target.
    pub left_alone: Option<LeftAlone>,
    /// What exactly is in the way, where an arm could not have gone there.
    #[serde(default)]
    pub refusal: Option<String>,
}

/// Why a candidate is not acted on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LeftAlone {
    /// The bit does not fit.
    OtherDrive,
    /// A person should look.
    Review,
    /// The bit has not met it where it is seen, nor around: only a person can say where it is.
    NotMet,
    /// There was no depth at it.
    NoDepth,
    /// It lies at the border of every arm's calibrated volume.
    HullEdge,
    /// It lies outside every arm's calibrated volume.
    HullOutside,
    /// Its head is no screw's size.
    HeadSize,
    /// The sheet around it is bent beyond the driver's range.
    Bent,
    /// No arm's joints can take it there, or not clear of the wrist's singularity.
    Unreachable,
    /// On the way there an arm would come too near to something.
    Collision,
}

impl fmt::Display for LeftAlone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::OtherDrive => "the bit does not fit",
            Self::Review => "a person should look",
            Self::NotMet => "the bit has not met it",
            Self::NoDepth => "no depth was measured",
            Self::HullEdge => "at the border of the calibrated volume",
            Self::HullOutside => "outside the calibrated volume",
            Self::HeadSize => "not the size of a screw's head",
            Self::Bent => "the sheet is bent beyond the driver's range",
            Self::Unreachable => "out of the arms' reach",
            Self::Collision => "something is in an arm's way",
        })
    }
}

/// Hash of a stored picture, hexadecimal SHA-256.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PictureId(pub String);

/// Plane of a face.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FacePlane {
    /// Depth where it crosses the camera's axis, mm.
    pub depth_mm: f64,
    /// Tilt against the camera's axis, rad.
    pub tilt_rad: f64,
    /// Which way it looks, towards the camera; not in journals of versions before.
    #[serde(default)]
    pub normal: Option<Direction<Camera>>,
    /// How far the heads of its screws lean from it together, rad; `None` with fewer than three, or where they do not lean together.
    #[serde(default)]
    pub heads_lean_rad: Option<f64>,
    /// Which way they look then; not in journals of versions before.
    #[serde(default)]
    pub heads_normal: Option<Direction<Camera>>,
}

/// One burst of the driver.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Burst {
    /// What was asked of the driver; `None` if it did not come to that.
    pub program: Option<DriveProgram>,
    /// How it ended; `None` if a device failed before.
    pub end: Option<DriveEnd>,
    /// What a device said, if one failed.
    pub error: Option<String>,
    /// Where the bit was sent.
    pub aim: Point<Base>,
    /// Picture of the second look that this burst was aimed with.
    pub second_look: Option<PictureId>,
    /// Of a burst of a search: places around the head that were still to be tried after it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub places_left: Option<usize>,
    /// Time from the start of the approach to the end of the retreat, s.
    pub time_s: f64,
}

/// Everything that was done to one screw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScrewAttempt {
    /// Its number in [`FaceRecord::found`].
    pub found: usize,
    /// Arm that did it.
    pub arm: String,
    /// Its bursts, the last one decided.
    pub bursts: Vec<Burst>,
    /// What a second picture said: `Some(true)` if a screw still stands there.
    pub still_there: Option<bool>,
    /// What was chosen when nothing harmless was left, and why.
    #[serde(default)]
    pub decision: Option<Ruling>,
}

impl ScrewAttempt {
    /// How the last burst ended.
    pub fn end(&self) -> Option<DriveEnd> {
        self.bursts.last().and_then(|b| b.end)
    }
    /// Bursts after the first.
    pub fn retries(&self) -> usize {
        self.bursts.len().saturating_sub(1)
    }
    /// Out, as far as driver and camera say. A driver that did not answer is believed to have done it if the screw is gone; one that
    /// slipped is not, since a worn recess may only have become hard to see. A bit that meets nothing where a screw was reported out
    /// has found its hole.
    pub fn removed(&self) -> bool {
        match self.end() {
            Some(DriveEnd::Removed) => self.still_there != Some(true),
            Some(DriveEnd::TimeOut) => self.still_there == Some(false),
            Some(DriveEnd::MissedHead) => self.claimed(),
            _ => false,
        }
    }
    /// True if the driver has said that it is out, whatever a picture says.
    pub fn claimed(&self) -> bool {
        self.bursts.iter().any(|b| b.end == Some(DriveEnd::Removed))
    }
    /// True if a second picture showed no screw where the bit had met nothing: there was none.
    pub fn absent(&self) -> bool {
        self.end() == Some(DriveEnd::MissedHead) && self.still_there == Some(false) && !self.removed()
    }
    /// True if the bit has met a recess: there is a screw, whatever the picture says.
    pub fn met(&self) -> bool {
        self.bursts
            .iter()
            .any(|b| b.end.is_some_and(|end| end != DriveEnd::MissedHead))
    }
    /// True if every place on a ring around it was tried too.
    pub fn searched(&self) -> bool {
        self.bursts.iter().any(|b| b.places_left == Some(0))
    }
    /// True if its head was milled.
    pub fn milled(&self) -> bool {
        let mill = |b: &Burst| b.program.is_some_and(|p| p.bit == Bit::Mill) && b.end == Some(DriveEnd::Removed);
        self.bursts.iter().any(mill)
    }
    /// Time spent on it, s.
    pub fn time_s(&self) -> f64 {
        self.bursts.iter().map(|b| b.time_s).sum()
    }
}

/// Why a face was looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// Before anything on the unit was touched.
    Survey,
    /// To take its screws out.
    Work,
    /// To find what was missed, after a cover did not come off.
    Missed,
    /// To take out what a person has clicked on.
    Clicked,
    /// To try what is left, however unlikely, before a cover that still does not come off is given up.
    LastTry,
    /// To search around what was not met, when nothing else is left.
    Search,
}

/// One look at a face and what followed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FaceRecord {
    /// Number of the step in the program.
    pub step: usize,
    /// Name of the step.
    pub step_name: String,
    /// The face.
    pub face: FaceId,
    /// Why it was looked at.
    pub purpose: Purpose,
    /// When the picture was taken, cell clock, s.
    pub t_s: f64,
    /// The picture, if pictures are kept.
    pub picture: Option<PictureId>,
    /// First column of the camera's whole picture that was read out, px.
    #[serde(default)]
    pub left_px: u32,
    /// First row of it, px.
    #[serde(default)]
    pub top_px: u32,
    /// Width of what was read out, px.
    pub width_px: u32,
    /// Height of what was read out, px.
    pub height_px: u32,
    /// Plane of the face, if it could be measured.
    pub plane: Option<FacePlane>,
    /// Every candidate, in the detector's order.
    pub found: Vec<Found>,
    /// What was done, in the order in which it was done.
    pub attempts: Vec<ScrewAttempt>,
}

impl Found {
    /// True if both finds are of one head, in pictures of one face.
    pub fn is_of(&self, other: &Self) -> bool {
        let off_px = (self.u_px - other.u_px).hypot(self.v_px - other.v_px);
        off_px < look::SAME_HEAD * self.diameter_px
    }
}

impl FaceRecord {
    /// Screws of this look that are out.
    pub fn removed(&self) -> usize {
        self.attempts.iter().filter(|a| a.removed()).count()
    }

    /// Finds of this look that the bit never met, with what was tried at them.
    pub fn not_met(&self) -> impl Iterator<Item = (&Found, &ScrewAttempt)> {
        let not_met = self.attempts.iter().filter(|a| !a.met() && !a.bursts.is_empty());
        not_met.filter_map(|a| Some((self.found.get(a.found)?, a)))
    }
}

/// How a pull ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PullEnd {
    /// The cover came off.
    Off,
    /// It stayed where it was.
    Stuck,
}

/// One pull at a cover.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CoverRecord {
    /// Number of the step in the program.
    pub step: usize,
    /// The cover.
    pub cover: String,
    /// How it ended.
    pub end: PullEnd,
    /// How that is known.
    pub seen_by: SeenBy,
    /// Covers that came off with it.
    pub takes_along: Vec<String>,
    /// Time it took, s.
    pub time_s: f64,
}

/// What told how an action ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SeenBy {
    /// The device itself, or an input of the cell.
    Signal,
    /// A picture, because no signal could be trusted (after a crash or a time-out).
    Picture,
}

/// Why a unit was not finished though it was begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NgReason {
    /// A cover did not come off, and no screw that holds it was seen.
    CoverStuck,
    /// A screw did not turn.
    ScrewSeized,
    /// The bit kept slipping out.
    ScrewCamOut,
    /// The bit did not find the recess.
    ScrewMissed,
    /// A screw stands where no arm may go.
    ScrewOutOfReach,
    /// A device failed or did not answer.
    DeviceFault,
    /// It was taken off the table while the program was down.
    TakenAway,
}

/// Why a unit was not begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExclusionReason {
    /// A head whose recess cannot be judged: mud, web, paint.
    SlotNotWorkable,
    /// The face or the sheet around a screw leans beyond the range.
    CoverBent,
    /// Fewer screws than the product has.
    ScrewsNotFound,
}

/// What became of a unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum Outcome {
    /// Every cover is off.
    Ok,
    /// Discharged unfinished.
    Ng {
        /// Why, for counting.
        reason: NgReason,
        /// In words.
        detail: String,
    },
    /// Out of scope, decided before acting.
    Excluded {
        /// Why, for counting.
        reason: ExclusionReason,
        /// In words, with the face.
        detail: String,
        /// Screws that had been taken out of *other* faces before this face was looked at (0 with a survey).
        screws_out_before: usize,
    },
}

impl Outcome {
    /// `ok`, `ng` or `excluded`.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Ng { .. } => "ng",
            Self::Excluded { .. } => "excluded",
        }
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ok => f.write_str("OK"),
            Self::Ng { detail, .. } => write!(f, "NG: {detail}"),
            Self::Excluded { detail, .. } => write!(f, "excluded: {detail}"),
        }
    }
}

/// What a person did for a unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Assist {
    /// Nothing.
    #[default]
    None,
    /// Clicked in a picture.
    Remote,
    /// Took it off the table or laid hands on it.
    Hand,
}

/// What a unit's outcome has cost it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Only screws are gone.
    #[default]
    NonDestructive,
    /// A head was milled off.
    Destructive,
}

/// What the time of a unit is spent on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Resource {
    /// Table: loading, turning, discharging.
    Handling,
    /// Taking screws out.
    Screws,
    /// Pulling covers and laying them aside.
    Covers,
    /// Camera and vision.
    Inspection,
    /// Nothing to do: no unit, or a person.
    Waiting,
    /// Second attempts of any kind.
    Recovery,
}

/// Seconds by resource, cell clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Times {
    /// Table: loading, turning, discharging, s.
    pub handling_s: f64,
    /// Taking screws out, s.
    pub screws_s: f64,
    /// Pulling covers, s.
    pub covers_s: f64,
    /// Camera and vision, s.
    pub inspection_s: f64,
    /// No unit, or a person, s.
    pub waiting_s: f64,
    /// Second attempts of any kind, s.
    pub recovery_s: f64,
}

impl Times {
    /// Adds a time to a resource.
    pub fn add(&mut self, resource: Resource, time_s: f64) {
        *match resource {
            Resource::Handling => &mut self.handling_s,
            Resource::Screws => &mut self.screws_s,
            Resource::Covers => &mut self.covers_s,
            Resource::Inspection => &mut self.inspection_s,
            Resource::Waiting => &mut self.waiting_s,
            Resource::Recovery => &mut self.recovery_s,
        } += time_s;
    }

    /// From the loading switch to the end of the discharge, as the paper counts it: all but waiting, s.
    pub fn cycle_s(&self) -> f64 {
        self.handling_s + self.screws_s + self.covers_s + self.inspection_s + self.recovery_s
    }
}

/// Something that changes the world and is written down before it is begun.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "act", rename_all = "snake_case")]
pub enum Act {
    /// Turn a face to the camera.
    Present {
        /// The face.
        face: FaceId,
    },
    /// Drive one burst at a screw of the face that was looked at last.
    Drive {
        /// Number in [`FaceRecord::found`].
        found: usize,
        /// Arm.
        arm: String,
        /// Where the bit is sent.
        aim: Point<Base>,
        /// 0 for the first burst.
        burst: usize,
    },
    /// Pull a cover.
    Pull {
        /// The cover.
        cover: String,
    },
    /// Hand the unit out.
    Discharge,
}

/// An event of a unit's way. The journal holds them in order; [`UnitRecord::apply`] is all that is ever made of them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The unit stands on the table.
    Arrived,
    /// Its plate was read.
    Identified {
        /// Its model number, if it could be read.
        model: Option<String>,
    },
    /// The program was started again in the middle of the unit.
    Resumed,
    /// About to act.
    Intent {
        /// What.
        act: Act,
    },
    /// A face stands before the camera.
    Presented {
        /// The face.
        face: FaceId,
    },
    /// A face was looked at.
    Seen {
        /// What was found.
        face: Box<FaceRecord>,
        /// What followed from it.
        #[serde(default)]
        decision: Option<Box<Decision>>,
        /// What was decided on, if frames are kept.
        #[serde(default)]
        frame: Option<Box<KeptFrame>>,
    },
    /// A burst ended.
    Driven {
        /// Number in [`FaceRecord::found`].
        found: usize,
        /// Arm.
        arm: String,
        /// How.
        burst: Burst,
    },
    /// The screws that were attempted have been looked at again.
    Verified {
        /// Numbers in [`FaceRecord::found`] with what the picture said: true if a screw still stands there.
        screws: Vec<(usize, bool)>,
        /// The pictures.
        pictures: Vec<PictureId>,
        /// What was decided on, if frames are kept.
        #[serde(default)]
        frames: Vec<KeptFrame>,
        /// What followed, where this was a second look before another burst.
        #[serde(default)]
        second_look: Option<Box<SecondLook>>,
    },
    /// A person was asked to click on screws in a picture.
    Asked {
        /// What.
        question: String,
        /// The picture.
        picture: PictureId,
        /// The clicks, px of the whole picture; `None` if nobody answered.
        clicks: Option<Vec<[f64; 2]>>,
    },
    /// Nothing harmless was left for a screw: what was chosen.
    Chosen {
        /// Number in [`FaceRecord::found`].
        found: usize,
        /// What, why, and where a cutter would go.
        decision: Ruling,
    },
    /// A pull ended.
    Pulled {
        /// How.
        cover: CoverRecord,
        /// What was decided on, where a picture had to tell and frames are kept.
        #[serde(default)]
        frame: Option<Box<KeptFrame>>,
    },
    /// The gripper has laid its cover aside.
    LaidAside,
    /// From here on (or no longer) time is spent on making something good.
    Recovery {
        /// Beginning or end.
        on: bool,
    },
    /// A step is finished.
    StepDone {
        /// Its number.
        step: usize,
    },
    /// The outcome is known.
    Decided {
        /// It.
        outcome: Outcome,
    },
    /// The cell's state has changed in the middle of the unit.
    State {
        /// To this.
        state: crate::packml::State,
    },
    /// The unit has left the table.
    Discharged,
}

impl Event {
    /// Its name in the journal's `kind` column.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Arrived => "arrived",
            Self::Identified { .. } => "identified",
            Self::Resumed => "resumed",
            Self::Intent { .. } => "intent",
            Self::Presented { .. } => "presented",
            Self::Seen { .. } => "seen",
            Self::Driven { .. } => "driven",
            Self::Verified { .. } => "verified",
            Self::Asked { .. } => "asked",
            Self::Chosen { .. } => "chosen",
            Self::Pulled { .. } => "pulled",
            Self::LaidAside => "laid_aside",
            Self::Recovery { .. } => "recovery",
            Self::StepDone { .. } => "step_done",
            Self::Decided { .. } => "decided",
            Self::State { .. } => "state",
            Self::Discharged => "discharged",
        }
    }

    /// What the time since the event before was spent on.
    fn resource(&self) -> Resource {
        match self {
            Self::Arrived | Self::Resumed | Self::Asked { .. } | Self::State { .. } => Resource::Waiting,
            Self::Identified { .. } | Self::Presented { .. } | Self::Discharged => Resource::Handling,
            Self::Driven { .. } | Self::Chosen { .. } => Resource::Screws,
            Self::Pulled { .. } | Self::LaidAside => Resource::Covers,
            Self::Intent {
                act: Act::Present { .. } | Act::Discharge,
            } => Resource::Handling,
            Self::Intent { act: Act::Drive { .. } } => Resource::Screws,
            Self::Intent { act: Act::Pull { .. } } => Resource::Covers,
            Self::Seen { .. } | Self::Verified { .. } => Resource::Inspection,
            Self::Recovery { .. } | Self::StepDone { .. } | Self::Decided { .. } => Resource::Inspection,
        }
    }
}

/// Everything about one unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UnitRecord {
    /// Number of the unit in this run, from 1.
    pub unit: u64,
    /// Model number, if it could be read.
    pub model: Option<String>,
    /// When it was begun, cell clock, s.
    pub started_s: f64,
    /// Time of the last event, cell clock, s.
    pub last_s: f64,
    /// What became of it; `None` while it is under way.
    #[serde(flatten)]
    pub outcome: Option<Outcome>,
    /// What a person did for it.
    #[serde(default)]
    pub assist: Assist,
    /// What it cost.
    #[serde(default)]
    pub method: Method,
    /// Steps that are finished.
    pub steps_done: usize,
    /// Every look at a face, in order.
    pub faces: Vec<FaceRecord>,
    /// Every pull, in order.
    pub covers: Vec<CoverRecord>,
    /// Seconds by resource.
    pub times: Times,
    /// How often the program was started again in the middle of it.
    pub resumed: u32,
    /// The act that was begun and whose end is not known: look before anything else.
    pub open: Option<Act>,
    /// Acts of other arms that were begun besides.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub also_open: Vec<Act>,
    /// True once it has left the table.
    pub discharged: bool,
    /// True while time counts as recovery.
    #[serde(default)]
    pub recovering: bool,
    /// Pictures taken to verify, in order.
    #[serde(default)]
    pub looks: Vec<PictureId>,
}

impl UnitRecord {
    /// A unit of which nothing is known yet; its time starts at `t_s`.
    pub fn new(unit: u64, t_s: f64) -> Self {
        Self {
            unit,
            model: None,
            started_s: t_s,
            last_s: t_s,
            outcome: None,
            assist: Assist::None,
            method: Method::NonDestructive,
            steps_done: 0,
            faces: Vec::new(),
            covers: Vec::new(),
            times: Times::default(),
            resumed: 0,
            open: None,
            also_open: Vec::new(),
            discharged: false,
            recovering: false,
            looks: Vec::new(),
        }
    }

    /// The record that events add up to; `started_s` is when the unit was asked for.
    pub fn from_events<'a>(unit: u64, started_s: f64, events: impl IntoIterator<Item = &'a (f64, Event)>) -> Self {
        let mut record = Self::new(unit, started_s);
        for (t_s, event) in events {
            record.apply(*t_s, event);
        }
        record
    }

    /// Takes one event in: pure bookkeeping, no device is asked.
    pub fn apply(&mut self, t_s: f64, event: &Event) {
        // A clock that started again with the machine must not give negative times.
        let spent_s = (t_s - self.last_s).max(0.0);
        let resource = match event.resource() {
            Resource::Waiting => Resource::Waiting,
            _ if self.recovering || self.is_again(event) => Resource::Recovery,
            resource => resource,
        };
        self.times.add(resource, spent_s);
        self.last_s = t_s;
        match event {
            Event::Arrived | Event::LaidAside | Event::State { .. } => {}
            Event::Identified { model } => self.model.clone_from(model),
            Event::Resumed => {
                self.resumed += 1;
                self.recovering = false;
            }
            Event::Intent { act } => self.begun(act),
            Event::Presented { .. } => self.nothing_open(),
            // A look at the world answers whatever was in doubt about it; what it showed is in the record that comes with it.
            Event::Seen { face, .. } => {
                self.faces.push((**face).clone());
                self.nothing_open();
            }
            Event::Asked { clicks, picture, .. } => {
                self.looks.push(picture.clone());
                if clicks.as_ref().is_some_and(|c| !c.is_empty()) {
                    self.assist = self.assist.max(Assist::Remote);
                }
            }
            Event::Chosen { found, decision } => {
                let attempts = self.faces.last_mut().map(|f| &mut f.attempts);
                for attempt in attempts.into_iter().flatten().filter(|a| a.found == *found) {
                    attempt.decision = Some(decision.clone());
                }
            }
            Event::Driven { found, arm, burst } => {
                self.ended(*found, arm);
                // a cut that was begun has left its mark, whatever came of it
                if burst.program.is_some_and(|p| p.bit == Bit::Mill) {
                    self.method = Method::Destructive;
                }
                if let Some(face) = self.faces.last_mut() {
                    match face.attempts.iter_mut().find(|a| a.found == *found) {
                        Some(attempt) => {
                            attempt.bursts.push(burst.clone());
                            attempt.still_there = None;
                        }
                        None => face.attempts.push(ScrewAttempt {
                            found: *found,
                            arm: arm.clone(),
                            bursts: vec![burst.clone()],
                            still_there: None,
                            decision: None,
                        }),
                    }
                }
            }
            Event::Verified { screws, pictures, .. } => {
                self.looks.extend(pictures.iter().cloned());
                if let Some(face) = self.faces.last_mut() {
                    for (found, stands) in screws {
                        for attempt in face.attempts.iter_mut().filter(|a| a.found == *found) {
                            attempt.still_there = Some(*stands);
                        }
                    }
                }
            }
            Event::Pulled { cover, .. } => {
                self.nothing_open();
                self.covers.push(cover.clone());
            }
            Event::Recovery { on } => self.recovering = *on,
            Event::StepDone { step } => self.steps_done = step + 1,
            Event::Decided { outcome } => {
                if matches!(
                    outcome,
                    Outcome::Ng {
                        reason: NgReason::TakenAway,
                        ..
                    }
                ) {
                    self.assist = Assist::Hand;
                }
                self.outcome = Some(outcome.clone());
            }
            Event::Discharged => {
                self.nothing_open();
                self.discharged = true;
            }
        }
    }

    /// Two arms may drive at the same time; nothing else is begun beside anything.
    fn begun(&mut self, act: &Act) {
        match (act, self.open.take()) {
            (Act::Drive { .. }, Some(other @ Act::Drive { .. })) => self.also_open.push(other),
            _ => self.also_open.clear(),
        }
        self.open = Some(act.clone());
    }

    fn ended(&mut self, found: usize, arm: &str) {
        let is_it = |act: &Act| matches!(act, Act::Drive { found: f, arm: a, .. } if *f == found && a == arm);
        self.also_open.retain(|act| !is_it(act));
        if self.open.as_ref().is_none_or(is_it) {
            self.open = self.also_open.pop();
        }
    }

    fn nothing_open(&mut self) {
        self.open = None;
        self.also_open.clear();
    }

    /// True for another burst at a screw that the first one did not take out.
    fn is_again(&self, event: &Event) -> bool {
        let tried = |found: usize| {
            let attempts = self.faces.last().into_iter().flat_map(|f| &f.attempts);
            attempts.filter(|a| a.found == found).count() > 0
        };
        match event {
            Event::Intent {
                act: Act::Drive { burst, .. },
            } => *burst > 0,
            Event::Driven { found, .. } => tried(*found),
            _ => false,
        }
    }

    /// Screws taken out so far, as far as driver and camera say.
    pub fn screws_out(&self) -> usize {
        self.faces.iter().map(FaceRecord::removed).sum()
    }

    /// Screws that only came to light when their face was looked at again because a cover stayed: they are out, and nothing was tried at them before.
    pub fn found_later(&self) -> usize {
        let tried_before = |number: usize, face: &FaceRecord, found: &Found| {
            let earlier = self.faces[..number].iter().filter(|f| f.face == face.face);
            earlier
                .flat_map(FaceRecord::not_met)
                .any(|(unmet, _)| unmet.is_of(found))
        };
        let again = [Purpose::Missed, Purpose::LastTry, Purpose::Search];
        let looks = self
            .faces
            .iter()
            .enumerate()
            .filter(|(_, f)| again.contains(&f.purpose));
        let of_look = |(number, face): (usize, &FaceRecord)| {
            let out = face.attempts.iter().filter(|a| a.removed());
            out.filter(|a| {
                face.found
                    .get(a.found)
                    .is_none_or(|found| !tried_before(number, face, found))
            })
            .count()
        };
        looks.map(of_look).sum()
    }

    /// Attempts of the whole unit.
    pub fn attempts(&self) -> impl Iterator<Item = &ScrewAttempt> {
        self.faces.iter().flat_map(|f| &f.attempts)
    }

    /// Covers that are off, with those that they took along.
    pub fn covers_off(&self) -> Vec<&str> {
        let off = self.covers.iter().filter(|c| c.end == PullEnd::Off);
        off.flat_map(|c| std::iter::once(c.cover.as_str()).chain(c.takes_along.iter().map(String::as_str)))
            .collect()
    }
}

#[cfg(test)]
impl Found {
    /// A screw that was seen well, of which nothing is known but its pixel.
    pub(crate) fn screw_at(u_px: f64, v_px: f64) -> Self {
        Self {
            u_px,
            v_px,
            sigma_px: 0.2,
            diameter_px: 20.0,
            score: 0.99,
            drive: "cross".into(),
            verdict: Verdict::Screw,
            camera_mm: None,
            base_mm: None,
            sigma_lateral_mm: None,
            sigma_depth_mm: None,
            hull: None,
            tilt_rad: None,
            left_alone: None,
            refusal: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn burst(end: DriveEnd) -> Burst {
        Burst {
            program: None,
            end: Some(end),
            error: None,
            aim: Point::new(1.0, 2.0, 3.0),
            second_look: None,
            places_left: None,
            time_s: 3.0,
        }
    }

    fn face() -> Box<FaceRecord> {
        Box::new(FaceRecord {
            step: 0,
            step_name: "front screws".into(),
            face: "front".into(),
            purpose: Purpose::Work,
            t_s: 12.0,
            picture: None,
            left_px: 0,
            top_px: 0,
            width_px: 40,
            height_px: 30,
            plane: None,
            found: Vec::new(),
            attempts: Vec::new(),
        })
    }

    #[test]
    fn what_was_tried_before_was_not_found_later() {
        let found = |u_px: f64| Found::screw_at(u_px, 10.0);
        let attempt = |found: usize, end: DriveEnd| ScrewAttempt {
            found,
            arm: "arm_a".into(),
            bursts: vec![burst(end)],
            still_there: None,
            decision: None,
        };
        let mut record = UnitRecord::new(1, 0.0);
        record.faces.push(FaceRecord {
            found: vec![found(100.0)],
            attempts: vec![attempt(0, DriveEnd::MissedHead)],
            ..*face()
        });
        record.faces.push(FaceRecord {
            purpose: Purpose::Missed,
            found: vec![found(103.0), found(300.0)],
            attempts: vec![attempt(0, DriveEnd::Removed), attempt(1, DriveEnd::Removed)],
            ..*face()
        });
        assert_eq!((record.screws_out(), record.found_later()), (2, 1));
    }

    fn seen() -> Event {
        Event::Seen {
            face: face(),
            decision: None,
            frame: None,
        }
    }

    fn verified(stands: bool) -> Event {
        Event::Verified {
            screws: vec![(0, stands)],
            pictures: vec![],
            frames: vec![],
            second_look: None,
        }
    }

    #[test]
    fn times_add_up_to_the_clock_and_go_where_they_belong() {
        let events = [
            (10.0, Event::Arrived),
            (
                10.0,
                Event::Intent {
                    act: Act::Present { face: "front".into() },
                },
            ),
            (15.0, Event::Presented { face: "front".into() }),
            (17.0, seen()),
            (
                21.0,
                Event::Driven {
                    found: 0,
                    arm: "arm_a".into(),
                    burst: burst(DriveEnd::CamOut),
                },
            ),
            (21.0, Event::Recovery { on: true }),
            (
                24.0,
                Event::Driven {
                    found: 0,
                    arm: "arm_a".into(),
                    burst: burst(DriveEnd::Removed),
                },
            ),
            (24.0, Event::Recovery { on: false }),
            (25.0, verified(false)),
            (28.0, Event::Discharged),
        ];
        let record = UnitRecord::from_events(1, 4.0, &events);
        let t = record.times;
        assert_eq!(
            [
                t.waiting_s,
                t.handling_s,
                t.inspection_s,
                t.screws_s,
                t.recovery_s,
                t.covers_s
            ],
            [6.0, 8.0, 3.0, 4.0, 3.0, 0.0]
        );
        assert!((t.cycle_s() + t.waiting_s - 24.0).abs() < 1e-12);
        assert_eq!(record.screws_out(), 1);
        assert_eq!(record.faces[0].attempts[0].retries(), 1);
        let text = serde_json::to_string(&record).expect("as JSON");
        assert_eq!(serde_json::from_str::<UnitRecord>(&text).expect("back"), record);
    }

    #[test]
    fn a_picture_outweighs_the_driver() {
        let mut record = UnitRecord::new(1, 0.0);
        record.apply(0.0, &seen());
        record.apply(
            1.0,
            &Event::Driven {
                found: 0,
                arm: "a".into(),
                burst: burst(DriveEnd::Removed),
            },
        );
        assert_eq!(record.screws_out(), 1);
        record.apply(2.0, &verified(true));
        assert_eq!(record.screws_out(), 0);
        // the bit finds nothing there: what the picture took for a screw was its hole
        record.apply(
            3.0,
            &Event::Driven {
                found: 0,
                arm: "a".into(),
                burst: burst(DriveEnd::MissedHead),
            },
        );
        assert_eq!(record.screws_out(), 1);
    }

    #[test]
    fn two_arms_have_an_act_open_each_and_another_burst_is_recovery() {
        let drive = |found: usize, arm: &str, burst: usize| Act::Drive {
            found,
            arm: arm.into(),
            aim: Point::new(1.0, 2.0, 3.0),
            burst,
        };
        let intent = |act: Act| Event::Intent { act };
        let driven = |found: usize, arm: &str, end: DriveEnd| Event::Driven {
            found,
            arm: arm.into(),
            burst: burst(end),
        };
        let (a, b) = (drive(0, "a", 0), drive(1, "b", 0));
        let mut record = UnitRecord::new(1, 0.0);
        record.apply(0.0, &seen());
        record.apply(0.0, &intent(a.clone()));
        record.apply(1.0, &intent(b.clone()));
        assert_eq!((&record.open, &record.also_open), (&Some(b.clone()), &vec![a]));
        record.apply(3.0, &driven(0, "a", DriveEnd::CamOut));
        assert_eq!((&record.open, record.also_open.len()), (&Some(b), 0));
        record.apply(3.0, &intent(drive(0, "a", 1)));
        record.apply(4.0, &driven(1, "b", DriveEnd::Removed));
        assert_eq!(record.open, Some(drive(0, "a", 1)));
        record.apply(6.0, &driven(0, "a", DriveEnd::Removed));
        assert_eq!((&record.open, record.also_open.len()), (&None, 0));
        // what is spent on the second burst of a screw is recovery
        assert_eq!((record.times.screws_s, record.times.recovery_s), (4.0, 2.0));
        assert_eq!(record.screws_out(), 2);
    }

    #[test]
    fn an_act_stays_open_until_it_is_answered() {
        let mut record = UnitRecord::new(1, 0.0);
        let act = Act::Pull { cover: "top".into() };
        record.apply(0.0, &Event::Intent { act: act.clone() });
        record.apply(5.0, &Event::Resumed);
        assert_eq!(record.open, Some(act));
        let cover = CoverRecord {
            step: 3,
            cover: "front".into(),
            end: PullEnd::Off,
            seen_by: SeenBy::Picture,
            takes_along: vec!["left".into()],
            time_s: 0.0,
        };
        record.apply(6.0, &Event::Pulled { cover, frame: None });
        assert_eq!(record.open, None);
        assert_eq!(record.covers_off(), ["front", "left"]);
    }
}
