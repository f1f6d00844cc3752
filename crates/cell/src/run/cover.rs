//! Covers: pulled at, and what is tried when one stays.

use super::{Stop, Way};
use crate::device::{DriveEnd, TagValue, jobs, tags};
use crate::look;
use crate::plan;
use crate::program::{FaceId, Step, Work};
use crate::record::{
    Act, CoverRecord, Event, FaceRecord, Found, LeftAlone, NgReason, Outcome, PullEnd, Purpose, ScrewAttempt, SeenBy,
    Verdict,
};

/// Looks at a face at most to try what is left on it, and as many to search around it.
const LAST_TRIES: usize = 3;

/// What was tried at a screw that does not come out; more says more surely that there is one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Tried {
    /// The bit was driven at it and met nothing.
    Once,
    /// Nor around it.
    Around,
    /// It met the recess, or a device failed.
    Met,
}

impl Tried {
    fn at(attempt: &ScrewAttempt) -> Self {
        match attempt.end() {
            Some(DriveEnd::MissedHead) if !attempt.met() && attempt.searched() => Self::Around,
            Some(DriveEnd::MissedHead) if !attempt.met() => Self::Once,
            _ => Self::Met,
        }
    }
}

impl Way<'_> {
    /// Pulls a cover; if it stays, looks for missed screws on the faces that hold it, asks a person if one may be asked, tries what is left, and pulls
    /// again whenever a screw has come out.
    pub(super) async fn cover(&mut self, index: usize, step: &Step) -> Result<(), Stop> {
        let Work::Cover { cover, held_by, .. } = &step.work else {
            return Ok(());
        };
        if self.pull(index, step).await? == PullEnd::Off {
            return Ok(());
        }
        self.observer.note(&format!(
            "the {cover} cover does not come off: looking for missed screws"
        ));
        self.log(Event::Recovery { on: true })?;
        let mut pulled_again = false;
        // where a head was in doubt it is the likeliest; of faces alike, the one that stands there costs no turn
        let mut faces: Vec<(&FaceId, f64)> = held_by.iter().map(|face| (face, self.doubt(face))).collect();
        let stands_there = |face: &FaceId| *face == step.present;
        faces.sort_by(|a, b| (b.1.total_cmp(&a.1)).then(stands_there(b.0).cmp(&stands_there(a.0))));
        // a face without a record has no screws on this product, or cannot be presented yet
        faces.retain(|(face, _)| self.record.faces.iter().any(|f| f.face == **face));
        // A screw that is known to stand holds the cover: looking for others would not free it. One that the bit has not met may be none, unless it was
        // searched around.
        let asked = self.may_ask().then_some(Purpose::Clicked);
        for purpose in [
            Some(Purpose::Missed),
            asked,
            Some(Purpose::LastTry),
            Some(Purpose::Search),
        ]
        .into_iter()
        .flatten()
        {
            let last = matches!(purpose, Purpose::LastTry | Purpose::Search);
            // the grip may have slipped: that is likelier than what is left, and a bounded pull may be tried a second time
            if last && !pulled_again {
                if self.pull(index, step).await? == PullEnd::Off {
                    return Ok(self.log(Event::Recovery { on: false })?);
                }
                pulled_again = true;
            }
            if let Some(known) = self.known_standing(held_by, Tried::Around).filter(|_| last) {
                return Err(Stop::Decided(known));
            }
            for (face, _) in &faces {
                if purpose == Purpose::Search && !self.is_to_be_searched(face) {
                    continue;
                }
                loop {
                    if let Some(known) = self.known_standing(held_by, Tried::Met) {
                        return Err(Stop::Decided(known));
                    }
                    let out = self.screws(index, step, face, purpose).await?;
                    // where driver and picture contradict each other the cover tells
                    let mut attempts = self.record.faces.last().into_iter().flat_map(|f| &f.attempts);
                    if out == 0 && !attempts.any(ScrewAttempt::claimed) {
                        break;
                    }
                    pulled_again = true;
                    if self.pull(index, step).await? == PullEnd::Off {
                        return Ok(self.log(Event::Recovery { on: false })?);
                    }
                    // one that nobody saw is seldom alone
                    let looks = self.record.faces.iter().filter(|f| f.face == **face);
                    if !last || looks.filter(|f| f.purpose == purpose).count() >= LAST_TRIES {
                        break;
                    }
                }
            }
        }
        Err(Stop::Decided(self.known_standing(held_by, Tried::Once).unwrap_or_else(
            || Outcome::Ng {
                reason: NgReason::CoverStuck,
                detail: format!("the {cover} cover did not come off, and no screw that holds it was seen"),
            },
        )))
    }

    /// The highest score of the heads that were left for a person when a face was worked on; 0 without any.
    fn doubt(&self, face: &FaceId) -> f64 {
        let worked_on = |f: &&FaceRecord| f.face == *face && f.purpose == Purpose::Work;
        let worked_on = self.record.faces.iter().rev().find(worked_on);
        let found = worked_on.into_iter().flat_map(|f| &f.found);
        let doubtful = found.filter(|f| f.verdict == Verdict::Review);
        doubtful.map(|f| f.score).fold(0.0, f64::max)
    }

    /// True if there is a head on a face that is likely enough to be searched around: the bit has not met it, and nothing has settled since what it is.
    fn is_to_be_searched(&self, face: &FaceId) -> bool {
        let looks = || self.record.faces.iter().filter(|f| f.face == *face);
        let attempts =
            || looks().flat_map(|look| look.attempts.iter().filter_map(|a| Some((look.found.get(a.found)?, a))));
        let is_settled = |find: &Found| attempts().any(|(other, a)| (a.removed() || a.searched()) && other.is_of(find));
        looks().any(|look| {
            look.not_met().any(|(find, attempt)| {
                let alone = look::by_picture_alone(find, look.purpose, &self.runner.config);
                look::is_worth_a_search(alone, Purpose::Search) && !attempt.absent() && !is_settled(find)
            })
        })
    }

    /// A screw on these faces that is known to stand, as the reason of a failure.
    ///
    /// # Arguments
    /// * `least` – what must have been tried at it for that.
    fn known_standing(&self, faces: &[FaceId], least: Tried) -> Option<Outcome> {
        for face in faces {
            let Some(last) = self.record.faces.iter().rev().find(|f| f.face == *face) else {
                continue;
            };
            // what was tried for the cover's sake alone and not met is no screw
            let odds = look::odds(&self.runner.config, last.purpose);
            let is_none = |a: &&ScrewAttempt| {
                let doubtful = last
                    .found
                    .get(a.found)
                    .is_some_and(|f| plan::is_doubtful(f.score, odds));
                doubtful && !a.met()
            };
            let failed = last
                .attempts
                .iter()
                .find(|a| !a.removed() && a.still_there != Some(false) && Tried::at(a) >= least && !is_none(a));
            if let Some(attempt) = failed {
                let (reason, what) = match attempt.end() {
                    Some(DriveEnd::Seized) => (NgReason::ScrewSeized, "did not turn"),
                    Some(DriveEnd::CamOut) => (NgReason::ScrewCamOut, "let the bit slip"),
                    Some(DriveEnd::MissedHead | DriveEnd::Removed) => (NgReason::ScrewMissed, "was not met by the bit"),
                    Some(DriveEnd::TimeOut) | None => (NgReason::DeviceFault, "could not be worked on"),
                };
                let bursts = attempt.bursts.len();
                return Some(Outcome::Ng {
                    reason,
                    detail: format!("{face}: a screw {what} in {bursts} burst(s), its cover stays"),
                });
            }
            let not_met = |f: &Found| f.left_alone == Some(LeftAlone::NotMet);
            if Tried::Around >= least && last.found.iter().any(not_met) {
                return Some(Outcome::Ng {
                    reason: NgReason::ScrewMissed,
                    detail: format!("{face}: a screw was not met by the bit, its cover stays"),
                });
            }
            let barred = [
                LeftAlone::HullEdge,
                LeftAlone::HullOutside,
                LeftAlone::NoDepth,
                LeftAlone::Bent,
                LeftAlone::Unreachable,
                LeftAlone::Collision,
            ];
            let screw = last
                .found
                .iter()
                .find(|f| !plan::is_doubtful(f.score, odds) && f.left_alone.is_some_and(|why| barred.contains(&why)));
            if let Some((screw, why)) = screw.and_then(|f| Some((f, f.left_alone?))) {
                let why = screw.refusal.clone().unwrap_or_else(|| why.to_string());
                return Some(Outcome::Ng {
                    reason: NgReason::ScrewOutOfReach,
                    detail: format!("{face}: a screw was left alone ({why}), its cover stays"),
                });
            }
        }
        None
    }

    /// One bounded pull at a cover; lays it aside if it comes off.
    async fn pull(&mut self, index: usize, step: &Step) -> Result<PullEnd, Stop> {
        let Work::Cover {
            cover, by, takes_along, ..
        } = &step.work
        else {
            return Ok(PullEnd::Stuck);
        };
        self.home().await?;
        if self.laying.is_none() {
            self.lay_aside().await?; // what the gripper may not hold any more
        }
        self.turn(&step.present).await?;
        self.laid_aside().await?;
        let begin_s = self.now_s();
        self.begin(Act::Pull { cover: cover.clone() }).await?;
        let arm = self.runner.devices.arms.iter().position(|arm| arm.robot.name() == by);
        if let Some(mover) = arm.and_then(|arm| self.mover(arm)) {
            mover.ready().await?;
            mover.job(&jobs::pull(cover)).await?;
        }
        let holding = self.runner.devices.io.read(tags::GRIPPER_HOLDING).await? == TagValue::Bool(true);
        let end = if holding { PullEnd::Off } else { PullEnd::Stuck };
        self.log(Event::Pulled {
            cover: CoverRecord {
                step: index,
                cover: cover.clone(),
                end,
                seen_by: SeenBy::Signal,
                takes_along: takes_along.clone(),
                time_s: self.now_s() - begin_s,
            },
            frame: None,
        })?;
        if holding {
            self.lay_aside().await?;
        }
        Ok(end)
    }

    /// Begins to lay the cover aside that the gripper holds, if it holds one. The table may turn and a unit may leave meanwhile; a picture, a
    /// screw and another pull wait for [`laid_aside`](Self::laid_aside).
    pub(super) async fn lay_aside(&mut self) -> Result<(), Stop> {
        self.laid_aside().await?;
        let io = &self.runner.devices.io;
        if io.read(tags::GRIPPER_HOLDING).await? != TagValue::Bool(true) {
            return Ok(());
        }
        let pullers = self.runner.program.steps.iter().filter_map(|step| match &step.work {
            Work::Cover { by, .. } => Some(by),
            Work::Screws { .. } => None,
        });
        let arms = &self.runner.devices.arms;
        let arm = pullers
            .filter_map(|by| arms.iter().position(|arm| arm.robot.name() == by))
            .next();
        if let Some((arm, mover)) = arm.and_then(|arm| Some((arm, self.mover(arm)?))) {
            let ticket = mover.start(jobs::DROP).await?;
            self.laying = Some((arm, ticket));
        }
        Ok(())
    }

    /// Waits until a cover is laid aside, if one is being laid.
    pub(super) async fn laid_aside(&mut self) -> Result<(), Stop> {
        let Some((arm, ticket)) = self.laying.take() else {
            return Ok(());
        };
        if let Some(mover) = self.mover(arm) {
            mover.finish(ticket, jobs::DROP).await?;
        }
        Ok(self.log(Event::LaidAside)?)
    }
}
