//! A simulated cell behind the device traits: everything the real one would do, and what really happened for scoring.
//!
//! In the way of one unit this crate stands where the hardware stands. `cell` sees only [`Devices`]: cameras that render what
//! is before them, arms whose tools are not quite where their controllers believe, a driver that can slip, covers that stay
//! while a screw holds them. The physical world behind them is shared and moves on in simulated seconds, drawn from one seed;
//! the same seed and the same calls give the same run. [`SimulatedCell::score`] tells what really happened, for reports and
//! evaluation only.
//!
//! ```
//! use sim::{SimSettings, SimulatedCell};
//! let simulated = SimulatedCell::new(SimSettings { seed: 7, ..SimSettings::default() });
//! assert_eq!(simulated.devices.arms.len(), 2);
//! assert_eq!(simulated.devices.clock.now_s(), 0.0);
//! assert!(simulated.score().units.is_empty());
//! ```

mod arm;
mod camera;
mod draw;
mod driver;
mod faults;
mod io;
pub mod layout;
mod log;
mod mechanics;
mod operator;
mod score;
#[cfg(test)]
mod shift;
#[cfg(test)]
mod tests;
mod world;

pub use faults::{Fault, FaultError, Faults};
pub use log::{LogError, read_actions};
pub use mechanics::ArmErrors;
pub use score::{Action, ActionKind, Aim, Score, ScrewScore, UnitScore};
pub use world::unit_seed;

use cell::device::{Arm, Devices};
use scene::FaceTruth;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::{Arc, Mutex};
use world::{Shared, World, lock};

/// What a simulated cell is made from; the table `[simulated]` of a cell file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimSettings {
    /// Seed of the cell itself: arms, camera, where things stand.
    pub seed: u64,
    /// Seed of the units that come in.
    pub units_seed: u64,
    /// Factor on every wear level of the units: 0 as new, 1 as collected.
    pub wear: f32,
    /// Whether there is anything on the units that may be taken for a screw.
    pub decoys: bool,
    /// Share of units that cannot be done; in the paper 28 of 120.
    pub excluded_share: f64,
    /// How far the arms depart from their data sheet.
    pub arms: ArmErrors,
    /// What is assumed of screws, bits and persons.
    pub assumed: Assumed,
    /// What goes wrong, and how often: nothing unless named.
    pub faults: Faults,
}

impl Default for SimSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            units_seed: 1,
            wear: 1.0,
            decoys: true,
            excluded_share: 28.0 / 120.0,
            arms: ArmErrors::default(),
            assumed: Assumed::default(),
            faults: Faults::none(),
        }
    }
}

/// What nobody has measured: a figure from the simulated cell is a claim about these numbers, and is printed with them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Assumed {
    /// A screw that is rusted solid comes loose after impacts for a time that varies from screw to screw; half of them within this, s. Only
    /// impacts of at least its torque count.
    pub seized_half_life_s: f64,
    /// What a filled recess is to the extractor bit, as a share of what it is to the cross bit: it cuts through dirt.
    pub extractor_fill: f64,
    /// The same for a rounded recess: it cuts its own grip.
    pub extractor_wear: f64,
    /// Time to change the bit at the magazine, the way there and back included, s.
    pub bit_change_s: f64,
    /// Time in which the mill takes a head off, s.
    pub mill_s: f64,
    /// How far beside a head the mill may stand and still take it off, mm.
    pub mill_reach_mm: f64,
    /// Whether the plant's controller permits milling.
    pub mill_permitted: bool,
    /// Share of the screws that a person sees in a picture where at least half of the head shows.
    pub person_sees: f64,
    /// The same for heads of which less shows, or whose recess is buried.
    pub person_sees_hidden: f64,
    /// Time until a person looks at a picture and understands it, s.
    pub person_look_s: f64,
    /// Time of a click, s.
    pub person_click_s: f64,
}

impl Default for Assumed {
    fn default() -> Self {
        Self {
            seized_half_life_s: 10.0,
            extractor_fill: 0.6,
            extractor_wear: 0.4,
            bit_change_s: 7.0,
            mill_s: 8.0,
            mill_reach_mm: 2.0,
            mill_permitted: true,
            person_sees: 0.98,
            person_sees_hidden: 0.7,
            person_look_s: 6.0,
            person_click_s: 1.5,
        }
    }
}

/// Settings that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("[simulated] in the cell file: {reason}")]
pub struct SettingsError {
    /// Key and cause.
    pub reason: String,
}

impl SimSettings {
    /// Reads the table `[simulated]` of a cell file; what it leaves out keeps its default.
    ///
    /// # Errors
    /// [`SettingsError`] for an unknown key, an unknown fault or a number out of range.
    pub fn from_table(table: &toml::Table) -> Result<Self, SettingsError> {
        let settings: Self = table.clone().try_into().map_err(|e: toml::de::Error| SettingsError {
            reason: e.message().to_owned(),
        })?;
        let bad = |key: &str, why: &str| {
            Err(SettingsError {
                reason: format!("{key} {why}"),
            })
        };
        if !(0.0..=2.0).contains(&settings.wear) {
            return bad("wear", "must lie between 0 and 2");
        }
        if !(0.0..=1.0).contains(&settings.excluded_share) {
            return bad("excluded_share", "must lie between 0 and 1");
        }
        let e = settings.arms;
        let errors = [
            e.link_mm,
            e.zero_deg,
            e.gravity,
            e.ripple_mm,
            e.hysteresis_mm,
            e.repeatability_mm,
        ];
        if !errors.iter().all(|v| (0.0..=20.0).contains(v)) {
            return bad("arms", "must hold numbers between 0 and 20");
        }
        let a = settings.assumed;
        let shares = [a.extractor_fill, a.extractor_wear, a.person_sees, a.person_sees_hidden];
        if !shares.iter().all(|v| (0.0..=1.0).contains(v)) {
            return bad("assumed", "must hold shares between 0 and 1");
        }
        let amounts = [
            a.seized_half_life_s,
            a.bit_change_s,
            a.mill_s,
            a.mill_reach_mm,
            a.person_look_s,
            a.person_click_s,
        ];
        if !amounts.iter().all(|v| (0.0..=3600.0).contains(v)) {
            return bad("assumed", "must hold times and distances between 0 and 3600");
        }
        Ok(settings)
    }
}

/// A simulated cell: its devices for the program, its truth for the score.
pub struct SimulatedCell {
    /// What the program works with.
    pub devices: Devices,
    world: Shared,
}

impl std::fmt::Debug for SimulatedCell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SimulatedCell")
            .field("devices", &self.devices)
            .finish_non_exhaustive()
    }
}

impl SimulatedCell {
    /// Switches a cell on: table empty, arms at home, clock at zero.
    pub fn new(settings: SimSettings) -> Self {
        let world: Shared = Arc::new(Mutex::new(World::new(settings)));
        let arms = layout::ARMS
            .iter()
            .enumerate()
            .map(|(index, (name, _))| Arm {
                robot: Arc::new(arm::ArmHandle {
                    world: world.clone(),
                    index,
                    name: (*name).to_owned(),
                }),
                driver: Some(Arc::new(driver::DriverHandle {
                    world: world.clone(),
                    arm: index,
                    name: format!("driver of {name}"),
                })),
            })
            .collect();
        let devices = Devices {
            color: Arc::new(camera::ColorHandle(world.clone())),
            depth: Arc::new(camera::DepthHandle(world.clone())),
            arms,
            io: Arc::new(io::IoHandle(world.clone())),
            reader: Arc::new(io::ReaderHandle(world.clone())),
            plant: Arc::new(io::PlantHandle(world.clone())),
            clock: Arc::new(io::ClockHandle(world.clone())),
            operator: Some(Arc::new(operator::OperatorHandle(world.clone()))),
        };
        Self { devices, world }
    }

    /// A person mounts the marker jig in place of this arm's bit (and takes it off every other arm), or with `None` takes it off.
    pub fn mount_jig(&self, arm: Option<usize>) {
        for (index, body) in lock(&self.world).arms.iter_mut().enumerate() {
            body.jig = arm == Some(index);
        }
    }

    /// What really happened so far. For reports and evaluation, never for deciding.
    pub fn score(&self) -> Score {
        lock(&self.world).score()
    }

    /// What is really on the face that stands before the camera, without the screws that are out; `None` while none does. For
    /// reports and evaluation, never for deciding.
    pub fn face_truth(&self) -> Option<FaceTruth> {
        let mut world = lock(&self.world);
        let mut truth = (*world.truth()?).clone();
        truth.screws.retain(|screw| !world.is_out(screw.id));
        Some(truth)
    }

    /// Nearest that the arms have come to each other so far, mm; not finite while none has moved. For reports and evaluation, never for
    /// deciding: arms that touch stop with an alarm, as real ones do.
    pub fn nearest_arms_mm(&self) -> f64 {
        lock(&self.world).nearest_arms_mm()
    }

    /// What the plant was told: one JSON text a finished unit.
    pub fn plant_reports(&self) -> Vec<String> {
        lock(&self.world).reports.clone()
    }

    /// As [`new`](Self::new), with the world's own log in a file: one JSON line a physical action. If the file is there, the
    /// world goes on where it ends, as a real cell stands where it stood when the computer went down.
    ///
    /// # Errors
    /// [`LogError`] with the file's name if it cannot be read, written or understood.
    pub fn open(settings: SimSettings, log: &Path) -> Result<Self, LogError> {
        let (actions, file) = log::ActionLog::open(log)?;
        for action in &actions {
            if let (Some(unit), ActionKind::Loaded { seed, .. }) = (action.unit, &action.kind)
                && *seed != unit_seed(settings.units_seed, unit)
            {
                return Err(LogError::OtherUnits {
                    path: log.to_owned(),
                    unit,
                    units_seed: settings.units_seed,
                });
            }
        }
        let cell = Self::new(settings);
        lock(&cell.world).resume(actions, file);
        Ok(cell)
    }

    /// Why the world's log could not be written, if so; it is not written further then.
    pub fn log_error(&self) -> Option<String> {
        lock(&self.world).log_error()
    }
}
