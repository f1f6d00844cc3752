//! The plane of a face and of the sheet around a screw, as depth shows them.

use crate::record::FacePlane;
use geometry::{Camera, CameraModel, DepthMap, Direction, Pixel, RgbdFrame, SurfaceSample};
use nalgebra::{Matrix3, Vector3};

/// Heads sit in a plane if their sheet is no further off it than this, mm: beads, flanges, and the measurement (two standard deviations).
const OFF_PLANE_MM: f64 = 3.0;
/// A head's sheet looks along a plane's normal if it leans no further from it than this, rad: the sheet around a head is narrow and has edges.
const OFF_NORMAL_RAD: f64 = 0.07;
/// Three heads make a plane if the triangle between them has at least this area, mm².
const LEAST_TRIANGLE_MM2: f64 = 1500.0;
/// Heads at most that triangles are made of.
const CORNERS: usize = 20;
/// No face is presented that looks farther aside, rad.
const STEEPEST_FACE_RAD: f64 = 0.35;
/// Steps of the fit to the heads that agree.
const FIT_STEPS: usize = 8;
/// Share of the middle one's lean that heads must have to lean together with it.
const LEANS_TOO: f64 = 0.5;
/// One of so many heads may lean otherwise: seated askew.
const MAY_LEAN_APART: usize = 5;

/// The plane that a face lies in: `normal` · point = `distance_mm`.
#[derive(Clone, Copy, Debug)]
pub struct FaceFit {
    /// Towards the camera.
    normal: Direction<Camera>,
    distance_mm: f64,
    /// Which way the heads of its screws look, where they lean from it together.
    heads: Option<Direction<Camera>>,
    camera: CameraModel,
}

/// The sheet around a head.
struct Sheet {
    at: Vector3<f64>,
    normal: Vector3<f64>,
}

impl FaceFit {
    /// The plane that most of the depth between two limits lies in (everything else is background); `None` if there is too little of it.
    pub fn of(frame: &RgbdFrame, working_depth_mm: [f64; 2]) -> Option<Self> {
        let (depth, camera) = (frame.depth.as_ref()?, frame.camera?);
        // A few thousand points say as much about a plane as millions, and cost milliseconds.
        let thin = (depth.width / 96).max(1);
        let (width, height) = (depth.width / thin, depth.height / thin);
        let [near, far] = working_depth_mm;
        // In inverse depth a plane is linear over the picture, whatever its tilt.
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
        if plane.depth_mm <= 0.0 || plane.inliers < 100 {
            return None;
        }
        let [along_u, along_v] = plane.slope_mm_per_px;
        let normal = -Vector3::new(along_u * camera.fx_px, along_v * camera.fy_px, plane.depth_mm);
        Some(Self {
            normal: Direction::from_vector(normal)?,
            distance_mm: -1e6 / normal.norm(),
            heads: None,
            camera,
        })
    }

    /// The plane that the screws of a face sit in: the one in which most heads lie and along whose normal the sheet around most heads looks. Where
    /// much of what shows lies behind the flanges (an open front, a grille), the plane of most of the depth is not the face's; with fewer than
    /// three heads, or where they do not agree, it is taken all the same if any head lies in it.
    ///
    /// # Arguments
    /// * `heads` – centres of the finds in the picture with the diameters of their heads, px.
    pub fn around(frame: &RgbdFrame, heads: &[(Pixel, f64)], working_depth_mm: [f64; 2]) -> Option<Self> {
        let camera = frame.camera?;
        let sheet = |&(pixel, diameter_px): &(Pixel, f64)| {
            let plane = sheet_plane(frame, pixel, diameter_px)?;
            Some(Sheet {
                at: camera.unproject(pixel, plane.depth_mm).vector(),
                normal: plane.normal(&camera, pixel)?.vector(),
            })
        };
        let sheets: Vec<Sheet> = heads.iter().filter_map(sheet).collect();
        let cost = |(normal, distance): &(Vector3<f64>, f64)| disagreement(&sheets, normal, *distance);
        let best = planes_through(&sheets)
            .into_iter()
            .min_by(|a, b| cost(a).total_cmp(&cost(b)));
        let fit = best.and_then(|(normal, distance)| refined(&sheets, normal, distance));
        let through_heads = fit.map(|(normal, distance_mm)| Self {
            normal,
            distance_mm,
            heads: None,
            camera,
        });
        if let Some(fit) = through_heads.filter(|fit| is_borne_out(&sheets, &fit.normal.vector(), fit.distance_mm)) {
            return Some(fit);
        }
        // a plane in which no head lies may be that of the background; of two the one that leans less is likelier a face's
        let holds_a_head = |most: &Self| {
            let off = |sheet: &Sheet| most.normal.vector().dot(&sheet.at) - most.distance_mm;
            sheets.iter().any(|sheet| off(sheet).abs() < OFF_PLANE_MM)
        };
        match (Self::of(frame, working_depth_mm), through_heads) {
            (Some(most), Some(fit)) if !holds_a_head(&most) && tilt_rad(fit.normal) < tilt_rad(most.normal) => {
                Some(fit)
            }
            (most, fit) => most.or(fit),
        }
    }

    /// A plane that was measured before, as this camera sees it; `None` where the record does not say which way it looks.
    pub fn known(plane: &FacePlane, camera: CameraModel) -> Option<Self> {
        let normal = plane.normal?;
        Some(Self {
            normal,
            distance_mm: plane.depth_mm * normal.vector().z,
            heads: plane.heads_normal,
            camera,
        })
    }

    /// Normal of the face, towards the camera.
    pub fn normal(&self) -> Direction<Camera> {
        self.normal
    }

    /// Which way the heads of its screws look, where they lean from it together.
    pub fn heads(&self) -> Option<Direction<Camera>> {
        self.heads
    }

    /// The same plane, with heads that look that way.
    pub fn with_heads(self, heads: Option<Direction<Camera>>) -> Self {
        Self { heads, ..self }
    }

    /// Which way heads look together: as the middle one of them does, if no more than one in five leans from the face less than half as far to that
    /// side. One head's top is measured to 3° (95 % within 11°), and the middle of a few such measurements is still off by 10° now and then.
    /// `None` with fewer than three.
    pub fn look_together(&self, heads: impl Iterator<Item = Direction<Camera>>) -> Option<Direction<Camera>> {
        let heads: Vec<_> = heads.collect();
        if heads.len() < 3 {
            return None;
        }
        let face = self.normal;
        let axis = |a: usize| median(heads.iter().map(|n| n.vector()[a]));
        let middle = Direction::from_vector(Vector3::new(axis(0), axis(1), axis(2)))?;
        let across = |n: &Direction<Camera>| n.vector() - face.vector() * n.vector().dot(&face.vector());
        let toward = across(&middle);
        let apart = |n: &&Direction<Camera>| across(n).dot(&toward) < LEANS_TOO * toward.norm_squared();
        let together = heads.iter().filter(apart).count() <= heads.len() / MAY_LEAN_APART;
        together.then_some(middle)
    }

    /// Depth of the plane at a pixel, mm.
    pub fn depth_mm(&self, pixel: Pixel) -> f64 {
        let [x, y] = self.camera.ray(pixel);
        self.distance_mm / self.normal.vector().dot(&Vector3::new(x, y, 1.0))
    }

    /// Depth on the axis and tilt, for the record.
    pub fn plane(&self) -> FacePlane {
        FacePlane {
            depth_mm: self.distance_mm / self.normal.vector().z,
            tilt_rad: tilt_rad(self.normal),
            normal: Some(self.normal),
            heads_lean_rad: self.heads.map(|heads| heads.angle_rad(self.normal)),
            heads_normal: self.heads,
        }
    }
}

/// Planes that the heads of a face may sit in: through each head along the normal of any, and through every three of the first ones.
fn planes_through(sheets: &[Sheet]) -> Vec<(Vector3<f64>, f64)> {
    let axis = |a: usize| median(sheets.iter().map(|s| s.normal[a]));
    let middle = Vector3::new(axis(0), axis(1), axis(2));
    let normals = sheets.iter().map(|s| s.normal).chain(middle.try_normalize(1e-6));
    let mut planes: Vec<(Vector3<f64>, f64)> = normals
        .flat_map(|normal| sheets.iter().map(move |s| (normal, normal.dot(&s.at))))
        .collect();
    let corners = &sheets[..sheets.len().min(CORNERS)];
    for (k, c) in corners.iter().enumerate() {
        for (j, b) in corners[..k].iter().enumerate() {
            for a in &corners[..j] {
                let across = (b.at - a.at).cross(&(c.at - a.at));
                let towards_camera = if across.z > 0.0 { -across } else { across };
                let normal = towards_camera / across.norm().max(1e-9);
                if across.norm() >= 2.0 * LEAST_TRIANGLE_MM2 {
                    planes.push((normal, normal.dot(&a.at)));
                }
            }
        }
    }
    planes
}

/// True if at least three heads lie in a plane and the sheet around two of them looks along its normal, as far as any face looks aside.
fn is_borne_out(sheets: &[Sheet], normal: &Vector3<f64>, distance: f64) -> bool {
    let lies_in = |sheet: &&Sheet| (normal.dot(&sheet.at) - distance).abs() < OFF_PLANE_MM;
    let looks_along = |sheet: &&Sheet| (normal - sheet.normal).norm() < OFF_NORMAL_RAD;
    let in_it = sheets.iter().filter(lies_in);
    in_it.clone().count() >= 3 && in_it.filter(looks_along).count() >= 2 && -normal.z > STEEPEST_FACE_RAD.cos()
}

/// How little heads and a plane agree: squares of how far each head lies off it and leans from it, those that disagree alike.
fn disagreement(sheets: &[Sheet], normal: &Vector3<f64>, distance: f64) -> f64 {
    let of = |sheet: &Sheet| {
        let off = (normal.dot(&sheet.at) - distance) / OFF_PLANE_MM;
        let lean = (normal - sheet.normal).norm() / OFF_NORMAL_RAD;
        off.powi(2).min(1.0) + lean.powi(2).min(1.0)
    };
    sheets.iter().map(of).sum()
}

/// The plane next to this one that fits best what agrees with it (Gauss-Newton on two angles and the distance).
fn refined(sheets: &[Sheet], mut normal: Vector3<f64>, mut distance: f64) -> Option<(Direction<Camera>, f64)> {
    for _ in 0..FIT_STEPS {
        let first = normal.cross(&Vector3::y()).try_normalize(1e-6)?;
        let second = normal.cross(&first);
        let (mut square, mut right) = (Matrix3::identity() * 1e-9, Vector3::zeros());
        for sheet in sheets {
            let off = normal.dot(&sheet.at) - distance;
            if off.abs() < OFF_PLANE_MM {
                let row = Vector3::new(sheet.at.dot(&first), sheet.at.dot(&second), -1.0) / OFF_PLANE_MM;
                square += row * row.transpose();
                right -= row * (off / OFF_PLANE_MM);
            }
            if (normal - sheet.normal).norm() < OFF_NORMAL_RAD {
                for (k, axis) in [first, second].iter().enumerate() {
                    square[(k, k)] += OFF_NORMAL_RAD.powi(-2);
                    right[k] += axis.dot(&sheet.normal) * OFF_NORMAL_RAD.powi(-2);
                }
            }
        }
        let step = square.try_inverse()? * right;
        normal = (normal + first * step.x + second * step.y).normalize();
        distance += step.z;
    }
    Some((Direction::from_vector(normal)?, distance))
}

/// Angle between a normal that points to the camera and the camera's axis, rad.
pub fn tilt_rad(normal: Direction<Camera>) -> f64 {
    normal.vector().angle(&-Vector3::z())
}

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
    sheet_plane(frame, pixel, diameter_px)?.normal(&frame.camera?, pixel)
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
        let plane = fit.plane();
        assert!((plane.tilt_rad - tilt).abs() < 2e-3, "{plane:?}");
        assert!((plane.depth_mm - 1500.0).abs() < 1.0, "{plane:?}");
        let pixel = Pixel::new(200.0, 150.0);
        let sheet = sheet_normal(&frame, pixel, 30.0).expect("sheet");
        assert!(sheet.angle_rad(fit.normal()) < 5e-3);
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
        let most = FaceFit::of(&frame, [1100.0, 1750.0]).expect("a plane").plane();
        assert!((most.tilt_rad - tilt).abs() > 0.1, "the scene should mislead");
        let few = FaceFit::around(&frame, &heads[..2], [1100.0, 1750.0]).expect("a plane");
        assert!((few.plane().tilt_rad - tilt).abs() < 0.02, "{:?}", few.plane());
        let fit = FaceFit::around(&frame, &heads, [1100.0, 1750.0]).expect("a plane");
        let plane = fit.plane();
        assert!(
            (plane.tilt_rad - tilt).abs() < 5e-3 && (plane.depth_mm - 1500.0).abs() < 1.0,
            "{plane:?}"
        );
    }

    #[test]
    fn on_levels_that_differ_and_beside_edges_heads_agree_on_the_face() {
        // five heads on the face, four on a plate 60 mm behind it, and around three of the nine the sheet leans by 4 to 14°
        let tilt = 5f64.to_radians();
        let face = Vector3::new(0.0, tilt.sin(), -tilt.cos());
        let sheets: Vec<Sheet> = (0..9)
            .map(|k| {
                let (x, y) = (-300.0 + 70.0 * f64::from(k), 150.0 * f64::from(k * k % 5) - 300.0);
                let behind = if k < 5 { 0.0 } else { 60.0 };
                let z = (-1500.0 * tilt.cos() - face.y * y - behind) / face.z;
                let edge = f64::from(u8::from(k % 3 == 0)) * (0.07 + 0.03 * f64::from(k));
                Sheet {
                    at: Vector3::new(x, y, z + 0.3 * f64::from(k % 3 - 1)),
                    normal: (face + Vector3::new(edge, 0.0, 0.0)).normalize(),
                }
            })
            .collect();
        let cost = |(normal, distance): &(Vector3<f64>, f64)| disagreement(&sheets, normal, *distance);
        let planes = planes_through(&sheets).into_iter();
        let (normal, distance) = planes.min_by(|a, b| cost(a).total_cmp(&cost(b))).expect("planes");
        let (normal, distance_mm) = refined(&sheets, normal, distance).expect("a plane");
        assert!(normal.vector().angle(&face) < 3e-3, "{normal:?}");
        assert!((distance_mm + 1500.0 * tilt.cos()).abs() < 0.5, "{distance_mm}");
    }

    #[test]
    fn heads_lean_together_if_hardly_one_leans_otherwise() {
        let camera = CameraModel::pinhole(800, 600, 900.0, 900.0);
        let straight = Direction::from_vector(-Vector3::z()).expect("not zero");
        let fit = FaceFit {
            normal: straight,
            distance_mm: -1500.0,
            heads: None,
            camera,
        };
        let head = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            Direction::from_vector(Vector3::new(sin, 0.0, -cos)).expect("not zero")
        };
        let lean = |degrees: &[f64]| {
            let look = fit.look_together(degrees.iter().map(|d| head(*d)));
            look.map(|look| look.angle_rad(straight).to_degrees())
        };
        assert_eq!(lean(&[12.0, 12.0]), None);
        assert_eq!(lean(&[12.0, 13.0, 2.0]), None);
        assert!(lean(&[12.0, 13.0, 8.0]).is_some_and(|l| (l - 12.0).abs() < 1e-6));
        assert!(lean(&[12.0, 13.0, 2.0, 12.0, 13.0]).is_some_and(|l| (l - 12.0).abs() < 1e-6));
        assert_eq!(lean(&[12.0, 13.0, 2.0, -3.0, 13.0]), None);
    }
}
