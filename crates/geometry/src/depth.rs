//! Registered depth and how to read it at a sub-pixel point in spite of holes and edges.

use crate::{Camera, CameraModel, Direction, Pixel, Point};

/// z along the optical axis for every `step` x `step` block of colour pixels; 0 is "no measurement".
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Colour pixels per depth pixel along each axis (1: same resolution).
    pub step: u32,
    /// Depth, mm, row by row.
    pub depth_mm: Vec<f32>,
}

/// Depth of a surface at a pixel, from the neighbourhood.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceSample {
    /// Depth of the fitted plane at the pixel, mm.
    pub depth_mm: f64,
    /// Standard error of that depth, mm.
    pub sigma_mm: f64,
    /// Slope of the plane: change of depth per colour pixel along u and v, mm/px.
    pub slope_mm_per_px: [f64; 2],
    /// Measurements that agree with the plane.
    pub inliers: usize,
}

impl SurfaceSample {
    /// Depth of the plane so many pixels from where it was fitted, mm.
    pub fn depth_at_mm(&self, [du, dv]: [f64; 2]) -> f64 {
        let [along_u, along_v] = self.slope_mm_per_px;
        self.depth_mm + along_u * du + along_v * dv
    }

    /// Normal of the plane, against the viewing ray.
    ///
    /// # Arguments
    /// * `pixel` – where it was fitted.
    pub fn normal(&self, camera: &CameraModel, pixel: Pixel) -> Option<Direction<Camera>> {
        let at = |du: f64, dv: f64| {
            let pixel = Pixel::new(pixel.u_px + du, pixel.v_px + dv);
            camera.unproject(pixel, self.depth_at_mm([du, dv])).vector()
        };
        let middle = at(0.0, 0.0);
        let normal = (at(4.0, 0.0) - middle).cross(&(at(0.0, 4.0) - middle));
        Direction::from_vector(if normal.dot(&middle) > 0.0 { -normal } else { normal })
    }
}

impl DepthMap {
    /// Colour pixel at the centre of depth pixel (i, j): pixel areas aligned.
    pub fn color_pixel(&self, i: u32, j: u32) -> Pixel {
        let half = (f64::from(self.step) - 1.0) / 2.0;
        Pixel::new(f64::from(i * self.step) + half, f64::from(j * self.step) + half)
    }

    /// The measurement at depth pixel (i, j), `None` where there is none.
    pub fn at(&self, i: u32, j: u32) -> Option<f64> {
        let z = *self.depth_mm.get((j * self.width + i) as usize)?;
        (i < self.width && z.is_finite() && z > 0.0).then_some(f64::from(z))
    }

    /// Depth of the surface around a sub-pixel point: a robust plane through the measurements between `inner_px` and
    /// `outer_px` (colour pixels) of it, evaluated at the point. Holes are left out, edges are rejected (least median
    /// start over candidate planes, then reweighted least squares). `None` if fewer than 12 measurements agree.
    ///
    /// An annulus that spares the recess (`inner_px` > 0) avoids the bias of the slot's floor.
    pub fn plane_at(&self, pixel: Pixel, inner_px: f64, outer_px: f64) -> Option<SurfaceSample> {
        let points = self.neighbourhood(pixel, inner_px, outer_px);
        fit_plane(&points)
    }

    /// Measurements (du_px, dv_px, depth_mm) around a pixel.
    pub fn neighbourhood(&self, pixel: Pixel, inner_px: f64, outer_px: f64) -> Vec<[f64; 3]> {
        let step = f64::from(self.step);
        let half = (step - 1.0) / 2.0;
        let low = |c: f64| (((c - outer_px - half) / step).floor().max(0.0)) as u32;
        let high = |c: f64, n: u32| (((c + outer_px - half) / step).ceil().max(-1.0) + 1.0).min(f64::from(n)) as u32;
        let mut points = Vec::new();
        for j in low(pixel.v_px)..high(pixel.v_px, self.height) {
            for i in low(pixel.u_px)..high(pixel.u_px, self.width) {
                let at = self.color_pixel(i, j);
                let r = at.distance_px(&pixel);
                if r >= inner_px
                    && r <= outer_px
                    && let Some(z) = self.at(i, j)
                {
                    points.push([at.u_px - pixel.u_px, at.v_px - pixel.v_px, z]);
                }
            }
        }
        points
    }
}

/// Fewest agreeing measurements for a plane that may be trusted.
const MIN_INLIERS: usize = 12;
/// Points at most that a median is taken over.
const MEDIAN_POINTS: usize = 160;

fn fit_plane(points: &[[f64; 3]]) -> Option<SurfaceSample> {
    if points.len() < MIN_INLIERS {
        return None;
    }
    // Start from the plane of a few spread triples with the smallest median deviation: withstands up to half outliers (edges).
    let n = points.len();
    let mut best: Option<(f64, [f64; 3])> = None;
    // A part of the points tells as well which plane is best.
    let part = n.div_ceil(MEDIAN_POINTS);
    let mut scratch = Vec::with_capacity(MEDIAN_POINTS);
    for k in 0..48usize {
        // a fixed low-discrepancy walk through the triples keeps the result deterministic
        let pick = |m: f64| (((k as f64 + 0.5) * m).fract() * n as f64) as usize;
        let triple = [
            points[pick(0.618_033_988_7)],
            points[pick(0.754_877_666_2)],
            points[pick(0.569_840_290_9)],
        ];
        let Some(plane) = through(&triple) else { continue };
        scratch.clear();
        scratch.extend(points.iter().step_by(part).map(|p| residual(&plane, p).abs()));
        let mid = scratch.len() / 2;
        let (_, median, _) = scratch.select_nth_unstable_by(mid, f64::total_cmp);
        if best.as_ref().is_none_or(|(m, _)| *median < *m) {
            best = Some((*median, plane));
        }
    }
    let (median, mut plane) = best?;
    let mut scale = (1.4826 * median).max(0.02);
    let mut inliers = 0;
    let mut covariance = 0.0;
    for _ in 0..6 {
        let limit = 2.5 * scale;
        let mut a = nalgebra::Matrix3::<f64>::zeros();
        let mut b = nalgebra::Vector3::<f64>::zeros();
        inliers = 0;
        for p in points {
            let r = residual(&plane, p);
            if r.abs() > limit {
                continue;
            }
            let w = (1.0 - (r / limit).powi(2)).powi(2);
            let row = nalgebra::Vector3::new(1.0, p[0], p[1]);
            a += row * row.transpose() * w;
            b += row * (p[2] * w);
            inliers += 1;
        }
        if inliers < MIN_INLIERS {
            return None;
        }
        let inverse = a.try_inverse()?;
        let solution = inverse * b;
        plane = [solution.x, solution.y, solution.z];
        covariance = inverse[(0, 0)];
        let (mut sum, mut count) = (0.0, 0usize);
        for p in points {
            let r = residual(&plane, p);
            if r.abs() <= limit {
                sum += r * r;
                count += 1;
            }
        }
        scale = (sum / (count.saturating_sub(3).max(1)) as f64)
            .sqrt()
            .clamp(0.02, scale * 1.5);
    }
    Some(SurfaceSample {
        depth_mm: plane[0],
        sigma_mm: scale * covariance.max(0.0).sqrt(),
        slope_mm_per_px: [plane[1], plane[2]],
        inliers,
    })
}

fn residual(plane: &[f64; 3], p: &[f64; 3]) -> f64 {
    p[2] - (plane[0] + plane[1] * p[0] + plane[2] * p[1])
}

fn through([a, b, c]: &[[f64; 3]; 3]) -> Option<[f64; 3]> {
    let (u1, v1, z1) = (b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    let (u2, v2, z2) = (c[0] - a[0], c[1] - a[1], c[2] - a[2]);
    let det = u1 * v2 - u2 * v1;
    if det.abs() < 4.0 {
        return None; // nearly collinear: would extrapolate wildly
    }
    let gu = (z1 * v2 - z2 * v1) / det;
    let gv = (u1 * z2 - u2 * z1) / det;
    Some([a[2] - gu * a[0] - gv * a[1], gu, gv])
}

impl DepthMap {
    /// The integer factor between a colour and a depth size, `None` if there is none.
    pub fn step_between(color: (u32, u32), depth: (u32, u32)) -> Option<u32> {
        (1..=8).find(|s| {
            (depth.0 == color.0 / s || depth.0 == color.0.div_ceil(*s))
                && (depth.1 == color.1 / s || depth.1 == color.1.div_ceil(*s))
        })
    }

    /// Depth of a surface point in the camera frame at `pixel`, see [`plane_at`](Self::plane_at).
    pub fn point_at(
        &self,
        camera: &CameraModel,
        pixel: Pixel,
        inner_px: f64,
        outer_px: f64,
    ) -> Option<(Point<Camera>, SurfaceSample)> {
        let sample = self.plane_at(pixel, inner_px, outer_px)?;
        Some((camera.unproject(pixel, sample.depth_mm), sample))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tilted(noise_mm: f32) -> DepthMap {
        let (width, height) = (120, 90);
        let depth_mm = (0..width * height)
            .map(|k| {
                let (i, j) = (k % width, k / width);
                let noise = ((k as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f32 / 16_777_216.0 - 0.5;
                1500.0 + 0.05 * (2 * i) as f32 - 0.03 * (2 * j) as f32 + noise * noise_mm * 3.46
            })
            .collect();
        DepthMap {
            width,
            height,
            step: 2,
            depth_mm,
        }
    }

    #[test]
    fn reads_the_plane_between_pixels() {
        let map = tilted(0.0);
        let pixel = Pixel::new(100.25, 80.75);
        let sample = map.plane_at(pixel, 0.0, 14.0).expect("plenty of points");
        // depth pixel (i, j) lies at colour (2i + 0.5, 2j + 0.5)
        let truth = 1500.0 + 0.05 * (100.25 - 0.5) - 0.03 * (80.75 - 0.5);
        assert!((sample.depth_mm - truth).abs() < 1e-3, "{sample:?} {truth}");
        assert!((sample.slope_mm_per_px[0] - 0.05).abs() < 1e-3);
    }

    #[test]
    fn holes_and_an_edge_do_not_matter() {
        let mut map = tilted(0.28);
        for j in 0..map.height {
            for i in 0..map.width {
                let k = (j * map.width + i) as usize;
                if i > 53 {
                    map.depth_mm[k] += 60.0; // background behind an edge, 7 px right of the point
                }
                if (i + j) % 3 == 0 {
                    map.depth_mm[k] = 0.0;
                }
            }
        }
        let sample = map
            .plane_at(Pixel::new(100.0, 80.0), 0.0, 16.0)
            .expect("enough points left");
        let truth = 1500.0 + 0.05 * 99.5 - 0.03 * 79.5;
        assert!((sample.depth_mm - truth).abs() < 0.25, "{sample:?} {truth}");
        assert!(sample.sigma_mm > 0.01 && sample.sigma_mm < 0.2, "{sample:?}");
    }

    #[test]
    fn nothing_there_is_none() {
        let mut map = tilted(0.1);
        map.depth_mm.fill(0.0);
        assert!(map.plane_at(Pixel::new(100.0, 80.0), 0.0, 16.0).is_none());
        assert!(tilted(0.1).plane_at(Pixel::new(5000.0, 80.0), 0.0, 16.0).is_none());
    }
}
