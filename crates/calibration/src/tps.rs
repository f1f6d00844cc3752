//! A thin-plate spline of what a rigid motion leaves, smoothed by the least left-out error: what medical and photogrammetric tools use, to
//! compare with.

use crate::rigid::{self, kabsch};
use nalgebra::{DMatrix, Isometry3, Matrix3xX, Point3, SymmetricEigen, Vector3};

/// Length in which places are measured, mm.
const UNIT_MM: f64 = 500.0;
/// Smoothing that is tried: from none to an affine map.
const SMOOTHING: [f64; 12] = [1e-6, 1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0];

/// A spline over a rigid motion.
#[derive(Clone)]
pub(crate) struct Spline {
    motion: Isometry3<f64>,
    centre: Vector3<f64>,
    places: Vec<Vector3<f64>>,
    /// A weight for each place, then the affine part: 1, x, y, z.
    weights: Matrix3xX<f64>,
}

/// A spline, and what each point would have been off had it been left out, base frame, mm.
pub(crate) struct Fitted {
    pub(crate) spline: Spline,
    pub(crate) left_out: Vec<Vector3<f64>>,
}

impl Spline {
    /// The spline whose left-out errors are least; `None` if the points do not determine one.
    pub(crate) fn fit(camera: &[Vector3<f64>], command: &[Vector3<f64>]) -> Option<Fitted> {
        let n = camera.len();
        if n < 8 {
            return None;
        }
        let motion = kabsch(camera, command, &vec![1.0; n]);
        let centre = camera.iter().sum::<Vector3<f64>>() / n as f64;
        let places: Vec<_> = camera.iter().map(|c| (c - centre) / UNIT_MM).collect();
        let residuals = DMatrix::from_fn(n, 3, |i, a| (command[i] - (motion * Point3::from(camera[i])).coords)[a]);
        // in three dimensions the thin plate bends by the distance itself; what is affine costs nothing and is split off
        let kernel = DMatrix::from_fn(n, n, |i, j| -(places[i] - places[j]).norm());
        let affine = DMatrix::from_fn(n, 4, |i, k| if k == 0 { 1.0 } else { places[i][k - 1] });
        let free = complement(&affine)?;
        let eigen = SymmetricEigen::new(free.transpose() * &kernel * &free);
        let basis = &free * &eigen.eigenvectors;
        let seen = basis.transpose() * &residuals;
        let left_out = |smoothing: f64| -> Vec<Vector3<f64>> {
            let shrink = eigen.eigenvalues.map(|v| 1.0 / (v.max(0.0) + smoothing));
            let weights = &basis * DMatrix::from_fn(seen.nrows(), 3, |i, a| seen[(i, a)] * shrink[i]);
            // the residual of the fit is smoothing * weights; left out, it is larger by what the point itself had to say
            (0..n)
                .map(|i| {
                    let own: f64 = (0..shrink.len()).map(|k| basis[(i, k)].powi(2) * shrink[k]).sum();
                    Vector3::from_fn(|a, _| -weights[(i, a)] / own.max(1e-300))
                })
                .collect()
        };
        let square = |errors: &[Vector3<f64>]| rigid::median(errors.iter().map(Vector3::norm_squared).collect());
        let best = SMOOTHING
            .into_iter()
            .map(|s| (square(&left_out(s)), s))
            .min_by(|a, b| a.0.total_cmp(&b.0))?
            .1;
        let shrink = eigen.eigenvalues.map(|v| 1.0 / (v.max(0.0) + best));
        let bent = &basis * DMatrix::from_fn(seen.nrows(), 3, |i, a| seen[(i, a)] * shrink[i]);
        let rest = &residuals - &kernel * &bent - &bent * best;
        let flat = (affine.transpose() * &affine)
            .cholesky()?
            .solve(&(affine.transpose() * rest));
        let weights = Matrix3xX::from_fn(n + 4, |a, i| if i < n { bent[(i, a)] } else { flat[(i - n, a)] });
        Some(Fitted {
            left_out: left_out(best),
            spline: Self {
                motion,
                centre,
                places,
                weights,
            },
        })
    }

    /// Where a camera point is in the base frame.
    pub(crate) fn at(&self, camera: Vector3<f64>) -> Vector3<f64> {
        let place = (camera - self.centre) / UNIT_MM;
        let n = self.places.len();
        let column = |i: usize| self.weights.fixed_columns::<1>(i).into_owned();
        let mut base = (self.motion * Point3::from(camera)).coords + column(n);
        for a in 0..3 {
            base += column(n + 1 + a) * place[a];
        }
        for (i, at) in self.places.iter().enumerate() {
            base -= column(i) * (place - at).norm();
        }
        base
    }
}

/// An orthonormal basis of what is orthogonal to the columns.
fn complement(columns: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = columns.nrows();
    let projector =
        DMatrix::identity(n, n) - columns * (columns.transpose() * columns).cholesky()?.solve(&columns.transpose());
    let eigen = SymmetricEigen::new(projector);
    let kept: Vec<usize> = (0..n).filter(|&i| eigen.eigenvalues[i] > 0.5).collect();
    Some(DMatrix::from_fn(n, kept.len(), |i, k| eigen.eigenvectors[(i, kept[k])]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Vec<Vector3<f64>> {
        let at = |k: usize| Vector3::new((k % 4) as f64, (k / 4 % 4) as f64, (k / 16) as f64) * 200.0;
        (0..64).map(|k| at(k) + Vector3::new(0.0, 0.0, 1500.0)).collect()
    }

    #[test]
    fn an_affine_map_is_exact_and_a_bent_one_close() -> Result<(), Box<dyn std::error::Error>> {
        let camera = grid();
        let flat = |c: &Vector3<f64>| Vector3::new(c.x + 0.01 * c.y + 3.0, c.y - 7.0, c.z + 0.002 * c.x);
        let bent = |c: &Vector3<f64>| flat(c) + Vector3::new(0.0, 0.5 * (c.x / 300.0).sin(), 0.0);
        for (world, limit_mm) in [(&flat as &dyn Fn(&Vector3<f64>) -> Vector3<f64>, 1e-6), (&bent, 0.03)] {
            let command: Vec<_> = camera.iter().map(world).collect();
            let spline = Spline::fit(&camera, &command).ok_or("determined")?.spline;
            for shift in [0.0, 90.0, 250.0] {
                let c = Vector3::new(150.0 + shift, 310.0, 1720.0);
                let off = (spline.at(c) - world(&c)).norm();
                assert!(off < limit_mm, "{off}");
            }
        }
        Ok(())
    }

    #[test]
    fn left_out_errors_are_those_of_leaving_out() -> Result<(), Box<dyn std::error::Error>> {
        let camera = grid();
        // enough noise that the same smoothing is chosen without one point
        let noise = |k: usize| ((k * 7919 % 101) as f64 / 101.0 - 0.5) * 0.2;
        let bend = |c: &Vector3<f64>| 0.8 * (c.y / 250.0).cos();
        let command: Vec<_> = camera
            .iter()
            .enumerate()
            .map(|(k, c)| c + Vector3::new(noise(k), noise(k + 31), bend(c)))
            .collect();
        let fitted = Spline::fit(&camera, &command).ok_or("determined")?;
        let k = 21;
        let mut without = (camera.clone(), command.clone());
        without.0.remove(k);
        without.1.remove(k);
        let off = Spline::fit(&without.0, &without.1)
            .ok_or("determined")?
            .spline
            .at(camera[k])
            - command[k];
        assert!(
            (fitted.left_out[k] - off).norm() < 0.05 * off.norm().max(0.1),
            "{off:?} {:?}",
            fitted.left_out[k]
        );
        Ok(())
    }
}
