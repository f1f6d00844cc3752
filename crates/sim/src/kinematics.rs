//! Where the controller of a GP25 believes its tool is: nominal kinematics, limits and times.
//!
//! `Base` is the robot's foot (`base_link`, as in the reference pairs): x forward, y left, z up from the foot.
//! Yaskawa's own base frame lies 505 mm above it; only a wire codec has to know.

use geometry::{Base, Flange, Tool, Transform};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rs_opw_kinematics::{
    constraints::Constraints,
    glam::{DQuat, DVec3},
    kinematic_traits::{Kinematics, Pose},
    kinematics_impl::OPWKinematics,
    parameters::opw_kinematics::Parameters,
};
use std::f64::consts::{FRAC_PI_2, PI};

/// Distance from J1 to J2 along x, mm.
pub(crate) const A1_MM: f64 = 150.0;
/// Offset of the forearm from J3 along its own x, mm.
pub(crate) const A2_MM: f64 = -200.0;
/// Height of J2 above the foot, mm.
pub(crate) const C1_MM: f64 = 505.0;
/// Upper arm, mm.
pub(crate) const C2_MM: f64 = 760.0;
/// Forearm, mm.
pub(crate) const C3_MM: f64 = 795.0;
/// Wrist centre to flange, mm.
pub(crate) const C4_MM: f64 = 100.0;
/// Encoder angle where the model stands straight up, rad.
const OFFSETS_RAD: [f64; 6] = [0.0, 0.0, -FRAC_PI_2, 0.0, 0.0, PI];
/// Direction of each joint.
const SIGNS: [f64; 6] = [1.0, 1.0, -1.0, -1.0, -1.0, -1.0];
/// Joint limits, degrees.
const LIMITS_DEG: [(f64, f64); 6] = [
    (-180.0, 180.0),
    (-105.0, 155.0),
    (-86.0, 160.0),
    (-200.0, 200.0),
    (-155.0, 150.0),
    (-455.0, 455.0),
];
/// Joint speed limits, degrees a second.
const SPEEDS_DEG_S: [f64; 6] = [210.0, 210.0, 265.0, 420.0, 420.0, 885.0];
/// Time from standstill to full speed, s.
const RISE_S: f64 = 0.3;
/// Time until the controller reports "in position" after the last motion, s.
const SETTLE_S: f64 = 0.08;
/// The wrist may not come nearer to its singularity than this, rad.
const WRIST_MARGIN_RAD: f64 = 0.14;

/// Joint angles of the rest position: tool high above the camera's view.
pub const HOME_RAD: [f64; 6] = [0.0, -0.6, -0.2, 0.0, 0.9, 0.0];
/// The middle of the arm's configuration (elbow up, wrist not flipped) in which it always works: one configuration
/// keeps the errors of the arm a smooth function of the place.
const WORK_RAD: [f64; 6] = [0.0, 0.4, -0.7, 0.0, 1.2, 0.0];

/// Why a pose cannot be taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Unreachable {
    /// Too far, too near or beyond a joint's range.
    #[error("no joint angles within limits reach ({0:.1}, {1:.1}, {2:.1}) mm in that orientation")]
    OutOfReach(f64, f64, f64),
    /// J5 too close to zero.
    #[error("J5 at {0:.1}° is within 8° of the wrist singularity")]
    WristSingularity(f64),
    /// NaN or infinite numbers.
    #[error("the target is not finite")]
    NotFinite,
}

/// A GP25 with its tool, as its controller knows it.
#[derive(Clone, Copy)]
pub struct Gp25 {
    solver: OPWKinematics,
    flange_from_tool: Transform<Flange, Tool>,
}

impl std::fmt::Debug for Gp25 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Gp25")
            .field("flange_from_tool", &self.flange_from_tool)
            .finish_non_exhaustive()
    }
}

impl Gp25 {
    /// An arm whose controller holds this tool point.
    pub fn new(flange_from_tool: Transform<Flange, Tool>) -> Self {
        let parameters = Parameters {
            a1: A1_MM / 1000.0,
            a2: A2_MM / 1000.0,
            b: 0.0,
            c1: C1_MM / 1000.0,
            c2: C2_MM / 1000.0,
            c3: C3_MM / 1000.0,
            c4: C4_MM / 1000.0,
            offsets: OFFSETS_RAD,
            sign_corrections: SIGNS.map(|s| s as i8),
            dof: 6,
        };
        let limits = LIMITS_DEG.map(|(low, high)| low..=high);
        Self {
            solver: OPWKinematics::new_with_constraints(parameters, Constraints::from_degrees(limits, 0.0)),
            flange_from_tool,
        }
    }

    /// The tool point that the controller holds.
    pub fn flange_from_tool(&self) -> Transform<Flange, Tool> {
        self.flange_from_tool
    }

    /// Pose of the tool for joint angles.
    pub fn forward(&self, joints_rad: [f64; 6]) -> Transform<Base, Tool> {
        Transform::<Base, Flange>::from_isometry(chain(model_angles(joints_rad), &Links::NOMINAL))
            * self.flange_from_tool
    }

    /// Joint angles for a pose of the tool, in the working configuration.
    ///
    /// # Errors
    /// [`Unreachable`] if there are none within the limits and clear of the wrist singularity.
    pub fn inverse(&self, base_from_tool: Transform<Base, Tool>) -> Result<[f64; 6], Unreachable> {
        let target = base_from_tool.isometry();
        let t = target.translation.vector;
        let q = target.rotation.coords;
        if !(t.iter().chain(q.iter()).all(|v| v.is_finite())) {
            return Err(Unreachable::NotFinite);
        }
        let flange = *(base_from_tool * self.flange_from_tool.inverse()).isometry();
        let (t_mm, r) = (flange.translation.vector, flange.rotation);
        let pose = Pose {
            translation: DVec3::new(t_mm.x, t_mm.y, t_mm.z) / 1000.0,
            rotation: DQuat::from_xyzw(r.i, r.j, r.k, r.w).normalize(),
        };
        let ahead = t_mm.y.atan2(t_mm.x);
        let strangeness = |q: &[f64; 6]| -> f64 {
            let turn = |a: f64, b: f64| (a - b).sin().abs() + 2.0 * (1.0 - (a - b).cos());
            turn(q[0], ahead)
                + (1..5)
                    .map(|j| (q[j] - WORK_RAD[j]).abs() * if j == 3 { 0.5 } else { 1.0 })
                    .sum::<f64>()
                + 0.01 * q[5].abs()
        };
        let joints = self
            .solver
            .inverse_continuing(&pose, &WORK_RAD)
            .into_iter()
            .filter(within_limits)
            .min_by(|a, b| strangeness(a).total_cmp(&strangeness(b)))
            .ok_or(Unreachable::OutOfReach(t.x, t.y, t.z))?;
        if joints[4].sin().abs() < WRIST_MARGIN_RAD.sin() {
            return Err(Unreachable::WristSingularity(joints[4].to_degrees()));
        }
        Ok(joints)
    }

    /// Shortest time for a motion of all joints together, s: each joint rises to its speed limit within 0.3 s with a
    /// limited jerk, the slowest one decides.
    pub fn joint_time_s(from_rad: [f64; 6], to_rad: [f64; 6]) -> f64 {
        let slowest = (0..6)
            .map(|j| trapezoid_s((to_rad[j] - from_rad[j]).abs(), SPEEDS_DEG_S[j].to_radians()))
            .fold(0.0, f64::max);
        slowest + SETTLE_S
    }

    /// Time for a straight line of the tool point at this speed, s.
    pub fn linear_time_s(distance_mm: f64, speed_mm_s: f64) -> f64 {
        trapezoid_s(distance_mm, speed_mm_s.max(0.1)) + SETTLE_S
    }
}

/// Time for a way with a trapezoid of speed, s; short ways never reach full speed.
fn trapezoid_s(way: f64, speed: f64) -> f64 {
    let rise_way = speed * RISE_S;
    if way >= rise_way {
        way / speed + RISE_S
    } else {
        2.0 * (way * RISE_S / speed).sqrt()
    }
}

/// True if every joint is inside its range.
pub(crate) fn within_limits(joints_rad: &[f64; 6]) -> bool {
    joints_rad
        .iter()
        .zip(LIMITS_DEG)
        .all(|(q, (low, high))| (low..=high).contains(&q.to_degrees()))
}

/// Angles of the model (straight up at zero) for encoder angles.
pub(crate) fn model_angles(joints_rad: [f64; 6]) -> [f64; 6] {
    std::array::from_fn(|j| joints_rad[j] * SIGNS[j] - OFFSETS_RAD[j])
}

/// The rigid parts between the joints, base to flange: part `i` lies before joint `i + 1`, the last one after J6.
#[derive(Clone, Debug)]
pub(crate) struct Links(pub [Isometry3<f64>; 7]);

impl Links {
    /// Lengths as in the data sheet.
    pub(crate) const NOMINAL: Links = Links([
        at(0.0, 0.0, 0.0),
        at(A1_MM, 0.0, C1_MM),
        at(0.0, 0.0, C2_MM),
        at(A2_MM, 0.0, C3_MM),
        at(0.0, 0.0, 0.0),
        at(0.0, 0.0, 0.0),
        at(0.0, 0.0, C4_MM),
    ]);
}

const fn at(x: f64, y: f64, z: f64) -> Isometry3<f64> {
    Isometry3 {
        rotation: UnitQuaternion::new_unchecked(Quaternion::new(1.0, 0.0, 0.0, 0.0)),
        translation: Translation3 {
            vector: Vector3::new(x, y, z),
        },
    }
}

/// Poses of everything from base to flange: the product of links and joints. J1, J4 and J6 turn about z, the others about y.
pub(crate) fn chain(model_rad: [f64; 6], links: &Links) -> Isometry3<f64> {
    let mut pose = links.0[0];
    for (j, angle) in model_rad.into_iter().enumerate() {
        let axis = if matches!(j, 0 | 3 | 5) {
            Vector3::z_axis()
        } else {
            Vector3::y_axis()
        };
        pose = pose * UnitQuaternion::from_axis_angle(&axis, angle) * links.0[j + 1];
    }
    pose
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::{draw, signed};
    use crate::layout;
    use geometry::Point;

    fn arm() -> Gp25 {
        Gp25::new(layout::flange_from_tool())
    }

    #[test]
    fn forward_agrees_with_the_reference_solver() {
        let arm = Gp25::new(Transform::identity());
        let mut rng = draw(3, &[]);
        for _ in 0..200 {
            let q: [f64; 6] = std::array::from_fn(|_| 2.0 * signed(&mut rng));
            let own = *arm.forward(q).isometry();
            let pose = arm.solver.forward(&q);
            let t = pose.translation * 1000.0;
            assert!((own.translation.vector - Vector3::new(t.x, t.y, t.z)).norm() < 1e-6);
            let r = pose.rotation;
            let r = UnitQuaternion::from_quaternion(Quaternion::new(r.w, r.x, r.y, r.z));
            assert!(own.rotation.angle_to(&r) < 1e-6);
        }
    }

    /// A row of the published calibration pairs: joint angles and the commanded place of a marker 200 mm before the flange.
    #[test]
    fn forward_agrees_with_a_recorded_visit() {
        let tool = Transform::from_parts([0.0, -40.0, 200.0], UnitQuaternion::identity());
        let q = [-0.644115, 0.896367, -0.832467, 0.650147, 1.696977, 0.095407];
        let at = Gp25::new(tool).forward(q) * Point::new(0.0, 0.0, 0.0);
        assert!(at.distance_mm(Point::new(952.498, -450.0, 163.0146)) < 0.01, "{at:?}");
    }

    #[test]
    fn both_arms_reach_the_whole_lattice_clear_of_the_singularity() {
        for index in 0..2 {
            let [low, high] = layout::volume(index);
            for (i, j, k) in (0..9).flat_map(|i| (0..19).flat_map(move |j| (0..16).map(move |k| (i, j, k)))) {
                // 40 mm nearer than the lattice too: from there the bit goes in
                for back_mm in [0.0, 40.0] {
                    let at = Point::new(
                        low.x_mm() + 50.0 * f64::from(i) - back_mm,
                        low.y_mm() + 50.0 * f64::from(j),
                        low.z_mm() + 50.0 * f64::from(k),
                    );
                    assert!(at.x_mm() <= high.x_mm() && at.y_mm() <= high.y_mm() && at.z_mm() <= high.z_mm());
                    let target = layout::tool_at(at);
                    let q = arm()
                        .inverse(target)
                        .unwrap_or_else(|e| panic!("arm {index} at {at:?}: {e}"));
                    let reached = arm().forward(q) * Point::new(0.0, 0.0, 0.0);
                    assert!(reached.distance_mm(at) < 1e-3);
                    assert!(q[4] > 0.5, "J5 at {} rad is near its singularity at {at:?}", q[4]);
                }
            }
        }
    }

    #[test]
    fn one_configuration_everywhere() {
        let [low, high] = layout::volume(0);
        let mut last: Option<[f64; 6]> = None;
        for step in 0..=200 {
            let t = f64::from(step) / 200.0;
            let at = Point::from_vector(low.vector() + (high.vector() - low.vector()) * t);
            let q = arm().inverse(layout::tool_at(at)).expect("in reach");
            if let Some(before) = last {
                assert!((0..6).all(|j| (q[j] - before[j]).abs() < 0.1), "a jump at {at:?}");
            }
            last = Some(q);
        }
    }

    #[test]
    fn times_follow_the_speed_limits() {
        assert!((trapezoid_s(210.0, 210.0) - 1.3).abs() < 1e-9);
        assert!((trapezoid_s(63.0, 210.0) - 0.6).abs() < 1e-9);
        assert_eq!(Gp25::joint_time_s(HOME_RAD, HOME_RAD), SETTLE_S);
        let work = arm()
            .inverse(layout::tool_at(Point::new(1060.0, 300.0, 300.0)))
            .expect("in reach");
        let time_s = Gp25::joint_time_s(HOME_RAD, work);
        assert!((0.5..1.5).contains(&time_s), "{time_s} s from home to work");
    }
}
