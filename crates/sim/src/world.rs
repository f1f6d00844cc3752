//! The physical world that all devices of one cell share: time, the unit on the table, what is off it, the arms.

use crate::arm::SimArm;
use crate::draw::{draw, mix, signed};
use crate::faults::{Fault, FaultDraws};
use crate::layout;
use crate::log::ActionLog;
use crate::score::{Action, ActionKind, Score, ScrewScore, UnitScore};
use crate::{Assumed, SimSettings};
use cell::device::{Bit, DriveEnd};
use cell::motion::{ArmMotion, CellDrawing};
use geometry::{Base, Camera, CameraModel, Face, Point, Tool, Transform};
use nalgebra::{UnitQuaternion, Vector3};
use rand::RngExt;
use scene::{CoverId, FaceId, FaceTruth, FaceView, Rendered, ScrewId, Sensor, Unit, UnitOptions};
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

/// Half side of the matching window of the cell's stereo, in its pixels: none. Already one of 3 pixels makes heads beside a wall seem to lean
/// together by several degrees, and the rule that leaves out faces whose heads really do cannot tell the two apart yet.
const DEPTH_WINDOW_PX: i64 = 0;

/// The world as its devices hold it.
pub(crate) type Shared = Arc<Mutex<World>>;

/// Takes the world; a device that panicked while it held it leaves it usable.
pub(crate) fn lock(world: &Shared) -> MutexGuard<'_, World> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits until it is so late in the world. Time goes on only once everybody who is at work waits, so that two arms that work at the same
/// time do so in the world too: what the one does takes none of the other's time.
pub(crate) fn until(world: &Shared, t_s: f64) -> Until {
    Until {
        world: world.clone(),
        t_s,
        wait: None,
        acts_seen: 0,
    }
}

/// See [`until`]. All that wait are asked in turn; who finds that nothing has happened since it was asked last lets time pass.
pub(crate) struct Until {
    world: Shared,
    t_s: f64,
    wait: Option<u64>,
    acts_seen: u64,
}

impl Future for Until {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<()> {
        let shared = self.world.clone();
        let mut world = lock(&shared);
        match self.wait {
            None if world.t_s < self.t_s => {
                world.acts += 1;
                let number = world.acts;
                world.waits.insert(number, self.t_s);
                self.wait = Some(number);
            }
            Some(_) if world.t_s < self.t_s && world.acts == self.acts_seen => {
                let next_s = world.waits.values().copied().fold(self.t_s, f64::min);
                world.advance_to(next_s);
            }
            _ => {}
        }
        if world.t_s >= self.t_s {
            world.acts += 1;
            return Poll::Ready(());
        }
        self.acts_seen = world.acts;
        context.waker().wake_by_ref();
        Poll::Pending
    }
}

impl Drop for Until {
    fn drop(&mut self) {
        if let Some(wait) = self.wait {
            lock(&self.world).waits.remove(&wait);
        }
    }
}

/// Time until a fed unit stands on the table, s.
const FEED_S: f64 = 14.0;
/// Time to turn another face to the camera, s.
const TURN_S: f64 = 3.2;
/// Time to clear the table, s.
const DISCHARGE_S: f64 = 10.0;
/// How often is looked whether moving arms touch each other, s.
const LOOK_S: f64 = 0.02;
/// A target may not lie deeper than this behind the sheet, mm: the bit stops at the head.
const DEEPEST_MM: f64 = 8.0;
/// Nothing may go below this height above the arm's foot, mm: the table.
const TABLE_TOP_MM: f64 = 90.0;

/// A job of an arm that leaves something changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ArmJob {
    Pull(CoverId),
    Drop,
    Mount(Bit),
}

impl ArmJob {
    /// Covers that a job exists for; the left one leaves with the front.
    pub(crate) fn pulls() -> impl Iterator<Item = CoverId> {
        [CoverId::Top, CoverId::Front, CoverId::Right].into_iter()
    }
}

/// Something the table is doing.
#[derive(Clone, Copy, Debug, PartialEq)]
enum TableJob {
    Feed,
    Turn(FaceId),
    Discharge,
}

/// The unit on the table.
pub(crate) struct LoadedUnit {
    pub(crate) unit: Unit,
    pub(crate) removed: BTreeSet<ScrewId>,
    pub(crate) covers_off: BTreeSet<CoverId>,
    pub(crate) attempts: BTreeMap<ScrewId, u32>,
    /// How long each screw has been hammered at its torque, s.
    pub(crate) impacts_s: BTreeMap<ScrewId, f64>,
    pub(crate) presented: Option<FaceId>,
    truths: BTreeMap<FaceId, Arc<FaceTruth>>,
    score: UnitScore,
}

/// A depth picture that came with the last colour picture.
pub(crate) struct LastShot {
    pub(crate) state: u64,
    pub(crate) region: Option<scene::Roi>,
    pub(crate) rendered: Rendered,
}

/// Everything physical.
pub(crate) struct World {
    t_s: f64,
    /// Counts whatever happens, so that who waits can tell whether anything did.
    acts: u64,
    /// Until when is waited for, by number of the wait.
    waits: BTreeMap<u64, f64>,
    /// What the arms are, to tell whether they touch each other.
    bodies: Vec<ArmMotion>,
    /// Nearest that the arms have come to each other, mm.
    nearest_arms_mm: f64,
    settings: SimSettings,
    pub(crate) arms: Vec<SimArm>,
    pub(crate) faults: FaultDraws,
    pub(crate) stated_camera: CameraModel,
    pub(crate) true_camera: CameraModel,
    pub(crate) unit: Option<LoadedUnit>,
    pub(crate) magnet: bool,
    pub(crate) held_cover: Option<CoverId>,
    table: Option<(TableJob, f64)>,
    fed: u64,
    pub(crate) exposures: u64,
    pub(crate) last_shot: Option<LastShot>,
    /// Which jig the cell has, once it was looked at.
    pub(crate) jig_seed: Option<u64>,
    pub(crate) reports: Vec<String>,
    actions: Vec<Action>,
    done: Vec<UnitScore>,
    log: Option<ActionLog>,
}

impl World {
    pub(crate) fn new(settings: SimSettings) -> Self {
        let seed = settings.seed;
        let stated_camera = scene::camera(mix(seed, &[10]));
        let tool = layout::flange_from_tool();
        let drawing = CellDrawing::default();
        let arms = layout::ARMS
            .iter()
            .zip(&drawing.arms)
            .enumerate()
            .map(|(i, ((name, _), drawn))| {
                let (camera, seed) = (layout::true_base_from_camera(i, seed), mix(seed, &[20, i as u64]));
                SimArm::new(name, seed, &settings.arms, tool, camera, i == 1, drawn.home_rad)
            })
            .collect();
        let bodies = layout::ARMS
            .iter()
            .filter_map(|(name, _)| ArmMotion::new(&drawing, name));
        Self {
            t_s: 0.0,
            acts: 0,
            waits: BTreeMap::new(),
            bodies: bodies.collect(),
            nearest_arms_mm: f64::INFINITY,
            faults: FaultDraws::new(mix(seed, &[30]), settings.faults.clone()),
            true_camera: layout::true_camera(&stated_camera, seed),
            stated_camera,
            arms,
            unit: None,
            magnet: false,
            held_cover: None,
            table: None,
            fed: 0,
            exposures: 0,
            last_shot: None,
            jig_seed: None,
            reports: Vec::new(),
            actions: Vec::new(),
            done: Vec::new(),
            log: None,
            settings,
        }
    }

    pub(crate) fn now_s(&self) -> f64 {
        self.t_s
    }

    pub(crate) fn seed(&self) -> u64 {
        self.settings.seed
    }

    pub(crate) fn assumed(&self) -> Assumed {
        self.settings.assumed
    }

    /// Lets time pass.
    pub(crate) fn pass(&mut self, s: f64) {
        self.advance_to(self.t_s + s.max(0.0));
    }

    /// Moves on to a time; everything that ends on the way happens in its order.
    pub(crate) fn advance_to(&mut self, t_s: f64) {
        self.acts += 1;
        while self.t_s < t_s {
            let next_s = self.next_event_s().filter(|at_s| *at_s <= t_s).unwrap_or(t_s);
            let moving = self.arms.iter().filter(|arm| arm.is_moving()).count();
            // while nothing moves, nothing comes nearer
            let step_s = if moving > 0 { LOOK_S } else { f64::INFINITY };
            self.t_s = next_s.min(self.t_s + step_s).max(self.t_s);
            if moving > 0 {
                self.look_at_arms();
            }
            self.settle();
        }
        self.settle();
    }

    /// Two arms that touch each other stop, as real ones would.
    fn look_at_arms(&mut self) {
        let (now_s, [a, b]) = (self.t_s, &self.bodies[..]) else {
            return;
        };
        let apart_mm = a.apart_mm(self.arms[0].joints_at(now_s), b, self.arms[1].joints_at(now_s));
        self.nearest_arms_mm = self.nearest_arms_mm.min(apart_mm);
        if apart_mm < 0.0 {
            for arm in &mut self.arms {
                arm.collide(now_s);
            }
        }
    }

    /// Nearest that the arms have come to each other, mm.
    pub(crate) fn nearest_arms_mm(&self) -> f64 {
        self.nearest_arms_mm
    }

    /// When something ends by itself next.
    pub(crate) fn next_event_s(&self) -> Option<f64> {
        let arms = self.arms.iter().filter_map(SimArm::next_event_s);
        arms.chain(self.table.map(|(_, at_s)| at_s)).min_by(f64::total_cmp)
    }

    fn settle(&mut self) {
        let now_s = self.t_s;
        if let Some((job, at_s)) = self.table
            && at_s <= now_s
        {
            self.table = None;
            self.end_table_job(job);
        }
        for i in 0..self.arms.len() {
            match self.arms[i].settle(now_s) {
                Some(ArmJob::Pull(cover)) => self.pull(i, cover),
                Some(ArmJob::Drop) => {
                    self.held_cover = None;
                    self.record(ActionKind::LaidAside);
                }
                Some(ArmJob::Mount(bit)) => {
                    self.arms[i].bit = bit;
                    let arm = self.arms[i].name.clone();
                    self.record(ActionKind::Mounted { arm, bit });
                }
                None => {}
            }
        }
    }

    pub(crate) fn record(&mut self, kind: ActionKind) {
        let unit = self.unit.as_ref().map(|u| u.score.index);
        let action = Action {
            t_s: self.t_s,
            unit,
            kind,
        };
        if let Some(log) = &mut self.log {
            log.append(&action);
        }
        self.actions.push(action);
    }

    /// Brings the world to where its log ends: what was done stays done. The arms are found at home, as after a restart by
    /// an operator.
    pub(crate) fn resume(&mut self, actions: Vec<Action>, log: ActionLog) {
        for action in actions {
            self.t_s = action.t_s;
            match &action.kind {
                ActionKind::Loaded { .. } => {
                    self.fed = action.unit.unwrap_or(self.fed);
                    self.load();
                }
                ActionKind::Presented { face } => {
                    if let Some(loaded) = &mut self.unit {
                        loaded.presented = Some(*face);
                    }
                    self.truth();
                }
                ActionKind::Drive {
                    screw: Some(id),
                    end,
                    impacts_s,
                    ..
                } => self.driven(*id, *end, *impacts_s),
                ActionKind::Drive { .. } | ActionKind::Asked { .. } => {}
                ActionKind::Mounted { arm, bit } => {
                    if let Some(arm) = self.arms.iter_mut().find(|a| a.name == *arm) {
                        arm.bit = *bit;
                    }
                }
                ActionKind::Pull { cover, off, .. } => {
                    self.held_cover = off.then_some(*cover);
                    if let Some(loaded) = self.unit.as_mut().filter(|_| *off) {
                        loaded.covers_off.extend(loaded.leaving(*cover));
                    }
                }
                ActionKind::LaidAside => self.held_cover = None,
                ActionKind::Discharged => self.discharged(),
            }
            self.actions.push(action);
        }
        self.log = Some(log);
    }

    /// Why the log could not be written, if so.
    pub(crate) fn log_error(&self) -> Option<String> {
        self.log.as_ref().and_then(|log| log.error.clone())
    }

    // ---- table ----

    pub(crate) fn table_busy(&self) -> bool {
        self.table.is_some()
    }

    fn begin_table_job(&mut self, job: TableJob, takes_s: f64) {
        let slow = if self.faults.happens(Fault::IoDelay) { 3.0 } else { 1.0 };
        self.table = Some((job, self.t_s + takes_s * slow));
    }

    pub(crate) fn feed(&mut self) {
        self.begin_table_job(TableJob::Feed, FEED_S);
    }

    pub(crate) fn turn(&mut self, face: FaceId) {
        let Some(loaded) = &mut self.unit else { return };
        if loaded.presented == Some(face) {
            return;
        }
        loaded.presented = None;
        self.begin_table_job(TableJob::Turn(face), TURN_S);
    }

    pub(crate) fn discharge(&mut self) {
        if let Some(loaded) = &mut self.unit {
            loaded.presented = None;
        }
        self.begin_table_job(TableJob::Discharge, DISCHARGE_S);
    }

    fn end_table_job(&mut self, job: TableJob) {
        match job {
            TableJob::Feed => {
                let seed = self.load();
                let spoilt = self.unit.as_ref().map(|loaded| loaded.unit.exclusion.is_some());
                self.record(ActionKind::Loaded { seed, spoilt });
            }
            TableJob::Turn(face) => {
                if let Some(loaded) = &mut self.unit {
                    loaded.presented = Some(face);
                }
                self.record(ActionKind::Presented { face });
                // Known for the score also where nothing is driven.
                self.truth();
            }
            TableJob::Discharge => {
                self.record(ActionKind::Discharged);
                self.discharged();
            }
        }
    }

    /// Puts the next unit on the table; returns its seed.
    fn load(&mut self) -> u64 {
        let index = self.fed;
        self.fed += 1;
        let seed = unit_seed(self.settings.units_seed, index);
        let options = UnitOptions {
            wear: self.settings.wear,
            decoys: self.settings.decoys,
            excluded_share: self.settings.excluded_share,
        };
        let unit = Unit::sample_with(seed, &options);
        self.unit = Some(LoadedUnit {
            score: UnitScore {
                index,
                seed,
                model: unit.model.clone(),
                theme: unit.theme,
                exclusion: unit.exclusion,
                loaded_s: self.t_s,
                discharged_s: None,
                screws: Vec::new(),
                covers_off: Vec::new(),
            },
            unit,
            removed: BTreeSet::new(),
            covers_off: BTreeSet::new(),
            attempts: BTreeMap::new(),
            impacts_s: BTreeMap::new(),
            presented: None,
            truths: BTreeMap::new(),
        });
        seed
    }

    fn discharged(&mut self) {
        if let Some(loaded) = self.unit.take() {
            let mut score = score_of(&loaded);
            score.discharged_s = Some(self.t_s);
            self.done.push(score);
        }
    }

    // ---- covers ----

    fn pull(&mut self, arm: usize, cover: CoverId) {
        let slipped = self.faults.happens(Fault::GripperSlip);
        let mut holding = 0;
        let mut off = false;
        if let Some(loaded) = &mut self.unit {
            let leaving = loaded.leaving(cover);
            holding = loaded.standing(&leaving).len();
            let at_hand = loaded.presented.is_some_and(|face| grips(cover, face));
            off = at_hand && holding == 0 && !slipped && !loaded.covers_off.contains(&cover);
            if off {
                loaded.covers_off.extend(leaving);
            }
        }
        self.held_cover = off.then_some(cover);
        self.record(ActionKind::Pull {
            arm: self.arms[arm].name.clone(),
            cover,
            off,
            held_by: holding,
        });
    }

    // ---- what stands where ----

    /// Where a face of the unit on the table stands before the camera.
    fn camera_from_face(&self, loaded: &LoadedUnit, face: FaceId) -> Option<Transform<Camera, Face>> {
        let design = loaded.unit.face(face)?;
        let mut rng = draw(loaded.score.seed, &[40, face as u64]);
        let tilt_rad = rng.random::<f64>().sqrt() * 6f64.to_radians();
        let toward = rng.random_range(0.0..TAU);
        let turn_rad = signed(&mut rng) * 4f64.to_radians();
        let offset = [4.0, 4.0, 12.0].map(|mm| mm * signed(&mut rng));
        let drawn = layout::station(
            [design.width_mm, design.height_mm],
            if face == FaceId::FrontInner {
                layout::INNER_DEPTH_MM
            } else {
                0.0
            },
            turn_rad,
            UnitQuaternion::from_scaled_axis(Vector3::new(toward.cos(), toward.sin(), 0.0) * tilt_rad),
            offset,
        );
        Some(layout::true_base_from_camera(0, self.settings.seed).inverse() * layout::drawn_base_from_camera(0) * drawn)
    }

    /// The presented face as the camera sees it, with a new exposure.
    pub(crate) fn view(&self) -> Option<FaceView> {
        let loaded = self.unit.as_ref()?;
        let face = loaded.presented?;
        Some(FaceView {
            design: loaded.unit.face(face)?.clone(),
            camera: self.true_camera,
            camera_from_face: self.camera_from_face(loaded, face)?,
            scene_seed: mix(loaded.score.seed, &[41, face as u64]),
            sensor: Sensor {
                noise_seed: mix(self.settings.seed, &[42, self.exposures]),
                depth_window_px: DEPTH_WINDOW_PX,
                ..Sensor::sample(mix(loaded.score.seed, &[43]))
            },
            removed_screws: loaded.removed.iter().copied().collect(),
        })
    }

    /// The truth of the presented face with all its screws, made when first asked for.
    pub(crate) fn truth(&mut self) -> Option<Arc<FaceTruth>> {
        let face = self.unit.as_ref()?.presented?;
        if let Some(known) = self.unit.as_ref()?.truths.get(&face) {
            return Some(known.clone());
        }
        let whole = FaceView {
            removed_screws: Vec::new(),
            ..self.view()?
        };
        let truth = Arc::new(scene::truth(&whole));
        self.unit.as_mut()?.truths.insert(face, truth.clone());
        Some(truth)
    }

    /// True if a screw of the unit on the table has been taken out.
    pub(crate) fn is_out(&self, screw: ScrewId) -> bool {
        self.unit.as_ref().is_some_and(|u| u.removed.contains(&screw))
    }

    /// A number that changes whenever the picture would.
    pub(crate) fn state_number(&self) -> u64 {
        match &self.unit {
            None => 0,
            Some(u) => {
                let face = u.presented.map_or(99, |f| f as u64);
                mix(
                    u.score.index,
                    &[face, u.removed.len() as u64, u.covers_off.len() as u64],
                )
            }
        }
    }

    /// An arm whose tool stands between the camera and the unit, other than one that shows the jig.
    pub(crate) fn arm_in_view(&self) -> Option<&SimArm> {
        self.arms.iter().find(|arm| {
            let tool = arm.camera_from_true_tool(self.t_s) * Point::new(0.0, 0.0, 0.0);
            !arm.jig
                && self
                    .stated_camera
                    .project(tool)
                    .is_some_and(|pixel| self.stated_camera.contains(pixel))
        })
    }

    /// Why an arm may not go there, if so.
    pub(crate) fn keep_out(&self, arm: usize, base_from_tool: Transform<Base, Tool>) -> Option<String> {
        let tip: Point<Base> = base_from_tool * Point::new(0.0, 0.0, 0.0);
        if tip.z_mm() < TABLE_TOP_MM {
            return Some(format!(
                "{:.1} mm above the foot lies in the table, whose top is at {TABLE_TOP_MM} mm",
                tip.z_mm()
            ));
        }
        let loaded = self.unit.as_ref()?;
        let tip_in_camera = self.arms[arm].base_from_camera.inverse() * tip;
        let Some(face) = loaded.presented else {
            return (tip_in_camera.z_mm() > layout::FACE_DEPTH_MM - 150.0)
                .then(|| "the table is turning; wait until a face is presented".into());
        };
        let design = loaded.unit.face(face)?;
        let p = self.camera_from_face(loaded, face)?.inverse() * tip_in_camera;
        let beside = p.x_mm().abs() > 0.5 * design.width_mm || p.y_mm().abs() > 0.5 * design.height_mm;
        let items = design.screws.iter().map(|s| s.placed.height_mm);
        let lowest = items.fold(0.0, f64::min);
        let deep_mm = p.z_mm() + lowest;
        (!beside && deep_mm > DEEPEST_MM).then(|| format!("the target lies {deep_mm:.1} mm inside the unit"))
    }

    /// Score of everything so far.
    pub(crate) fn score(&self) -> Score {
        let mut units = self.done.clone();
        units.extend(self.unit.as_ref().map(score_of));
        Score {
            units,
            actions: self.actions.clone(),
        }
    }

    /// Notes what the driver did to a screw.
    pub(crate) fn driven(&mut self, screw: ScrewId, end: DriveEnd, impacts_s: f64) {
        let Some(loaded) = &mut self.unit else { return };
        *loaded.impacts_s.entry(screw).or_default() += impacts_s;
        *loaded.attempts.entry(screw).or_default() += 1;
        if end == DriveEnd::Removed {
            loaded.removed.insert(screw);
        }
    }
}

impl LoadedUnit {
    /// The cover and those that come off with it.
    fn leaving(&self, cover: CoverId) -> Vec<CoverId> {
        let covers = self.unit.covers.iter();
        covers
            .filter(|c| c.id == cover || c.leaves_with == Some(cover) || leaves_with(c.id) == Some(cover))
            .map(|c| c.id)
            .collect()
    }

    /// Screws that still hold any of these covers.
    fn standing(&self, covers: &[CoverId]) -> Vec<ScrewId> {
        self.unit
            .covers
            .iter()
            .filter(|c| covers.contains(&c.id))
            .flat_map(|c| c.screws.iter().copied())
            .filter(|s| !self.removed.contains(s))
            .collect()
    }
}

/// Which face has to stand before the gripper for a cover.
fn grips(cover: CoverId, face: FaceId) -> bool {
    match cover {
        CoverId::Top => face == FaceId::Top,
        CoverId::Right => face == FaceId::Right,
        CoverId::Left => face == FaceId::Left,
        CoverId::Front | CoverId::FrontInner => matches!(face, FaceId::Front | FaceId::FrontInner),
    }
}

/// Covers without a job of their own.
fn leaves_with(cover: CoverId) -> Option<CoverId> {
    matches!(cover, CoverId::Left | CoverId::FrontInner).then_some(CoverId::Front)
}

fn score_of(loaded: &LoadedUnit) -> UnitScore {
    let screws = loaded.unit.screws().map(|(face, screw)| {
        let seen = loaded.truths.get(&face);
        ScrewScore {
            id: screw.id,
            face,
            removed: loaded.removed.contains(&screw.id),
            seized: screw.seized,
            attempts: loaded.attempts.get(&screw.id).copied().unwrap_or(0),
            detectable: seen
                .and_then(|t| t.screws.iter().find(|s| s.id == screw.id))
                .map(|s| s.detectable),
        }
    });
    UnitScore {
        screws: screws.collect(),
        covers_off: loaded.covers_off.iter().copied().collect(),
        ..loaded.score.clone()
    }
}

/// Seed of the `index`-th unit of a series.
pub fn unit_seed(units_seed: u64, index: u64) -> u64 {
    mix(units_seed, &[50, index])
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Direction;

    #[test]
    fn an_arm_can_go_to_every_screw_of_every_unit() {
        let drawing = CellDrawing::default();
        let motions = layout::ARMS.map(|(name, _)| ArmMotion::new(&drawing, name).expect("a drawn arm"));
        let mut world = World::new(SimSettings::default());
        let (mut screws, mut by_second, mut around) = (0, 0, 0);
        for _ in 0..60 {
            world.load();
            let loaded = world.unit.as_ref().expect("a unit");
            for design in &loaded.unit.faces {
                let camera_from_face = world.camera_from_face(loaded, design.id).expect("a face");
                for screw in &design.screws {
                    let [x, y] = screw.placed.at_mm;
                    let ways: Vec<_> = motions
                        .iter()
                        .zip(&world.arms)
                        .map(|(motion, arm)| {
                            let base_from_face = arm.base_from_camera * camera_from_face;
                            let tip = base_from_face * Point::new(x, y, -screw.placed.height_mm);
                            let inwards = base_from_face * Direction::new(0.0, 0.0, 1.0).expect("a direction");
                            let standoff = cell::plan::tool_pose(tip.moved(inwards, -40.0), inwards);
                            motion.check(motion.home_rad(), standoff, cell::plan::tool_pose(tip, inwards), 150.0)
                        })
                        .collect();
                    screws += 1;
                    match (&ways[0], &ways[1]) {
                        (Ok(way), _) => around += usize::from(way.via().is_some()),
                        (Err(_), Ok(_)) => by_second += 1,
                        (Err(a), Err(b)) => {
                            panic!("{:?} ({x}, {y}) of {:?} mm: {a}; {b}", design.id, loaded.unit.size_mm)
                        }
                    }
                }
            }
        }
        // the lowest of tall units that lean are for the other arm
        assert!(screws > 1000 && by_second * 50 < screws, "{by_second} of {screws}");
        // for some a straight joint move would swing the bit through the unit: then the way leads around it
        assert!(around > 0 && around * 2 < screws, "{around} of {screws}");
    }
}
