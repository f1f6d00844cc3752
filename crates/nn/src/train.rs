//! Training: forward with batch statistics, backward, Adam.
//!
//! Work is parallel over chunks of [`CHUNK`] pictures; sums over the batch are formed a picture or a chunk at a time and
//! added in index order, so the number of threads cannot change a bit of a result.

use std::collections::BTreeMap;
use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use crate::conv::{Geometry, MAX_TAPS, pack, stored_channels, unpack};
use crate::elementwise;
use crate::file::{Entry, Reader, read, serialize, write};
use crate::kernel::{Level, Product, Segment, Start};
use crate::network::{ConvParameters, Norm, read_parameters};
use crate::spec::{NORM_EPSILON, upsample_taps};
use crate::{LayerSpec, Network, NnError, Spec, Tensor};

/// Pictures that share one partial weight gradient.
const CHUNK: usize = 4;
/// Share of a new batch in the running statistics.
const MOMENTUM: f32 = 0.1;
/// Adam's decay of the first and second moment, and its guard against division by zero.
const BETA: (f32, f32) = (0.9, 0.999);
const ADAM_EPSILON: f32 = 1e-8;

/// A network in training: parameters, running batch statistics, Adam moments.
///
/// `forward`, a loss, `backward`, `adam_step`; the same seed and data give the same bits on any number of threads.
#[derive(Clone, Debug)]
pub struct Trainer {
    spec: Spec,
    channels: Vec<usize>,
    stored: Vec<usize>,
    layers: Vec<Layer>,
    steps: u32,
    level: Level,
    /// Of the last forward pass; kept so that the next need not allocate.
    pass: Pass,
}

#[derive(Clone, Debug)]
enum Layer {
    Conv(Box<Conv>),
    MaxPool2,
    Upsample2,
}

#[derive(Clone, Debug)]
struct Conv {
    geometry: Geometry,
    relu: bool,
    /// Packed.
    weight: Parameter,
    /// The bias, or batch normalisation instead of it.
    after: After,
}

#[derive(Clone, Debug)]
enum After {
    Bias(Parameter),
    Norm(BatchNorm),
}

#[derive(Clone, Debug)]
struct BatchNorm {
    scale: Parameter,
    shift: Parameter,
    running_mean: Vec<f32>,
    running_variance: Vec<f32>,
    /// Of the last batch.
    mean: Vec<f32>,
    inverse_deviation: Vec<f32>,
}

#[derive(Clone, Debug)]
struct Parameter {
    value: Vec<f32>,
    gradient: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
}

/// What a forward pass leaves for the backward pass.
#[derive(Clone, Debug, Default)]
struct Pass {
    n: usize,
    /// Height and width before each layer and after the last.
    sizes: Vec<(usize, usize)>,
    /// The input of each layer and the output of the last, padded as the layer that reads it needs.
    values: Vec<Padded>,
    /// The output of each convolution before batch norm, not padded; empty for other layers.
    raw: Vec<Vec<f32>>,
    /// Gradients by the value after and before the current layer, not padded.
    gradient: Vec<f32>,
    gradient_before: Vec<f32>,
    /// A weight gradient for each chunk.
    partial: Vec<f32>,
}

/// Pictures with a border of zeros.
#[derive(Clone, Debug, Default)]
struct Padded {
    data: Vec<f32>,
    frame: Frame,
}

/// The layout of one picture of a [`Padded`].
#[derive(Clone, Copy, Debug, Default)]
struct Frame {
    h: usize,
    w: usize,
    c: usize,
    pad: usize,
}

impl Frame {
    /// Floats in a row.
    fn row(&self) -> usize {
        (self.w + 2 * self.pad) * self.c
    }

    /// Floats in a picture.
    fn picture(&self) -> usize {
        (self.h + 2 * self.pad) * self.row()
    }

    /// Index of pixel 0 of a row.
    fn pixel(&self, y: usize) -> usize {
        (y + self.pad) * self.row() + self.pad * self.c
    }

    /// The pixels of a row, without the border.
    fn pixels<'a>(&self, picture: &'a [f32], y: usize) -> &'a [f32] {
        &picture[self.pixel(y)..][..self.w * self.c]
    }

    fn pixels_mut<'a>(&self, picture: &'a mut [f32], y: usize) -> &'a mut [f32] {
        &mut picture[self.pixel(y)..][..self.w * self.c]
    }
}

impl Parameter {
    fn new(value: Vec<f32>) -> Self {
        let zeros = vec![0.0; value.len()];
        Self {
            value,
            gradient: zeros.clone(),
            first: zeros.clone(),
            second: zeros,
        }
    }

    /// `value` for the first `channels` floats, zero for the `stored - channels` that only fill up vectors.
    fn per_channel(mut value: Vec<f32>, stored: usize) -> Self {
        value.resize(stored, 0.0);
        Self::new(value)
    }

    fn step(&mut self, rate: f32, decay: f32, corrections: (f32, f32)) {
        let values = self.value.iter_mut().zip(&mut self.gradient);
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((value, gradient), (first, second)) in values.zip(moments) {
            *first = BETA.0 * *first + (1.0 - BETA.0) * *gradient;
            *second = BETA.1 * *second + (1.0 - BETA.1) * *gradient * *gradient;
            let step = (*first / corrections.0) / ((*second / corrections.1).sqrt() + ADAM_EPSILON);
            *value -= rate * (step + decay * *value);
            *gradient = 0.0;
        }
    }
}

impl Trainer {
    /// A network with random weights (He et al. 2015, uniform), which depend on `seed` alone.
    ///
    /// # Panics
    /// Where [`Spec::check`] fails.
    pub fn new(spec: Spec, seed: u64) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let channels = spec.channels();
        let parameters: Vec<_> = spec
            .layers
            .iter()
            .zip(&channels)
            .filter_map(|(layer, &inputs)| {
                let &LayerSpec::Conv {
                    kernel,
                    out,
                    batch_norm,
                    ..
                } = layer
                else {
                    return None;
                };
                let terms = kernel * kernel * inputs;
                let bound = (6.0 / terms as f32).sqrt();
                Some(ConvParameters {
                    weight: (0..terms * out).map(|_| random.random_range(-bound..bound)).collect(),
                    bias: vec![0.0; if batch_norm { 0 } else { out }],
                    norm: batch_norm.then(|| Norm {
                        scale: vec![1.0; out],
                        shift: vec![0.0; out],
                        mean: vec![0.0; out],
                        variance: vec![1.0; out],
                    }),
                })
            })
            .collect();
        Self::from_parameters(spec, parameters)
    }

    fn from_parameters(spec: Spec, parameters: Vec<ConvParameters>) -> Self {
        if let Err(error) = spec.check() {
            panic!("{error}");
        }
        let channels = spec.channels();
        let stored = stored_channels(&channels);
        let mut parameters = parameters.into_iter();
        let mut layers = Vec::with_capacity(spec.layers.len());
        for (index, layer) in spec.layers.iter().enumerate() {
            layers.push(match *layer {
                LayerSpec::MaxPool2 => Layer::MaxPool2,
                LayerSpec::Upsample2 => Layer::Upsample2,
                LayerSpec::Conv {
                    kernel,
                    stride,
                    dilation,
                    out,
                    relu,
                    ..
                } => {
                    let geometry = Geometry {
                        kernel,
                        stride,
                        dilation,
                        inputs: stored[index],
                        outputs: stored[index + 1],
                    };
                    let given = parameters.next().unwrap_or_else(|| unreachable!());
                    let fill = |value| Parameter::per_channel(value, geometry.outputs);
                    Layer::Conv(Box::new(Conv {
                        geometry,
                        relu,
                        weight: Parameter::new(pack(&geometry, channels[index], out, &given.weight)),
                        after: match given.norm {
                            None => After::Bias(fill(given.bias)),
                            Some(norm) => After::Norm(BatchNorm {
                                running_mean: fill(norm.mean).value,
                                running_variance: fill(norm.variance).value,
                                scale: fill(norm.scale),
                                shift: fill(norm.shift),
                                mean: vec![0.0; geometry.outputs],
                                inverse_deviation: vec![0.0; geometry.outputs],
                            }),
                        },
                    }))
                }
            });
        }
        Self {
            spec,
            channels,
            stored,
            layers,
            steps: 0,
            level: Level::detect(),
            pass: Pass::default(),
        }
    }

    /// The architecture.
    pub fn spec(&self) -> &Spec {
        &self.spec
    }

    /// Steps of [`adam_step`](Self::adam_step) so far.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// The outputs for a batch, normalised by its own statistics; keeps what [`backward`](Self::backward) needs.
    ///
    /// # Panics
    /// Where the batch is empty or does not have the network's input channels.
    pub fn forward(&mut self, batch: &Tensor) -> Tensor {
        batch.assert_shape();
        assert!(!batch.data.is_empty(), "a batch needs pictures with pixels");
        assert_eq!(
            batch.c, self.spec.input_channels,
            "the batch's channels must be the network's input channels"
        );
        self.prepare(batch.n, batch.h, batch.w);
        let level = self.level;
        let pass = &mut self.pass;
        let frame = pass.values[0].frame;
        pass.values[0]
            .data
            .par_chunks_mut(frame.picture())
            .zip(batch.data.par_chunks(batch.h * batch.w * batch.c))
            .for_each(|(to, from)| {
                for (y, row) in from.chunks_exact(batch.w * batch.c).enumerate() {
                    frame.pixels_mut(to, y).copy_from_slice(row);
                }
            });
        for index in 0..self.layers.len() {
            let (before, layer) = self.layers.split_at_mut(index);
            let norm_before = before.last().and_then(Layer::norm);
            let (values, after) = pass.values.split_at_mut(index + 1);
            let (input, output) = (&mut values[index], &mut after[0]);
            let (raw_before, raw) = pass.raw.split_at_mut(index);
            let raw_before = raw_before.last();
            let (from, to) = (input.frame, output.frame);
            let inputs = input.data.par_chunks_mut(from.picture()).enumerate();
            let finish = |n: usize, input: &mut [f32]| {
                if let (Some((norm, relu)), Some(raw)) = (norm_before, raw_before) {
                    norm.apply(level, relu, &raw[n * from.h * from.w * from.c..], input, &from);
                }
            };
            match &mut layer[0] {
                Layer::Conv(conv) => {
                    let (geometry, weights, relu) = (conv.geometry, &conv.weight.value, conv.relu);
                    match &mut conv.after {
                        After::Bias(bias) => {
                            let outputs = output.data.par_chunks_mut(to.picture());
                            inputs.zip(outputs).for_each(|((n, input), output)| {
                                finish(n, input);
                                for y in 0..to.h {
                                    let out = frame_row(&to, output, y);
                                    let start = Start::Bias(bias.value.as_ptr());
                                    conv_row(level, &geometry, weights, y, &from, input, out, &to, start, relu);
                                }
                            });
                        }
                        After::Norm(norm) => {
                            let picture = to.h * to.w * to.c;
                            let mut sums = vec![0.0; pass.n * 2 * to.c];
                            let outputs = raw[0].par_chunks_mut(picture);
                            let outputs = outputs.zip(sums.par_chunks_mut(2 * to.c));
                            inputs.zip(outputs).for_each(|((n, input), (output, sums))| {
                                finish(n, input);
                                for (y, row) in output.chunks_exact_mut(to.w * to.c).enumerate() {
                                    let out = row.as_mut_ptr();
                                    conv_row(level, &geometry, weights, y, &from, input, out, &to, Start::Zero, false);
                                    elementwise::moments(level, row, sums);
                                }
                            });
                            norm.gather(&sums, pass.n * to.h * to.w);
                        }
                    }
                }
                Layer::MaxPool2 => {
                    let outputs = output.data.par_chunks_mut(to.picture());
                    inputs.zip(outputs).for_each(|((n, input), output)| {
                        finish(n, input);
                        max_pool(&from, input, &to, output);
                    });
                }
                Layer::Upsample2 => {
                    let outputs = output.data.par_chunks_mut(to.picture());
                    inputs.zip(outputs).for_each(|((n, input), output)| {
                        finish(n, input);
                        upsample(&from, input, &to, output);
                    });
                }
            }
        }
        let last = self.layers.len();
        let frame = pass.values[last].frame;
        let channels = self.channels[last];
        let mut output = Tensor::zeros(batch.n, frame.h, frame.w, channels);
        let norm = self.layers[last - 1].norm();
        let raw = &pass.raw[last - 1];
        pass.values[last]
            .data
            .par_chunks_mut(frame.picture())
            .zip(output.data.par_chunks_mut(frame.h * frame.w * channels))
            .enumerate()
            .for_each(|(n, (value, output))| {
                if let Some((norm, relu)) = norm {
                    norm.apply(level, relu, &raw[n * frame.picture()..], value, &frame);
                }
                for (to, from) in output.chunks_exact_mut(channels).zip(value.chunks_exact(frame.c)) {
                    to.copy_from_slice(&from[..channels]);
                }
            });
        output
    }

    /// Makes room for a batch; the borders of the values are zero and stay so.
    fn prepare(&mut self, n: usize, h: usize, w: usize) {
        if self.pass.n == n && self.pass.sizes.first() == Some(&(h, w)) {
            return;
        }
        let mut sizes = vec![(h, w)];
        for layer in &self.spec.layers {
            let (h, w) = sizes[sizes.len() - 1];
            sizes.push((layer.output_size(h), layer.output_size(w)));
        }
        let values = (0..sizes.len())
            .map(|index| {
                let frame = Frame {
                    h: sizes[index].0,
                    w: sizes[index].1,
                    c: self.stored[index],
                    pad: self.spec.layers.get(index).map_or(0, LayerSpec::padding),
                };
                Padded {
                    data: vec![0.0; n * frame.picture()],
                    frame,
                }
            })
            .collect();
        let floats = |index: usize| n * sizes[index].0 * sizes[index].1 * self.stored[index];
        let raw = (0..self.layers.len())
            .map(|index| match self.layers[index].norm() {
                Some(_) => vec![0.0; floats(index + 1)],
                None => Vec::new(),
            })
            .collect();
        let largest = (0..sizes.len()).map(floats).max().unwrap_or(0);
        let weights = self.layers.iter().map(|layer| match layer {
            Layer::Conv(conv) => conv.geometry.weights() + conv.geometry.outputs,
            _ => 0,
        });
        let weights = weights.max().unwrap_or(0);
        self.pass = Pass {
            n,
            sizes: sizes.clone(),
            values,
            raw,
            gradient: vec![0.0; largest],
            gradient_before: vec![0.0; largest],
            partial: vec![0.0; n.div_ceil(CHUNK) * weights],
        };
    }

    /// Adds the gradients of the parameters, given that of the loss by the output of the last forward pass.
    /// Averaging is the caller's: the gradient of a mean loss gives mean gradients.
    ///
    /// # Panics
    /// Where the shape differs from that output.
    pub fn backward(&mut self, grad_output: &Tensor) {
        grad_output.assert_shape();
        let last = self.layers.len();
        let frame = self.pass.values.last().map(|value| value.frame).unwrap_or_default();
        let channels = self.channels[last];
        assert_eq!(
            (grad_output.n, grad_output.h, grad_output.w, grad_output.c),
            (self.pass.n, frame.h, frame.w, channels),
            "the gradient must have the shape of the last output"
        );
        let level = self.level;
        let pass = &mut self.pass;
        let picture = frame.picture();
        let mut sums = vec![0.0; pass.n * 2 * frame.c];
        pass.gradient[..pass.n * picture]
            .par_chunks_mut(picture)
            .zip(grad_output.data.par_chunks(frame.h * frame.w * channels))
            .zip(sums.par_chunks_mut(2 * frame.c))
            .enumerate()
            .for_each(|(n, ((to, from), sums))| {
                for (to, from) in to.chunks_exact_mut(frame.c).zip(from.chunks_exact(channels)) {
                    to[..channels].copy_from_slice(from);
                    to[channels..].fill(0.0);
                }
                let value = &pass.values[last].data[n * picture..][..picture];
                self.layers[last - 1].enter(level, n, to, value, &frame, &pass.raw[last - 1], sums);
            });
        for index in (0..last).rev() {
            let (before, layer) = self.layers.split_at_mut(index);
            let before = before.last();
            let (input, output) = (&pass.values[index], pass.values[index + 1].frame);
            let from = input.frame;
            let from_size = from.h * from.w * from.c;
            let to_size = output.h * output.w * output.c;
            let mut sums_before = vec![0.0; pass.n * 2 * from.c];
            let raw_before = index.checked_sub(1).map(|i| &pass.raw[i]);
            let gradient = &pass.gradient[..pass.n * to_size];
            let outside = Frame { pad: 0, ..from };
            let gradients_before = pass.gradient_before[..pass.n * from_size]
                .par_chunks_mut(CHUNK * from_size)
                .zip(sums_before.par_chunks_mut(CHUNK * 2 * from.c))
                .enumerate();
            let enter = |n: usize, gradient: &mut [f32], sums: &mut [f64]| {
                if let (Some(layer), Some(raw)) = (before, raw_before) {
                    let value = &input.data[n * from.picture()..][..from.picture()];
                    layer.enter(level, n, gradient, value, &from, raw, sums);
                }
            };
            let picture = |n: usize| &input.data[n * from.picture()..][..from.picture()];
            match &mut layer[0] {
                Layer::Conv(conv) => {
                    let geometry = conv.geometry;
                    let means = match &mut conv.after {
                        After::Bias(_) => None,
                        After::Norm(norm) => Some(norm.gather_gradients(&sums, (pass.n * output.h * output.w) as f64)),
                    };
                    let flipped = flip(&geometry, &conv.weight.value);
                    let parts = geometry.weights() + geometry.outputs;
                    let partial = &mut pass.partial[..pass.n.div_ceil(CHUNK) * parts];
                    partial.fill(0.0);
                    let dense = Frame {
                        pad: geometry.padding(),
                        ..output
                    };
                    let after = &conv.after;
                    let raw = &pass.raw[index];
                    gradients_before.zip(partial.par_chunks_mut(parts)).for_each_init(
                        || vec![0.0; dense.picture()],
                        |scratch, ((chunk, (gradients_before, sums_before)), partial)| {
                            let (weights, bias) = partial.split_at_mut(geometry.weights());
                            let pictures = gradients_before.chunks_exact_mut(from_size);
                            let pictures = pictures.zip(sums_before.chunks_exact_mut(2 * from.c));
                            for (i, (gradient_before, sums_before)) in pictures.enumerate() {
                                let n = chunk * CHUNK + i;
                                let gradient = &gradient[n * to_size..][..to_size];
                                for (y, row) in gradient.chunks_exact(output.w * output.c).enumerate() {
                                    let to = dense.pixels_mut(scratch, y);
                                    match (after, &means) {
                                        (After::Norm(norm), Some(means)) => {
                                            let raw = &raw[n * to_size + y * row.len()..][..row.len()];
                                            elementwise::norm_backward(level, row, raw, &norm.mean, means, to);
                                        }
                                        _ => {
                                            to.copy_from_slice(row);
                                            elementwise::add_pixels(level, row, bias);
                                        }
                                    }
                                }
                                weight_gradient(level, &geometry, &from, picture(n), &dense, scratch, weights);
                                if index > 0 {
                                    input_gradient(
                                        level,
                                        &geometry,
                                        &flipped,
                                        &dense,
                                        scratch,
                                        &outside,
                                        gradient_before,
                                    );
                                    enter(n, gradient_before, sums_before);
                                }
                            }
                        },
                    );
                    for partial in partial.chunks_exact(parts) {
                        let (weights, bias) = partial.split_at(geometry.weights());
                        add(&mut conv.weight.gradient, weights);
                        if let After::Bias(parameter) = &mut conv.after {
                            add(&mut parameter.gradient, bias);
                        }
                    }
                }
                Layer::MaxPool2 | Layer::Upsample2 => {
                    let pool = matches!(layer[0], Layer::MaxPool2);
                    gradients_before.for_each(|(chunk, (gradients_before, sums_before))| {
                        let pictures = gradients_before.chunks_exact_mut(from_size);
                        let pictures = pictures.zip(sums_before.chunks_exact_mut(2 * from.c));
                        for (i, (before, sums_before)) in pictures.enumerate() {
                            let n = chunk * CHUNK + i;
                            let gradient = &gradient[n * to_size..][..to_size];
                            before.fill(0.0);
                            if pool {
                                max_pool_backward(&from, picture(n), &output, gradient, before);
                            } else {
                                upsample_backward(&from, &output, gradient, before);
                            }
                            enter(n, before, sums_before);
                        }
                    });
                }
            }
            sums = sums_before;
            std::mem::swap(&mut pass.gradient, &mut pass.gradient_before);
        }
    }

    /// One step of Adam (Kingma and Ba 2015) with the gradients added up since the last, which it zeroes.
    ///
    /// `weight_decay` is decoupled (Loshchilov and Hutter 2019) and applies to the weights of the convolutions only.
    pub fn adam_step(&mut self, learning_rate: f32, weight_decay: f32) {
        self.steps += 1;
        let correction = |beta: f32| (1.0 - f64::from(beta).powi(self.steps as i32)) as f32;
        let corrections = (correction(BETA.0), correction(BETA.1));
        for layer in &mut self.layers {
            let Layer::Conv(conv) = layer else { continue };
            conv.weight.step(learning_rate, weight_decay, corrections);
            match &mut conv.after {
                After::Bias(bias) => bias.step(learning_rate, 0.0, corrections),
                After::Norm(norm) => {
                    norm.scale.step(learning_rate, 0.0, corrections);
                    norm.shift.step(learning_rate, 0.0, corrections);
                }
            }
        }
    }

    /// The network as it is now, with the running statistics folded in.
    pub fn network(&self) -> Network {
        Network::new(self.spec.clone(), &self.parameters(), self.level)
    }

    /// The parameters as in files.
    fn parameters(&self) -> Vec<ConvParameters> {
        let mut parameters = Vec::new();
        for (index, layer) in self.layers.iter().enumerate() {
            let Layer::Conv(conv) = layer else { continue };
            let (inputs, outputs) = (self.channels[index], self.channels[index + 1]);
            let cut = |values: &[f32]| values[..outputs].to_vec();
            let (bias, norm) = match &conv.after {
                After::Bias(bias) => (cut(&bias.value), None),
                After::Norm(norm) => {
                    let norm = Norm {
                        scale: cut(&norm.scale.value),
                        shift: cut(&norm.shift.value),
                        mean: cut(&norm.running_mean),
                        variance: cut(&norm.running_variance),
                    };
                    (Vec::new(), Some(norm))
                }
            };
            parameters.push(ConvParameters {
                weight: unpack(&conv.geometry, inputs, outputs, &conv.weight.value),
                bias,
                norm,
            });
        }
        parameters
    }

    /// Writes what a [`Network`] needs, and `metadata`, as a safetensors file.
    ///
    /// # Errors
    /// [`NnError::Io`] where the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>, metadata: &BTreeMap<String, String>) -> Result<(), NnError> {
        write(path.as_ref(), &self.to_bytes(metadata)?)
    }

    /// The bytes that [`save`](Self::save) writes; equal networks and metadata give equal bytes.
    ///
    /// # Errors
    /// [`NnError::Format`] where the metadata cannot be written as JSON.
    pub fn to_bytes(&self, metadata: &BTreeMap<String, String>) -> Result<Vec<u8>, NnError> {
        serialize(&self.spec, metadata, &self.entries())
    }

    /// Writes everything that it takes to go on training: as [`save`](Self::save), and Adam's state.
    ///
    /// # Errors
    /// [`NnError::Io`] where the file cannot be written.
    pub fn save_checkpoint(&self, path: impl AsRef<Path>, metadata: &BTreeMap<String, String>) -> Result<(), NnError> {
        write(path.as_ref(), &self.checkpoint_bytes(metadata)?)
    }

    /// The bytes that [`save_checkpoint`](Self::save_checkpoint) writes: a second trainer made of them goes on alike.
    ///
    /// # Errors
    /// [`NnError::Format`] where the metadata cannot be written as JSON.
    pub fn checkpoint_bytes(&self, metadata: &BTreeMap<String, String>) -> Result<Vec<u8>, NnError> {
        let mut metadata = metadata.clone();
        metadata.insert(STEPS.into(), self.steps.to_string());
        let mut entries = self.entries();
        for (index, layer) in self.layers.iter().enumerate() {
            let Layer::Conv(conv) = layer else { continue };
            for (name, parameter) in conv.parameters() {
                for (moment, data) in [("first", &parameter.first), ("second", &parameter.second)] {
                    entries.push(Entry {
                        name: format!("adam.{index}.{name}.{moment}"),
                        shape: vec![data.len()],
                        data: data.clone(),
                    });
                }
            }
        }
        serialize(&self.spec, &metadata, &entries)
    }

    /// Reads a file that [`save_checkpoint`](Self::save_checkpoint) wrote; or one that [`save`](Self::save) wrote, to
    /// train further with fresh Adam moments.
    ///
    /// # Errors
    /// An [`NnError`] that says what is wrong with the file.
    pub fn load_checkpoint(path: impl AsRef<Path>) -> Result<Self, NnError> {
        Self::from_bytes(&read(path.as_ref())?)
    }

    /// As [`load_checkpoint`](Self::load_checkpoint), from the bytes of such a file.
    ///
    /// # Errors
    /// An [`NnError`] that says what is wrong with them.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, NnError> {
        let reader = Reader::new(bytes)?;
        let mut trainer = Self::from_parameters(reader.spec.clone(), read_parameters(&reader)?);
        let Some(steps) = reader.metadata.get(STEPS) else {
            return Ok(trainer);
        };
        trainer.steps = steps
            .parse()
            .map_err(|_| NnError::Format(format!("its step count is {steps:?}")))?;
        for (index, layer) in trainer.layers.iter_mut().enumerate() {
            let Layer::Conv(conv) = layer else { continue };
            for (name, parameter) in conv.parameters_mut() {
                let shape = [parameter.value.len()];
                let tensor = |moment: &str| reader.tensor(&format!("adam.{index}.{name}.{moment}"), &shape);
                parameter.first = tensor("first")?;
                parameter.second = tensor("second")?;
            }
        }
        Ok(trainer)
    }

    /// For tests: values and gradients of all parameters, convolution by convolution, as in files.
    #[cfg(test)]
    pub(crate) fn flat(&self) -> (Vec<f32>, Vec<f32>) {
        let (mut values, mut gradients) = (Vec::new(), Vec::new());
        for (index, layer) in self.layers.iter().enumerate() {
            let Layer::Conv(conv) = layer else { continue };
            let (inputs, outputs) = (self.channels[index], self.channels[index + 1]);
            for (name, parameter) in conv.parameters() {
                for (to, from) in [(&mut values, &parameter.value), (&mut gradients, &parameter.gradient)] {
                    to.extend(if name == "weight" {
                        unpack(&conv.geometry, inputs, outputs, from)
                    } else {
                        from[..outputs].to_vec()
                    });
                }
            }
        }
        (values, gradients)
    }

    /// For tests: as on a processor of that level.
    #[cfg(test)]
    pub(crate) fn set_level(&mut self, level: Level) {
        self.level = level;
    }

    fn entries(&self) -> Vec<Entry> {
        let mut entries = Vec::new();
        let mut parameters = self.parameters().into_iter();
        for (index, layer) in self.spec.layers.iter().enumerate() {
            let &LayerSpec::Conv { kernel, out, .. } = layer else {
                continue;
            };
            let Some(parameters) = parameters.next() else {
                continue;
            };
            let mut entry = |name: &str, shape: Vec<usize>, data: Vec<f32>| {
                let name = format!("layers.{index}.{name}");
                entries.push(Entry { name, shape, data });
            };
            let inputs = self.channels[index];
            entry("weight", vec![out, inputs, kernel, kernel], parameters.weight);
            match parameters.norm {
                None => entry("bias", vec![out], parameters.bias),
                Some(norm) => {
                    entry("norm.weight", vec![out], norm.scale);
                    entry("norm.bias", vec![out], norm.shift);
                    entry("norm.running_mean", vec![out], norm.mean);
                    entry("norm.running_var", vec![out], norm.variance);
                }
            }
        }
        entries
    }
}

/// The metadata key of Adam's step count.
const STEPS: &str = "steps";

impl Conv {
    fn parameters(&self) -> Vec<(&'static str, &Parameter)> {
        match &self.after {
            After::Bias(bias) => vec![("weight", &self.weight), ("bias", bias)],
            After::Norm(norm) => vec![
                ("weight", &self.weight),
                ("norm.weight", &norm.scale),
                ("norm.bias", &norm.shift),
            ],
        }
    }

    fn parameters_mut(&mut self) -> Vec<(&'static str, &mut Parameter)> {
        match &mut self.after {
            After::Bias(bias) => vec![("weight", &mut self.weight), ("bias", bias)],
            After::Norm(norm) => vec![
                ("weight", &mut self.weight),
                ("norm.weight", &mut norm.scale),
                ("norm.bias", &mut norm.shift),
            ],
        }
    }
}

impl Layer {
    /// The batch norm of the layer and whether it rectifies.
    fn norm(&self) -> Option<(&BatchNorm, bool)> {
        match self {
            Layer::Conv(conv) => match &conv.after {
                After::Norm(norm) => Some((norm, conv.relu)),
                After::Bias(_) => None,
            },
            _ => None,
        }
    }

    /// Takes the gradient by this layer's output back through its rectification, and adds up what batch norm's backward
    /// pass needs to know of the whole batch: per channel, the gradient and its product with the centred raw value.
    #[allow(clippy::too_many_arguments)]
    fn enter(
        &self,
        level: Level,
        n: usize,
        gradient: &mut [f32],
        value: &[f32],
        frame: &Frame,
        raw: &[f32],
        sums: &mut [f64],
    ) {
        let Layer::Conv(conv) = self else { return };
        let length = frame.w * frame.c;
        for (y, gradient) in gradient.chunks_exact_mut(length).enumerate() {
            if conv.relu {
                elementwise::mask(level, gradient, frame.pixels(value, y));
            }
            if let After::Norm(norm) = &conv.after {
                let raw = &raw[(n * frame.h + y) * length..][..length];
                elementwise::norm_sums(level, gradient, raw, &norm.mean, sums);
            }
        }
    }
}

/// What batch norm's backward pass knows of the whole batch:
/// `gradient of raw = factor * (gradient - mean - slope * (raw - mean of raw))`.
pub(crate) struct NormGradient {
    pub factor: Vec<f32>,
    pub mean: Vec<f32>,
    pub slope: Vec<f32>,
}

impl BatchNorm {
    /// Normalises a picture.
    fn apply(&self, level: Level, relu: bool, raw: &[f32], value: &mut [f32], frame: &Frame) {
        let mut factor = self.scale.value.clone();
        let mut offset = self.shift.value.clone();
        for c in 0..factor.len() {
            factor[c] *= self.inverse_deviation[c];
            offset[c] -= factor[c] * self.mean[c];
        }
        let length = frame.w * frame.c;
        for (y, raw) in raw.chunks_exact(length).take(frame.h).enumerate() {
            let out = frame.pixels_mut(value, y);
            elementwise::scale_shift(level, raw, &factor, &offset, relu, out);
        }
    }

    /// Takes the statistics of a batch from the sums of its pictures (per channel: sum, sum of squares).
    fn gather(&mut self, sums: &[f64], count: usize) {
        let channels = self.mean.len();
        let total = total(sums, 2 * channels);
        let count = count as f64;
        for c in 0..channels {
            let mean = total[c] / count;
            let variance = (total[channels + c] / count - mean * mean).max(0.0);
            self.mean[c] = mean as f32;
            self.inverse_deviation[c] = (1.0 / (variance + f64::from(NORM_EPSILON)).sqrt()) as f32;
            // The running variance is that of the population, as elsewhere.
            let unbiased = variance * count / (count - 1.0).max(1.0);
            self.running_mean[c] += MOMENTUM * (mean as f32 - self.running_mean[c]);
            self.running_variance[c] += MOMENTUM * (unbiased as f32 - self.running_variance[c]);
        }
    }

    /// Adds the gradients of scale and shift, and returns what the gradient of the raw values needs.
    fn gather_gradients(&mut self, sums: &[f64], count: f64) -> NormGradient {
        let channels = self.mean.len();
        let total = total(sums, 2 * channels);
        let mut result = NormGradient {
            factor: vec![0.0; channels],
            mean: vec![0.0; channels],
            slope: vec![0.0; channels],
        };
        for c in 0..channels {
            let inverse = f64::from(self.inverse_deviation[c]);
            let (gradient, product) = (total[c], total[channels + c]);
            self.shift.gradient[c] += gradient as f32;
            self.scale.gradient[c] += (product * inverse) as f32;
            result.factor[c] = self.scale.value[c] * self.inverse_deviation[c];
            result.mean[c] = (gradient / count) as f32;
            result.slope[c] = (product * inverse * inverse / count) as f32;
        }
        result
    }
}

/// The sum of the chunks of `sums`, first to last.
fn total(sums: &[f64], length: usize) -> Vec<f64> {
    let mut total = vec![0.0; length];
    for part in sums.chunks_exact(length) {
        for (total, part) in total.iter_mut().zip(part) {
            *total += part;
        }
    }
    total
}

fn add(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}

fn frame_row(frame: &Frame, picture: &mut [f32], y: usize) -> *mut f32 {
    frame.pixels_mut(picture, y).as_mut_ptr()
}

#[allow(clippy::too_many_arguments)]
fn conv_row(
    level: Level,
    geometry: &Geometry,
    weights: &[f32],
    y: usize,
    from: &Frame,
    input: &[f32],
    out: *mut f32,
    to: &Frame,
    start: Start,
    relu: bool,
) {
    debug_assert!(input.len() >= from.picture() && from.pad == geometry.padding());
    let row = |y| input[from.pixel(y)..].as_ptr();
    // SAFETY: the input is padded as the geometry asks for, `out` is a row of `to.w` pixels of another buffer, and
    // `start` has a value for each of its channels.
    unsafe { geometry.row(level, weights, y, from.h, row, out, to.w, start, relu) }
}

/// Weights for the gradient by the input: `[ky][kx][output][input]`, both kernel axes reversed.
fn flip(geometry: &Geometry, weights: &[f32]) -> Vec<f32> {
    let (inputs, outputs) = (geometry.inputs, geometry.outputs);
    let mut flipped = vec![0.0; weights.len()];
    let taps = weights.chunks_exact(inputs * outputs);
    for (tap, to) in taps.rev().zip(flipped.chunks_exact_mut(inputs * outputs)) {
        for i in 0..inputs {
            for o in 0..outputs {
                to[o * inputs + i] = tap[i * outputs + o];
            }
        }
    }
    flipped
}

/// Adds the gradient by the packed weights of one picture.
fn weight_gradient(
    level: Level,
    geometry: &Geometry,
    from: &Frame,
    input: &[f32],
    dense: &Frame,
    gradient: &[f32],
    weights: &mut [f32],
) {
    let (runs, rows) = geometry.runs();
    let pad = geometry.padding();
    let mut segments = Vec::with_capacity(dense.h);
    for ky in 0..geometry.kernel {
        for run in 0..runs {
            segments.clear();
            for y in 0..dense.h {
                // Row of the padded input; its borders are zero and add nothing.
                let row = y * geometry.stride + ky * geometry.dilation;
                if row >= pad && row < from.h + pad {
                    let start = row * from.row() + run * geometry.dilation * from.c;
                    segments.push(Segment {
                        scalar: input[start..].as_ptr(),
                        vector: gradient[dense.pixel(y)..].as_ptr(),
                    });
                }
            }
            let out = &mut weights[(ky * runs + run) * rows * geometry.outputs..][..rows * geometry.outputs];
            let product = Product {
                segments: &segments,
                length: dense.w,
                scalar_pixel: 1,
                scalar_step: geometry.stride * from.c,
                vector_step: dense.c,
                out: out.as_mut_ptr(),
                out_pixel: geometry.outputs,
                pixels: rows,
                channels: geometry.outputs,
                start: Start::Output,
                relu: false,
            };
            // SAFETY: input rows are padded, so that step `dense.w - 1` plus the run of taps ends inside the row.
            unsafe { product.run(level) }
        }
    }
}

/// The gradient of one picture by the input of the convolution.
fn input_gradient(
    level: Level,
    geometry: &Geometry,
    flipped: &[f32],
    dense: &Frame,
    gradient: &[f32],
    to: &Frame,
    out: &mut [f32],
) {
    if geometry.stride == 1 {
        let backward = Geometry {
            inputs: geometry.outputs,
            outputs: geometry.inputs,
            ..*geometry
        };
        for y in 0..to.h {
            let row = frame_row(to, out, y);
            conv_row(
                level,
                &backward,
                flipped,
                y,
                dense,
                gradient,
                row,
                to,
                Start::Zero,
                false,
            );
        }
        return;
    }
    // Stride 2: every other pixel of a row takes part in the same taps; a row is two rows of half the pixels.
    let (kernel, pad) = (geometry.kernel, geometry.padding());
    let tap = geometry.inputs * geometry.outputs;
    let nothing = Segment {
        scalar: std::ptr::null(),
        vector: std::ptr::null(),
    };
    for y in 0..to.h {
        for x in 0..2.min(to.w) {
            let mut segments = [nothing; MAX_TAPS];
            let mut count = 0;
            for ky in (0..kernel).filter(|ky| (y + pad + ky).is_multiple_of(2)) {
                for kx in (0..kernel).filter(|kx| (x + pad + kx).is_multiple_of(2)) {
                    // y = 2 * row + ky - pad, and rows of the gradient are padded.
                    let row = (y + 2 * pad - ky + pad) / 2;
                    let column = (x + 2 * pad - kx + pad) / 2;
                    segments[count] = Segment {
                        scalar: gradient[row * dense.row() + column * dense.c..].as_ptr(),
                        vector: flipped[(kernel * kernel - 1 - ky * kernel - kx) * tap..].as_ptr(),
                    };
                    count += 1;
                }
            }
            let product = Product {
                segments: &segments[..count],
                length: geometry.outputs,
                scalar_pixel: dense.c,
                scalar_step: 1,
                vector_step: geometry.inputs,
                out: out[to.pixel(y) + x * to.c..].as_mut_ptr(),
                out_pixel: 2 * to.c,
                pixels: (to.w - x).div_ceil(2),
                channels: geometry.inputs,
                start: Start::Zero,
                relu: false,
            };
            // SAFETY: rows and columns run from 0 to at most padding beyond the gradient's last, which is padded.
            unsafe { product.run(level) }
        }
    }
}

fn max_pool(from: &Frame, input: &[f32], to: &Frame, output: &mut [f32]) {
    for y in 0..to.h {
        let above = from.pixels(input, 2 * y);
        let below = from.pixels(input, (2 * y + 1).min(from.h - 1));
        let out = to.pixels_mut(output, y);
        for x in 0..to.w {
            let (left, right) = (2 * x * from.c, (2 * x + 1).min(from.w - 1) * from.c);
            for c in 0..from.c {
                let a = above[left + c].max(above[right + c]);
                let b = below[left + c].max(below[right + c]);
                out[x * to.c + c] = a.max(b);
            }
        }
    }
}

/// The gradient goes to the first of the highest.
fn max_pool_backward(from: &Frame, input: &[f32], to: &Frame, gradient: &[f32], before: &mut [f32]) {
    for y in 0..to.h {
        for x in 0..to.w {
            for c in 0..from.c {
                let mut best = (f32::NEG_INFINITY, 0);
                for (dy, dx) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    let (y, x) = (2 * y + dy, 2 * x + dx);
                    if y < from.h && x < from.w {
                        let value = input[from.pixel(y) + x * from.c + c];
                        if value > best.0 {
                            best = (value, (y * from.w + x) * from.c + c);
                        }
                    }
                }
                before[best.1] += gradient[(y * to.w + x) * to.c + c];
            }
        }
    }
}

fn upsample(from: &Frame, input: &[f32], to: &Frame, output: &mut [f32]) {
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    for y in 0..to.h {
        let (above, below, down) = upsample_taps(y, from.h);
        let (above, below) = (from.pixels(input, above), from.pixels(input, below));
        let out = to.pixels_mut(output, y);
        for x in 0..to.w {
            let (left, right, across) = upsample_taps(x, from.w);
            let (left, right) = (left * from.c, right * from.c);
            for c in 0..from.c {
                let a = mix(above[left + c], above[right + c], across);
                let b = mix(below[left + c], below[right + c], across);
                out[x * to.c + c] = mix(a, b, down);
            }
        }
    }
}

fn upsample_backward(from: &Frame, to: &Frame, gradient: &[f32], before: &mut [f32]) {
    for y in 0..to.h {
        let (above, below, down) = upsample_taps(y, from.h);
        for x in 0..to.w {
            let (left, right, across) = upsample_taps(x, from.w);
            for (row, down) in [(above, 1.0 - down), (below, down)] {
                for (column, across) in [(left, 1.0 - across), (right, across)] {
                    let weight = down * across;
                    for c in 0..from.c {
                        before[(row * from.w + column) * from.c + c] += weight * gradient[(y * to.w + x) * to.c + c];
                    }
                }
            }
        }
    }
}
