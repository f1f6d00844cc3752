//! What can be wrong with a network file.

use std::path::PathBuf;

/// Why a network could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum NnError {
    /// The file system refused.
    #[error("could not {action} the network file {}: {source}; check the path, its permissions and the free space", path.display())]
    Io {
        /// `read` or `write`.
        action: &'static str,
        /// Of the network file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// No safetensors file, or a damaged one.
    #[error(
        "this is no readable network file ({0}); give a .safetensors file written by `unscrew train`, or copy it again"
    )]
    Format(String),
    /// A safetensors file of something else.
    #[error(
        "the safetensors file has no `spec` in its metadata, so it is not a network of this program; give a file written by `unscrew train`"
    )]
    NoSpec,
    /// An architecture that the kernels do not have.
    #[error(
        "layer {layer} of the network cannot be run: {reason}; change the architecture or use a newer version of this program"
    )]
    Spec {
        /// Index of the layer.
        layer: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A parameter is not in the file.
    #[error(
        "the network file lacks the tensor `{0}` that its spec asks for; it is damaged or was written by another version: train or export it again"
    )]
    MissingTensor(String),
    /// A parameter has another shape than the architecture says.
    #[error(
        "the tensor `{name}` of the network file is {found}, but its spec asks for {expected}; train or export it again"
    )]
    Shape {
        /// Of the tensor.
        name: String,
        /// Type and shape in the file.
        found: String,
        /// Type and shape by the spec.
        expected: String,
    },
    /// A parameter is infinite or not a number.
    #[error(
        "the tensor `{0}` of the network file has values that are not finite: the training diverged; lower its learning rate and train again"
    )]
    NotFinite(String),
    /// An ONNX model that is not one chain of the layers that can be run.
    #[error("the ONNX model cannot be used: {0}")]
    Onnx(String),
    /// ONNX Runtime is needed and not there, or failed.
    #[error("ONNX Runtime: {0}")]
    OnnxRuntime(String),
}
