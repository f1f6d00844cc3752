//! Inference: batch norm folded into the convolutions, rows streamed through the layers.
//!
//! A layer keeps only as many rows of its output as the next one needs (a ring), so a 12-megapixel picture
//! passes through a few megabytes that stay in the cache. A picture is cut into strips of output rows, one task each.

use std::cell::Cell;
use std::path::Path;

use rayon::prelude::*;

use crate::conv::{Geometry, pack, stored_channels};
use crate::eight::{Eight, REACH, Step};
use crate::file::{Reader, read};
use crate::kernel::{Level, Start};
use crate::kernel8::Level8;
use crate::spec::{NORM_EPSILON, upsample_taps};
use crate::{LayerSpec, NnError, RowSource, Spec, Tensor};

/// A network for inference: batch norm folded, weights packed for the best instructions of this processor.
#[derive(Clone, Debug)]
pub struct Network {
    spec: Spec,
    layers: Vec<Layer>,
    /// Floats in a stored pixel before each layer and after the last.
    stored: Vec<usize>,
    level: Level,
    /// What is run instead, where asked for.
    eight: Option<Eight>,
}

#[derive(Clone, Debug)]
pub(crate) enum Layer {
    Conv {
        geometry: Geometry,
        weights: Vec<f32>,
        bias: Vec<f32>,
        relu: bool,
        /// How far each output channel reaches, where its normalisation tells.
        highest: Option<Vec<f32>>,
    },
    MaxPool2,
    Upsample2,
}

/// The parameters of one convolution as in files: weights `[out][in][ky][kx]`.
pub(crate) struct ConvParameters {
    pub weight: Vec<f32>,
    /// Empty with batch norm.
    pub bias: Vec<f32>,
    /// Empty without.
    pub norm: Option<Norm>,
}

/// Batch normalisation of one layer, a value a channel.
pub(crate) struct Norm {
    pub scale: Vec<f32>,
    pub shift: Vec<f32>,
    pub mean: Vec<f32>,
    pub variance: Vec<f32>,
}

impl Network {
    /// The architecture.
    pub fn spec(&self) -> &Spec {
        &self.spec
    }

    pub(crate) fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Reads a network from a file that [`Trainer::save`](crate::Trainer::save) wrote.
    ///
    /// # Errors
    /// An [`NnError`] that says what is wrong with the file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, NnError> {
        Self::from_bytes(&read(path.as_ref())?)
    }

    /// Reads a network from the bytes of such a file.
    ///
    /// # Errors
    /// An [`NnError`] that says what is wrong with them.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, NnError> {
        let reader = Reader::new(bytes)?;
        let parameters = read_parameters(&reader)?;
        Ok(Self::new(reader.spec, &parameters, Level::detect()))
    }

    /// Folds and packs; `parameters` has an entry for each convolution, with lengths as the spec says.
    pub(crate) fn new(spec: Spec, parameters: &[ConvParameters], level: Level) -> Self {
        let channels = spec.channels();
        let stored = stored_channels(&channels);
        let mut parameters = parameters.iter();
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
                    let parameters = parameters.next().unwrap_or_else(|| unreachable!());
                    let (weight, mut bias) = parameters.folded();
                    bias.resize(geometry.outputs, 0.0);
                    let reach = |norm: &Norm| {
                        let channels = norm.scale.iter().zip(&norm.shift);
                        channels.map(|(scale, shift)| shift + REACH * scale.abs()).collect()
                    };
                    Layer::Conv {
                        geometry,
                        weights: pack(&geometry, channels[index], out, &weight),
                        bias,
                        relu,
                        highest: parameters.norm.as_ref().map(reach),
                    }
                }
            });
        }
        Self {
            spec,
            layers,
            stored,
            level,
            eight: None,
        }
    }

    /// The same network run in eight bits from now on, several times as fast where the processor has instructions for it; `input` says
    /// what a byte of each input channel means. The outputs differ a little from those of floats, and are the same to the bit on every
    /// processor. A network that cannot (one that is no chain of normalised convolutions) stays as it is.
    #[must_use]
    pub fn in_eight_bits(mut self, input: &[Step]) -> Self {
        self.eight = Eight::new(&self, input, Level8::detect());
        self
    }

    /// True if it runs in eight bits.
    pub fn has_eight_bits(&self) -> bool {
        self.eight.is_some()
    }

    /// The output for a whole picture (n = 1), in strips of rows on the rayon pool.
    ///
    /// The result does not depend on the strips, to the bit.
    ///
    /// # Panics
    /// Where the source does not have the network's input channels, or no pixels.
    pub fn forward(&self, source: &dyn RowSource) -> Tensor {
        let (h, w) = self.spec.output_size(source.height(), source.width());
        // Each strip computes the rows around it again: few strips, but enough to even out the load.
        let halo = self.spec.receptive_field() / self.spec.stride() + 1;
        let strips = (2 * rayon::current_num_threads()).min(h / halo).max(1);
        if let Some(eight) = &self.eight {
            self.check_input(source.height(), source.width(), source.channels());
            return eight.forward(source, strips);
        }
        self.forward_strips(source, h.div_ceil(strips), h, w)
    }

    pub(crate) fn forward_strips(&self, source: &dyn RowSource, rows: usize, h: usize, w: usize) -> Tensor {
        self.check_input(source.height(), source.width(), source.channels());
        let mut output = Tensor::zeros(1, h, w, self.spec.output_channels());
        output
            .data
            .par_chunks_mut(rows * w * output.c)
            .enumerate()
            .for_each(|(strip, out)| self.strip(source, strip * rows, out));
        output
    }

    /// The outputs for many small pictures of the same size, parallel over pictures.
    ///
    /// # Panics
    /// Where the batch does not have the network's input channels, or no pixels.
    pub fn forward_batch(&self, batch: &Tensor) -> Tensor {
        batch.assert_shape();
        if batch.n > 0 {
            self.check_input(batch.h, batch.w, batch.c);
        }
        if let Some(eight) = self.eight.as_ref().filter(|_| batch.n > 0) {
            return eight.forward_batch(batch.n, batch.h, batch.w, |n| Picture { batch, n });
        }
        let (h, w) = self.spec.output_size(batch.h, batch.w);
        let mut output = Tensor::zeros(batch.n, h, w, self.spec.output_channels());
        if batch.n == 0 {
            return output;
        }
        output
            .data
            .par_chunks_mut(h * w * output.c)
            .enumerate()
            .for_each(|(n, out)| self.strip(&Picture { batch, n }, 0, out));
        output
    }

    fn check_input(&self, h: usize, w: usize, c: usize) {
        assert!(h > 0 && w > 0, "a picture needs pixels, this one has {h} x {w}");
        assert_eq!(
            c, self.spec.input_channels,
            "the picture's channels must be the network's input channels"
        );
    }

    /// Computes output rows from `y0` on into `out`, as many as fit.
    fn strip(&self, source: &dyn RowSource, y0: usize, out: &mut [f32]) {
        thread_local! {
            static SCRATCH: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
        }
        let mut plan = Plan::new(&self.spec.layers, &self.stored, source.height(), source.width());
        // Taken, not borrowed: a source that uses rayon itself may start another strip on this thread.
        let mut scratch = SCRATCH.take();
        scratch.clear();
        scratch.resize(plan.values, 0.0);
        plan.start(&self.spec.layers, y0);
        let channels = self.spec.output_channels();
        let last = plan.rings.len() - 1;
        let (width, stored) = (plan.rings[last].width, self.stored[last]);
        for (i, row) in out.chunks_exact_mut(width * channels).enumerate() {
            plan.need(self, source, &mut scratch, last, y0 + i);
            let pixels = &scratch[plan.rings[last].pixel(y0 + i)..][..width * stored];
            for (to, from) in row.chunks_exact_mut(channels).zip(pixels.chunks_exact(stored)) {
                to.copy_from_slice(&from[..channels]);
            }
        }
        SCRATCH.set(scratch);
    }
}

/// One picture of a batch.
struct Picture<'a> {
    batch: &'a Tensor,
    n: usize,
}

impl RowSource for Picture<'_> {
    fn height(&self) -> usize {
        self.batch.h
    }

    fn width(&self) -> usize {
        self.batch.w
    }

    fn channels(&self) -> usize {
        self.batch.c
    }

    fn row(&self, y: usize, out: &mut [f32]) {
        let start = self.batch.index(self.n, y, 0);
        out.copy_from_slice(&self.batch.data[start..start + self.batch.w * self.batch.c]);
    }
}

/// The last rows of one layer's output (ring 0: of the picture), zero pixels left and right.
pub(crate) struct Ring {
    /// Of the whole picture at this layer.
    pub height: usize,
    pub width: usize,
    /// Where the ring begins in the scratch memory.
    start: usize,
    /// Rows it holds.
    pub rows: usize,
    /// Values in a row.
    pub row: usize,
    /// Values left of pixel 0.
    pub left: usize,
    /// The next row to compute.
    pub next: usize,
}

impl Ring {
    /// Where pixel 0 of row `y` lies in the scratch memory.
    pub(crate) fn pixel(&self, y: usize) -> usize {
        self.start + (y % self.rows) * self.row + self.left
    }
}

/// The rings of one pass.
pub(crate) struct Plan {
    pub rings: Vec<Ring>,
    /// Values in all of them.
    pub values: usize,
}

impl Plan {
    /// `stored`: values in a stored pixel before each layer and after the last.
    pub(crate) fn new(layers: &[LayerSpec], stored: &[usize], h: usize, w: usize) -> Self {
        let mut rings = Vec::with_capacity(layers.len() + 1);
        let (mut height, mut width, mut values) = (h, w, 0);
        for (index, &stored) in stored.iter().enumerate() {
            let next = layers.get(index);
            let pad = next.map_or(0, LayerSpec::padding);
            let rows = match next {
                Some(LayerSpec::Conv { .. }) => 2 * pad + 1,
                Some(_) => 2,
                None => 1,
            };
            let row = (width + 2 * pad) * stored;
            rings.push(Ring {
                height,
                width,
                start: values,
                rows,
                row,
                left: pad * stored,
                next: 0,
            });
            values += rows * row;
            if let Some(layer) = next {
                (height, width) = (layer.output_size(height), layer.output_size(width));
            }
        }
        Self { rings, values }
    }

    /// Prepares for output rows from `y` on: finds the first row that each layer needs.
    pub(crate) fn start(&mut self, layers: &[LayerSpec], mut y: usize) {
        for index in (0..self.rings.len()).rev() {
            self.rings[index].next = y;
            if index > 0 {
                y = layers[index - 1].input_rows(y, self.rings[index - 1].height).0;
            }
        }
    }

    /// Computes the rows of ring `index` up to `y`.
    fn need(&mut self, network: &Network, source: &dyn RowSource, scratch: &mut [f32], index: usize, y: usize) {
        while self.rings[index].next <= y {
            let row = self.rings[index].next;
            self.rings[index].next += 1;
            let to = self.rings[index].pixel(row);
            let width = self.rings[index].width;
            let stored = network.stored[index];
            if index == 0 {
                source.row(row, &mut scratch[to..to + width * stored]);
                continue;
            }
            let layer = &network.spec.layers[index - 1];
            let last = layer.input_rows(row, self.rings[index - 1].height).1;
            self.need(network, source, scratch, index - 1, last);
            let input = &self.rings[index - 1];
            match &network.layers[index - 1] {
                Layer::Conv {
                    geometry,
                    weights,
                    bias,
                    relu,
                    ..
                } => {
                    let base = scratch.as_mut_ptr();
                    // SAFETY: the ring holds the rows with the padding that the geometry asks for, and the
                    // output row lies in another ring; `new` packed weights and bias for the geometry.
                    unsafe {
                        geometry.row(
                            network.level,
                            weights,
                            row,
                            input.height,
                            |y| base.add(input.pixel(y)).cast_const(),
                            base.add(to),
                            width,
                            Start::Bias(bias.as_ptr()),
                            *relu,
                        );
                    }
                }
                Layer::MaxPool2 => {
                    let (above, below) = layer.input_rows(row, input.height);
                    let (above, below) = (input.pixel(above), input.pixel(below));
                    let step = network.stored[index - 1];
                    for x in 0..width {
                        let right = (2 * x + 1).min(input.width - 1) * step;
                        for c in 0..step {
                            let left = 2 * x * step + c;
                            let a = scratch[above + left].max(scratch[above + right + c]);
                            let b = scratch[below + left].max(scratch[below + right + c]);
                            scratch[to + x * stored + c] = a.max(b);
                        }
                    }
                }
                Layer::Upsample2 => {
                    let (above, below, down) = upsample_taps(row, input.height);
                    let (above, below) = (input.pixel(above), input.pixel(below));
                    let step = network.stored[index - 1];
                    for x in 0..width {
                        let (left, right, across) = upsample_taps(x, input.width);
                        let (left, right) = (left * step, right * step);
                        for c in 0..step {
                            let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
                            let a = mix(scratch[above + left + c], scratch[above + right + c], across);
                            let b = mix(scratch[below + left + c], scratch[below + right + c], across);
                            scratch[to + x * stored + c] = mix(a, b, down);
                        }
                    }
                }
            }
        }
    }
}

impl ConvParameters {
    /// Weights and bias with the normalisation in them.
    pub(crate) fn folded(&self) -> (Vec<f32>, Vec<f32>) {
        let mut weight = self.weight.clone();
        let Some(norm) = &self.norm else {
            return (weight, self.bias.clone());
        };
        let outputs = norm.scale.len();
        let each = weight.len() / outputs;
        let mut bias = Vec::with_capacity(outputs);
        for (o, weights) in weight.chunks_exact_mut(each).enumerate() {
            let scale = norm.scale[o] / (norm.variance[o] + NORM_EPSILON).sqrt();
            for value in weights {
                *value *= scale;
            }
            bias.push(norm.shift[o] - norm.mean[o] * scale);
        }
        (weight, bias)
    }
}

/// The parameters of every convolution of a file.
pub(crate) fn read_parameters(reader: &Reader) -> Result<Vec<ConvParameters>, NnError> {
    let channels = reader.spec.channels();
    let mut parameters = Vec::new();
    for (index, layer) in reader.spec.layers.iter().enumerate() {
        if let &LayerSpec::Conv {
            kernel,
            out,
            batch_norm,
            ..
        } = layer
        {
            let tensor = |name: &str, shape: &[usize]| reader.tensor(&format!("layers.{index}.{name}"), shape);
            let convolution = ConvParameters {
                weight: tensor("weight", &[out, channels[index], kernel, kernel])?,
                bias: if batch_norm {
                    Vec::new()
                } else {
                    tensor("bias", &[out])?
                },
                norm: if batch_norm {
                    Some(Norm {
                        scale: tensor("norm.weight", &[out])?,
                        shift: tensor("norm.bias", &[out])?,
                        mean: tensor("norm.running_mean", &[out])?,
                        variance: tensor("norm.running_var", &[out])?,
                    })
                } else {
                    None
                },
            };
            let norm = convolution.norm.iter();
            if norm.flat_map(|norm| &norm.variance).any(|&v| v < 0.0) {
                return Err(NnError::Format(format!("layer {index} has a negative variance")));
            }
            parameters.push(convolution);
        }
    }
    Ok(parameters)
}
