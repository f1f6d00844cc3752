//! Passes over the pixels of a row, channel by channel, compiled for each level of instructions.

use crate::kernel::Level;
use crate::train::NormGradient;

/// Compiles a function for each level and picks at run time. Rust contracts no products into fused ones,
/// so all give the same bits.
macro_rules! dispatched {
    ($(#[$doc:meta])* fn $name:ident($($arg:ident: $type:ty),* $(,)?) $body:block) => {
        $(#[$doc])*
        pub(crate) fn $name(level: Level, $($arg: $type),*) {
            #[inline(always)]
            fn portable($($arg: $type),*) $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            fn avx2($($arg: $type),*) {
                portable($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512vl,avx2")]
            fn avx512($($arg: $type),*) {
                portable($($arg),*)
            }
            match level {
                Level::Portable => portable($($arg),*),
                // SAFETY: a level is only made where the processor has it.
                #[cfg(target_arch = "x86_64")]
                Level::Avx2 => unsafe { avx2($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                Level::Avx512 => unsafe { avx512($($arg),*) },
            }
        }
    };
}

dispatched! {
    /// Adds sum and sum of squares of each channel to the halves of `sums`.
    fn moments(row: &[f32], sums: &mut [f64]) {
        let (sum, square) = sums.split_at_mut(sums.len() / 2);
        let channels = sum.len();
        for block in (0..channels).step_by(8) {
            let (mut s, mut q) = ([0.0f32; 8], [0.0f32; 8]);
            for pixel in row.chunks_exact(channels) {
                for (c, value) in pixel[block..block + 8].iter().enumerate() {
                    s[c] += value;
                    q[c] += value * value;
                }
            }
            for c in 0..8 {
                sum[block + c] += f64::from(s[c]);
                square[block + c] += f64::from(q[c]);
            }
        }
    }
}

dispatched! {
    /// `out = row * factor + offset`, clamped below at zero if `relu`.
    fn scale_shift(row: &[f32], factor: &[f32], offset: &[f32], relu: bool, out: &mut [f32]) {
        let least = if relu { 0.0 } else { f32::NEG_INFINITY };
        let channels = factor.len();
        let offset = &offset[..channels];
        for (from, to) in row.chunks_exact(channels).zip(out.chunks_exact_mut(channels)) {
            for c in 0..channels {
                to[c] = (from[c] * factor[c] + offset[c]).max(least);
            }
        }
    }
}

dispatched! {
    /// Zeroes the gradient where the rectified value is zero.
    fn mask(gradient: &mut [f32], value: &[f32]) {
        for (gradient, &value) in gradient.iter_mut().zip(value) {
            *gradient = if value > 0.0 { *gradient } else { 0.0 };
        }
    }
}

dispatched! {
    /// Adds, for each channel, the gradient and its product with the centred raw value to the halves of `sums`.
    fn norm_sums(gradient: &[f32], raw: &[f32], mean: &[f32], sums: &mut [f64]) {
        let (sum, product) = sums.split_at_mut(sums.len() / 2);
        let channels = sum.len();
        for block in (0..channels).step_by(8) {
            let (mut s, mut p) = ([0.0f32; 8], [0.0f32; 8]);
            let mean = &mean[block..block + 8];
            for (gradient, raw) in gradient.chunks_exact(channels).zip(raw.chunks_exact(channels)) {
                let (gradient, raw) = (&gradient[block..block + 8], &raw[block..block + 8]);
                for c in 0..8 {
                    s[c] += gradient[c];
                    p[c] += gradient[c] * (raw[c] - mean[c]);
                }
            }
            for c in 0..8 {
                sum[block + c] += f64::from(s[c]);
                product[block + c] += f64::from(p[c]);
            }
        }
    }
}

dispatched! {
    /// The gradient by the raw values of a batch-normalised row.
    fn norm_backward(gradient: &[f32], raw: &[f32], mean: &[f32], batch: &NormGradient, out: &mut [f32]) {
        let channels = mean.len();
        let (factor, slope) = (&batch.factor[..channels], &batch.slope[..channels]);
        let gradient_mean = &batch.mean[..channels];
        let pixels = gradient.chunks_exact(channels).zip(raw.chunks_exact(channels));
        for ((gradient, raw), out) in pixels.zip(out.chunks_exact_mut(channels)) {
            for c in 0..channels {
                let centred = raw[c] - mean[c];
                out[c] = factor[c] * (gradient[c] - gradient_mean[c] - slope[c] * centred);
            }
        }
    }
}

dispatched! {
    /// Adds the pixels of a row.
    fn add_pixels(row: &[f32], sums: &mut [f32]) {
        for pixel in row.chunks_exact(sums.len()) {
            for (sum, value) in sums.iter_mut().zip(pixel) {
                *sum += value;
            }
        }
    }
}
