//! The way of one unit: load, read, then every step of the program: present, look, decide, act, look again; discharge.
//!
//! Every act is in the journal before it is begun, every answer before the next act. The state of a unit is the fold of its events
//! ([`UnitRecord`]), so that going on after a crash and going on after a step are the same thing.

mod climb;
mod cover;
mod face;

use crate::capture::{Shot, present, region_around, regions_around, shoot};
use crate::config::CellConfig;
use crate::device::{DeviceError, Devices, DriveEnd, DriveProgram, TagValue, Ticket, tags};
use crate::frames::KeptFrame;
use crate::journal::{Journal, JournalError};
use crate::ladder::{Cause, Climb};
use crate::look::{self, Judge, Question};
use crate::motion::{ArmMotion, Trajectory};
use crate::packml::{Command, Illegal, Machine, State};
use crate::plan::{self, Reach, SafeTarget, Target};
use crate::program::{FaceId, Program, Step, Work};
use crate::record::{
    Act, CoverRecord, Event, ExclusionReason, FaceRecord, NgReason, Outcome, PictureId, PullEnd, Purpose, ScrewAttempt,
    SeenBy, UnitRecord,
};
use crate::removal::Mover;
use calibration::Map;
use geometry::{Pixel, RgbdFrame};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// How often a held cell looks whether it may go on, s.
const HELD_POLL_S: f64 = 0.1;

/// Finds screws in a shot. [`vision::Detector`] does; tests have their own.
pub trait Finder: Send + Sync {
    /// Every candidate, in pixels of the shot, and in the camera's frame where it has depth.
    ///
    /// # Arguments
    /// * `odds` – how much likelier than the picture alone says a doubtful head is a screw (1 without other evidence).
    ///
    /// # Errors
    /// [`DeviceError::Fault`] if it could not look: that nothing was found then means nothing.
    fn find(&self, frame: &RgbdFrame, odds: f64) -> Result<Vec<vision::Screw>, DeviceError>;
    /// What made it, for the record.
    fn model(&self) -> String;
}

impl Finder for vision::Detector {
    fn find(&self, frame: &RgbdFrame, odds: f64) -> Result<Vec<vision::Screw>, DeviceError> {
        let options = vision::Options {
            odds,
            ..vision::Options::default()
        };
        let found = self.detect(frame, &options);
        match found.doubts.iter().find(|d| matches!(d, vision::Doubt::NotSeen { .. })) {
            Some(doubt) => Err(DeviceError::Fault {
                device: "detector".into(),
                action: "looking for screws".into(),
                code: 0,
                text: doubt.to_string(),
            }),
            None => Ok(found.screws),
        }
    }
    fn model(&self) -> String {
        vision::Detector::model(self).id().to_owned()
    }
}

/// Is told how a unit gets on. Every method has an empty default.
pub trait Observer {
    /// A step begins: its number from 0, of how many, its name.
    fn step(&self, _unit: u64, _step: usize, _of: usize, _name: &str) {}
    /// A face was looked at; nothing on it has been touched since.
    fn seen(&self, _unit: u64, _face: &FaceRecord) {}
    /// A screw of the face is being worked on: its number from 0, of how many.
    fn screw(&self, _screw: usize, _of: usize) {}
    /// Something worth a line.
    fn note(&self, _text: &str) {}
    /// A unit has left the table.
    fn finished(&self, _record: &UnitRecord) {}
}

/// An observer that does not care.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;
impl Observer for Silent {}

/// Why the program could not go on. A unit that fails is no error: see [`Outcome`].
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Devices, maps and program do not fit together.
    #[error("the cell cannot run this program: {reason}")]
    Setup {
        /// What does not fit, and what to do.
        reason: String,
    },
    /// No unit came, or it cannot be handed out.
    #[error("{action}: {source}")]
    Handling {
        /// What was tried.
        action: &'static str,
        /// What the device said.
        source: DeviceError,
    },
    /// The cell does not execute: it was not started, or was stopped, held or aborted in the middle of a unit. The unit stays as it is.
    #[error(
        "the cell is in state {state}{why}; nothing moves until it is reset and started again (then go on with --resume)"
    )]
    NotExecuting {
        /// Its state.
        state: State,
        /// What led there, if anything did.
        why: String,
    },
    /// The journal cannot be written: nothing is done that is not written down.
    #[error(transparent)]
    Journal(#[from] JournalError),
}

/// Why work on a unit ends.
enum Stop {
    Decided(Outcome),
    Device(DeviceError),
    Journal(JournalError),
    /// The cell no longer executes: the unit stays where it is.
    Halted(String),
}
impl From<DeviceError> for Stop {
    fn from(error: DeviceError) -> Self {
        Self::Device(error)
    }
}
impl From<JournalError> for Stop {
    fn from(error: JournalError) -> Self {
        Self::Journal(error)
    }
}

/// True if a person's eyes on the picture may take away the reason.
fn is_for_eyes(reason: ExclusionReason) -> bool {
    matches!(
        reason,
        ExclusionReason::SlotNotWorkable | ExclusionReason::ScrewsNotFound
    )
}

/// Takes units apart.
pub struct Runner {
    devices: Devices,
    finder: Arc<dyn Finder>,
    maps: Vec<Map>,
    /// One per arm; `None` for an arm that is not drawn.
    motions: Vec<Option<ArmMotion>>,
    program: Program,
    config: CellConfig,
    journal: Journal,
    machine: Arc<Mutex<Machine>>,
}

impl std::fmt::Debug for Runner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Runner")
            .field("devices", &self.devices)
            .finish_non_exhaustive()
    }
}

impl Runner {
    /// A runner of a program on a cell.
    ///
    /// # Arguments
    /// * `maps` – one per arm, in the order of the arms; an arm without a map is never sent to a screw.
    ///
    /// # Errors
    /// [`RunError::Setup`] if no arm can take screws out, one that could is not in the cell's drawing, or the program names an arm
    /// that is not there.
    pub fn new(
        devices: Devices,
        finder: Arc<dyn Finder>,
        maps: Vec<Map>,
        program: Program,
        config: CellConfig,
        journal: Journal,
    ) -> Result<Self, RunError> {
        let able = devices.arms.iter().zip(&maps).any(|(arm, _)| arm.driver.is_some());
        if !able {
            return Err(RunError::Setup {
                reason: "no arm has both a driver and a map; calibrate one first".into(),
            });
        }
        let motions: Vec<Option<ArmMotion>> = devices
            .arms
            .iter()
            .map(|arm| ArmMotion::new(&config.motion, arm.robot.name()))
            .collect();
        for ((arm, _), motion) in devices.arms.iter().zip(&maps).zip(&motions) {
            if arm.driver.is_some() && motion.is_none() {
                return Err(RunError::Setup {
                    reason: format!(
                        "arm '{}' is not drawn, so that nothing says what it could run into; describe it in [[motion.arms]] of the cell file",
                        arm.robot.name()
                    ),
                });
            }
        }
        let names: Vec<&str> = devices.arms.iter().map(|arm| arm.robot.name()).collect();
        for step in &program.steps {
            if let Work::Cover { by, .. } = &step.work
                && !names.contains(&by.as_str())
            {
                return Err(RunError::Setup {
                    reason: format!(
                        "step '{}' is for arm '{by}', the cell has {}; change `by`",
                        step.name,
                        names.join(", ")
                    ),
                });
            }
        }
        Ok(Self {
            devices,
            finder,
            maps,
            motions,
            program,
            config,
            journal,
            machine: Arc::default(),
        })
    }

    /// Mode and state of the cell, for commands from elsewhere; they take effect before the next act.
    pub fn machine(&self) -> Arc<Mutex<Machine>> {
        self.machine.clone()
    }

    /// Resets and starts the cell: what a person asks for, never the program itself.
    ///
    /// # Errors
    /// [`Illegal`] from another state than stopped, completed or idle.
    pub fn start(&self) -> Result<(), Illegal> {
        let mut machine = self.machine.lock().unwrap_or_else(PoisonError::into_inner);
        if machine.state() != State::Idle {
            machine.command(Command::Reset)?;
            machine.done();
        }
        machine.command(Command::Start)?;
        machine.done();
        Ok(())
    }

    /// Asks for something that belongs to the course of work; what is not legal then (a person has stopped the cell) is not done.
    fn proceed(&self, command: Command) -> State {
        let mut machine = self.machine.lock().unwrap_or_else(PoisonError::into_inner);
        if machine.command(command).is_ok() {
            machine.done();
        }
        machine.state()
    }

    /// The units that were asked for are done.
    pub fn complete(&self) -> State {
        self.proceed(Command::Complete)
    }

    fn executing(&self) -> Result<(), RunError> {
        let state = self.machine.lock().unwrap_or_else(PoisonError::into_inner).state();
        if state == State::Execute {
            return Ok(());
        }
        let why = String::new();
        Err(RunError::NotExecuting { state, why })
    }

    /// The journal.
    pub fn journal(&self) -> &Journal {
        &self.journal
    }

    /// Waits for the next unit and takes it apart.
    ///
    /// # Errors
    /// [`RunError`]; a unit that fails is not one.
    pub async fn run_unit(&mut self, observer: &dyn Observer) -> Result<UnitRecord, RunError> {
        self.executing()?;
        let since_s = self.devices.clock.now_s();
        self.proceed(Command::Suspend); // until a unit comes
        self.load().await.map_err(|source| RunError::Handling {
            action: "waiting for a unit",
            source,
        })?;
        self.proceed(Command::Unsuspend);
        let loaded_s = self.devices.clock.now_s();
        let unit = self.journal.begin_unit(since_s)?;
        let mut way = Way {
            record: UnitRecord::new(unit, since_s),
            runner: self,
            observer,
            laying: None,
        };
        // the time of waiting ends with the loading switch, whatever reading the plate takes
        way.log_at(loaded_s, Event::Arrived)?;
        let model = match way.runner.devices.reader.read().await {
            Ok(model) => model.map(|m| m.0),
            Err(error) => {
                observer.note(&format!("the model number could not be read: {error}"));
                None
            }
        };
        way.log(Event::Identified { model })?;
        way.finish().await
    }

    /// Goes on with the unit that was under way when the program ended; `None` if there was none.
    ///
    /// An act that was begun and whose end is not known is looked at: nothing is repeated or skipped on faith.
    ///
    /// # Errors
    /// [`RunError`].
    pub async fn resume_unit(&mut self, observer: &dyn Observer) -> Result<Option<UnitRecord>, RunError> {
        self.executing()?;
        let Some(record) = self.journal.under_way()? else {
            return Ok(None);
        };
        let mut way = Way {
            record,
            runner: self,
            observer,
            laying: None,
        };
        way.log(Event::Resumed)?;
        let loaded = way.runner.devices.io.read(tags::LOADED).await;
        let loaded = loaded.map_err(|source| RunError::Handling {
            action: "looking whether a unit stands on the table",
            source,
        })?;
        if loaded != TagValue::Bool(true) {
            if way.record.outcome.is_none() {
                way.log(Event::Decided {
                    outcome: Outcome::Ng {
                        reason: NgReason::TakenAway,
                        detail: "it was no longer on the table when the program came back".into(),
                    },
                })?;
            }
            return way.close(Some(Event::Discharged)).await.map(Some);
        }
        way.finish().await.map(Some)
    }

    async fn load(&self) -> Result<(), DeviceError> {
        let io = &self.devices.io;
        let on = TagValue::Bool(true);
        if io.read(tags::LOADED).await? != on {
            match io.write(tags::FEED, on.clone()).await {
                // the infeed may have heard: the switch tells
                Ok(()) | Err(DeviceError::Timeout { .. }) => {}
                Err(error) => return Err(error),
            }
            io.wait_for(tags::LOADED, on.clone(), self.config.timeouts.load_s)
                .await?;
        }
        io.write(tags::MAGNET, on).await
    }
}

/// One unit under way.
struct Way<'a> {
    runner: &'a mut Runner,
    record: UnitRecord,
    observer: &'a dyn Observer,
    /// The arm that lays a cover aside, with the job that it was given.
    laying: Option<(usize, Option<Ticket>)>,
}

impl Way<'_> {
    fn now_s(&self) -> f64 {
        self.runner.devices.clock.now_s()
    }

    fn log(&mut self, event: Event) -> Result<(), JournalError> {
        self.log_at(self.now_s(), event)
    }

    fn log_at(&mut self, t_s: f64, event: Event) -> Result<(), JournalError> {
        self.runner.journal.append(self.record.unit, t_s, &event)?;
        self.record.apply(t_s, &event);
        Ok(())
    }

    fn mover(&self, arm: usize) -> Option<Mover<'_>> {
        let runner = &self.runner;
        Mover::of(&runner.devices, &runner.config, &runner.motions, arm, None)
    }

    /// Takes it apart, hands it out, closes its record.
    async fn finish(mut self) -> Result<UnitRecord, RunError> {
        if self.record.outcome.is_none() {
            let outcome = match self.take_apart().await {
                Ok(()) => Outcome::Ok,
                Err(Stop::Decided(outcome)) => outcome,
                Err(Stop::Device(error)) => Outcome::Ng {
                    reason: NgReason::DeviceFault,
                    detail: error.to_string(),
                },
                Err(Stop::Journal(error)) => return Err(error.into()),
                Err(Stop::Halted(why)) => return Err(self.halted(why)),
            };
            self.observer.note(&outcome.to_string());
            if self.record.recovering {
                self.log(Event::Recovery { on: false })?;
            }
            self.log(Event::Decided { outcome })?;
        }
        if !self.record.discharged {
            match self.discharge().await {
                Ok(()) => return self.close(Some(Event::Discharged)).await,
                Err(Stop::Journal(error)) => return Err(error.into()),
                Err(Stop::Halted(why)) => return Err(self.halted(why)),
                Err(Stop::Device(source)) => {
                    return Err(RunError::Handling {
                        action: "handing the unit out; clear the table by hand, then go on with --resume",
                        source,
                    });
                }
                Err(Stop::Decided(_)) => {}
            }
        }
        self.close(None).await
    }

    fn halted(&self, why: String) -> RunError {
        let state = self
            .runner
            .machine
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .state();
        RunError::NotExecuting {
            state,
            why: format!(": {why}"),
        }
    }

    /// Writes down what is about to be done, unless the cell no longer executes: the one place that every act passes.
    async fn begin(&mut self, act: Act) -> Result<(), Stop> {
        self.gate().await?;
        Ok(self.log(Event::Intent { act })?)
    }

    /// Waits out a hold; ends the work if the cell was stopped or the safety chain is open.
    async fn gate(&mut self) -> Result<(), Stop> {
        let machine = self.runner.machine.clone();
        let locked = || machine.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let closed = self.runner.devices.io.read(tags::SAFETY_OK).await? == TagValue::Bool(true);
            if !closed {
                locked().abort();
            }
            let before = locked().state();
            let state = locked().done();
            if state != before {
                self.log(Event::State { state })?;
            }
            match state {
                State::Execute => return Ok(()),
                State::Held => {
                    self.runner.devices.clock.pass(HELD_POLL_S);
                    tokio::time::sleep(Duration::from_secs_f64(HELD_POLL_S)).await;
                }
                _ if !closed => return Err(Stop::Halted("the safety chain is open".into())),
                _ => return Err(Stop::Halted("it was told to".into())),
            }
        }
    }

    /// Closes the record, with the event that ends it unless that is written already.
    async fn close(mut self, last: Option<Event>) -> Result<UnitRecord, RunError> {
        match last {
            Some(event) => {
                let t_s = self.now_s();
                self.record.apply(t_s, &event);
                self.runner.journal.close_unit(t_s, &event, &self.record)?;
            }
            None => self.runner.journal.finish_unit(&self.record)?,
        }
        // the plant's own systems may be down: the journal has everything
        if let Ok(json) = serde_json::to_string(&self.record)
            && let Err(error) = self.runner.devices.plant.report(&json).await
        {
            self.observer
                .note(&format!("the plant was not told of unit {}: {error}", self.record.unit));
        }
        self.observer.finished(&self.record);
        Ok(self.record)
    }

    async fn take_apart(&mut self) -> Result<(), Stop> {
        self.settle_open_act().await?;
        let program = self.runner.program.clone();
        if self.record.steps_done == 0 && self.record.attempts().next().is_none() {
            for face in &program.survey {
                let seen = self
                    .record
                    .faces
                    .iter()
                    .any(|f| f.face == *face && f.purpose == Purpose::Survey);
                if !seen {
                    self.look_at(0, &program.steps[0], face, Purpose::Survey).await?;
                }
            }
        }
        for (index, step) in program.steps.iter().enumerate().skip(self.record.steps_done) {
            self.observer
                .step(self.record.unit, index, program.steps.len(), &step.name);
            // after a crash the cover of this step may be off already
            let off =
                matches!(&step.work, Work::Cover { cover, .. } if self.record.covers_off().contains(&cover.as_str()));
            if !off {
                if step.has_screws() {
                    self.screws(index, step, &step.present, Purpose::Work).await?;
                }
                self.cover(index, step).await?;
            }
            self.log(Event::StepDone { step: index })?;
        }
        Ok(())
    }

    /// What was begun when the program ended, and how it ended, is found out by looking. Drives and turns are answered by the
    /// look that begins every step; a cover by the gripper or a picture.
    async fn settle_open_act(&mut self) -> Result<(), Stop> {
        if self.record.resumed == 0 {
            return Ok(());
        }
        for arm in 0..self.runner.devices.arms.len() {
            if let Some(mover) = self.mover(arm) {
                mover.recover().await?;
            }
        }
        self.home().await?;
        let Some(Act::Pull { cover }) = self.record.open.clone() else {
            self.lay_aside().await?;
            return self.laid_aside().await;
        };
        let index = self.record.steps_done;
        let program = self.runner.program.clone();
        let Some(step) = program.steps.get(index) else {
            return Ok(());
        };
        let Work::Cover { takes_along, .. } = &step.work else {
            return Ok(());
        };
        let holding = self.runner.devices.io.read(tags::GRIPPER_HOLDING).await? == TagValue::Bool(true);
        let (end, seen_by, frame) = if holding {
            (PullEnd::Off, SeenBy::Signal, None)
        } else {
            self.turn(&step.present).await?;
            let (end, frame) = self.is_cover_off(&step.present).await?;
            (end, SeenBy::Picture, frame.map(Box::new))
        };
        self.lay_aside().await?;
        self.laid_aside().await?;
        self.log(Event::Pulled {
            cover: CoverRecord {
                step: index,
                cover,
                end,
                seen_by,
                takes_along: takes_along.clone(),
                time_s: 0.0,
            },
            frame,
        })?;
        if end == PullEnd::Off {
            self.log(Event::StepDone { step: index })?;
        }
        Ok(())
    }

    /// Whether the face that stands before the camera is still there: the sheet around the places where its screws were.
    async fn is_cover_off(&mut self, face: &FaceId) -> Result<(PullEnd, Option<KeptFrame>), Stop> {
        let config = self.runner.config.inspection;
        let shot = shoot(&self.runner.devices, None, config.depth_frames.max(1)).await?;
        let before = self.record.faces.iter().rev().find(|f| f.face == *face);
        Ok((look::cover_off(&shot.frame, before), self.keep(&shot)?))
    }

    /// Sends the arms out of the way of table and camera, one after the other. Where several are away from their rests, as after a stop in the
    /// middle of their ways, one goes first whose way home is clear of where the others stand; if there is none, a person has to move one.
    async fn home(&mut self) -> Result<(), Stop> {
        self.gate().await?;
        let laying = self.laying.map(|(arm, _)| arm);
        let mut away: Vec<(usize, [f64; 6])> = Vec::new();
        for arm in (0..self.runner.devices.arms.len()).filter(|arm| laying != Some(*arm)) {
            let state = self.runner.devices.arms[arm].robot.state().await?;
            let motion = self.runner.motions.get(arm).and_then(Option::as_ref);
            if state.running || motion.is_none_or(|motion| !motion.is_home(state.joints_rad)) {
                away.push((arm, state.joints_rad));
            }
        }
        while !away.is_empty() {
            let Some(next) = (0..away.len()).find(|k| self.may_go_home(*k, &away)) else {
                return Err(Stop::Device(DeviceError::NotReady {
                    device: self.runner.devices.arms[away[0].0].robot.name().to_owned(),
                    state:
                        "away from its rest, and so is another arm that is in its way home; move one of them by hand"
                            .into(),
                }));
            };
            let (arm, _) = away.remove(next);
            if let Some(mover) = self.mover(arm) {
                mover.home().await?;
            }
        }
        Ok(())
    }

    /// True if an arm's way home keeps the margin from where the others stand that are away from their rests.
    fn may_go_home(&self, number: usize, away: &[(usize, [f64; 6])]) -> bool {
        let motion = |arm: usize| self.runner.motions.get(arm).and_then(Option::as_ref);
        let (arm, joints_rad) = away[number];
        let others = away.iter().filter(|(other, _)| *other != arm);
        // of one that is not drawn nothing is known; it carries no driver
        let Some(own) = motion(arm) else { return true };
        let way = own.swept(&own.way_home(joints_rad));
        let margin_mm = self.runner.config.motion.margin_mm;
        let stands = |at: &[f64; 6]| Trajectory::joint(*at, *at);
        others
            .map(|(other, at)| motion(*other).map(|other| other.swept([&stands(at)])))
            .all(|there| there.is_none_or(|there| way.is_clear_of(&there, margin_mm)))
    }

    async fn turn(&mut self, face: &FaceId) -> Result<(), Stop> {
        self.begin(Act::Present { face: face.clone() }).await?;
        present(&self.runner.devices, face, self.runner.config.timeouts.present_s).await?;
        Ok(self.log(Event::Presented { face: face.clone() })?)
    }

    /// Presents a face, looks at it, and excludes the unit if the picture says so.
    async fn look_at(
        &mut self,
        index: usize,
        step: &Step,
        face: &FaceId,
        purpose: Purpose,
    ) -> Result<(Shot, Vec<Target>), Stop> {
        self.home().await?;
        self.turn(face).await?;
        self.laid_aside().await?;
        let config = self.runner.config.clone();
        let devices = &self.runner.devices;
        let maps = self.reaches().into_iter().map(|reach| reach.map);
        let region = match purpose {
            // a screw beyond what an arm can reach is no target, but the reason why a cover stays
            Purpose::LastTry => None,
            _ => plan::region_in_reach(&devices.color.intrinsics(), maps, config.inspection.head_mm[1]),
        };
        let shot = shoot(devices, region, config.inspection.depth_frames).await?;
        let clicks = if purpose == Purpose::Clicked {
            let text = format!("Which heads on the {face} are cross screws that still stand?");
            self.ask(&shot, &text).await?
        } else {
            None
        };
        let question = Question {
            index,
            step,
            face,
            purpose,
            so_far: &self.record,
            clicks: clicks.as_deref(),
        };
        let judged = self.judge().face(&shot, &question)?;
        self.budget(&shot);
        let decision = Some(Box::new(judged.decision()));
        let look::Judged {
            face: mut seen,
            targets,
            excluded,
        } = judged;
        seen.picture = Some(
            self.runner
                .journal
                .store_picture(&shot.frame.color, config.journal.jpeg_quality)?,
        );
        let frame = self.keep(&shot)?.map(Box::new);
        self.observer.seen(self.record.unit, &seen);
        self.log(Event::Seen {
            face: Box::new(seen),
            decision,
            frame,
        })?;
        match excluded {
            Some((reason, detail)) => Err(self.exclude(reason, detail)),
            None => Ok((shot, targets)),
        }
    }

    fn exclude(&self, reason: ExclusionReason, detail: String) -> Stop {
        Stop::Decided(Outcome::Excluded {
            reason,
            detail,
            screws_out_before: self.record.screws_out(),
        })
    }

    /// The arms that can take screws out, from their rest: there they stand whenever a picture is taken.
    fn reaches(&self) -> Vec<Reach<'_>> {
        let runner = &self.runner;
        let arms = runner.devices.arms.iter().zip(&runner.maps).zip(&runner.motions);
        arms.enumerate()
            .filter(|(_, ((device, _), _))| device.driver.is_some())
            .filter_map(|(arm, ((_, map), motion))| Some(Reach::from_rest(arm, map, motion.as_ref()?)))
            .collect()
    }

    /// What decides on the pictures of this cell.
    fn judge(&self) -> Judge<'_> {
        Judge {
            finder: self.runner.finder.as_ref(),
            reaches: self.reaches(),
            config: &self.runner.config,
        }
    }

    /// Keeps what was decided on, if frames are kept.
    fn keep(&self, shot: &Shot) -> Result<Option<KeptFrame>, JournalError> {
        let keeps = self.runner.config.journal.keep_frames;
        keeps.then(|| self.runner.journal.keep_frame(shot)).transpose()
    }

    /// How much likelier than pictures say a doubtful head on the face that is being worked on is a screw.
    fn face_odds(&self) -> f64 {
        let purpose = self.record.faces.last().map(|f| f.purpose);
        purpose.map_or(1.0, |purpose| look::odds_again(&self.runner.config, purpose))
    }

    /// True if a bit has met a find of the face that is being worked on.
    fn is_met(&self, found: usize) -> bool {
        let mut attempts = self.record.faces.last().into_iter().flat_map(|f| &f.attempts);
        attempts.any(|a| a.found == found && a.met())
    }

    /// True if a find of the face that is being worked on is a target only because its cover did not come off, and no bit has met it yet.
    fn is_doubtful(&self, found: usize) -> bool {
        if self.is_met(found) {
            return false;
        }
        // a person's click leaves no doubt
        let face = self.record.faces.last().filter(|f| f.purpose != Purpose::Clicked);
        face.and_then(|f| Some((f.found.get(found)?, look::odds(&self.runner.config, f.purpose))))
            .is_some_and(|(find, odds)| plan::is_doubtful(find.score, odds))
    }

    /// Lets the time pass that computing on a picture is budgeted with.
    fn budget(&self, shot: &Shot) {
        let per_mpx = self.runner.config.inspection.vision_s_per_mpx;
        self.runner.devices.clock.pass(per_mpx * shot.megapixels());
    }

    /// Takes the screws of a face out; returns how many came out.
    async fn screws(&mut self, index: usize, step: &Step, face: &FaceId, purpose: Purpose) -> Result<usize, Stop> {
        let (shot, targets) = match self.look_at(index, step, face, purpose).await {
            Err(Stop::Decided(Outcome::Excluded { reason, .. })) if self.may_ask() && is_for_eyes(reason) => {
                self.look_at(index, step, face, Purpose::Clicked).await?
            }
            other => other?,
        };
        self.drive_out(&targets, &shot).await?;
        self.verify(&targets, &shot).await?;
        self.home().await?;
        Ok(self.record.faces.last().map_or(0, FaceRecord::removed))
    }

    async fn burst(
        &mut self,
        found: usize,
        place: SafeTarget,
        program: DriveProgram,
        second_look: Option<PictureId>,
        places_left: Option<usize>,
    ) -> Result<Option<DriveEnd>, Stop> {
        let target = Target {
            found,
            place,
            room: None,
        };
        self.begin_burst(&target).await?;
        let Some(mover) = self.mover(place.arm()) else {
            return Ok(None);
        };
        let mut burst = mover.burst(&place, program).await;
        (burst.second_look, burst.places_left) = (second_look, places_left);
        let (end, failed) = (burst.end, burst.error.is_some());
        self.end_burst(&target, burst)?;
        if failed && self.is_in_trouble(&target).await {
            self.put_right(&target).await?;
        }
        Ok(end)
    }

    /// Looks at one screw again and maps it anew. `None` if no screw is seen there any more, or no arm may go there.
    ///
    /// # Arguments
    /// * `asks` – whether a person is asked to click on it.
    async fn second_look(
        &mut self,
        target: &Target,
        shot: &Shot,
        asks: bool,
    ) -> Result<Option<(SafeTarget, PictureId)>, Stop> {
        self.home().await?;
        let config = self.runner.config.clone();
        let Some((center, half_px)) = self.place_in_picture(target.found, shot) else {
            return Ok(None);
        };
        let camera = self.runner.devices.color.intrinsics();
        let Some(region) = region_around(&camera, center, half_px) else {
            return Ok(None);
        };
        let near = shoot(
            &self.runner.devices,
            Some(region),
            config.inspection.depth_frames.max(1),
        )
        .await?;
        let clicks = if asks {
            self.ask(&near, "Where is the screw that the bit does not meet?")
                .await?
        } else {
            None
        };
        let face = self.record.faces.last().and_then(|f| f.plane);
        let (stands, place) =
            self.judge()
                .second_look(&near, (center, half_px), face, self.face_odds(), clicks.as_deref())?;
        self.budget(&near);
        let picture = self
            .runner
            .journal
            .store_picture(&near.frame.color, config.journal.jpeg_quality)?;
        let frames = self.keep(&near)?.into_iter().collect();
        self.log(Event::Verified {
            screws: vec![(target.found, stands)],
            pictures: vec![picture.clone()],
            frames,
            second_look: Some(Box::new(look::second_look_of(target.found, place.as_ref()))),
        })?;
        Ok(place.map(|place| (place, picture)))
    }

    /// Where a find is in the whole picture, and the half width of a region around it, px.
    fn place_in_picture(&self, found: usize, shot: &Shot) -> Option<(Pixel, f64)> {
        let find = self.record.faces.last()?.found.get(found)?;
        look::place_in_picture(find, &shot.frame.camera?, &self.runner.config)
    }

    /// Looks again where a screw is said to have come out: in regions, since only these places can have changed, and a whole
    /// picture of the same face under the same light would miss what the first one missed. One that still stands gets the
    /// burst it has left.
    async fn verify(&mut self, targets: &[Target], shot: &Shot) -> Result<(), Stop> {
        let claimed = |a: &ScrewAttempt| {
            a.still_there.is_none() && matches!(a.end(), Some(DriveEnd::Removed | DriveEnd::TimeOut))
        };
        let Some(standing) = self.look_where(claimed, shot).await? else {
            return Ok(());
        };
        let mut again = false;
        for found in standing {
            let tried = self
                .record
                .faces
                .last()
                .and_then(|f| f.attempts.iter().find(|a| a.found == found));
            let retried = tried.is_some_and(|a| a.retries() > 0);
            if let Some(target) = targets.iter().find(|t| t.found == found && !retried) {
                let ladder = self.runner.config.ladder.clone();
                self.climb(target, shot, Climb::new(&ladder), Cause::StillThere).await?;
                again = true;
            }
        }
        if again {
            self.log(Event::Recovery { on: true })?;
            self.look_where(claimed, shot).await?;
            self.log(Event::Recovery { on: false })?;
        }
        Ok(())
    }

    /// Takes pictures of the attempts that ask for it; returns those that still stand, `None` if there was nothing to look at.
    async fn look_where(
        &mut self,
        asks: impl Fn(&ScrewAttempt) -> bool,
        shot: &Shot,
    ) -> Result<Option<Vec<usize>>, Stop> {
        let Some(face) = self.record.faces.last() else {
            return Ok(None);
        };
        let asked: Vec<usize> = face.attempts.iter().filter(|a| asks(a)).map(|a| a.found).collect();
        let places: Vec<(usize, Pixel, f64)> = asked
            .iter()
            .filter_map(|found| {
                self.place_in_picture(*found, shot)
                    .map(|(pixel, half_px)| (*found, pixel, half_px))
            })
            .collect();
        let Some(half_px) = places.iter().map(|p| p.2).reduce(f64::max) else {
            return Ok(None);
        };
        self.home().await?;
        let config = self.runner.config.clone();
        let camera = self.runner.devices.color.intrinsics();
        let pixels: Vec<Pixel> = places.iter().map(|p| p.1).collect();
        let (mut seen, mut pictures, mut frames) = (Vec::new(), Vec::new(), Vec::new());
        for region in regions_around(&camera, &pixels, half_px) {
            let near = shoot(&self.runner.devices, Some(region), 0).await?;
            seen.extend(self.judge().standing(&near, self.face_odds())?);
            self.budget(&near);
            pictures.push(
                self.runner
                    .journal
                    .store_picture(&near.frame.color, config.journal.jpeg_quality)?,
            );
            frames.extend(self.keep(&near)?);
        }
        let screws = self.judge().which_stand(&places, &seen);
        let standing = screws.iter().filter(|s| s.1).map(|s| s.0).collect();
        self.log(Event::Verified {
            screws,
            pictures,
            frames,
            second_look: None,
        })?;
        Ok(Some(standing))
    }

    async fn discharge(&mut self) -> Result<(), Stop> {
        for arm in 0..self.runner.devices.arms.len() {
            if let Some(mover) = self.mover(arm) {
                mover.recover().await?;
            }
        }
        self.home().await?;
        if self.laying.is_none() {
            self.lay_aside().await?;
        }
        let loaded = TagValue::Bool(true);
        // asked before it is ordered: after a crash the unit may have left already
        if self.runner.devices.io.read(tags::LOADED).await? != loaded {
            return self.laid_aside().await;
        }
        self.begin(Act::Discharge).await?;
        let io = self.runner.devices.io.clone();
        io.write(tags::MAGNET, TagValue::Bool(false)).await?;
        match io.write(tags::DISCHARGE, TagValue::Bool(true)).await {
            Ok(()) | Err(DeviceError::Timeout { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        self.laid_aside().await?;
        let gone = TagValue::Bool(false);
        match io
            .wait_for(tags::LOADED, gone.clone(), self.runner.config.timeouts.discharge_s)
            .await
        {
            Err(late @ DeviceError::Timeout { .. }) => {
                if io.read(tags::LOADED).await? == gone {
                    Ok(())
                } else {
                    Err(late.into())
                }
            }
            other => Ok(other?),
        }
    }
}
