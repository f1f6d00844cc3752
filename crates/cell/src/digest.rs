//! What counting needs of a finished unit, so that a shift of thousands of units is counted in seconds: written down in the transaction
//! that closes the unit, from its events and nothing else, and sealed as they are.

use crate::device::DriveEnd;
use crate::program::FaceId;
use crate::record::{Act, Assist, Event, LeftAlone, Method, Outcome, Purpose, ScrewAttempt, Times, UnitRecord};
use geometry::{Base, Point};
use serde::{Deserialize, Serialize};

/// A unit as it is counted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Digest {
    /// Number of the unit.
    pub unit: u64,
    /// What became of it; `None` while it is under way.
    pub outcome: Option<Outcome>,
    /// When it was begun, cell clock, s.
    #[serde(default)]
    pub started_s: f64,
    /// What a person did for it.
    #[serde(default)]
    pub assist: Assist,
    /// What it cost.
    #[serde(default)]
    pub method: Method,
    /// Seconds by resource.
    pub times: Times,
    /// Screws that were acted on.
    pub attempted: usize,
    /// Of these out, as far as driver and camera say.
    pub removed: usize,
    /// Of these, with more than one burst.
    pub retried: usize,
    /// Of the screws that there were: out at the first burst.
    #[serde(default)]
    pub out_at_once: usize,
    /// Out after more than that.
    #[serde(default)]
    pub out_later: usize,
    /// Still in when all was tried.
    #[serde(default)]
    pub stayed: usize,
    /// Out that were only looked for because a cover did not come off.
    #[serde(default)]
    pub found_later: usize,
    /// Scores of the finds that were acted on.
    pub scores_acted_on: Vec<f64>,
    /// Scores of the finds that were left alone in doubt.
    pub scores_in_doubt: Vec<f64>,
    /// What the journal says was done to it, in order.
    pub claims: Vec<Claim>,
}

/// An intent of the journal, with the time until the event that answers it: when a physical action may have happened, and whether the journal says
/// that one did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Claim {
    /// Face that stood before the camera.
    pub face: Option<FaceId>,
    /// Where the bit was sent; `None` for a pull.
    pub aim: Option<Point<Base>>,
    /// Arm that was sent there; `None` for a pull, and in journals of before arms worked at the same time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// What was pulled at; `None` for a burst.
    pub cover: Option<String>,
    /// Time of the intent, cell clock, s.
    pub from_s: f64,
    /// Time of the event that answers it or shows that none will; `None`: there is none yet.
    pub until_s: Option<f64>,
    /// True if the journal says how it ended.
    pub done: bool,
}

impl Digest {
    /// Of a record without what was done: enough for rates and times.
    pub fn of(record: &UnitRecord) -> Self {
        let attempts: Vec<&ScrewAttempt> = record.attempts().collect();
        let found = || {
            let looks = record.faces.iter().filter(|f| f.purpose == Purpose::Work);
            looks.flat_map(|f| &f.found)
        };
        let scores = |left: Option<LeftAlone>| {
            let of = found().filter(|f| f.left_alone == left);
            of.map(|f| f.score).collect()
        };
        let first = |a: &&&ScrewAttempt| a.bursts.first().and_then(|b| b.end) == Some(DriveEnd::Removed);
        let removed = attempts.iter().filter(|a| a.removed()).count();
        let out_at_once = attempts.iter().filter(|a| a.removed()).filter(first).count();
        Self {
            unit: record.unit,
            outcome: record.outcome.clone(),
            started_s: record.started_s,
            assist: record.assist,
            method: record.method,
            times: record.times,
            attempted: attempts.len(),
            removed,
            out_at_once,
            out_later: removed - out_at_once,
            stayed: attempts.iter().filter(|a| !a.removed() && !a.absent()).count(),
            found_later: record.found_later(),
            retried: attempts.iter().filter(|a| a.retries() > 0).count(),
            scores_acted_on: scores(None),
            scores_in_doubt: scores(Some(LeftAlone::Review)),
            claims: Vec::new(),
        }
    }

    /// Of a unit's events.
    pub fn from_events(unit: u64, started_s: f64, events: &[(f64, Event)]) -> Self {
        Self {
            claims: claims(events),
            ..Self::of(&UnitRecord::from_events(unit, started_s, events))
        }
    }
}

/// The intents to act on a unit, with their ends. Two arms may drive at the same time, each answers for itself.
fn claims(events: &[(f64, Event)]) -> Vec<Claim> {
    let (mut claims, mut face) = (Vec::<Claim>::new(), None);
    // numbers of the claims that are open, with their screw
    let mut open: Vec<(usize, Option<usize>)> = Vec::new();
    for (t_s, event) in events {
        match event {
            Event::Driven { found, arm, burst } => {
                let is_it = |(k, screw): &(usize, Option<usize>)| {
                    *screw == Some(*found) && claims[*k].arm.as_ref() == Some(arm)
                };
                if let Some(at) = open.iter().position(is_it) {
                    end(&mut claims[open.remove(at).0], *t_s, burst.end.is_some());
                }
            }
            Event::Intent {
                act: Act::Drive { .. }, ..
            }
            | Event::Recovery { .. }
            | Event::LaidAside
            | Event::State { .. } => {}
            other => {
                for (k, _) in open.drain(..) {
                    let is_pull = claims[k].cover.is_some();
                    end(&mut claims[k], *t_s, is_pull && matches!(other, Event::Pulled { .. }));
                }
            }
        }
        let (aim, arm, cover, screw) = match event {
            Event::Presented { face: now } => {
                face = Some(now.clone());
                continue;
            }
            Event::Intent {
                act: Act::Drive { aim, arm, found, .. },
            } => (Some(*aim), Some(arm.clone()), None, Some(*found)),
            Event::Intent {
                act: Act::Pull { cover },
            } => (None, None, Some(cover.clone()), None),
            _ => continue,
        };
        open.push((claims.len(), screw));
        claims.push(Claim {
            face: face.clone(),
            aim,
            arm,
            cover,
            from_s: *t_s,
            until_s: None,
            done: false,
        });
    }
    claims
}

fn end(claim: &mut Claim, t_s: f64, done: bool) {
    claim.until_s = Some(t_s);
    claim.done = done;
}
