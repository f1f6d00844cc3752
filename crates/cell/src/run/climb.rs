//! Up the ladder with one screw that did not come out at once, and what a person says of a picture.

use super::{Stop, Way};
use crate::capture::{Shot, sheet_depth_mm};
use crate::device::{DeviceError, DriveEnd, DriveProgram, Question, TagValue, tags};
use crate::ladder::{Cause, Climb, Rung};
use crate::plan::{SafeTarget, Target};
use crate::policy::{Case, Choice};
use crate::record::{Event, Verdict};
use geometry::Pixel;

/// A click means the candidate whose middle lies within this share of its head's diameter.
const SAME_HEAD: f64 = 0.6;
/// Width that is taken for a head that only a person has seen, mm.
const USUAL_HEAD_MM: f64 = 9.5;
/// The same in a picture, px.
const USUAL_HEAD_PX: f64 = 30.0;
/// Standard error of a click, px.
const CLICK_PX: f64 = 1.5;

impl Way<'_> {
    /// One screw: a burst, and the ladder of its cause if it does not come out.
    pub(super) async fn remove(&mut self, target: &Target, shot: &Shot) -> Result<(), Stop> {
        let first = self.runner.config.drive.first;
        let end = self.burst(target.found, target.place, first, None).await?;
        match Cause::of(end) {
            Some(cause) => self.climb(target, shot, cause).await,
            None => Ok(()),
        }
    }

    /// Tries one rung after the other until the screw is out, is not there, or nothing is left.
    pub(super) async fn climb(&mut self, target: &Target, shot: &Shot, mut cause: Cause) -> Result<(), Stop> {
        let (ladder, first) = (self.runner.config.ladder.clone(), self.runner.config.drive.first);
        let mut climb = Climb::new(&ladder);
        let (found, mut place) = (target.found, target.place);
        self.log(Event::Recovery { on: true })?;
        while let Some(rung) = climb.next(cause, self.bursts(found)) {
            // A head that is tried for its cover's sake alone may be none: it is looked at again, but not searched for.
            if cause == Cause::MissedHead && rung != Rung::LookAgain && self.is_doubtful(found) {
                break;
            }
            let end = match rung {
                Rung::Drive { program } if rung.is_destructive() => match self.mill(found, place, program).await? {
                    Some(end) => end,
                    None => break,
                },
                Rung::Drive { program } => self.burst(found, place, program, None).await?,
                Rung::Search { places, radius_mm } => self.search(found, place, first, places, radius_mm).await?,
                Rung::LookAgain | Rung::Click => {
                    let asks = rung == Rung::Click;
                    if asks && !self.may_ask() {
                        continue;
                    }
                    let Some((again, picture)) = self.second_look(target, shot, asks).await? else {
                        break;
                    };
                    place = again;
                    self.burst(found, place, first, Some(picture)).await?
                }
            };
            match Cause::of(end) {
                Some(next) => cause = next,
                None => break,
            }
        }
        Ok(self.log(Event::Recovery { on: false })?)
    }

    /// Bursts at a find of the face that is being worked on.
    fn bursts(&self, found: usize) -> usize {
        let attempts = self.record.faces.last().into_iter().flat_map(|f| &f.attempts);
        attempts.filter(|a| a.found == found).map(|a| a.bursts.len()).sum()
    }

    /// Drives at places on a ring, until the bit meets something.
    async fn search(
        &mut self,
        found: usize,
        place: SafeTarget,
        program: DriveProgram,
        places: u32,
        radius_mm: f64,
    ) -> Result<Option<DriveEnd>, Stop> {
        let mut end = Some(DriveEnd::MissedHead);
        for step in 0..places {
            if end != Some(DriveEnd::MissedHead) {
                break;
            }
            let angle = std::f64::consts::TAU * f64::from(step) / f64::from(places);
            let across_mm = [radius_mm * angle.cos(), radius_mm * angle.sin()];
            let map = self.runner.maps.get(place.arm());
            if let Some(beside) = map.and_then(|map| place.beside(map, across_mm)) {
                end = self.burst(found, beside, program, None).await?;
            }
        }
        Ok(end)
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
        Ok(Some(self.burst(found, place, program, None).await?))
    }

    /// Whether a person may be asked to click.
    pub(super) fn may_ask(&self) -> bool {
        self.runner.config.help.click && self.runner.devices.operator.is_some()
    }

    /// Asks a person to click on the screws in a picture. Every candidate that is clicked on becomes one; a click beside all of them a new
    /// one. `screws` stay as they are if nobody may be asked or answers.
    pub(super) async fn ask(
        &mut self,
        shot: &Shot,
        screws: Vec<vision::Screw>,
        text: &str,
    ) -> Result<Vec<vision::Screw>, Stop> {
        let Some(operator) = self.runner.devices.operator.clone().filter(|_| self.may_ask()) else {
            return Ok(screws);
        };
        let config = self.runner.config.clone();
        let color = &shot.frame.color;
        let picture = self.runner.journal.store_picture(color, config.journal.jpeg_quality)?;
        let in_doubt = screws.iter().filter(|s| s.verdict == Verdict::Review);
        let question = Question {
            text: text.to_owned(),
            image: color.clone(),
            region: shot.region,
            doubtful: in_doubt
                .map(|s| shot.to_whole(s.pixel))
                .map(|p| [p.u_px, p.v_px])
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
        Ok(clicked_on(shot, screws, &clicks.unwrap_or_default()))
    }
}

/// What is a screw once a person has clicked.
fn clicked_on(shot: &Shot, mut screws: Vec<vision::Screw>, clicks: &[[f64; 2]]) -> Vec<vision::Screw> {
    for click in clicks {
        let corner = [f64::from(shot.region.x_px), f64::from(shot.region.y_px)];
        let pixel = Pixel::new(click[0] - corner[0], click[1] - corner[1]);
        let near = screws
            .iter_mut()
            .filter(|s| s.pixel.distance_px(&pixel) < SAME_HEAD * s.diameter_px)
            .min_by(|a, b| a.pixel.distance_px(&pixel).total_cmp(&b.pixel.distance_px(&pixel)));
        match near {
            Some(screw) => screw.verdict = Verdict::Screw,
            None => screws.extend(seen_by_a_person(shot, pixel)),
        }
    }
    screws
}

/// A screw that only a person has seen; `None` without depth there.
fn seen_by_a_person(shot: &Shot, pixel: Pixel) -> Option<vision::Screw> {
    let camera = shot.frame.camera?;
    // how wide it is in the picture depends on how far away it is, which is measured around it
    let roughly_mm = sheet_depth_mm(&shot.frame, pixel, USUAL_HEAD_PX)?;
    let around_px = USUAL_HEAD_MM / camera.pixel_mm(roughly_mm).max(1e-6);
    let depth_mm = sheet_depth_mm(&shot.frame, pixel, around_px)?;
    Some(vision::Screw {
        pixel,
        sigma_px: CLICK_PX,
        diameter_px: around_px,
        score: 1.0,
        fits: 1.0,
        drive: vision::Drive::Cross,
        verdict: Verdict::Screw,
        cues: Vec::new(),
        angle_rad: None,
        camera: Some(camera.unproject(pixel, depth_mm)),
        normal: crate::capture::sheet_normal(&shot.frame, pixel, around_px),
        top_normal: None,
        sigma_lateral_mm: Some(CLICK_PX * camera.pixel_mm(depth_mm)),
        sigma_depth_mm: None,
    })
}
