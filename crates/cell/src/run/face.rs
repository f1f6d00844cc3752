//! The screws of a face, event by event: the dispatcher says which arm may begin what, every burst is in the journal before it begins, and
//! what a picture, a person or a cutter has to settle waits until both arms rest.

use super::{Stop, Way};
use crate::capture::Shot;
use crate::config::CellConfig;
use crate::device::{Bit, DeviceError, Devices, DriveEnd, DriveProgram};
use crate::journal::JournalError;
use crate::ladder::{Cause, Climb, Rung};
use crate::motion::ArmMotion;
use crate::plan::{Room, Target};
use crate::record::{Act, Burst, Event, Purpose};
use crate::removal::Mover;
use crate::schedule::dispatch::{Dispatcher, Event as Told, Work};
use std::future::{Future, poll_fn};
use std::pin::Pin;
use std::task::Poll;

/// How often an arm comes back to a screw after its others: once, with another bit.
const COMES_BACK: u8 = 1;

/// How what an arm does has ended.
enum Ended {
    Burst(Burst),
    Home(Result<(), DeviceError>),
}

/// What an arm does.
struct Pending<'a> {
    ticket: u32,
    /// Number of the screw among the targets; `None` on the way home.
    screw: Option<usize>,
    future: Pin<Box<dyn Future<Output = Ended> + 'a>>,
}

/// What is known of a screw that did not come out at once.
struct Tried<'a> {
    climb: Climb<'a>,
    cause: Cause,
    /// A picture, a person or a cutter is next.
    waits: bool,
}

impl Tried<'_> {
    /// What the ladder says next; it is used with that.
    fn next(&mut self, bursts: usize, first: DriveProgram) -> DriveProgram {
        let rung = self.climb.next(self.cause, bursts);
        rung.as_ref().and_then(Rung::program).unwrap_or(first)
    }
}

/// What arms need, while the program goes on writing its journal.
struct Beside<'a> {
    devices: &'a Devices,
    motions: &'a [Option<ArmMotion>],
    config: &'a CellConfig,
}

impl<'a> Beside<'a> {
    fn mover(&self, arm: usize, room: Option<&'a Room>) -> Option<Mover<'a>> {
        Mover::of(self.devices, self.config, self.motions, arm, room)
    }

    fn burst(&self, ticket: u32, screw: usize, target: &'a Target, program: DriveProgram) -> Option<Pending<'a>> {
        let mover = self.mover(target.place.arm(), target.room.as_ref())?;
        let burst = async move { Ended::Burst(mover.burst(&target.place, program).await) };
        Some(Pending {
            ticket,
            screw: Some(screw),
            future: Box::pin(burst),
        })
    }

    fn home(&self, ticket: u32, arm: usize) -> Option<Pending<'a>> {
        let mover = self.mover(arm, None)?;
        Some(Pending {
            ticket,
            screw: None,
            future: Box::pin(async move { Ended::Home(mover.home().await) }),
        })
    }
}

impl Way<'_> {
    /// Drives at all targets of the face that was looked at last, both arms at the same time where each has its own room.
    ///
    /// Rungs of the ladder that press harder or longer follow at once; another bit is mounted when the arm has done its other screws; all
    /// else waits until both arms rest. An arm that does not stand ready after a burst ends the work side by side: the other one goes home, and
    /// what is left is done one after the other.
    pub(super) async fn drive_out(&mut self, targets: &[Target], shot: &Shot) -> Result<(), Stop> {
        let (devices, motions) = (self.runner.devices.clone(), self.runner.motions.clone());
        let (config, ladder) = (self.runner.config.clone(), self.runner.config.ladder.clone());
        let cell = Beside {
            devices: &devices,
            motions: &motions,
            config: &config,
        };
        let hands = Hands::of(targets, &motions);
        let mut dispatcher = hands.dispatcher(targets);
        let mut tried: Vec<Option<Tried<'_>>> = targets.iter().map(|_| None).collect();
        let mut is_begun = vec![false; targets.len()];
        let mut pending: [Option<Pending<'_>>; 2] = [None, None];
        let mut stop: Option<Stop> = None;
        let mut trouble: Option<usize> = None;
        let mut told = Told::Begin;
        loop {
            let halts = stop.is_some() || trouble.is_some();
            let commands = if halts { Vec::new() } else { dispatcher.step(told) };
            for command in commands {
                match command.work {
                    Work::Drive { arm: side, screw, .. } if stop.is_none() => {
                        let target = &targets[screw];
                        if !is_begun[screw] {
                            self.observer
                                .screw(is_begun.iter().filter(|b| **b).count(), targets.len());
                        }
                        is_begun[screw] = true;
                        let program = match &mut tried[screw] {
                            Some(tried) => tried.next(self.bursts(target.found), config.drive.first),
                            None => config.drive.first,
                        };
                        match self.begin_burst(target).await {
                            Ok(()) => pending[side] = cell.burst(command.ticket, screw, target, program),
                            Err(error) => stop = Some(error),
                        }
                    }
                    Work::Withdraw { arm: side } => {
                        pending[side] = cell.home(command.ticket, hands.arms[side]);
                    }
                    // one face is all that there is to this plan
                    _ => {}
                }
            }
            // what is under way is seen to its end, whatever came up meanwhile
            let Some((side, done, ended)) = next_of(&mut pending).await else {
                break;
            };
            told = Told::Done(done.ticket);
            let (screw, ended) = match (ended, done.screw) {
                (Ended::Burst(burst), Some(screw)) => (screw, burst),
                (Ended::Home(Err(error)), _) => {
                    stop.get_or_insert(error.into());
                    continue;
                }
                _ => continue,
            };
            let target = &targets[screw];
            let (bit, cause, failed) = (
                ended.program.map(|p| p.bit),
                Cause::of(ended.end),
                ended.error.is_some(),
            );
            // what is tried for its cover's sake alone and is not met is no screw
            let not_driven = ended.program.is_none() || ended.end == Some(DriveEnd::MissedHead);
            self.end_burst(target, ended)?;
            let is_none = not_driven && self.is_doubtful(target.found) && !self.may_be_searched_around(target.found);
            if failed && self.is_in_trouble(target).await {
                trouble = Some(screw);
            }
            let Some(cause) = cause else { continue };
            let bursts = self.bursts(target.found);
            let tried = tried[screw].get_or_insert_with(|| Tried {
                climb: Climb::new(&ladder),
                cause,
                waits: false,
            });
            tried.cause = cause;
            let next = tried.climb.peek(cause, bursts);
            let halts = stop.is_some() || trouble.is_some();
            match next {
                None => {}
                Some(Rung::Drive { program }) if is_at_the_screw(cause) && program.bit != Bit::Mill && !halts => {
                    if bit != Some(program.bit) && dispatcher.comes_back(done.ticket) {
                        told = Told::Failed(done.ticket);
                        continue;
                    }
                    let program = tried.next(bursts, config.drive.first);
                    match self.begin_burst(target).await {
                        Ok(()) => {
                            pending[side] = cell.burst(done.ticket, screw, target, program);
                            told = Told::Begin; // nothing has ended
                        }
                        Err(error) => stop = Some(error),
                    }
                }
                Some(_) => tried.waits = !is_none,
            }
        }
        if let Some(screw) = trouble {
            self.put_right(&targets[screw]).await?;
        }
        if let Some(stop) = stop {
            return Err(stop);
        }
        if trouble.is_some() {
            // what was to be come back to has waited long enough
            for tried in tried.iter_mut().flatten() {
                tried.waits |= tried.climb.peek(tried.cause, 0).is_some();
            }
            let left = targets.iter().zip(&is_begun).filter(|(_, is_begun)| !**is_begun);
            let left: Vec<Target> = left
                .map(|(target, _)| Target {
                    room: None,
                    ..target.clone()
                })
                .collect();
            Box::pin(self.drive_out(&left, shot)).await?;
        }
        // when a missed screw has come out its cover is pulled at before anything is searched around
        let pulls_first = |way: &Self| {
            let again = [Purpose::Missed, Purpose::LastTry, Purpose::Search];
            let face = way.record.faces.last();
            face.is_some_and(|face| again.contains(&face.purpose) && face.removed() > 0)
        };
        for (target, tried) in targets.iter().zip(tried) {
            if pulls_first(self) && !self.is_met(target.found) {
                continue;
            }
            let stands = self.stands(target.found);
            if let Some(tried) = tried.filter(|t| t.waits && stands) {
                self.home().await?;
                self.climb(target, shot, tried.climb, tried.cause).await?;
            }
        }
        Ok(())
    }

    /// True while the last burst at a find of the face that is being worked on has not taken it out.
    fn stands(&self, found: usize) -> bool {
        let attempts = self.record.faces.last().into_iter().flat_map(|f| &f.attempts);
        attempts.filter(|a| a.found == found).all(|a| !a.removed())
    }

    /// Writes down that a burst is about to begin.
    pub(super) async fn begin_burst(&mut self, target: &Target) -> Result<(), Stop> {
        let arm = self.arm_name(target.place.arm());
        let burst = self.bursts(target.found);
        let (found, aim) = (target.found, target.place.tip());
        self.begin(Act::Drive { found, arm, aim, burst }).await
    }

    /// Writes down how a burst ended.
    pub(super) fn end_burst(&mut self, target: &Target, burst: Burst) -> Result<(), JournalError> {
        let arm = self.arm_name(target.place.arm());
        let found = target.found;
        if let Some(error) = &burst.error {
            self.observer.note(error);
        }
        self.log(Event::Driven { found, arm, burst })
    }

    /// True if the arm does not stand ready after a burst that failed.
    pub(super) async fn is_in_trouble(&self, target: &Target) -> bool {
        match self.mover(target.place.arm()) {
            Some(mover) => mover.ready().await.is_err(),
            None => false,
        }
    }

    /// Clears what can be cleared and draws the bit back, the other arms at rest: an arm that does not stand ready again is a matter for a
    /// person, not for the next screw.
    pub(super) async fn put_right(&mut self, target: &Target) -> Result<(), Stop> {
        let arm = target.place.arm();
        self.gate().await?;
        for other in (0..self.runner.devices.arms.len()).filter(|other| *other != arm) {
            if let Some(mover) = self.mover(other) {
                mover.home().await?;
            }
        }
        if let Some(mover) = self.mover(arm) {
            mover.recover().await?;
            mover.withdraw(&target.place).await?;
        }
        Ok(())
    }

    fn arm_name(&self, arm: usize) -> String {
        let arm = self.runner.devices.arms.get(arm);
        arm.map(|arm| arm.robot.name().to_owned()).unwrap_or_default()
    }
}

/// True for causes that the arm can do something about where it stands; the others need a picture.
fn is_at_the_screw(cause: Cause) -> bool {
    matches!(cause, Cause::CamOut | Cause::Seized)
}

/// Which arm is which for the dispatcher: from right to left.
struct Hands {
    /// Numbers of the arms.
    arms: [usize; 2],
    /// Which of them begins.
    first: usize,
}

impl Hands {
    fn of(targets: &[Target], motions: &[Option<ArmMotion>]) -> Self {
        let mut arms: Vec<usize> = targets.iter().map(|t| t.place.arm()).collect();
        arms.dedup();
        let first = arms.first().copied().unwrap_or(0);
        let other = arms.iter().copied().find(|arm| *arm != first);
        let other = other.unwrap_or_else(|| usize::from(first == 0));
        let is_right = |arm: usize| motions.get(arm).and_then(Option::as_ref).and_then(ArmMotion::is_right);
        if is_right(first) == Some(false) || is_right(other) == Some(true) {
            Self {
                arms: [other, first],
                first: 1,
            }
        } else {
            Self {
                arms: [first, other],
                first: 0,
            }
        }
    }

    fn dispatcher(&self, targets: &[Target]) -> Dispatcher {
        let of_arm = |arm: usize| {
            let own = targets.iter().enumerate().filter(|(_, t)| t.place.arm() == arm);
            own.map(|(k, t)| (k, t.room.as_ref().map(|room| room.reach))).collect()
        };
        Dispatcher::at_face(self.arms.map(of_arm), self.first, COMES_BACK)
    }
}

/// The next that ends of what is under way; `None` if nothing is.
async fn next_of<'a>(pending: &mut [Option<Pending<'a>>]) -> Option<(usize, Pending<'a>, Ended)> {
    if pending.iter().all(Option::is_none) {
        return None;
    }
    let (side, ended) = poll_fn(|context| {
        for (side, slot) in pending.iter_mut().enumerate() {
            if let Some(slot) = slot
                && let Poll::Ready(ended) = slot.future.as_mut().poll(context)
            {
                return Poll::Ready((side, ended));
            }
        }
        Poll::Pending
    })
    .await;
    let done = pending[side].take()?;
    Some((side, done, ended))
}
