//! The architecture of a network, and what follows from it.

use serde::{Deserialize, Serialize};

use crate::NnError;

/// A sequential fully convolutional network over NHWC float tensors.
///
/// Every layer pads with zeros so that its output has `ceil(input / stride)` pixels a side
/// (`2 * input` for [`LayerSpec::Upsample2`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spec {
    /// Channels of the input picture.
    pub input_channels: usize,
    /// The layers, first to last.
    pub layers: Vec<LayerSpec>,
}

/// One layer of a [`Spec`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum LayerSpec {
    /// Convolution, then batch normalisation, then rectification, the last two as asked for.
    ///
    /// It pads `dilation * (kernel - 1) / 2` zeros on each side, so output pixel `i` is centred on
    /// input pixel `stride * i`.
    Conv {
        /// Side of the kernel: 1, 3 or 5.
        kernel: usize,
        /// Step between outputs: 1 or 2.
        stride: usize,
        /// Step between taps: 1, 2 or 4; other than 1 only with stride 1.
        dilation: usize,
        /// Output channels.
        out: usize,
        /// Normalise over the batch (a convolution so followed has no bias of its own).
        batch_norm: bool,
        /// Clamp below at zero.
        relu: bool,
    },
    /// Maximum over 2x2 pixels; at an odd border, over those that exist.
    MaxPool2,
    /// Bilinear, twice the size, borders repeated (pixel areas aligned).
    Upsample2,
}

/// Batch normalisation adds this to the variance.
pub(crate) const NORM_EPSILON: f32 = 1e-5;

impl Spec {
    /// Input pixels per output pixel, at least 1.
    pub fn stride(&self) -> usize {
        (self.pixel_map().0.round() as usize).max(1)
    }

    /// Where the output pixels lie in the input: pixel `i` of the output is centred on `scale * i + offset`.
    pub fn pixel_map(&self) -> (f64, f64) {
        self.layers
            .iter()
            .fold((1.0, 0.0), |(scale, offset), layer| match layer {
                LayerSpec::Conv { stride, .. } => (scale * *stride as f64, offset),
                LayerSpec::MaxPool2 => (scale * 2.0, offset + scale * 0.5),
                LayerSpec::Upsample2 => (scale * 0.5, offset - scale * 0.25),
            })
    }

    /// Side of the square of input pixels that one output pixel depends on.
    pub fn receptive_field(&self) -> usize {
        self.layers.iter().rev().fold(1, |field, layer| match layer {
            LayerSpec::Conv {
                kernel,
                stride,
                dilation,
                ..
            } => (field - 1) * stride + dilation * (kernel - 1) + 1,
            LayerSpec::MaxPool2 => field * 2,
            LayerSpec::Upsample2 => field / 2 + 2,
        })
    }

    /// Channels of the output.
    pub fn output_channels(&self) -> usize {
        self.channels().last().copied().unwrap_or(0)
    }

    /// Learnt parameters: weights, biases, scales and shifts.
    pub fn parameters(&self) -> usize {
        let channels = self.channels();
        self.layers
            .iter()
            .zip(&channels)
            .map(|(layer, &inputs)| match layer {
                LayerSpec::Conv {
                    kernel,
                    out,
                    batch_norm,
                    ..
                } => kernel * kernel * inputs * out + out * if *batch_norm { 2 } else { 1 },
                _ => 0,
            })
            .sum()
    }

    /// Floating-point operations of the convolutions for one picture of `h` by `w` pixels
    /// (a multiplication and an addition count as two).
    pub fn flops(&self, h: usize, w: usize) -> u64 {
        let channels = self.channels();
        let (mut h, mut w, mut flops) = (h, w, 0);
        for (layer, &inputs) in self.layers.iter().zip(&channels) {
            (h, w) = (layer.output_size(h), layer.output_size(w));
            if let LayerSpec::Conv { kernel, out, .. } = layer {
                flops += (2 * kernel * kernel * inputs * out * h * w) as u64;
            }
        }
        flops
    }

    /// Height and width of the output for an input of `h` by `w` pixels.
    pub fn output_size(&self, h: usize, w: usize) -> (usize, usize) {
        self.layers
            .iter()
            .fold((h, w), |(h, w), layer| (layer.output_size(h), layer.output_size(w)))
    }

    /// Checks that the kernels can run this network.
    ///
    /// # Errors
    /// [`NnError::Spec`] names the layer and what is wrong with it.
    pub fn check(&self) -> Result<(), NnError> {
        let wrong = |layer: usize, reason: String| Err(NnError::Spec { layer, reason });
        if self.input_channels == 0 || self.layers.is_empty() {
            return wrong(0, "a network needs input channels and a layer".into());
        }
        for (index, layer) in self.layers.iter().enumerate() {
            if let &LayerSpec::Conv {
                kernel,
                stride,
                dilation,
                out,
                ..
            } = layer
            {
                if ![1, 3, 5].contains(&kernel) {
                    return wrong(index, format!("kernel {kernel} is not 1, 3 or 5"));
                }
                if ![1, 2].contains(&stride) {
                    return wrong(index, format!("stride {stride} is not 1 or 2"));
                }
                if ![1, 2, 4].contains(&dilation) || (stride > 1 && dilation > 1) {
                    return wrong(index, format!("dilation {dilation} is not 1, 2 or 4 (1 with stride 2)"));
                }
                if out == 0 {
                    return wrong(index, "a convolution needs output channels".into());
                }
            }
        }
        Ok(())
    }

    /// Channels before each layer, and after the last.
    pub(crate) fn channels(&self) -> Vec<usize> {
        let mut channels = vec![self.input_channels];
        for layer in &self.layers {
            let previous = channels[channels.len() - 1];
            channels.push(match layer {
                LayerSpec::Conv { out, .. } => *out,
                _ => previous,
            });
        }
        channels
    }
}

impl LayerSpec {
    /// A convolution with batch normalisation and rectification.
    pub fn conv(kernel: usize, stride: usize, dilation: usize, out: usize) -> Self {
        LayerSpec::Conv {
            kernel,
            stride,
            dilation,
            out,
            batch_norm: true,
            relu: true,
        }
    }

    /// A last layer: the same weighted sums at every pixel, with a bias, as they are.
    pub fn output(out: usize) -> Self {
        LayerSpec::Conv {
            kernel: 1,
            stride: 1,
            dilation: 1,
            out,
            batch_norm: false,
            relu: false,
        }
    }

    /// Output pixels along a side with `size` input pixels.
    pub(crate) fn output_size(&self, size: usize) -> usize {
        match self {
            LayerSpec::Conv { stride, .. } => size.div_ceil(*stride),
            LayerSpec::MaxPool2 => size.div_ceil(2),
            LayerSpec::Upsample2 => size * 2,
        }
    }

    /// Zeros that the layer needs around its input.
    pub(crate) fn padding(&self) -> usize {
        match self {
            LayerSpec::Conv { kernel, dilation, .. } => dilation * (kernel - 1) / 2,
            _ => 0,
        }
    }

    /// Input rows (first, last; both included, inside a picture of `size` rows) that output row `y` needs.
    pub(crate) fn input_rows(&self, y: usize, size: usize) -> (usize, usize) {
        let last = size - 1;
        match self {
            LayerSpec::Conv { stride, .. } => {
                let pad = self.padding();
                let centre = y * stride;
                (centre.saturating_sub(pad), (centre + pad).min(last))
            }
            LayerSpec::MaxPool2 => (2 * y, (2 * y + 1).min(last)),
            LayerSpec::Upsample2 => {
                let (a, b, _) = upsample_taps(y, size);
                (a, b)
            }
        }
    }
}

/// The two input pixels between which output pixel `i` of a bilinear x2 lies, and the weight of the second.
pub(crate) fn upsample_taps(i: usize, size: usize) -> (usize, usize, f32) {
    let near = i / 2;
    if i.is_multiple_of(2) {
        (near.saturating_sub(1), near, 0.75)
    } else {
        (near, (near + 1).min(size - 1), 0.25)
    }
}
