//! Brown-Conrady (`plumb_bob`) camera model and its inverse.

use crate::{Camera, Pixel, Point};
use serde::{Deserialize, Serialize};

/// Pinhole with radial and tangential distortion (Brown 1966, Conrady 1919; ROS `plumb_bob`: k1 k2 p1 p2 k3).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraModel {
    /// Image width, px.
    pub width_px: u32,
    /// Image height, px.
    pub height_px: u32,
    /// Focal length along u, px.
    pub fx_px: f64,
    /// Focal length along v, px.
    pub fy_px: f64,
    /// Principal point, px.
    pub cx_px: f64,
    /// Principal point, px.
    pub cy_px: f64,
    /// Distortion k1, k2, p1, p2, k3 (no unit).
    pub distortion: [f64; 5],
}

impl CameraModel {
    /// A camera without distortion, principal point in the middle.
    pub fn pinhole(width_px: u32, height_px: u32, fx_px: f64, fy_px: f64) -> Self {
        Self {
            width_px,
            height_px,
            fx_px,
            fy_px,
            cx_px: (f64::from(width_px) - 1.0) / 2.0,
            cy_px: (f64::from(height_px) - 1.0) / 2.0,
            distortion: [0.0; 5],
        }
    }

    /// Normalised image coordinates (x/z, y/z) to distorted ones.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// The inverse of [`distort`](Self::distort), by Newton's method; exact to 1e-10 wherever the model is invertible.
    pub fn undistort(&self, distorted: [f64; 2]) -> [f64; 2] {
        if self.distortion == [0.0; 5] {
            return distorted;
        }
        let [mut x, mut y] = distorted;
        for _ in 0..20 {
            let d = self.distort([x, y]);
            let (ex, ey) = (d[0] - distorted[0], d[1] - distorted[1]);
            if ex.abs().max(ey.abs()) < 1e-13 {
                break;
            }
            let [[a, b], [c, e]] = self.distortion_jacobian([x, y]);
            let det = a * e - b * c;
            if det.abs() < 1e-9 {
                break;
            }
            x -= (e * ex - b * ey) / det;
            y -= (a * ey - c * ex) / det;
        }
        [x, y]
    }

    fn distortion_jacobian(&self, [x, y]: [f64; 2]) -> [[f64; 2]; 2] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3); // d radial / d r2
        let cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        [
            [radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, cross],
            [cross, radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x],
        ]
    }

    /// Where a point is seen; `None` at or behind the camera. May lie outside the picture: see [`contains`](Self::contains).
    pub fn project(&self, p: Point<Camera>) -> Option<Pixel> {
        if p.z_mm() <= 1e-6 {
            return None;
        }
        let [x, y] = self.distort([p.x_mm() / p.z_mm(), p.y_mm() / p.z_mm()]);
        Some(Pixel::new(self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px))
    }

    /// The viewing ray of a pixel, as (x/z, y/z).
    pub fn ray(&self, pixel: Pixel) -> [f64; 2] {
        self.undistort([
            (pixel.u_px - self.cx_px) / self.fx_px,
            (pixel.v_px - self.cy_px) / self.fy_px,
        ])
    }

    /// The point at depth `z_mm` (along the optical axis) that is seen at `pixel`.
    pub fn unproject(&self, pixel: Pixel, z_mm: f64) -> Point<Camera> {
        let [x, y] = self.ray(pixel);
        Point::new(x * z_mm, y * z_mm, z_mm)
    }

    /// True if the pixel lies in the picture.
    pub fn contains(&self, pixel: Pixel) -> bool {
        (-0.5..f64::from(self.width_px) - 0.5).contains(&pixel.u_px)
            && (-0.5..f64::from(self.height_px) - 0.5).contains(&pixel.v_px)
    }

    /// Size of a pixel at depth `z_mm`, mm.
    pub fn pixel_mm(&self, z_mm: f64) -> f64 {
        z_mm / (self.fx_px * self.fy_px).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lens() -> CameraModel {
        CameraModel {
            distortion: [-0.085, 0.07, -4e-4, 3e-4, 0.01],
            ..CameraModel::pinhole(4104, 3006, 4640.0, 4637.0)
        }
    }

    proptest! {
        #[test]
        fn unproject_inverts_project(u in 0.0..4103.0, v in 0.0..3005.0, z in 500.0..3000.0f64) {
            let camera = lens();
            let pixel = Pixel::new(u, v);
            let back = camera.project(camera.unproject(pixel, z)).expect("in front");
            prop_assert!(back.distance_px(&pixel) < 1e-6);
        }
    }

    #[test]
    fn known_distortion() {
        // one corner worked by hand: r2 = 0.25, radial = 1 - 0.085/4 + 0.07/16 + 0.01/64
        let [x, y] = lens().distort([0.4, 0.3]);
        let radial = 1.0 - 0.085 * 0.25 + 0.07 * 0.0625 + 0.01 * 0.015625;
        assert!((x - (0.4 * radial + 2.0 * -4e-4 * 0.12 + 3e-4 * (0.25 + 0.32))).abs() < 1e-12);
        assert!((y - (0.3 * radial + -4e-4 * (0.25 + 0.18) + 2.0 * 3e-4 * 0.12)).abs() < 1e-12);
    }

    #[test]
    fn behind_is_nowhere() {
        assert!(lens().project(Point::new(0.0, 0.0, -5.0)).is_none());
    }
}
