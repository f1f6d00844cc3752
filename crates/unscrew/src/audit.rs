//! Do the journal and the world agree? Physical actions counted from the simulated world's own log, so that a wrong journal cannot hide.

use anyhow::Result;
use cell::device::DriveEnd;
use cell::journal::Journal;
use cell::program::FaceId;
use cell::record::{Act, Event};
use geometry::{Base, Point};
use serde::Serialize;
use sim::{Action, ActionKind};

/// Times of journal and world are of the same clock; rounding, s.
const ROUNDING_S: f64 = 1e-6;
/// The bit has gone to the same place again if it came so near, mm.
const SAME_PLACE_MM: f64 = 3.0;

/// Physical actions on units: bursts of the driver and pulls at covers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Actions {
    /// That the world has seen.
    pub actions_total: usize,
    /// Of these, those that the journal has no intent for, the second of one intent, and those that did again after a crash what was done.
    pub actions_repeated: usize,
    /// That the journal calls done and the world has not seen.
    pub actions_lost: usize,
}

/// An intent of the journal with the time until its next event, and what the world did in it.
struct Slot {
    pull: bool,
    /// Face that stood before the camera.
    face: Option<FaceId>,
    /// Where the bit was sent; `None` for a pull.
    aim: Option<Point<Base>>,
    /// What was pulled at.
    cover: Option<String>,
    from_s: f64,
    until_s: f64,
    done: bool,
    seen: usize,
    took_effect: bool,
}

/// Compares a run's journal with its world.
///
/// # Errors
/// If the journal cannot be read.
pub fn audit(journal: &Journal, world: &[Action]) -> Result<Actions> {
    let mut total = Actions::default();
    for unit in journal.units()? {
        let mut slots = slots(&journal.events(unit)?);
        // the journal counts units from 1, the world from 0
        for action in world.iter().filter(|a| a.unit.map(|u| u + 1) == Some(unit)) {
            let (pull, effect) = match &action.kind {
                ActionKind::Drive { end, .. } => (false, *end == DriveEnd::Removed),
                ActionKind::Pull { off, .. } => (true, *off),
                _ => continue,
            };
            total.actions_total += 1;
            let within = |s: &&mut Slot| {
                s.pull == pull && s.from_s <= action.t_s + ROUNDING_S && action.t_s <= s.until_s + ROUNDING_S
            };
            match slots.iter_mut().rev().find(within) {
                Some(slot) => {
                    slot.seen += 1;
                    slot.took_effect |= effect;
                }
                None => total.actions_repeated += 1,
            }
        }
        for (k, slot) in slots.iter().enumerate() {
            total.actions_repeated += slot.seen.saturating_sub(1);
            total.actions_lost += usize::from(slot.done && slot.seen == 0);
            // what a crash left open and the world had done must not be done again
            let again = |later: &Slot| {
                let near = |(a, b): (Point<Base>, Point<Base>)| a.distance_mm(b) < SAME_PLACE_MM;
                let same_place = later.face == slot.face && later.aim.zip(slot.aim).is_some_and(near);
                let same_cover = slot.pull && later.cover == slot.cover;
                later.seen > 0 && later.pull == slot.pull && (same_place || same_cover)
            };
            let left_open = !slot.done && slot.took_effect;
            total.actions_repeated += usize::from(left_open && slots[k + 1..].iter().any(again));
        }
    }
    Ok(total)
}

fn slots(events: &[(f64, Event)]) -> Vec<Slot> {
    let (mut slots, mut face, mut open) = (Vec::<Slot>::new(), None, false);
    for (t_s, event) in events {
        if let (true, Some(slot)) = (open, slots.last_mut()) {
            slot.until_s = *t_s;
            slot.done = match event {
                Event::Driven { burst, .. } => burst.end.is_some(),
                Event::Pulled { .. } => true,
                _ => false,
            };
        }
        open = false;
        match event {
            Event::Presented { face: now } => face = Some(now.clone()),
            Event::Intent { act } => {
                let (aim, cover) = match act {
                    Act::Drive { aim, .. } => (Some(*aim), None),
                    Act::Pull { cover } => (None, Some(cover.clone())),
                    _ => continue,
                };
                open = true;
                slots.push(Slot {
                    pull: cover.is_some(),
                    face: face.clone(),
                    aim,
                    cover,
                    from_s: *t_s,
                    until_s: f64::INFINITY,
                    done: false,
                    seen: 0,
                    took_effect: false,
                });
            }
            _ => {}
        }
    }
    slots
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(x: f64) -> Event {
        Event::Intent {
            act: Act::Drive {
                found: 0,
                arm: "arm_a".into(),
                aim: Point::new(x, 0.0, 500.0),
                burst: 0,
            },
        }
    }

    fn done() -> Event {
        Event::Driven {
            found: 0,
            arm: "arm_a".into(),
            burst: cell::record::Burst {
                program: None,
                end: Some(DriveEnd::Removed),
                error: None,
                aim: Point::new(0.0, 0.0, 500.0),
                second_look: None,
                time_s: 1.0,
            },
        }
    }

    fn removed(t_s: f64) -> Action {
        Action {
            t_s,
            unit: Some(0),
            kind: ActionKind::Drive {
                arm: "arm_a".into(),
                screw: None,
                aim: None,
                end: DriveEnd::Removed,
                impacts_s: 0.0,
            },
        }
    }

    fn audited(events: &[(f64, Event)], world: &[Action]) -> (usize, usize, usize) {
        let folder = tempfile::tempdir().expect("folder");
        let mut journal = Journal::open(folder.path()).expect("journal");
        let unit = journal.begin_unit(0.0).expect("unit");
        for (t_s, event) in events {
            journal.append(unit, *t_s, event).expect("event");
        }
        let a = audit(&journal, world).expect("audit");
        (a.actions_total, a.actions_repeated, a.actions_lost)
    }

    #[test]
    fn what_the_journal_hides_is_counted() {
        let good = [(1.0, drive(0.0)), (3.0, done()), (3.0, drive(50.0)), (5.0, done())];
        assert_eq!(audited(&good, &[removed(2.0), removed(4.0)]), (2, 0, 0));
        // done in the journal only; done in the world only; done twice
        assert_eq!(audited(&good, &[removed(2.0)]), (1, 0, 1));
        assert_eq!(audited(&good, &[removed(0.5), removed(2.0), removed(4.0)]), (3, 1, 0));
        assert_eq!(audited(&good, &[removed(2.0), removed(2.5), removed(4.0)]), (3, 1, 0));
        // a crash in a burst: looked at and gone on, or blindly repeated
        let crash = |next: f64| {
            [
                (1.0, drive(0.0)),
                (9.0, Event::Resumed),
                (12.0, drive(next)),
                (14.0, done()),
            ]
        };
        assert_eq!(audited(&crash(80.0), &[removed(2.0), removed(13.0)]), (2, 0, 0));
        assert_eq!(audited(&crash(0.4), &[removed(2.0), removed(13.0)]), (2, 1, 0));
        assert_eq!(audited(&crash(0.4), &[removed(13.0)]), (1, 0, 0));
    }
}
