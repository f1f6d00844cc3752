//! From a shot to a decision: what the program makes of a picture, and nothing else. The [`Runner`](crate::run::Runner) and a replay
//! both decide here, so that the same frame, model, maps and cell file give the same decision, byte by byte.

mod earlier;

use crate::capture::Shot;
use crate::config::CellConfig;
use crate::device::DeviceError;
use crate::plan::{self, Reach, SafeTarget, Target};
use crate::plane::{FaceFit, sheet_depth_mm, sheet_normal};
use crate::program::{FaceId, Step};
use crate::record::{ExclusionReason, FacePlane, FaceRecord, Found, LeftAlone, PullEnd, Purpose, UnitRecord, Verdict};
use crate::run::Finder;
use earlier::Earlier;
use geometry::{Base, CameraModel, Direction, Pixel, Point, RgbdFrame};
use serde::{Deserialize, Serialize};

/// A cover is off if the sheet around its screws lies this much deeper than before, mm.
const COVER_OFF_MM: f64 = 15.0;

/// Two places nearer than this share of a head's diameter are of one head: a click and a candidate, a find and one of an earlier look.
pub(crate) const SAME_HEAD: f64 = 0.6;
/// Width that is taken for a head that only a person has seen, mm.
const USUAL_HEAD_MM: f64 = 9.5;
/// The same in a picture, px.
const USUAL_HEAD_PX: f64 = 30.0;
/// Height of its recess's rim above the sheet, mm.
const USUAL_RIM_MM: f64 = 2.5;
/// A head that the bit did not meet is searched around if its picture alone makes it a screw with so much probability.
const WORTH_A_SEARCH: f64 = 0.9;
/// The same when nothing else is left.
const LIKELY_ENOUGH: f64 = 0.02;
/// Standard error of a click, px.
const CLICK_PX: f64 = 1.5;

/// What decides beside the picture: model, maps, cell file.
#[derive(Clone)]
pub struct Judge<'a> {
    /// Finds screws.
    pub finder: &'a dyn Finder,
    /// Arms that can take screws out, with their maps.
    pub reaches: Vec<Reach<'a>>,
    /// Rules and limits.
    pub config: &'a CellConfig,
}

impl std::fmt::Debug for Judge<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Judge")
            .field("reaches", &self.reaches)
            .finish_non_exhaustive()
    }
}

/// Why a face is looked at.
#[derive(Clone, Copy, Debug)]
pub struct Question<'a> {
    /// Number of the step in the program.
    pub index: usize,
    /// The step.
    pub step: &'a Step,
    /// The face.
    pub face: &'a FaceId,
    /// To what end.
    pub purpose: Purpose,
    /// What is known of the unit so far.
    pub so_far: &'a UnitRecord,
    /// Where a person has clicked on screws, px of the whole picture, if one was asked.
    pub clicks: Option<&'a [[f64; 2]]>,
}

/// Where an arm is sent: a [`SafeTarget`] for the record, which cannot be made into one again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Aim {
    /// Number in [`FaceRecord::found`].
    pub found: usize,
    /// Number of the arm.
    pub arm: usize,
    /// Where the bit meets the screw.
    pub tip: Point<Base>,
    /// Direction in which it comes.
    pub approach: Direction<Base>,
    /// Where the straight way begins, mm before the screw.
    pub standoff_mm: f64,
}

impl Aim {
    fn at(found: usize, place: &SafeTarget) -> Self {
        Self {
            found,
            arm: place.arm(),
            tip: place.tip(),
            approach: place.approach(),
            standoff_mm: place.standoff_mm(),
        }
    }
}

/// What follows from a look at a face.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// The screws to take out, in this order.
    pub targets: Vec<Aim>,
    /// Why the unit is out of scope, if it is: for counting, and in words.
    pub excluded: Option<(ExclusionReason, String)>,
}

/// What follows from a second look at a screw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SecondLook {
    /// Where it is driven at; `None` if no screw stands there any more or no arm may go there.
    pub aim: Option<Aim>,
}

/// A face as judged.
#[derive(Clone, Debug)]
pub struct Judged {
    /// What was found; its `picture` is for the caller to name.
    pub face: FaceRecord,
    /// What to do.
    pub targets: Vec<Target>,
    /// Why not to do it.
    pub excluded: Option<(ExclusionReason, String)>,
}

impl Judged {
    /// The decision for the record.
    pub fn decision(&self) -> Decision {
        Decision {
            targets: self.targets.iter().map(|t| Aim::at(t.found, &t.place)).collect(),
            excluded: self.excluded.clone(),
        }
    }
}

impl Judge<'_> {
    /// How much likelier than pictures say a doubtful head is a screw: a cover that does not come off is evidence.
    pub fn odds(&self, purpose: Purpose) -> f64 {
        odds(self.config, purpose)
    }

    /// What is on a face, what to do with it, and whether the unit is out of scope.
    ///
    /// # Errors
    /// The finder's.
    pub fn face(&self, shot: &Shot, question: &Question<'_>) -> Result<Judged, DeviceError> {
        let config = self.config;
        let Question {
            index,
            step,
            face,
            purpose,
            so_far,
            clicks,
        } = *question;
        let odds = self.odds(purpose);
        let earlier = Earlier::of(so_far, face, shot);
        // a face that is worked on anew was left in the middle of it
        let is_anew = matches!(purpose, Purpose::Survey | Purpose::Work);
        let not_met = |s: &vision::Screw| earlier.not_met(s).filter(|_| !is_anew);
        let mut screws = self.finder.find(&shot.frame, odds)?;
        // What the bit did not meet is not driven at again, unless it is to be searched around, which is done once, or this is the last try, in which
        // what is likely enough has another chance by a new picture. A person's click brings back what it is on. When heads are searched around,
        // no more are tried for the cover's sake alone.
        let is_left = |s: &vision::Screw| {
            let alone = plan::without_odds(s.fits, odds);
            match (not_met(s), purpose) {
                (Some(_), Purpose::Clicked) => true,
                (Some(searched), Purpose::LastTry) => searched || alone < LIKELY_ENOUGH,
                (Some(searched), _) => searched || !is_worth_a_search(alone, purpose),
                (None, Purpose::Search) => plan::is_doubtful(s.fits, odds),
                (None, _) => false,
            }
        };
        for screw in screws.iter_mut().filter(|s| s.verdict == Verdict::Screw) {
            if is_left(screw) {
                screw.verdict = Verdict::Review;
            }
        }
        let mut screws = clicked_on(shot, screws, clicks.unwrap_or_default(), |s| not_met(s).is_some());
        let certain = screws
            .iter()
            .filter(|s| !plan::is_doubtful(s.fits, odds) || s.verdict == Verdict::Other);
        let certain = certain.map(|s| (s.pixel, s.diameter_px));
        let mut heads: Vec<(Pixel, f64)> = Vec::new();
        // what is left of a face that has been worked on are its holes: the sheet around them is the face
        for (pixel, diameter_px) in certain.chain(earlier.screws()) {
            // one that was seen twice has one say
            if heads
                .iter()
                .all(|(other, _)| other.distance_px(&pixel) > SAME_HEAD * diameter_px)
            {
                heads.push((pixel, diameter_px));
            }
        }
        let fit = FaceFit::around(&shot.frame, &heads, config.inspection.working_depth_mm);
        plan::bound_doubtful(
            &mut screws,
            odds,
            config.inspection.doubtful_max,
            earlier.by_pictures_alone(config),
            |s| not_met(s).is_some(),
            fit.as_ref(),
            shot,
        );
        let tops = screws
            .iter()
            .filter(|s| s.verdict == Verdict::Screw && !plan::is_doubtful(s.fits, odds));
        let tops: Vec<_> = tops.filter_map(|s| s.top_normal).collect();
        let fit = fit.map(|fit| match tops.len() {
            // most screws are out already: they have told which way those that are left look
            0..=2 => fit.with_heads(earlier.heads_normal()),
            _ => fit.with_heads(fit.look_together(tops.into_iter())),
        });
        let (mut found, targets) = plan::plan(&screws, shot, fit.as_ref(), &self.reaches, config);
        let seen_but_not_met = |s: &vision::Screw| {
            s.verdict == Verdict::Review && !plan::is_doubtful(s.fits, odds) && not_met(s) == Some(true)
        };
        for (find, _) in found.iter_mut().zip(&screws).filter(|(_, s)| seen_but_not_met(s)) {
            find.left_alone = Some(LeftAlone::NotMet);
        }
        let plane = fit.as_ref().map(FaceFit::plane);
        let seen = FaceRecord {
            step: index,
            step_name: step.name.clone(),
            face: face.clone(),
            purpose,
            t_s: shot.frame.t_s,
            picture: None,
            left_px: shot.region.x_px,
            top_px: shot.region.y_px,
            width_px: shot.region.width_px,
            height_px: shot.region.height_px,
            plane,
            found,
            attempts: Vec::new(),
        };
        // Excluded is what was out of scope before this face was touched. Once it has been, a failure is a failure.
        let least = if purpose == Purpose::Work {
            step.least_screws()
        } else {
            0
        };
        let excluded = if earlier.touched() || !is_anew {
            None
        } else {
            plan::exclusion(&seen, least, config)
        };
        Ok(Judged {
            face: seen,
            targets,
            excluded,
        })
    }

    /// The screw that still stands at a place of the whole picture, mapped anew.
    ///
    /// # Arguments
    /// * `face` – the plane of its face as measured when the whole of it was looked at; the region is too small to measure it.
    /// * `clicks` – where a person has clicked, if one was asked.
    ///
    /// # Returns
    /// Whether one does, and where an arm may go for it.
    ///
    /// # Errors
    /// The finder's.
    pub fn second_look(
        &self,
        near: &Shot,
        (center, half_px): (Pixel, f64),
        face: Option<FacePlane>,
        odds: f64,
        clicks: Option<&[[f64; 2]]>,
    ) -> Result<(bool, Option<SafeTarget>), DeviceError> {
        let screws = self.finder.find(&near.frame, odds)?;
        // a person is asked where the bit has not met what the picture shows
        let screws = clicked_on(near, screws, clicks.unwrap_or_default(), |_| true);
        let same_px = self.same_px(half_px);
        let off = |s: &vision::Screw| near.to_whole(s.pixel).distance_px(&center);
        let closest = screws
            .into_iter()
            .filter(|s| s.verdict == Verdict::Screw && off(s) <= same_px)
            .min_by(|a, b| off(a).total_cmp(&off(b)));
        let Some(screw) = closest else { return Ok((false, None)) };
        let fit = face.and_then(|plane| FaceFit::known(&plane, near.frame.camera?));
        let (_, again) = plan::plan(&[screw], near, fit.as_ref(), &self.reaches, self.config);
        Ok((true, again.first().map(|t| t.place)))
    }

    /// Where screws stand in a shot, in pixels of the whole picture.
    ///
    /// # Errors
    /// The finder's.
    pub fn standing(&self, near: &Shot, odds: f64) -> Result<Vec<Pixel>, DeviceError> {
        let screws = self.finder.find(&near.frame, odds)?;
        let standing = screws.iter().filter(|s| s.verdict == Verdict::Screw);
        Ok(standing.map(|s| near.to_whole(s.pixel)).collect())
    }

    /// Of places (number, pixel, half width of the region around it), which of them have a screw.
    pub fn which_stand(&self, places: &[(usize, Pixel, f64)], standing: &[Pixel]) -> Vec<(usize, bool)> {
        let stands = |pixel: &Pixel, half_px: f64| {
            let same_px = self.same_px(half_px);
            standing.iter().any(|s| s.distance_px(pixel) <= same_px)
        };
        places
            .iter()
            .map(|(found, p, half)| (*found, stands(p, *half)))
            .collect()
    }

    fn same_px(&self, half_px: f64) -> f64 {
        self.config.inspection.same_screw_mm * half_px / self.config.inspection.second_look_mm
    }
}

/// How much likelier than pictures say a doubtful head is a screw.
pub fn odds(config: &CellConfig, purpose: Purpose) -> f64 {
    match purpose {
        Purpose::Missed => config.inspection.stuck_cover_odds,
        Purpose::LastTry | Purpose::Search => config.inspection.last_try_odds,
        Purpose::Survey | Purpose::Work | Purpose::Clicked => 1.0,
    }
}

/// The same when a screw is looked at again: what a person has clicked on is not doubted for its picture's sake, and with the odds of a last try every
/// hole would be a screw that still stands.
pub fn odds_again(config: &CellConfig, purpose: Purpose) -> f64 {
    match purpose {
        Purpose::Clicked | Purpose::LastTry | Purpose::Search => config.inspection.stuck_cover_odds,
        other => odds(config, other),
    }
}

/// Probability that a find of a look is a screw, by its picture alone.
pub fn by_picture_alone(find: &Found, purpose: Purpose, config: &CellConfig) -> f64 {
    plan::without_odds(find.score, odds(config, purpose))
}

/// True if a head that the bit did not meet is to be searched around.
///
/// # Arguments
/// * `alone` – its probability by the picture alone.
pub fn is_worth_a_search(alone: f64, purpose: Purpose) -> bool {
    match purpose {
        Purpose::Clicked => true,
        Purpose::Survey | Purpose::Work | Purpose::Missed => alone >= WORTH_A_SEARCH,
        Purpose::LastTry => false,
        Purpose::Search => alone >= LIKELY_ENOUGH,
    }
}

/// What a second look needs for the record.
pub fn second_look_of(found: usize, place: Option<&SafeTarget>) -> SecondLook {
    SecondLook {
        aim: place.map(|place| Aim::at(found, place)),
    }
}

/// Where a find is in the whole picture, and the half width of a region around it, px.
///
/// # Arguments
/// * `camera` – that of the shot of the whole face.
pub fn place_in_picture(find: &Found, camera: &CameraModel, config: &CellConfig) -> Option<(Pixel, f64)> {
    let pixel_mm = camera.pixel_mm(find.camera_mm?.z_mm());
    let half_px = config.inspection.second_look_mm / pixel_mm.max(1e-6);
    Some((Pixel::new(find.u_px, find.v_px), half_px))
}

/// Whether a cover is still there: the sheet around the places where the screws of its face were.
pub fn cover_off(now: &RgbdFrame, before: Option<&FaceRecord>) -> PullEnd {
    let places = before
        .into_iter()
        .flat_map(|f| &f.found)
        .filter_map(|f| Some((f, f.camera_mm?.z_mm())));
    let (mut there, mut gone) = (0, 0);
    for (found, depth_mm) in places {
        let pixel = Pixel::new(found.u_px, found.v_px);
        match sheet_depth_mm(now, pixel, found.diameter_px) {
            Some(now_mm) if (now_mm - depth_mm).abs() < COVER_OFF_MM => there += 1,
            _ => gone += 1,
        }
    }
    // never measured before: pulling once more is bounded, leaving it on is not what was asked for
    if gone > there { PullEnd::Off } else { PullEnd::Stuck }
}

/// What is a screw once a person has clicked.
///
/// # Arguments
/// * `is_not_met` – true of finds that the bit has not met: what a person shows there is where the person shows it.
fn clicked_on(
    shot: &Shot,
    mut screws: Vec<vision::Screw>,
    clicks: &[[f64; 2]],
    is_not_met: impl Fn(&vision::Screw) -> bool,
) -> Vec<vision::Screw> {
    for click in clicks {
        let pixel = shot.to_shot(Pixel::new(click[0], click[1]));
        let near = screws
            .iter_mut()
            .filter(|s| s.pixel.distance_px(&pixel) < SAME_HEAD * s.diameter_px)
            .min_by(|a, b| a.pixel.distance_px(&pixel).total_cmp(&b.pixel.distance_px(&pixel)));
        match near {
            Some(screw) => {
                if let Some(shown) = is_not_met(screw).then(|| seen_by_a_person(shot, pixel)).flatten() {
                    *screw = shown;
                }
                // a person's word leaves no doubt
                (screw.verdict, screw.score, screw.fits) = (Verdict::Screw, 1.0, 1.0);
            }
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
    let depth_mm = sheet_depth_mm(&shot.frame, pixel, around_px)? - USUAL_RIM_MM;
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
        normal: sheet_normal(&shot.frame, pixel, around_px),
        top_normal: None,
        sigma_lateral_mm: Some(CLICK_PX * camera.pixel_mm(depth_mm)),
        sigma_depth_mm: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::Region;
    use crate::program::Program;
    use geometry::{DepthMap, RgbImage};

    /// One head in doubt, so far away.
    struct InDoubt(Pixel, f64);

    /// In the corner of a frame of flanges.
    const IN_THE_CORNER: InDoubt = InDoubt(AT, 1500.0);

    const AT: Pixel = Pixel::new(640.0, 100.0);

    impl Finder for InDoubt {
        fn find(&self, frame: &RgbdFrame, odds: f64) -> Result<Vec<vision::Screw>, DeviceError> {
            let alone = 0.1;
            let fits = odds * alone / (odds * alone + 1.0 - alone);
            Ok(vec![vision::Screw {
                pixel: self.0,
                sigma_px: 0.3,
                diameter_px: 20.0,
                score: fits,
                fits,
                drive: vision::Drive::Unknown,
                verdict: if fits > 0.6 { Verdict::Screw } else { Verdict::Review },
                cues: Vec::new(),
                angle_rad: None,
                camera: frame.camera.map(|camera| camera.unproject(self.0, self.1)),
                normal: None,
                top_normal: None,
                sigma_lateral_mm: Some(0.1),
                sigma_depth_mm: Some(0.1),
            }])
        }

        fn model(&self) -> String {
            "doubt".into()
        }
    }

    /// A frame of flanges, 1500 mm away, and what is seen through it and beside it, 280 mm behind.
    fn shot() -> Shot {
        let mut map = DepthMap {
            width: 400,
            height: 300,
            step: 2,
            depth_mm: vec![1780.0; 120_000],
        };
        for j in 30..275 {
            for i in 60..340 {
                if !((75..240).contains(&j) && (105..295).contains(&i)) {
                    map.depth_mm[(j * 400 + i) as usize] = 1500.0;
                }
            }
        }
        Shot {
            frame: RgbdFrame {
                color: RgbImage::new(800, 600),
                depth: Some(map),
                camera: Some(CameraModel::pinhole(800, 600, 900.0, 900.0)),
                t_s: 0.0,
            },
            region: Region {
                x_px: 0,
                y_px: 0,
                width_px: 800,
                height_px: 600,
            },
        }
    }

    /// What is known of a face that has been worked on: the holes of its flanges.
    fn worked_on(face: &FaceId) -> UnitRecord {
        let mut record = UnitRecord::new(1, 0.0);
        record.faces.push(FaceRecord {
            step: 4,
            step_name: "front inner screws".into(),
            face: face.clone(),
            purpose: Purpose::Work,
            t_s: 0.0,
            picture: None,
            left_px: 0,
            top_px: 0,
            width_px: 800,
            height_px: 600,
            plane: None,
            found: [(160.0, 100.0), (400.0, 98.0), (150.0, 300.0), (160.0, 500.0)]
                .map(|(u_px, v_px)| Found::screw_at(u_px, v_px))
                .to_vec(),
            attempts: Vec::new(),
        });
        record
    }

    #[test]
    fn a_face_whose_screws_are_out_is_known_by_its_holes() {
        let (config, program) = (CellConfig::simulated(), Program::paper().expect("embedded"));
        let judge = Judge {
            finder: &IN_THE_CORNER,
            reaches: Vec::new(),
            config: &config,
        };
        let (shot, face) = (shot(), FaceId("front_inner".into()));
        let verdict = |so_far: &UnitRecord| {
            let question = Question {
                index: 5,
                step: &program.steps[5],
                face: &face,
                purpose: Purpose::Missed,
                so_far,
                clicks: None,
            };
            judge.face(&shot, &question).expect("judged").face.found[0].verdict
        };
        // what is behind the flanges is most of what is seen
        assert_eq!(
            verdict(&UnitRecord::new(1, 0.0)),
            Verdict::Review,
            "the scene should mislead"
        );
        assert_eq!(verdict(&worked_on(&face)), Verdict::Screw);
    }

    #[test]
    fn a_doubtful_head_behind_the_face_is_tried_if_its_plate_looks_the_same_way() {
        let (config, program) = (CellConfig::simulated(), Program::paper().expect("embedded"));
        let face = FaceId("front_inner".into());
        let finder = InDoubt(Pixel::new(400.0, 310.0), 1560.0);
        let record = worked_on(&face);
        let verdict = |slope_mm: f32| {
            let mut shot = shot();
            let depth = shot.frame.depth.as_mut().expect("depth");
            for j in 120..190 {
                for i in 160..240 {
                    depth.depth_mm[(j * 400 + i) as usize] = 1560.0 + slope_mm * (i - 200) as f32;
                }
            }
            let judge = Judge {
                finder: &finder,
                reaches: Vec::new(),
                config: &config,
            };
            let question = Question {
                index: 5,
                step: &program.steps[5],
                face: &face,
                purpose: Purpose::Missed,
                so_far: &record,
                clicks: None,
            };
            judge.face(&shot, &question).expect("judged").face.found[0].verdict
        };
        assert_eq!(verdict(0.0), Verdict::Screw, "a plate behind the flanges");
        assert_eq!(verdict(2.0), Verdict::Review, "a gap of a grille");
    }

    #[test]
    fn a_person_says_that_it_is_a_screw_and_where_the_bit_has_not_met_it_also_where() {
        let shot = shot();
        let found = IN_THE_CORNER.find(&shot.frame, 1.0).expect("found");
        let click = [AT.u_px + 5.0, AT.v_px - 4.0];
        let after = |not_met: bool| clicked_on(&shot, found.clone(), &[click], |_| not_met).remove(0);
        let (known, shown) = (after(false), after(true));
        assert_eq!((known.verdict, known.pixel), (Verdict::Screw, AT));
        assert_eq!(
            (shown.verdict, shown.pixel),
            (Verdict::Screw, Pixel::new(click[0], click[1]))
        );
        let depth_mm = shown.camera.expect("a place").z_mm();
        assert!((depth_mm - (1500.0 - USUAL_RIM_MM)).abs() < 0.1, "{depth_mm}");
    }
}
