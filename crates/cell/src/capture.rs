//! From the cell's cameras to shots: a face is presented, colour and depth are grabbed, with the place of each in the whole picture.

use crate::device::{ColorFrame, DepthFrame, DeviceError, Devices, Region, TagValue, tags};
use crate::program::FaceId;
use geometry::{CameraModel, DepthMap, Pixel, RgbdFrame};

/// Regions begin at multiples of this, so that depth of any usual step is aligned with colour, px.
const REGION_GRID_PX: u32 = 8;

/// A shot with its place in the whole picture.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Colour, depth and camera; the camera is that of the region.
    pub frame: RgbdFrame,
    /// Part of the whole picture that it shows.
    pub region: Region,
}

impl Shot {
    /// A pixel of the shot in the whole picture.
    pub fn to_whole(&self, pixel: Pixel) -> Pixel {
        Pixel::new(
            pixel.u_px + f64::from(self.region.x_px),
            pixel.v_px + f64::from(self.region.y_px),
        )
    }

    /// A pixel of the whole picture in the shot.
    pub fn to_shot(&self, pixel: Pixel) -> Pixel {
        Pixel::new(
            pixel.u_px - f64::from(self.region.x_px),
            pixel.v_px - f64::from(self.region.y_px),
        )
    }

    /// Size, megapixels.
    pub fn megapixels(&self) -> f64 {
        f64::from(self.region.width_px) * f64::from(self.region.height_px) * 1e-6
    }
}

/// Turns a face to the camera and waits until it stands there. A time-out is answered by reading where the table is, never
/// by asking it to turn again.
///
/// # Errors
/// What the table says, or [`DeviceError::Timeout`] if the face does not stand there in time.
pub async fn present(devices: &Devices, face: &FaceId, timeout_s: f64) -> Result<(), DeviceError> {
    let wanted = TagValue::Text(face.0.clone());
    if devices.io.read(tags::PRESENTED).await? == wanted {
        return Ok(());
    }
    match devices.io.write(tags::PRESENT, wanted.clone()).await {
        // The order may have arrived although its answer did not: what follows reads the table, it does not ask again.
        Ok(()) | Err(DeviceError::Timeout { .. }) => {}
        Err(error) => return Err(error),
    }
    match devices.io.wait_for(tags::PRESENTED, wanted.clone(), timeout_s).await {
        Err(timeout @ DeviceError::Timeout { .. }) => {
            if devices.io.read(tags::PRESENTED).await? == wanted {
                Ok(())
            } else {
                Err(timeout)
            }
        }
        other => other,
    }
}

/// Takes a shot of the whole view or of a region; depth is the mean of `depth_frames` frames, none for 0. Both cameras work at the same time.
///
/// # Errors
/// What a camera says; a grab that failed is tried once more, since taking a picture changes nothing.
pub async fn shoot(devices: &Devices, region: Option<Region>, depth_frames: usize) -> Result<Shot, DeviceError> {
    let color = async {
        match devices.color.grab(region).await {
            Err(DeviceError::Timeout { .. } | DeviceError::Fault { .. }) => devices.color.grab(region).await,
            other => other,
        }
    };
    let depth = async {
        let mut frames: Vec<DepthFrame> = Vec::with_capacity(depth_frames);
        for _ in 0..depth_frames {
            frames.push(match devices.depth.grab(region).await {
                Err(DeviceError::Timeout { .. } | DeviceError::Fault { .. }) => devices.depth.grab(region).await?,
                other => other?,
            });
        }
        Ok::<_, DeviceError>(frames)
    };
    let (color, frames) = tokio::join!(color, depth);
    let (color, frames) = (color?, frames?);
    let mut mean: Option<Mean> = None;
    for frame in frames {
        check_registered(&color, &frame)?;
        match &mut mean {
            Some(mean) => mean.add(&frame.map),
            None => mean = Some(Mean::of(frame.map)),
        }
    }
    let camera = camera_of_region(&devices.color.intrinsics(), color.region);
    Ok(Shot {
        region: color.region,
        frame: RgbdFrame {
            color: color.image,
            depth: mean.map(Mean::finish),
            camera: Some(camera),
            t_s: color.t_s,
        },
    })
}

fn check_registered(color: &ColorFrame, depth: &DepthFrame) -> Result<(), DeviceError> {
    let (width, height) = color.image.dimensions();
    if depth.region == color.region
        && DepthMap::step_between((width, height), (depth.map.width, depth.map.height)) == Some(depth.map.step)
    {
        return Ok(());
    }
    Err(DeviceError::Fault {
        device: "depth camera".into(),
        action: "grab".into(),
        code: 0,
        text: format!(
            "its frame of {} x {} (step {}) for {:?} does not belong to the colour picture of {width} x {height} for {:?}; check its registration",
            depth.map.width, depth.map.height, depth.map.step, depth.region, color.region
        ),
    })
}

/// Mean of depth frames, holes left out.
struct Mean {
    map: DepthMap,
    count: Vec<u16>,
}

impl Mean {
    fn of(map: DepthMap) -> Self {
        let valid = |z: &f32| u16::from(z.is_finite() && *z > 0.0);
        let count: Vec<u16> = map.depth_mm.iter().map(valid).collect();
        let mut mean = Self { map, count };
        for (z, n) in mean.map.depth_mm.iter_mut().zip(&mean.count) {
            if *n == 0 {
                *z = 0.0;
            }
        }
        mean
    }

    fn add(&mut self, other: &DepthMap) {
        for ((sum, n), z) in self.map.depth_mm.iter_mut().zip(&mut self.count).zip(&other.depth_mm) {
            if z.is_finite() && *z > 0.0 {
                *sum += z;
                *n += 1;
            }
        }
    }

    fn finish(mut self) -> DepthMap {
        for (sum, n) in self.map.depth_mm.iter_mut().zip(&self.count) {
            if *n > 1 {
                *sum /= f32::from(*n);
            }
        }
        self.map
    }
}

/// The camera as seen from a region: the same rays, the principal point moved.
pub fn camera_of_region(whole: &CameraModel, region: Region) -> CameraModel {
    CameraModel {
        width_px: region.width_px,
        height_px: region.height_px,
        cx_px: whole.cx_px - f64::from(region.x_px),
        cy_px: whole.cy_px - f64::from(region.y_px),
        ..*whole
    }
}

/// The region of the picture around a pixel, aligned for depth; `None` if nothing of it lies in the picture.
pub fn region_around(camera: &CameraModel, pixel: Pixel, half_px: f64) -> Option<Region> {
    region_of(camera, &[pixel], half_px)
}

/// The region of the picture that holds all these pixels, inside the picture or not, and so much around them; `None` as for one.
pub fn region_of(camera: &CameraModel, pixels: &[Pixel], around_px: f64) -> Option<Region> {
    let span = |along: fn(&Pixel) -> f64, size: u32| {
        let all = pixels.iter().map(along);
        let (low, high) = (all.clone().reduce(f64::min)?, all.reduce(f64::max)?);
        let low = ((low - around_px).max(0.0) as u32) / REGION_GRID_PX * REGION_GRID_PX;
        let high = ((high + around_px).ceil().max(0.0) as u32).div_ceil(REGION_GRID_PX) * REGION_GRID_PX;
        let high = high.min(size);
        (high > low).then(|| (low, high - low))
    };
    let (x_px, width_px) = span(|p| p.u_px, camera.width_px)?;
    let (y_px, height_px) = span(|p| p.v_px, camera.height_px)?;
    Some(Region {
        x_px,
        y_px,
        width_px,
        height_px,
    })
}

/// What a picture costs beyond its pixels (trigger, transfer, a pass of the networks), as pixels, Mpx.
const PICTURE_COST_MPX: f64 = 1.0;

/// Few regions that together show everything around some pixels: two are joined where one picture costs less than two.
pub fn regions_around(camera: &CameraModel, pixels: &[Pixel], half_px: f64) -> Vec<Region> {
    let mut regions: Vec<Region> = pixels
        .iter()
        .filter_map(|p| region_around(camera, *p, half_px))
        .collect();
    let cost = |r: &Region| PICTURE_COST_MPX + f64::from(r.width_px) * f64::from(r.height_px) * 1e-6;
    loop {
        let mut best: Option<(f64, usize, usize, Region)> = None;
        for i in 0..regions.len() {
            for j in i + 1..regions.len() {
                let joined = join(&regions[i], &regions[j]);
                let saved = cost(&regions[i]) + cost(&regions[j]) - cost(&joined);
                if saved > 0.0 && best.as_ref().is_none_or(|b| saved > b.0) {
                    best = Some((saved, i, j, joined));
                }
            }
        }
        let Some((_, i, j, joined)) = best else { return regions };
        regions.swap_remove(j);
        regions[i] = joined;
    }
}

fn join(a: &Region, b: &Region) -> Region {
    let (x_px, y_px) = (a.x_px.min(b.x_px), a.y_px.min(b.y_px));
    Region {
        x_px,
        y_px,
        width_px: (a.x_px + a.width_px).max(b.x_px + b.width_px) - x_px,
        height_px: (a.y_px + a.height_px).max(b.y_px + b.height_px) - y_px,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_sees_the_same_rays() {
        let whole = CameraModel {
            distortion: [-0.06, 0.03, 1e-4, -2e-4, 0.0],
            ..CameraModel::pinhole(4104, 3006, 4638.0, 4637.0)
        };
        let pixel = Pixel::new(3990.3, 77.7);
        let region = region_around(&whole, pixel, 100.0).expect("inside");
        assert_eq!((region.x_px % 8, region.y_px % 8), (0, 0));
        assert!(region.x_px + region.width_px <= 4104 && region.y_px == 0);
        let part = camera_of_region(&whole, region);
        let local = Pixel::new(pixel.u_px - f64::from(region.x_px), pixel.v_px - f64::from(region.y_px));
        assert_eq!(part.ray(local), whole.ray(pixel));
        assert!(region_around(&whole, Pixel::new(-500.0, 10.0), 100.0).is_none());
    }

    #[test]
    fn neighbours_share_a_picture_and_every_pixel_is_in_one() {
        let camera = CameraModel::pinhole(4104, 3006, 4638.0, 4638.0);
        let pixels: Vec<Pixel> = [(500.0, 300.0), (900.0, 310.0), (1300.0, 305.0), (3800.0, 2900.0)]
            .map(|(u, v)| Pixel::new(u, v))
            .to_vec();
        let regions = regions_around(&camera, &pixels, 100.0);
        assert_eq!(regions.len(), 2, "{regions:?}");
        let shown = |p: &Pixel, r: &Region| {
            (p.u_px - f64::from(r.x_px)) >= 90.0
                && (p.v_px - f64::from(r.y_px)) >= 90.0
                && p.u_px + 90.0 <= f64::from(r.x_px + r.width_px)
                && p.v_px + 90.0 <= f64::from(r.y_px + r.height_px)
        };
        assert!(
            pixels.iter().all(|p| regions.iter().any(|r| shown(p, r))),
            "{regions:?}"
        );
    }
}
