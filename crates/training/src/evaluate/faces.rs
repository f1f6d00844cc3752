//! Rendered faces, and folders of pictures with exact truth.

use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};
use std::ops::Range;
use std::path::{Path, PathBuf};

use geometry::{Camera, CameraModel, Direction, Pixel, Point, Rate, RgbdFrame, read_color, read_depth};
use scene::fastener::Decoy;
use scene::{FaceId, FaceTruth, Unit};
use serde::{Deserialize, Serialize};
use vision::layout::TRAINED_HEAD_PX;
use vision::{Detections, Detector, Drive, Options, Screw, Timing, Verdict, candidates, coarse_map};

use super::scores::{CurvePoint, ReliabilityBin, Scores};
use super::{
    Coverage, EvaluateError, FalseFind, Miss, Quantiles, Share, cut, list, percent, read_text, speaker, unreadable,
    word, write_lists,
};
use crate::face::{Shot, face_of, shot, shot_without_screws};

/// Seeds from here on are for evaluation, smaller ones for training.
pub const FIRST_EVALUATION_SEED: u64 = 1_000_000;

/// A find belongs to a screw within so many head diameters of it.
const ON_SCREW: f64 = 0.5;
/// A find that belongs to no screw is put down to a decoy within so many of its diameters.
const ON_DECOY: f64 = 1.0;
/// A decoy of which less than this shows cannot be judged.
const DECOY_SHOWS: f64 = 0.5;

/// What is rendered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Product {
    /// Worn outdoor units with all that may be taken for a screw.
    #[default]
    Units,
    /// The paper's gauge: a plate with nothing but screws.
    Gauge,
    /// Worn outdoor units from which every screw has been taken out.
    Bare,
}

/// Source of figures on [`Product::Gauge`].
const GAUGES: &str = "rendered gauges with nothing but screws";

/// What became of a kind of decoy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DecoyRow {
    /// How many show.
    pub n: usize,
    /// Of these, called `screw`: wrong.
    pub screw: usize,
    /// Of these, called `other`: right for a fastener.
    pub other: usize,
    /// Of these, left to a person.
    pub review: usize,
    /// Of these, not reported: right for what is no fastener.
    pub dropped: usize,
    /// False finds put down to this kind, those at hidden ones and repeated ones included.
    pub false_finds: usize,
}

/// How well the drive of fasteners is told.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DriveRow {
    /// How many show.
    pub n: usize,
    /// Of these, reported with any verdict.
    pub found: usize,
    /// Of the found, with the right drive.
    pub right: usize,
}

/// Stage 1 alone.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageOne {
    /// Detectable screws with a candidate within half a head.
    pub recall: Rate,
    /// Candidates a picture.
    pub candidates_mean: f64,
}

/// What a detector is worth on pictures with exact truth.
///
/// A detectable screw is found if a find of verdict `screw` lies within half a head of it. A find of verdict `screw` that lies so
/// near no cross screw is false. Finds on screws that are not detectable, and second finds on one screw, are neither.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// What it was measured on.
    pub source: String,
    /// The model: `sha256:` and its hash.
    pub model: String,
    /// Head diameters that were looked for, px.
    pub head_px: [f64; 2],
    /// Number of pictures.
    pub pictures: usize,
    /// Seeds of the first and the last face, where they were rendered.
    pub seeds: Option<[u64; 2]>,
    /// Detectable screws found.
    pub recall: Rate,
    /// Detectable screws found or left to a person.
    pub recall_or_review: Rate,
    /// Finds of verdict `screw` that are right.
    pub precision: Rate,
    /// Detectable screws whose best find says `other`.
    pub called_other: usize,
    /// Detectable screws without any find.
    pub dropped: usize,
    /// Finds of verdict `screw` on something else.
    pub false_finds: usize,
    /// Further finds of verdict `screw` on a screw that has one already.
    pub repeated: usize,
    /// Finds of verdict `review` on no cross screw: looks that a person spends for nothing.
    pub idle_reviews: usize,
    /// Finds of verdict `other` where there is no fastener.
    pub idle_others: usize,
    /// Screws that nobody is expected to find.
    pub undetectable: usize,
    /// Of these, found all the same.
    pub undetectable_found: usize,
    /// Stage 1 alone; `None` where the picture was searched at other scales too.
    pub stage_one: Option<StageOne>,
    /// Distance of found centres from the true ones, px.
    pub center_px: Option<Quantiles>,
    /// Mean error of found centres along u and v, px.
    pub center_bias_px: Option<[f64; 2]>,
    /// Error across the camera's axis, mm.
    pub lateral_mm: Option<Quantiles>,
    /// Error along the camera's axis, mm.
    pub depth_mm: Option<Quantiles>,
    /// Mean error along the camera's axis (found less true), mm.
    pub depth_bias_mm: Option<f64>,
    /// Error in space, mm.
    pub space_mm: Option<Quantiles>,
    /// Angle between the normals of found screws and the screws' axes, degrees.
    pub normal_deg: Option<Quantiles>,
    /// Found screws without a place in space.
    pub without_depth: usize,
    /// Errors of the centre, along u and v each, against `sigma_px`.
    pub sigma: Coverage,
    /// Errors along the camera's axis against `sigma_depth_mm`.
    pub depth_sigma: Coverage,
    /// Recall by wear tag.
    pub by_wear: BTreeMap<String, Rate>,
    /// Recall by shape of head.
    pub by_head: BTreeMap<String, Rate>,
    /// Recall by plating.
    pub by_plating: BTreeMap<String, Rate>,
    /// Recall by face.
    pub by_face: BTreeMap<String, Rate>,
    /// What became of everything else, by kind.
    pub by_decoy: BTreeMap<String, DecoyRow>,
    /// Fasteners by drive: the detectable cross screws, and the others that show.
    pub by_drive: BTreeMap<String, DriveRow>,
    /// Of the reported fasteners, those whose drive is right.
    pub drive_right: Rate,
    /// The same of those that the cross bit does not fit.
    pub other_drive_right: Rate,
    /// Probabilities of a cross screw as said, beside what is so.
    pub reliability: Vec<ReliabilityBin>,
    /// What other thresholds would give.
    pub curve: Vec<CurvePoint>,
    /// Detectable screws not found, at most 200.
    pub misses: Vec<Miss>,
    /// False finds, at most 200.
    pub false_list: Vec<FalseFind>,
    /// Mean time a picture, ms.
    pub timing_ms: Timing,
}

/// Measures a detector on rendered faces, one for each seed: face `seed % 5` of unit `seed`.
///
/// # Arguments
/// * `seeds` – from [`FIRST_EVALUATION_SEED`] on; smaller ones belong to training.
/// * `progress` – told the number of faces done.
///
/// # Errors
/// [`EvaluateError::TrainingSeed`].
pub fn evaluate_faces(
    detector: &Detector,
    options: &Options,
    product: Product,
    seeds: Range<u64>,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<Evaluation, EvaluateError> {
    let mut evaluator = Evaluator::new(detector, options);
    for (done, seed) in (1..).zip(seeds) {
        evaluator.face(product, seed)?;
        progress(done);
    }
    Ok(evaluator.finish())
}

/// Measures a detector on a folder of pictures with exact truth: `rgb/*.jpg`, `depth/*.png`, `truth/*.json`.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_truth_folder(
    detector: &Detector,
    options: &Options,
    folder: &Path,
) -> Result<Evaluation, EvaluateError> {
    let mut evaluator = Evaluator::new(detector, options);
    for path in truth_files(folder)? {
        evaluator.truth_file(folder, &path)?;
    }
    Ok(evaluator.finish())
}

/// The truth files of a folder, in the order of their names.
///
/// # Errors
/// [`EvaluateError::Nothing`] where there are none, [`EvaluateError::File`] where the folder cannot be read.
pub fn truth_files(folder: &Path) -> Result<Vec<PathBuf>, EvaluateError> {
    let truth = folder.join("truth");
    let entries = std::fs::read_dir(&truth).map_err(|source| unreadable(&truth, source))?;
    let mut paths = Vec::new();
    for entry in entries {
        let path = entry.map_err(|source| unreadable(&truth, source))?.path();
        if path.extension().is_some_and(|e| e == "json") {
            paths.push(path);
        }
    }
    if paths.is_empty() {
        return Err(EvaluateError::Nothing {
            path: folder.into(),
            reason: "expected truth/*.json beside rgb/*.jpg and depth/*.png".into(),
        });
    }
    paths.sort();
    Ok(paths)
}

/// Measures a detector picture by picture, for whoever wants to stop in between; [`evaluate_faces`] and
/// [`evaluate_truth_folder`] do all in one.
pub struct Evaluator<'a> {
    detector: &'a Detector,
    options: &'a Options,
    source: String,
    seeds: Option<[u64; 2]>,
    tally: Tally,
}

impl<'a> Evaluator<'a> {
    /// Nothing measured yet.
    pub fn new(detector: &'a Detector, options: &'a Options) -> Self {
        Self {
            detector,
            options,
            source: String::new(),
            seeds: None,
            tally: Tally::default(),
        }
    }

    /// Renders face `seed % 5` of unit `seed` (of a gauge its only one), and measures on it.
    ///
    /// # Errors
    /// [`EvaluateError::TrainingSeed`] below [`FIRST_EVALUATION_SEED`].
    pub fn face(&mut self, product: Product, seed: u64) -> Result<(), EvaluateError> {
        if seed < FIRST_EVALUATION_SEED {
            return Err(EvaluateError::TrainingSeed { seed });
        }
        let (shot, face) = match product {
            Product::Units => (shot(&Unit::sample(seed), face_of(seed), seed), face_of(seed)),
            Product::Gauge => (shot(&Unit::gauge(seed), FaceId::Front, seed), FaceId::Front),
            Product::Bare => (
                shot_without_screws(&Unit::sample(seed), face_of(seed), seed),
                face_of(seed),
            ),
        };
        let source = match product {
            Product::Units => "rendered faces of outdoor units",
            Product::Gauge => GAUGES,
            Product::Bare => "rendered faces of outdoor units without a screw",
        };
        self.source = source.into();
        let [first, last] = self.seeds.unwrap_or([seed; 2]);
        self.seeds = Some([first.min(seed), last.max(seed)]);
        let Some(Shot { frame, truth }) = shot else {
            return Ok(()); // a unit without that face
        };
        let truth = Truth::of_face(format!("{seed} {}", face.name()), face.name(), &truth);
        self.measure(&frame, &truth)
    }

    /// Measures on one picture of a folder with exact truth; `path` is one of [`truth_files`].
    ///
    /// # Errors
    /// An [`EvaluateError`] that names the file.
    pub fn truth_file(&mut self, folder: &Path, path: &Path) -> Result<(), EvaluateError> {
        let (frame, truth) = read_truth(folder, path)?;
        self.source = format!("pictures of {}", folder.display());
        self.measure(&frame, &truth)
    }

    fn measure(&mut self, frame: &RgbdFrame, truth: &Truth) -> Result<(), EvaluateError> {
        let found = self.detector.detect(frame, self.options);
        let head_px = &self.options.head_px;
        let one_scale = TRAINED_HEAD_PX.contains(head_px.start()) && TRAINED_HEAD_PX.contains(head_px.end());
        // at one scale the network's pixels are the picture's
        let model = self.detector.model();
        let map = coarse_map(&model.coarse, &frame.color)?;
        let places = one_scale.then(|| {
            candidates(&map, &model.settings.thresholds)
                .iter()
                .map(|c| Pixel::new(c.pixel.u_px, c.pixel.v_px))
                .collect::<Vec<Pixel>>()
        });
        self.tally.add(truth, &found, places.as_deref());
        Ok(())
    }

    /// Pictures measured on so far.
    pub fn pictures(&self) -> usize {
        self.tally.pictures
    }

    /// The figures.
    pub fn finish(self) -> Evaluation {
        let t = self.tally;
        let n = t.pictures.max(1) as f64;
        let rates = |shares: BTreeMap<String, Share>| shares.into_iter().map(|(k, s)| (k, s.rate())).collect();
        let mean = |errors: &[f64]| (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64);
        let centers = |f: fn(&CenterError) -> f64| t.center.iter().map(f).collect::<Vec<f64>>();
        let spaces = |f: fn(&SpaceError) -> f64| t.space.iter().map(f).collect::<Vec<f64>>();
        let timings = |f: fn(&Timing) -> f64| t.timings.iter().map(f).sum::<f64>() / n;
        let mut relative = centers(|e| e.u_px / e.sigma_px);
        relative.extend(centers(|e| e.v_px / e.sigma_px));
        let (found, detectable) = (t.recall.hits, t.recall.of);
        let drives = |is_asked: fn(&str) -> bool| {
            let rows = || t.by_drive.iter().filter(|(name, _)| is_asked(name)).map(|(_, row)| row);
            Rate::of(rows().map(|d| d.right).sum(), rows().map(|d| d.found).sum())
        };
        Evaluation {
            source: self.source,
            model: self.detector.model().id().to_owned(),
            head_px: [*self.options.head_px.start(), *self.options.head_px.end()],
            pictures: t.pictures,
            seeds: self.seeds,
            recall: t.recall.rate(),
            recall_or_review: Rate::of(found + t.review, detectable),
            precision: Rate::of(found, found + t.false_finds),
            called_other: t.called_other,
            dropped: detectable - found - t.review - t.called_other,
            false_finds: t.false_finds,
            repeated: t.repeated,
            idle_reviews: t.idle_reviews,
            idle_others: t.idle_others,
            undetectable: t.undetectable.of,
            undetectable_found: t.undetectable.hits,
            stage_one: t.stage_one.map(|s| StageOne {
                recall: s.rate(),
                candidates_mean: t.candidates as f64 / n,
            }),
            center_px: Quantiles::of(&centers(|e| e.u_px.hypot(e.v_px))),
            center_bias_px: mean(&centers(|e| e.u_px))
                .zip(mean(&centers(|e| e.v_px)))
                .map(Into::into),
            lateral_mm: Quantiles::of(&spaces(|e| e.mm[0].hypot(e.mm[1]))),
            depth_mm: Quantiles::of(&spaces(|e| e.mm[2].abs())),
            depth_bias_mm: mean(&spaces(|e| e.mm[2])),
            space_mm: Quantiles::of(&spaces(|e| e.mm[0].hypot(e.mm[1]).hypot(e.mm[2]))),
            normal_deg: Quantiles::of(&t.normal_deg),
            without_depth: t.without_depth,
            sigma: Coverage::of(&relative),
            depth_sigma: Coverage::of(&spaces(|e| e.mm[2] / e.sigma_depth_mm)),
            drive_right: drives(|_| true),
            other_drive_right: drives(|name| name != Drive::Cross.name()),
            timing_ms: Timing {
                decode: timings(|t| t.decode),
                coarse: timings(|t| t.coarse),
                fine: timings(|t| t.fine),
                centre: timings(|t| t.centre),
                locate: timings(|t| t.locate),
                total: timings(|t| t.total),
            },
            reliability: t.scores.reliability(),
            curve: t.scores.curve(t.pictures),
            by_wear: rates(t.by_wear),
            by_head: rates(t.by_head),
            by_plating: rates(t.by_plating),
            by_face: rates(t.by_face),
            by_decoy: t.by_decoy,
            by_drive: t.by_drive,
            misses: t.misses,
            false_list: t.false_list,
        }
    }
}

/// What is in a picture, from whatever source.
struct Truth {
    picture: String,
    face: String,
    screws: Vec<TrueScrew>,
    decoys: Vec<TrueDecoy>,
}

struct TrueScrew {
    pixel: Pixel,
    point: Point<Camera>,
    axis: Option<Direction<Camera>>,
    head_d_px: f64,
    detectable: bool,
    wear: Vec<String>,
    head: String,
    plating: String,
}

struct TrueDecoy {
    kind: String,
    pixel: Pixel,
    d_px: f64,
    shows: bool,
}

impl TrueDecoy {
    fn drive(&self) -> Option<Drive> {
        let known = Decoy::ALL.into_iter().find(|d| d.name() == self.kind)?;
        known.drive().map(crate::drive_seen)
    }
}

impl Truth {
    fn of_face(picture: String, face: &str, truth: &FaceTruth) -> Self {
        let screws = truth.screws.iter().map(|s| TrueScrew {
            pixel: s.pixel,
            point: s.point,
            axis: Some(s.axis),
            head_d_px: s.head_d_px,
            detectable: s.detectable,
            wear: s.wear.clone(),
            head: word(&s.head),
            plating: word(&s.plating),
        });
        let decoys = truth.decoys.iter().map(|d| TrueDecoy {
            kind: d.kind.name().into(),
            pixel: d.pixel,
            d_px: d.d_px,
            shows: d.visible_fraction >= DECOY_SHOWS,
        });
        Self {
            picture,
            face: face.into(),
            screws: screws.collect(),
            decoys: decoys.collect(),
        }
    }
}

/// What a find is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Subject {
    /// A cross screw.
    Screw(usize),
    /// Something else that is in the truth.
    Decoy(usize),
    /// Nothing in particular.
    Background,
}

fn subject(truth: &Truth, at: Pixel) -> Subject {
    let nearest = |items: &mut dyn Iterator<Item = (Pixel, f64)>| {
        items
            .enumerate()
            .map(|(k, (pixel, reach_px))| (k, pixel.distance_px(&at), reach_px))
            .filter(|(_, distance_px, reach_px)| distance_px <= reach_px)
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(k, ..)| k)
    };
    let screw = nearest(&mut truth.screws.iter().map(|s| (s.pixel, ON_SCREW * s.head_d_px)));
    let decoy = || nearest(&mut truth.decoys.iter().map(|d| (d.pixel, ON_DECOY * d.d_px)));
    screw
        .map(Subject::Screw)
        .or_else(|| decoy().map(Subject::Decoy))
        .unwrap_or(Subject::Background)
}

struct CenterError {
    u_px: f64,
    v_px: f64,
    sigma_px: f64,
}

struct SpaceError {
    mm: [f64; 3],
    sigma_depth_mm: f64,
}

#[derive(Default)]
struct Tally {
    pictures: usize,
    recall: Share,
    review: usize,
    called_other: usize,
    false_finds: usize,
    repeated: usize,
    idle_reviews: usize,
    idle_others: usize,
    undetectable: Share,
    stage_one: Option<Share>,
    candidates: usize,
    center: Vec<CenterError>,
    space: Vec<SpaceError>,
    normal_deg: Vec<f64>,
    without_depth: usize,
    by_wear: BTreeMap<String, Share>,
    by_head: BTreeMap<String, Share>,
    by_plating: BTreeMap<String, Share>,
    by_face: BTreeMap<String, Share>,
    by_decoy: BTreeMap<String, DecoyRow>,
    by_drive: BTreeMap<String, DriveRow>,
    misses: Vec<Miss>,
    false_list: Vec<FalseFind>,
    timings: Vec<Timing>,
    scores: Scores,
}

impl Tally {
    /// Adds a picture.
    fn add(&mut self, truth: &Truth, found: &Detections, places: Option<&[Pixel]>) {
        self.pictures += 1;
        self.candidates += places.map_or(0, <[Pixel]>::len);
        self.timings.push(found.timing_ms);
        let subjects: Vec<Subject> = found.screws.iter().map(|s| subject(truth, s.pixel)).collect();
        let about = |which: Subject| {
            let pairs = found.screws.iter().zip(&subjects);
            pairs.filter(move |(_, s)| **s == which).map(|(find, _)| find)
        };
        for (k, screw) in truth.screws.iter().enumerate() {
            let finds = || about(Subject::Screw(k));
            let acted = finds().filter(|f| f.verdict == Verdict::Screw).count();
            self.repeated += acted.saturating_sub(1);
            if screw.detectable {
                self.scores.screw(finds().map(|f| f.fits).fold(0.0, f64::max));
                let near = |p: &Pixel| p.distance_px(&screw.pixel) <= ON_SCREW * screw.head_d_px;
                let candidate = places.map(|places| places.iter().any(near));
                self.screw(truth, screw, speaker(finds(), screw.pixel), candidate);
            } else {
                self.undetectable.add(acted > 0);
            }
        }
        for (k, decoy) in truth.decoys.iter().enumerate() {
            if decoy.shows {
                self.decoy(decoy, speaker(about(Subject::Decoy(k)), decoy.pixel));
            }
        }
        for (find, subject) in found.screws.iter().zip(&subjects) {
            // of screws that nobody can make out nothing is expected
            if !matches!(subject, Subject::Screw(k) if !truth.screws[*k].detectable) {
                self.scores.find(find.fits, matches!(subject, Subject::Screw(_)));
            }
            let (kind, fastener) = match *subject {
                Subject::Screw(_) => continue,
                Subject::Decoy(k) => (truth.decoys[k].kind.as_str(), truth.decoys[k].drive().is_some()),
                Subject::Background => ("background", false),
            };
            match find.verdict {
                Verdict::Review => self.idle_reviews += 1,
                Verdict::Other => self.idle_others += usize::from(!fastener),
                Verdict::Screw => {
                    self.false_finds += 1;
                    self.by_decoy.entry(kind.into()).or_default().false_finds += 1;
                    list(&mut self.false_list, || FalseFind::new(&truth.picture, find, kind));
                }
            }
        }
    }

    /// A detectable screw and the find that speaks for it.
    fn screw(&mut self, truth: &Truth, screw: &TrueScrew, find: Option<&Screw>, candidate: Option<bool>) {
        let hit = find.filter(|f| f.verdict == Verdict::Screw);
        let found = hit.is_some();
        self.recall.add(found);
        self.drive(Drive::Cross, find);
        if let Some(candidate) = candidate {
            self.stage_one.get_or_insert_default().add(candidate);
        }
        for tag in &screw.wear {
            self.by_wear.entry(tag.clone()).or_default().add(found);
        }
        self.by_head.entry(screw.head.clone()).or_default().add(found);
        self.by_plating.entry(screw.plating.clone()).or_default().add(found);
        self.by_face.entry(truth.face.clone()).or_default().add(found);
        let Some(hit) = hit else {
            match find.map(|f| f.verdict) {
                Some(Verdict::Review) => self.review += 1,
                Some(_) => self.called_other += 1,
                None => {}
            }
            let tags = || {
                [&screw.head, &screw.plating]
                    .into_iter()
                    .chain(&screw.wear)
                    .cloned()
                    .collect()
            };
            list(&mut self.misses, || Miss {
                candidate,
                ..Miss::new(&truth.picture, screw.pixel, screw.head_d_px, tags(), find)
            });
            return;
        };
        self.center.push(CenterError {
            u_px: hit.pixel.u_px - screw.pixel.u_px,
            v_px: hit.pixel.v_px - screw.pixel.v_px,
            sigma_px: hit.sigma_px,
        });
        match (hit.camera, hit.sigma_depth_mm) {
            (Some(point), Some(sigma_depth_mm)) => self.space.push(SpaceError {
                mm: (point.vector() - screw.point.vector()).into(),
                sigma_depth_mm,
            }),
            _ => self.without_depth += 1,
        }
        let angle = |(normal, axis): (Direction<Camera>, _)| normal.angle_rad(axis).to_degrees();
        self.normal_deg.extend(hit.normal.zip(screw.axis).map(angle));
    }

    /// Something that is no cross screw, and the find that speaks for it.
    fn decoy(&mut self, decoy: &TrueDecoy, find: Option<&Screw>) {
        let row = self.by_decoy.entry(decoy.kind.clone()).or_default();
        row.n += 1;
        match find.map(|f| f.verdict) {
            Some(Verdict::Screw) => row.screw += 1,
            Some(Verdict::Other) => row.other += 1,
            Some(Verdict::Review) => row.review += 1,
            None => row.dropped += 1,
        }
        if let Some(drive) = decoy.drive() {
            self.drive(drive, find);
        }
    }

    /// A fastener of a drive and the find that speaks for it.
    fn drive(&mut self, drive: Drive, find: Option<&Screw>) {
        let row = self.by_drive.entry(drive.name().into()).or_default();
        row.n += 1;
        row.found += usize::from(find.is_some());
        row.right += usize::from(find.is_some_and(|f| f.drive == drive));
    }
}

/// A truth file; fields that are not needed here are ignored.
#[derive(Deserialize)]
struct TruthFile {
    rgb: Option<String>,
    depth: Option<String>,
    depth_scale_mm: f64,
    side: Option<String>,
    camera: TruthCamera,
    screws: Vec<FileScrew>,
    negatives: Vec<FileNegative>,
}

#[derive(Deserialize)]
struct TruthCamera {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    dist_k1k2p1p2k3: [f64; 5],
}

#[derive(Deserialize)]
struct FileScrew {
    u: f64,
    v: f64,
    xyz_mm: [f64; 3],
    axis: Option<[f64; 3]>,
    head_d_px: f64,
    detectable: bool,
    #[serde(default)]
    tags: Vec<String>,
    #[serde(rename = "type")]
    head: Option<String>,
    plating: Option<String>,
}

#[derive(Deserialize)]
struct FileNegative {
    kind: String,
    u: f64,
    v: f64,
    d_mm: f64,
    xyz_mm: Option<[f64; 3]>,
}

/// Reads a truth file with its picture and depth.
fn read_truth(folder: &Path, path: &Path) -> Result<(RgbdFrame, Truth), EvaluateError> {
    let file: TruthFile = serde_json::from_str(&read_text(path)?).map_err(|e| EvaluateError::Format {
        path: path.into(),
        reason: format!("{e}; expected the truth of a picture with depth_scale_mm, camera, screws and negatives"),
    })?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let beside = |named: &Option<String>, usual: String| folder.join(named.as_deref().unwrap_or(&usual));
    let color = read_color(&beside(&file.rgb, format!("rgb/{name}.jpg")))?;
    let depth = beside(&file.depth, format!("depth/{name}.png"));
    let depth = read_depth(&depth, file.depth_scale_mm, color.dimensions())?;
    let c = &file.camera;
    let camera = CameraModel {
        width_px: color.width(),
        height_px: color.height(),
        fx_px: c.fx,
        fy_px: c.fy,
        cx_px: c.cx,
        cy_px: c.cy,
        distortion: c.dist_k1k2p1p2k3,
    };
    let truth = file.truth(name, &camera);
    let frame = RgbdFrame {
        color,
        depth: Some(depth),
        camera: Some(camera),
        t_s: 0.0,
    };
    Ok((frame, truth))
}

impl TruthFile {
    fn truth(self, picture: String, camera: &CameraModel) -> Truth {
        // a negative without a place in space is as far away as the screws are
        let mean_z_mm = self.screws.iter().map(|s| s.xyz_mm[2]).sum::<f64>() / self.screws.len().max(1) as f64;
        let unknown = || "unknown".to_string();
        let screws = self.screws.into_iter().map(|s| TrueScrew {
            pixel: Pixel::new(s.u, s.v),
            point: Point::new(s.xyz_mm[0], s.xyz_mm[1], s.xyz_mm[2]),
            axis: s.axis.and_then(|[x, y, z]| Direction::new(x, y, z)),
            head_d_px: s.head_d_px,
            detectable: s.detectable,
            wear: s.tags,
            head: s.head.unwrap_or_else(unknown),
            plating: s.plating.unwrap_or_else(unknown),
        });
        let decoys = self.negatives.into_iter().map(|d| TrueDecoy {
            kind: d.kind,
            pixel: Pixel::new(d.u, d.v),
            d_px: d.d_mm / camera.pixel_mm(d.xyz_mm.map_or(mean_z_mm, |p| p[2]).max(1.0)),
            shows: true,
        });
        Truth {
            picture,
            face: self.side.unwrap_or_else(unknown),
            screws: screws.collect(),
            decoys: decoys.collect(),
        }
    }
}

fn write_rates(f: &mut Formatter<'_>, title: &str, rows: &BTreeMap<String, Rate>) -> fmt::Result {
    if rows.is_empty() {
        return Ok(());
    }
    writeln!(
        f,
        "\n{title:<22} {:>6} {:>6} {:>9}   95 % bounds",
        "n", "found", "recall %"
    )?;
    for (name, rate) in rows {
        let (name, share) = (cut(name, 20), percent(rate.rate, 2));
        let (low, high) = (100.0 * rate.low, 100.0 * rate.high);
        writeln!(
            f,
            "  {name:<20} {:>6} {:>6} {share:>9}   {low:.1} to {high:.1}",
            rate.of, rate.hits
        )?;
    }
    Ok(())
}

impl Display for Evaluation {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "model        {}", self.model)?;
        write!(f, "measured on  {} {}", self.pictures, self.source)?;
        if let Some([first, last]) = self.seeds {
            write!(f, ", seeds {first} to {last}")?;
        }
        writeln!(f, "\nheads        {} to {} px", self.head_px[0], self.head_px[1])?;
        writeln!(f, "recall     {}", self.recall)?;
        writeln!(f, "  + review {}", self.recall_or_review)?;
        writeln!(f, "precision  {}", self.precision)?;
        let missed = self.recall.of - self.recall.hits;
        write!(f, "TP, FN, FP   {}, {missed}, {}", self.recall.hits, self.false_finds)?;
        let paper = if self.source == GAUGES {
            "   (the paper, on 3,070 screws of its gauge: 3064, 6, 0)"
        } else {
            ""
        };
        writeln!(f, "{paper}")?;
        if let Some(stage) = &self.stage_one {
            writeln!(f, "stage 1    {}", stage.recall)?;
            writeln!(f, "             {:.1} candidates a picture", stage.candidates_mean)?;
        }
        writeln!(
            f,
            "not found    {} ({} to review, {} called other, {} dropped)",
            self.recall.of - self.recall.hits,
            self.recall_or_review.hits - self.recall.hits,
            self.called_other,
            self.dropped
        )?;
        writeln!(
            f,
            "false        {} finds; {} reviews of what is no cross screw; {} `other` of what is no fastener",
            self.false_finds, self.idle_reviews, self.idle_others
        )?;
        writeln!(
            f,
            "not counted  {} of {} undetectable screws found, {} repeated finds",
            self.undetectable_found, self.undetectable, self.repeated
        )?;

        let heads = ["n", "median", "p95", "p99", "max"];
        let [n, median, p95, p99, max] = heads;
        writeln!(f, "\n{:<22} {n:>6} {median:>9} {p95:>9} {p99:>9} {max:>9}", "error")?;
        for (name, errors) in [
            ("centre px", self.center_px),
            ("lateral mm", self.lateral_mm),
            ("depth mm", self.depth_mm),
            ("3D mm", self.space_mm),
            ("normal degrees", self.normal_deg),
        ] {
            match errors {
                Some(e) => writeln!(
                    f,
                    "  {name:<20} {:>6} {:>9.3} {:>9.3} {:>9.3} {:>9.3}",
                    e.n, e.median, e.p95, e.p99, e.max
                )?,
                None => writeln!(f, "  {name:<20} {:>6}", 0)?,
            }
        }
        if let Some([u, v]) = self.center_bias_px {
            write!(f, "  mean error: u {u:+.3} px, v {v:+.3} px")?;
            if let Some(depth_mm) = self.depth_bias_mm {
                write!(f, ", depth {depth_mm:+.3} mm")?;
            }
            writeln!(f, "; {} found without depth", self.without_depth)?;
        }
        for (name, coverage) in [("sigma_px", &self.sigma), ("sigma_depth_mm", &self.depth_sigma)] {
            if let (Some(one), Some(two)) = (coverage.one_sigma.rate, coverage.two_sigma.rate) {
                let (one, two) = (100.0 * one, 100.0 * two);
                writeln!(
                    f,
                    "  within {name}: {one:.1} % (should be 68.3), within 1.96 of it: {two:.1} % (95.0)"
                )?;
            }
        }

        writeln!(
            f,
            "\n{:<22} {:>6} {:>9} {:>9}",
            "said to be cross", "n", "said %", "is %"
        )?;
        for bin in &self.reliability {
            let (range, is) = (format!("{:.1} to {:.1}", bin.low, bin.high), percent(bin.cross.rate, 1));
            writeln!(
                f,
                "  {range:<20} {:>6} {:>9.1} {is:>9}",
                bin.cross.of,
                100.0 * bin.said_mean
            )?;
        }
        write_rates(f, "by wear", &self.by_wear)?;
        write_rates(f, "by head", &self.by_head)?;
        write_rates(f, "by plating", &self.by_plating)?;
        write_rates(f, "by face", &self.by_face)?;
        if !self.by_decoy.is_empty() {
            let heads = ["n", "screw", "other", "review", "dropped", "false finds"];
            let [n, screw, other, review, dropped, false_finds] = heads;
            writeln!(
                f,
                "\n{:<22} {n:>6} {screw:>6} {other:>6} {review:>6} {dropped:>8} {false_finds:>12}",
                "no cross screw"
            )?;
            for (name, d) in &self.by_decoy {
                let name = cut(name, 20);
                writeln!(
                    f,
                    "  {name:<20} {:>6} {:>6} {:>6} {:>6} {:>8} {:>12}",
                    d.n, d.screw, d.other, d.review, d.dropped, d.false_finds
                )?;
            }
        }
        if !self.by_drive.is_empty() {
            writeln!(
                f,
                "\n{:<22} {:>6} {:>6} {:>12}",
                "fasteners by drive", "n", "found", "drive right"
            )?;
            for (name, d) in &self.by_drive {
                writeln!(f, "  {name:<20} {:>6} {:>6} {:>12}", d.n, d.found, d.right)?;
            }
            writeln!(f, "  right of found {}", self.drive_right)?;
            writeln!(f, "  without cross  {}", self.other_drive_right)?;
        }
        write_lists(f, &self.misses, &self.false_list)?;
        let t = &self.timing_ms;
        writeln!(
            f,
            "\nmean time    {:.0} ms a picture (coarse {:.0}, fine {:.0}, centre {:.0}, locate {:.0})",
            t.total, t.coarse, t.fine, t.centre, t.locate
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::tests::{detections, find};

    fn screw(u_px: f64, detectable: bool, tag: &str) -> TrueScrew {
        TrueScrew {
            pixel: Pixel::new(u_px, 100.0),
            point: Point::new(0.0, 0.0, 1500.0),
            axis: None,
            head_d_px: 30.0,
            detectable,
            wear: vec![tag.into()],
            head: "pan".into(),
            plating: "zinc".into(),
        }
    }

    fn decoy(u_px: f64, kind: &str, shows: bool) -> TrueDecoy {
        TrueDecoy {
            kind: kind.into(),
            pixel: Pixel::new(u_px, 300.0),
            d_px: 20.0,
            shows,
        }
    }

    fn evaluation(truth: &Truth, finds: Vec<Screw>, places: Option<&[Pixel]>) -> Evaluation {
        let detector = Detector::embedded().expect("the built-in model");
        let options = Options::default();
        let mut evaluator = Evaluator::new(&detector, &options);
        evaluator.tally.add(truth, &detections(finds), places);
        evaluator.finish()
    }

    #[test]
    fn finds_are_matched_as_defined() {
        let truth = Truth {
            picture: "p".into(),
            face: "front".into(),
            screws: vec![
                screw(100.0, true, "clean"), // found, twice
                screw(200.0, true, "rust"),  // review
                screw(300.0, true, "rust"),  // nothing but stage 1
                screw(400.0, false, "mud"),  // undetectable, found
                screw(500.0, true, "rust"),  // find just too far away
                screw(600.0, true, "clean"), // called other
            ],
            decoys: vec![
                decoy(100.0, "hex_bolt", true), // other: right
                decoy(200.0, "hex_bolt", true), // screw: false
                decoy(300.0, "slotted", true),  // other, wrong drive
                decoy(400.0, "hole", true),     // dropped
                decoy(500.0, "rivet", false),   // hidden, called screw all the same
            ],
        };
        use Verdict::{Other, Review, Screw};
        let finds = vec![
            find(110.0, 100.0, Screw, Drive::Cross),
            find(100.3, 100.4, Screw, Drive::Cross),
            find(214.9, 100.0, Review, Drive::Cross),
            find(401.0, 100.0, Screw, Drive::Cross),
            find(515.1, 100.0, Screw, Drive::Cross),
            find(600.0, 100.0, Other, Drive::Slotted),
            find(101.0, 300.0, Other, Drive::HexHead),
            find(219.0, 300.0, Screw, Drive::Cross),
            find(300.0, 300.0, Other, Drive::Torx),
            find(500.0, 300.0, Screw, Drive::Cross),
            find(900.0, 900.0, Review, Drive::Cross),
            find(900.0, 100.0, Other, Drive::HexHead),
        ];
        let places = [
            Pixel::new(105.0, 100.0),
            Pixel::new(312.0, 100.0),
            Pixel::new(480.0, 100.0),
        ];
        let e = evaluation(&truth, finds, Some(&places));
        assert_eq!((e.recall.hits, e.recall.of, e.recall_or_review.hits), (1, 5, 2));
        assert_eq!((e.called_other, e.dropped, e.repeated), (1, 2, 1));
        assert_eq!((e.undetectable, e.undetectable_found), (1, 1));
        assert_eq!((e.idle_reviews, e.idle_others), (1, 1));
        assert_eq!((e.precision.hits, e.precision.of, e.false_finds), (1, 4, 3));
        let kinds: Vec<&str> = e.false_list.iter().map(|f| f.kind.as_str()).collect();
        assert_eq!(kinds, ["background", "hex_bolt", "rivet"]);
        let bolt = DecoyRow {
            n: 2,
            screw: 1,
            other: 1,
            false_finds: 1,
            ..DecoyRow::default()
        };
        assert_eq!(e.by_decoy["hex_bolt"], bolt);
        assert_eq!(e.by_decoy["hole"].dropped, 1);
        assert_eq!((e.by_decoy["rivet"].n, e.by_decoy["rivet"].false_finds), (0, 1));
        let drive = |name: &str| (e.by_drive[name].n, e.by_drive[name].found, e.by_drive[name].right);
        assert_eq!((drive("hex_head"), drive("slotted")), ((2, 2, 1), (1, 1, 0)));
        assert_eq!(drive("cross"), (5, 3, 2));
        assert_eq!((e.drive_right.hits, e.drive_right.of), (3, 6));
        assert_eq!((e.other_drive_right.hits, e.other_drive_right.of), (1, 3));
        assert_eq!(
            (e.by_wear["rust"].hits, e.by_wear["rust"].of, e.by_wear["clean"].of),
            (0, 3, 2)
        );
        assert!(!e.by_wear.contains_key("mud"));
        let stage = e.stage_one.expect("places were given");
        assert_eq!((stage.recall.hits, stage.recall.of, stage.candidates_mean), (2, 5, 3.0));
        // the nearer of the two finds is the one that is measured
        let near = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(near(e.center_px.expect("one found").max, 0.5));
        assert!(near(e.lateral_mm.expect("with depth").max, 0.5));
        assert!(near(e.depth_bias_mm.expect("with depth"), 1.2) && near(e.space_mm.expect("with depth").max, 1.3));
        assert_eq!((e.sigma.one_sigma.hits, e.sigma.one_sigma.of), (2, 2));
        assert_eq!((e.depth_sigma.one_sigma.hits, e.depth_sigma.two_sigma.hits), (0, 1));
        let called: Vec<&str> = e.misses.iter().map(|m| m.called.as_str()).collect();
        assert_eq!(called, ["review", "nothing", "nothing", "other"]);
        assert_eq!(e.misses[1].candidate, Some(true));

        let text = e.to_string();
        assert!(text.lines().all(|l| l.chars().count() <= 100), "{text}");
        assert!(text.contains("95 %") && text.contains("hex_bolt"), "{text}");
        let json = serde_json::to_string(&e).expect("plain data");
        let read: Evaluation = serde_json::from_str(&json).expect("as written");
        assert_eq!((read.to_string(), read.misses), (text, e.misses));
    }

    #[test]
    fn seeds_of_training_are_refused() {
        let detector = Detector::embedded().expect("the built-in model");
        let seeds = 999_999..1_000_001;
        let refused = evaluate_faces(&detector, &Options::default(), Product::Units, seeds, &|_| {});
        assert!(
            matches!(refused, Err(EvaluateError::TrainingSeed { seed: 999_999 })),
            "{refused:?}"
        );
    }

    /// A folder that goes when it is dropped.
    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("unscrew-evaluate-{name}-{}", std::process::id()));
            for part in ["rgb", "depth", "truth"] {
                std::fs::create_dir_all(path.join(part)).expect("a temporary folder");
            }
            Self(path)
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn a_truth_folder_is_read() {
        let folder = Folder::new("truth");
        let json = folder.0.join("truth/a.json");
        let text = r#"{"depth_scale_mm": 0.1, "side": "left", "extra": 1,
            "camera": {"fx": 1000, "fy": 1001, "cx": 31.5, "cy": 23.5, "dist_k1k2p1p2k3": [0.1, 0, 0, 0, 0]},
            "screws": [{"u": 20.5, "v": 10, "xyz_mm": [-16, -20, 1500], "head_d_px": 8, "detectable": true,
                        "tags": ["rust_heavy"], "type": "truss", "plating": "zinc"}],
            "negatives": [{"kind": "hex_socket", "u": 40, "v": 30, "d_mm": 9, "xyz_mm": [0, 0, 1000]},
                          {"kind": "hole_empty", "u": 50, "v": 30, "d_mm": 6}]}"#;
        std::fs::write(&json, text).expect("a file");
        let color = image::RgbImage::from_pixel(64, 48, image::Rgb([90; 3]));
        geometry::write_jpeg(&folder.0.join("rgb/a.jpg"), &color, 90).expect("a picture");
        let depth = geometry::DepthMap {
            width: 32,
            height: 24,
            step: 2,
            depth_mm: vec![1500.0; 32 * 24],
        };
        geometry::write_depth_png(&folder.0.join("depth/a.png"), &depth, 0.1).expect("depth");

        let files = truth_files(&folder.0).expect("one file");
        assert_eq!((files.len(), &files[0]), (1, &json));
        let (frame, truth) = read_truth(&folder.0, &json).expect("whole");
        let camera = frame.camera.expect("a camera");
        assert_eq!((camera.width_px, camera.fy_px, camera.distortion[0]), (64, 1001.0, 0.1));
        let z = frame.depth.expect("depth").at(3, 3).expect("measured");
        assert!((z - 1500.0).abs() < 0.06, "{z}");
        let screw = &truth.screws[0];
        assert_eq!(
            (screw.pixel.u_px, screw.point.z_mm(), screw.head.as_str()),
            (20.5, 1500.0, "truss")
        );
        assert_eq!((truth.face.as_str(), truth.picture.as_str()), ("left", "a"));
        let [socket, hole] = truth.decoys.as_slice() else {
            panic!("two negatives")
        };
        assert!((socket.d_px - 9.0).abs() < 0.1 && (hole.d_px - 4.0).abs() < 0.1);
        assert_eq!((socket.drive(), hole.drive()), (Some(Drive::HexSocket), None));

        std::fs::write(&json, r#"{"depth_scale_mm": 0.1}"#).expect("a file");
        let bad = read_truth(&folder.0, &json).map(|_| ()).expect_err("no camera");
        assert!(
            bad.to_string().contains("a.json") && bad.to_string().contains("camera"),
            "{bad}"
        );
        std::fs::remove_file(&json).expect("was there");
        let none = truth_files(&folder.0).expect_err("no truth there");
        assert!(matches!(none, EvaluateError::Nothing { .. }), "{none}");
    }
}
