//! Training: patches, three networks, thresholds, one model file; the same bytes from the same settings on any number of threads.

use crate::batch::{Batch, Stage, batch, loss};
use crate::boxes::BoxesError;
use crate::mine::{Mined, mine};
use crate::pictures;
use crate::real;
use crate::samples::{Patch, any_fastener, only, rendered};
use crate::tune::{self, Tuning};
use nn::{Engine, Network, Tensor, Trainer};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use serde_json::json;
use std::{
    collections::BTreeMap,
    ops::Range,
    path::{Path, PathBuf},
};
use vision::layout::{CLOSE_HEAD_PX, Class, coarse_spec, fine_spec};
use vision::{Detector, Networks, Settings, Thresholds, decode_model, encode_model};

/// Units below this seed are learned from.
pub const TRAINING_SEEDS: Range<u64> = 0..500_000;
/// Units whose faces set thresholds and sigma factors.
pub const TUNING_SEEDS: Range<u64> = 500_000..1_000_000;
/// Steps over which the learning rate rises to its full value: batch norm has no statistics to stand on before.
const WARM_UP: usize = 100;
/// Weight of the places in the last quarter of the steps, when the classes are nearly learned, against that before.
const LATE_PLACE: f32 = 4.0;
/// Share of a batch that comes from pictures from elsewhere, against all others together.
const PICTURED: f64 = 0.3;
/// Share of a batch that comes from what was mined, against the pools of rendered and real patches together.
const MINED: f64 = 0.15;
/// What decides beside the settings what a network learns: a network half trained by another recipe is not gone on with.
const RECIPE: [&str; 2] = [include_str!("batch.rs"), include_str!("../../vision/src/clip.rs")];
/// Learning rate of the closer look against that of the network that it goes on from.
const CLOSE_RATE: f32 = 0.5;
/// Steps after which a network is written to the work folder.
const KEEP_EVERY: usize = 500;

/// Why training could not be done.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A file of the real photographs, of the work folder or of the model to go on from could not be read.
    #[error("cannot read {path}: {source}; run from the repository's root, or give the folder of the training data")]
    Data {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file of the work folder is not what training wrote.
    #[error("{path} is damaged; delete it, and training makes it anew")]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// The work folder is from before a change of the renderer.
    #[error("the patches kept in {folder} were rendered by another version; give another --work folder")]
    OtherRenderer {
        /// The folder.
        folder: PathBuf,
    },
    /// A picture or the model file.
    #[error(transparent)]
    File(#[from] geometry::FileError),
    /// Photographs with boxes.
    #[error(transparent)]
    Boxes(#[from] BoxesError),
    /// A network could not be saved.
    #[error(transparent)]
    Network(#[from] nn::NnError),
    /// The model could not be put together.
    #[error(transparent)]
    Model(#[from] vision::ModelError),
    /// A truth file of the pictures to learn from.
    #[error("{path}: {reason}; expected rgb, screws (u, v, head_d_px, detectable) and negatives (kind, u, v, d_px)")]
    Truth {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// More units than there are seeds for.
    #[error("{units} units to learn from; at most {} are set aside for it", TRAINING_SEEDS.end)]
    TooManyUnits {
        /// What was asked for.
        units: u64,
    },
}

/// The recipe. Optimiser, batch and first learning rate are the paper's (section 4.2).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainSettings {
    /// Seed of the first unit.
    pub first_unit: u64,
    /// Units whose five faces are rendered to learn from.
    pub units: u64,
    /// Patches of background a face.
    pub background: usize,
    /// Pictures in a step.
    pub batch: usize,
    /// Highest learning rate (paper: 0.01); it falls in a straight line to nothing at the last step.
    pub learning_rate: f32,
    /// Steps of stage 1.
    pub coarse_steps: usize,
    /// Steps of the network of stage 2.
    pub fine_steps: usize,
    /// Steps of the network for the closer look; it begins as the first one of stage 2, where the model that is trained further has none.
    pub close_steps: usize,
    /// Faces that the half-trained networks look at; where they are wrong is learned from in the rest of the steps. They are of the
    /// units after those that are learned from.
    pub mining_faces: u64,
    /// Faces that set thresholds and sigma factors.
    pub tuning_faces: u64,
    /// Seed of everything.
    pub seed: u64,
    /// Model whose networks are trained further; `None` starts anew. A network with 0 steps stays as it is.
    #[serde(skip)]
    pub from: Option<PathBuf>,
    /// Identity of that model.
    pub from_model: Option<String>,
    /// Folder of more pictures with exact truth, as `path_traced.py` makes them; `None` has none.
    #[serde(skip)]
    pub pictures: Option<PathBuf>,
    /// Identity of those pictures.
    pub pictures_id: Option<String>,
    /// Folder where rendered patches and half-trained networks are kept, so that a stopped training goes on; `None` keeps nothing.
    #[serde(skip)]
    pub work: Option<PathBuf>,
    /// Folder of the real photographs.
    #[serde(skip)]
    pub data: PathBuf,
    /// Date for the model file, given by the caller.
    pub date: String,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self {
            first_unit: 0,
            units: 700,
            background: 8,
            batch: 128,
            learning_rate: 0.01,
            coarse_steps: 1900,
            fine_steps: 11000,
            close_steps: 6000,
            mining_faces: 0,
            tuning_faces: 150,
            seed: 1,
            from: None,
            from_model: None,
            pictures: None,
            pictures_id: None,
            work: None,
            data: PathBuf::from("crates/training/data"),
            date: String::new(),
        }
    }
}

/// What training says while it goes on.
pub trait Progress: Sync {
    /// `done` of `total` of a phase; `loss` where there is one.
    fn report(&self, phase: &str, done: u64, total: u64, loss: Option<f32>);
}

/// What training made.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Identity of the model file.
    pub model: String,
    /// Its size, bytes.
    pub bytes: usize,
    /// Patches by origin and kind.
    pub patches: BTreeMap<String, usize>,
    /// Loss over the last steps, by network.
    pub loss: BTreeMap<String, f32>,
    /// Thresholds and sigma factors with the figures that they were chosen by.
    pub tuning: Tuning,
}

/// Trains a detector and writes its model file (aside, then renamed).
///
/// # Errors
/// [`TrainError`] if the real photographs cannot be read or the file cannot be written.
pub fn train(settings: &TrainSettings, out: &Path, progress: &dyn Progress) -> Result<TrainReport, TrainError> {
    let learned = settings.first_unit.saturating_add(settings.units);
    if learned.saturating_add(settings.mining_faces) > TRAINING_SEEDS.end {
        return Err(TrainError::TooManyUnits {
            units: settings.units.saturating_add(settings.mining_faces),
        });
    }
    let real = real::patches(&settings.data, settings.seed)?; // first: a missing folder is said at once
    let (pictured, pictures_id) = match &settings.pictures {
        Some(folder) => pictures::patches(folder, settings.seed).map(|(patches, id)| (patches, Some(id)))?,
        None => (Vec::new(), None),
    };
    let (settings, start) = &begun(&TrainSettings {
        pictures_id,
        ..settings.clone()
    })?;
    let mut patches = rendered(
        settings.first_unit..settings.first_unit + settings.units,
        settings.background,
        settings.work.as_deref(),
        &|done| {
            progress.report("rendering", done, settings.units, None);
        },
    )?;
    let mut counted = count("rendered", &patches);
    counted.extend(count("real", &real));
    counted.extend(count("pictured", &pictured));
    patches.extend(real);
    let mut lesson = Lesson {
        settings,
        pools: vec![(1.0, &patches), (PICTURED, &pictured)],
        progress,
    };
    let mut losses = BTreeMap::new();
    let coarse = match start {
        Some(networks) => Trainer::from_bytes(&networks.coarse)?,
        None => Trainer::new(coarse_spec(), settings.seed),
    };
    let coarse = lesson.learn("coarse", coarse, Stage::Coarse, settings.coarse_steps, &mut losses)?;
    // one network gives what the paper's three give (docs/detection.md); a model that is gone on with keeps its number of them
    let mut trainers = match start {
        Some(networks) => networks
            .fine
            .iter()
            .map(|bytes| Trainer::from_bytes(bytes))
            .collect::<Result<_, _>>()?,
        None => vec![Trainer::new(fine_spec(), settings.seed + 1)],
    };
    let mined;
    if settings.mining_faces > 0 {
        // a model that is gone on with can tell at once what it falls for
        let before = if settings.from.is_some() {
            0
        } else {
            settings.fine_steps / 4 * 3
        };
        for (k, trainer) in trainers.iter_mut().enumerate() {
            *trainer = lesson.learn(&format!("half{k}"), trainer.clone(), Stage::Fine, before, &mut losses)?;
        }
        mined = lesson.mined(&coarse.network(), trainers.iter().map(Trainer::network))?;
        counted.extend(count("mined", &mined));
        lesson.pools.push((MINED, &mined));
    }
    let mut fine = Vec::new();
    for (k, trainer) in trainers.into_iter().enumerate() {
        let trainer = lesson.learn(
            &format!("fine{k}"),
            trainer,
            Stage::Fine,
            settings.fine_steps,
            &mut losses,
        )?;
        fine.push(trainer.to_bytes(&BTreeMap::new())?);
    }
    let close = match start.as_ref().and_then(|networks| networks.close.as_ref()) {
        None if settings.close_steps > 0 => fine.first(),
        own => own,
    };
    let close = match close {
        Some(bytes) => {
            let begun = Trainer::from_bytes(bytes)?;
            let trainer = lesson.learn("close", begun, Stage::Close, settings.close_steps, &mut losses)?;
            Some(trainer.to_bytes(&BTreeMap::new())?)
        }
        None => None,
    };
    let networks = Networks {
        coarse: coarse.to_bytes(&BTreeMap::new())?,
        fine,
        close,
    };
    let untuned = Settings {
        thresholds: Thresholds::default(),
        ..Settings::default()
    };
    let detector = Detector::from_bytes(&encode_model(&networks, &untuned)?)?;
    let tuning = tune::tune(detector.model(), TUNING_SEEDS.start, settings.tuning_faces, &|done| {
        progress.report("tuning", done, settings.tuning_faces, None);
    })?;
    let tuned = Settings {
        thresholds: tuning.thresholds,
        corrections: tuning.corrections,
        facts: BTreeMap::from([
            ("version".into(), json!(env!("CARGO_PKG_VERSION"))),
            ("date".into(), json!(settings.date)),
            ("settings".into(), json!(settings)),
            ("patches".into(), json!(counted)),
            ("loss".into(), json!(losses)),
            ("tuning".into(), json!(tuning)),
        ]),
    };
    let bytes = encode_model(&networks, &tuned)?;
    geometry::write_aside(out, &bytes)?;
    Ok(TrainReport {
        model: vision::model_id(&bytes),
        bytes: bytes.len(),
        patches: counted,
        loss: losses,
        tuning,
    })
}

fn count(origin: &str, patches: &[Patch]) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for patch in patches {
        *counts
            .entry(format!("{origin} {}", Pool::of(patch).name()))
            .or_default() += 1;
    }
    counts
}

/// What a patch is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pool {
    Cross,
    OtherDrive,
    OtherFeature,
    Background,
    Real,
}

impl Pool {
    const ALL: [Pool; 5] = [
        Pool::Cross,
        Pool::OtherDrive,
        Pool::OtherFeature,
        Pool::Background,
        Pool::Real,
    ];

    fn of(patch: &Patch) -> Self {
        match patch.labels.first().filter(|_| patch.focused) {
            Some(label) if !label.exact => Pool::Real,
            Some(label) if label.classes == only(Class::Cross) => Pool::Cross,
            Some(label) if label.classes & any_fastener() != 0 => Pool::OtherDrive,
            Some(_) => Pool::OtherFeature,
            None => Pool::Background,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Pool::Cross => "cross screws",
            Pool::OtherDrive => "other fasteners",
            Pool::OtherFeature => "other features",
            Pool::Background => "background",
            Pool::Real => "photographs",
        }
    }

    /// Share of a batch: whole pictures are mostly background, candidates mostly are not.
    fn share(self, stage: Stage) -> f64 {
        let [coarse, fine] = match self {
            Pool::Cross => [0.34, 0.36],
            Pool::OtherDrive => [0.10, 0.20],
            Pool::OtherFeature => [0.18, 0.22],
            Pool::Background => [0.26, 0.08],
            Pool::Real => [0.12, 0.14],
        };
        if stage == Stage::Coarse { coarse } else { fine }
    }
}

/// Draws patches so that each pool has its share of every batch.
fn picks(pools: &[(f64, Vec<usize>)], n: usize, rng: &mut Pcg64Mcg) -> Vec<usize> {
    let total: f64 = pools.iter().map(|p| p.0).sum();
    (0..n)
        .map(|_| {
            let mut x = rng.random_range(0.0..total);
            let pool = pools.iter().find(|p| {
                x -= p.0;
                x < 0.0
            });
            let pool = &pool.unwrap_or(&pools[0]).1;
            pool[rng.random_range(0..pool.len())]
        })
        .collect()
}

/// Settings with the identity of the model that is trained further, and that model's networks.
fn begun(settings: &TrainSettings) -> Result<(TrainSettings, Option<Networks>), TrainError> {
    let Some(path) = &settings.from else {
        return Ok((settings.clone(), None));
    };
    let bytes = std::fs::read(path).map_err(|source| TrainError::Data {
        path: path.clone(),
        source,
    })?;
    let (networks, _) = decode_model(&bytes, &path.display().to_string())?;
    let settings = TrainSettings {
        from_model: Some(vision::model_id(&bytes)),
        ..settings.clone()
    };
    Ok((settings, Some(networks)))
}

/// What every network of a training learns from, and how.
pub struct Lesson<'a> {
    /// The recipe.
    pub settings: &'a TrainSettings,
    /// What is learned from: patches, and the weight of all of them together in a batch. The first are drawn by what they are for.
    pub pools: Vec<(f64, &'a [Patch])>,
    /// Where it says how far it is.
    pub progress: &'a dyn Progress,
}

impl Lesson<'_> {
    /// Trains from the step where the trainer is up to the `last`, and puts the loss over the last steps into `losses`.
    ///
    /// # Errors
    /// [`TrainError`] for the work folder.
    pub fn learn(
        &self,
        name: &str,
        mut trainer: Trainer,
        stage: Stage,
        last: usize,
        losses: &mut BTreeMap<String, f32>,
    ) -> Result<Trainer, TrainError> {
        let settings = self.settings;
        let (total, highest) = match stage {
            Stage::Coarse => (settings.coarse_steps, settings.learning_rate),
            Stage::Fine => (settings.fine_steps, settings.learning_rate),
            Stage::Close => (settings.close_steps, CLOSE_RATE * settings.learning_rate),
        };
        let kept = settings.work.as_ref().map(|folder| {
            let key = json!([
                RECIPE,
                WARM_UP,
                LATE_PLACE,
                CLOSE_RATE,
                CLOSE_HEAD_PX,
                PICTURED,
                MINED,
                settings_key(settings),
                trainer.spec(),
                name
            ])
            .to_string();
            folder.join(format!(
                "{name}-{}.checkpoint",
                &geometry::sha256_hex(key.as_bytes())[..12]
            ))
        });
        let mut mean_loss = f32::NAN;
        if let Some(path) = kept.as_ref().filter(|p| p.exists()) {
            let bytes = std::fs::read(path).map_err(|source| TrainError::Data {
                path: path.clone(),
                source,
            })?;
            trainer = Trainer::from_bytes(&bytes).map_err(|_| TrainError::Damaged { path: path.clone() })?;
            let loss = nn::metadata(&bytes).ok().and_then(|m| m.get("loss")?.parse().ok());
            mean_loss = loss.unwrap_or(f32::NAN);
        }
        let pools = pools(&self.pools, stage);
        let all: Vec<&Patch> = self.pools.iter().flat_map(|p| p.1).collect();
        let mut grad = Tensor::default();
        for step in trainer.steps() as usize..last {
            // a generator a step: a training that goes on draws what it would have drawn
            let mut rng = Pcg64Mcg::seed_from_u64(hash(&[settings.seed, name_hash(name), step as u64]));
            let picks = picks(&pools, settings.batch, &mut rng);
            let Batch { input, targets } = batch(stage, &all, &picks, rng.random());
            let output = trainer.forward(&input);
            let place = if 4 * step >= 3 * total { LATE_PLACE } else { 1.0 };
            let now = loss(stage, &output, &targets, place, &mut grad);
            trainer.backward(&grad);
            let rise = ((step + 1) as f32 / WARM_UP as f32).min(1.0);
            let rate = highest * rise * (1.0 - step as f32 / total as f32);
            trainer.adam_step(rate, 0.0);
            mean_loss = if mean_loss.is_nan() {
                now
            } else {
                0.98 * mean_loss + 0.02 * now
            };
            if (step + 1) % 50 == 0 || step + 1 == last {
                self.progress
                    .report(name, step as u64 + 1, last as u64, Some(mean_loss));
            }
            if let Some(path) = kept
                .as_ref()
                .filter(|_| (step + 1) % KEEP_EVERY == 0 || step + 1 == last)
            {
                let told = BTreeMap::from([("loss".to_owned(), mean_loss.to_string())]);
                geometry::write_aside(path, &trainer.checkpoint_bytes(&told)?)?;
            }
        }
        if !mean_loss.is_nan() {
            losses.insert(name.to_owned(), mean_loss);
        }
        Ok(trainer)
    }

    /// Patches of where the networks are wrong on faces of units that come after those learned from; with a work folder, a manifest of
    /// them is left there.
    fn mined(&self, coarse: &Network, fine: impl Iterator<Item = Network>) -> Result<Vec<Patch>, TrainError> {
        let settings = self.settings;
        let first = settings.first_unit + settings.units;
        let fine: Vec<Engine> = fine.map(Engine::from).collect();
        let (patches, manifest): (_, Vec<Mined>) = mine(
            &coarse.clone().into(),
            &fine,
            first..first + settings.mining_faces,
            &|done| self.progress.report("mining", done, settings.mining_faces, None),
        )?;
        if let Some(folder) = &settings.work {
            let lines = manifest.iter().map(|m| json!(m).to_string() + "\n");
            geometry::write_aside(&folder.join("mined.jsonl"), lines.collect::<String>().as_bytes())?;
        }
        Ok(patches)
    }
}

/// The settings that decide what a network learns, without those that only say where or when.
fn settings_key(settings: &TrainSettings) -> serde_json::Value {
    json!(TrainSettings {
        date: String::new(),
        tuning_faces: 0,
        ..settings.clone()
    })
}

/// A number that depends on all of `parts` (FNV-1a).
fn hash(parts: &[u64]) -> u64 {
    parts
        .iter()
        .flat_map(|p| p.to_le_bytes())
        .fold(0xCBF2_9CE4_8422_2325, |h, b| {
            (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01B3)
        })
}

fn name_hash(name: &str) -> u64 {
    hash(&name.bytes().map(u64::from).collect::<Vec<_>>())
}

/// Indices of patches by pool, with each pool's share of a batch: the first patches by what they are for, the others whole.
fn pools(all: &[(f64, &[Patch])], stage: Stage) -> Vec<(f64, Vec<usize>)> {
    let mut begin = 0;
    let mut pools: Vec<(f64, Vec<usize>)> = Vec::new();
    for (k, &(weight, patches)) in all.iter().enumerate() {
        if k == 0 {
            pools.extend(Pool::ALL.map(|pool| {
                let members = (0..patches.len()).filter(|&i| Pool::of(&patches[i]) == pool).collect();
                (weight * pool.share(stage), members)
            }));
        } else {
            pools.push((weight, (begin..begin + patches.len()).collect()));
        }
        begin += patches.len();
    }
    pools.retain(|p| !p.1.is_empty());
    pools
}
