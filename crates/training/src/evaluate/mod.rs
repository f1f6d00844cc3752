//! What a detector is worth: its finds beside the truth, as rates with bounds.
//!
//! Four sources of truth: rendered faces that training never saw ([`evaluate_faces`]), a folder of pictures with exact truth from
//! anywhere ([`evaluate_truth_folder`]), photographs with boxes drawn by people ([`evaluate_photographs`]), and crops of e-waste
//! that training left out ([`evaluate_crops`]).

mod crops;
mod faces;
mod photographs;
mod scores;

pub use crops::{CropEvaluation, evaluate_crops};
pub use faces::{
    DecoyRow, DriveRow, Evaluation, Evaluator, FIRST_EVALUATION_SEED, Product, StageOne, evaluate_faces,
    evaluate_truth_folder, truth_files,
};
pub use photographs::{PhotoEvaluation, SceneRow, evaluate_photographs};
pub use scores::{CurvePoint, ReliabilityBin};

use std::fmt::{self, Formatter};
use std::path::{Path, PathBuf};

use geometry::{FileError, Pixel, Rate};
use serde::{Deserialize, Serialize};
use vision::{Screw, Verdict};

use crate::boxes::BoxesError;
use crate::train::TrainError;

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
    /// Pictures with boxes.
    #[error(transparent)]
    Boxes(#[from] BoxesError),
    /// The training data's folder.
    #[error(transparent)]
    Data(#[from] TrainError),
    /// An engine from outside that fails.
    #[error(transparent)]
    Engine(#[from] nn::NnError),
    /// A folder without anything to measure on.
    #[error("nothing to evaluate in {path}: {reason}")]
    Nothing {
        /// The folder or file.
        path: PathBuf,
        /// What was looked for.
        reason: String,
    },
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

/// Adds to a list that does not grow without end.
fn list<T>(list: &mut Vec<T>, entry: impl FnOnce() -> T) {
    if list.len() < LISTED {
        list.push(entry());
    }
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

fn unreadable(path: &Path, source: std::io::Error) -> EvaluateError {
    EvaluateError::File(FileError::Read {
        path: path.into(),
        source,
    })
}

fn read_text(path: &Path) -> Result<String, EvaluateError> {
    std::fs::read_to_string(path).map_err(|source| unreadable(path, source))
}

/// The snake-case name of an enum's value, as in the files.
fn word(value: &impl Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => word,
        _ => "unknown".into(),
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Point;
    use vision::{Detections, Drive, Timing};

    pub(super) fn find(u_px: f64, v_px: f64, verdict: Verdict, drive: Drive) -> Screw {
        Screw {
            pixel: Pixel::new(u_px, v_px),
            sigma_px: 0.5,
            diameter_px: 30.0,
            score: 0.9,
            fits: 0.9,
            drive,
            verdict,
            cues: Vec::new(),
            angle_rad: None,
            camera: Some(Point::new(0.3, 0.4, 1501.2)),
            normal: None,
            top_normal: None,
            sigma_lateral_mm: Some(0.1),
            sigma_depth_mm: Some(1.0),
        }
    }

    pub(super) fn detections(screws: Vec<Screw>) -> Detections {
        Detections {
            doubts: Vec::new(),
            screws,
            timing_ms: Timing::default(),
            model: "sha256:00".into(),
            size_px: (1000, 1000),
        }
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
}
