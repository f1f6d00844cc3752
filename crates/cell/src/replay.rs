//! A recorded shift decided again: each look of a unit with its kept frame, through the very code of the [`Runner`](crate::run::Runner)
//! ([`Judge`]), with the same or another model, map or cell file.
//!
//! Every decision is asked with the unit as the journal knew it then. What would have come of another one (the driver's answer, the
//! next picture) nobody knows: it did not happen.

use crate::device::DeviceError;
use crate::frames;
use crate::look::{self, Decision, Judge, Question, SecondLook};
use crate::program::{FaceId, Program};
use crate::record::{Event, FaceRecord, Found, PullEnd, SeenBy, UnitRecord, Verdict};
use crate::store::StoreError;
use geometry::CameraModel;
use serde::Serialize;
use std::path::Path;

/// A recorded look that cannot be decided again.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// Its frame.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The detector.
    #[error(transparent)]
    Finder(#[from] DeviceError),
    /// Its step is not in the program.
    #[error("unit {unit}: step {step} is not in the program; replay with the program of the run")]
    Step {
        /// Unit.
        unit: u64,
        /// Number of the step.
        step: usize,
    },
}

/// What kind of a look it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A whole face, to decide what to do on it.
    Face,
    /// One screw before another burst.
    SecondLook,
    /// Where screws are said to have come out.
    Check,
    /// Whether a cover came off, after a crash.
    Cover,
}

/// A look, decided again.
#[derive(Clone, Debug, Serialize)]
pub struct Look {
    /// Number of the unit.
    pub unit: u64,
    /// Number of the event in the journal.
    pub event: i64,
    /// What kind of a look it was.
    pub kind: Kind,
    /// The face.
    pub face: Option<FaceId>,
    /// True if every byte of the decision is the same.
    pub same: bool,
    /// What differs.
    #[serde(flatten)]
    pub changes: Changes,
}

/// What would have been decided otherwise. Finds of record and replay within half a head of each other are the same.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Changes {
    /// Screws where there was no find.
    pub screws_gained: Vec<Place>,
    /// Screws that are no find any more.
    pub screws_lost: Vec<Place>,
    /// Finds for review or of another drive that came or went.
    pub other_finds: usize,
    /// Finds with another verdict.
    pub verdicts: Vec<VerdictChange>,
    /// Finds that would have been driven at now.
    pub targets_gained: Vec<Place>,
    /// Finds that would not have been any more.
    pub targets_lost: Vec<Place>,
    /// Finds whose place in the robot's base moved.
    pub moved: Vec<Moved>,
    /// True if the same targets come in another order.
    pub order: bool,
    /// Whether the unit is out of scope, where that changed.
    pub excluded: Option<ExclusionChange>,
    /// Screws said to stand (true now) or to be out, where that changed: numbers in the face's finds.
    pub standing: Vec<(usize, bool)>,
    /// The cover's state now, where that changed.
    pub cover: Option<PullEnd>,
}

/// A place in the whole picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Place {
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
}

/// A find that is something else now.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VerdictChange {
    /// Where.
    #[serde(flatten)]
    pub at: Place,
    /// What it was.
    pub was: Verdict,
    /// What it is.
    pub is: Verdict,
}

/// A find that is somewhere else now.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Moved {
    /// Where it was.
    #[serde(flatten)]
    pub at: Place,
    /// How far it moved in the robot's base, mm.
    pub moved_mm: f64,
}

/// A unit whose exclusion would have been decided otherwise, in words.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExclusionChange {
    /// Why it was.
    pub was: Option<String>,
    /// Why it is.
    pub is: Option<String>,
}

/// What one event gave.
#[derive(Clone, Debug)]
pub enum Stepped {
    /// It was no look.
    NoLook,
    /// It was a look whose frame was not kept.
    NoFrame,
    /// A look, decided again.
    Look(Box<Look>),
}

/// One unit on its way through the journal.
#[derive(Debug)]
pub struct UnitReplay<'a> {
    run: &'a Path,
    so_far: UnitRecord,
    /// Camera of the face that was looked at last.
    camera: Option<CameraModel>,
    /// What a person has clicked on for the next look.
    clicks: Option<Vec<[f64; 2]>>,
}

impl<'a> UnitReplay<'a> {
    /// Before its first event.
    pub fn new(run: &'a Path, unit: u64) -> Self {
        Self {
            run,
            so_far: UnitRecord::new(unit, 0.0),
            camera: None,
            clicks: None,
        }
    }

    /// Decides again what this event says was decided, then takes the event in as it was.
    ///
    /// # Errors
    /// [`ReplayError`].
    pub fn step(
        &mut self,
        judge: &Judge<'_>,
        program: &Program,
        (id, t_s, event): &(i64, f64, Event),
    ) -> Result<Stepped, ReplayError> {
        let look = |kind, face: Option<&FaceId>, same, changes| {
            Ok::<_, ReplayError>(Stepped::Look(Box::new(Look {
                unit: self.so_far.unit,
                event: *id,
                kind,
                face: face.cloned(),
                same,
                changes,
            })))
        };
        let last = self.so_far.faces.last();
        let stepped = match event {
            Event::Seen { face, decision, frame } => match frame {
                None => Ok(Stepped::NoFrame),
                Some(frame) => {
                    let step = program.steps.get(face.step).ok_or(ReplayError::Step {
                        unit: self.so_far.unit,
                        step: face.step,
                    })?;
                    let question = Question {
                        index: face.step,
                        step,
                        face: &face.face,
                        purpose: face.purpose,
                        so_far: &self.so_far,
                        clicks: self.clicks.as_deref(),
                    };
                    let judged = judge.face(&frames::load(self.run, frame)?, &question)?;
                    let (was, is) = (decision.as_deref(), judged.decision());
                    let same = bytes(face, was) == bytes(&judged.face, Some(&is));
                    let changes = compare(face, was, &judged.face, &is);
                    look(Kind::Face, Some(&face.face), same, changes)
                }
            },
            Event::Verified { frames, .. } if frames.is_empty() => Ok(Stepped::NoFrame),
            Event::Verified {
                screws,
                frames,
                second_look,
                ..
            } => {
                let odds = last.map_or(1.0, |face| look::odds_again(judge.config, face.purpose));
                let places = screws.iter().filter_map(|(found, _)| {
                    let find = last?.found.get(*found)?;
                    let (pixel, half_px) = look::place_in_picture(find, &self.camera?, judge.config)?;
                    Some((*found, pixel, half_px))
                });
                let places: Vec<_> = places.collect();
                let face = last.map(|f| &f.face);
                let (kind, now, second, was) = match (second_look, &frames[..], &places[..]) {
                    (Some(was), [frame], [(found, pixel, half_px)]) => {
                        let near = frames::load(self.run, frame)?;
                        let (stands, place) = judge.second_look(
                            &near,
                            (*pixel, *half_px),
                            last.and_then(|f| f.plane),
                            odds,
                            self.clicks.as_deref(),
                        )?;
                        let is = look::second_look_of(*found, place.as_ref());
                        (Kind::SecondLook, vec![(*found, stands)], Some(is), Some(&**was))
                    }
                    _ => {
                        let mut seen = Vec::new();
                        for frame in frames {
                            seen.extend(judge.standing(&frames::load(self.run, frame)?, odds)?);
                        }
                        (Kind::Check, judge.which_stand(&places, &seen), None, None)
                    }
                };
                let changes = Changes {
                    standing: now.iter().filter(|n| !screws.contains(n)).copied().collect(),
                    ..second_changes(last, was, second.as_ref())
                };
                let same = now == *screws && json(&was) == json(&second.as_ref());
                look(kind, face, same, changes)
            }
            Event::Pulled { cover, frame } if cover.seen_by == SeenBy::Picture => match frame {
                None => Ok(Stepped::NoFrame),
                Some(frame) => {
                    let step = program.steps.get(cover.step);
                    let face = step.map(|step| &step.present);
                    let before = self.so_far.faces.iter().rev().find(|f| Some(&f.face) == face);
                    let end = look::cover_off(&frames::load(self.run, frame)?.frame, before);
                    let changes = Changes {
                        cover: (end != cover.end).then_some(end),
                        ..Changes::default()
                    };
                    look(Kind::Cover, face, end == cover.end, changes)
                }
            },
            _ => Ok(Stepped::NoLook),
        }?;
        match event {
            Event::Asked { clicks, .. } => self.clicks.clone_from(clicks),
            // a question that a crash cut short is asked again
            Event::Seen { .. } | Event::Verified { .. } | Event::Resumed => self.clicks = None,
            _ => {}
        }
        if let Event::Seen { frame: Some(frame), .. } = event {
            self.camera = frame.camera;
        }
        self.so_far.apply(*t_s, event);
        Ok(stepped)
    }
}

/// What was decided on a face as text; what was done afterwards, and the name of the picture for the report, are no decision.
fn bytes(face: &FaceRecord, decision: Option<&Decision>) -> String {
    let decided = FaceRecord {
        picture: None,
        attempts: Vec::new(),
        ..face.clone()
    };
    format!("{}\n{}", json(&decided), json(&decision))
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).unwrap_or_else(|e| e.to_string())
}

fn compare(was: &FaceRecord, before: Option<&Decision>, is: &FaceRecord, now: &Decision) -> Changes {
    let mut changes = Changes::default();
    let pairs = matched(&was.found, &is.found);
    let at = |f: &Found| Place {
        u_px: f.u_px,
        v_px: f.v_px,
    };
    let target = |f: &Found| f.left_alone.is_none();
    for (k, find) in was.found.iter().enumerate().filter(|(k, _)| pairs[*k].is_none()) {
        match find.verdict {
            Verdict::Screw => changes.screws_lost.push(at(find)),
            _ => changes.other_finds += 1,
        }
        if target(&was.found[k]) {
            changes.targets_lost.push(at(find));
        }
    }
    for (n, find) in is.found.iter().enumerate() {
        if !pairs.contains(&Some(n)) {
            match find.verdict {
                Verdict::Screw => changes.screws_gained.push(at(find)),
                _ => changes.other_finds += 1,
            }
            if target(find) {
                changes.targets_gained.push(at(find));
            }
        }
    }
    for (old, n) in was.found.iter().zip(&pairs) {
        let Some(new) = n.map(|n| &is.found[n]) else { continue };
        if old.verdict != new.verdict {
            changes.verdicts.push(VerdictChange {
                at: at(old),
                was: old.verdict,
                is: new.verdict,
            });
        }
        match (target(old), target(new)) {
            (true, false) => changes.targets_lost.push(at(old)),
            (false, true) => changes.targets_gained.push(at(old)),
            _ => {}
        }
        if let (Some(a), Some(b)) = (old.base_mm, new.base_mm)
            && a != b
        {
            changes.moved.push(Moved {
                at: at(old),
                moved_mm: a.distance_mm(b),
            });
        }
    }
    if let Some(before) = before {
        let old: Vec<Option<usize>> = before
            .targets
            .iter()
            .map(|t| pairs.get(t.found).copied().flatten())
            .collect();
        let new: Vec<Option<usize>> = now.targets.iter().map(|t| Some(t.found)).collect();
        let alike = changes.targets_gained.is_empty() && changes.targets_lost.is_empty();
        changes.order = alike && old != new;
        if before.excluded != now.excluded {
            let words = |d: &Decision| d.excluded.as_ref().map(|(_, detail)| detail.clone());
            changes.excluded = Some(ExclusionChange {
                was: words(before),
                is: words(now),
            });
        }
    }
    changes
}

/// For each find of the record its find of the replay, the nearest pairs first.
fn matched(was: &[Found], is: &[Found]) -> Vec<Option<usize>> {
    let mut pairs = vec![None; was.len()];
    let mut near: Vec<(f64, usize, usize)> = Vec::new();
    for (k, a) in was.iter().enumerate() {
        for (n, b) in is.iter().enumerate() {
            let off_px = (a.u_px - b.u_px).hypot(a.v_px - b.v_px);
            if off_px <= 0.5 * a.diameter_px.max(b.diameter_px) {
                near.push((off_px, k, n));
            }
        }
    }
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    for (_, k, n) in near {
        if pairs[k].is_none() && !pairs.contains(&Some(n)) {
            pairs[k] = Some(n);
        }
    }
    pairs
}

fn second_changes(face: Option<&FaceRecord>, was: Option<&SecondLook>, is: Option<&SecondLook>) -> Changes {
    let mut changes = Changes::default();
    let (was, is) = (was.and_then(|w| w.aim.as_ref()), is.and_then(|i| i.aim.as_ref()));
    let found = was.or(is).and_then(|aim| face?.found.get(aim.found));
    let Some(at) = found.map(|f| Place {
        u_px: f.u_px,
        v_px: f.v_px,
    }) else {
        return changes;
    };
    match (was, is) {
        (Some(a), Some(b)) if a.tip != b.tip => changes.moved.push(Moved {
            at,
            moved_mm: a.tip.distance_mm(b.tip),
        }),
        (Some(_), None) => changes.targets_lost.push(at),
        (None, Some(_)) => changes.targets_gained.push(at),
        _ => {}
    }
    changes
}
