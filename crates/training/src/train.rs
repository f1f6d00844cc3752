//! Training: patches, four networks, thresholds, one model file; the same bytes from the same settings on any number of threads.

use crate::batch::{Batch, Stage, batch, loss};
use crate::real;
use crate::samples::{Patch, any_fastener, only, rendered};
use crate::tune::{self, Tuning};
use nn::{Tensor, Trainer};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use serde_json::json;
use std::{
    collections::BTreeMap,
    ops::Range,
    path::{Path, PathBuf},
};
use vision::layout::{Class, coarse_spec, fine_spec};
use vision::{Detector, Settings, Thresholds, decode_model, encode_model};

/// Networks in the ensemble of stage 2, as in the paper.
const ENSEMBLE: u64 = 3;
/// Units below this seed are learned from.
pub const TRAINING_SEEDS: Range<u64> = 0..500_000;
/// Units whose faces set thresholds and sigma factors.
pub const TUNING_SEEDS: Range<u64> = 500_000..1_000_000;
/// Steps over which the learning rate rises to its full value: batch norm has no statistics to stand on before.
const WARM_UP: usize = 100;

/// Why training could not be done.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A file of the real photographs could not be read.
    #[error("cannot read {path}: {source}; run from the repository's root, or give the folder of the training data")]
    Data {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A picture or the model file.
    #[error(transparent)]
    File(#[from] geometry::FileError),
    /// A network could not be saved.
    #[error(transparent)]
    Network(#[from] nn::NnError),
    /// The model could not be put together.
    #[error(transparent)]
    Model(#[from] vision::ModelError),
    /// More units than there are seeds for.
    #[error("{units} units to learn from; at most {} are set aside for it", TRAINING_SEEDS.end)]
    TooManyUnits {
        /// What was asked for.
        units: u64,
    },
}

/// The recipe. Optimiser, batch, loss and steps of the learning rate are the paper's (section 4.2).
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
    /// First learning rate (paper: 0.01).
    pub learning_rate: f32,
    /// Factor on it after each third of the steps (paper: 0.25 every 10 of 30 epochs).
    pub decay: f32,
    /// Steps of stage 1.
    pub coarse_steps: usize,
    /// Steps of each network of stage 2.
    pub fine_steps: usize,
    /// Faces that set thresholds and sigma factors.
    pub tuning_faces: u64,
    /// Seed of everything.
    pub seed: u64,
    /// Model whose networks are trained further; `None` starts anew. A network with 0 steps stays as it is.
    #[serde(skip)]
    pub from: Option<PathBuf>,
    /// Identity of that model.
    pub from_model: Option<String>,
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
            units: 150,
            background: 8,
            batch: 128,
            learning_rate: 0.01,
            decay: 0.25,
            coarse_steps: 1900,
            fine_steps: 2500,
            tuning_faces: 24,
            seed: 1,
            from: None,
            from_model: None,
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
    if settings.first_unit.saturating_add(settings.units) > TRAINING_SEEDS.end {
        return Err(TrainError::TooManyUnits { units: settings.units });
    }
    let real = real::patches(&settings.data, settings.seed)?; // first: a missing folder is said at once
    let (settings, start) = &begun(settings)?;
    let mut patches = rendered(
        settings.first_unit..settings.first_unit + settings.units,
        settings.background,
        &|done| {
            progress.report("rendering", done, settings.units, None);
        },
    );
    let counted = count(&patches, &real);
    patches.extend(real);
    let mut losses = BTreeMap::new();
    let mut learn = |name: String, stage, steps, seed| {
        let (trainer, loss) = network(
            trainer(start, &name, stage, seed)?,
            stage,
            &patches,
            settings,
            steps,
            seed,
            &|done, loss| {
                progress.report(&name, done as u64, steps as u64, Some(loss));
            },
        );
        losses.insert(name, loss);
        Ok::<_, TrainError>(trainer.to_bytes(&BTreeMap::new())?)
    };
    let coarse = learn("coarse".to_owned(), Stage::Coarse, settings.coarse_steps, settings.seed)?;
    let fine: Vec<Vec<u8>> = (0..ENSEMBLE)
        .map(|k| {
            learn(
                format!("fine{k}"),
                Stage::Fine,
                settings.fine_steps,
                settings.seed + 1 + k,
            )
        })
        .collect::<Result<_, _>>()?;
    drop(patches);
    let untuned = Settings {
        thresholds: Thresholds::default(),
        ..Settings::default()
    };
    let detector = Detector::from_bytes(&encode_model(&coarse, &fine, &untuned)?)?;
    let tuning = tune::tune(detector.model(), TUNING_SEEDS.start, settings.tuning_faces, &|done| {
        progress.report("tuning", done, settings.tuning_faces, None);
    });
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
    let bytes = encode_model(&coarse, &fine, &tuned)?;
    geometry::write_aside(out, &bytes)?;
    Ok(TrainReport {
        model: vision::model_id(&bytes),
        bytes: bytes.len(),
        patches: counted,
        loss: losses,
        tuning,
    })
}

fn count(rendered: &[Patch], real: &[Patch]) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for (origin, patches) in [("rendered", rendered), ("real", real)] {
        for patch in patches {
            *counts
                .entry(format!("{origin} {}", Pool::of(patch).name()))
                .or_default() += 1;
        }
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
            Pool::Cross => [0.34, 0.38],
            Pool::OtherDrive => [0.10, 0.15],
            Pool::OtherFeature => [0.18, 0.26],
            Pool::Background => [0.26, 0.09],
            Pool::Real => [0.12, 0.12],
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

/// Settings with the identity of the model that is trained further, and that model's networks by name.
fn begun(settings: &TrainSettings) -> Result<(TrainSettings, BTreeMap<String, Vec<u8>>), TrainError> {
    let Some(path) = &settings.from else {
        return Ok((settings.clone(), BTreeMap::new()));
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
    Ok((settings, networks))
}

/// A network to train: the one of that name to go on from, or a new one.
fn trainer(start: &BTreeMap<String, Vec<u8>>, name: &str, stage: Stage, seed: u64) -> Result<Trainer, TrainError> {
    match start.get(name) {
        Some(bytes) => Ok(Trainer::from_bytes(bytes)?),
        None => Ok(Trainer::new(
            if stage == Stage::Fine {
                fine_spec()
            } else {
                coarse_spec()
            },
            seed,
        )),
    }
}

fn network(
    mut trainer: Trainer,
    stage: Stage,
    patches: &[Patch],
    settings: &TrainSettings,
    steps: usize,
    seed: u64,
    say: &dyn Fn(usize, f32),
) -> (Trainer, f32) {
    let mut pools: Vec<(f64, Vec<usize>)> = Pool::ALL
        .iter()
        .map(|&pool| {
            let members = (0..patches.len()).filter(|&i| Pool::of(&patches[i]) == pool).collect();
            (pool.share(stage), members)
        })
        .collect();
    pools.retain(|p| !p.1.is_empty());
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut grad = Tensor::default();
    let mut mean_loss = 0.0f32;
    for step in 0..steps {
        let picks = picks(&pools, settings.batch, &mut rng);
        let Batch { input, targets } = batch(stage, patches, &picks, rng.random());
        let output = trainer.forward(&input);
        let now = loss(stage, &output, &targets, &mut grad);
        trainer.backward(&grad);
        let rise = ((step + 1) as f32 / WARM_UP as f32).min(1.0);
        trainer.adam_step(
            settings.learning_rate * settings.decay.powi((3 * step / steps) as i32) * rise,
            0.0,
        );
        let memory = 0.98f32.min(step as f32 / (step as f32 + 1.0));
        mean_loss = memory * mean_loss + (1.0 - memory) * now;
        if (step + 1) % 50 == 0 || step + 1 == steps {
            say(step + 1, mean_loss);
        }
    }
    (trainer, mean_loss)
}
