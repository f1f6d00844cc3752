//! Data sets, augmentation, training, evaluation: from rendered faces and real photographs to one model file, and from a model to
//! figures with bounds.
//!
//! Beside the way of one unit, not in it: `vision` only ever sees the file that [`train`] writes. It uses `scene` for pictures with
//! exact truth, `nn` to learn, `vision` for what the networks see and say.

mod batch;
mod boxes;
mod evaluate;
mod face;
mod mine;
mod pictures;
mod real;
mod samples;
mod sheet;
mod train;
mod trial;
mod tune;

pub use boxes::BoxesError;
pub use evaluate::{
    Coverage, CropEvaluation, CurvePoint, DecoyRow, DriveRow, EvaluateError, Evaluation, Evaluator,
    FIRST_EVALUATION_SEED, FalseFind, Miss, PhotoEvaluation, Product, Quantiles, ReliabilityBin, SceneRow, StageOne,
    evaluate_crops, evaluate_faces, evaluate_photographs, evaluate_truth_folder, truth_files,
};
pub use face::drive_seen;
pub use geometry::{Rate, wilson};
pub use sheet::crop_sheet;
pub use train::{Progress, TRAINING_SEEDS, TUNING_SEEDS, TrainError, TrainReport, TrainSettings, train};
pub use trial::{Trial, measure_networks, measure_networks_on_pictures, try_network};
pub use tune::Tuning;
