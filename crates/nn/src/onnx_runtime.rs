//! ONNX Runtime as an engine, found at run time: nothing of it is needed to build.
//!
//! The library is the one that `ORT_DYLIB_PATH` names (`libonnxruntime.so`, `onnxruntime.dll`, 1.17 or later), or the
//! system's. A graph reads N, C, H, W floats and answers with such; height and width must be free.

use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};

use ort::value::{Outlet, TensorRef, ValueType};

use crate::{Network, NnError, RowSource, Tensor, onnx};

/// What computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Provider {
    /// The processor.
    #[default]
    Cpu,
    /// The first NVIDIA GPU; an error where there is none, never silently the processor.
    Cuda,
}

/// A graph, ready to run. Clones share it.
#[derive(Clone)]
pub struct Session {
    session: Arc<Mutex<ort::session::Session>>,
    inputs: usize,
    outputs: usize,
    stride: Option<usize>,
}

impl fmt::Debug for Session {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ONNX Runtime session, {} to {} channels", self.inputs, self.outputs)
    }
}

/// Side of the picture that is tried first, px.
const TRIAL_PX: usize = 64;

fn failed(error: impl fmt::Display) -> NnError {
    NnError::OnnxRuntime(error.to_string())
}

/// Loads the library, once.
fn loaded() -> Result<(), NnError> {
    static LOADED: OnceLock<Result<(), String>> = OnceLock::new();
    let load = || {
        let default = || {
            format!(
                "{}onnxruntime{}",
                std::env::consts::DLL_PREFIX,
                std::env::consts::DLL_SUFFIX
            )
        };
        let path = std::env::var_os("ORT_DYLIB_PATH").map_or_else(|| PathBuf::from(default()), PathBuf::from);
        match ort::init_from(&path) {
            Ok(environment) => {
                environment.with_telemetry(false).commit();
                Ok(())
            }
            Err(error) => Err(format!(
                "cannot load {} ({error}); install ONNX Runtime, and let ORT_DYLIB_PATH name its library",
                path.display()
            )),
        }
    };
    LOADED.get_or_init(load).clone().map_err(NnError::OnnxRuntime)
}

impl Network {
    /// The same network, run by ONNX Runtime.
    ///
    /// # Errors
    /// [`NnError::OnnxRuntime`] where the library or the provider is not there.
    pub fn through_onnx_runtime(&self, provider: Provider) -> Result<Session, NnError> {
        Session::new(&onnx::export(self), provider)
    }
}

impl Session {
    /// A graph from the bytes of an ONNX file; it runs once, to see what it answers.
    ///
    /// # Errors
    /// [`NnError::OnnxRuntime`] where the library or the provider is not there, or with what it says of the graph.
    pub fn new(graph: &[u8], provider: Provider) -> Result<Self, NnError> {
        loaded()?;
        let providers = match provider {
            Provider::Cpu => Vec::new(),
            Provider::Cuda => vec![ort::ep::CUDA::default().build().error_on_failure()],
        };
        let session = ort::session::Session::builder()
            .map_err(failed)?
            .with_intra_threads(rayon::current_num_threads())
            .map_err(failed)?
            .with_execution_providers(providers)
            .map_err(failed)?
            .commit_from_memory(graph)
            .map_err(failed)?;
        let (Some(inputs), Some(outputs)) = (channels(session.inputs()), channels(session.outputs())) else {
            return Err(failed(
                "the graph must have one input and one output, both N, C, H, W with a fixed C",
            ));
        };
        let mut session = Self {
            session: Arc::new(Mutex::new(session)),
            inputs,
            outputs,
            stride: None,
        };
        let answer = session.forward_batch(&Tensor::zeros(1, TRIAL_PX, TRIAL_PX, inputs))?;
        let whole = answer.h == answer.w && answer.h > 0 && TRIAL_PX.is_multiple_of(answer.h);
        session.stride = whole.then(|| TRIAL_PX / answer.h);
        Ok(session)
    }

    /// Channels of the input.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Channels of the output.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Input pixels for an output pixel, where that is a whole number.
    pub fn stride(&self) -> Option<usize> {
        self.stride
    }

    /// The output for a whole picture (n = 1), which exists as floats at once here.
    ///
    /// # Errors
    /// [`NnError::OnnxRuntime`] with what the library says.
    pub fn forward(&self, source: &dyn RowSource) -> Result<Tensor, NnError> {
        let (h, w, c) = (source.height(), source.width(), source.channels());
        let mut planes = vec![0.0; c * h * w];
        let mut row = vec![0.0; w * c];
        for y in 0..h {
            source.row(y, &mut row);
            for (x, pixel) in row.chunks_exact(c).enumerate() {
                for (k, value) in pixel.iter().enumerate() {
                    planes[(k * h + y) * w + x] = *value;
                }
            }
        }
        self.run([1, c, h, w], &planes)
    }

    /// The outputs for many pictures of the same size.
    ///
    /// # Errors
    /// [`NnError::OnnxRuntime`] with what the library says.
    pub fn forward_batch(&self, batch: &Tensor) -> Result<Tensor, NnError> {
        let Tensor { n, h, w, c, .. } = *batch;
        if n == 0 {
            return Ok(Tensor::zeros(0, h, w, self.outputs));
        }
        let mut planes = vec![0.0; batch.data.len()];
        for (to, from) in planes
            .chunks_exact_mut(c * h * w)
            .zip(batch.data.chunks_exact(c * h * w))
        {
            for (at, pixel) in from.chunks_exact(c).enumerate() {
                for (k, value) in pixel.iter().enumerate() {
                    to[k * h * w + at] = *value;
                }
            }
        }
        self.run([n, c, h, w], &planes)
    }

    /// From planes to an answer with its channels together.
    fn run(&self, shape: [usize; 4], planes: &[f32]) -> Result<Tensor, NnError> {
        assert_eq!(
            shape[1], self.inputs,
            "the picture's channels must be the network's input channels"
        );
        let input = TensorRef::from_array_view((shape, planes)).map_err(failed)?;
        let mut session = self.session.lock().map_err(failed)?;
        let outputs = session.run(ort::inputs![input]).map_err(failed)?;
        let (shape, values) = outputs[0].try_extract_tensor::<f32>().map_err(failed)?;
        let sizes: Vec<usize> = shape.iter().filter_map(|&s| usize::try_from(s).ok()).collect();
        let [n, c, h, w] = sizes[..] else {
            return Err(failed(format!(
                "the graph answers with {shape:?}, expected is N, C, H, W"
            )));
        };
        let mut answer = Tensor::zeros(n, h, w, c);
        if answer.data.is_empty() {
            return Ok(answer);
        }
        for (to, from) in answer
            .data
            .chunks_exact_mut(c * h * w)
            .zip(values.chunks_exact(c * h * w))
        {
            for (at, pixel) in to.chunks_exact_mut(c).enumerate() {
                for (k, value) in pixel.iter_mut().enumerate() {
                    *value = from[k * h * w + at];
                }
            }
        }
        Ok(answer)
    }
}

/// The channels of the only input or output, where it is a picture.
fn channels(outlets: &[Outlet]) -> Option<usize> {
    let [outlet] = outlets else { return None };
    let ValueType::Tensor { shape, .. } = outlet.dtype() else {
        return None;
    };
    (shape.len() == 4).then(|| usize::try_from(shape[1]).ok())?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Engine, LayerSpec, Spec, Trainer};

    /// Runs where `ORT_DYLIB_PATH` names a library.
    #[test]
    #[ignore = "needs ONNX Runtime: ORT_DYLIB_PATH"]
    fn it_answers_as_the_own_kernels_do() -> Result<(), NnError> {
        let spec = Spec {
            input_channels: 3,
            layers: vec![
                LayerSpec::conv(5, 2, 1, 16),
                LayerSpec::conv(3, 2, 1, 24),
                LayerSpec::conv(3, 2, 1, 32),
                LayerSpec::conv(3, 1, 2, 32),
                LayerSpec::Upsample2,
                LayerSpec::output(2),
            ],
        };
        let network = Trainer::new(spec, 3).network();
        let mut batch = Tensor::zeros(3, 96, 64, 3);
        for (i, value) in batch.data.iter_mut().enumerate() {
            *value = (i * 7919 % 1013) as f32 / 506.5 - 1.0;
        }
        let graph = Engine::from_bytes(&onnx::export(&network))?;
        assert!(matches!(graph, Engine::OnnxRuntime(_)));
        assert_eq!((graph.inputs(), graph.outputs(), graph.stride()), (3, 2, Some(4)));
        let own = Engine::from(network);
        for (a, b) in [
            (own.forward_batch(&batch)?, graph.forward_batch(&batch)?),
            (own.forward(&batch)?, graph.forward(&batch)?),
        ] {
            assert_eq!((a.n, a.h, a.w, a.c), (b.n, b.h, b.w, b.c));
            let apart = a
                .data
                .iter()
                .zip(&b.data)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max);
            assert!(apart < 1e-4, "{apart}");
        }
        assert!(Engine::from_bytes(&[8; 40]).is_err());
        Ok(())
    }
}
