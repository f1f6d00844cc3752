//! From the cell's cameras to shots: a face is presented, colour and depth are grabbed, and the planes in them are measured.

use crate::device::{ColorFrame, DepthFrame, DeviceError, Devices, Region, TagValue, tags};
use crate::program::FaceId;
use crate::record::FacePlane;
use geometry::{Camera, CameraModel, DepthMap, Direction, Pixel, Point, RgbdFrame, SurfaceSample};
use nalgebra::Vector3;

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
    let span = |c: f64, size: u32| {
        let low = ((c - half_px).max(0.0) as u32) / REGION_GRID_PX * REGION_GRID_PX;
        let high = ((c + half_px).ceil().max(0.0) as u32).div_ceil(REGION_GRID_PX) * REGION_GRID_PX;
        let high = high.min(size);
        (high > low).then(|| (low, high - low))
    };
    let (x_px, width_px) = span(pixel.u_px, camera.width_px)?;
    let (y_px, height_px) = span(pixel.v_px, camera.height_px)?;
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

/// The plane that most of a face lies in. In inverse depth a plane is linear over the picture, whatever its tilt.
#[derive(Clone, Copy, Debug)]
pub struct FaceFit {
    /// Inverse depth at the principal point, and its change along u and v, 1/m and 1/m per px.
    inverse: [f64; 3],
    camera: CameraModel,
}

impl FaceFit {
    /// Fits the plane to the depth between two limits (everything else is background); `None` if there is too little of it.
    pub fn of(frame: &RgbdFrame, working_depth_mm: [f64; 2]) -> Option<Self> {
        let (depth, camera) = (frame.depth.as_ref()?, frame.camera?);
        // A few thousand points say as much about a plane as millions, and cost milliseconds.
        let thin = (depth.width / 96).max(1);
        let (width, height) = (depth.width / thin, depth.height / thin);
        let [near, far] = working_depth_mm;
        let inverse = (0..width * height)
            .map(|n| {
                let (i, j) = (n % width * thin + thin / 2, n / width * thin + thin / 2);
                match depth.at(i, j) {
                    Some(z) if (near..=far).contains(&z) => (1e6 / z) as f32,
                    _ => 0.0,
                }
            })
            .collect();
        let map = DepthMap {
            width,
            height,
            step: depth.step * thin,
            depth_mm: inverse,
        };
        let axis = Pixel::new(camera.cx_px, camera.cy_px);
        let reach_px =
            f64::from(camera.width_px).hypot(f64::from(camera.height_px)) + axis.u_px.abs() + axis.v_px.abs();
        let plane = map.plane_at(axis, 0.0, reach_px)?;
        let at_axis = plane.depth_mm;
        (at_axis > 0.0 && plane.inliers >= 100).then_some(Self {
            inverse: [at_axis, plane.slope_mm_per_px[0], plane.slope_mm_per_px[1]],
            camera,
        })
    }

    /// The plane that the screws of a face sit in. Where much of what shows lies behind the flanges (an open front, a grille),
    /// the plane of most of the depth is not the face's: depth far from the screws is left out, and the sheet around
    /// the heads has the last word.
    ///
    /// # Arguments
    /// * `heads` – centres of the finds in the picture with the diameters of their heads, px.
    pub fn around(frame: &RgbdFrame, heads: &[(Pixel, f64)], working_depth_mm: [f64; 2]) -> Option<Self> {
        let camera = frame.camera?;
        let sheet: Vec<(Point<Camera>, Direction<Camera>)> = heads
            .iter()
            .filter_map(|(pixel, diameter_px)| {
                let plane = sheet_plane(frame, *pixel, *diameter_px)?;
                Some((
                    camera.unproject(*pixel, plane.depth_mm),
                    plane_normal(&camera, *pixel, &plane)?,
                ))
            })
            .collect();
        if sheet.len() < 3 {
            return Self::of(frame, working_depth_mm);
        }
        let middle_mm = median(sheet.iter().map(|s| s.0.z_mm()));
        let [near, far] = working_depth_mm;
        let limits = [
            near.max(middle_mm - FACE_RELIEF_MM),
            far.min(middle_mm + FACE_RELIEF_MM),
        ];
        let axis = |a: usize| median(sheet.iter().map(|s| s.1.vector()[a]));
        let normal = Direction::from_vector(Vector3::new(axis(0), axis(1), axis(2)))?;
        let whole = Self::of(frame, limits).filter(|fit| {
            let agrees = |n: Direction<Camera>| n.angle_rad(normal) <= SHEETS_AGREE_RAD;
            fit.normal().is_some_and(agrees)
        });
        whole.or_else(|| {
            let n = normal.vector();
            let distance_mm = median(sheet.iter().map(|s| s.0.vector().dot(&n)));
            let per_distance = 1e6 / distance_mm;
            Some(Self {
                inverse: [
                    n.z * per_distance,
                    n.x * per_distance / camera.fx_px,
                    n.y * per_distance / camera.fy_px,
                ],
                camera,
            })
        })
    }

    /// Normal of the face, towards the camera.
    pub fn normal(&self) -> Option<Direction<Camera>> {
        let [w, wu, wv] = self.inverse;
        Direction::from_vector(-Vector3::new(wu * self.camera.fx_px, wv * self.camera.fy_px, w))
    }

    /// How far heads lean from the face together: one that is seated askew does not move the median. `None` with fewer than five: one head's
    /// top is measured to 3° (95 % within 11°), and of three such measurements the median is still off by 10° now and then.
    pub fn lean_rad(&self, heads: impl Iterator<Item = Direction<Camera>>) -> Option<f64> {
        let heads: Vec<_> = heads.collect();
        if heads.len() < 5 {
            return None;
        }
        let axis = |a: usize| median(heads.iter().map(|n| n.vector()[a]));
        Some(Direction::from_vector(Vector3::new(axis(0), axis(1), axis(2)))?.angle_rad(self.normal()?))
    }

    /// Depth of the plane at a pixel, mm.
    pub fn depth_mm(&self, pixel: Pixel) -> f64 {
        let [w, wu, wv] = self.inverse;
        1e6 / (w + wu * (pixel.u_px - self.camera.cx_px) + wv * (pixel.v_px - self.camera.cy_px))
    }

    /// Depth on the axis and tilt, for the record.
    pub fn plane(&self) -> Option<FacePlane> {
        Some(FacePlane {
            depth_mm: 1e6 / self.inverse[0],
            tilt_rad: tilt_rad(self.normal()?),
            heads_lean_rad: None,
        })
    }
}

/// Angle between a normal that points to the camera and the camera's axis, rad.
pub fn tilt_rad(normal: Direction<Camera>) -> f64 {
    normal.vector().angle(&-Vector3::z())
}

/// How far a face reaches before and behind the middle of its screws at the tilt that is allowed, mm.
const FACE_RELIEF_MM: f64 = 70.0;
/// The plane of most of the depth is the face's if the sheet around the heads leans no further from it, rad.
const SHEETS_AGREE_RAD: f64 = 0.035;

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
    match (values.get(low), values.get(high)) {
        (Some(a), Some(b)) => 0.5 * (a + b),
        _ => 0.0,
    }
}

/// Normal of the sheet around a head, towards the camera; `None` without enough depth there.
pub fn sheet_normal(frame: &RgbdFrame, pixel: Pixel, diameter_px: f64) -> Option<Direction<Camera>> {
    plane_normal(&frame.camera?, pixel, &sheet_plane(frame, pixel, diameter_px)?)
}

/// Depth of the sheet around a head, at its centre, mm; `None` without enough depth there.
pub fn sheet_depth_mm(frame: &RgbdFrame, pixel: Pixel, diameter_px: f64) -> Option<f64> {
    sheet_plane(frame, pixel, diameter_px).map(|plane| plane.depth_mm)
}

fn sheet_plane(frame: &RgbdFrame, pixel: Pixel, diameter_px: f64) -> Option<SurfaceSample> {
    let plane = frame
        .depth
        .as_ref()?
        .plane_at(pixel, 0.8 * diameter_px, 2.0 * diameter_px)?;
    (plane.inliers >= 40).then_some(plane)
}

fn plane_normal(camera: &CameraModel, pixel: Pixel, plane: &SurfaceSample) -> Option<Direction<Camera>> {
    let at = |du: f64, dv: f64| {
        let z = plane.depth_mm + plane.slope_mm_per_px[0] * du + plane.slope_mm_per_px[1] * dv;
        let pixel = Pixel::new(pixel.u_px + du, pixel.v_px + dv);
        camera.unproject(pixel, z).vector()
    };
    let middle = at(0.0, 0.0);
    let normal = (at(4.0, 0.0) - middle).cross(&(at(0.0, 4.0) - middle));
    Direction::from_vector(if normal.z > 0.0 { -normal } else { normal })
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::RgbImage;

    /// A plane through (0, 0, 1500) with a given normal, in the middle two thirds of the picture; a wall 300 mm behind.
    fn tilted_face(normal: Vector3<f64>) -> RgbdFrame {
        let camera = CameraModel::pinhole(800, 600, 900.0, 900.0);
        let (width, height) = (400, 300);
        let mut map = DepthMap {
            width,
            height,
            step: 2,
            depth_mm: vec![0.0; 120_000],
        };
        for j in 0..height {
            for i in 0..width {
                let [x, y] = camera.ray(map.color_pixel(i, j));
                let z = 1500.0 * normal.z / (normal.x * x + normal.y * y + normal.z);
                let inside = (60..340).contains(&i) && (40..260).contains(&j);
                let hole = (i * 7 + j * 3) % 11 == 0;
                map.depth_mm[(j * width + i) as usize] = if hole {
                    0.0
                } else if inside {
                    z as f32
                } else {
                    1800.0
                };
            }
        }
        RgbdFrame {
            color: RgbImage::new(800, 600),
            depth: Some(map),
            camera: Some(camera),
            t_s: 0.0,
        }
    }

    #[test]
    fn a_face_s_tilt_is_measured_in_spite_of_the_wall_behind() {
        let tilt = 7f64.to_radians();
        let frame = tilted_face(Vector3::new(tilt.sin(), 0.0, -tilt.cos()));
        let fit = FaceFit::of(&frame, [1100.0, 1750.0]).expect("a face");
        let plane = fit.plane().expect("a plane");
        assert!((plane.tilt_rad - tilt).abs() < 2e-3, "{plane:?}");
        assert!((plane.depth_mm - 1500.0).abs() < 1.0, "{plane:?}");
        let pixel = Pixel::new(200.0, 150.0);
        let sheet = sheet_normal(&frame, pixel, 30.0).expect("sheet");
        assert!(sheet.angle_rad(fit.normal().expect("normal")) < 5e-3);
        let [x, y] = frame.camera.expect("camera").ray(pixel);
        let n = Vector3::new(tilt.sin(), 0.0, -tilt.cos());
        let z = 1500.0 * n.z / (n.x * x + n.y * y + n.z);
        assert!((fit.depth_mm(pixel) - z).abs() < 1.0);
        assert!(FaceFit::of(&frame, [300.0, 400.0]).is_none());
    }

    #[test]
    fn an_open_front_does_not_hide_the_plane_of_its_flanges() {
        let tilt = 4f64.to_radians();
        let mut frame = tilted_face(Vector3::new(tilt.sin(), 0.0, -tilt.cos()));
        let heads: Vec<(Pixel, f64)> = [
            (160.0, 100.0),
            (400.0, 98.0),
            (640.0, 100.0),
            (150.0, 300.0),
            (160.0, 500.0),
        ]
        .map(|(u, v)| (Pixel::new(u, v), 20.0))
        .to_vec();
        // all but a frame of flanges lies up to 280 mm further back, and leans
        if let Some(depth) = &mut frame.depth {
            for j in 75..240 {
                for i in 105..320 {
                    depth.depth_mm[(j * depth.width + i) as usize] += 40.0 + 1.1 * (i - 105) as f32;
                }
            }
        }
        let most = FaceFit::of(&frame, [1100.0, 1750.0])
            .and_then(|f| f.normal())
            .expect("a plane");
        assert!((tilt_rad(most) - tilt).abs() > 0.1, "the scene should mislead");
        let fit = FaceFit::around(&frame, &heads, [1100.0, 1750.0]).expect("a plane");
        let plane = fit.plane().expect("a plane");
        assert!(
            (plane.tilt_rad - tilt).abs() < 5e-3 && (plane.depth_mm - 1500.0).abs() < 1.0,
            "{plane:?}"
        );
    }

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
