//! From patches to what the networks are fed: crop, turn, scale, light, and the targets of every cell.

use crate::samples::{Classes, Label, PATCH_PX, Patch, only};
use geometry::{Pixel, RgbImage};
use nalgebra::{Matrix2, Rotation2, Vector2};
use nn::Tensor;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use vision::Clip;
use vision::layout::{
    CLASS_CHANNELS, CLASSES, CLIP_CENTER_PX, CLIP_PX, CLOSE_HEAD_PX, Class, FINE_INPUT_CHANNELS, IGNORE_RADIUS,
    LABEL_RADIUS, LN_DIAMETER, NOMINAL_HEAD_PX, OFFSET_U, OFFSET_UNIT_PX, OFFSET_V, STRIDE, cell_center_px,
    network_value,
};

/// Side of the coarse network's training crop, px.
pub const COARSE_PX: usize = 96;

/// Share of pictures with a cable, a pipe or a strip of sheet drawn across: the rendered ones rarely have it over a head.
const OCCLUDED: f64 = 0.06;
/// Share of pictures with blotches of one colour over everything, and with the edge of a shadow across.
const GRIMY: f64 = 0.10;
const SHADED: f64 = 0.12;
/// Share of pictures that are squeezed as if seen from well aside; the others as a face that leans by a few degrees.
const ASLANT: f64 = 0.25;
/// Share of pictures that get another camera's light, colour and noise in full; the others are nearly left as rendered.
const RELIT: f64 = 0.6;

/// Weight of each regression beside the classes' cross-entropy, and the error from which it counts linearly. Offsets
/// that weigh more than this take the network's attention from telling a cross from a hexalobular recess.
const PLACE_WEIGHTS: [(f32, f32); 3] = [(0.15, 0.06), (0.15, 0.06), (0.015, 0.1)];

/// Which network a batch is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Stage 1: larger crops, no gamma correction.
    Coarse,
    /// Stage 2: clips around a candidate, gamma corrected.
    Fine,
    /// Stage 2's closer look: every head as large as the others.
    Close,
}

impl Stage {
    /// Side of the crop, px.
    pub fn side_px(self) -> usize {
        match self {
            Stage::Coarse => COARSE_PX,
            Stage::Fine | Stage::Close => CLIP_PX,
        }
    }

    fn input_channels(self) -> usize {
        match self {
            Stage::Coarse => 3,
            Stage::Fine | Stage::Close => FINE_INPUT_CHANNELS,
        }
    }
}

/// Target of one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Target {
    /// Classes that it may be; 0: ignored.
    pub classes: Classes,
    /// Weight in the loss.
    pub weight: f32,
    /// Offset and ln diameter as the network gives them, where known.
    pub regression: Option<[f32; 3]>,
}

/// Pictures and targets for a step of training.
pub struct Batch {
    /// The networks' input.
    pub input: Tensor,
    /// A target for every output cell.
    pub targets: Vec<Target>,
}

/// Draws a batch: patch `picks[i]`, augmented by seed.
pub fn batch(stage: Stage, patches: &[&Patch], picks: &[usize], seed: u64) -> Batch {
    let side = stage.side_px();
    let cells = side / STRIDE;
    let channels = stage.input_channels();
    let mut input = Tensor::zeros(picks.len(), side, side, channels);
    let mut targets = vec![Target::default(); picks.len() * cells * cells];
    input
        .data
        .par_chunks_mut(side * side * channels)
        .zip(targets.par_chunks_mut(cells * cells))
        .zip(picks)
        .enumerate()
        .for_each(|(i, ((pixels, targets), &pick))| {
            let mut rng = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (i as u64) << 20);
            fill(stage, patches[pick], &mut rng, pixels, targets);
        });
    Batch { input, targets }
}

fn fill(stage: Stage, patch: &Patch, rng: &mut Pcg64Mcg, pixels: &mut [f32], targets: &mut [Target]) {
    let side = stage.side_px();
    let mut normal = |sigma: f64| sigma * (0..4).map(|_| rng.random_range(-1.0..1.0)).sum::<f64>() * 0.866;
    // where the crop's middle comes from: near the item for what a candidate looks like, anywhere for background
    let middle = PATCH_PX as f64 / 2.0 - 0.5;
    let focus = patch
        .labels
        .first()
        .filter(|_| patch.focused)
        .map(|l| [f64::from(l.u_px), f64::from(l.v_px)]);
    let jitter = match stage {
        Stage::Fine if focus.is_some() => 3.5,
        Stage::Close if focus.is_some() => 1.5,
        _ => 10.0,
    };
    let mut source = focus.filter(|_| stage != Stage::Coarse).unwrap_or([middle, middle]);
    source = source.map(|c| c + normal(jitter).clamp(-12.0, 12.0));
    let size = match (stage, patch.labels.first().filter(|_| patch.focused)) {
        (Stage::Close, Some(label)) => CLOSE_HEAD_PX / f64::from(label.diameter_px),
        (Stage::Close, None) => CLOSE_HEAD_PX / NOMINAL_HEAD_PX,
        _ => 1.0,
    };
    let scale = size * normal(0.10).exp().clamp(0.75, 1.4);
    let tilt: f64 = normal(0.12);
    let mild = normal(0.05).exp().clamp(0.88, 1.14);
    // width over height of a circle is the square of this
    let squeeze = if rng.random_bool(ASLANT) {
        rng.random_range(0.76..1.0f64)
    } else {
        mild
    };
    let along: f64 = rng.random_range(0.0..std::f64::consts::PI);
    let turn = tilt + std::f64::consts::FRAC_PI_2 * f64::from(rng.random_range(0..4u8));
    let flip = if rng.random_bool(0.5) { -1.0 } else { 1.0 };
    // crop pixel -> patch pixel: squeezed along an axis, turned, perhaps mirrored
    let half = match stage {
        Stage::Coarse => side as f64 / 2.0,
        Stage::Fine | Stage::Close => CLIP_CENTER_PX as f64,
    };
    let axis = Rotation2::new(along);
    let squeezed = axis * Matrix2::new(squeeze, 0.0, 0.0, 1.0 / squeeze) * axis.inverse();
    let matrix = Rotation2::new(turn) * squeezed * Matrix2::new(flip, 0.0, 0.0, 1.0) / scale;
    let inverse = matrix.try_inverse().unwrap_or_default(); // its determinant is ±1/scale²
    let source = Vector2::from(source);
    let forward = |x: f64, y: f64| source + matrix * Vector2::new(x - half, y - half);
    let backward = |u: f64, v: f64| -> [f64; 2] { (inverse * (Vector2::new(u, v) - source)).add_scalar(half).into() };
    let mut rgb = vec![0f32; side * side * 3];
    let (corner, right, down) = (forward(0.0, 0.0), matrix.column(0), matrix.column(1));
    for y in 0..side {
        for x in 0..side {
            let at = corner + right * x as f64 + down * y as f64;
            sample(&patch.rgb, at.x, at.y, &mut rgb[3 * (y * side + x)..][..3]);
        }
    }
    let strand = rng.random_bool(OCCLUDED).then(|| Strand::sample(half, scale, rng));
    if rng.random_bool(GRIMY) {
        grime(&mut rgb, side, rng);
    }
    if let Some(strand) = &strand {
        strand.draw(&mut rgb, side);
    }
    if rng.random_bool(SHADED) {
        shadow(&mut rgb, side, rng);
    }
    relight(&mut rgb, side, rng);
    let bytes: Vec<u8> = rgb.iter().map(|v| v.round().clamp(0.0, 255.0) as u8).collect();
    match stage {
        Stage::Fine | Stage::Close => {
            let Some(clip) = RgbImage::from_raw(side as u32, side as u32, bytes) else {
                return;
            };
            Clip::cut(&clip, Pixel::new(CLIP_CENTER_PX as f64, CLIP_CENTER_PX as f64)).network_input(pixels);
        }
        Stage::Coarse => pixels
            .iter_mut()
            .zip(bytes)
            .for_each(|(to, from)| *to = network_value(from)),
    }
    let cells = side / STRIDE;
    let labels: Vec<_> = patch
        .labels
        .iter()
        .map(|l| {
            let (at, d) = (
                backward(f64::from(l.u_px), f64::from(l.v_px)),
                f64::from(l.diameter_px) * scale,
            );
            let hidden = strand.as_ref().is_some_and(|s| s.hides(at, d));
            (at, d, if hidden { Label { classes: 0, ..*l } } else { *l })
        })
        .collect();
    for (k, target) in targets.iter_mut().enumerate() {
        let (x, y) = (cell_center_px(k % cells), cell_center_px(k / cells));
        let nearest = labels
            .iter()
            .map(|(at, d, label)| ((x - at[0]).hypot(y - at[1]) / d, at, *d, label))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        *target = match nearest {
            Some((r, at, d, label)) if r < LABEL_RADIUS => Target {
                classes: label.classes,
                weight: 1.0,
                regression: (stage != Stage::Coarse && label.exact && label.classes != 0).then(|| {
                    [
                        ((at[0] - x) / OFFSET_UNIT_PX) as f32,
                        ((at[1] - y) / OFFSET_UNIT_PX) as f32,
                        (d / NOMINAL_HEAD_PX).ln() as f32,
                    ]
                }),
            },
            Some((r, _, _, label)) if r < IGNORE_RADIUS || (label.classes == 0 && r < 0.8) => Target::default(),
            _ => Target {
                classes: patch.elsewhere,
                weight: if stage == Stage::Coarse { 0.3 } else { 0.03 },
                regression: None,
            },
        };
        if stage == Stage::Coarse && target.classes != 0 {
            coarse(target);
        }
    }
}

/// Two classes for stage 1: may it be a fastener? Marks and holes that look alike weigh less: stage 2 tells them apart.
fn coarse(target: &mut Target) {
    let fasteners = crate::samples::any_fastener();
    if target.classes & fasteners == 0 {
        target.weight = if target.classes & only(Class::OtherFeature) != 0 {
            0.4
        } else {
            target.weight
        };
        target.classes = 0b01;
    } else if target.classes & !fasteners == 0 {
        target.weight = if target.classes & only(Class::Cross) != 0 {
            4.0
        } else {
            2.0
        };
        target.classes = 0b10;
    } else {
        *target = Target::default();
    }
}

fn sample(rgb: &[u8], u: f64, v: f64, out: &mut [f32]) {
    let last = (PATCH_PX - 1) as f64;
    let (u, v) = (u.clamp(0.0, last - 1e-6), v.clamp(0.0, last - 1e-6));
    let (i, j) = (u as usize, v as usize);
    let (fx, fy) = ((u - i as f64) as f32, (v - j as f64) as f32);
    for (c, value) in out.iter_mut().enumerate() {
        let at = |di: usize, dj: usize| f32::from(rgb[3 * ((j + dj) * PATCH_PX + i + di) + c]);
        let top = at(0, 0) + fx * (at(1, 0) - at(0, 0));
        let bottom = at(0, 1) + fx * (at(1, 1) - at(0, 1));
        *value = top + fy * (bottom - top);
    }
}

/// Something long in front of an item: a cable, a pipe, a strip of sheet, with its shadow.
struct Strand {
    /// Unit normal of its axis.
    normal: [f64; 2],
    /// Distance of its axis from the crop's first pixel along the normal, px.
    at_px: f64,
    half_width_px: f64,
    color: [f32; 3],
    /// 1: round as a cable; 0: flat.
    round: f32,
    /// Where along its width the light falls, -1 to 1.
    light: f32,
    shadow_px: f64,
}

impl Strand {
    /// One that passes near the crop pixel (`middle`, `middle`).
    fn sample(middle: f64, scale: f64, rng: &mut Pcg64Mcg) -> Self {
        let angle = rng.random_range(0.0..std::f64::consts::TAU);
        let normal = [angle.cos(), angle.sin()];
        let half_width_px = rng.random_range(2.0..8.0) * scale;
        let base = rng.random_range(15.0..235.0f32);
        let spread = if rng.random_bool(0.5) { 12.0 } else { 90.0 };
        Self {
            normal,
            at_px: middle * (normal[0] + normal[1]) + rng.random_range(4.0..18.0) * scale,
            half_width_px,
            color: std::array::from_fn(|_| (base + rng.random_range(-spread..spread)).clamp(5.0, 250.0)),
            round: if rng.random_bool(0.75) {
                rng.random_range(0.4..1.0)
            } else {
                0.0
            },
            light: rng.random_range(-0.8..0.8),
            shadow_px: rng.random_range(-6.0..6.0),
        }
    }

    /// Distance from its axis, px.
    fn off(&self, at: [f64; 2]) -> f64 {
        at[0] * self.normal[0] + at[1] * self.normal[1] - self.at_px
    }

    fn draw(&self, rgb: &mut [f32], side: usize) {
        for (k, pixel) in rgb.chunks_exact_mut(3).enumerate() {
            let off = self.off([(k % side) as f64, (k / side) as f64]);
            let cover = |off: f64| (self.half_width_px - off.abs() + 0.5).clamp(0.0, 1.0) as f32;
            let dark = 1.0 - 0.45 * cover(off - self.shadow_px);
            let across = (off / self.half_width_px).clamp(-1.0, 1.0) as f32;
            let shade = 1.0 - self.round * (0.75 * (across - self.light).powi(2)).min(0.9);
            let cover = cover(off);
            for (value, color) in pixel.iter_mut().zip(self.color) {
                *value = *value * dark * (1.0 - cover) + color * shade * cover;
            }
        }
    }

    /// True if less than half of the head or 40 % of its slot is left to see: then nothing is to be learned from it.
    fn hides(&self, at: [f64; 2], diameter_px: f64) -> bool {
        let (low, high) = (self.off(at) - self.half_width_px, self.off(at) + self.half_width_px);
        let hidden = |radius: f64| ((high.min(radius) - low.max(-radius)) / (2.0 * radius)).max(0.0);
        hidden(0.5 * diameter_px) > 0.45 || hidden(0.21 * diameter_px) > 0.55
    }
}

/// Blotches of rust, mud, white rust or black grime on less than half of the picture.
fn grime(rgb: &mut [f32], side: usize, rng: &mut Pcg64Mcg) {
    let base: [f32; 3] = [
        [120.0, 62.0, 30.0],
        [95.0, 80.0, 60.0],
        [205.0, 205.0, 198.0],
        [38.0, 36.0, 34.0],
    ][rng.random_range(0..4)];
    let color = base.map(|c| c * rng.random_range(0.75..1.25f32));
    let cell_px = rng.random_range(3.0..11.0f32);
    let (opaque, from) = (rng.random_range(0.3..0.8f32), rng.random_range(0.56..0.70f32));
    let knots = (side as f32 / cell_px) as usize + 2;
    let grid: Vec<f32> = (0..knots * knots).map(|_| rng.random()).collect();
    for (k, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        let (x, y) = ((k % side) as f32 / cell_px, (k / side) as f32 / cell_px);
        let (i, j, fx, fy) = (x as usize, y as usize, x.fract(), y.fract());
        let row = |j: usize| grid[j * knots + i] * (1.0 - fx) + grid[j * knots + i + 1] * fx;
        let cover = opaque * ((row(j) * (1.0 - fy) + row(j + 1) * fy - from) * 8.0).clamp(0.0, 1.0);
        for (value, color) in pixel.iter_mut().zip(color) {
            *value += cover * (color - *value);
        }
    }
}

/// Darkens one side of a line near the middle.
fn shadow(rgb: &mut [f32], side: usize, rng: &mut Pcg64Mcg) {
    let (sin, cos) = rng.random_range(0.0..std::f32::consts::TAU).sin_cos();
    let (off, soft, dark) = (
        rng.random_range(-16.0..16.0f32),
        rng.random_range(0.5..3.0f32),
        rng.random_range(0.35..0.85f32),
    );
    let half = side as f32 / 2.0;
    for (k, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        let beyond = ((k % side) as f32 - half) * cos + ((k / side) as f32 - half) * sin - off;
        let shade = 1.0 - (1.0 - dark) * (0.5 + beyond / soft).clamp(0.0, 1.0);
        pixel.iter_mut().for_each(|value| *value *= shade);
    }
}

/// Light, colour, contrast, blur and noise as another camera would have them.
fn relight(rgb: &mut [f32], side: usize, rng: &mut Pcg64Mcg) {
    let full = rng.random_bool(RELIT);
    let much = if full { 1.0f32 } else { 0.25 };
    let dark = if full && rng.random_bool(0.12) {
        rng.random_range(-1.8..0.0f32)
    } else {
        0.0
    };
    let gain = (dark + much * rng.random_range(-0.35..0.30f32)).exp();
    let gamma = (much * rng.random_range(-0.35..0.33f32)).exp();
    let cast: [f32; 3] = std::array::from_fn(|_| 1.0 + much * rng.random_range(-0.15..0.18f32));
    let gray = if full && rng.random_bool(0.2) {
        1.0
    } else {
        much * rng.random_range(0.0..0.3f32)
    };
    // colours exchanged: rust must not be all there is to see
    let order = if full && rng.random_bool(0.25) {
        [[2, 1, 0], [1, 0, 2], [0, 2, 1], [1, 2, 0], [2, 0, 1]][rng.random_range(0..5)]
    } else {
        [0, 1, 2]
    };
    let slope = [rng.random_range(-0.25..0.25f32), rng.random_range(-0.25..0.25f32)];
    let noise = if full && rng.random_bool(0.7) {
        rng.random_range(0.0..7.0f32)
    } else {
        0.0
    };
    let s = side as f32;
    let tone: [f32; 257] = std::array::from_fn(|v| 255.0 * (v as f32 / 255.0).powf(gamma));
    let curve = |v: f32| {
        let v = v.clamp(0.0, 255.0);
        let (i, f) = (v as usize, v.fract());
        tone[i] + f * (tone[i + 1] - tone[i])
    };
    for (k, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        let (x, y) = ((k % side) as f32 / s - 0.5, (k / side) as f32 / s - 0.5);
        let shade = gain * (1.0 + slope[0] * x + slope[1] * y);
        let luma = 0.3 * pixel[0] + 0.59 * pixel[1] + 0.11 * pixel[2];
        for (c, value) in pixel.iter_mut().enumerate() {
            *value = curve(*value + gray * (luma - *value)) * shade * cast[c];
        }
        let now = [pixel[0], pixel[1], pixel[2]];
        pixel.copy_from_slice(&order.map(|c: usize| now[c]));
    }
    if full && rng.random_bool(0.35) {
        soften(rgb, side, rng.random_range(0.1..0.9f32));
    } else if full && rng.random_bool(0.25) {
        soften(rgb, side, -rng.random_range(0.1..0.5f32));
    }
    if noise > 0.0 {
        let mut state = rng.random::<u64>();
        for value in rgb.iter_mut() {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            let part = |k: u32| ((state >> k) & 0xffff) as f32 / 65535.0 - 0.5;
            *value += noise * 1.7 * (part(48) + part(32) + part(16));
        }
    }
}

/// Mixes each pixel with the mean of its neighbours; a negative share sharpens.
fn soften(rgb: &mut [f32], side: usize, share: f32) {
    let from = rgb.to_vec();
    let at = |x: usize, y: usize, c: usize| from[3 * (y * side + x) + c];
    for y in 0..side {
        for x in 0..side {
            let (l, r, t, b) = (
                x.saturating_sub(1),
                (x + 1).min(side - 1),
                y.saturating_sub(1),
                (y + 1).min(side - 1),
            );
            for c in 0..3 {
                let mean = (at(l, y, c)
                    + at(r, y, c)
                    + at(x, t, c)
                    + at(x, b, c)
                    + 0.5 * (at(l, t, c) + at(r, t, c) + at(l, b, c) + at(r, b, c)))
                    / 6.0;
                rgb[3 * (y * side + x) + c] += share * (mean - at(x, y, c));
            }
        }
    }
}

/// Loss and gradient over a batch: cross-entropy against sets of classes, smooth L1 for the regressions, these with `place` times
/// their weight.
pub fn loss(stage: Stage, output: &Tensor, targets: &[Target], place: f32, grad: &mut Tensor) -> f32 {
    let classes = match stage {
        Stage::Coarse => vision::layout::COARSE_CHANNELS,
        Stage::Fine | Stage::Close => CLASSES,
    };
    *grad = Tensor::zeros(output.n, output.h, output.w, output.c);
    let total: f32 = targets
        .iter()
        .filter(|t| t.classes != 0)
        .map(|t| t.weight)
        .sum::<f32>()
        .max(1e-6);
    let known = targets.iter().filter(|t| t.regression.is_some()).count().max(1) as f32;
    let mut sum = 0.0f64;
    let rows = output
        .data
        .chunks_exact(output.c)
        .zip(grad.data.chunks_exact_mut(output.c));
    for ((z, g), target) in rows.zip(targets) {
        if target.classes != 0 {
            let w = target.weight / total;
            let high = z[..classes].iter().copied().fold(f32::MIN, f32::max);
            let mut p = [0f32; CLASSES];
            let mut norm = 0.0;
            for c in 0..classes {
                p[c] = (z[c] - high).exp();
                norm += p[c];
            }
            let inside: f32 = (0..classes)
                .filter(|c| target.classes >> c & 1 == 1)
                .map(|c| p[c])
                .sum::<f32>()
                .max(1e-20);
            sum -= f64::from(w) * f64::from((inside / norm).ln());
            for c in 0..classes {
                let among = if target.classes >> c & 1 == 1 {
                    p[c] / inside
                } else {
                    0.0
                };
                g[CLASS_CHANNELS.start + c] = w * (p[c] / norm - among);
            }
        }
        if let Some(truth) = target.regression {
            for (channel, (truth, (weight, knee))) in [OFFSET_U, OFFSET_V, LN_DIAMETER]
                .into_iter()
                .zip(truth.into_iter().zip(PLACE_WEIGHTS))
            {
                let error = z[channel] - truth;
                let w = place * weight / known;
                if error.abs() < knee {
                    sum += f64::from(w * 0.5 * error * error / knee);
                    g[channel] = w * error / knee;
                } else {
                    sum += f64::from(w * (error.abs() - 0.5 * knee));
                    g[channel] = w * error.signum();
                }
            }
        }
    }
    sum as f32
}
