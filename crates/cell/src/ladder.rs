//! What is tried after a burst that did not take the screw out: a ladder for each cause, as data.
//!
//! Every burst ends with a cause, every cause has its own ladder, and a rung is used once a screw. The bit may slip, be pressed harder, and
//! then prove the screw seized: from there on the other ladder is climbed. What a rung does is bounded by its programme, how many there are
//! by [`Ladder::bursts_max`].

use crate::device::{Bit, DriveEnd, DriveProgram};
use serde::{Deserialize, Serialize};

/// One thing to try.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "try", rename_all = "snake_case", deny_unknown_fields)]
pub enum Rung {
    /// Drive again at the same place: pressed harder, longer, with another bit.
    Drive {
        /// With which programme.
        program: DriveProgram,
    },
    /// Look again with a region of the picture, map again, and drive there; ends the ladder if no screw is seen any more.
    LookAgain,
    /// Drive at places around the last one, farther out than the bit's cone reaches, until the bit meets something. What the bit has done nothing but
    /// miss waits for it until its cover has not come off.
    Search {
        /// Places on the ring.
        places: u32,
        /// Its radius, mm.
        radius_mm: f64,
        /// How much deeper the bit goes than to the last one, mm: what hides a head lies before it, and takes its depth for the head's.
        #[serde(default)]
        deeper_mm: f64,
    },
    /// Ask a person where in the picture the screw is, and drive there. Passed over where no person may be asked; waits like a search.
    Click,
}

impl Rung {
    /// True if it leaves more than a hole where the screw was: only where the policy and the plant's controller let it.
    pub fn is_destructive(&self) -> bool {
        matches!(self, Rung::Drive { program } if program.bit == Bit::Mill)
    }

    /// The programme that it brings along, if it does.
    pub fn program(&self) -> Option<DriveProgram> {
        match self {
            Rung::Drive { program } => Some(*program),
            _ => None,
        }
    }
}

/// What to try, by how the last burst ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ladder {
    /// The bit met nothing, or a device failed before it could.
    pub missed_head: Vec<Rung>,
    /// The bit slipped out of the recess.
    pub cam_out: Vec<Rung>,
    /// The screw did not turn within time and torque.
    pub seized: Vec<Rung>,
    /// The programme did not end in time: the screw may be out, half out or untouched, only a picture tells.
    pub time_out: Vec<Rung>,
    /// The driver says that the screw is out, a picture that it stands.
    pub still_there: Vec<Rung>,
    /// Bursts at one screw at most, whatever the ladders say.
    pub bursts_max: usize,
}

impl Default for Ladder {
    fn default() -> Self {
        let usual = DriveProgram {
            axial_force_n: 150.0,
            max_time_s: 2.5,
            max_torque_nm: 12.0,
            stroke_mm: 10.0,
            bit: Bit::Cross,
        };
        let drive = |program| Rung::Drive { program };
        let pressed = |axial_force_n, bit| DriveProgram {
            axial_force_n,
            bit,
            ..usual
        };
        let longer = |max_time_s, max_torque_nm| DriveProgram {
            max_time_s,
            max_torque_nm,
            ..pressed(400.0, Bit::Cross)
        };
        let mill = DriveProgram {
            axial_force_n: 80.0,
            max_time_s: 15.0,
            max_torque_nm: 6.0,
            stroke_mm: 4.0,
            bit: Bit::Mill,
        };
        let search = Rung::Search {
            places: 6,
            radius_mm: 0.8,
            deeper_mm: 0.0,
        };
        let farther = Rung::Search {
            places: 8,
            radius_mm: 1.5,
            deeper_mm: 2.0,
        };
        Self {
            // looking comes before searching: around what is no screw there is nothing to find
            missed_head: vec![Rung::LookAgain, search, Rung::Click, farther],
            cam_out: vec![
                drive(pressed(250.0, Bit::Cross)),
                drive(pressed(400.0, Bit::Cross)),
                drive(pressed(250.0, Bit::Extractor)),
                drive(pressed(400.0, Bit::Extractor)),
                drive(mill),
            ],
            seized: vec![
                drive(longer(6.0, 18.0)),
                drive(longer(10.0, 22.0)),
                drive(longer(10.0, 22.0)),
                drive(longer(10.0, 22.0)),
                drive(mill),
            ],
            time_out: vec![Rung::LookAgain, drive(longer(6.0, 18.0))],
            still_there: vec![Rung::LookAgain, search, drive(longer(6.0, 18.0))],
            bursts_max: 20,
        }
    }
}

impl Ladder {
    /// Every rung, for checks.
    pub fn rungs(&self) -> impl Iterator<Item = &Rung> {
        let all = [
            &self.missed_head,
            &self.cam_out,
            &self.seized,
            &self.time_out,
            &self.still_there,
        ];
        all.into_iter().flatten()
    }
}

/// Why a screw still stands after what was tried last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// See [`Ladder::missed_head`].
    MissedHead,
    /// See [`Ladder::cam_out`].
    CamOut,
    /// See [`Ladder::seized`].
    Seized,
    /// See [`Ladder::time_out`].
    TimeOut,
    /// See [`Ladder::still_there`].
    StillThere,
}

impl Cause {
    /// The cause that a burst's end names; `None` if the screw is out.
    pub fn of(end: Option<DriveEnd>) -> Option<Self> {
        match end {
            Some(DriveEnd::Removed) => None,
            Some(DriveEnd::CamOut) => Some(Self::CamOut),
            Some(DriveEnd::Seized) => Some(Self::Seized),
            Some(DriveEnd::TimeOut) => Some(Self::TimeOut),
            Some(DriveEnd::MissedHead) | None => Some(Self::MissedHead),
        }
    }
}

/// The way up for one screw: which rungs have been used.
#[derive(Clone, Debug)]
pub struct Climb<'a> {
    ladder: &'a Ladder,
    used: [usize; 5],
}

impl<'a> Climb<'a> {
    /// At the foot of every ladder.
    pub fn new(ladder: &'a Ladder) -> Self {
        Self { ladder, used: [0; 5] }
    }

    /// The next rung for a cause, which counts as used from now on; `None` if there is none left.
    ///
    /// # Arguments
    /// * `bursts` – bursts at this screw so far.
    pub fn next(&mut self, cause: Cause, bursts: usize) -> Option<Rung> {
        let rung = self.peek(cause, bursts);
        self.used[cause as usize] += usize::from(rung.is_some());
        rung
    }

    /// The same, but it does not count as used.
    pub fn peek(&self, cause: Cause, bursts: usize) -> Option<Rung> {
        if bursts >= self.ladder.bursts_max {
            return None;
        }
        let rungs = match cause {
            Cause::MissedHead => &self.ladder.missed_head,
            Cause::CamOut => &self.ladder.cam_out,
            Cause::Seized => &self.ladder.seized,
            Cause::TimeOut => &self.ladder.time_out,
            Cause::StillThere => &self.ladder.still_there,
        };
        rungs.get(self.used[cause as usize]).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_have_ladders_of_their_own_and_a_rung_is_used_once() {
        let ladder = Ladder::default();
        let mut climb = Climb::new(&ladder);
        assert_eq!(climb.next(Cause::CamOut, 1), Some(ladder.cam_out[0]));
        assert_eq!(climb.next(Cause::Seized, 2), Some(ladder.seized[0]));
        assert_eq!(climb.next(Cause::CamOut, 3), Some(ladder.cam_out[1]));
        let mut bursts = 4;
        for cause in [Cause::CamOut, Cause::Seized, Cause::MissedHead]
            .into_iter()
            .cycle()
            .take(90)
        {
            bursts += usize::from(climb.next(cause, bursts).is_some());
        }
        assert!(bursts <= ladder.bursts_max);
        assert_eq!(climb.next(Cause::CamOut, 0), None, "every rung was used");
    }

    #[test]
    fn a_ladder_is_data() {
        let text = r#"
            bursts_max = 3
            cam_out = [
                { try = "drive", program = { axial_force_n = 300.0, max_time_s = 3.0, max_torque_nm = 12.0, stroke_mm = 10.0, bit = "extractor" } },
            ]
            missed_head = [{ try = "search", places = 4, radius_mm = 1.0 }, { try = "click" }]
        "#;
        let ladder: Ladder = toml::from_str(text).expect("a ladder");
        assert_eq!(ladder.cam_out.len(), 1);
        assert_eq!(ladder.missed_head[1], Rung::Click);
        assert_eq!(
            ladder.seized,
            Ladder::default().seized,
            "what is left out keeps its default"
        );
        assert!(toml::from_str::<Ladder>("cam_out = [{ try = \"pray\" }]").is_err());
    }
}
