//! The capture of calibration pairs: an arm shows the marker at every place of a plan, the camera looks, every visit is a row.
//!
//! The jig carries its marker where the bit's tip would be, and the arm keeps the orientation in which it will work. Rows are
//! appended as they come, misses included, so that a capture that was cut off goes on where it ended.

use crate::capture::{Shot, region_around, shoot};
use crate::config::{Approach, Timeouts};
use crate::device::{DeviceError, Devices};
use crate::removal::Mover;
use calibration::{Pair, PairError, PairWriter, Target};
use geometry::{Base, Camera, Direction, Pixel, Point, Transform};
use image::{RgbImage, imageops::crop_imm};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::collections::HashSet;
use std::path::Path;
use vision::{LocatedMarker, MarkerError, MarkerSpec, locate_marker};

/// How to capture.
#[derive(Clone, Debug)]
pub struct CaptureSettings {
    /// Direction of the bit at every visit: that of the camera's view, as when screws are driven.
    pub approach: Direction<Base>,
    /// What the marker looks like.
    pub marker: MarkerSpec,
    /// Frames of depth that are averaged. A dense lattice averages over its neighbours and needs one; a hundred points need four.
    pub depth_frames: usize,
    /// Half width of the region that is read out once the marker's place can be predicted, px.
    pub region_px: f64,
    /// How long anything may take.
    pub timeouts: Timeouts,
}

impl CaptureSettings {
    /// The usual settings for a camera that looks along `approach`.
    pub fn along(approach: Direction<Base>) -> Self {
        Self {
            approach,
            marker: MarkerSpec::default(),
            depth_frames: 1,
            region_px: 85.0,
            timeouts: Timeouts::default(),
        }
    }
}

/// One visit, as the progress callback sees it.
#[derive(Clone, Copy, Debug)]
pub struct Visit<'a> {
    /// Visits done, this one and those of an earlier capture included.
    pub done: usize,
    /// Visits of the plan.
    pub of: usize,
    /// The row.
    pub pair: &'a Pair,
    /// Why there is no measurement, if there is none.
    pub miss: Option<&'a str>,
    /// What the camera saw around the marker, or where it should have been.
    pub picture: Option<&'a RgbImage>,
}

/// What a capture brought.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CaptureSummary {
    /// Rows in the file.
    pub visits: usize,
    /// Rows without a measurement.
    pub missed: usize,
    /// False if it was stopped before the end of the plan.
    pub complete: bool,
}

/// Why a capture ended early. What was captured is in the file.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// The file.
    #[error(transparent)]
    Pairs(#[from] PairError),
    /// A device.
    #[error("the capture stopped at visit {visit}: {source}; run it again to go on from there")]
    Device {
        /// Number of the visit.
        visit: u64,
        /// What the device said.
        source: DeviceError,
    },
    /// There is no such arm.
    #[error("the cell has no arm number {arm}; it has {arms}")]
    NoArm {
        /// What was asked for, from 0.
        arm: usize,
        /// How many there are.
        arms: usize,
    },
}

/// Visits every place of a plan with one arm and appends a row a visit to `path`; places whose ids are in the file are skipped.
///
/// # Arguments
/// * `arm` – number of the arm that carries the jig; the table is empty.
/// * `progress` – called after every row; returning false ends the capture there.
///
/// # Errors
/// [`CaptureError`]. A place that the arm refuses and a marker that is not found are rows, not errors.
pub async fn capture_pairs(
    devices: &Devices,
    arm: usize,
    plan: &[Target],
    settings: &CaptureSettings,
    path: &Path,
    mut progress: impl FnMut(&Visit<'_>) -> bool,
) -> Result<CaptureSummary, CaptureError> {
    let carrier = devices.arms.get(arm).ok_or(CaptureError::NoArm {
        arm,
        arms: devices.arms.len(),
    })?;
    let (mut writer, mut pairs) = if path.exists() {
        PairWriter::resume(path)?
    } else {
        (PairWriter::create(path)?, Vec::new())
    };
    let known: HashSet<u64> = pairs.iter().map(|p| p.id).collect();
    let mover = Mover {
        io: &devices.io,
        arm: carrier,
        approach: Approach::default(),
        timeouts: settings.timeouts,
        clock: &devices.clock,
        motion: None,
        room: None,
    };
    let mut complete = true;
    for target in plan.iter().filter(|t| !known.contains(&t.id)) {
        let stopped = |source| CaptureError::Device {
            visit: target.id,
            source,
        };
        let Visited { pair, miss, picture } = visit(devices, &mover, target, settings, &pairs)
            .await
            .map_err(stopped)?;
        writer.append(&pair)?;
        pairs.push(pair);
        let go_on = pairs.last().is_none_or(|pair| {
            progress(&Visit {
                done: pairs.len(),
                of: plan.len(),
                pair,
                miss: miss.as_deref(),
                picture: picture.as_ref(),
            })
        });
        if !go_on {
            complete = false;
            break;
        }
    }
    mover.home().await.map_err(|source| CaptureError::Device {
        visit: pairs.last().map_or(0, |p| p.id),
        source,
    })?;
    Ok(CaptureSummary {
        visits: pairs.len(),
        missed: pairs.iter().filter(|p| !p.valid).count(),
        complete,
    })
}

/// A row, why it holds no measurement if it holds none, and what was seen there.
struct Visited {
    pair: Pair,
    miss: Option<String>,
    picture: Option<RgbImage>,
}

async fn visit(
    devices: &Devices,
    mover: &Mover<'_>,
    target: &Target,
    settings: &CaptureSettings,
    before: &[Pair],
) -> Result<Visited, DeviceError> {
    let mut pair = Pair {
        id: target.id,
        node: target.node,
        t_s: devices.clock.now_s(),
        command: target.command,
        pixel: None,
        depth_mm: None,
        camera: None,
        joints_rad: None,
        valid: false,
    };
    match mover.visit(target.command, settings.approach).await {
        Ok(()) => {}
        Err(DeviceError::Refused { reason, .. }) => {
            return Ok(Visited {
                pair,
                miss: Some(format!("out of reach: {reason}")),
                picture: None,
            });
        }
        Err(error) => return Err(error),
    }
    let state = mover.ready().await?;
    pair.joints_rad = Some(state.joints_rad);
    let (t_s, seen, picture) = find(devices, target.command, settings, before).await?;
    pair.t_s = t_s;
    let miss = match seen {
        Ok((pixel, marker)) => {
            pair.pixel = Some(pixel);
            pair.depth_mm = Some(marker.depth_mm);
            pair.camera = Some(marker.point);
            pair.valid = true;
            None
        }
        Err(miss) => Some(miss.to_string()),
    };
    Ok(Visited { pair, miss, picture })
}

/// When it looked, the marker or why there is none, and what is around it.
type Look = (f64, Result<(Pixel, LocatedMarker), MarkerError>, Option<RgbImage>);

/// Looks for the marker where the earlier rows let it be expected, and in the whole picture if it is not there.
async fn find(
    devices: &Devices,
    command: Point<Base>,
    settings: &CaptureSettings,
    before: &[Pair],
) -> Result<Look, DeviceError> {
    let look = |shot: &Shot| locate_marker(&shot.frame, &settings.marker).map(|m| (shot.to_whole(m.marker.pixel), m));
    let camera = devices.color.intrinsics();
    let region = |pixel: Pixel| region_around(&camera, pixel, settings.region_px);
    let expected = predict(command, before).and_then(|point| camera.project(point));
    if let Some(region) = expected.and_then(region) {
        let shot = shoot(devices, Some(region), settings.depth_frames).await?;
        if let Ok(seen) = look(&shot) {
            return Ok((shot.frame.t_s, Ok(seen), Some(shot.frame.color)));
        }
    }
    // one whole picture tells where it is; the frames to average are those of its region
    let shot = shoot(devices, None, 1).await?;
    let seen = look(&shot);
    if let Some(region) = seen
        .as_ref()
        .ok()
        .and_then(|(pixel, _)| region(*pixel))
        .filter(|_| settings.depth_frames > 1)
    {
        let near = shoot(devices, Some(region), settings.depth_frames).await?;
        if let Ok(seen) = look(&near) {
            return Ok((near.frame.t_s, Ok(seen), Some(near.frame.color)));
        }
    }
    let at = seen.as_ref().map(|s| s.0).ok().or(expected);
    let picture = at.map(|at| {
        let corner = |c: f64| (c - settings.region_px).max(0.0) as u32;
        let side = 2 * settings.region_px as u32;
        // a corner beyond the picture gives what there is, down to nothing
        crop_imm(&shot.frame.color, corner(at.u_px), corner(at.v_px), side, side).to_image()
    });
    let picture = picture.filter(|p| p.width() > 0 && p.height() > 0);
    Ok((shot.frame.t_s, seen, picture))
}

/// Where the camera should see a commanded place, by the rigid motion that fits the rows so far. Only to know where to look.
fn predict(command: Point<Base>, before: &[Pair]) -> Option<Point<Camera>> {
    // the latest rows are the nearest ones
    let rows = before
        .iter()
        .rev()
        .filter_map(|p| Some((p.command.vector(), p.camera?.vector())));
    let (from, to): (Vec<_>, Vec<_>) = rows.take(60).unzip();
    if from.len() < 4 {
        return None;
    }
    let camera_from_base: Transform<Camera, Base> = Transform::from_isometry(rigid(&from, &to)?);
    Some(camera_from_base * command)
}

/// The rigid motion with the least square error (Kabsch 1976).
fn rigid(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Isometry3<f64>> {
    let middle = |cloud: &[Vector3<f64>]| cloud.iter().sum::<Vector3<f64>>() / cloud.len().max(1) as f64;
    let (mf, mt) = (middle(from), middle(to));
    let cross: Matrix3<f64> = from.iter().zip(to).map(|(f, t)| (t - mt) * (f - mf).transpose()).sum();
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let proper = Vector3::new(1.0, 1.0, (u * v_t).determinant().signum());
    let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&proper) * v_t);
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Isometry3::from_parts(Translation3::from(mt - rotation * mf), rotation))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_predicted_from_a_plane_of_rows() {
        let camera_from_base: Transform<Camera, Base> =
            Transform::from_parts([12.0, 530.0, -300.0], UnitQuaternion::from_euler_angles(1.5, 0.1, -1.6));
        let rows: Vec<Pair> = (0..12)
            .map(|n| {
                let command = Point::new(1000.0, 50.0 * f64::from(n % 4), 300.0 + 50.0 * f64::from(n / 4));
                Pair {
                    id: n as u64,
                    node: None,
                    t_s: 0.0,
                    command,
                    pixel: None,
                    depth_mm: None,
                    camera: (n != 5).then(|| camera_from_base * command),
                    joints_rad: None,
                    valid: n != 5,
                }
            })
            .collect();
        let next = Point::new(1050.0, 80.0, 420.0);
        let predicted = predict(next, &rows).expect("enough rows");
        assert!(predicted.distance_mm(camera_from_base * next) < 1e-6);
        assert!(predict(next, &rows[..3]).is_none());
    }
}
