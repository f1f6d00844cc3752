//! A network in eight bits: activations as unsigned bytes, weights as signed ones, sums exact in 32 bits.
//!
//! Nothing has to be measured for it: batch normalisation says how far each channel reaches. A channel whose values have the mean
//! `shift` and the deviation `scale` is given the range from zero, where it is cut off, to `shift + 6 scale`; its step goes into
//! the weights of the layer after it. The last layer's sums leave as floats.

use std::cell::Cell;

use rayon::prelude::*;

use crate::kernel::padded;
use crate::kernel8::{Level8, Out8, Product8, STEP, Segment8};
use crate::network::{Layer, Plan};
use crate::spec::upsample_taps;
use crate::{LayerSpec, Network, RowSource, Tensor};

/// Deviations above the mean that a channel's range takes in.
pub(crate) const REACH: f32 = 6.0;
/// The largest weight.
const MOST: f32 = 127.0;
const MAX_TAPS: usize = 25;

/// What a byte of an input channel means: `low + byte * step`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The value of byte 0.
    pub low: f32,
    /// From one byte's value to the next one's.
    pub step: f32,
}

impl Step {
    /// 256 values from `low` to `high`.
    pub const fn between(low: f32, high: f32) -> Self {
        Self {
            low,
            step: (high - low) / 255.0,
        }
    }

    fn byte(&self, value: f32) -> u8 {
        // the cast cuts off what is outside
        ((value - self.low) / self.step + 0.5) as u8
    }
}

/// One convolution.
#[derive(Clone, Debug)]
struct Conv8 {
    kernel: usize,
    stride: usize,
    dilation: usize,
    inputs: usize,
    outputs: usize,
    /// `[ky][kx][input / 4][output][input % 4]`.
    weights: Vec<i8>,
    factor: Vec<f32>,
    offset: Vec<f32>,
}

/// The eight-bit form of a chain of convolutions, at whose end an enlargement may stand before the last one.
#[derive(Clone, Debug)]
pub(crate) struct Eight {
    input: Vec<Step>,
    /// The chain without the enlargement: sums and bilinear means can change places.
    chain: Vec<LayerSpec>,
    convs: Vec<Conv8>,
    /// Bytes in a stored pixel before each layer of the chain; then floats after the last.
    stored: Vec<usize>,
    outputs: usize,
    enlarged: bool,
    level: Level8,
}

impl Eight {
    /// `None` where the network is no such chain, or where not every layer but the last is normalised.
    pub(crate) fn new(network: &Network, input: &[Step], level: Level8) -> Option<Self> {
        let spec = network.spec();
        if input.len() != spec.input_channels {
            return None;
        }
        let channels = spec.channels();
        let mut chain = spec.layers.clone();
        let mut layers: Vec<&Layer> = network.layers().iter().collect();
        let enlarged = chain.len() >= 2 && chain[chain.len() - 2] == LayerSpec::Upsample2;
        if enlarged {
            // only weighted sums of one pixel can change places with the enlargement
            match chain[chain.len() - 1] {
                LayerSpec::Conv {
                    kernel: 1,
                    stride: 1,
                    relu: false,
                    ..
                } => {}
                _ => return None,
            }
            chain.remove(chain.len() - 2);
            layers.remove(layers.len() - 2);
        }
        let mut stored = vec![spec.input_channels.next_multiple_of(STEP)];
        let mut steps: Vec<Step> = input.to_vec();
        let mut convs = Vec::new();
        let last = chain.len() - 1;
        for (index, (spec, layer)) in chain.iter().zip(&layers).enumerate() {
            let (
                &LayerSpec::Conv {
                    kernel,
                    stride,
                    dilation,
                    out,
                    relu,
                    ..
                },
                Layer::Conv {
                    geometry,
                    weights,
                    bias,
                    highest,
                    ..
                },
            ) = (spec, layer)
            else {
                return None;
            };
            let after: Vec<f32> = if index == last {
                if relu {
                    return None;
                }
                vec![1.0; out]
            } else {
                let highest = highest.as_ref().filter(|_| relu)?;
                highest.iter().map(|h| h.max(1e-6) / 255.0).collect()
            };
            let inputs = steps.len();
            let mut conv = Conv8 {
                kernel,
                stride,
                dilation,
                inputs: stored[index],
                outputs: padded(out),
                weights: vec![0; kernel * kernel * stored[index] * padded(out)],
                factor: vec![0.0; padded(out)],
                offset: vec![0.0; padded(out)],
            };
            let weights = crate::conv::unpack(geometry, inputs, out, weights);
            let taps = kernel * kernel;
            for o in 0..out {
                let own = &weights[o * inputs * taps..][..inputs * taps];
                let in_steps = |i: usize| own[i] * steps[i / taps].step;
                let largest = (0..own.len())
                    .map(|i| in_steps(i).abs())
                    .fold(f32::MIN_POSITIVE, f32::max);
                let scale = largest / MOST;
                for i in 0..own.len() {
                    let (channel, tap) = (i / taps, i % taps);
                    let at = ((tap * conv.inputs / STEP + channel / STEP) * conv.outputs + o) * STEP + channel % STEP;
                    conv.weights[at] = (in_steps(i) / scale).round() as i8;
                }
                let low: f32 = (0..own.len()).map(|i| own[i] * steps[i / taps].low).sum();
                conv.factor[o] = scale / after[o];
                conv.offset[o] = (bias[o] + low) / after[o];
            }
            convs.push(conv);
            stored.push(padded(out));
            steps = after.iter().map(|&step| Step { low: 0.0, step }).collect();
        }
        Some(Self {
            input: input.to_vec(),
            chain,
            convs,
            stored,
            outputs: channels[channels.len() - 1],
            enlarged,
            level,
        })
    }

    /// The output for a whole picture, in strips of so many rows (before the enlargement).
    pub(crate) fn forward(&self, source: &dyn RowSource, strips: usize) -> Tensor {
        let (h, w) = self.size(source.height(), source.width());
        let mut output = Tensor::zeros(1, h, w, self.outputs);
        let rows = h.div_ceil(strips.max(1));
        let strips = output.data.par_chunks_mut(rows * w * self.outputs).enumerate();
        strips.for_each(|(strip, out)| self.strip(source, strip * rows, out));
        self.enlarge(output)
    }

    /// The outputs for a batch, whose pictures `source` gives.
    pub(crate) fn forward_batch<'a, S: RowSource + 'a>(
        &self,
        n: usize,
        h: usize,
        w: usize,
        source: impl Fn(usize) -> S + Sync,
    ) -> Tensor {
        let (h, w) = self.size(h, w);
        let mut output = Tensor::zeros(n, h, w, self.outputs);
        let pictures = output.data.par_chunks_mut(h * w * self.outputs).enumerate();
        pictures.for_each(|(n, out)| self.strip(&source(n), 0, out));
        self.enlarge(output)
    }

    fn size(&self, h: usize, w: usize) -> (usize, usize) {
        let layers = self.chain.iter();
        layers.fold((h, w), |(h, w), layer| (layer.output_size(h), layer.output_size(w)))
    }

    fn enlarge(&self, small: Tensor) -> Tensor {
        if !self.enlarged {
            return small;
        }
        let (h, w, c) = (2 * small.h, 2 * small.w, small.c);
        let mut large = Tensor::zeros(small.n, h, w, c);
        large.data.par_chunks_mut(w * c).enumerate().for_each(|(row, out)| {
            let (n, y) = (row / h, row % h);
            let (above, below, down) = upsample_taps(y, small.h);
            for x in 0..w {
                let (left, right, across) = upsample_taps(x, small.w);
                let at = |y: usize, x: usize| &small.pixel(n, y, x)[..c];
                let corners = [at(above, left), at(above, right), at(below, left), at(below, right)];
                for (i, to) in out[x * c..][..c].iter_mut().enumerate() {
                    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
                    let [a, b] = [0, 2].map(|k| mix(corners[k][i], corners[k + 1][i], across));
                    *to = mix(a, b, down);
                }
            }
        });
        large
    }

    /// Computes rows from `y0` on into `out`, as many as fit.
    fn strip(&self, source: &dyn RowSource, y0: usize, out: &mut [f32]) {
        thread_local! {
            static SCRATCH: Cell<(Vec<u8>, Vec<f32>)> = const { Cell::new((Vec::new(), Vec::new())) };
        }
        let mut plan = Plan::new(&self.chain, &self.stored, source.height(), source.width());
        plan.start(&self.chain, y0);
        // Taken, not borrowed: a source that uses rayon itself may start another strip on this thread.
        let (mut bytes, mut floats) = SCRATCH.take();
        let last = plan.rings.len() - 1;
        let width = plan.rings[last].width;
        let nothing = plan.rings[0].row;
        bytes.clear();
        bytes.resize(plan.values, 0);
        // the picture's padding is the value zero, and so is a row beyond its end, which stands after the rings
        bytes.resize(plan.values + nothing, 0);
        let zero: Vec<u8> = self.input.iter().map(|step| step.byte(0.0)).collect();
        let (rings, beyond) = bytes.split_at_mut(plan.values);
        for pixel in rings[..plan.rings[0].rows * nothing]
            .chunks_exact_mut(self.stored[0])
            .chain(beyond.chunks_exact_mut(self.stored[0]))
        {
            pixel[..zero.len()].copy_from_slice(&zero);
        }
        floats.resize((width * self.stored[last]).max(source.width() * self.input.len()), 0.0);
        for (i, row) in out.chunks_exact_mut(width * self.outputs).enumerate() {
            let y = y0 + i;
            let below = self.chain[last - 1].input_rows(y, plan.rings[last - 1].height).1;
            self.need(&mut plan, source, &mut bytes, &mut floats, last - 1, below);
            self.row(
                &plan,
                bytes.as_mut_ptr(),
                last - 1,
                y,
                width,
                Out8::Floats(floats.as_mut_ptr()),
            );
            let pixels = floats.chunks_exact(self.stored[last]);
            for (to, from) in row.chunks_exact_mut(self.outputs).zip(pixels) {
                to.copy_from_slice(&from[..self.outputs]);
            }
        }
        SCRATCH.set((bytes, floats));
    }

    /// Computes the rows of ring `index` up to `y`.
    fn need(
        &self,
        plan: &mut Plan,
        source: &dyn RowSource,
        bytes: &mut [u8],
        floats: &mut [f32],
        index: usize,
        y: usize,
    ) {
        while plan.rings[index].next <= y {
            let row = plan.rings[index].next;
            plan.rings[index].next += 1;
            let to = plan.rings[index].pixel(row);
            let width = plan.rings[index].width;
            if index == 0 {
                self.read(source, row, floats, &mut bytes[to..to + width * self.stored[0]]);
                continue;
            }
            let last = self.chain[index - 1].input_rows(row, plan.rings[index - 1].height).1;
            self.need(plan, source, bytes, floats, index - 1, last);
            let base = bytes.as_mut_ptr();
            self.row(plan, base, index - 1, row, width, Out8::Bytes(base.wrapping_add(to)));
        }
    }

    /// A row of the picture in bytes.
    fn read(&self, source: &dyn RowSource, y: usize, floats: &mut [f32], out: &mut [u8]) {
        let channels = self.input.len();
        let color = Step::between(-1.0, 1.0);
        if let Some(bytes) = source.bytes(y).filter(|_| self.input.iter().all(|step| *step == color)) {
            match (out.as_chunks_mut::<STEP>(), bytes.as_chunks::<3>()) {
                // a constant length, or else each pixel is a call
                ((to, []), (from, [])) if channels == 3 => to
                    .iter_mut()
                    .zip(from)
                    .for_each(|(to, from)| to[..3].copy_from_slice(from)),
                _ => {
                    let pixels = out.chunks_exact_mut(self.stored[0]).zip(bytes.chunks_exact(channels));
                    pixels.for_each(|(to, from)| to[..channels].copy_from_slice(from));
                }
            }
            return;
        }
        let floats = &mut floats[..source.width() * channels];
        source.row(y, floats);
        let pixels = out.chunks_exact_mut(self.stored[0]);
        for (to, from) in pixels.zip(floats.chunks_exact(channels)) {
            for ((to, &from), step) in to.iter_mut().zip(from).zip(&self.input) {
                *to = step.byte(from);
            }
        }
    }

    /// Row `y` of what convolution `index` makes of ring `index`.
    fn row(&self, plan: &Plan, bytes: *mut u8, index: usize, y: usize, pixels: usize, out: Out8) {
        let (conv, input) = (&self.convs[index], &plan.rings[index]);
        let nothing = Segment8 {
            scalar: std::ptr::null(),
            vector: std::ptr::null(),
        };
        let mut segments = [nothing; MAX_TAPS];
        let mut count = 0;
        // neighbouring taps of a row lie next to each other in memory: they are one run of steps
        let (runs, taps) = if conv.dilation == 1 {
            (1, conv.kernel)
        } else {
            (conv.kernel, 1)
        };
        let length = taps * conv.inputs / STEP;
        let pad = (conv.dilation * (conv.kernel - 1) / 2) as isize;
        for ky in 0..conv.kernel {
            let from = (y * conv.stride + ky * conv.dilation) as isize - pad;
            let first = if (0..input.height as isize).contains(&from) {
                input.pixel(from as usize)
            } else if index == 0 {
                plan.values + input.left
            } else {
                continue; // zeros
            };
            for run in 0..runs {
                let x = (run * conv.dilation) as isize - pad;
                segments[count] = Segment8 {
                    scalar: bytes.wrapping_add(first).wrapping_offset(x * conv.inputs as isize),
                    vector: conv.weights[(ky * runs + run) * length * conv.outputs * STEP..].as_ptr(),
                };
                count += 1;
            }
        }
        let product = Product8 {
            segments: &segments[..count],
            length,
            scalar_pixel: conv.stride * conv.inputs,
            factor: &conv.factor,
            offset: &conv.offset,
            out,
            pixels,
            channels: conv.outputs,
        };
        // SAFETY: the ring holds the rows, and the row beyond, with the padding that the convolution needs; the output row lies in
        // another ring or has the room; `new` packed weights, factors and offsets for this geometry.
        unsafe { product.run(self.level) }
    }
}
