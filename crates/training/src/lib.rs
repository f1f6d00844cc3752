//! Data sets, augmentation, training, evaluation.
