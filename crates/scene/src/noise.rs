//! Cheap tileable noise: tables made once, read with a random shift, turn and scale.
//!
//! Values are spread evenly over 0 to 1, so that a threshold is the share of the area under it.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::sync::LazyLock;

/// Side of a table, texels.
const SIDE: usize = 256;

/// Character of a noise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grain {
    /// Cloudy: large patches with ragged borders.
    Cloud,
    /// Even grain of about one size.
    Even,
    /// Veins: ridges between cells.
    Vein,
}

static TABLES: LazyLock<[Vec<f32>; 3]> = LazyLock::new(|| {
    [
        equalise(octaves(1, 4, 6, 0.58)),
        equalise(octaves(2, 32, 2, 0.5)),
        equalise(veins(3)),
    ]
});

/// Sum of value noises, `cells` per side in the first, doubling, each `gain` times weaker.
fn octaves(seed: u64, mut cells: usize, count: usize, gain: f32) -> Vec<f32> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut table = vec![0.0; SIDE * SIDE];
    let mut weight = 1.0;
    for _ in 0..count {
        let knots: Vec<f32> = (0..cells * cells).map(|_| rng.random::<f32>() - 0.5).collect();
        let step = cells as f32 / SIDE as f32;
        for (i, value) in table.iter_mut().enumerate() {
            let x = (i % SIDE) as f32 * step;
            let y = (i / SIDE) as f32 * step;
            let (ix, iy) = (x as usize, y as usize);
            let ease = |t: f32| t * t * (3.0 - 2.0 * t);
            let (fx, fy) = (ease(x - ix as f32), ease(y - iy as f32));
            let (jx, jy) = ((ix + 1) % cells, (iy + 1) % cells);
            let top = knots[iy * cells + ix] * (1.0 - fx) + knots[iy * cells + jx] * fx;
            let bottom = knots[jy * cells + ix] * (1.0 - fx) + knots[jy * cells + jx] * fx;
            *value += weight * (top + fy * (bottom - top));
        }
        weight *= gain;
        cells = (cells * 2).min(SIDE);
    }
    table
}

fn veins(seed: u64) -> Vec<f32> {
    let a = octaves(seed, 8, 4, 0.55);
    let b = octaves(seed + 100, 8, 4, 0.55);
    a.iter().zip(&b).map(|(a, b)| -(a.abs().min(b.abs()))).collect()
}

/// Replaces each value by its rank, 0 to 1.
fn equalise(table: Vec<f32>) -> Vec<f32> {
    let mut order: Vec<usize> = (0..table.len()).collect();
    order.sort_by(|&a, &b| table[a].total_cmp(&table[b]));
    let mut ranked = vec![0.0; table.len()];
    for (rank, i) in order.into_iter().enumerate() {
        ranked[i] = rank as f32 / (SIDE * SIDE - 1) as f32;
    }
    ranked
}

/// One noise over the plane, drawn from the tables.
#[derive(Clone, Copy, Debug)]
pub struct Noise {
    grain: Grain,
    shift: [f32; 2],
    turn: [f32; 2],
}

impl Noise {
    /// A noise whose largest features are about `feature_mm` wide, placed at random.
    pub fn new<R: RngExt + ?Sized>(grain: Grain, feature_mm: f32, rng: &mut R) -> Noise {
        let cells = match grain {
            Grain::Cloud => 4.0,
            Grain::Even => 32.0,
            Grain::Vein => 8.0,
        };
        let scale = SIDE as f32 / cells / feature_mm;
        let angle = rng.random_range(0.0..std::f32::consts::TAU);
        Noise {
            grain,
            shift: [
                rng.random_range(0.0..SIDE as f32) + 16.0 * SIDE as f32,
                rng.random_range(0.0..SIDE as f32) + 16.0 * SIDE as f32,
            ],
            turn: [scale * angle.cos(), scale * angle.sin()],
        }
    }

    /// Value at a place (mm), 0 to 1.
    #[inline]
    pub fn at(&self, x_mm: f32, y_mm: f32) -> f32 {
        let table = &TABLES[self.grain as usize];
        let x = self.turn[0] * x_mm - self.turn[1] * y_mm + self.shift[0];
        let y = self.turn[1] * x_mm + self.turn[0] * y_mm + self.shift[1];
        let (fx, fy) = (x.max(0.0), y.max(0.0));
        let (ix, iy) = (fx as usize, fy as usize);
        let (fx, fy) = (fx - ix as f32, fy - iy as f32);
        let (x0, y0) = (ix % SIDE, (iy % SIDE) * SIDE);
        let (x1, y1) = ((ix + 1) % SIDE, ((iy + 1) % SIDE) * SIDE);
        let top = table[y0 + x0] + fx * (table[y0 + x1] - table[y0 + x0]);
        let bottom = table[y1 + x0] + fx * (table[y1 + x1] - table[y1 + x0]);
        top + fy * (bottom - top)
    }
}

/// 0 below `low`, 1 above `high`, smooth between.
#[inline]
pub fn smoothstep(low: f32, high: f32, value: f32) -> f32 {
    let t = ((value - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_threshold_is_a_share_of_the_area() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        for grain in [Grain::Cloud, Grain::Even, Grain::Vein] {
            let noise = Noise::new(grain, 2.0, &mut rng);
            let n = 40_000;
            let under = (0..n)
                .filter(|i| noise.at((i % 200) as f32 * 0.37, (i / 200) as f32 * 0.37) < 0.3)
                .count();
            let share = under as f32 / n as f32;
            assert!((0.2..0.4).contains(&share), "{grain:?}: {share}");
        }
    }
}
