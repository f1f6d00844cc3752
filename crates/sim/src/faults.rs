//! Faults of the simulated cell, by name and rate; all off unless asked for.

use crate::draw::{draw, name_number};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

macro_rules! faults {
    ($($(#[$doc:meta])* $variant:ident = $name:literal;)*) => {
        /// Something that can go wrong.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Fault { $($(#[$doc])* $variant,)* }
        impl Fault {
            /// Every fault, in a fixed order.
            pub const ALL: &'static [Fault] = &[$(Fault::$variant,)*];
            /// Name in the cell file.
            pub fn name(self) -> &'static str {
                match self { $(Fault::$variant => $name,)* }
            }
        }
    };
}
faults! {
    /// The colour camera does not answer.
    CameraTimeout = "camera_timeout";
    /// The colour camera answers without a picture.
    CameraDroppedFrame = "camera_dropped_frame";
    /// The depth camera measures nothing in a large part of the picture.
    DepthMissing = "depth_missing";
    /// A move is begun, but the controller's answer is lost.
    ArmTimeoutAfterMove = "arm_timeout_after_move";
    /// A move stops half way with an alarm.
    ArmAlarm = "arm_alarm";
    /// A reset is acknowledged, but nothing is cleared.
    ResetLies = "reset_lies";
    /// The driver works, but its answer is lost.
    DriverNoAnswer = "driver_no_answer";
    /// The gripper slips off a cover that is free.
    GripperSlip = "gripper_slip";
    /// The model-number reader does not answer.
    ReaderFails = "reader_fails";
    /// The table takes three times as long.
    IoDelay = "io_delay";
    /// The calibration marker cannot be seen.
    MarkerHidden = "marker_hidden";
    /// A reflection is seen where the calibration marker is not.
    MarkerGlare = "marker_glare";
}

/// A fault table that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FaultError {
    /// No fault of that name.
    #[error("there is no fault '{name}'; the known ones are {known}")]
    Unknown {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// Not a probability.
    #[error("the rate of fault '{name}' is {rate}; it must lie between 0 and 1")]
    Rate {
        /// Name.
        name: String,
        /// What was asked for.
        rate: f64,
    },
}

/// Rates of the faults: probability at each opportunity (a grab, a move, a reset ...). Those not named never happen.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, f64>", into = "BTreeMap<String, f64>")]
pub struct Faults(BTreeMap<Fault, f64>);

impl Faults {
    /// No faults.
    pub fn none() -> Self {
        Self::default()
    }

    /// Rate of a fault, 0 if it is off.
    pub fn rate(&self, fault: Fault) -> f64 {
        self.0.get(&fault).copied().unwrap_or(0.0)
    }

    /// The same table with one more fault.
    ///
    /// # Errors
    /// [`FaultError`] for an unknown name or a rate that is no probability.
    pub fn with(mut self, name: &str, rate: f64) -> Result<Self, FaultError> {
        let Some(fault) = Fault::ALL.iter().copied().find(|f| f.name() == name) else {
            return Err(FaultError::Unknown {
                name: name.into(),
                known: Fault::ALL.iter().map(|f| f.name()).collect::<Vec<_>>().join(", "),
            });
        };
        if !(0.0..=1.0).contains(&rate) {
            return Err(FaultError::Rate {
                name: name.into(),
                rate,
            });
        }
        self.0.insert(fault, rate);
        Ok(self)
    }
}

impl TryFrom<BTreeMap<String, f64>> for Faults {
    type Error = FaultError;
    fn try_from(table: BTreeMap<String, f64>) -> Result<Self, FaultError> {
        table
            .into_iter()
            .try_fold(Self::none(), |faults, (name, rate)| faults.with(&name, rate))
    }
}

impl From<Faults> for BTreeMap<String, f64> {
    fn from(faults: Faults) -> Self {
        faults
            .0
            .into_iter()
            .map(|(fault, rate)| (fault.name().to_owned(), rate))
            .collect()
    }
}

/// Draws faults: the n-th opportunity of a fault has the same outcome in every run of the same seed.
#[derive(Clone, Debug)]
pub(crate) struct FaultDraws {
    seed: u64,
    faults: Faults,
    opportunities: BTreeMap<Fault, u64>,
}

impl FaultDraws {
    pub(crate) fn new(seed: u64, faults: Faults) -> Self {
        Self {
            seed,
            faults,
            opportunities: BTreeMap::new(),
        }
    }

    pub(crate) fn happens(&mut self, fault: Fault) -> bool {
        let rate = self.faults.rate(fault);
        if rate <= 0.0 {
            return false;
        }
        let n = self.opportunities.entry(fault).or_default();
        *n += 1;
        draw(self.seed, &[name_number(fault.name()), *n]).random_bool(rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn off_by_default_and_by_name() {
        assert!(Fault::ALL.iter().all(|f| Faults::none().rate(*f) == 0.0));
        let faults: Faults = toml::from_str("camera_timeout = 0.25\nreset_lies = 1.0").expect("known names");
        assert_eq!(faults.rate(Fault::CameraTimeout), 0.25);
        assert_eq!(faults.rate(Fault::ArmAlarm), 0.0);
        let mut draws = FaultDraws::new(1, faults);
        let n = (0..4000).filter(|_| draws.happens(Fault::CameraTimeout)).count();
        assert!((900..1100).contains(&n), "{n} of 4000 at a rate of 0.25");
        assert!(draws.happens(Fault::ResetLies) && !draws.happens(Fault::ArmAlarm));
    }

    #[test]
    fn an_unknown_name_is_refused_with_the_known_ones() {
        let error = toml::from_str::<Faults>("camera_on_fire = 0.1")
            .expect_err("unknown")
            .to_string();
        assert!(
            error.contains("camera_on_fire") && error.contains("camera_dropped_frame"),
            "{error}"
        );
        let error = toml::from_str::<Faults>("arm_alarm = 3.0")
            .expect_err("no probability")
            .to_string();
        assert!(
            error.contains("arm_alarm") && error.contains("between 0 and 1"),
            "{error}"
        );
    }
}
