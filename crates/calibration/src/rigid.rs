//! The rigid start of every fit: are these pairs what they say, and which motion do most of them agree on?

use crate::Pair;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::collections::HashSet;

/// Why pairs give no map, and what to do about it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// Not enough visits with a marker.
    #[error("{have} usable pairs are too few for method '{method}', which needs {need}; visit more points")]
    TooFew {
        /// Pairs with a marker.
        have: usize,
        /// Pairs that the method needs.
        need: usize,
        /// The method.
        method: &'static str,
    },
    /// Two pairs with the same id.
    #[error("id {id} occurs twice; a visit may be used once")]
    DuplicateId {
        /// The id.
        id: u64,
    },
    /// A pair with NaN or an infinite number.
    #[error("pair {id} is valid but holds a number that is not finite; mark it as not valid")]
    NotFinite {
        /// The id.
        id: u64,
    },
    /// A length that is a thousand times too small.
    #[error("'{column}' looks like metres ({value:.3}); all lengths are millimetres, multiply it by 1000")]
    Metres {
        /// The columns.
        column: &'static str,
        /// A typical value that is there.
        value: f64,
    },
    /// Columns that contradict each other.
    #[error("columns '{first}' and '{second}' seem to be swapped: {reason}")]
    Swapped {
        /// One column.
        first: &'static str,
        /// The other.
        second: &'static str,
        /// What gives it away.
        reason: &'static str,
    },
    /// All points in a plane or on a line.
    #[error(
        "all points lie within {thickness_mm:.2} mm of a plane; spread them over the volume, at least {need_mm:.0} mm in each direction"
    )]
    Coplanar {
        /// Spread across the plane, mm.
        thickness_mm: f64,
        /// Spread that is needed, mm.
        need_mm: f64,
    },
    /// One frame is the mirror image of the other.
    #[error(
        "camera and robot are mirror images of each other (off by {rigid_mm:.1} mm as they are, {mirrored_mm:.1} mm mirrored): one axis has the wrong sign or two of the 'cmd_' or 'cam_' columns are swapped"
    )]
    Mirrored {
        /// Median residual of the best proper motion, mm.
        rigid_mm: f64,
        /// Median residual with one axis turned round, mm.
        mirrored_mm: f64,
    },
    /// Joint angles of another arm than was said.
    #[error(
        "the joint angles are not those of a GP25 whose tool keeps its direction: they put the wrist {scatter_mm:.1} mm (rms) off the commands; are q1_rad to q6_rad radians, J1 first? For another arm leave `--arm gp25` out"
    )]
    NotThisArm {
        /// Scatter of the vector from wrist to marker, mm.
        scatter_mm: f64,
    },
    /// No motion explains the pairs.
    #[error(
        "no rigid motion explains the pairs: half of them are off by more than {median_mm:.1} mm; are the rows shifted against each other, columns swapped, or two cameras mixed?"
    )]
    NotRigid {
        /// Median residual of the best motion, mm.
        median_mm: f64,
    },
}

/// The valid pairs as bare vectors: camera and command, mm, with their place in the slice that they came from.
pub(crate) struct Points {
    pub(crate) index: Vec<usize>,
    pub(crate) camera: Vec<Vector3<f64>>,
    pub(crate) command: Vec<Vector3<f64>>,
}

/// Collects what can be used and refuses what cannot be meant.
pub(crate) fn usable(pairs: &[Pair], need: usize, method: &'static str) -> Result<Points, FitError> {
    let mut ids = HashSet::new();
    let mut points = Points {
        index: Vec::new(),
        camera: Vec::new(),
        command: Vec::new(),
    };
    for (index, pair) in pairs.iter().enumerate() {
        if !ids.insert(pair.id) {
            return Err(FitError::DuplicateId { id: pair.id });
        }
        if !pair.valid {
            continue;
        }
        let camera = pair.camera.filter(|c| c.is_finite());
        let (Some(camera), true) = (camera, pair.command.is_finite()) else {
            return Err(FitError::NotFinite { id: pair.id });
        };
        points.index.push(index);
        points.camera.push(camera.vector());
        points.command.push(pair.command.vector());
    }
    let have = points.index.len();
    if have < need {
        return Err(FitError::TooFew { have, need, method });
    }
    check_units(pairs, &points)?;
    check_columns(pairs, &points)?;
    Ok(points)
}

fn check_units(pairs: &[Pair], points: &Points) -> Result<(), FitError> {
    let (camera, command) = (typical_radius(&points.camera), typical_radius(&points.command));
    let z = median(points.camera.iter().map(|c| c.z).collect());
    // nothing can be calibrated 20 mm in front of a lens, and no arm's work fits in a thimble
    let scale = |small: f64, large: f64| (200.0..5000.0).contains(&(large / small));
    if scale(camera, command) || (z.abs() < 20.0 && camera < 5.0) {
        return Err(FitError::Metres {
            column: "cam_*_mm",
            value: z,
        });
    }
    if scale(command, camera) {
        return Err(FitError::Metres {
            column: "cmd_*_mm",
            value: points.command[0].x,
        });
    }
    let depths: Vec<f64> = pairs.iter().filter(|p| p.valid).filter_map(|p| p.depth_mm).collect();
    if let Some(&value) = depths.first()
        && scale(median(depths), z)
    {
        return Err(FitError::Metres {
            column: "depth_mm",
            value,
        });
    }
    Ok(())
}

/// `depth_mm` is `cam_z_mm` under another name, and `u_px` grows with `cam_x_mm`: enough to notice exchanged columns.
fn check_columns(pairs: &[Pair], points: &Points) -> Result<(), FitError> {
    let valid = || pairs.iter().filter(|p| p.valid);
    // depth_mm, then the columns that it could stand beside
    let rows: Vec<[f64; 7]> = valid()
        .filter_map(|p| {
            let ([x, y, z], [a, b, c]) = (p.camera?.to_array(), p.command.to_array());
            Some([p.depth_mm?, z, x, y, a, b, c])
        })
        .collect();
    if !rows.is_empty() {
        let off = |column: usize| median(rows.iter().map(|row| (row[0] - row[column]).abs()).collect());
        let columns = ["cam_x_mm", "cam_y_mm", "cmd_x_mm", "cmd_y_mm", "cmd_z_mm"];
        let closest = columns
            .into_iter()
            .zip((2..).map(off))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        let as_it_should = off(1);
        if let Some((second, distance)) = closest
            && as_it_should > 5.0
            && distance < 2.0
        {
            return Err(FitError::Swapped {
                first: "cam_z_mm",
                second,
                reason: "depth_mm equals the other one",
            });
        }
    }
    let rays: Vec<_> = valid()
        .filter_map(|p| Some((p.pixel?, p.camera?)))
        .map(|(px, c)| [px.u_px, px.v_px, c.x_mm() / c.z_mm(), c.y_mm() / c.z_mm()])
        .collect();
    if rays.len() >= 8 {
        let c = |a: usize, b: usize| correlation(rays.iter().map(|r| (r[a], r[b])));
        if c(0, 3) > 0.9 && c(1, 2) > 0.9 && c(0, 2) < 0.5 && c(1, 3) < 0.5 {
            // exchanged coordinates mirror the frame, exchanged pixels do not
            let (first, second) = match robust_rigid(points) {
                Err(FitError::Mirrored { .. }) => ("cam_x_mm", "cam_y_mm"),
                _ => ("u_px", "v_px"),
            };
            return Err(FitError::Swapped {
                first,
                second,
                reason: "u grows with cam_y and v with cam_x",
            });
        }
    }
    Ok(())
}

/// The motion that most pairs agree on, and whether they do. Starts from the candidate with the least median residual
/// (Rousseeuw 1984), which half the pairs may contradict, then reweighted least squares.
pub(crate) fn robust_rigid(points: &Points) -> Result<Isometry3<f64>, FitError> {
    let (motion, median_mm) = least_median(&points.camera, &points.command);
    let limit_mm = 0.03 * typical_radius(&points.command);
    if median_mm > limit_mm {
        let mirrored: Vec<_> = points.camera.iter().map(|c| Vector3::new(-c.x, c.y, c.z)).collect();
        let (_, mirrored_mm) = least_median(&mirrored, &points.command);
        return Err(if mirrored_mm < limit_mm {
            FitError::Mirrored {
                rigid_mm: median_mm,
                mirrored_mm,
            }
        } else {
            FitError::NotRigid { median_mm }
        });
    }
    // only points that agree can span the volume: one gross outlier must not hide a plane
    let agree = |cloud: &[Vector3<f64>]| -> Vec<Vector3<f64>> {
        let all = points.camera.iter().zip(&points.command).zip(cloud);
        all.filter(|((f, t), _)| (motion * Point3::from(**f) - Point3::from(**t)).norm() < 2.0 * limit_mm)
            .map(|(_, p)| *p)
            .collect()
    };
    for cloud in [&points.camera, &points.command] {
        let spread = principal_spread(&agree(cloud));
        let need_mm = (0.02 * spread[0]).max(0.5);
        if spread[2] < need_mm {
            return Err(FitError::Coplanar {
                thickness_mm: spread[2],
                need_mm,
            });
        }
    }
    Ok(motion)
}

pub(crate) fn least_median(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> (Isometry3<f64>, f64) {
    let n = from.len();
    let residuals = |m: &Isometry3<f64>| -> Vec<f64> {
        from.iter()
            .zip(to)
            .map(|(f, t)| (m.transform_vector(f) + m.translation.vector - t).norm())
            .collect()
    };
    let mut best = kabsch(from, to, &vec![1.0; n]);
    let mut least = median(residuals(&best));
    for trial in 0..200 {
        // a fixed low-discrepancy walk through the quadruples keeps the result deterministic
        let pick = |m: f64| (((f64::from(trial) + 0.5) * m).fract() * n as f64) as usize;
        let quad = [0.856_674_884, 0.733_891_856, 0.628_706_721, 0.538_597_255].map(pick);
        let (f, t) = (quad.map(|q| from[q]), quad.map(|q| to[q]));
        let motion = kabsch(&f, &t, &[1.0; 4]);
        let m = median(residuals(&motion));
        if m < least {
            (best, least) = (motion, m);
        }
    }
    for _ in 0..10 {
        let r = residuals(&best);
        let limit = (6.0 * median(r.clone())).max(1e-9);
        let weights: Vec<f64> = r.iter().map(|r| (1.0 - (r / limit).powi(2)).max(0.0).powi(2)).collect();
        best = kabsch(from, to, &weights);
    }
    let m = median(residuals(&best));
    (best, m)
}

/// The rigid motion with the least weighted square error (Kabsch 1976, Umeyama 1991); never a reflection.
pub(crate) fn kabsch(from: &[Vector3<f64>], to: &[Vector3<f64>], weights: &[f64]) -> Isometry3<f64> {
    let total: f64 = weights.iter().sum::<f64>().max(1e-12);
    let centre = |cloud: &[Vector3<f64>]| cloud.iter().zip(weights).map(|(p, w)| p * *w).sum::<Vector3<f64>>() / total;
    let (cf, ct) = (centre(from), centre(to));
    let mut cross = Matrix3::zeros();
    for ((f, t), w) in from.iter().zip(to).zip(weights) {
        cross += (t - ct) * (f - cf).transpose() * *w;
    }
    let svd = cross.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Isometry3::from_parts(Translation3::from(ct - cf), UnitQuaternion::identity());
    };
    let proper = Vector3::new(1.0, 1.0, (u * v_t).determinant().signum());
    let rotation = u * Matrix3::from_diagonal(&proper) * v_t;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Isometry3::from_parts(Translation3::from(ct - rotation * cf), rotation)
}

/// Standard deviations along the principal axes, largest first, mm.
fn principal_spread(cloud: &[Vector3<f64>]) -> [f64; 3] {
    let n = cloud.len().max(1) as f64;
    let mean = cloud.iter().sum::<Vector3<f64>>() / n;
    let covariance = cloud
        .iter()
        .map(|p| (p - mean) * (p - mean).transpose())
        .sum::<Matrix3<f64>>()
        / n;
    let mut spread: [f64; 3] = covariance.symmetric_eigenvalues().map(|v| v.max(0.0).sqrt()).into();
    spread.sort_by(|a, b| b.total_cmp(a));
    spread
}

/// Median distance from the componentwise median: an extent that outliers do not move, mm.
fn typical_radius(cloud: &[Vector3<f64>]) -> f64 {
    let centre = Vector3::from_fn(|a, _| median(cloud.iter().map(|p| p[a]).collect()));
    median(cloud.iter().map(|p| (p - centre).norm()).collect()).max(1e-9)
}

fn correlation(xy: impl Iterator<Item = (f64, f64)> + Clone) -> f64 {
    let n = xy.clone().count() as f64;
    let (mx, my) = xy.clone().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / n, b + y / n));
    let (sxy, sxx, syy) = xy.fold((0.0, 0.0, 0.0), |(a, b, c), (x, y)| {
        (a + (x - mx) * (y - my), b + (x - mx).powi(2), c + (y - my).powi(2))
    });
    sxy / (sxx * syy).sqrt().max(1e-300)
}

/// The middle value; 0 of nothing.
pub(crate) fn median(values: Vec<f64>) -> f64 {
    quantile(values, 0.5)
}

/// The value below which a share `q` lies, nearest rank; 0 of nothing.
pub(crate) fn quantile(mut values: Vec<f64>, q: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() as f64 * q).ceil() as usize).clamp(1, values.len()) - 1;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}
