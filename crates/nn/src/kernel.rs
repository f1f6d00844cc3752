//! The one inner loop: a block of sums of products, held in registers.
//!
//! A row of a convolution, its gradient by the input and its gradient by the weights are all
//! `out[p][..] = start + sum over segments s, steps k of scalar[s][p, k] * vector[s][k][..]`;
//! they differ only in where the scalars and vectors lie. Each output is summed in the same order however
//! the row is cut into blocks, so bands, batches and threads cannot change a bit of it.

use std::sync::OnceLock;

/// Vectors are processed in multiples of this many floats.
pub(crate) const LANES: usize = 8;

/// Channels of an activation as stored: rounded up to whole vectors.
pub(crate) fn padded(channels: usize) -> usize {
    channels.next_multiple_of(LANES)
}

/// Vectors of the longest piece of a sum: two thirds of the usual first cache.
const PIECE_BYTES: usize = 20 * 1024;

/// The widest instructions to use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Level {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Level {
    /// The best that this processor has.
    pub(crate) fn detect() -> Self {
        static LEVEL: OnceLock<Level> = OnceLock::new();
        *LEVEL.get_or_init(|| Self::all().pop().unwrap_or(Level::Portable))
    }

    /// All that this processor has, worst first.
    pub(crate) fn all() -> Vec<Self> {
        #[allow(unused_mut)]
        let mut levels = vec![Level::Portable];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            levels.push(Level::Avx2);
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                levels.push(Level::Avx512);
            }
        }
        levels
    }
}

/// One run of `length` steps of a [`Product`].
#[derive(Clone, Copy)]
pub(crate) struct Segment {
    /// The scalar of pixel 0, step 0.
    pub scalar: *const f32,
    /// The vector of step 0.
    pub vector: *const f32,
}

/// What the sums start from.
#[derive(Clone, Copy)]
pub(crate) enum Start {
    Zero,
    /// A vector shared by all pixels.
    Bias(*const f32),
    /// What is in the output already.
    Output,
}

/// A row of sums of products; see the module's documentation.
pub(crate) struct Product<'a> {
    pub segments: &'a [Segment],
    /// Steps in each segment.
    pub length: usize,
    /// Floats from the scalar of one pixel to the next.
    pub scalar_pixel: usize,
    /// Floats from the scalar of one step to the next.
    pub scalar_step: usize,
    /// Floats from the vector of one step to the next.
    pub vector_step: usize,
    pub out: *mut f32,
    /// Floats from one output pixel to the next.
    pub out_pixel: usize,
    pub pixels: usize,
    /// Floats in an output pixel, a multiple of [`LANES`].
    pub channels: usize,
    pub start: Start,
    /// Clamp below at zero.
    pub relu: bool,
}

impl Product<'_> {
    /// Computes the row.
    ///
    /// # Safety
    /// All of the scalars, vectors and outputs that the fields describe are inside live allocations,
    /// the outputs alias nothing that is read, and the processor has `level`.
    pub(crate) unsafe fn run(&self, level: Level) {
        debug_assert!(self.channels.is_multiple_of(LANES));
        unsafe {
            match level {
                Level::Portable => self.columns::<[f32; 8]>(),
                #[cfg(target_arch = "x86_64")]
                Level::Avx2 => x86::run_avx2(self),
                #[cfg(target_arch = "x86_64")]
                Level::Avx512 => x86::run_avx512(self),
            }
        }
    }

    /// Cuts the channels into groups of one to three vectors, and the sums into pieces whose vectors stay in the first
    /// cache while the whole row goes by. Between pieces the sums wait in the output, so no bit changes.
    #[inline(always)]
    unsafe fn columns<S: Simd>(&self) {
        let total = self.channels / S::LANES;
        let mut done = 0;
        while done < total {
            let rest = total - done;
            // As many as leave room for enough pixels to keep the units busy.
            let most = match S::REGISTERS {
                ..16 => 1,
                16..32 => 2,
                _ => 3,
            };
            let group = if rest == 4 { 2 } else { rest.min(most) };
            let channel = done * S::LANES;
            done += group;
            // A step's vectors, and the rest of the cache line that they end in.
            let step_bytes = (group * S::LANES).min(self.vector_step) * 4 + 64;
            let together = (PIECE_BYTES / (step_bytes * self.length)).max(1);
            let mut rest = self.segments;
            let mut start = self.start;
            loop {
                let (segments, later) = rest.split_at(together.min(rest.len()));
                rest = later;
                let piece = Product {
                    segments,
                    start,
                    relu: self.relu && rest.is_empty(),
                    ..*self
                };
                unsafe {
                    match group {
                        1 => piece.pixels::<S, 1>(channel),
                        2 => piece.pixels::<S, 2>(channel),
                        _ => piece.pixels::<S, 3>(channel),
                    }
                }
                if rest.is_empty() {
                    break;
                }
                start = Start::Output;
            }
        }
    }

    /// Cuts the row into the largest blocks that the registers hold.
    #[inline(always)]
    unsafe fn pixels<S: Simd, const B: usize>(&self, channel: usize) {
        // Beside the sums, the registers hold a vector for each column and the scalar.
        let fits = |pixels: usize| pixels * B + B + 1 < S::REGISTERS;
        let mut done = 0;
        while done < self.pixels {
            let rest = self.pixels - done;
            unsafe {
                // 16 is cut 8 + 8: 12 + 4 would keep the units less busy.
                done += if fits(12) && rest >= 12 && rest != 16 {
                    self.block::<S, 12, B>(done, channel);
                    12
                } else if fits(8) && rest >= 8 {
                    self.block::<S, 8, B>(done, channel);
                    8
                } else if fits(6) && !fits(8) && rest >= 6 && rest != 8 {
                    self.block::<S, 6, B>(done, channel);
                    6
                } else if rest >= 4 {
                    self.block::<S, 4, B>(done, channel);
                    4
                } else if rest >= 2 {
                    self.block::<S, 2, B>(done, channel);
                    2
                } else {
                    self.block::<S, 1, B>(done, channel);
                    1
                };
            }
        }
    }

    /// `P` pixels by `B` vectors of sums.
    #[inline(always)]
    unsafe fn block<S: Simd, const P: usize, const B: usize>(&self, pixel: usize, channel: usize) {
        unsafe {
            let out = self.out.add(pixel * self.out_pixel + channel);
            let mut sums = [[S::splat(0.0); B]; P];
            match self.start {
                Start::Zero => {}
                Start::Bias(bias) => {
                    for b in 0..B {
                        let bias = S::load(bias.add(channel + b * S::LANES));
                        for sum in &mut sums {
                            sum[b] = bias;
                        }
                    }
                }
                Start::Output => {
                    for (p, sum) in sums.iter_mut().enumerate() {
                        for (b, sum) in sum.iter_mut().enumerate() {
                            *sum = S::load(out.add(p * self.out_pixel + b * S::LANES));
                        }
                    }
                }
            }
            for segment in self.segments {
                let mut scalar = segment.scalar.add(pixel * self.scalar_pixel);
                let mut vector = segment.vector.add(channel);
                for _ in 0..self.length {
                    let mut vectors = [S::splat(0.0); B];
                    for (b, v) in vectors.iter_mut().enumerate() {
                        *v = S::load(vector.add(b * S::LANES));
                    }
                    for (p, sum) in sums.iter_mut().enumerate() {
                        let factor = S::splat(*scalar.add(p * self.scalar_pixel));
                        for (sum, v) in sum.iter_mut().zip(vectors) {
                            *sum = S::multiply_add(factor, v, *sum);
                        }
                    }
                    // The last step may end outside the allocation.
                    scalar = scalar.wrapping_add(self.scalar_step);
                    vector = vector.wrapping_add(self.vector_step);
                }
            }
            for (p, sum) in sums.iter().enumerate() {
                for (b, sum) in sum.iter().enumerate() {
                    let value = if self.relu { S::positive(*sum) } else { *sum };
                    S::store(out.add(p * self.out_pixel + b * S::LANES), value);
                }
            }
        }
    }
}

/// A vector of floats of some instruction set.
trait Simd: Copy {
    const LANES: usize;
    const REGISTERS: usize;
    unsafe fn splat(value: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    unsafe fn store(to: *mut f32, value: Self);
    /// `a * b + c`.
    unsafe fn multiply_add(a: Self, b: Self, c: Self) -> Self;
    unsafe fn positive(self) -> Self;
}

impl Simd for [f32; 8] {
    const LANES: usize = 8;
    /// Pairs of 128-bit registers.
    const REGISTERS: usize = if cfg!(target_arch = "aarch64") { 16 } else { 8 };

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        [value; 8]
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        unsafe { from.cast::<[f32; 8]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn store(to: *mut f32, value: Self) {
        unsafe { to.cast::<[f32; 8]>().write_unaligned(value) }
    }

    #[inline(always)]
    unsafe fn multiply_add(a: Self, b: Self, c: Self) -> Self {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }

    #[inline(always)]
    unsafe fn positive(self) -> Self {
        self.map(|value| value.max(0.0))
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Product, Simd};

    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn run_avx2(product: &Product) {
        unsafe { product.columns::<Half<16>>() }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
    pub(super) unsafe fn run_avx512(product: &Product) {
        unsafe {
            if product.channels.is_multiple_of(16) {
                product.columns::<Full>()
            } else {
                product.columns::<Half<32>>()
            }
        }
    }

    /// 8 floats, with `REGISTERS` registers of them.
    #[derive(Clone, Copy)]
    struct Half<const REGISTERS: usize>(__m256);

    impl<const R: usize> Simd for Half<R> {
        const LANES: usize = 8;
        const REGISTERS: usize = R;

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            Self(unsafe { _mm256_set1_ps(value) })
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            Self(unsafe { _mm256_loadu_ps(from) })
        }

        #[inline(always)]
        unsafe fn store(to: *mut f32, value: Self) {
            unsafe { _mm256_storeu_ps(to, value.0) }
        }

        #[inline(always)]
        unsafe fn multiply_add(a: Self, b: Self, c: Self) -> Self {
            Self(unsafe { _mm256_fmadd_ps(a.0, b.0, c.0) })
        }

        #[inline(always)]
        unsafe fn positive(self) -> Self {
            Self(unsafe { _mm256_max_ps(self.0, _mm256_setzero_ps()) })
        }
    }

    /// 16 floats.
    #[derive(Clone, Copy)]
    struct Full(__m512);

    impl Simd for Full {
        const LANES: usize = 16;
        const REGISTERS: usize = 32;

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            Self(unsafe { _mm512_set1_ps(value) })
        }

        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            Self(unsafe { _mm512_loadu_ps(from) })
        }

        #[inline(always)]
        unsafe fn store(to: *mut f32, value: Self) {
            unsafe { _mm512_storeu_ps(to, value.0) }
        }

        #[inline(always)]
        unsafe fn multiply_add(a: Self, b: Self, c: Self) -> Self {
            Self(unsafe { _mm512_fmadd_ps(a.0, b.0, c.0) })
        }

        #[inline(always)]
        unsafe fn positive(self) -> Self {
            Self(unsafe { _mm512_max_ps(self.0, _mm512_setzero_ps()) })
        }
    }
}
