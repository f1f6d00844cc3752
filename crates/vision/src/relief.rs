//! The centre of a head from depth alone: the disc that stands out of its sheet. Rust, mud and shadows do not move it.

use std::ops::Range;

use geometry::{DepthMap, Pixel, SurfaceSample};

use crate::center::{CueCenter, paraboloid};

/// Radius within which a height has a say, in head diameters.
const REACH: f64 = 0.95;
/// The head's top, whose height is that of the disc, in head diameters.
const TOP: f64 = 0.35;
/// Lower than this nothing stands out of stereo's noise, mm.
const LOWEST_MM: f64 = 0.8;
/// Fewest measurements of the top, and of all.
const ENOUGH: [usize; 2] = [8, 40];
/// Width of the slope at a head's edge, in pixels of the depth: what the matching window makes of it.
const EDGE: f64 = 3.0;
/// Radii of the disc that are tried first, in head diameters, and the least and the largest that is a head's.
const RADII: [f64; 3] = [0.42, 0.5, 0.58];
const HEADS: Range<f64> = 0.35..0.7;
/// How far from where it is looked for the centre may be, in head diameters.
const MAX_OFF: f64 = 0.22;
/// Difference from the disc, in its height, from which a measurement is of something else.
const CAP: f32 = 0.8;

/// Finds the centre of the disc that stands out of the sheet near a place.
///
/// # Arguments
/// * `sheet` – the sheet at `start` ([`RimProfile`](crate::RimProfile) has it).
/// * `start` – the centre so far, good to about 0.2 diameters.
/// * `diameter_px` – of the head, good to about 15 %.
///
/// # Returns
/// `None` where depth is missing or no disc of a head's size stands out.
pub fn relief(depth: &DepthMap, sheet: &SurfaceSample, start: Pixel, diameter_px: f64) -> Option<CueCenter> {
    let above = depth.neighbourhood(start, 0.0, REACH * diameter_px);
    let heights: Vec<[f64; 3]> = above
        .iter()
        .map(|&[u, v, z]| [u, v, sheet.depth_at_mm([u, v]) - z])
        .collect();
    let is_top = |[u, v, _]: &&[f64; 3]| u.hypot(*v) < TOP * diameter_px;
    let mut top: Vec<f64> = heights.iter().filter(is_top).map(|p| p[2]).collect();
    if top.len() < ENOUGH[0] || heights.len() < ENOUGH[1] {
        return None;
    }
    let middle = top.len() / 2;
    let top_mm = *top.select_nth_unstable_by(middle, f64::total_cmp).1;
    if top_mm < LOWEST_MM {
        return None;
    }
    let heights = Heights::above(&heights, top_mm, EDGE * f64::from(depth.step));
    let cost = |[u, v, radius]: [f64; 3]| heights.cost([u as f32, v as f32, radius as f32]);
    let mut best = (f64::MAX, [0.0; 3]);
    let mut step = (0.08 * diameter_px).max(1.0);
    let side = (MAX_OFF * diameter_px / step) as i64;
    for radius in RADII {
        for (i, j) in (-side..=side).flat_map(|i| (-side..=side).map(move |j| (i, j))) {
            let disc = [step * i as f64, step * j as f64, radius * diameter_px];
            best = nearer(best, (cost(disc), disc));
        }
    }
    while step > 0.2 {
        let before = best;
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let mut disc = before.1;
                disc[axis] += sign * step;
                best = nearer(best, (cost(disc), disc));
            }
        }
        if best.0 == before.0 {
            step *= 0.5;
        }
    }
    let (least, [u, v, radius]) = best;
    let peak = paraboloid(|du, dv| -cost([u + du, v + dv, radius]), 0.5)?;
    let at = [u + peak.dx.clamp(-0.5, 0.5), v + peak.dy.clamp(-0.5, 0.5)];
    if at[0].hypot(at[1]) > MAX_OFF * diameter_px || !HEADS.contains(&(radius / diameter_px)) {
        return None;
    }
    // least squares: variance = 2 * mean square of what is left / curvature
    let sigma_px = (2.0 * least / heights.count as f64 / peak.curvature).sqrt();
    Some(CueCenter {
        pixel: Pixel::new(start.u_px + at[0], start.v_px + at[1]),
        sigma_px: sigma_px.max(0.03),
    })
}

fn nearer(best: (f64, [f64; 3]), other: (f64, [f64; 3])) -> (f64, [f64; 3]) {
    if other.0 < best.0 { other } else { best }
}

/// Heights (1: the head's top, 0: the sheet) at places, px from where the head is looked for; so many beside each other as are added at once.
struct Heights {
    places: Vec<[[f32; LANES]; 3]>,
    count: usize,
    edge_px: f32,
}

const LANES: usize = 16;

impl Heights {
    fn above(points: &[[f64; 3]], top_mm: f64, edge_px: f64) -> Self {
        let lanes = |points: &[[f64; 3]]| {
            // what fills the last lanes up is a place on the sheet, far away: it costs nothing
            let mut lanes = [[1e3; LANES], [0.0; LANES], [0.0; LANES]];
            for (k, [u, v, height_mm]) in points.iter().enumerate() {
                for (lane, value) in lanes.iter_mut().zip([*u, *v, height_mm / top_mm]) {
                    lane[k] = value as f32;
                }
            }
            lanes
        };
        Self {
            places: points.chunks(LANES).map(lanes).collect(),
            count: points.len(),
            edge_px: edge_px as f32,
        }
    }

    /// Sum of squared differences from a disc of that centre and radius, each capped.
    fn cost(&self, [u, v, radius]: [f32; 3]) -> f64 {
        let mut sums = [0f32; LANES];
        let per_px = 1.0 / self.edge_px;
        for [x, y, height] in &self.places {
            for k in 0..LANES {
                let r = ((x[k] - u) * (x[k] - u) + (y[k] - v) * (y[k] - v)).sqrt();
                let disc = ((radius - r) * per_px + 0.5).clamp(0.0, 1.0);
                sums[k] += ((height[k] - disc) * (height[k] - disc)).min(CAP * CAP);
            }
        }
        f64::from(sums.iter().sum::<f32>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RimProfile;
    use crate::synthetic::gaussian;
    use geometry::CameraModel;

    const DIAMETER_PX: f64 = 30.0;

    /// A head so high on a sheet that leans, at half resolution, with stereo's noise.
    fn scene(at: Pixel, height_mm: f64, seed: u64) -> (DepthMap, CameraModel) {
        let mut random = 2 * seed + 1;
        let mut map = DepthMap {
            width: 100,
            height: 80,
            step: 2,
            depth_mm: vec![0.0; 8000],
        };
        for k in 0..map.depth_mm.len() {
            let p = map.color_pixel(k as u32 % map.width, k as u32 / map.width);
            let edge = (0.5 + (0.5 * DIAMETER_PX - p.distance_px(&at)) / 4.0).clamp(0.0, 1.0);
            let sheet = 1500.0 + 0.02 * p.u_px - 0.03 * p.v_px;
            map.depth_mm[k] = (sheet - height_mm * edge + 0.28 * gaussian(&mut random)) as f32;
        }
        (map, CameraModel::pinhole(200, 160, 4638.0, 4638.0))
    }

    fn found(depth: &DepthMap, camera: &CameraModel, start: Pixel, diameter_px: f64) -> Option<CueCenter> {
        let sheet = RimProfile::of(depth, camera, start, diameter_px)?.sheet;
        relief(depth, &sheet, start, diameter_px)
    }

    #[test]
    fn a_head_is_found_in_depth_alone() {
        let (mut errors, mut sigmas) = (0.0, 0.0);
        for k in 0..24 {
            let f = |m: f64| (f64::from(k + 1) * m).fract();
            let at = Pixel::new(95.0 + 10.0 * f(0.618), 75.0 + 10.0 * f(0.755));
            let (depth, camera) = scene(at, 2.0 + 2.0 * f(0.57), k as u64);
            let start = Pixel::new(at.u_px + 4.0 * f(0.31) - 2.0, at.v_px + 4.0 * f(0.47) - 2.0);
            let found = found(&depth, &camera, start, DIAMETER_PX * (0.9 + 0.2 * f(0.23))).expect("a head");
            let off_px = found.pixel.distance_px(&at);
            assert!(off_px < 1.5, "{k}: off by {off_px}, {found:?}");
            errors += off_px.powi(2);
            sigmas += 2.0 * found.sigma_px.powi(2);
        }
        let ratio = (errors / sigmas).sqrt();
        assert!((0.3..3.0).contains(&ratio), "true error over stated sigma: {ratio}");
        assert!((errors / 24.0).sqrt() < 0.6, "{errors}");
    }

    #[test]
    fn where_nothing_stands_out_there_is_no_cue() {
        let at = Pixel::new(100.0, 80.0);
        let (flat, camera) = scene(at, 0.2, 3);
        assert_eq!(found(&flat, &camera, at, DIAMETER_PX), None);
        let (mut none, camera) = scene(at, 3.0, 3);
        none.depth_mm.fill(0.0);
        assert_eq!(found(&none, &camera, at, DIAMETER_PX), None);
        let (aside, camera) = scene(Pixel::new(112.0, 80.0), 3.0, 3);
        assert_eq!(found(&aside, &camera, at, DIAMETER_PX), None);
    }
}
