//! What a detector is worth: its finds beside the truth, as rates with bounds.
//!
//! Three sources of truth: rendered faces that training never saw ([`evaluate_faces`]), a folder of pictures with exact truth from
//! anywhere ([`evaluate_truth_folder`]), and photographs with boxes drawn by people ([`evaluate_yolo_folder`]).

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};
use std::ops::Range;
use std::path::{Path, PathBuf};

use geometry::{Camera, CameraModel, FileError, Pixel, Point, RgbImage, RgbdFrame, read_color, read_depth};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use scene::fastener::Decoy;
use scene::{FaceId, FaceTruth, FaceView, Prepared, Unit};
use serde::{Deserialize, Serialize};
use vision::layout::TRAINED_HEAD_PX;
use vision::{Detections, Detector, Drive, Options, Screw, Timing, Verdict, candidates, coarse_map, look};

use crate::real;
use crate::samples::{PATCH_PX, any_fastener};
use crate::train::TrainError;

/// Seeds from here on are for evaluation, smaller ones for training.
pub const FIRST_EVALUATION_SEED: u64 = 1_000_000;

/// A find belongs to a screw within so many head diameters of it.
const ON_SCREW: f64 = 0.5;
/// A find that belongs to no screw is put down to a decoy within so many of its diameters.
const ON_DECOY: f64 = 1.0;
/// A decoy of which less than this shows cannot be judged.
const DECOY_SHOWS: f64 = 0.5;
/// A find and a person's box are the same thing from this overlap on (intersection over union).
const SAME_BOX: f64 = 0.3;
/// Misses and false finds that are listed one by one.
const LISTED: usize = 200;
/// Of these, in the table for a terminal.
const PRINTED: usize = 12;

/// Why there is nothing to say. Each message names what, where and what to do.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The seed may have been trained on.
    #[error(
        "seed {seed} belongs to training; figures on it would flatter: give a seed of {FIRST_EVALUATION_SEED} or more"
    )]
    TrainingSeed {
        /// The seed.
        seed: u64,
    },
    /// A picture, depth or text that cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file with truth, labels or scenes that cannot be understood.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// The training data's folder.
    #[error(transparent)]
    Data(#[from] TrainError),
    /// A folder without anything to measure on.
    #[error("nothing to evaluate in {path}: {reason}")]
    Nothing {
        /// The folder or file.
        path: PathBuf,
        /// What was looked for.
        reason: String,
    },
}

/// What is rendered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Product {
    /// Worn outdoor units with all that may be taken for a screw.
    #[default]
    Units,
    /// The paper's gauge: a plate with nothing but screws.
    Gauge,
}

/// A share with its 95 % bounds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// How many were.
    pub hits: usize,
    /// Of how many.
    pub of: usize,
    /// hits / of; `None` of nothing.
    pub rate: Option<f64>,
    /// Lower 95 % bound.
    pub low: f64,
    /// Upper 95 % bound.
    pub high: f64,
}

impl Rate {
    /// A share with its Wilson score bounds.
    pub fn of(hits: usize, of: usize) -> Self {
        let (low, high) = wilson(hits, of);
        Self {
            hits,
            of,
            rate: (of > 0).then(|| hits as f64 / of as f64),
            low,
            high,
        }
    }
}

impl Display for Rate {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.rate {
            Some(rate) => write!(
                f,
                "{:6.2} %  ({} of {}; 95 %: {:.2} to {:.2} %)",
                100.0 * rate,
                self.hits,
                self.of,
                100.0 * self.low,
                100.0 * self.high
            ),
            None => write!(f, "     -    (of none)"),
        }
    }
}

/// 95 % bounds of a binomial share (Wilson 1927); (0, 1) of nothing.
pub fn wilson(hits: usize, of: usize) -> (f64, f64) {
    if of == 0 {
        return (0.0, 1.0);
    }
    wilson_share(hits as f64 / of as f64, of as f64)
}

fn wilson_share(p: f64, n: f64) -> (f64, f64) {
    const Z: f64 = 1.959_963_984_540_054;
    let center = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + Z * Z / n;
    (((center - half) / scale).max(0.0), ((center + half) / scale).min(1.0))
}

/// How large errors are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// Number of errors.
    pub n: usize,
    /// Half are smaller.
    pub median: f64,
    /// 95 % are smaller.
    pub p95: f64,
    /// 99 % are smaller.
    pub p99: f64,
    /// The largest.
    pub max: f64,
}

impl Quantiles {
    /// Of some errors, interpolated between neighbours; `None` of none.
    pub fn of(errors: &[f64]) -> Option<Self> {
        let mut sorted = errors.to_vec();
        sorted.sort_by(f64::total_cmp);
        let &max = sorted.last()?;
        let at = |q: f64| {
            let place = q * (sorted.len() - 1) as f64;
            let (low, part) = (place as usize, place.fract());
            let high = sorted[(low + 1).min(sorted.len() - 1)];
            sorted[low] + part * (high - sorted[low])
        };
        Some(Self {
            n: sorted.len(),
            median: at(0.5),
            p95: at(0.95),
            p99: at(0.99),
            max,
        })
    }
}

/// Whether sigmas are honest: shares of errors within one (should be 68.3 %) and 1.96 of them (95 %).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Within one sigma.
    pub one_sigma: Rate,
    /// Within 1.96 sigma.
    pub two_sigma: Rate,
}

impl Coverage {
    /// Of errors in units of their own sigma.
    pub fn of(relative_errors: &[f64]) -> Self {
        let within = |limit: f64| {
            Rate::of(
                relative_errors.iter().filter(|e| e.abs() <= limit).count(),
                relative_errors.len(),
            )
        };
        Self {
            one_sigma: within(1.0),
            two_sigma: within(1.96),
        }
    }
}

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

/// How well the drive of fasteners that the cross bit does not fit is told.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DriveRow {
    /// How many show.
    pub n: usize,
    /// Of these, reported with any verdict.
    pub found: usize,
    /// Of the found, with the right drive.
    pub right: usize,
}

/// A cross screw that was not called `screw`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Miss {
    /// The picture: a face's seed and name, or a file.
    pub picture: String,
    /// Where it is, px.
    pub u_px: f64,
    /// Where it is, px.
    pub v_px: f64,
    /// Its head, px.
    pub head_d_px: f64,
    /// Head, plating and wear; of a photograph its scene.
    pub tags: Vec<String>,
    /// What it was called instead: `review`, `other`, or `nothing`.
    pub called: String,
    /// Score of that find.
    pub score: Option<f64>,
    /// Whether stage 1 had a candidate there.
    pub candidate: Option<bool>,
}

/// A find of verdict `screw` where there is no cross screw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FalseFind {
    /// The picture: a face's seed and name, or a file.
    pub picture: String,
    /// Where it is, px.
    pub u_px: f64,
    /// Where it is, px.
    pub v_px: f64,
    /// What is there: a kind of decoy, or `background`.
    pub kind: String,
    /// Its score.
    pub score: f64,
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
    /// Other drives, by drive.
    pub by_drive: BTreeMap<String, DriveRow>,
    /// Reported fasteners of other drives whose drive is right.
    pub drive_right: Rate,
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

fn unreadable(path: &Path, source: std::io::Error) -> EvaluateError {
    EvaluateError::File(FileError::Read {
        path: path.into(),
        source,
    })
}

fn read_text(path: &Path) -> Result<String, EvaluateError> {
    std::fs::read_to_string(path).map_err(|source| unreadable(path, source))
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
        let (unit, face, source) = match product {
            Product::Units => {
                let face = FaceId::ALL[(seed % FaceId::ALL.len() as u64) as usize];
                (Unit::sample(seed), face, "rendered faces of outdoor units")
            }
            Product::Gauge => (
                Unit::gauge(seed),
                FaceId::Front,
                "rendered gauges with nothing but screws",
            ),
        };
        self.source = source.into();
        let [first, last] = self.seeds.unwrap_or([seed; 2]);
        self.seeds = Some([first.min(seed), last.max(seed)]);
        let Some(view) = FaceView::sample(&unit, face, seed) else {
            return Ok(()); // a unit without that face
        };
        let prepared = Prepared::new(&view);
        let rendered = prepared.render(None);
        let frame = RgbdFrame {
            color: rendered.color,
            depth: Some(rendered.depth),
            camera: Some(view.camera),
            t_s: 0.0,
        };
        let truth = Truth::of_face(format!("{seed} {}", face.name()), face.name(), &prepared.truth());
        self.measure(&frame, &truth);
        Ok(())
    }

    /// Measures on one picture of a folder with exact truth; `path` is one of [`truth_files`].
    ///
    /// # Errors
    /// An [`EvaluateError`] that names the file.
    pub fn truth_file(&mut self, folder: &Path, path: &Path) -> Result<(), EvaluateError> {
        let (frame, truth) = read_truth(folder, path)?;
        self.source = format!("pictures of {}", folder.display());
        self.measure(&frame, &truth);
        Ok(())
    }

    fn measure(&mut self, frame: &RgbdFrame, truth: &Truth) {
        let found = self.detector.detect(frame, self.options);
        let head_px = &self.options.head_px;
        let one_scale = TRAINED_HEAD_PX.contains(head_px.start()) && TRAINED_HEAD_PX.contains(head_px.end());
        // at one scale the network's pixels are the picture's
        let places = one_scale.then(|| {
            let model = self.detector.model();
            let map = coarse_map(&model.coarse, &frame.color);
            candidates(&map, &model.settings.thresholds)
                .iter()
                .map(|c| Pixel::new(c.pixel.u_px, c.pixel.v_px))
                .collect::<Vec<Pixel>>()
        });
        self.tally.add(truth, &found, places.as_deref());
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
        let drives = |f: fn(&DriveRow) -> usize| t.by_drive.values().map(f).sum();
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
            without_depth: t.without_depth,
            sigma: Coverage::of(&relative),
            depth_sigma: Coverage::of(&spaces(|e| e.mm[2] / e.sigma_depth_mm)),
            drive_right: Rate::of(drives(|d| d.right), drives(|d| d.found)),
            timing_ms: Timing {
                decode: timings(|t| t.decode),
                coarse: timings(|t| t.coarse),
                fine: timings(|t| t.fine),
                centre: timings(|t| t.centre),
                locate: timings(|t| t.locate),
                total: timings(|t| t.total),
            },
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
        known.drive().map(|drive| match drive {
            scene::fastener::Drive::Cross => Drive::Cross,
            scene::fastener::Drive::Slotted => Drive::Slotted,
            scene::fastener::Drive::HexSocket => Drive::HexSocket,
            scene::fastener::Drive::Torx => Drive::Torx,
            scene::fastener::Drive::HexHead => Drive::HexHead,
        })
    }
}

impl Truth {
    fn of_face(picture: String, face: &str, truth: &FaceTruth) -> Self {
        let screws = truth.screws.iter().map(|s| TrueScrew {
            pixel: s.pixel,
            point: s.point,
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

/// The snake-case name of an enum's value, as in the files.
fn word(value: &impl Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => word,
        _ => "unknown".into(),
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

/// The find that speaks for an item: an action weighs more than a question, a question more than a note.
fn speaker<'a>(finds: impl Iterator<Item = &'a Screw>, at: Pixel) -> Option<&'a Screw> {
    let rank = |s: &Screw| match s.verdict {
        Verdict::Screw => 0,
        Verdict::Review => 1,
        Verdict::Other => 2,
    };
    finds.min_by(|a, b| {
        let far = |s: &Screw| s.pixel.distance_px(&at);
        rank(a).cmp(&rank(b)).then(far(a).total_cmp(&far(b)))
    })
}

#[derive(Clone, Copy, Default)]
struct Share {
    hits: usize,
    of: usize,
}

impl Share {
    fn add(&mut self, hit: bool) {
        self.hits += usize::from(hit);
        self.of += 1;
    }

    fn rate(self) -> Rate {
        Rate::of(self.hits, self.of)
    }
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
    undetectable: Share,
    stage_one: Option<Share>,
    candidates: usize,
    center: Vec<CenterError>,
    space: Vec<SpaceError>,
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
            let kind = match *subject {
                Subject::Screw(_) => continue,
                Subject::Decoy(k) => truth.decoys[k].kind.as_str(),
                Subject::Background => "background",
            };
            if find.verdict != Verdict::Screw {
                self.idle_reviews += usize::from(find.verdict == Verdict::Review);
                continue;
            }
            self.false_finds += 1;
            self.by_decoy.entry(kind.into()).or_default().false_finds += 1;
            list(&mut self.false_list, || FalseFind::new(&truth.picture, find, kind));
        }
    }

    /// A detectable screw and the find that speaks for it.
    fn screw(&mut self, truth: &Truth, screw: &TrueScrew, find: Option<&Screw>, candidate: Option<bool>) {
        let hit = find.filter(|f| f.verdict == Verdict::Screw);
        let found = hit.is_some();
        self.recall.add(found);
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
            let row = self.by_drive.entry(drive.name().into()).or_default();
            row.n += 1;
            row.found += usize::from(find.is_some());
            row.right += usize::from(find.is_some_and(|f| f.drive == drive));
        }
    }
}

/// Adds to a list that does not grow without end.
fn list<T>(list: &mut Vec<T>, entry: impl FnOnce() -> T) {
    if list.len() < LISTED {
        list.push(entry());
    }
}

impl Miss {
    fn new(picture: &str, at: Pixel, head_d_px: f64, tags: Vec<String>, find: Option<&Screw>) -> Self {
        Self {
            picture: picture.into(),
            u_px: at.u_px,
            v_px: at.v_px,
            head_d_px,
            tags,
            called: find.map_or("nothing".into(), |f| word(&f.verdict)),
            score: find.map(|f| f.score),
            candidate: None,
        }
    }
}

impl FalseFind {
    fn new(picture: &str, find: &Screw, kind: &str) -> Self {
        Self {
            picture: picture.into(),
            u_px: find.pixel.u_px,
            v_px: find.pixel.v_px,
            kind: kind.into(),
            score: find.score,
        }
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

/// The photographs of one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SceneRow {
    /// Photographs of it.
    pub photos: usize,
    /// Distinct cross screws: the most that one photograph shows.
    pub distinct: usize,
    /// Share of the cross screws found, mean over its photographs; `None` without cross screws.
    pub found: Option<f64>,
    /// False finds a photograph.
    pub false_finds_mean: f64,
}

/// What a detector is worth on photographs with boxes drawn by people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoEvaluation {
    /// What it was measured on.
    pub source: String,
    /// The model: `sha256:` and its hash.
    pub model: String,
    /// Head diameters that were looked for, px.
    pub head_px: [f64; 2],
    /// Number of photographs.
    pub photos: usize,
    /// Distinct cross screws: over all scenes, the most that one photograph shows.
    pub distinct: usize,
    /// Recall per distinct cross screw: the mean over the photographs of a scene, weighted with its distinct screws.
    pub recall_distinct: Option<f64>,
    /// Its 95 % bounds (Wilson, of that many distinct screws).
    pub recall_distinct_bounds: [f64; 2],
    /// Labelled cross screws found, copies counted as often as they occur.
    pub recall: Rate,
    /// Labelled cross screws found or left to a person.
    pub recall_or_review: Rate,
    /// Labelled cross screws reported with any verdict.
    pub recall_any: Rate,
    /// Finds of verdict `screw` on no labelled cross screw.
    pub false_finds: usize,
    /// The same a photograph.
    pub false_finds_mean: f64,
    /// Of these, on a labelled hexagon.
    pub hex_called_screw: usize,
    /// Labelled hexagons.
    pub hexagons: usize,
    /// Drive that reported labels were given: by label (`cross`, `hex`), then by drive.
    pub drives: BTreeMap<String, BTreeMap<String, usize>>,
    /// By scene.
    pub scenes: BTreeMap<String, SceneRow>,
    /// Labelled cross screws not found, at most 200.
    pub misses: Vec<Miss>,
    /// False finds, at most 200.
    pub false_list: Vec<FalseFind>,
    /// Mean time a photograph, ms.
    pub total_ms: f64,
}

/// A box drawn by a person, px.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Label {
    cross: bool,
    low: [f64; 2],
    high: [f64; 2],
}

impl Label {
    fn center(&self) -> Pixel {
        Pixel::new(0.5 * (self.low[0] + self.high[0]), 0.5 * (self.low[1] + self.high[1]))
    }

    /// True if the find's centre lies in the box, or its own box is much the same.
    fn holds(&self, find: &Screw) -> bool {
        let at = [find.pixel.u_px, find.pixel.v_px];
        if (0..2).all(|k| at[k] >= self.low[k] && at[k] <= self.high[k]) {
            return true;
        }
        let (mut both, mut own) = (1.0, 1.0);
        for ((at, low), high) in at.into_iter().zip(self.low).zip(self.high) {
            let half = 0.5 * find.diameter_px;
            both *= (high.min(at + half) - low.max(at - half)).max(0.0);
            own *= high - low;
        }
        both > SAME_BOX * (find.diameter_px * find.diameter_px + own - both)
    }
}

/// Lines of `class x y w h`, or `class x1 y1 x2 y2 x3 y3 ...` (a polygon), as shares of the picture's size.
fn parse_labels(text: &str, size_px: (u32, u32)) -> Result<Vec<Label>, String> {
    let size = [f64::from(size_px.0), f64::from(size_px.1)];
    let mut labels = Vec::new();
    for (line, number) in text.lines().zip(1..) {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [class, numbers @ ..] = fields.as_slice() else {
            continue;
        };
        let cross = match *class {
            "0" => false,
            "1" => true,
            other => {
                return Err(format!(
                    "line {number}: class {other}; expected 0 (hexagon) or 1 (cross)"
                ));
            }
        };
        let finite = |n: &&str| n.parse().ok().filter(|v: &f64| v.is_finite());
        let values: Option<Vec<f64>> = numbers.iter().map(finite).collect();
        let values = values.ok_or_else(|| format!("line {number}: expected numbers after the class"))?;
        let (low, high) = match values.as_slice() {
            [x, y, w, h] => ([x - 0.5 * w, y - 0.5 * h], [x + 0.5 * w, y + 0.5 * h]),
            corners if corners.len() >= 6 && corners.len() % 2 == 0 => {
                let each = |k: usize| corners.iter().skip(k).step_by(2).copied();
                (
                    [0, 1].map(|k| each(k).fold(f64::MAX, f64::min)),
                    [0, 1].map(|k| each(k).fold(f64::MIN, f64::max)),
                )
            }
            _ => {
                let n = values.len();
                return Err(format!(
                    "line {number}: {n} numbers after the class; expected a box of 4 or a polygon"
                ));
            }
        };
        // shares are of areas: their 0 is the outer edge of pixel 0
        let to_px = |share: [f64; 2]| [0, 1].map(|k| share[k] * size[k] - 0.5);
        labels.push(Label {
            cross,
            low: to_px(low),
            high: to_px(high),
        });
    }
    Ok(labels)
}

/// The columns `file` and `scene` of a manifest.
fn parse_manifest(text: &str) -> Result<Vec<(String, String)>, String> {
    let mut lines = text.lines().zip(1..);
    let fields = |line: &str| -> Vec<String> { line.split(',').map(|f| f.trim().to_owned()).collect() };
    let header = lines.next().map(|(line, _)| fields(line)).unwrap_or_default();
    let column = |name: &str| {
        let place = header.iter().position(|h| h == name);
        place.ok_or_else(|| format!("no column {name}; expected a CSV file with the columns file and scene"))
    };
    let (file, scene) = (column("file")?, column("scene")?);
    let mut rows = Vec::new();
    for (line, number) in lines.filter(|(l, _)| !l.trim().is_empty()) {
        let row = fields(line);
        if row.len() != header.len() {
            return Err(format!(
                "line {number} has {} fields, its header {}; names must not hold commas",
                row.len(),
                header.len()
            ));
        }
        rows.push((row[file].clone(), row[scene].clone()));
    }
    Ok(rows)
}

/// Measures a detector on photographs with boxes in YOLO's format, class 1 a cross recess, 0 a hexagon.
///
/// Many photographs may be photometric copies of one another: figures are per scene first.
///
/// # Arguments
/// * `manifest` – CSV with the columns `file` (in `images`) and `scene`.
/// * `scenes` – only these; `None`: all.
/// * `progress` – told the number of photographs done, and of all.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_yolo_folder(
    detector: &Detector,
    options: &Options,
    images: &Path,
    labels: &Path,
    manifest: &Path,
    scenes: Option<&[String]>,
    progress: &(dyn Fn(u64, u64) + Sync),
) -> Result<PhotoEvaluation, EvaluateError> {
    let format = |path: &Path, reason: String| EvaluateError::Format {
        path: path.into(),
        reason,
    };
    let mut rows = parse_manifest(&read_text(manifest)?).map_err(|reason| format(manifest, reason))?;
    if let Some(wanted) = scenes {
        let known: BTreeSet<&str> = rows.iter().map(|(_, scene)| scene.as_str()).collect();
        if let Some(unknown) = wanted.iter().find(|w| !known.contains(w.as_str())) {
            let known: Vec<&str> = known.into_iter().collect();
            let reason = format!("no scene {unknown}; there are {}", known.join(", "));
            return Err(format(manifest, reason));
        }
        rows.retain(|(_, scene)| wanted.contains(scene));
    }
    if rows.is_empty() {
        return Err(EvaluateError::Nothing {
            path: manifest.into(),
            reason: "it lists no photograph".into(),
        });
    }
    let mut tally = PhotoTally::default();
    for ((file, scene), done) in rows.iter().zip(1..) {
        let picture = read_color(&images.join(file))?;
        let path = labels.join(Path::new(file).with_extension("txt"));
        let labels = parse_labels(&read_text(&path)?, picture.dimensions()).map_err(|reason| format(&path, reason))?;
        tally.add(file, scene, &labels, &detector.detect_image(&picture, options));
        progress(done, rows.len() as u64);
    }
    let head_px = [*options.head_px.start(), *options.head_px.end()];
    let source = format!("photographs of {}", images.display());
    Ok(tally.finish(source, detector.model().id(), head_px))
}

#[derive(Default)]
struct PhotoTally {
    photos: usize,
    recall: Share,
    review: usize,
    any: usize,
    hexagons: usize,
    false_finds: usize,
    hex_called_screw: usize,
    drives: BTreeMap<String, BTreeMap<String, usize>>,
    /// By scene: found and labelled cross screws, and false finds, of each photograph.
    scenes: BTreeMap<String, Vec<(Share, usize)>>,
    misses: Vec<Miss>,
    false_list: Vec<FalseFind>,
    total_ms: f64,
}

impl PhotoTally {
    fn add(&mut self, file: &str, scene: &str, labels: &[Label], found: &Detections) {
        self.photos += 1;
        self.total_ms += found.timing_ms.total;
        // a find belongs to the nearest box that holds it, so that one find cannot stand for two screws
        let owner = |find: &Screw| {
            let far = |l: &Label| l.center().distance_px(&find.pixel);
            let held = labels.iter().enumerate().filter(|(_, l)| l.holds(find));
            held.min_by(|a, b| far(a.1).total_cmp(&far(b.1))).map(|(k, _)| k)
        };
        let owners: Vec<Option<usize>> = found.screws.iter().map(owner).collect();
        let (mut share, mut false_finds) = (Share::default(), 0);
        for (k, label) in labels.iter().enumerate() {
            let finds = found.screws.iter().zip(&owners);
            let own = finds.filter(|(_, o)| **o == Some(k)).map(|(find, _)| find);
            let find = speaker(own, label.center());
            if let Some(find) = find {
                let name = if label.cross { "cross" } else { "hex" };
                let drives = self.drives.entry(name.into()).or_default();
                *drives.entry(find.drive.name().into()).or_default() += 1;
            }
            if !label.cross {
                self.hexagons += 1;
                continue;
            }
            let hit = find.is_some_and(|f| f.verdict == Verdict::Screw);
            share.add(hit);
            self.recall.add(hit);
            self.any += usize::from(find.is_some());
            self.review += usize::from(find.is_some_and(|f| f.verdict == Verdict::Review));
            if !hit {
                let side_px = (label.high[0] - label.low[0]).max(label.high[1] - label.low[1]);
                list(&mut self.misses, || {
                    Miss::new(file, label.center(), side_px, vec![scene.into()], find)
                });
            }
        }
        for find in found.screws.iter().filter(|f| f.verdict == Verdict::Screw) {
            if labels.iter().any(|l| l.cross && l.holds(find)) {
                continue;
            }
            let hex = labels.iter().any(|l| l.holds(find));
            false_finds += 1;
            self.hex_called_screw += usize::from(hex);
            let kind = if hex { "hex" } else { "background" };
            list(&mut self.false_list, || FalseFind::new(file, find, kind));
        }
        self.false_finds += false_finds;
        self.scenes.entry(scene.into()).or_default().push((share, false_finds));
    }

    fn finish(self, source: String, model: &str, head_px: [f64; 2]) -> PhotoEvaluation {
        let row = |photos: &Vec<(Share, usize)>| {
            let shares: Vec<f64> = photos.iter().filter_map(|(s, _)| s.rate().rate).collect();
            SceneRow {
                photos: photos.len(),
                distinct: photos.iter().map(|(s, _)| s.of).max().unwrap_or(0),
                found: (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64),
                false_finds_mean: photos.iter().map(|(_, f)| *f as f64).sum::<f64>() / photos.len().max(1) as f64,
            }
        };
        let scenes: BTreeMap<String, SceneRow> = self.scenes.iter().map(|(name, p)| (name.clone(), row(p))).collect();
        let distinct: usize = scenes.values().map(|s| s.distinct).sum();
        let found: f64 = scenes.values().filter_map(|s| Some(s.found? * s.distinct as f64)).sum();
        let share = (distinct > 0).then(|| found / distinct as f64);
        let bounds = share.map_or((0.0, 1.0), |p| wilson_share(p, distinct as f64));
        let n = self.photos.max(1) as f64;
        PhotoEvaluation {
            source,
            model: model.to_owned(),
            head_px,
            photos: self.photos,
            distinct,
            recall_distinct: share,
            recall_distinct_bounds: bounds.into(),
            recall: self.recall.rate(),
            recall_or_review: Rate::of(self.recall.hits + self.review, self.recall.of),
            recall_any: Rate::of(self.any, self.recall.of),
            false_finds: self.false_finds,
            false_finds_mean: self.false_finds as f64 / n,
            hex_called_screw: self.hex_called_screw,
            hexagons: self.hexagons,
            drives: self.drives,
            scenes,
            misses: self.misses,
            false_list: self.false_list,
            total_ms: self.total_ms / n,
        }
    }
}

/// Stage 2 on real crops of held-out groups: a fastener of any drive, against holes and everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CropEvaluation {
    /// Screws of any drive that were called a fastener.
    pub fasteners: Rate,
    /// Holes and other things that were not.
    pub others: Rate,
    /// Mean of the two.
    pub balanced_accuracy: f64,
}

/// Measures stage 2 on the held-out crops of the training data's folder.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_crops(detector: &Detector, data: &Path) -> Result<CropEvaluation, EvaluateError> {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let (mut fasteners, mut others) = (Share::default(), Share::default());
    for patch in real::crops(data, true, &mut rng)? {
        let side = PATCH_PX as u32;
        let (Some(label), Some(picture)) = (patch.labels.first(), RgbImage::from_raw(side, side, patch.rgb.clone()))
        else {
            continue;
        };
        let place = Pixel::new(f64::from(label.u_px), f64::from(label.v_px));
        let evidence = look(&detector.model().fine, &picture, &[place]);
        let called = evidence.iter().any(|e| e.fastener() >= 0.5);
        if label.classes == any_fastener() {
            fasteners.add(called);
        } else {
            others.add(!called);
        }
    }
    let (fasteners, others) = (fasteners.rate(), others.rate());
    Ok(CropEvaluation {
        fasteners,
        others,
        balanced_accuracy: 0.5 * (fasteners.rate.unwrap_or(0.0) + others.rate.unwrap_or(0.0)),
    })
}

/// A name cut to fit its column.
fn cut(text: &str, width: usize) -> String {
    match text.char_indices().nth(width) {
        None => text.to_owned(),
        Some(_) => text.chars().take(width - 1).chain(['~']).collect(),
    }
}

/// As in the tables: `98.7`, or `-` of nothing.
fn percent(share: Option<f64>, digits: usize) -> String {
    share.map_or("-".into(), |s| format!("{:.digits$}", 100.0 * s))
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

fn write_lists(f: &mut Formatter<'_>, misses: &[Miss], false_list: &[FalseFind]) -> fmt::Result {
    if !misses.is_empty() {
        writeln!(f, "\nnot found")?;
    }
    for miss in misses.iter().take(PRINTED) {
        let called = match miss.score {
            Some(score) => format!("{} {score:.2}", miss.called),
            None if miss.candidate == Some(false) => "nothing (stage 1)".into(),
            None => miss.called.clone(),
        };
        let (picture, tags) = (cut(&miss.picture, 20), cut(&miss.tags.join(" "), 28));
        let (u, v, d) = (miss.u_px, miss.v_px, miss.head_d_px);
        writeln!(f, "  {picture:<20} {u:7.1} {v:7.1}  head {d:5.1}  {called:<17}  {tags}")?;
    }
    if !false_list.is_empty() {
        writeln!(f, "\nfalse finds")?;
    }
    for find in false_list.iter().take(PRINTED) {
        let (picture, kind) = (cut(&find.picture, 20), &find.kind);
        writeln!(
            f,
            "  {picture:<20} {:7.1} {:7.1}  score {:.3}  {kind}",
            find.u_px, find.v_px, find.score
        )?;
    }
    if misses.len() > PRINTED || false_list.len() > PRINTED {
        writeln!(f, "  (the first {PRINTED} of each; the JSON has the first {LISTED})")?;
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
            "false        {} finds; {} reviews of what is no cross screw",
            self.false_finds, self.idle_reviews
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
                "other drives", "n", "found", "drive right"
            )?;
            for (name, d) in &self.by_drive {
                writeln!(f, "  {name:<20} {:>6} {:>6} {:>12}", d.n, d.found, d.right)?;
            }
            writeln!(f, "  right of found {}", self.drive_right)?;
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

impl Display for PhotoEvaluation {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "model        {}", self.model)?;
        writeln!(f, "measured on  {} {}", self.photos, self.source)?;
        writeln!(f, "heads        {} to {} px", self.head_px[0], self.head_px[1])?;
        match self.recall_distinct {
            Some(recall) => writeln!(
                f,
                "recall     {:6.2} %  (of {} distinct cross screws; 95 %: {:.1} to {:.1} %)",
                100.0 * recall,
                self.distinct,
                100.0 * self.recall_distinct_bounds[0],
                100.0 * self.recall_distinct_bounds[1]
            )?,
            None => writeln!(f, "recall          -    (no cross screws)")?,
        }
        writeln!(f, "of labels  {}", self.recall)?;
        writeln!(f, "  + review {}", self.recall_or_review)?;
        writeln!(f, "  any      {}", self.recall_any)?;
        writeln!(
            f,
            "false        {} finds, {:.2} a photograph; {} of them on one of {} hexagons",
            self.false_finds, self.false_finds_mean, self.hex_called_screw, self.hexagons
        )?;
        if !self.drives.is_empty() {
            writeln!(f, "\nlabel    drive it was given")?;
        }
        for (label, drives) in &self.drives {
            let drives: Vec<String> = drives.iter().map(|(drive, n)| format!("{drive} {n}")).collect();
            writeln!(f, "  {label:<6} {}", drives.join(", "))?;
        }
        let [photos, distinct, found, false_finds] = ["photos", "distinct", "found %", "false a photo"];
        writeln!(
            f,
            "\n{:<22} {photos:>6} {distinct:>9} {found:>9} {false_finds:>14}",
            "scene"
        )?;
        for (name, s) in &self.scenes {
            let (name, found) = (cut(name, 20), percent(s.found, 1));
            writeln!(
                f,
                "  {name:<20} {:>6} {:>9} {found:>9} {:>14.2}",
                s.photos, s.distinct, s.false_finds_mean
            )?;
        }
        write_lists(f, &self.misses, &self.false_list)?;
        writeln!(f, "\nmean time    {:.0} ms a photograph", self.total_ms)
    }
}

impl Display for CropEvaluation {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "fasteners of any drive  {}", self.fasteners)?;
        writeln!(f, "holes and others        {}", self.others)?;
        writeln!(f, "balanced accuracy       {:6.2} %", 100.0 * self.balanced_accuracy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn find(u_px: f64, v_px: f64, verdict: Verdict, drive: Drive) -> Screw {
        Screw {
            pixel: Pixel::new(u_px, v_px),
            sigma_px: 0.5,
            diameter_px: 30.0,
            score: 0.9,
            drive,
            verdict,
            cues: Vec::new(),
            angle_rad: None,
            camera: Some(Point::new(0.3, 0.4, 1501.2)),
            normal: None,
            sigma_lateral_mm: Some(0.1),
            sigma_depth_mm: Some(1.0),
        }
    }

    fn detections(screws: Vec<Screw>) -> Detections {
        Detections {
            screws,
            timing_ms: Timing::default(),
            model: "sha256:00".into(),
            size_px: (1000, 1000),
        }
    }

    fn screw(u_px: f64, detectable: bool, tag: &str) -> TrueScrew {
        TrueScrew {
            pixel: Pixel::new(u_px, 100.0),
            point: Point::new(0.0, 0.0, 1500.0),
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
        ];
        let places = [
            Pixel::new(105.0, 100.0),
            Pixel::new(312.0, 100.0),
            Pixel::new(480.0, 100.0),
        ];
        let e = evaluation(&truth, finds, Some(&places));
        assert_eq!((e.recall.hits, e.recall.of, e.recall_or_review.hits), (1, 5, 2));
        assert_eq!((e.called_other, e.dropped, e.repeated), (1, 2, 1));
        assert_eq!((e.undetectable, e.undetectable_found, e.idle_reviews), (1, 1, 1));
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
        assert_eq!((e.drive_right.hits, e.drive_right.of), (1, 3));
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
    fn bounds_of_the_paper_s_gauge() {
        let (low, high) = wilson(3064, 3070);
        assert_eq!([(low * 1e4).round(), (high * 1e4).round()], [9957.0, 9991.0]);
        assert_eq!(wilson(0, 0), (0.0, 1.0));
        assert!(wilson(5, 5).1 > 0.999_999 && wilson(5, 5).0 < 0.6 && wilson(0, 5).0 < 1e-12);
    }

    #[test]
    fn quantiles_and_coverage() {
        let errors: Vec<f64> = (0..=100).rev().map(f64::from).collect();
        let q = Quantiles::of(&errors).expect("not empty");
        assert_eq!((q.n, q.median, q.p95, q.p99, q.max), (101, 50.0, 95.0, 99.0, 100.0));
        assert_eq!(Quantiles::of(&[1.0, 2.0]).map(|q| q.median), Some(1.5));
        assert_eq!(Quantiles::of(&[]), None);
        let c = Coverage::of(&[0.5, -0.9, 1.5, -1.95, 3.0, f64::NAN]);
        assert_eq!((c.one_sigma.hits, c.two_sigma.hits, c.two_sigma.of), (2, 4, 6));
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

    #[test]
    fn photographs_are_counted_by_scene() {
        let text = "1 0.1 0.1 0.05 0.05\n\n0 0.5 0.5 0.6 0.5 0.6 0.6 0.5 0.6\n";
        let labels = parse_labels(text, (1000, 1000)).expect("a box and a polygon");
        let near = |a: [f64; 2], b: f64| a.iter().all(|a| (a - b).abs() < 1e-9);
        assert!(labels[0].cross && near(labels[0].low, 74.5) && near(labels[0].high, 124.5));
        assert!(!labels[1].cross && near(labels[1].low, 499.5) && near(labels[1].high, 599.5));
        assert!(parse_labels("2 0 0 1 1", (9, 9)).is_err() && parse_labels("1 0 0 1", (9, 9)).is_err());

        let acted = |at: f64| find(at, at, Verdict::Screw, Drive::Cross);
        let mut tally = PhotoTally::default();
        tally.add("a", "one", &labels, &detections(vec![acted(100.0), acted(550.0)]));
        let bolt = find(550.0, 550.0, Verdict::Other, Drive::HexHead);
        tally.add("b", "one", &labels, &detections(vec![bolt]));
        let second = Label {
            cross: true,
            low: [200.0; 2],
            high: [230.0; 2],
        };
        let finds = vec![acted(100.0), acted(216.0), acted(800.0)];
        tally.add("c", "two", &[labels[0], second], &detections(finds));
        let e = tally.finish("x".into(), "sha256:00", [15.0, 80.0]);
        assert_eq!((e.distinct, e.photos, e.hexagons), (3, 3, 2));
        // scene one: half of one screw; scene two: both of two
        assert!((e.recall_distinct.expect("screws") - 2.5 / 3.0).abs() < 1e-12, "{e:?}");
        assert_eq!((e.recall.hits, e.recall.of), (3, 4));
        assert_eq!(
            (e.false_finds, e.hex_called_screw, e.false_finds_mean),
            (2, 1, 2.0 / 3.0)
        );
        assert_eq!((e.drives["hex"]["cross"], e.drives["hex"]["hex_head"]), (1, 1));
        assert_eq!(e.drives["cross"]["cross"], 3);
        assert!(e.to_string().lines().all(|l| l.chars().count() <= 100), "{e}");

        // a centre outside the box: a good overlap serves, too little of one does not
        let at = |u_px: f64| find(u_px, 215.0, Verdict::Screw, Drive::Cross);
        assert!(second.holds(&at(199.0)) && !second.holds(&at(192.0)));
    }

    #[test]
    fn manifests() {
        let rows = parse_manifest("scene,file,n\ns1,a.jpg,3\n\ns2,b.jpg,4\n").expect("two rows");
        assert_eq!(rows[1], ("b.jpg".into(), "s2".into()));
        assert!(parse_manifest("file,n\n").is_err_and(|e| e.contains("scene")));
        assert!(parse_manifest("file,scene\na,b,c\n").is_err_and(|e| e.contains("line 2")));
    }
}
