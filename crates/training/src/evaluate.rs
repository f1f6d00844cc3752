//! What a detector is worth: recall, precision and errors on faces and photographs that it has not learned from, with bounds.
//!
//! A true screw is *found* where a find with the verdict `screw` lies within half its head diameter. A find with that verdict that is near no
//! cross screw is a *false find*; `other` on a hexagon bolt is right. Screws that are not detectable count on neither side.

use crate::real;
use geometry::{Camera, CameraModel, FileError, Pixel, Point, RgbImage, RgbdFrame, read_color, read_depth};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use scene::{FaceId, FaceView, Prepared, Unit};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};
use vision::{Detector, Options, Screw, Verdict, candidates, coarse_map, look};

/// Units from this seed on are never trained nor tuned on.
pub const FIRST_EVALUATION_SEED: u64 = 1_000_000;
/// A find within this many head diameters of a screw is that screw.
const MATCH_RADIUS: f64 = 0.5;
/// Small marks have a neighbourhood too, px.
const MIN_DECOY_RADIUS_PX: f64 = 8.0;

/// Why a detector could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// Seeds that belong to training.
    #[error("units below seed {FIRST_EVALUATION_SEED} are for training; start at {FIRST_EVALUATION_SEED} instead of {start}")]
    TrainedOn {
        /// First seed asked for.
        start: u64,
    },
    /// A file or folder could not be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A truth file with other contents than expected.
    #[error("{path} is not a truth file (screws, negatives, camera): {source}")]
    Truth {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// A folder without anything to measure on.
    #[error("nothing to measure on in {path}: {expected}")]
    Empty {
        /// The folder.
        path: PathBuf,
        /// What should be there.
        expected: &'static str,
    },
    /// A picture.
    #[error(transparent)]
    File(#[from] FileError),
    /// The real photographs of the training data.
    #[error(transparent)]
    Train(#[from] crate::TrainError),
}

/// Lower and upper end of Wilson's 95 % interval for `k` of `n`.
///
/// ```
/// let (low, high) = training::wilson(3064, 3070);
/// assert!((low - 0.99574).abs() < 1e-4 && (high - 0.99910).abs() < 1e-4);
/// ```
pub fn wilson(k: usize, n: usize) -> (f64, f64) {
    if n == 0 {
        return (0.0, 1.0);
    }
    let (z, n) = (1.959_964, n as f64);
    let p = k as f64 / n;
    let middle = p + z * z / (2.0 * n);
    let half = z * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + z * z / n;
    (((middle - half) / scale).max(0.0), ((middle + half) / scale).min(1.0))
}

/// A share with Wilson's 95 % bounds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// How many.
    pub k: usize,
    /// Of how many.
    pub n: usize,
    /// k / n; 0 where n is 0.
    pub share: f64,
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
}

impl Share {
    /// `k` of `n`.
    pub fn new(k: usize, n: usize) -> Self {
        let (low, high) = wilson(k, n);
        Self { k, n, share: k as f64 / n.max(1) as f64, low, high }
    }
}

impl fmt::Display for Share {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { k, n, share, low, high } = self;
        write!(f, "{:.2} % ({k} of {n}; {:.2} to {:.2})", 100.0 * share, 100.0 * low, 100.0 * high)
    }
}

/// How errors are spread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Values.
    pub n: usize,
    /// Half of them are at most this.
    pub median: f64,
    /// 95 % of them are at most this.
    pub p95: f64,
    /// 99 % of them are at most this.
    pub p99: f64,
    /// The largest.
    pub max: f64,
}

impl Spread {
    /// Of some values, in any order.
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let n = values.len();
        let at = |q: f64| values.get(((q * n as f64).ceil() as usize).clamp(1, n.max(1)) - 1).copied().unwrap_or(0.0);
        Self { n, median: at(0.5), p95: at(0.95), p99: at(0.99), max: at(1.0) }
    }
}

impl fmt::Display for Spread {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { n, median, p95, p99, max } = self;
        write!(f, "median {median:.3}  p95 {p95:.3}  p99 {p99:.3}  max {max:.2}  (n {n})")
    }
}

/// What became of the screws of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ScrewTally {
    /// Detectable screws.
    pub screws: usize,
    /// Found.
    pub found: usize,
    /// Left for a person to look at.
    pub review: usize,
}

/// What the things of one kind that are no cross screws were called.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NegativeTally {
    /// How many there are.
    pub shown: usize,
    /// Called a screw: false.
    pub screw: usize,
    /// Left for a person to look at.
    pub review: usize,
    /// Called a fastener of another drive.
    pub other: usize,
    /// Passed over.
    pub dropped: usize,
}

/// A screw that was missed, or a find that is none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mistake {
    /// The picture.
    pub image: String,
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
    /// Head diameter, px.
    pub diameter_px: f64,
    /// Wear of the missed screw, or what the false find really is.
    pub what: String,
    /// What the detector made of it.
    pub called: String,
}

/// Figures of a detector on faces with known truth.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// The model.
    pub model: String,
    /// Pictures.
    pub faces: usize,
    /// Detectable screws found.
    pub recall: Share,
    /// Finds called `screw` that are cross screws.
    pub precision: Share,
    /// Detectable screws left for a person to look at.
    pub review: Share,
    /// Finds of verdict `review` that are no screw, a face.
    pub idle_looks_a_face: f64,
    /// Detectable screws among the candidates of stage 1.
    pub stage_1: Share,
    /// Candidates of stage 1 a face.
    pub candidates_a_face: f64,
    /// Stage 2 alone, shown the true places: screws accepted.
    pub stage_2: Share,
    /// Stage 2 alone, shown the true places: things that are no cross screw, accepted.
    pub stage_2_false: Share,
    /// Fasteners found whose drive was named rightly.
    pub drive: Share,
    /// Distance from true recess centre, px.
    pub centre_px: Spread,
    /// The same in the plane of the screw, mm.
    pub centre_mm: Spread,
    /// Across the optical axis, mm, where there is depth.
    pub lateral_mm: Spread,
    /// Along it, mm.
    pub depth_mm: Spread,
    /// Centre errors along one axis within one stated sigma: should be 68.3 %.
    pub within_1_sigma: Share,
    /// Within two: should be 95.4 %.
    pub within_2_sigma: Share,
    /// By wear.
    pub by_wear: BTreeMap<String, ScrewTally>,
    /// By kind of negative.
    pub by_negative: BTreeMap<String, NegativeTally>,
    /// Screws that were not found.
    pub missed: Vec<Mistake>,
    /// False finds.
    pub false_finds: Vec<Mistake>,
    /// Time of a detection, ms.
    pub detect_ms: Spread,
}

/// A cross screw in a picture.
struct TrueScrew {
    pixel: Pixel,
    point: Point<Camera>,
    head_d_px: f64,
    mm_per_px: f64,
    detectable: bool,
    tags: Vec<String>,
}

/// Something else in a picture.
struct TrueNegative {
    kind: String,
    drive: Option<&'static str>,
    pixel: Pixel,
    d_px: f64,
}

/// A picture with all that is in it.
struct Shot {
    name: String,
    frame: RgbdFrame,
    screws: Vec<TrueScrew>,
    negatives: Vec<TrueNegative>,
}

/// Adds up what happens on one shot after another.
#[derive(Default)]
struct Tally {
    found: usize,
    detectable: usize,
    review: usize,
    right: usize,
    idle_looks: usize,
    candidate: usize,
    candidates: usize,
    stage_2: [usize; 2],
    stage_2_false: [usize; 2],
    drive: [usize; 2],
    sigma: [usize; 2],
    centre_px: Vec<f64>,
    centre_mm: Vec<f64>,
    lateral_mm: Vec<f64>,
    depth_mm: Vec<f64>,
    detect_ms: Vec<f64>,
    evaluation: Evaluation,
}

impl Tally {
    fn add(&mut self, detector: &Detector, options: &Options, shot: &Shot) {
        let detections = detector.detect(&shot.frame, options);
        let finds = &detections.screws;
        self.detect_ms.push(detections.timing_ms.total);
        self.evaluation.faces += 1;
        self.evaluation.model = detections.model.clone();
        self.stages(detector, shot);
        for screw in shot.screws.iter().filter(|s| s.detectable) {
            self.screw(&shot.name, screw, finds);
        }
        for negative in &shot.negatives {
            self.negative(negative, finds);
        }
        for find in finds.iter().filter(|f| f.verdict != Verdict::Other) {
            if shot.screws.iter().any(|s| s.pixel.distance_px(&find.pixel) < MATCH_RADIUS * s.head_d_px) {
                self.right += usize::from(find.verdict == Verdict::Screw);
            } else if find.verdict == Verdict::Review {
                self.idle_looks += 1;
            } else {
                let what = shot.negatives.iter().find(|n| n.meets(find)).map_or("background", |n| &n.kind);
                self.evaluation.false_finds.push(Mistake {
                    image: shot.name.clone(),
                    u_px: find.pixel.u_px,
                    v_px: find.pixel.v_px,
                    diameter_px: find.diameter_px,
                    what: what.into(),
                    called: called(Some(find)),
                });
            }
        }
    }

    fn screw(&mut self, image: &str, screw: &TrueScrew, finds: &[Screw]) {
        // Finds are sorted by verdict: the first one near is what would be acted on.
        let find = finds.iter().find(|f| screw.pixel.distance_px(&f.pixel) < MATCH_RADIUS * screw.head_d_px);
        let found = find.filter(|f| f.verdict == Verdict::Screw);
        let review = find.is_some_and(|f| f.verdict == Verdict::Review);
        self.detectable += 1;
        self.found += usize::from(found.is_some());
        self.review += usize::from(review);
        for tag in &screw.tags {
            let tally = self.evaluation.by_wear.entry(tag.clone()).or_default();
            tally.screws += 1;
            tally.found += usize::from(found.is_some());
            tally.review += usize::from(review);
        }
        if let Some(find) = find {
            self.drive[0] += usize::from(find.drive == vision::Drive::Cross);
            self.drive[1] += 1;
        }
        let Some(find) = found else {
            self.evaluation.missed.push(Mistake {
                image: image.into(),
                u_px: screw.pixel.u_px,
                v_px: screw.pixel.v_px,
                diameter_px: screw.head_d_px,
                what: screw.tags.join(" "),
                called: called(find),
            });
            return;
        };
        let error = find.pixel.distance_px(&screw.pixel);
        self.centre_px.push(error);
        self.centre_mm.push(error * screw.mm_per_px);
        for along in [find.pixel.u_px - screw.pixel.u_px, find.pixel.v_px - screw.pixel.v_px] {
            self.sigma[0] += usize::from(along.abs() <= find.sigma_px);
            self.sigma[1] += usize::from(along.abs() <= 2.0 * find.sigma_px);
        }
        if let Some(point) = find.camera {
            let ray = screw.point.vector().normalize();
            let error = point.vector() - screw.point.vector();
            let along = error.dot(&ray);
            self.depth_mm.push(along.abs());
            self.lateral_mm.push((error - ray * along).norm());
        }
    }

    fn negative(&mut self, negative: &TrueNegative, finds: &[Screw]) {
        let find = finds.iter().find(|f| negative.meets(f));
        let tally = self.evaluation.by_negative.entry(negative.kind.clone()).or_default();
        tally.shown += 1;
        match find.map(|f| f.verdict) {
            Some(Verdict::Screw) => tally.screw += 1,
            Some(Verdict::Review) => tally.review += 1,
            Some(Verdict::Other) => tally.other += 1,
            None => tally.dropped += 1,
        }
        if let (Some(find), Some(drive)) = (find, negative.drive) {
            self.drive[0] += usize::from(find.drive.name() == drive);
            self.drive[1] += 1;
        }
    }

    /// Each stage alone: what stage 1 proposes, and what stage 2 says of the true places.
    fn stages(&mut self, detector: &Detector, shot: &Shot) {
        let model = detector.model();
        let places: Vec<Pixel> = candidates(&coarse_map(&model.coarse, &shot.frame.color), &model.settings.thresholds)
            .iter()
            .map(|c| Pixel::new(c.pixel.u_px, c.pixel.v_px))
            .collect();
        self.candidates += places.len();
        let shown: Vec<&TrueScrew> = shot.screws.iter().filter(|s| s.detectable).collect();
        for screw in &shown {
            let met = places.iter().any(|p| p.distance_px(&screw.pixel) < MATCH_RADIUS * screw.head_d_px);
            self.candidate += usize::from(met);
        }
        let accepted = |pixels: Vec<Pixel>| {
            let places: Vec<_> = pixels.iter().map(|p| Pixel::new(p.u_px, p.v_px)).collect();
            let corrections = &model.settings.corrections;
            let evidence = look(&model.fine, &shot.frame.color, &places);
            let yes = evidence.iter().filter(|e| {
                let p = f64::from(e.of(vision::layout::Class::Cross)).clamp(1e-7, 1.0 - 1e-7);
                let odds = corrections.score_slope * (p / (1.0 - p)).ln() + corrections.score_offset;
                1.0 / (1.0 + (-odds).exp()) >= f64::from(model.settings.thresholds.accept)
            });
            [yes.count(), pixels.len()]
        };
        for (sum, new) in [
            (&mut self.stage_2, accepted(shown.iter().map(|s| s.pixel).collect())),
            (&mut self.stage_2_false, accepted(shot.negatives.iter().map(|n| n.pixel).collect())),
        ] {
            sum.iter_mut().zip(new).for_each(|(s, n)| *s += n);
        }
    }

    fn finish(self) -> Evaluation {
        let false_finds = self.evaluation.false_finds.len();
        let faces = self.evaluation.faces.max(1) as f64;
        let axes = 2 * self.centre_px.len();
        Evaluation {
            recall: Share::new(self.found, self.detectable),
            precision: Share::new(self.right, self.right + false_finds),
            review: Share::new(self.review, self.detectable),
            idle_looks_a_face: self.idle_looks as f64 / faces,
            stage_1: Share::new(self.candidate, self.detectable),
            candidates_a_face: self.candidates as f64 / faces,
            stage_2: Share::new(self.stage_2[0], self.stage_2[1]),
            stage_2_false: Share::new(self.stage_2_false[0], self.stage_2_false[1]),
            drive: Share::new(self.drive[0], self.drive[1]),
            centre_px: Spread::of(self.centre_px),
            centre_mm: Spread::of(self.centre_mm),
            lateral_mm: Spread::of(self.lateral_mm),
            depth_mm: Spread::of(self.depth_mm),
            within_1_sigma: Share::new(self.sigma[0], axes),
            within_2_sigma: Share::new(self.sigma[1], axes),
            detect_ms: Spread::of(self.detect_ms),
            ..self.evaluation
        }
    }
}

impl TrueNegative {
    fn meets(&self, find: &Screw) -> bool {
        self.pixel.distance_px(&find.pixel) < (MATCH_RADIUS * self.d_px).max(MIN_DECOY_RADIUS_PX)
    }
}

fn called(find: Option<&Screw>) -> String {
    find.map_or("nothing".into(), |f| {
        let verdict = match f.verdict {
            Verdict::Screw => "screw",
            Verdict::Other => "other",
            Verdict::Review => "review",
        };
        format!("{verdict}, {}, {:.3}", f.drive.name(), f.score)
    })
}

/// What is rendered to measure on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Product {
    /// Worn outdoor units with everything that may be mistaken for a screw: one face of each, the five faces in turn.
    Units,
    /// The paper's gauge: screws only.
    Gauge,
}

/// Measures a detector picture by picture.
pub struct Evaluator<'a> {
    detector: &'a Detector,
    options: &'a Options,
    tally: Tally,
}

impl<'a> Evaluator<'a> {
    /// Measures this detector with these options.
    pub fn new(detector: &'a Detector, options: &'a Options) -> Self {
        Self { detector, options, tally: Tally::default() }
    }

    /// Adds the face that a seed stands for.
    ///
    /// # Errors
    /// [`EvaluateError::TrainedOn`] for seeds below [`FIRST_EVALUATION_SEED`].
    pub fn face(&mut self, product: Product, seed: u64) -> Result<(), EvaluateError> {
        if seed < FIRST_EVALUATION_SEED {
            return Err(EvaluateError::TrainedOn { start: seed });
        }
        if let Some(shot) = rendered(product, seed) {
            self.tally.add(self.detector, self.options, &shot);
        }
        Ok(())
    }

    /// Adds a picture with a truth file of another program; pictures are named relative to `folder`.
    ///
    /// # Errors
    /// An [`EvaluateError`] that names the file.
    pub fn truth_file(&mut self, folder: &Path, path: &Path) -> Result<(), EvaluateError> {
        let truth: TruthFile = serde_json::from_str(&text(path)?)
            .map_err(|source| EvaluateError::Truth { path: path.into(), source })?;
        self.tally.add(self.detector, self.options, &truth.shot(folder)?);
        Ok(())
    }

    /// Pictures so far.
    pub fn pictures(&self) -> usize {
        self.tally.evaluation.faces
    }

    /// The figures.
    pub fn finish(self) -> Evaluation {
        self.tally.finish()
    }
}

/// Measures a detector on the faces of `seeds`.
///
/// # Errors
/// [`EvaluateError::TrainedOn`] for seeds below [`FIRST_EVALUATION_SEED`].
pub fn evaluate_faces(
    detector: &Detector,
    options: &Options,
    product: Product,
    seeds: Range<u64>,
) -> Result<Evaluation, EvaluateError> {
    let mut evaluator = Evaluator::new(detector, options);
    for seed in seeds {
        evaluator.face(product, seed)?;
    }
    Ok(evaluator.finish())
}

/// The face that a seed stands for.
fn rendered(product: Product, seed: u64) -> Option<Shot> {
    let (unit, face) = match product {
        Product::Units => (Unit::sample(seed), FaceId::ALL[(seed % FaceId::ALL.len() as u64) as usize]),
        Product::Gauge => {
            let unit = Unit::gauge(seed);
            let face = unit.faces.first()?.id;
            (unit, face)
        }
    };
    let view = FaceView::sample(&unit, face, seed)?;
    let prepared = Prepared::new(&view);
    let truth = prepared.truth();
    let picture = prepared.render(None);
    let screws = truth.screws.iter().map(|s| TrueScrew {
        pixel: s.pixel,
        point: s.point,
        head_d_px: s.head_d_px,
        mm_per_px: s.head_d_mm / s.head_d_px,
        detectable: s.detectable,
        tags: s.wear.clone(),
    });
    let negatives = truth.decoys.iter().filter(|d| d.visible_fraction > 0.5).map(|d| TrueNegative {
        kind: d.kind.name().into(),
        drive: drive_of(d.kind.name()),
        pixel: d.pixel,
        d_px: d.d_px,
    });
    Some(Shot {
        name: format!("unit {seed}, {}", face.name()),
        screws: screws.collect(),
        negatives: negatives.collect(),
        frame: RgbdFrame { color: picture.color, depth: Some(picture.depth), camera: Some(view.camera), t_s: 0.0 },
    })
}

/// What turns a fastener that is no cross screw.
fn drive_of(kind: &str) -> Option<&'static str> {
    match kind {
        "hex_bolt" | "hex_flange_bolt" | "nut" => Some("hex_head"),
        "hex_socket" => Some("hex_socket"),
        "slotted" => Some("slotted"),
        "torx" => Some("torx"),
        _ => None,
    }
}

/// Truth of one picture as other renderers write it.
#[derive(Deserialize)]
struct TruthFile {
    rgb: String,
    depth: Option<String>,
    #[serde(default)]
    depth_scale_mm: f64,
    width: u32,
    height: u32,
    camera: TruthCamera,
    screws: Vec<TruthScrew>,
    negatives: Vec<TruthNegative>,
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
struct TruthScrew {
    u: f64,
    v: f64,
    xyz_mm: [f64; 3],
    head_d_mm: f64,
    head_d_px: f64,
    detectable: bool,
    #[serde(default)]
    tags: Vec<String>,
}

#[derive(Deserialize)]
struct TruthNegative {
    kind: String,
    u: f64,
    v: f64,
    xyz_mm: [f64; 3],
    d_mm: f64,
}

/// The truth files of a folder of pictures with depth that another program made: `DIR/truth/*.json`.
///
/// # Errors
/// An [`EvaluateError`] that names the folder.
pub fn truth_files(dir: &Path) -> Result<Vec<PathBuf>, EvaluateError> {
    let files = files(&dir.join("truth"), "json")?;
    if files.is_empty() {
        return Err(EvaluateError::Empty { path: dir.into(), expected: "truth/*.json is missing" });
    }
    Ok(files)
}

/// Measures a detector on such a folder.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_truth_folder(detector: &Detector, options: &Options, dir: &Path) -> Result<Evaluation, EvaluateError> {
    let mut evaluator = Evaluator::new(detector, options);
    for path in truth_files(dir)? {
        evaluator.truth_file(dir, &path)?;
    }
    Ok(evaluator.finish())
}

impl TruthFile {
    fn shot(self, dir: &Path) -> Result<Shot, EvaluateError> {
        let c = &self.camera;
        let camera = CameraModel {
            cx_px: c.cx,
            cy_px: c.cy,
            distortion: c.dist_k1k2p1p2k3,
            ..CameraModel::pinhole(self.width, self.height, c.fx, c.fy)
        };
        let color = read_color(&dir.join(&self.rgb))?;
        let depth = match &self.depth {
            Some(file) => Some(read_depth(&dir.join(file), self.depth_scale_mm, color.dimensions())?),
            None => None,
        };
        let screws = self.screws.into_iter().map(|s| TrueScrew {
            pixel: Pixel::new(s.u, s.v),
            point: Point::new(s.xyz_mm[0], s.xyz_mm[1], s.xyz_mm[2]),
            head_d_px: s.head_d_px,
            mm_per_px: s.head_d_mm / s.head_d_px,
            detectable: s.detectable,
            tags: if s.tags.is_empty() { vec!["clean".into()] } else { s.tags },
        });
        let negatives = self.negatives.into_iter().map(|n| TrueNegative {
            drive: drive_of(&n.kind),
            pixel: Pixel::new(n.u, n.v),
            d_px: n.d_mm / camera.pixel_mm(n.xyz_mm[2]),
            kind: n.kind,
        });
        Ok(Shot {
            name: self.rgb,
            screws: screws.collect(),
            negatives: negatives.collect(),
            frame: RgbdFrame { color, depth, camera: Some(camera), t_s: 0.0 },
        })
    }
}

/// Figures of a detector on photographs with labelled boxes.
///
/// Many photographs may show the same screws, so figures are given by distinct screw too: a scene has as many Phillips screws as its fullest
/// photograph, and each counts as found by the share of the scene's Phillips boxes that were found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PhotoEvaluation {
    /// Photographs.
    pub photographs: usize,
    /// Phillips boxes found.
    pub boxes: Share,
    /// Phillips boxes where something was found, of whatever verdict.
    pub seen: Share,
    /// Distinct Phillips screws.
    pub distinct: usize,
    /// Distinct Phillips screws found, in shares.
    pub distinct_found: f64,
    /// `distinct_found / distinct`.
    pub distinct_recall: f64,
    /// Finds called `screw` at no Phillips box, a photograph.
    pub false_a_photograph: f64,
    /// Boxes of either class with a find: Phillips called cross, hexagon called anything else.
    pub drive: Share,
    /// By scene: photographs, Phillips boxes, found, false finds.
    pub scenes: BTreeMap<String, [usize; 4]>,
    /// False finds.
    pub false_finds: Vec<Mistake>,
}

/// Measures a detector on photographs: `images/*.jpg`, `labels/*.txt` (YOLO; class 1 is Phillips, 0 hexagon), and the scene of each in
/// a `manifest` (CSV: `file,scene,...`; without it each photograph is a scene). `only_scenes` limits it to some.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_yolo_folder(
    detector: &Detector,
    options: &Options,
    images: &Path,
    labels: &Path,
    manifest: &Path,
    only_scenes: Option<&[String]>,
    progress: &dyn Fn(u64, u64),
) -> Result<PhotoEvaluation, EvaluateError> {
    let manifest = if manifest.is_file() { text(manifest)? } else { String::new() };
    let scenes: BTreeMap<&str, &str> =
        manifest.lines().skip(1).filter_map(|l| l.split_once(',')).map(|(file, rest)| (file, rest.split(',').next().unwrap_or(rest))).collect();
    let mut pictures = files(images, "jpg")?;
    pictures.extend(files(images, "png")?);
    let mut result = PhotoEvaluation::default();
    let (mut found, mut seen, mut drive) = ([0; 2], [0; 2], [0; 2]);
    let mut fullest: BTreeMap<String, usize> = BTreeMap::new();
    for (k, path) in pictures.iter().enumerate() {
        let file = path.file_name().map(|f| f.to_string_lossy().into_owned()).unwrap_or_default();
        let scene = scenes.get(file.as_str()).map_or_else(|| file.clone(), |s| (*s).to_owned());
        if only_scenes.is_some_and(|only| !only.contains(&scene)) {
            continue;
        }
        let picture: RgbImage = read_color(path)?;
        let labels = labels.join(Path::new(&file).with_extension("txt"));
        let boxes = boxes_of(&text(&labels)?, picture.dimensions());
        let finds = detector.detect_image(&picture, options).screws;
        let phillips = |b: &&Labelled| b.phillips;
        let near = |b: &Labelled, f: &Screw| f.pixel.distance_px(&Pixel::new(b.u_px, b.v_px)) < MATCH_RADIUS * b.diameter_px;
        let entry = result.scenes.entry(scene.clone()).or_default();
        result.photographs += 1;
        entry[0] += 1;
        let most = fullest.entry(scene).or_default();
        *most = (*most).max(boxes.iter().filter(phillips).count());
        for target in &boxes {
            let find = finds.iter().find(|f| near(target, f));
            if target.phillips {
                let hit = find.is_some_and(|f| f.verdict == Verdict::Screw);
                entry[1] += 1;
                entry[2] += usize::from(hit);
                found[0] += usize::from(hit);
                found[1] += 1;
                seen[0] += usize::from(find.is_some());
                seen[1] += 1;
            }
            if let Some(find) = find {
                drive[0] += usize::from((find.drive == vision::Drive::Cross) == target.phillips);
                drive[1] += 1;
            }
        }
        for find in finds.iter().filter(|f| f.verdict == Verdict::Screw) {
            if !boxes.iter().filter(phillips).any(|b| near(b, find)) {
                entry[3] += 1;
                let on_hexagon = boxes.iter().any(|b| near(b, find));
                result.false_finds.push(Mistake {
                    image: file.clone(),
                    u_px: find.pixel.u_px,
                    v_px: find.pixel.v_px,
                    diameter_px: find.diameter_px,
                    what: if on_hexagon { "hexagon".into() } else { "no label".into() },
                    called: called(Some(find)),
                });
            }
        }
        progress(k as u64 + 1, pictures.len() as u64);
    }
    if result.photographs == 0 {
        return Err(EvaluateError::Empty { path: images.into(), expected: "images/*.jpg with labels/*.txt of the asked scenes" });
    }
    result.boxes = Share::new(found[0], found[1]);
    result.seen = Share::new(seen[0], seen[1]);
    result.drive = Share::new(drive[0], drive[1]);
    for (scene, [_, boxes, found, _]) in &result.scenes {
        let distinct = fullest.get(scene).copied().unwrap_or(0);
        result.distinct += distinct;
        result.distinct_found += distinct as f64 * *found as f64 / (*boxes).max(1) as f64;
    }
    result.distinct_recall = result.distinct_found / result.distinct.max(1) as f64;
    result.false_a_photograph = result.false_finds.len() as f64 / result.photographs as f64;
    Ok(result)
}

/// A labelled box of a photograph.
struct Labelled {
    u_px: f64,
    v_px: f64,
    diameter_px: f64,
    phillips: bool,
}

/// YOLO boxes: 0 hexagon, 1 Phillips; the diameter is that of the circle in the mean of its sides.
fn boxes_of(text: &str, (width, height): (u32, u32)) -> Vec<Labelled> {
    let parse = |line: &str| {
        let v: Vec<f64> = line.split_whitespace().filter_map(|f| f.parse().ok()).collect();
        let &[class, x, y, w, h] = v.as_slice() else { return None };
        Some(Labelled {
            u_px: x * f64::from(width) - 0.5,
            v_px: y * f64::from(height) - 0.5,
            diameter_px: (w * f64::from(width) * h * f64::from(height)).sqrt(),
            phillips: class == 1.0,
        })
    };
    text.lines().filter_map(parse).collect()
}

/// Stage 2 on real crops of held-out groups: fastener of any drive against hole and everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CropEvaluation {
    /// Screws of any drive that were called a fastener.
    pub fasteners: Share,
    /// Holes and other things that were not.
    pub others: Share,
    /// Mean of the two.
    pub balanced_accuracy: f64,
}

/// Measures stage 2 on the held-out crops of the training data's folder.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_crops(detector: &Detector, data: &Path) -> Result<CropEvaluation, EvaluateError> {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let (mut fasteners, mut others) = ([0; 2], [0; 2]);
    for patch in real::crops(data, true, &mut rng)? {
        let side = crate::samples::PATCH_PX as u32;
        let (Some(label), Some(picture)) = (patch.labels.first(), RgbImage::from_raw(side, side, patch.rgb.clone())) else {
            continue;
        };
        let place = Pixel::new(f64::from(label.u_px), f64::from(label.v_px));
        let yes = look(&detector.model().fine, &picture, &[place]).iter().any(|e| e.fastener() >= 0.5);
        let (sum, right) = if label.classes == crate::samples::any_fastener() { (&mut fasteners, yes) } else { (&mut others, !yes) };
        sum[0] += usize::from(right);
        sum[1] += 1;
    }
    let (fasteners, others) = (Share::new(fasteners[0], fasteners[1]), Share::new(others[0], others[1]));
    Ok(CropEvaluation { fasteners, others, balanced_accuracy: 0.5 * (fasteners.share + others.share) })
}

impl fmt::Display for Evaluation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{} faces, model {}", self.faces, self.model)?;
        writeln!(f, "recall            {}", self.recall)?;
        writeln!(f, "precision         {}", self.precision)?;
        writeln!(f, "screws to review  {}", self.review)?;
        writeln!(f, "idle looks        {:.2} a face", self.idle_looks_a_face)?;
        writeln!(f, "stage 1 alone     {}, {:.0} candidates a face", self.stage_1, self.candidates_a_face)?;
        writeln!(f, "stage 2 alone     {}, false {}", self.stage_2, self.stage_2_false)?;
        writeln!(f, "drive named       {}", self.drive)?;
        writeln!(f, "centre, px        {}", self.centre_px)?;
        writeln!(f, "centre, mm        {}", self.centre_mm)?;
        if self.depth_mm.n > 0 {
            writeln!(f, "3D lateral, mm    {}", self.lateral_mm)?;
            writeln!(f, "3D depth, mm      {}", self.depth_mm)?;
        }
        writeln!(f, "within 1 sigma    {}", self.within_1_sigma)?;
        writeln!(f, "within 2 sigma    {}", self.within_2_sigma)?;
        writeln!(f, "\n{:<18} {:>7} {:>7} {:>7}", "wear", "screws", "found", "review")?;
        for (tag, t) in &self.by_wear {
            writeln!(f, "{tag:<18} {:>7} {:>7} {:>7}   {:.2} %", t.screws, t.found, t.review, 100.0 * t.found as f64 / t.screws as f64)?;
        }
        writeln!(f, "\n{:<18} {:>7} {:>7} {:>7} {:>7} {:>7}", "negative", "shown", "screw", "review", "other", "dropped")?;
        for (kind, t) in &self.by_negative {
            writeln!(f, "{kind:<18} {:>7} {:>7} {:>7} {:>7} {:>7}", t.shown, t.screw, t.review, t.other, t.dropped)?;
        }
        mistakes(f, "missed", &self.missed)?;
        mistakes(f, "false", &self.false_finds)
    }
}

impl fmt::Display for PhotoEvaluation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{} photographs", self.photographs)?;
        writeln!(
            f,
            "distinct Phillips screws found {:.1} of {} ({:.1} %); a scene has as many as its fullest photograph, each found by the share of its boxes",
            self.distinct_found,
            self.distinct,
            100.0 * self.distinct_recall
        )?;
        writeln!(f, "Phillips boxes found           {}", self.boxes)?;
        writeln!(f, "seen, whatever the verdict     {}", self.seen)?;
        writeln!(f, "false finds                    {:.2} a photograph", self.false_a_photograph)?;
        writeln!(f, "Phillips against hexagon       {}", self.drive)?;
        writeln!(f, "\n{:<18} {:>11} {:>9} {:>7} {:>7}", "scene", "photographs", "Phillips", "found", "false")?;
        for (scene, [photographs, boxes, found, wrong]) in &self.scenes {
            writeln!(f, "{scene:<18} {photographs:>11} {boxes:>9} {found:>7} {wrong:>7}")?;
        }
        mistakes(f, "false", &self.false_finds)
    }
}

impl fmt::Display for CropEvaluation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "fasteners of any drive  {}", self.fasteners)?;
        writeln!(f, "holes and others        {}", self.others)?;
        writeln!(f, "balanced accuracy       {:.2} %", 100.0 * self.balanced_accuracy)
    }
}

fn mistakes(f: &mut fmt::Formatter, name: &str, mistakes: &[Mistake]) -> fmt::Result {
    if mistakes.is_empty() {
        return Ok(());
    }
    writeln!(f, "\n{name}:")?;
    for m in mistakes {
        writeln!(f, "  {} at ({:.0}, {:.0}), {:.0} px: {}; called {}", m.image, m.u_px, m.v_px, m.diameter_px, m.what, m.called)?;
    }
    Ok(())
}

fn text(path: &Path) -> Result<String, EvaluateError> {
    std::fs::read_to_string(path).map_err(|source| EvaluateError::Read { path: path.into(), source })
}

/// Files of a folder with an extension, in order of their names.
fn files(dir: &Path, extension: &str) -> Result<Vec<PathBuf>, EvaluateError> {
    let read = |source| EvaluateError::Read { path: dir.into(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(read)? {
        let path = entry.map_err(read)?.path();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension)) {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vision::Drive;

    fn find(u: f64, verdict: Verdict, drive: Drive) -> Screw {
        Screw {
            pixel: Pixel::new(u, 10.0),
            sigma_px: 0.5,
            diameter_px: 28.0,
            score: 0.9,
            drive,
            verdict,
            cues: Vec::new(),
            angle_rad: None,
            camera: Some(Point::new(0.0, 0.3, 1500.4)),
            normal: None,
            sigma_lateral_mm: None,
            sigma_depth_mm: None,
        }
    }

    #[test]
    fn a_find_counts_for_what_it_is() {
        let screw = |u: f64| TrueScrew {
            pixel: Pixel::new(u, 10.0),
            point: Point::new(0.0, 0.0, 1500.0),
            head_d_px: 28.0,
            mm_per_px: 0.3,
            detectable: true,
            tags: vec!["rust".into()],
        };
        let bolt = TrueNegative { kind: "hex_bolt".into(), drive: Some("hex_head"), pixel: Pixel::new(200.0, 10.0), d_px: 28.0 };
        let finds = [
            find(11.0, Verdict::Screw, Drive::Cross),
            find(100.0, Verdict::Review, Drive::Slotted),
            find(202.0, Verdict::Other, Drive::HexHead),
        ];
        let mut tally = Tally::default();
        for u in [10.0, 101.0, 300.0] {
            tally.screw("a", &screw(u), &finds);
        }
        tally.negative(&bolt, &finds);
        let result = tally.finish();
        assert_eq!((result.recall.k, result.recall.n, result.review.k), (1, 3, 1));
        assert_eq!((result.drive.k, result.drive.n), (2, 3));
        assert_eq!(result.by_wear["rust"], ScrewTally { screws: 3, found: 1, review: 1 });
        assert_eq!(result.by_negative["hex_bolt"].other, 1);
        assert_eq!(result.missed.len(), 2);
        assert!((result.centre_px.max - 1.0).abs() < 1e-9 && (result.centre_mm.max - 0.3).abs() < 1e-9);
        assert!((result.depth_mm.max - 0.4).abs() < 1e-6 && (result.lateral_mm.max - 0.3).abs() < 1e-6);
        // 1 px off along u, not at all along v, sigma 0.5
        assert_eq!((result.within_1_sigma.k, result.within_2_sigma.k, result.within_2_sigma.n), (1, 2, 2));
    }

    #[test]
    fn spread_and_bounds() {
        let spread = Spread::of((1..=100).rev().map(f64::from).collect());
        assert_eq!((spread.median, spread.p95, spread.p99, spread.max), (50.0, 95.0, 99.0, 100.0));
        assert_eq!(Spread::of(Vec::new()).max, 0.0);
        assert_eq!(wilson(0, 0), (0.0, 1.0));
        let (low, high) = wilson(0, 10_000);
        assert!(low == 0.0 && high < 4e-4);
    }

    #[test]
    fn training_seeds_are_refused() -> Result<(), vision::ModelError> {
        let refused = evaluate_faces(&Detector::embedded()?, &Options::default(), Product::Units, 5..6);
        assert!(matches!(refused, Err(EvaluateError::TrainedOn { start: 5 })));
        Ok(())
    }
}
