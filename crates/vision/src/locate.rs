//! From a pixel to a point in space: depth at the plane of the recess rim, in spite of the slot, holes and edges.

use geometry::{Camera, CameraModel, DepthMap, Direction, Pixel, Point, SurfaceSample};
use rayon::prelude::*;

use crate::Corrections;

/// The ring of the head's top around the recess, in head diameters.
const TOP_RING: [f64; 2] = [0.24, 0.36];
/// No head rises farther above its sheet, in head diameters.
const HIGHEST: f64 = 0.7;
/// Of a head behind a cable at least one in so many measurements is of the head.
const SHOWS: usize = 5;
/// The ring of sheet around the head, in head diameters; and a narrower one for heads on a strip of sheet.
const SHEET_RING: [f64; 2] = [0.75, 1.6];
const STRIP_RING: [f64; 2] = [0.62, 1.0];
/// Borders of the rings around the recess whose heights above the sheet tell the rim's, in head diameters.
const RINGS: [f64; 8] = [0.0, 0.12, 0.20, 0.27, 0.34, 0.41, 0.48, 0.56];
/// Heights in those rings, and the head's diameter.
pub const RIM_TERMS: usize = RINGS.len();
/// Rings whose middle height is how far something rises: all that lie well within a head.
const RISING_RINGS: usize = 4;
/// Rises beyond these say no more, mm.
const RISE_MM: [f64; 2] = [-1.0, 4.0];
/// Weights of these where nothing was measured: the top around the recess, a little domed.
pub(crate) const USUAL_RIM: [f64; RIM_TERMS] = [0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.02];
/// Rings that must have depth of their own; the others are filled from their neighbours.
const RINGS_SEEN: usize = 5;
/// The slope that a face in front of the camera can have: steeper planes come from an edge.
const STEEPEST: f64 = 1.0;
/// Stereo errors of neighbouring measurements go together: so many count as one.
const MEASUREMENTS_A_SAMPLE: f64 = 4.0;
/// Angle to the optical axis beyond which a ring around a head has an edge in it, rad.
const STEEPEST_SHEET: f64 = 0.5;
/// Angle to the other heads' sheet beyond which it has too, rad.
const SAME_SHEET: f64 = 0.12;

/// What a depth rests on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthSource {
    /// How high the head rises above the sheet, ring by ring.
    Head,
    /// The sheet around the head, and the usual height of heads.
    Sheet,
}

/// A screw in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Located {
    /// Centre of the recess in the plane of its rim.
    pub point: Point<Camera>,
    /// Standard error along the optical axis, mm.
    pub sigma_depth_mm: f64,
    /// Standard error across it, along each axis, mm.
    pub sigma_lateral_mm: f64,
    /// Normal of the sheet around it, towards the camera.
    pub normal: Direction<Camera>,
    /// Normal of the head's top, where it has enough depth of its own.
    pub top_normal: Option<Direction<Camera>>,
    /// What the depth rests on.
    pub source: DepthSource,
}

/// Locates the recess rim of a screw.
///
/// # Arguments
/// * `pixel`, `sigma_px` – centre of the recess and its standard error along each axis.
/// * `diameter_px` – of the head.
///
/// # Returns
/// `None` where neither the head nor the sheet around it has depth.
pub fn locate(
    depth: &DepthMap,
    camera: &CameraModel,
    pixel: Pixel,
    sigma_px: f64,
    diameter_px: f64,
    corrections: &Corrections,
) -> Option<Located> {
    let sheet = sheet(depth, camera, pixel, diameter_px)?;
    let head_mm = diameter_px * camera.pixel_mm(sheet.depth_mm);
    let profile = RimProfile::above(sheet, depth, pixel, head_mm, diameter_px);
    let (height_mm, sigma_depth_mm, source) = match &profile {
        Some(profile) => (
            profile.height_mm(&corrections.rim_height),
            profile.sigma_mm(corrections.rim_spread) * corrections.depth_sigma,
            DepthSource::Head,
        ),
        None => {
            let [height, spread] = corrections.usual_height;
            (
                height * head_mm,
                noise_mm(&sheet).hypot(spread * head_mm),
                DepthSource::Sheet,
            )
        }
    };
    let depth_mm = sheet.depth_mm - height_mm;
    let [inner, outer] = TOP_RING.map(|r| r * diameter_px);
    let top = depth
        .plane_at(pixel, inner, outer)
        .filter(|plane| believable(plane, camera, pixel));
    Some(Located {
        point: camera.unproject(pixel, depth_mm),
        sigma_depth_mm,
        sigma_lateral_mm: sigma_px * camera.pixel_mm(depth_mm),
        normal: sheet.normal(camera, pixel)?,
        top_normal: top.and_then(|top| top.normal(camera, pixel)),
        source,
    })
}

/// How high a head rises above the sheet around it, ring by ring.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RimProfile {
    /// The sheet around the head.
    pub sheet: SurfaceSample,
    /// Median height in each ring, mm along the optical axis, then the head's diameter, mm.
    pub terms: [f64; RIM_TERMS],
}

impl RimProfile {
    /// That of a head of this diameter; `None` where the sheet or most rings have no depth.
    pub fn of(depth: &DepthMap, camera: &CameraModel, pixel: Pixel, diameter_px: f64) -> Option<Self> {
        let sheet = sheet(depth, camera, pixel, diameter_px)?;
        let head_mm = diameter_px * camera.pixel_mm(sheet.depth_mm);
        Self::above(sheet, depth, pixel, head_mm, diameter_px)
    }

    fn above(sheet: SurfaceSample, depth: &DepthMap, pixel: Pixel, head_mm: f64, diameter_px: f64) -> Option<Self> {
        let points = depth.neighbourhood(pixel, 0.0, RINGS[RIM_TERMS - 1] * diameter_px);
        let heights: Vec<(f64, f64)> = points
            .iter()
            .map(|[u, v, z]| (u.hypot(*v) / diameter_px, sheet.depth_at_mm([*u, *v]) - z))
            .collect();
        // what is higher than a head hangs before it, a cable; if all is, the head stands on something before that sheet
        let is_head = |height_mm: f64| height_mm < HIGHEST * head_mm;
        let shows = heights.iter().filter(|(_, height_mm)| is_head(*height_mm)).count() >= heights.len() / SHOWS;
        let mut rings: [Vec<f64>; RIM_TERMS - 1] = Default::default();
        for (r, height_mm) in heights {
            if let Some(ring) = RINGS.windows(2).position(|border| (border[0]..border[1]).contains(&r))
                && (is_head(height_mm) || !shows)
            {
                rings[ring].push(height_mm);
            }
        }
        let heights = rings.map(|mut heights| {
            let middle = heights.len() / 2;
            (!heights.is_empty()).then(|| *heights.select_nth_unstable_by(middle, f64::total_cmp).1)
        });
        if heights.iter().flatten().count() < RINGS_SEEN {
            return None;
        }
        let mut terms = [head_mm; RIM_TERMS];
        for (ring, term) in terms[..RIM_TERMS - 1].iter_mut().enumerate() {
            // the nearest ring that was seen, of two the outer one
            let seen = (0..heights.len()).filter(|&k| heights[k].is_some());
            *term = heights[seen.min_by_key(|&k| (k.abs_diff(ring), k < ring))?]?;
        }
        Some(Self { sheet, terms })
    }

    /// How far what is there rises above the sheet, mm along the optical axis: the median of the inner rings, kept to -1 to 4 mm. Near 0
    /// for a mark or a dent, below it for a hole.
    pub fn rise_mm(&self) -> f64 {
        let mut inner = [0.0; RISING_RINGS];
        inner.copy_from_slice(&self.terms[..RISING_RINGS]);
        inner.sort_by(f64::total_cmp);
        let [low, high] = RISE_MM;
        (0.5 * (inner[RISING_RINGS / 2 - 1] + inner[RISING_RINGS / 2])).clamp(low, high)
    }

    /// Height of the rim above the sheet, mm along the optical axis, by weights as those of [`Corrections::rim_height`].
    pub fn height_mm(&self, weights: &[f64; RIM_TERMS]) -> f64 {
        self.terms.iter().zip(weights).map(|(term, weight)| term * weight).sum()
    }

    /// Standard error of that height where it spreads so much, in head diameters, mm.
    pub fn sigma_mm(&self, spread: f64) -> f64 {
        noise_mm(&self.sheet).hypot(spread * self.terms[RIM_TERMS - 1])
    }
}

/// Standard error of a sheet's depth, mm.
fn noise_mm(sheet: &SurfaceSample) -> f64 {
    sheet.sigma_mm * MEASUREMENTS_A_SAMPLE.sqrt()
}

/// Which way the sheet looks around each of several heads on one face, towards the camera: the plane of the ring around the head, which is
/// far wider than the head's top; where that disagrees with most of the others, an edge is in it, and the middle of all is taken.
///
/// # Arguments
/// * `heads` – centre and diameter of each, px.
///
/// # Returns
/// A direction for each head; `None` where no head has depth around it.
pub fn facings(depth: &DepthMap, camera: &CameraModel, heads: &[(Pixel, f64)]) -> Vec<Option<Direction<Camera>>> {
    let own: Vec<Option<Direction<Camera>>> = heads
        .par_iter()
        .map(|&(pixel, diameter_px)| {
            let [inner, outer] = SHEET_RING.map(|r| r * diameter_px);
            let plane = depth.plane_at(pixel, inner, outer)?;
            plane
                .normal(camera, pixel)
                .filter(|n| n.vector().z < -STEEPEST_SHEET.cos())
        })
        .collect();
    let median = |axis: usize| {
        let mut along: Vec<f64> = own.iter().flatten().map(|n| n.vector()[axis]).collect();
        along.sort_by(f64::total_cmp);
        along.get(along.len() / 2).copied()
    };
    let all = || Direction::new(median(0)?, median(1)?, median(2)?);
    let all = all();
    let near = |n: &Direction<Camera>| all.is_some_and(|all| n.angle_rad(all) < SAME_SHEET);
    own.into_iter().map(|own| own.filter(near).or(all)).collect()
}

/// Where something that lies one head diameter below the recess rim appears, seen from the rim: a pixel's offset, px.
pub fn parallax_px(camera: &CameraModel, pixel: Pixel, normal: Direction<Camera>, diameter_px: f64) -> [f64; 2] {
    let (ray, n) = (camera.unproject(pixel, 1.0), normal.vector());
    [ray.x_mm() * n.z - n.x, ray.y_mm() * n.z - n.y].map(|shift| shift * diameter_px)
}

/// The sheet around a head. On a strip of sheet most of the usual ring is what lies behind it: its plane is far below the head, or a steep one
/// through both. There the narrower ring says more.
fn sheet(depth: &DepthMap, camera: &CameraModel, pixel: Pixel, diameter_px: f64) -> Option<SurfaceSample> {
    let plane = |ring: [f64; 2]| {
        let [inner, outer] = ring.map(|r| r * diameter_px);
        depth
            .plane_at(pixel, inner, outer)
            .filter(|plane| believable(plane, camera, pixel))
    };
    let usual = plane(SHEET_RING);
    let mut head: Vec<f64> = depth
        .neighbourhood(pixel, 0.0, TOP_RING[1] * diameter_px)
        .iter()
        .map(|p| p[2])
        .collect();
    let middle = head.len() / 2;
    let top_mm = (!head.is_empty()).then(|| *head.select_nth_unstable_by(middle, f64::total_cmp).1);
    let is_under = |plane: &SurfaceSample| {
        let along_axis = plane.normal(camera, pixel).map_or(0.0, |n| n.vector().z.abs());
        let highest_mm = HIGHEST * diameter_px * camera.pixel_mm(plane.depth_mm);
        along_axis > STEEPEST_SHEET.cos() && top_mm.is_none_or(|top_mm| plane.depth_mm - top_mm < highest_mm)
    };
    match usual {
        Some(sheet) if is_under(&sheet) => Some(sheet),
        _ => plane(STRIP_RING).filter(is_under).or(usual),
    }
}

fn believable(plane: &SurfaceSample, camera: &CameraModel, pixel: Pixel) -> bool {
    let steep = 1.0 / (1.0 + STEEPEST * STEEPEST).sqrt();
    plane.depth_mm > 1.0 && plane.normal(camera, pixel).is_some_and(|n| n.vector().z.abs() > steep)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::gaussian;

    const RIM_MM: f64 = 1480.0;
    const AT: Pixel = Pixel::new(400.3, 300.6);
    const DIAMETER_PX: f64 = 34.0;

    /// A domed head, its rim 3 mm above its sheet, with a recess 2 mm deep, tilted, half resolution, stereo noise.
    fn scene(keep: impl Fn(f64) -> bool) -> (DepthMap, CameraModel) {
        let camera = CameraModel::pinhole(800, 600, 4638.0, 4638.0);
        let (width, height, mut random) = (400, 300, 7);
        let mut map = DepthMap {
            width,
            height,
            step: 2,
            depth_mm: vec![0.0; 400 * 300],
        };
        for j in 0..height {
            for i in 0..width {
                let p = map.color_pixel(i, j);
                let r = p.distance_px(&AT) / DIAMETER_PX;
                let relief = if r < 0.23 {
                    2.0
                } else if r < 0.5 {
                    1.1 * (r * r - 0.23 * 0.23) / (0.5 * 0.5 - 0.23 * 0.23)
                } else {
                    3.0
                };
                let tilt = 0.03 * (p.u_px - AT.u_px) - 0.02 * (p.v_px - AT.v_px);
                if keep(r) {
                    let z = RIM_MM + tilt + relief + 0.28 * gaussian(&mut random);
                    map.depth_mm[(j * width + i) as usize] = z as f32;
                }
            }
        }
        (map, camera)
    }

    #[test]
    fn the_rim_is_not_biased_by_the_recess() {
        let (map, camera) = scene(|_| true);
        let found = locate(&map, &camera, AT, 0.2, DIAMETER_PX, &Corrections::default()).expect("depth all over");
        let error = found.point.z_mm() - RIM_MM;
        assert!(
            error.abs() < 0.2 && error.abs() < 4.0 * found.sigma_depth_mm,
            "{error} {found:?}"
        );
        assert_eq!(found.source, DepthSource::Head);
        assert!((found.sigma_lateral_mm - 0.2 * RIM_MM / 4638.0).abs() < 0.01);
        // 0.03 mm a pixel of 0.32 mm is a tilt of 5 degrees.
        assert!((0.98..0.998).contains(&-found.normal.vector().z), "{found:?}");
    }

    #[test]
    fn what_lies_below_the_rim_appears_where_the_camera_sees_it() {
        let (map, camera) = scene(|_| true);
        let [normal] = facings(&map, &camera, &[(AT, DIAMETER_PX)])[..] else {
            panic!("one head")
        };
        let normal = normal.expect("depth all over");
        let rim = camera.unproject(AT, RIM_MM);
        // one head diameter along the plane's normal into the sheet, seen by the same camera
        let below = rim.vector() - normal.vector() * DIAMETER_PX * camera.pixel_mm(RIM_MM);
        let seen = camera.project(Point::new(below.x, below.y, below.z)).expect("in view");
        let [du, dv] = parallax_px(&camera, AT, normal, DIAMETER_PX);
        let off = (seen.u_px - AT.u_px - du).hypot(seen.v_px - AT.v_px - dv);
        assert!(
            du.hypot(dv) > 2.0 && off < 0.05 * du.hypot(dv),
            "{du} {dv}, off by {off}"
        );
        // 0.03 and -0.02 mm a pixel of 0.32 mm
        let true_normal = Direction::new(0.094, -0.063, -1.0).expect("not zero");
        assert!(normal.angle_rad(true_normal) < 0.02, "{normal:?}");
    }

    #[test]
    fn a_head_at_an_edge_looks_where_the_others_look() {
        // five heads on a sheet that leans by 3 degrees; the last has a steep flank beside it
        let camera = CameraModel::pinhole(800, 600, 4638.0, 4638.0);
        let flank = |p: Pixel| if p.u_px > 600.0 { 0.16 * (p.u_px - 600.0) } else { 0.0 };
        let mut map = DepthMap {
            width: 400,
            height: 300,
            step: 2,
            depth_mm: vec![0.0; 400 * 300],
        };
        for k in 0..map.depth_mm.len() {
            let p = map.color_pixel(k as u32 % 400, k as u32 / 400);
            map.depth_mm[k] = (1500.0 + 0.017 * (p.v_px - 300.0) + flank(p)) as f32;
        }
        let heads = [100.0, 200.0, 300.0, 400.0, 660.0].map(|u| (Pixel::new(u, 300.0), 30.0));
        let found = facings(&map, &camera, &heads);
        let first = found[0].expect("depth all over");
        assert!(
            first.angle_rad(Direction::new(0.0, 0.0526, -1.0).expect("not zero")) < 0.01,
            "{first:?}"
        );
        for (k, facing) in found.iter().enumerate() {
            assert!(
                facing.expect("depth all over").angle_rad(first) < 0.01,
                "{k}: {facing:?}"
            );
        }
    }

    #[test]
    fn a_cable_before_a_part_of_a_head_is_not_taken_for_it() {
        let (mut map, camera) = scene(|_| true);
        for k in 0..map.depth_mm.len() {
            let p = map.color_pixel(k as u32 % map.width, k as u32 / map.width);
            let along = (p.u_px - AT.u_px) + 0.4 * (p.v_px - AT.v_px);
            if (-0.2..0.35).contains(&(along / DIAMETER_PX)) {
                map.depth_mm[k] = (RIM_MM - 9.0) as f32;
            }
        }
        let found = locate(&map, &camera, AT, 0.2, DIAMETER_PX, &Corrections::default()).expect("depth all over");
        assert!((found.point.z_mm() - RIM_MM).abs() < 0.8, "{found:?}");
    }

    #[test]
    fn a_head_far_before_all_that_is_measured_around_it_is_located_where_it_is() {
        // a stud: nothing of its sheet shows
        let (mut map, camera) = scene(|_| true);
        for k in 0..map.depth_mm.len() {
            let p = map.color_pixel(k as u32 % map.width, k as u32 / map.width);
            if p.distance_px(&AT) > 0.52 * DIAMETER_PX {
                map.depth_mm[k] += 60.0;
            }
        }
        let found = locate(&map, &camera, AT, 0.2, DIAMETER_PX, &Corrections::default()).expect("depth all over");
        assert!((found.point.z_mm() - RIM_MM).abs() < 3.0, "{found:?}");
    }

    #[test]
    fn a_head_on_a_strip_of_sheet_is_located_on_it() {
        // a strip not much wider than the head, and a plate 60 mm behind it
        let (mut map, camera) = scene(|_| true);
        for k in 0..map.depth_mm.len() {
            let p = map.color_pixel(k as u32 % map.width, k as u32 / map.width);
            if (p.u_px - AT.u_px).abs() > 0.68 * DIAMETER_PX {
                map.depth_mm[k] += 60.0;
            }
        }
        let found = locate(&map, &camera, AT, 0.2, DIAMETER_PX, &Corrections::default()).expect("depth all over");
        assert!((found.point.z_mm() - RIM_MM).abs() < 0.5, "{found:?}");
        let rise_mm = RimProfile::of(&map, &camera, AT, DIAMETER_PX)
            .expect("depth all over")
            .rise_mm();
        assert!((1.0..3.5).contains(&rise_mm), "{rise_mm}");
        assert!(found.normal.vector().z < -0.98, "{found:?}");
    }

    #[test]
    fn without_depth_on_the_head_the_sheet_serves() {
        let (map, camera) = scene(|r| r > 0.6);
        let found = locate(&map, &camera, AT, 0.2, DIAMETER_PX, &Corrections::default()).expect("depth on the sheet");
        assert_eq!(found.source, DepthSource::Sheet);
        let error = found.point.z_mm() - RIM_MM;
        assert!(
            error.abs() < 2.5 * found.sigma_depth_mm && found.sigma_depth_mm > 0.5,
            "{error} {found:?}"
        );
        let (none, camera) = scene(|_| false);
        assert!(locate(&none, &camera, AT, 0.2, DIAMETER_PX, &Corrections::default()).is_none());
    }
}
