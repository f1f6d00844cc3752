//! One convolution over padded rows: geometry, packed weights, forward row.

use crate::kernel::{Level, Product, Segment, Start, padded};

/// The largest number of taps of a kernel.
pub(crate) const MAX_TAPS: usize = 25;

/// A convolution's shape, channels as stored.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geometry {
    pub kernel: usize,
    pub stride: usize,
    pub dilation: usize,
    /// Floats in a pixel of the input: the true channels for a picture, whole vectors after a layer.
    pub inputs: usize,
    /// Floats in a pixel of the output: whole vectors.
    pub outputs: usize,
}

impl Geometry {
    /// Zeros on each side of the input.
    pub(crate) fn padding(&self) -> usize {
        self.dilation * (self.kernel - 1) / 2
    }

    /// Floats of the packed weights, `[ky][kx][input][output]`.
    pub(crate) fn weights(&self) -> usize {
        self.kernel * self.kernel * self.inputs * self.outputs
    }

    /// Neighbouring taps of a row lie next to each other in memory: they are one run of steps.
    /// Returns runs in a row of taps and steps in each.
    pub(crate) fn runs(&self) -> (usize, usize) {
        if self.dilation == 1 {
            (1, self.kernel * self.inputs)
        } else {
            (self.kernel, self.inputs)
        }
    }

    /// Computes a row of outputs.
    ///
    /// # Safety
    /// `row(y)` points to pixel 0 of input row `y`, for each `y < height` that output row `y_out` needs, with
    /// `padding` readable pixels before and after those of the picture; `weights` is packed and `start`, `out`
    /// have the room; the processor has `level`.
    #[allow(clippy::too_many_arguments)]
    pub(crate) unsafe fn row(
        &self,
        level: Level,
        weights: &[f32],
        y_out: usize,
        height: usize,
        row: impl Fn(usize) -> *const f32,
        out: *mut f32,
        pixels: usize,
        start: Start,
        relu: bool,
    ) {
        debug_assert_eq!(weights.len(), self.weights());
        let nothing = Segment {
            scalar: std::ptr::null(),
            vector: std::ptr::null(),
        };
        let mut segments = [nothing; MAX_TAPS];
        let mut count = 0;
        let (runs, length) = self.runs();
        let pad = self.padding() as isize;
        for ky in 0..self.kernel {
            let y = (y_out * self.stride + ky * self.dilation) as isize - pad;
            if y < 0 || y >= height as isize {
                continue; // zeros
            }
            let first = row(y as usize);
            for run in 0..runs {
                let x = (run * self.dilation) as isize - pad;
                segments[count] = Segment {
                    scalar: first.wrapping_offset(x * self.inputs as isize),
                    vector: weights[(ky * runs + run) * length * self.outputs..].as_ptr(),
                };
                count += 1;
            }
        }
        let product = Product {
            segments: &segments[..count],
            length,
            scalar_pixel: self.stride * self.inputs,
            scalar_step: 1,
            vector_step: self.outputs,
            out,
            out_pixel: self.outputs,
            pixels,
            channels: self.outputs,
            start,
            relu,
        };
        unsafe { product.run(level) }
    }
}

/// Packs weights from `[out][in][ky][kx]` (as in files) to `[ky][kx][input][output]`, filled up with zeros.
pub(crate) fn pack(geometry: &Geometry, inputs: usize, outputs: usize, weights: &[f32]) -> Vec<f32> {
    let mut packed = vec![0.0; geometry.weights()];
    for_each_weight(geometry, inputs, outputs, |file, pack| packed[pack] = weights[file]);
    packed
}

/// The inverse of [`pack`].
pub(crate) fn unpack(geometry: &Geometry, inputs: usize, outputs: usize, packed: &[f32]) -> Vec<f32> {
    let mut weights = vec![0.0; outputs * inputs * geometry.kernel * geometry.kernel];
    for_each_weight(geometry, inputs, outputs, |file, pack| weights[file] = packed[pack]);
    weights
}

fn for_each_weight(geometry: &Geometry, inputs: usize, outputs: usize, mut each: impl FnMut(usize, usize)) {
    let taps = geometry.kernel * geometry.kernel;
    for tap in 0..taps {
        for i in 0..inputs {
            for o in 0..outputs {
                each(
                    (o * inputs + i) * taps + tap,
                    (tap * geometry.inputs + i) * geometry.outputs + o,
                );
            }
        }
    }
}

/// Channels as stored before each layer and after the last: the picture as it is, all others in whole vectors.
pub(crate) fn stored_channels(channels: &[usize]) -> Vec<usize> {
    // Pooling and upsampling work on whole vectors too, so their input is only unpadded where it is the picture.
    let mut stored: Vec<usize> = channels.iter().map(|&c| padded(c)).collect();
    stored[0] = channels[0];
    stored
}
