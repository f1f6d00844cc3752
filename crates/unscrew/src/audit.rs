//! Do the journal and the world agree? Physical actions counted from the simulated world's own log, so that a wrong journal cannot hide.

use cell::device::DriveEnd;
use cell::digest::{Claim, Digest};
use cell::motion::CellDrawing;
use geometry::{Base, Point};
use serde::Serialize;
use sim::{Action, ActionKind};
use std::collections::BTreeMap;

/// Times of journal and world are of the same clock; rounding, s.
const ROUNDING_S: f64 = 1e-6;
/// The bit has gone to the same place again if it came so near, mm.
const SAME_PLACE_MM: f64 = 3.0;
/// The same for another arm's bit: what the feet may stand off the drawing comes on top, mm.
const SAME_PLACE_OF_ANOTHER_MM: f64 = 7.0;

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

/// Where the bit was sent, in the first arm's base as drawn: each arm names places in its own.
fn place(claim: &Claim) -> Option<Point<Base>> {
    let drawing = CellDrawing::default();
    let foot_mm = drawing.arms.iter().find(|arm| Some(&arm.name) == claim.arm.as_ref());
    let [x_mm, y_mm, z_mm] = foot_mm.map_or([0.0; 3], |arm| arm.foot_mm);
    let aim = claim.aim?;
    Some(Point::new(aim.x_mm() + x_mm, aim.y_mm() + y_mm, aim.z_mm() + z_mm))
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
            let within_mm = if later.claim.arm == claim.arm {
                SAME_PLACE_MM
            } else {
                SAME_PLACE_OF_ANOTHER_MM
            };
            let near = |(a, b): (Point<Base>, Point<Base>)| a.distance_mm(b) < within_mm;
            let same_place = later.claim.face == claim.face && place(later.claim).zip(place(claim)).is_some_and(near);
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
        drive_by("arm_a", 0, x)
    }

    fn drive_by(arm: &str, found: usize, x: f64) -> Event {
        Event::Intent {
            act: Act::Drive {
                found,
                arm: arm.into(),
                aim: Point::new(x, 0.0, 500.0),
                burst: 0,
            },
        }
    }

    fn done() -> Event {
        done_by("arm_a", 0)
    }

    fn done_by(arm: &str, found: usize) -> Event {
        Event::Driven {
            found,
            arm: arm.into(),
            burst: cell::record::Burst {
                program: None,
                end: Some(DriveEnd::Removed),
                error: None,
                aim: Point::new(0.0, 0.0, 500.0),
                second_look: None,
                places_left: None,
                time_s: 1.0,
            },
        }
    }

    fn removed(t_s: f64) -> Action {
        removed_by("arm_a", t_s)
    }

    fn removed_by(arm: &str, t_s: f64) -> Action {
        Action {
            t_s,
            unit: Some(0),
            kind: ActionKind::Drive {
                arm: arm.into(),
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

    #[test]
    fn each_of_two_arms_answers_for_itself() {
        let both = [
            (1.0, drive_by("arm_a", 0, 0.0)),
            (1.5, drive_by("arm_b", 1, 400.0)),
            (3.0, done_by("arm_a", 0)),
            (3.1, drive_by("arm_a", 2, 50.0)),
            (4.0, done_by("arm_b", 1)),
            (5.0, done_by("arm_a", 2)),
        ];
        let (a, b) = (|t_s| removed_by("arm_a", t_s), |t_s| removed_by("arm_b", t_s));
        assert_eq!(audited(&both, &[a(2.9), b(3.9), a(4.9)]), (3, 0, 0));
        // one arm's burst does not stand for the other's
        assert_eq!(audited(&both, &[a(2.9), a(4.9)]), (2, 0, 1));
        assert_eq!(audited(&both, &[a(2.9), b(3.5), b(3.9), a(4.9)]), (4, 1, 0));
        // a crash in the middle of both
        let crash = [
            both[0].clone(),
            both[1].clone(),
            (9.0, Event::Resumed),
            (12.0, drive_by("arm_a", 0, 400.3)),
        ];
        assert_eq!(audited(&crash, &[a(2.9), b(3.9)]), (2, 0, 0));
        // and one that was out already is driven at again
        let crash = [
            both[0].clone(),
            both[1].clone(),
            (9.0, Event::Resumed),
            (12.0, drive_by("arm_a", 0, 0.3)),
            (14.0, done_by("arm_a", 0)),
        ];
        assert_eq!(audited(&crash, &[a(2.9), b(3.9), a(13.0)]), (3, 1, 0));
    }
}
