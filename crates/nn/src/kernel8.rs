//! The inner loop in eight bits: sums of products of bytes, exact in 32-bit integers.
//!
//! As the [kernel](crate::kernel) of floats, with four input channels a step: an activation is an unsigned byte, a weight a signed
//! one. Integers do not round, so every instruction set gives the same bits. With AVX-512 VNNI a step is one instruction for four times
//! as many products as one of floats; plain AVX2 has to keep neighbouring products apart, whose sum does not fit 16 bits, and is
//! about as fast as with floats.

/// Input channels in a step.
pub(crate) const STEP: usize = 4;

/// The widest instructions to use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Level8 {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Vnni,
}

impl Level8 {
    /// All that this processor has, worst first.
    pub(crate) fn all() -> Vec<Self> {
        #[allow(unused_mut)]
        let mut levels = vec![Level8::Portable];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            levels.push(Level8::Avx2);
            let vnni = is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512bw");
            if vnni && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                levels.push(Level8::Vnni);
            }
        }
        levels
    }

    /// The best that this processor has.
    pub(crate) fn detect() -> Self {
        Self::all().pop().unwrap_or(Level8::Portable)
    }
}

/// One run of `length` steps of a [`Product8`].
#[derive(Clone, Copy)]
pub(crate) struct Segment8 {
    /// The first input channel of pixel 0, step 0.
    pub scalar: *const u8,
    /// The weights of step 0: [`STEP`] for each output channel.
    pub vector: *const i8,
}

/// Where the sums go.
#[derive(Clone, Copy)]
pub(crate) enum Out8 {
    /// Rounded to the nearest whole number from 0 to 255.
    Bytes(*mut u8),
    Floats(*mut f32),
}

/// `out[p][c] = factor[c] * sum over segments s, steps k of scalar[s][p, k] · vector[s][k][c] + offset[c]`.
pub(crate) struct Product8<'a> {
    pub segments: &'a [Segment8],
    /// Steps in each segment.
    pub length: usize,
    /// Bytes from one pixel's scalars to the next's; from one step's to the next's it is [`STEP`].
    pub scalar_pixel: usize,
    pub factor: &'a [f32],
    pub offset: &'a [f32],
    pub out: Out8,
    pub pixels: usize,
    /// Values in an output pixel, a multiple of [`LANES`](crate::kernel::LANES).
    pub channels: usize,
}

impl Product8<'_> {
    /// Computes the row.
    ///
    /// # Safety
    /// All of the scalars, vectors and outputs that the fields describe are inside live allocations,
    /// the outputs alias nothing that is read, and the processor has `level`.
    pub(crate) unsafe fn run(&self, level: Level8) {
        assert!(self.factor.len() == self.channels && self.offset.len() == self.channels);
        unsafe {
            match level {
                Level8::Portable => self.columns::<[i32; 8]>(),
                #[cfg(target_arch = "x86_64")]
                Level8::Avx2 => x86::run_avx2(self),
                #[cfg(target_arch = "x86_64")]
                Level8::Vnni => x86::run_vnni(self),
            }
        }
    }

    /// Cuts the channels into groups of one or two vectors.
    #[inline(always)]
    unsafe fn columns<S: Simd8>(&self) {
        let total = self.channels / S::LANES;
        let mut done = 0;
        while done < total {
            let channel = done * S::LANES;
            unsafe {
                if total - done >= 2 && S::REGISTERS >= 16 {
                    self.pixels::<S, 2>(channel);
                    done += 2;
                } else {
                    self.pixels::<S, 1>(channel);
                    done += 1;
                }
            }
        }
    }

    /// Cuts the row into the largest blocks that the registers hold.
    #[inline(always)]
    unsafe fn pixels<S: Simd8, const B: usize>(&self, channel: usize) {
        let fits = |pixels: usize| pixels * B + B + S::SPARE <= S::REGISTERS;
        let mut done = 0;
        while done < self.pixels {
            let rest = self.pixels - done;
            unsafe {
                done += if fits(12) && rest >= 12 && rest != 16 {
                    self.block::<S, 12, B>(done, channel);
                    12
                } else if fits(8) && rest >= 8 {
                    self.block::<S, 8, B>(done, channel);
                    8
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
    unsafe fn block<S: Simd8, const P: usize, const B: usize>(&self, pixel: usize, channel: usize) {
        unsafe {
            let mut sums = [[S::zero(); B]; P];
            for segment in self.segments {
                let mut scalar = segment.scalar.add(pixel * self.scalar_pixel);
                let mut vector = segment.vector.add(channel * STEP);
                for _ in 0..self.length {
                    let mut vectors = [S::zero(); B];
                    for (b, v) in vectors.iter_mut().enumerate() {
                        *v = S::load(vector.add(b * S::LANES * STEP));
                    }
                    for (p, sum) in sums.iter_mut().enumerate() {
                        let four = scalar.add(p * self.scalar_pixel).cast::<i32>().read_unaligned();
                        S::dot(sum, four, &vectors);
                    }
                    // The last step may end outside the allocation.
                    scalar = scalar.wrapping_add(STEP);
                    vector = vector.wrapping_add(self.channels * STEP);
                }
            }
            for b in 0..B {
                let c = channel + b * S::LANES;
                let (factor, offset) = (self.factor.as_ptr().add(c), self.offset.as_ptr().add(c));
                for (p, sum) in sums.iter().enumerate() {
                    let at = (pixel + p) * self.channels + c;
                    match self.out {
                        Out8::Bytes(out) => S::store_bytes(sum[b], factor, offset, out.add(at)),
                        Out8::Floats(out) => S::store_floats(sum[b], factor, offset, out.add(at)),
                    }
                }
            }
        }
    }
}

/// A vector of 32-bit integers of some instruction set, or the bytes of its weights.
trait Simd8: Copy {
    const LANES: usize;
    const REGISTERS: usize;
    /// Registers that a step needs beside sums and weights.
    const SPARE: usize;
    unsafe fn zero() -> Self;
    /// [`STEP`] weights a lane.
    unsafe fn load(from: *const i8) -> Self;
    /// Adds to each lane the products of four unsigned bytes with the lane's four weights.
    unsafe fn dot<const B: usize>(sums: &mut [Self; B], four: i32, weights: &[Self; B]);
    unsafe fn store_bytes(self, factor: *const f32, offset: *const f32, to: *mut u8);
    unsafe fn store_floats(self, factor: *const f32, offset: *const f32, to: *mut f32);
}

impl Simd8 for [i32; 8] {
    const LANES: usize = 8;
    const REGISTERS: usize = 8;
    const SPARE: usize = 1;

    #[inline(always)]
    unsafe fn zero() -> Self {
        [0; 8]
    }

    #[inline(always)]
    unsafe fn load(from: *const i8) -> Self {
        unsafe { from.cast::<[i32; 8]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn dot<const B: usize>(sums: &mut [Self; B], four: i32, weights: &[Self; B]) {
        let four = four.to_ne_bytes().map(i32::from);
        for (sum, weights) in sums.iter_mut().zip(weights) {
            for (sum, weights) in sum.iter_mut().zip(weights) {
                let weights = weights.to_ne_bytes().map(|w| i32::from(w.cast_signed()));
                for (a, w) in four.iter().zip(weights) {
                    *sum += a * w;
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn store_bytes(self, factor: *const f32, offset: *const f32, to: *mut u8) {
        for (i, sum) in self.into_iter().enumerate() {
            let value = unsafe { sum as f32 * *factor.add(i) + *offset.add(i) };
            unsafe { *to.add(i) = value.clamp(0.0, 255.0).round_ties_even() as u8 };
        }
    }

    #[inline(always)]
    unsafe fn store_floats(self, factor: *const f32, offset: *const f32, to: *mut f32) {
        for (i, sum) in self.into_iter().enumerate() {
            unsafe { *to.add(i) = sum as f32 * *factor.add(i) + *offset.add(i) };
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Product8, Simd8};

    #[target_feature(enable = "avx2")]
    pub(super) unsafe fn run_avx2(product: &Product8) {
        unsafe { product.columns::<Plain>() }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vnni,avx2")]
    pub(super) unsafe fn run_vnni(product: &Product8) {
        unsafe {
            if product.channels.is_multiple_of(16) {
                product.columns::<Full>()
            } else {
                product.columns::<Half>()
            }
        }
    }

    /// 8 integers, without VNNI.
    #[derive(Clone, Copy)]
    struct Plain(__m256i);

    impl Simd8 for Plain {
        const LANES: usize = 8;
        const REGISTERS: usize = 16;
        const SPARE: usize = 5;

        #[inline(always)]
        unsafe fn zero() -> Self {
            Self(unsafe { _mm256_setzero_si256() })
        }

        #[inline(always)]
        unsafe fn load(from: *const i8) -> Self {
            Self(unsafe { _mm256_loadu_si256(from.cast()) })
        }

        #[inline(always)]
        unsafe fn dot<const B: usize>(sums: &mut [Self; B], four: i32, weights: &[Self; B]) {
            unsafe {
                // one product of 255 * 128 fits 16 bits, the sum of two does not: bytes 0 and 2 first, then 1 and 3
                let even = _mm256_set1_epi32(four & 0x00FF_00FF);
                let odd = _mm256_set1_epi32(four & 0xFF00_FF00_u32.cast_signed());
                let ones = _mm256_set1_epi16(1);
                for (sum, weights) in sums.iter_mut().zip(weights) {
                    let even = _mm256_madd_epi16(_mm256_maddubs_epi16(even, weights.0), ones);
                    let odd = _mm256_madd_epi16(_mm256_maddubs_epi16(odd, weights.0), ones);
                    sum.0 = _mm256_add_epi32(sum.0, _mm256_add_epi32(even, odd));
                }
            }
        }

        #[inline(always)]
        unsafe fn store_bytes(self, factor: *const f32, offset: *const f32, to: *mut u8) {
            unsafe {
                let rounded = _mm256_cvtps_epi32(bounded8(scaled8(self.0, factor, offset)));
                let (low, high) = (_mm256_castsi256_si128(rounded), _mm256_extracti128_si256::<1>(rounded));
                let words = _mm_packus_epi32(low, high);
                _mm_storel_epi64(to.cast(), _mm_packus_epi16(words, words));
            }
        }

        #[inline(always)]
        unsafe fn store_floats(self, factor: *const f32, offset: *const f32, to: *mut f32) {
            unsafe { _mm256_storeu_ps(to, scaled8(self.0, factor, offset)) }
        }
    }

    /// Multiplied, then added: not fused, as that is not everywhere.
    #[inline(always)]
    unsafe fn scaled8(sums: __m256i, factor: *const f32, offset: *const f32) -> __m256 {
        unsafe {
            let product = _mm256_mul_ps(_mm256_cvtepi32_ps(sums), _mm256_loadu_ps(factor));
            _mm256_add_ps(product, _mm256_loadu_ps(offset))
        }
    }

    #[inline(always)]
    unsafe fn bounded8(values: __m256) -> __m256 {
        unsafe { _mm256_min_ps(_mm256_max_ps(values, _mm256_setzero_ps()), _mm256_set1_ps(255.0)) }
    }

    /// 8 integers with VNNI.
    #[derive(Clone, Copy)]
    struct Half(__m256i);

    impl Simd8 for Half {
        const LANES: usize = 8;
        const REGISTERS: usize = 32;
        const SPARE: usize = 1;

        #[inline(always)]
        unsafe fn zero() -> Self {
            Self(unsafe { _mm256_setzero_si256() })
        }

        #[inline(always)]
        unsafe fn load(from: *const i8) -> Self {
            Self(unsafe { _mm256_loadu_si256(from.cast()) })
        }

        #[inline(always)]
        unsafe fn dot<const B: usize>(sums: &mut [Self; B], four: i32, weights: &[Self; B]) {
            unsafe {
                let four = _mm256_set1_epi32(four);
                for (sum, weights) in sums.iter_mut().zip(weights) {
                    sum.0 = _mm256_dpbusd_epi32(sum.0, four, weights.0);
                }
            }
        }

        #[inline(always)]
        unsafe fn store_bytes(self, factor: *const f32, offset: *const f32, to: *mut u8) {
            unsafe {
                let rounded = _mm256_cvtps_epi32(bounded8(scaled8(self.0, factor, offset)));
                _mm_storel_epi64(to.cast(), _mm256_cvtusepi32_epi8(rounded));
            }
        }

        #[inline(always)]
        unsafe fn store_floats(self, factor: *const f32, offset: *const f32, to: *mut f32) {
            unsafe { _mm256_storeu_ps(to, scaled8(self.0, factor, offset)) }
        }
    }

    /// 16 integers with VNNI.
    #[derive(Clone, Copy)]
    struct Full(__m512i);

    impl Full {
        #[inline(always)]
        unsafe fn scaled(self, factor: *const f32, offset: *const f32) -> __m512 {
            unsafe {
                let product = _mm512_mul_ps(_mm512_cvtepi32_ps(self.0), _mm512_loadu_ps(factor));
                _mm512_add_ps(product, _mm512_loadu_ps(offset))
            }
        }
    }

    impl Simd8 for Full {
        const LANES: usize = 16;
        const REGISTERS: usize = 32;
        const SPARE: usize = 1;

        #[inline(always)]
        unsafe fn zero() -> Self {
            Self(unsafe { _mm512_setzero_si512() })
        }

        #[inline(always)]
        unsafe fn load(from: *const i8) -> Self {
            Self(unsafe { _mm512_loadu_si512(from.cast()) })
        }

        #[inline(always)]
        unsafe fn dot<const B: usize>(sums: &mut [Self; B], four: i32, weights: &[Self; B]) {
            unsafe {
                let four = _mm512_set1_epi32(four);
                for (sum, weights) in sums.iter_mut().zip(weights) {
                    sum.0 = _mm512_dpbusd_epi32(sum.0, four, weights.0);
                }
            }
        }

        #[inline(always)]
        unsafe fn store_bytes(self, factor: *const f32, offset: *const f32, to: *mut u8) {
            unsafe {
                let values = _mm512_max_ps(self.scaled(factor, offset), _mm512_setzero_ps());
                let rounded = _mm512_cvtps_epi32(_mm512_min_ps(values, _mm512_set1_ps(255.0)));
                _mm_storeu_si128(to.cast(), _mm512_cvtusepi32_epi8(rounded));
            }
        }

        #[inline(always)]
        unsafe fn store_floats(self, factor: *const f32, offset: *const f32, to: *mut f32) {
            unsafe { _mm512_storeu_ps(to, self.scaled(factor, offset)) }
        }
    }
}
