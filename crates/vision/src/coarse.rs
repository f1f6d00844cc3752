//! Stage 1: the whole picture through the high-recall network, and the candidates in its answer.

use geometry::{Pixel, space};
use image::RgbImage;
use nn::{Engine, NnError};
use rayon::prelude::*;

use crate::Thresholds;
use crate::components::{Run, area, components};
use crate::layout::{COARSE_CHANNELS, COARSE_FASTENER, NOMINAL_HEAD_PX, STRIDE};
use crate::picture::Rows;

/// Two candidates of one picture are at least this far apart, in nominal head diameters.
const APART: f64 = 0.6;
/// More candidates than any face has: keeps the time bounded on a picture that is all texture.
const MOST: usize = 1000;

/// A place that may be a fastener's head, in the pixels of the picture that the network saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Centre of the evidence.
    pub pixel: Pixel<space::Clip>,
    /// Mean probability around the centre, 0 to 1.
    pub score: f32,
    /// Area of its component, shared among the candidates in it, px².
    pub area_px: f64,
}

/// The coarse network's answer: a probability for each cell of [`STRIDE`] pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct ProbabilityMap {
    /// Cells in a row.
    pub width: usize,
    /// Rows of cells.
    pub height: usize,
    /// Probability of "may be a fastener's head", row by row.
    pub probability: Vec<f32>,
}

/// Runs the coarse network over a whole picture, in bands of rows without seams.
///
/// # Errors
/// [`NnError`] where an engine from outside fails; the own one does not.
pub fn coarse_map(network: &Engine, picture: &RgbImage) -> Result<ProbabilityMap, NnError> {
    if picture.width() == 0 || picture.height() == 0 {
        return Ok(ProbabilityMap {
            width: 0,
            height: 0,
            probability: Vec::new(),
        });
    }
    let logits = network.forward(&Rows(picture))?;
    // Softmax over two channels is the logistic function of their difference.
    let cells = logits.data.par_chunks_exact(COARSE_CHANNELS);
    let probability = cells
        .map(|cell| 1.0 / (1.0 + (cell[1 - COARSE_FASTENER] - cell[COARSE_FASTENER]).exp()))
        .collect();
    Ok(ProbabilityMap {
        width: logits.w,
        height: logits.h,
        probability,
    })
}

/// Thresholds the map, filters its components by area, and takes their well-separated local maxima.
///
/// # Returns
/// The candidates, most probable first.
pub fn candidates(map: &ProbabilityMap, thresholds: &Thresholds) -> Vec<Candidate> {
    let inside = |x: usize, y: usize| map.probability[y * map.width + x] >= thresholds.coarse; // false for NaN
    let mut found = Vec::new();
    for runs in components(map.width, map.height, inside) {
        let cells = area(&runs);
        if cells >= thresholds.coarse_min_cells.max(1) {
            peaks(map, &runs, cells, &mut found);
        }
    }
    suppress(
        found,
        |c| [c.pixel.u_px, c.pixel.v_px],
        |c| c.score,
        |_, _| APART * NOMINAL_HEAD_PX,
        MOST,
    )
}

/// Adds the local maxima of the smoothed probability in a component.
fn peaks(map: &ProbabilityMap, runs: &[Run], cells: usize, found: &mut Vec<Candidate>) {
    let first = found.len();
    let smooth = |x: usize, y: usize| smoothed(map, x, y);
    for run in runs {
        for x in run.start..run.end {
            let here = smooth(x, run.y);
            let mut highest = true;
            for dy in -1..=1i64 {
                for dx in -1..=1i64 {
                    let (nx, ny) = (x as i64 + dx, run.y as i64 + dy);
                    if (dx, dy) == (0, 0) || nx < 0 || ny < 0 || nx >= map.width as i64 || ny >= map.height as i64 {
                        continue;
                    }
                    let there = smooth(nx as usize, ny as usize);
                    // On a plateau the last cell wins, so that there is exactly one.
                    highest &= there < here || (there == here && (dy, dx) < (0, 0));
                }
            }
            if highest {
                found.push(Candidate {
                    pixel: centroid(map, x, run.y),
                    score: here,
                    area_px: 0.0,
                });
            }
        }
    }
    let share = (cells * STRIDE * STRIDE) as f64 / (found.len() - first).max(1) as f64;
    for candidate in &mut found[first..] {
        candidate.area_px = share;
    }
}

/// Mean over 5 x 5 cells; beyond the border there is nothing.
fn smoothed(map: &ProbabilityMap, x: usize, y: usize) -> f32 {
    let mut sum = 0.0;
    for_square(map, x, y, 2, |_, _, p| sum += p);
    sum / 25.0
}

/// Probability-weighted centroid of the cells around a peak.
fn centroid(map: &ProbabilityMap, x: usize, y: usize) -> Pixel<space::Clip> {
    let (mut u, mut v, mut sum) = (0.0, 0.0, 0.0);
    for_square(map, x, y, 2, |x, y, p| {
        let p = f64::from(p);
        u += p * x as f64;
        v += p * y as f64;
        sum += p;
    });
    let (u, v) = if sum > 0.0 {
        (u / sum, v / sum)
    } else {
        (x as f64, y as f64)
    };
    Pixel::new(u * STRIDE as f64, v * STRIDE as f64)
}

fn for_square(map: &ProbabilityMap, x: usize, y: usize, reach: usize, mut each: impl FnMut(usize, usize, f32)) {
    for ny in y.saturating_sub(reach)..(y + reach + 1).min(map.height) {
        for nx in x.saturating_sub(reach)..(x + reach + 1).min(map.width) {
            each(nx, ny, map.probability[ny * map.width + nx]);
        }
    }
}

/// Keeps what is not nearer than `apart` to something with a higher score, at most `most` of it.
pub(crate) fn suppress<T>(
    mut items: Vec<T>,
    place: impl Fn(&T) -> [f64; 2],
    score: impl Fn(&T) -> f32,
    apart: impl Fn(&T, &T) -> f64,
    most: usize,
) -> Vec<T> {
    items.sort_by(|a, b| score(b).total_cmp(&score(a))); // stable: ties keep the picture's order
    let mut kept: Vec<T> = Vec::new();
    for item in items {
        let [u, v] = place(&item);
        let free = kept.iter().all(|k| {
            let [ku, kv] = place(k);
            (u - ku).hypot(v - kv) >= apart(k, &item)
        });
        if free {
            kept.push(item);
        }
        if kept.len() == most {
            break;
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(rows: &[&str]) -> ProbabilityMap {
        ProbabilityMap {
            width: rows[0].len(),
            height: rows.len(),
            probability: rows
                .iter()
                .flat_map(|r| {
                    r.bytes()
                        .map(|b| if b == b'.' { 0.0 } else { f32::from(b - b'0') / 10.0 })
                })
                .collect(),
        }
    }

    #[test]
    fn a_merged_blob_gives_two_candidates_and_a_speck_none() {
        let mut blob = vec![vec![b'.'; 40]; 12];
        for (cx, cy) in [(8.0, 5.0), (15.0, 6.0)] {
            for (y, row) in blob.iter_mut().enumerate() {
                for (x, cell) in row.iter_mut().enumerate() {
                    if (x as f64 - cx).hypot(y as f64 - cy) < 3.6 {
                        *cell = b'9';
                    }
                }
            }
        }
        blob[10][35] = b'9'; // one cell: below the area filter
        let rows: Vec<&str> = blob.iter().filter_map(|r| std::str::from_utf8(r).ok()).collect();
        let mut found = candidates(&map(&rows), &Thresholds::default());
        found.sort_by(|a, b| a.pixel.u_px.total_cmp(&b.pixel.u_px));
        assert_eq!(found.len(), 2, "{found:?}");
        for (candidate, at) in found.iter().zip([[32.0, 20.0], [60.0, 24.0]]) {
            let off = (candidate.pixel.u_px - at[0]).hypot(candidate.pixel.v_px - at[1]);
            assert!(off < 5.0, "{candidate:?} should be at {at:?}");
        }
    }

    #[test]
    fn suppression_keeps_the_best_of_a_crowd() {
        let crowd = vec![(0.0, 0.5f32), (3.0, 0.9), (9.0, 0.8), (30.0, 0.1)];
        let kept = suppress(crowd, |c| [c.0, 0.0], |c| c.1, |_, _| 8.0, 9);
        assert_eq!(kept, [(3.0, 0.9), (30.0, 0.1)]);
    }

    #[test]
    fn nothing_gives_nothing() {
        let empty = ProbabilityMap {
            width: 0,
            height: 0,
            probability: vec![],
        };
        assert!(candidates(&empty, &Thresholds::default()).is_empty());
        assert!(candidates(&map(&["."]), &Thresholds::default()).is_empty());
        assert!(
            candidates(
                &map(&["N"]),
                &Thresholds {
                    coarse: f32::NAN,
                    ..Default::default()
                }
            )
            .is_empty()
        );
    }
}
