//! Where the controller of a GP25 believes its tool is: nominal kinematics and limits.
//!
//! `Base` is the robot's foot (`base_link`, as in the reference pairs): x forward, y left, z up from the foot.
//! Yaskawa's own base frame lies 505 mm above it; only a wire codec has to know.

use super::profile::Limits;
use super::trajectory::Trajectory;
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
pub const A1_MM: f64 = 150.0;
/// Offset of the forearm from J3 along its own x, mm.
pub const A2_MM: f64 = -200.0;
/// Height of J2 above the foot, mm.
pub const C1_MM: f64 = 505.0;
/// Upper arm, mm.
pub const C2_MM: f64 = 760.0;
/// Forearm, mm.
pub const C3_MM: f64 = 795.0;
/// Wrist centre to flange, mm.
pub const C4_MM: f64 = 100.0;
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
/// The wrist may not come nearer to its singularity than this, rad.
const WRIST_MARGIN_RAD: f64 = 0.14;

/// Joint angles of the rest position unless a cell has its own: tool high above the camera's view.
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
    /// On a straight line the joints would have to change over to another configuration.
    #[error("the arm would have to turn over near ({0:.1}, {1:.1}, {2:.1}) mm on the straight line")]
    TurnsOver(f64, f64, f64),
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
        Links::NOMINAL.flange(model_angles(joints_rad)) * self.flange_from_tool
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

    /// Time of a joint move from rest to rest, s: every joint within its limits of speed, acceleration and jerk, all of them
    /// together, the slowest one decides. What a controller takes to report "in position" comes on top.
    pub fn travel_s(from_rad: [f64; 6], to_rad: [f64; 6]) -> f64 {
        Trajectory::joint(from_rad, to_rad).duration_s()
    }

    /// What each joint may do, in rad.
    pub fn joint_limits() -> [Limits; 6] {
        SPEEDS_DEG_S.map(|speed| Limits::of_speed(speed.to_radians()))
    }
}

/// True if every joint is inside its range.
pub fn within_limits(joints_rad: &[f64; 6]) -> bool {
    joints_rad
        .iter()
        .zip(LIMITS_DEG)
        .all(|(q, (low, high))| (low..=high).contains(&q.to_degrees()))
}

/// Angles of the model (straight up at zero) for encoder angles.
pub fn model_angles(joints_rad: [f64; 6]) -> [f64; 6] {
    std::array::from_fn(|j| joints_rad[j] * SIGNS[j] - OFFSETS_RAD[j])
}

/// The rigid parts between the joints, base to flange: part `i` lies before joint `i + 1`, the last one after J6.
#[derive(Clone, Debug)]
pub struct Links(pub [Isometry3<f64>; 7]);

impl Links {
    /// Lengths as in the data sheet.
    pub const NOMINAL: Links = Links([
        at(0.0, 0.0, 0.0),
        at(A1_MM, 0.0, C1_MM),
        at(0.0, 0.0, C2_MM),
        at(A2_MM, 0.0, C3_MM),
        at(0.0, 0.0, 0.0),
        at(0.0, 0.0, 0.0),
        at(0.0, 0.0, C4_MM),
    ]);

    /// Poses in the base, from the foot to the flange: entry `i` has turned with `i` joints and lies at the far end of part `i`.
    pub fn poses(&self, model_rad: [f64; 6]) -> [Isometry3<f64>; 7] {
        let mut poses = [self.0[0]; 7];
        // J1, J4 and J6 turn about z, the others about y
        for (j, angle) in model_rad.into_iter().enumerate() {
            let axis = if matches!(j, 0 | 3 | 5) {
                Vector3::z_axis()
            } else {
                Vector3::y_axis()
            };
            poses[j + 1] = poses[j] * UnitQuaternion::from_axis_angle(&axis, angle) * self.0[j + 1];
        }
        poses
    }

    /// Pose of the flange.
    pub fn flange(&self, model_rad: [f64; 6]) -> Transform<Base, Flange> {
        Transform::from_isometry(self.poses(model_rad)[6])
    }
}

const fn at(x: f64, y: f64, z: f64) -> Isometry3<f64> {
    Isometry3 {
        rotation: UnitQuaternion::new_unchecked(Quaternion::new(1.0, 0.0, 0.0, 0.0)),
        translation: Translation3 {
            vector: Vector3::new(x, y, z),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tool_pose;
    use geometry::{Direction, Point};
    use proptest::prelude::*;

    const TOOL_MM: [f64; 3] = [0.0, -40.0, 300.0];

    fn arm() -> Gp25 {
        Gp25::new(Transform::from_parts(TOOL_MM, UnitQuaternion::identity()))
    }

    proptest! {
        #[test]
        fn forward_agrees_with_the_reference_solver(q in prop::array::uniform6(-2.0..2.0f64)) {
            let arm = Gp25::new(Transform::identity());
            let own = *arm.forward(q).isometry();
            let pose = arm.solver.forward(&q);
            let t = pose.translation * 1000.0;
            prop_assert!((own.translation.vector - Vector3::new(t.x, t.y, t.z)).norm() < 1e-6);
            let r = pose.rotation;
            let r = UnitQuaternion::from_quaternion(Quaternion::new(r.w, r.x, r.y, r.z));
            prop_assert!(own.rotation.angle_to(&r) < 1e-6);
        }

        /// Over the calibrated volume of either arm, and for every lean of a sheet that is worked on.
        #[test]
        fn inverse_and_forward_are_a_round_trip(
            x in 910.0..1350.0f64, y in -1150.0..450.0f64, z in 150.0..900.0f64,
            lean in -0.2..0.2f64, turn in -0.2..0.2f64,
        ) {
            // the second arm stands 700 mm beside the first and works on the same faces
            prop_assume!(y.abs() < 450.0 || y < -250.0);
            let approach = Direction::new(1.0, lean, turn).expect("a direction");
            let target = tool_pose(Point::new(x, y, z), approach);
            match arm().inverse(target) {
                Ok(q) => {
                    prop_assert!(within_limits(&q), "{q:?}");
                    let off = arm().forward(q).isometry().inv_mul(target.isometry());
                    prop_assert!(off.translation.vector.norm() < 1e-4 && off.rotation.angle() < 1e-6, "{off}");
                }
                // the far corners of the second arm lean out of its reach, and nothing else does
                Err(why) => prop_assert!(x.hypot(y) > 1500.0, "({x:.0}, {y:.0}, {z:.0}): {why}"),
            }
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
    fn what_cannot_be_taken_is_refused_with_the_reason() {
        let ahead = Direction::new(1.0, 0.0, 0.0).expect("a direction");
        let far = arm().inverse(tool_pose(Point::new(2300.0, 0.0, 500.0), ahead));
        assert!(matches!(far, Err(Unreachable::OutOfReach(..))), "{far:?}");
        let nowhere = arm().inverse(tool_pose(Point::new(f64::NAN, 0.0, 500.0), ahead));
        assert_eq!(nowhere, Err(Unreachable::NotFinite));
        // the forearm lies along the bit: J4 and J6 turn about the same axis
        let singular = arm().forward([0.0, 0.4, -0.7, 0.0, 0.05, 0.0]);
        let refused = arm().inverse(singular);
        assert!(matches!(refused, Err(Unreachable::WristSingularity(..))), "{refused:?}");
    }
}
