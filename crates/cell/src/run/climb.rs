//! Up the ladder with one screw that did not come out at once, and questions to a person.

use super::{Stop, Way};
use crate::capture::Shot;
use crate::device::{DeviceError, DriveEnd, DriveProgram, Question, TagValue, tags};
use crate::ladder::{Cause, Climb, Rung};
use crate::look;
use crate::plan::{SafeTarget, Target};
use crate::policy::{Case, Choice};
use crate::record::{Event, FaceRecord, Purpose, Verdict};

/// Places on a ring, across the approach, mm.
fn ring(places: u32, radius_mm: f64) -> impl Iterator<Item = [f64; 2]> {
    (0..places).map(move |step| {
        let angle = std::f64::consts::TAU * f64::from(step) / f64::from(places);
        [radius_mm * angle.cos(), radius_mm * angle.sin()]
    })
}

impl Way<'_> {
    /// Tries one rung after the other until the screw is out, is not there, or nothing is left. The other arm rests.
    ///
    /// # Arguments
    /// * `climb` – which rungs have been used.
    pub(super) async fn climb(
        &mut self,
        target: &Target,
        shot: &Shot,
        mut climb: Climb<'_>,
        mut cause: Cause,
    ) -> Result<(), Stop> {
        let first = self.runner.config.drive.first;
        let (found, mut place) = (target.found, target.place);
        self.log(Event::Recovery { on: true })?;
        let mut not_met = false;
        while let Some(rung) = climb.next(cause, self.bursts(found)) {
            // What is tried for its cover's sake alone and is not met is none; what else may be none is looked at again, but not searched for.
            if not_met && self.is_doubtful(found) && !self.may_be_searched_around(found) {
                break;
            }
            if matches!(rung, Rung::Search { .. }) && !self.may_be_searched_around(found) {
                continue;
            }
            // What was not met where a second picture showed it either is seldom a screw: its cover tells.
            if matches!(rung, Rung::Search { .. } | Rung::Click) && self.waits_for_its_cover(found) {
                continue;
            }
            let end = match rung {
                Rung::Drive { program } if rung.is_destructive() => match self.mill(found, place, program).await? {
                    Some(end) => end,
                    None => break,
                },
                Rung::Drive { program } => self.burst(found, place, program, None, None).await?,
                Rung::Search {
                    places,
                    radius_mm,
                    deeper_mm,
                } => {
                    let ring = ring(places, radius_mm);
                    let (end, met_at) = self.search(found, place, first, ring, deeper_mm).await?;
                    // what follows is done where the bit has met it
                    place = met_at.unwrap_or(place);
                    end
                }
                Rung::LookAgain | Rung::Click => {
                    let asks = rung == Rung::Click;
                    if asks && !self.may_ask() {
                        continue;
                    }
                    let Some((again, picture)) = self.second_look(target, shot, asks).await? else {
                        break;
                    };
                    place = again;
                    self.burst(found, place, first, Some(picture), None).await?
                }
            };
            not_met = end == Some(DriveEnd::MissedHead);
            match Cause::of(end) {
                Some(next) => cause = next,
                None => break,
            }
        }
        Ok(self.log(Event::Recovery { on: false })?)
    }

    /// Bursts at a find of the face that is being worked on.
    pub(super) fn bursts(&self, found: usize) -> usize {
        let attempts = self.record.faces.last().into_iter().flat_map(|f| &f.attempts);
        attempts.filter(|a| a.found == found).map(|a| a.bursts.len()).sum()
    }

    /// True if a find of the face that is being worked on is a screw with enough probability, by a person's word, or because the bit has met it.
    pub(super) fn may_be_searched_around(&self, found: usize) -> bool {
        let seen = |face: &FaceRecord| {
            let alone = |find| look::by_picture_alone(find, face.purpose, &self.runner.config);
            let alone = face.found.get(found).map_or(0.0, alone);
            look::is_worth_a_search(alone, face.purpose)
        };
        self.is_met(found) || self.record.faces.last().is_some_and(seen)
    }

    /// True of a find that the bit has done nothing but miss, while its face is worked on and nothing is known of the covers that it holds.
    fn waits_for_its_cover(&self, found: usize) -> bool {
        self.record.faces.last().is_some_and(|face| {
            let bursts = face
                .attempts
                .iter()
                .filter(|a| a.found == found)
                .flat_map(|a| &a.bursts);
            let mut ends = bursts.map(|b| b.end);
            face.purpose == Purpose::Work && ends.all(|end| end == Some(DriveEnd::MissedHead))
        })
    }

    /// Drives at places on a ring, until the bit meets something.
    ///
    /// # Returns
    /// How the last burst ended, and where the bit has met something.
    async fn search(
        &mut self,
        found: usize,
        place: SafeTarget,
        program: DriveProgram,
        ring: impl Iterator<Item = [f64; 2]>,
        deeper_mm: f64,
    ) -> Result<(Option<DriveEnd>, Option<SafeTarget>), Stop> {
        let map = self.runner.maps.get(place.arm());
        let beside = |across_mm| map.and_then(|map| place.beside(map, across_mm, deeper_mm));
        let bursts_left = self.runner.config.ladder.bursts_max.saturating_sub(self.bursts(found));
        let mut places: Vec<SafeTarget> = ring.filter_map(beside).collect();
        places.truncate(bursts_left);
        let mut end = Some(DriveEnd::MissedHead);
        for (number, beside) in places.iter().enumerate() {
            let left = places.len() - 1 - number;
            end = self.burst(found, *beside, program, None, Some(left)).await?;
            if end != Some(DriveEnd::MissedHead) {
                return Ok((end, Some(*beside)));
            }
        }
        Ok((end, None))
    }

    /// Mills the head off if everything allows it; what was decided is in the journal either way.
    ///
    /// # Returns
    /// `None` if it is not milled.
    async fn mill(
        &mut self,
        found: usize,
        place: SafeTarget,
        program: DriveProgram,
    ) -> Result<Option<Option<DriveEnd>>, Stop> {
        let Some(face) = self.record.faces.last().map(|f| f.face.clone()) else {
            return Ok(None);
        };
        // asked now and for this cut: a permission may be taken back at any time; no answer is none
        let permitted = self.runner.devices.io.read(tags::MILL_PERMITTED).await;
        let decision = self.runner.config.destructive.choose(
            &Case {
                face: &face,
                region: self.runner.program.region(&face),
                can_retry: false,
                depth_mm: program.stroke_mm,
                permitted: permitted.is_ok_and(|value| value == TagValue::Bool(true)),
                person: self.runner.config.help.hand,
            },
            &place,
        );
        let choice = decision.choice;
        self.observer.note(&decision.because);
        self.log(Event::Chosen { found, decision })?;
        if choice != Choice::Mill {
            return Ok(None);
        }
        Ok(Some(self.burst(found, place, program, None, None).await?))
    }

    /// Whether a person may be asked to click.
    pub(super) fn may_ask(&self) -> bool {
        self.runner.config.help.click && self.runner.devices.operator.is_some()
    }

    /// Asks a person to click on the screws in a picture.
    ///
    /// # Returns
    /// The clicks, px of the whole picture; `None` if nobody may be asked or answers.
    pub(super) async fn ask(&mut self, shot: &Shot, text: &str) -> Result<Option<Vec<[f64; 2]>>, Stop> {
        let Some(operator) = self.runner.devices.operator.clone().filter(|_| self.may_ask()) else {
            return Ok(None);
        };
        let config = self.runner.config.clone();
        let color = &shot.frame.color;
        let picture = self.runner.journal.store_picture(color, config.journal.jpeg_quality)?;
        let in_doubt = self.record.faces.last().into_iter().flat_map(|face| &face.found);
        let question = Question {
            text: text.to_owned(),
            image: color.clone(),
            region: shot.region,
            doubtful: in_doubt
                .filter(|f| f.verdict == Verdict::Review)
                .map(|f| [f.u_px, f.v_px])
                .collect(),
        };
        let clicks = match operator.point_at_screws(&question, config.help.timeout_s).await {
            Ok(clicks) => Some(clicks),
            Err(DeviceError::Timeout { .. }) => None,
            Err(error) => return Err(error.into()),
        };
        self.log(Event::Asked {
            question: question.text,
            picture,
            clicks: clicks.clone(),
        })?;
        Ok(clicks)
    }
}
