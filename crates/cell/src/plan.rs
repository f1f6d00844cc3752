//! From finds to targets: which may be acted on, by which arm, along which line, in which order; and what excludes a unit.
//!
//! A robot can only be sent to a [`SafeTarget`], and the only way to get one is from a map whose calibrated volume holds both the
//! screw and the way to it, and from an arm that can go that way without running into anything. What lies at the border or
//! outside, or behind something, is reported, never commanded.

mod allot;

use crate::capture::{Shot, region_of};
use crate::config::{Approach, CellConfig};
use crate::device::Region;
use crate::motion::{ArmMotion, Refusal, Way};
use crate::plane::{FaceFit, sheet_normal, tilt_rad};
use crate::record::{ExclusionReason, FaceRecord, Found, Hull, LeftAlone, Verdict};
use calibration::{Map, MappedPoint};
use geometry::{Base, Camera, CameraModel, Direction, Pixel, Point, Tool, Transform};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Shortest way in front of a screw on which the bit can still be lined up, mm.
const SHORTEST_STANDOFF_MM: f64 = 8.0;

/// Joint angles that differ by less belong to the same way, rad: a millimetre at the bit.
const SAME_WAY_RAD: f64 = 5e-4;

/// The screws of a face stand no farther in front of its plane or behind it, mm: ribs and sunk flanges.
const ON_FACE_MM: f64 = 20.0;
/// Or on a plate that looks the same way, no farther from it than this, mm.
const PLATES_MM: f64 = 80.0;
/// How far such a plate may lean from the face, rad.
const SAME_WAY_AS_FACE_RAD: f64 = 0.06;
/// Sheet and head lean alike if they lean no further from each other, rad.
const SAME_LEAN_RAD: f64 = 0.07;
/// Heads that lean together by less are those of a straight face: so much it may be measured to be, and so far a bit holds that comes along the face's
/// normal, rad (8°).
const HEADS_LEAN_FROM_RAD: f64 = 0.14;

/// The sheet around a head is looked at so far from it, in its diameters.
const AROUND_A_HEAD: f64 = 2.0;
/// Doubtful heads that are screws are not met at the first burst in so many cases; assumed.
const NOT_MET: f64 = 0.15;

/// A place that an arm may be sent to: the point and the straight way to it lie in the calibrated volume of that arm's map, and
/// the whole way there is free.
///
/// ```compile_fail
/// // there is no way to make one up
/// let target = cell::plan::SafeTarget { arm: 0, tip: geometry::Point::new(0.0, 0.0, 0.0) };
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafeTarget {
    arm: usize,
    tip: Point<Base>,
    approach: Direction<Base>,
    standoff_mm: f64,
}

impl SafeTarget {
    /// Maps a point seen by the camera into an arm's base, and looks at the way there.
    ///
    /// # Arguments
    /// * `normal` – of the surface, towards the camera: the bit comes against it.
    /// * `approach` – its standoff is shortened where the volume ends before.
    ///
    /// # Returns
    /// The place, and the free way there.
    ///
    /// # Errors
    /// [`Refused`], if the point or every straight way to it leaves the volume, or the arm cannot go there safely.
    pub fn locate(
        reach: &Reach<'_>,
        point: Point<Camera>,
        normal: Direction<Camera>,
        approach: &Approach,
    ) -> Result<(Self, Way), Refused> {
        let place = Self::in_volume(reach, point, normal, approach.standoff_mm)?;
        let way = place.check(reach.motion, reach.joints_rad, approach)?;
        Ok((place, way))
    }

    fn in_volume(
        reach: &Reach<'_>,
        point: Point<Camera>,
        normal: Direction<Camera>,
        standoff_mm: f64,
    ) -> Result<Self, LeftAlone> {
        let map = reach.map;
        let mapped = map.apply(point);
        match mapped.hull {
            Hull::Inside => {}
            Hull::Edge => return Err(LeftAlone::HullEdge),
            Hull::Outside => return Err(LeftAlone::HullOutside),
        }
        let (tip, volume) = (mapped.base, map.volume());
        let outward = map.base_from_camera() * normal;
        if !(tip.is_finite() && volume.contains(tip)) {
            return Err(LeftAlone::HullEdge);
        }
        let standoff_mm = [1.0, 0.75, 0.5, 0.25]
            .map(|share| share * standoff_mm)
            .into_iter()
            .find(|mm| *mm >= SHORTEST_STANDOFF_MM && volume.contains(tip.moved(outward, *mm)))
            .ok_or(LeftAlone::HullEdge)?;
        let approach = Direction::from_vector(-outward.vector()).ok_or(LeftAlone::HullEdge)?;
        Ok(Self {
            arm: reach.arm,
            tip,
            approach,
            standoff_mm,
        })
    }

    /// Looks at the whole way there from where the arm's joints are.
    ///
    /// # Errors
    /// [`Refusal`], with what is in the way.
    pub fn check(&self, motion: &ArmMotion, joints_rad: [f64; 6], approach: &Approach) -> Result<Way, Refusal> {
        let speed_mm_s = approach.approach_mm_s;
        motion.check(joints_rad, self.standoff_pose(), self.contact_pose(), speed_mm_s)
    }

    /// A place so far beside it, across the approach, along the tool's axes, and so much deeper; `None` if that or the way to it leaves the volume.
    pub fn beside(&self, map: &Map, across_mm: [f64; 2], deeper_mm: f64) -> Option<Self> {
        let tool = tool_pose(self.tip, self.approach);
        let tip = tool * Point::new(across_mm[0], across_mm[1], deeper_mm);
        let moved = Self { tip, ..*self };
        let start = tip.moved(self.approach, -self.standoff_mm);
        let volume = map.volume();
        (volume.contains(tip) && volume.contains(start)).then_some(moved)
    }

    /// Number of the arm.
    pub fn arm(&self) -> usize {
        self.arm
    }
    /// Where the bit meets the screw.
    pub fn tip(&self) -> Point<Base> {
        self.tip
    }
    /// Direction in which the bit comes.
    pub fn approach(&self) -> Direction<Base> {
        self.approach
    }
    /// Where the straight way to it begins, mm before it.
    pub fn standoff_mm(&self) -> f64 {
        self.standoff_mm
    }
    /// Pose of the tool with the bit in the screw.
    pub fn contact_pose(&self) -> Transform<Base, Tool> {
        tool_pose(self.tip, self.approach)
    }
    /// Where the bit waits in front of the screw, on the straight way to it.
    pub fn standoff(&self) -> Point<Base> {
        self.tip.moved(self.approach, -self.standoff_mm)
    }
    /// Pose of the tool there.
    pub fn standoff_pose(&self) -> Transform<Base, Tool> {
        tool_pose(self.standoff(), self.approach)
    }
}

/// Pose of the tool with its tip at a point and the bit along a direction: z along the bit, x as far up as that allows, as in
/// every visit of the calibration (a tool that is turned about the bit would reach with another error).
pub fn tool_pose(tip: Point<Base>, approach: Direction<Base>) -> Transform<Base, Tool> {
    let z = approach.vector();
    let up = if z.z.abs() > 0.99 { Vector3::x() } else { Vector3::z() };
    let x = (up - z * up.dot(&z)).normalize();
    let columns = [x, z.cross(&x), z];
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&columns));
    Transform::from_parts(tip.to_array(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// A screw that an arm could take out, and how.
#[derive(Clone, Debug)]
struct Candidate {
    /// Its number in [`FaceRecord::found`].
    found: usize,
    point: Point<Camera>,
    choices: Vec<Choice>,
}

/// An arm's way to a screw.
#[derive(Clone, Debug)]
struct Choice {
    place: SafeTarget,
    way: Way,
}

/// A screw that will be acted on.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Its number in [`FaceRecord::found`].
    pub found: usize,
    /// Where the arm may go.
    pub place: SafeTarget,
    /// The room that is kept for it; `None` if the other arm rests meanwhile.
    pub room: Option<Room>,
}

/// What an arm may do at a screw while the other one is at work: the ways whose room was looked at when the face was shared out.
#[derive(Clone, Debug, PartialEq)]
pub struct Room {
    /// How far across it reaches, in steps: 0 wherever the other arm is; see [`Dispatcher::at_face`](crate::schedule::dispatch::Dispatcher::at_face).
    pub reach: usize,
    /// Where the joints are from the rest to in front of it: at the beginning and at the end of each move, rad.
    pub from_rest_rad: Vec<[f64; 6]>,
    /// The same from in front of the screw before; empty where it is come to from the rest.
    pub from_last_rad: Vec<[f64; 6]>,
}

impl Room {
    /// True if a way is one of those that were looked at, or leads nowhere from in front of the screw.
    pub fn holds(&self, way: &Way) -> bool {
        let near = |a: &[f64; 6], b: &[f64; 6]| (0..6).all(|j| (a[j] - b[j]).abs() < SAME_WAY_RAD);
        let begin = way.joint.first().map(|leg| leg.trajectory.begin_rad());
        let ends = way.joint.iter().map(|leg| leg.trajectory.end_rad());
        let at: Vec<[f64; 6]> = begin.into_iter().chain(ends).collect();
        let is =
            |planned: &Vec<[f64; 6]>| planned.len() == at.len() && planned.iter().zip(&at).all(|(a, b)| near(a, b));
        let there = self.from_rest_rad.last();
        is(&self.from_rest_rad)
            || is(&self.from_last_rad)
            || at.iter().all(|q| there.is_some_and(|there| near(q, there)))
    }
}

/// An arm that can take screws out.
#[derive(Clone, Copy, Debug)]
pub struct Reach<'a> {
    /// Number of the arm.
    pub arm: usize,
    /// Its map.
    pub map: &'a Map,
    /// What is around it.
    pub motion: &'a ArmMotion,
    /// Where its joints are now, rad.
    pub joints_rad: [f64; 6],
}

impl<'a> Reach<'a> {
    /// An arm at rest.
    pub fn from_rest(arm: usize, map: &'a Map, motion: &'a ArmMotion) -> Self {
        Self {
            arm,
            map,
            motion,
            joints_rad: motion.home_rad(),
        }
    }
}

/// The part of the picture in which there can be a target: the calibrated volumes as the camera sees them, and as much more as is looked at around a
/// head. `None` if that cannot be told, or the camera sees nothing of them.
pub fn region_in_reach<'a>(
    camera: &CameraModel,
    maps: impl IntoIterator<Item = &'a Map>,
    head_mm: f64,
) -> Option<Region> {
    // corners and middles: a lens bends the edges
    let places = maps.into_iter().flat_map(|map| {
        let camera_from_base = map.base_from_camera().inverse();
        let share = |k: u32| f64::from(k % 3) / 2.0;
        (0..27).map(move |k| camera_from_base * map.volume().at([share(k), share(k / 3), share(k / 9)]))
    });
    let places: Vec<Point<Camera>> = places.collect();
    let nearest_mm = places.iter().map(Point::z_mm).reduce(f64::min)?;
    // a volume that begins behind the camera may show anywhere
    let pixels: Option<Vec<Pixel>> = places.iter().map(|place| camera.project(*place)).collect();
    let around_px = AROUND_A_HEAD * head_mm / camera.pixel_mm(nearest_mm).max(1e-6);
    region_of(camera, &pixels?, around_px)
}

/// Why an arm is not sent to a find.
#[derive(Clone, Debug, PartialEq)]
pub struct Refused {
    /// The reason.
    pub why: LeftAlone,
    /// What exactly is in the way, if the arm could not have gone there.
    pub detail: Option<String>,
}

impl From<LeftAlone> for Refused {
    fn from(why: LeftAlone) -> Self {
        Self { why, detail: None }
    }
}

impl From<Refusal> for Refused {
    fn from(refusal: Refusal) -> Self {
        Self {
            why: (&refusal).into(),
            detail: Some(refusal.to_string()),
        }
    }
}

impl Refused {
    /// Of what two arms say that which came nearer to a target; both where neither could have gone there.
    fn or(self, other: Self) -> Self {
        let nearness = |refused: &Self| match refused.why {
            LeftAlone::HullOutside => 0,
            LeftAlone::HullEdge => 1,
            _ => 2,
        };
        match (nearness(&self).cmp(&nearness(&other)), &self.detail, &other.detail) {
            (std::cmp::Ordering::Less, ..) => other,
            (std::cmp::Ordering::Equal, Some(a), Some(b)) => Self {
                detail: Some(format!("{a}; {b}")),
                ..self
            },
            _ => self,
        }
    }
}

/// What the picture alone says.
///
/// # Arguments
/// * `fits` – probability with the odds.
/// * `odds` – how much likelier other evidence makes it than the picture says.
pub fn without_odds(fits: f64, odds: f64) -> f64 {
    fits / (fits + odds * (1.0 - fits))
}

/// True if the picture alone rather says that it is no screw: only the odds of a stuck cover speak for it.
pub fn is_doubtful(fits: f64, odds: f64) -> bool {
    without_odds(fits, odds) < 0.5
}

/// Leaves of the doubtful heads the `most` likely ones; the others are for a person to look at. One missed screw holds a cover: that is
/// evidence for the best few, not for every crossing of a grille.
///
/// # Arguments
/// * `before` – finds of the same face when it was looked at without the odds: what was in doubt then and is now is likelier than
///   what one of two pictures shows.
/// * `was_not_met` – whether the bit was driven at one before and met nothing, which makes it less likely a screw.
/// * `face` – where the face lies: what is far from it, and not on a plate that looks the same way, is a gap of a grille.
pub fn bound_doubtful(
    screws: &mut [vision::Screw],
    odds: f64,
    most: usize,
    before: &[Found],
    was_not_met: impl Fn(&vision::Screw) -> bool,
    face: Option<&FaceFit>,
    shot: &Shot,
) {
    let on_face = |screw: &vision::Screw| {
        let (Some(face), Some(at)) = (face, screw.camera) else {
            return false; // no depth, no target
        };
        let off_mm = (at.z_mm() - face.depth_mm(screw.pixel)).abs();
        let looks_the_same_way = || {
            let sheet = sheet_normal(&shot.frame, screw.pixel, screw.diameter_px);
            sheet.is_some_and(|sheet| sheet.angle_rad(face.normal()) <= SAME_WAY_AS_FACE_RAD)
        };
        off_mm <= ON_FACE_MM || off_mm <= PLATES_MM && looks_the_same_way()
    };
    let seen_before = |screw: &vision::Screw| {
        let at = shot.to_whole(screw.pixel);
        let near = |f: &&Found| at.distance_px(&Pixel::new(f.u_px, f.v_px)) < screw.diameter_px;
        let in_doubt = before.iter().filter(|f| f.verdict == Verdict::Review).filter(near);
        in_doubt.map(|f| f.score).fold(0.0, f64::max)
    };
    let doubtful = screws
        .iter_mut()
        .filter(|s| s.verdict == Verdict::Screw && is_doubtful(s.fits, odds));
    let likelihood = |screw: &vision::Screw| {
        let seen = without_odds(screw.fits, odds).max(seen_before(screw));
        if was_not_met(screw) { NOT_MET * seen } else { seen }
    };
    let mut doubtful: Vec<(f64, &mut vision::Screw)> = doubtful.map(|s| (likelihood(s), s)).collect();
    doubtful.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (likely, behind): (Vec<_>, Vec<_>) = doubtful.into_iter().partition(|(_, s)| on_face(s));
    for (_, screw) in likely.into_iter().skip(most).chain(behind) {
        screw.verdict = Verdict::Review;
    }
}

/// Turns the detector's finds into records and targets.
///
/// # Returns
/// Every find with its place and, if it is left alone, the reason; and the targets: which arm does which, in which order.
pub fn plan(
    screws: &[vision::Screw],
    shot: &Shot,
    face: Option<&FaceFit>,
    arms: &[Reach<'_>],
    config: &CellConfig,
) -> (Vec<Found>, Vec<Target>) {
    let mut found = Vec::with_capacity(screws.len());
    let mut candidates = Vec::new();
    for screw in screws {
        let (entry, choices) = judge(screw, shot, face, arms, config);
        if let (false, Some(point)) = (choices.is_empty(), screw.camera) {
            candidates.push(Candidate {
                found: found.len(),
                point,
                choices,
            });
        }
        found.push(entry);
    }
    let targets = allot::allot(&candidates, arms, config);
    for (target, candidate) in targets
        .iter()
        .filter_map(|t| Some((t, candidates.iter().find(|c| c.found == t.found)?)))
    {
        // the arm that goes there decides what the record says
        if let Some(reach) = arms.iter().find(|r| r.arm == target.place.arm()) {
            found[target.found].base_mm = Some(target.place.tip());
            found[target.found].hull = Some(reach.map.apply(candidate.point).hull);
        }
    }
    (found, targets)
}

fn judge(
    screw: &vision::Screw,
    shot: &Shot,
    face: Option<&FaceFit>,
    arms: &[Reach<'_>],
    config: &CellConfig,
) -> (Found, Vec<Choice>) {
    let whole = shot.to_whole(screw.pixel);
    let sheet = sheet_normal(&shot.frame, screw.pixel, screw.diameter_px);
    let mapped: Option<MappedPoint> = screw
        .camera
        .and_then(|point| arms.first().map(|reach| reach.map.apply(point)));
    let mut found = Found {
        u_px: whole.u_px,
        v_px: whole.v_px,
        sigma_px: screw.sigma_px,
        diameter_px: screw.diameter_px,
        score: screw.score,
        drive: screw.drive.name().into(),
        verdict: screw.verdict,
        camera_mm: screw.camera,
        base_mm: mapped.map(|m| m.base),
        sigma_lateral_mm: mapped.map(|m| m.sigma_lateral_mm.hypot(screw.sigma_lateral_mm.unwrap_or(0.0))),
        sigma_depth_mm: mapped.map(|m| m.sigma_depth_mm.hypot(screw.sigma_depth_mm.unwrap_or(0.0))),
        hull: mapped.map(|m| m.hull),
        tilt_rad: leaning(sheet, head_normal(screw), -Vector3::z()),
        left_alone: None,
        refusal: None,
    };
    match target(screw, shot, sheet, face, arms, config) {
        Ok(choices) => (found, choices),
        Err(refused) => {
            found.left_alone = Some(refused.why);
            found.refusal = refused.detail;
            (found, Vec::new())
        }
    }
}

/// Every arm that can go to a screw, in the order of the arms.
fn target(
    screw: &vision::Screw,
    shot: &Shot,
    sheet: Option<Direction<Camera>>,
    face: Option<&FaceFit>,
    arms: &[Reach<'_>],
    config: &CellConfig,
) -> Result<Vec<Choice>, Refused> {
    match screw.verdict {
        Verdict::Screw => {}
        Verdict::Other => return Err(LeftAlone::OtherDrive.into()),
        Verdict::Review => return Err(LeftAlone::Review.into()),
    }
    let point = screw.camera.ok_or(LeftAlone::NoDepth)?;
    if !is_head_size(screw.diameter_px, point, shot, config) {
        return Err(LeftAlone::HeadSize.into());
    }
    let normal = line_of_approach(sheet, screw.top_normal, face, config).ok_or(LeftAlone::NoDepth)?;
    // one measurement alone may be that of an edge
    let askew = screw
        .top_normal
        .and_then(|top| leaning(sheet, Some(top), normal.vector()));
    if askew.is_some_and(|lean| lean > config.exclusion.screw_tilt_max_rad) {
        return Err(LeftAlone::Bent.into());
    }
    let mut refused = Refused::from(LeftAlone::HullOutside);
    let mut choices = Vec::new();
    for reach in arms {
        match SafeTarget::locate(reach, point, normal, &config.approach) {
            Ok((place, way)) => choices.push(Choice { place, way }),
            Err(why) => refused = refused.or(why),
        }
        if config.work.arms < 2 && !choices.is_empty() {
            break; // the others only stand in for the first
        }
    }
    if choices.is_empty() { Err(refused) } else { Ok(choices) }
}

fn is_head_size(diameter_px: f64, point: Point<Camera>, shot: &Shot, config: &CellConfig) -> bool {
    let [least, most] = config.inspection.head_mm;
    let scale = shot.frame.camera.map(|camera| camera.pixel_mm(point.z_mm()));
    scale.is_none_or(|mm| (least..=most).contains(&(diameter_px * mm)))
}

/// Normal of the head's top; where that was not measured, of the sheet as it agrees with that around the other heads.
fn head_normal(screw: &vision::Screw) -> Option<Direction<Camera>> {
    screw.top_normal.or(screw.normal)
}

/// How far the sheet leans from a line. Two independent measurements, the sheet around the head and the top of the head, have to say so, and both to
/// the same side: an edge nearby spoils the one, a head seated askew the other.
fn leaning(sheet: Option<Direction<Camera>>, head: Option<Direction<Camera>>, line: Vector3<f64>) -> Option<f64> {
    let off = |normal: Direction<Camera>| normal.vector().angle(&line);
    match (sheet, head) {
        (Some(sheet), Some(head)) => {
            let across = |n: Direction<Camera>| n.vector() - line * n.vector().dot(&line);
            let same_side = across(sheet).dot(&across(head)) / (across(sheet).norm() * across(head).norm()).max(1e-12);
            Some(off(sheet).min(off(head)) * same_side.max(0.0))
        }
        (one, other) => one.or(other).map(off),
    }
}

/// The normal that the bit follows: the face's plane, which is measured best, unless all heads on it lean from it together (a bent cover: they tell more
/// than one of them), or the sheet around the screw and its head both do, and the same way (a dent).
fn line_of_approach(
    sheet: Option<Direction<Camera>>,
    head: Option<Direction<Camera>>,
    face: Option<&FaceFit>,
    config: &CellConfig,
) -> Option<Direction<Camera>> {
    let Some(fit) = face else {
        // a plane through an edge leans more than the sheet does
        return [sheet, head]
            .into_iter()
            .flatten()
            .min_by(|a, b| tilt_rad(*a).total_cmp(&tilt_rad(*b)));
    };
    let face = fit.normal();
    let leans = |normal: Direction<Camera>| normal.angle_rad(face) > config.approach.local_normal_from_rad;
    let bent = HEADS_LEAN_FROM_RAD..=config.exclusion.heads_lean_max_rad;
    if let Some(heads) = fit.heads().filter(|heads| bent.contains(&heads.angle_rad(face))) {
        return Some(heads);
    }
    match (sheet, head) {
        (Some(sheet), Some(head)) if leans(sheet) && leans(head) && sheet.angle_rad(head) <= SAME_LEAN_RAD => {
            Some(sheet)
        }
        _ => Some(face),
    }
}

/// Why a unit is excluded after this look at a face, if it is: judged on the picture, before anything on the face is touched.
pub fn exclusion(face: &FaceRecord, least_screws: usize, config: &CellConfig) -> Option<(ExclusionReason, String)> {
    let rules = &config.exclusion;
    let name = &face.face;
    if let Some(plane) = face.plane.filter(|plane| plane.tilt_rad > rules.face_tilt_max_rad) {
        let (tilt, most) = (plane.tilt_rad.to_degrees(), rules.face_tilt_max_rad.to_degrees());
        return Some((
            ExclusionReason::CoverBent,
            format!("{name}: the face leans by {tilt:.1}°, more than {most:.1}°"),
        ));
    }
    let leaning = face.plane.and_then(|plane| plane.heads_lean_rad);
    if let Some(lean) = leaning.filter(|lean| *lean > rules.heads_lean_max_rad) {
        let (lean, most) = (lean.to_degrees(), rules.heads_lean_max_rad.to_degrees());
        return Some((
            ExclusionReason::CoverBent,
            format!("{name}: its screws lean together by {lean:.1}°, more than {most:.1}°"),
        ));
    }
    let count = |reason: LeftAlone| face.found.iter().filter(|f| f.left_alone == Some(reason)).count();
    let bent = count(LeftAlone::Bent);
    if bent > rules.bent_max {
        return Some((
            ExclusionReason::CoverBent,
            format!("{name}: {bent} screw(s) lean beyond range"),
        ));
    }
    let sure_enough = |f: &&Found| f.verdict == Verdict::Review && f.score >= rules.review_score_min;
    let unclear: Vec<&Found> = face.found.iter().filter(sure_enough).collect();
    if unclear.len() > rules.review_max {
        let places: Vec<String> = unclear
            .iter()
            .map(|f| format!("({:.0}, {:.0})", f.u_px, f.v_px))
            .collect();
        return Some((
            ExclusionReason::SlotNotWorkable,
            format!(
                "{name}: {} head(s) whose recess cannot be judged, at pixel {}",
                unclear.len(),
                places.join(" ")
            ),
        ));
    }
    let screws = face.found.iter().filter(|f| f.verdict == Verdict::Screw).count();
    (screws < least_screws).then(|| {
        (
            ExclusionReason::ScrewsNotFound,
            format!("{name}: {screws} screw(s) found, the product has at least {least_screws}"),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_leans_only_if_sheet_and_head_lean_to_the_same_side() {
        let towards = |degrees: f64, turned: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let (v, u) = turned.to_radians().sin_cos();
            Direction::new(sin * u, sin * v, -cos)
        };
        let lean = |sheet, head| leaning(sheet, head, -Vector3::z()).expect("measured").to_degrees();
        assert!((lean(towards(14.0, 30.0), towards(12.0, 40.0)) - 12.0).abs() < 0.3);
        assert!(lean(towards(16.0, 30.0), towards(16.0, 125.0)) < 0.1);
        assert!(lean(towards(16.0, 30.0), towards(2.0, 30.0)) < 2.1);
        assert!((lean(towards(13.0, 0.0), None) - 13.0).abs() < 1e-6);
        assert_eq!(leaning(None, None, -Vector3::z()), None);
    }

    fn towards(degrees: f64) -> Option<Direction<Camera>> {
        let (sin, cos) = degrees.to_radians().sin_cos();
        Direction::new(sin, 0.0, -cos)
    }

    /// A face that looks straight at the camera, its heads perhaps not.
    fn straight_face(heads_normal: Option<Direction<Camera>>) -> FaceFit {
        let plane = crate::record::FacePlane {
            depth_mm: 1500.0,
            tilt_rad: 0.0,
            normal: towards(0.0),
            heads_lean_rad: None,
            heads_normal,
        };
        FaceFit::known(&plane, geometry::CameraModel::pinhole(800, 600, 900.0, 900.0)).expect("known")
    }

    #[test]
    fn the_bit_follows_the_face_unless_sheet_and_head_lean_alike() {
        let face = straight_face(None);
        let config = CellConfig::simulated();
        let line = |sheet: f64, head: f64| {
            let line = line_of_approach(towards(sheet), towards(head), Some(&face), &config).expect("a line");
            line.angle_rad(face.normal()).to_degrees()
        };
        assert!((line(9.0, 8.0) - 9.0).abs() < 1e-6, "a dent");
        assert_eq!(line(60.0, 9.0), 0.0, "a plane through an edge");
        assert_eq!(line(4.0, 4.0), 0.0, "no more than the measurement");
        assert_eq!(line(9.0, -8.0), 0.0);
    }

    #[test]
    fn on_a_bent_cover_the_bit_follows_what_all_heads_say() {
        let line = |heads: f64, own: f64| {
            let face = straight_face(towards(heads));
            let sheet = towards(0.0);
            let line = line_of_approach(sheet, towards(own), Some(&face), &CellConfig::simulated());
            line.expect("a line").angle_rad(face.normal()).to_degrees()
        };
        assert!(
            (line(13.0, 4.0) - 13.0).abs() < 1e-6,
            "one head alone is measured badly"
        );
        assert_eq!(line(7.5, 9.0), 0.0, "no more than the measurement");
    }
}
