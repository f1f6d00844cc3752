//! What runs a network: the kernels of this crate, or ONNX Runtime (feature `ort`).

use crate::{Network, NnError, RowSource, Step, Tensor};

/// A network and what runs it.
#[derive(Clone, Debug)]
pub enum Engine {
    /// This crate's kernels: nothing else is needed.
    Own(Network),
    /// ONNX Runtime: any graph, and its providers for GPUs.
    #[cfg(feature = "ort")]
    OnnxRuntime(crate::onnx_runtime::Session),
}

impl From<Network> for Engine {
    fn from(network: Network) -> Self {
        Engine::Own(network)
    }
}

impl Engine {
    /// Reads a network that a [`Trainer`](crate::Trainer) wrote, or an ONNX graph, which needs the feature `ort`.
    ///
    /// # Errors
    /// An [`NnError`] that says what is wrong with the bytes, or that ONNX Runtime is needed and not there.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, NnError> {
        // safetensors: the length of the header (8 bytes), then JSON; ONNX: the tag of its first field, `ir_version`
        let graph = bytes.first() == Some(&0x08) && bytes.get(8) != Some(&b'{');
        #[cfg(feature = "ort")]
        if graph {
            return crate::onnx_runtime::Session::new(bytes, crate::onnx_runtime::Provider::Cpu)
                .map(Engine::OnnxRuntime);
        }
        if graph {
            return Err(NnError::OnnxRuntime(
                "the network is an ONNX graph that only ONNX Runtime can run; build with `--features ort`".into(),
            ));
        }
        Network::from_bytes(bytes).map(Engine::Own)
    }

    /// The same run in eight bits where that is possible ([`Network::in_eight_bits`]).
    #[must_use]
    pub fn in_eight_bits(self, input: &[Step]) -> Self {
        match self {
            Engine::Own(network) => Engine::Own(network.in_eight_bits(input)),
            #[cfg(feature = "ort")]
            there => there,
        }
    }

    /// Channels of the input.
    pub fn inputs(&self) -> usize {
        match self {
            Engine::Own(network) => network.spec().input_channels,
            #[cfg(feature = "ort")]
            Engine::OnnxRuntime(session) => session.inputs(),
        }
    }

    /// Channels of the output.
    pub fn outputs(&self) -> usize {
        match self {
            Engine::Own(network) => network.spec().output_channels(),
            #[cfg(feature = "ort")]
            Engine::OnnxRuntime(session) => session.outputs(),
        }
    }

    /// Input pixels for an output pixel along each axis, where that is a whole number.
    pub fn stride(&self) -> Option<usize> {
        match self {
            // a network that ends with an enlargement has its cells half a cell off, and learns to answer for where they should be
            Engine::Own(network) => {
                let (scale, offset) = network.spec().pixel_map();
                (scale.fract() == 0.0 && scale >= 1.0 && offset.abs() <= 0.5 * scale).then_some(scale as usize)
            }
            #[cfg(feature = "ort")]
            Engine::OnnxRuntime(session) => session.stride(),
        }
    }

    /// Side of the square of input pixels that an output pixel depends on; `None` where only the graph knows.
    pub fn receptive_field(&self) -> Option<usize> {
        match self {
            Engine::Own(network) => Some(network.spec().receptive_field()),
            #[cfg(feature = "ort")]
            Engine::OnnxRuntime(_) => None,
        }
    }

    /// The output for a whole picture (n = 1).
    ///
    /// # Errors
    /// [`NnError::OnnxRuntime`]; this crate's kernels do not fail.
    ///
    /// # Panics
    /// Where the source does not have the network's input channels, or no pixels.
    pub fn forward(&self, source: &dyn RowSource) -> Result<Tensor, NnError> {
        match self {
            Engine::Own(network) => Ok(network.forward(source)),
            #[cfg(feature = "ort")]
            Engine::OnnxRuntime(session) => session.forward(source),
        }
    }

    /// The outputs for many small pictures of the same size.
    ///
    /// # Errors
    /// [`NnError::OnnxRuntime`]; this crate's kernels do not fail.
    ///
    /// # Panics
    /// Where the batch does not have the network's input channels, or no pixels.
    pub fn forward_batch(&self, batch: &Tensor) -> Result<Tensor, NnError> {
        match self {
            Engine::Own(network) => Ok(network.forward_batch(batch)),
            #[cfg(feature = "ort")]
            Engine::OnnxRuntime(session) => session.forward_batch(batch),
        }
    }
}
