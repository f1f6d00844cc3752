//! Do the journal and the world agree? Physical actions counted from the simulated world's own log, so that a wrong journal cannot hide.

use cell::device::DriveEnd;
use cell::digest::{Claim, Digest};
use geometry::{Base, Point};
use serde::Serialize;
use sim::{Action, ActionKind};
use std::collections::BTreeMap;

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

/// An intent of the journal, and what the world did in it.
struct Slot<'a> {
    claim: &'a Claim,
    seen: usize,
    took_effect: bool,
}

/// Compares a run's journal with its world.
pub fn audit(units: &[Digest], world: &[Action]) -> Actions {
    let mut of_unit = BTreeMap::<u64, Vec<&Action>>::new();
    for action in world {
        if let Some(unit) = action.unit {
            // the journal counts units from 1, the world from 0
            of_unit.entry(unit + 1).or_default().push(action);
        }
    }
    let mut total = Actions::default();
    for unit in units {
        let actions = of_unit.remove(&unit.unit).unwrap_or_default();
        compare(&unit.claims, &actions, &mut total);
    }
    // what was done to units that the journal does not know
    for actions in of_unit.values() {
        compare(&[], actions, &mut total);
    }
    total
}

fn compare(claims: &[Claim], world: &[&Action], total: &mut Actions) {
    let mut slots: Vec<Slot<'_>> = claims
        .iter()
        .map(|claim| Slot {
            claim,
            seen: 0,
            took_effect: false,
        })
        .collect();
    for action in world {
        let (pull, by, effect) = match &action.kind {
            ActionKind::Drive { arm, end, .. } => (false, Some(arm), *end == DriveEnd::Removed),
            ActionKind::Pull { off, .. } => (true, None, *off),
            _ => continue,
        };
        total.actions_total += 1;
        let within = |s: &&mut Slot<'_>| {
            s.claim.cover.is_some() == pull
                && (s.claim.arm.is_none() || s.claim.arm.as_ref() == by)
                && s.claim.from_s <= action.t_s + ROUNDING_S
                && s.claim.until_s.is_none_or(|until_s| action.t_s <= until_s + ROUNDING_S)
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
        let claim = slot.claim;
        total.actions_repeated += slot.seen.saturating_sub(1);
        total.actions_lost += usize::from(claim.done && slot.seen == 0);
        // what a crash left open and the world had done must not be done again
        let again = |later: &Slot<'_>| {
            let near = |(a, b): (Point<Base>, Point<Base>)| a.distance_mm(b) < SAME_PLACE_MM;
            let same_place = later.claim.face == claim.face && later.claim.aim.zip(claim.aim).is_some_and(near);
            let same_cover = claim.cover.is_some() && later.claim.cover == claim.cover;
            later.seen > 0 && (same_place || same_cover)
        };
        let left_open = !claim.done && slot.took_effect;
        total.actions_repeated += usize::from(left_open && slots[k + 1..].iter().any(again));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cell::Journal;
    use cell::record::{Act, Event};

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
        let a = audit(&journal.digests(false).expect("units"), world);
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
