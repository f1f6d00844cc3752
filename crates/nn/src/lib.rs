//! Small convolutional networks, forward and backward, on the CPU.
//!
//! The networks of `vision` run here and those of `training` learn here; this crate knows nothing of screws.
//! A [`Spec`] describes a sequential fully convolutional network, a [`Trainer`] learns its parameters and writes them
//! as safetensors, a [`Network`] reads them and runs them over whole pictures or batches of clips; an [`Engine`] is such a network, or
//! with the feature `ort` any ONNX graph.
//!
//! Everything rests on one register-blocked kernel (AVX-512, AVX2 or portable, found at run time), and for inference in eight bits
//! ([`Network::in_eight_bits`]) on a second one of the same build. Results do not depend on the number of threads nor on how a picture is
//! cut into strips; those in eight bits not on the processor either.
//!
//! ```
//! use nn::{LayerSpec, Spec, Tensor, Trainer, softmax_cross_entropy};
//!
//! let conv = |stride, out, last: bool| LayerSpec::Conv {
//!     kernel: 3, stride, dilation: 1, out, batch_norm: !last, relu: !last,
//! };
//! let spec = Spec { input_channels: 3, layers: vec![conv(2, 8, false), conv(1, 2, true)] };
//! let mut trainer = Trainer::new(spec, 1);
//! let batch = Tensor::zeros(4, 16, 16, 3);
//! let logits = trainer.forward(&batch);
//! let (target, weight) = (vec![0; 4 * 8 * 8], vec![1.0; 4 * 8 * 8]);
//! let mut grad = Tensor::zeros(4, 8, 8, 2);
//! let loss = softmax_cross_entropy(&logits, 0..2, &target, &weight, &mut grad);
//! trainer.backward(&grad);
//! trainer.adam_step(0.01, 0.0);
//! assert!(loss.is_finite());
//! assert_eq!(trainer.network().forward_batch(&batch).h, 8);
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod conv;
mod eight;
mod elementwise;
mod engine;
mod error;
mod file;
mod kernel;
mod kernel8;
mod loss;
mod network;
pub mod onnx;
#[cfg(feature = "ort")]
pub mod onnx_runtime;
mod spec;
mod tensor;
mod train;

pub use eight::Step;
pub use engine::Engine;
pub use error::NnError;
pub use file::metadata;
pub use loss::{softmax, softmax_cross_entropy};
pub use network::Network;
pub use spec::{LayerSpec, Spec};
pub use tensor::{RowSource, Tensor};
pub use train::Trainer;

#[cfg(test)]
mod tests;
