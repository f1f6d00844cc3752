//! Where every joint is at every time of a move: joints together, or a straight line of the tool.

use super::gp25::{Gp25, Unreachable};
use super::profile::{Limits, Profile};
use geometry::{Base, Tool, Transform};

/// Distance between two poses of a straight line whose joint angles are solved for, mm.
const KNOT_MM: f64 = 2.0;
/// A joint that turns further between two of them has changed over to another configuration, rad.
const JUMP_RAD: f64 = 0.1;

/// Joint angles over time, from rest to rest with limited jerk.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// Joint angles at equal distances along the way; two or more.
    knots_rad: Vec<[f64; 6]>,
    /// Of the way, which is 1 long.
    profile: Profile,
}

impl Trajectory {
    /// All joints together, each in proportion: the one that needs longest decides.
    pub fn joint(from_rad: [f64; 6], to_rad: [f64; 6]) -> Self {
        let knots_rad = vec![from_rad, to_rad];
        let profile = Profile::new(1.0, joint_limits(&knots_rad, None));
        let still = from_rad == to_rad;
        Self {
            knots_rad,
            profile: if still {
                Profile::new(0.0, Limits::of_speed(1.0))
            } else {
                profile
            },
        }
    }

    /// A straight line of the tool point at this speed, or slower where a joint could not follow.
    ///
    /// # Errors
    /// [`Unreachable`] if a pose on the line cannot be taken.
    pub fn straight(
        arm: &Gp25,
        from: Transform<Base, Tool>,
        to: Transform<Base, Tool>,
        speed_mm_s: f64,
    ) -> Result<Self, Unreachable> {
        let (a, b) = (from.isometry(), to.isometry());
        let length_mm = (b.translation.vector - a.translation.vector).norm();
        // a turn on the spot takes knots too: a degree each
        let pieces = (length_mm / KNOT_MM).max(a.rotation.angle_to(&b.rotation).to_degrees());
        let pieces = (pieces.ceil() as usize).max(1);
        let mut knots_rad: Vec<[f64; 6]> = Vec::with_capacity(pieces + 1);
        for k in 0..=pieces {
            let share = k as f64 / pieces as f64;
            let pose = a.try_lerp_slerp(b, share, 1e-9).unwrap_or(*b);
            let joints = arm.inverse(Transform::from_isometry(pose))?;
            let jumps = |last: &[f64; 6]| (0..6).any(|j| (joints[j] - last[j]).abs() > JUMP_RAD);
            if knots_rad.last().is_some_and(jumps) {
                let t = pose.translation.vector;
                return Err(Unreachable::TurnsOver(t.x, t.y, t.z));
            }
            knots_rad.push(joints);
        }
        let line = (length_mm > 0.0).then(|| Limits::of_speed(speed_mm_s).per(length_mm));
        let still = length_mm == 0.0 && knots_rad.windows(2).all(|pair| pair[0] == pair[1]);
        let limits = joint_limits(&knots_rad, line);
        Ok(Self {
            knots_rad,
            profile: Profile::new(if still { 0.0 } else { 1.0 }, limits),
        })
    }

    /// How long it takes, s.
    pub fn duration_s(&self) -> f64 {
        self.profile.duration_s()
    }

    /// Joint angles at a time, rad; before the beginning those of the beginning, after the end those of the end.
    pub fn at(&self, t_s: f64) -> [f64; 6] {
        if t_s >= self.duration_s() {
            return self.end_rad();
        }
        self.along(self.profile.at(t_s))
    }

    /// Joint angles at the beginning, rad.
    pub fn begin_rad(&self) -> [f64; 6] {
        self.knots_rad[0]
    }

    /// Joint angles at the end, rad.
    pub fn end_rad(&self) -> [f64; 6] {
        self.knots_rad[self.knots_rad.len() - 1]
    }

    /// Joint angles at a share of the way: through the knots, without a step in speed (Catmull and Rom 1974).
    pub(crate) fn along(&self, share: f64) -> [f64; 6] {
        let pieces = self.knots_rad.len() - 1;
        let at = share.clamp(0.0, 1.0) * pieces as f64;
        let k = (at as usize).min(pieces - 1);
        let t = at - k as f64;
        let knot = |k: usize| &self.knots_rad[k];
        std::array::from_fn(|j| {
            let (a, b) = (knot(k)[j], knot(k + 1)[j]);
            let chord = b - a;
            // how much steeper than the chord it is at either end
            let before = if k > 0 { 0.5 * (b - knot(k - 1)[j]) - chord } else { 0.0 };
            let after = if k + 1 < pieces {
                0.5 * (knot(k + 2)[j] - a) - chord
            } else {
                0.0
            };
            a + t * (chord + (1.0 - t) * (before * (1.0 - t) - after * t))
        })
    }

    /// Largest turn of each joint over the whole way if it went on as in its fastest piece, rad.
    pub(crate) fn steepest_rad(&self) -> [f64; 6] {
        steepest(&self.knots_rad)
    }
}

fn steepest(knots_rad: &[[f64; 6]]) -> [f64; 6] {
    let pieces = (knots_rad.len() - 1) as f64;
    std::array::from_fn(|j| {
        let turns = knots_rad.windows(2).map(|pair| (pair[1][j] - pair[0][j]).abs());
        pieces * turns.fold(0.0, f64::max)
    })
}

/// Limits on a way of length 1: those of the joints, and those of the line if there is one.
fn joint_limits(knots_rad: &[[f64; 6]], line: Option<Limits>) -> Limits {
    let turns = steepest(knots_rad);
    let joints = Gp25::joint_limits().into_iter().zip(turns);
    let moving = joints
        .filter(|(_, turn)| *turn > 0.0)
        .map(|(limits, turn)| limits.per(turn));
    // a joint that follows a line may need a little more in between than its steepest piece says
    let moving = moving.map(|limits| if line.is_some() { limits.per(1.1) } else { limits });
    let slower = |a: Limits, b: Limits| Limits {
        speed: a.speed.min(b.speed),
        acceleration: a.acceleration.min(b.acceleration),
        jerk: a.jerk.min(b.jerk),
    };
    moving.chain(line).reduce(slower).unwrap_or(Limits::of_speed(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::HOME_RAD;
    use crate::plan::tool_pose;
    use geometry::{Direction, Point};
    use nalgebra::UnitQuaternion;
    use proptest::prelude::*;

    fn joints() -> impl Strategy<Value = [f64; 6]> {
        prop::array::uniform6(-1.5..1.5f64)
    }

    proptest! {
        #[test]
        fn joint_moves_keep_every_limit_and_end_exactly(from in joints(), to in joints()) {
            let move_ = Trajectory::joint(from, to);
            prop_assert_eq!((move_.at(0.0), move_.at(move_.duration_s())), (from, to));
            let h = move_.duration_s() / 400.0;
            let q = |k: u32| move_.at(f64::from(k) * h);
            let mut nearest = 0.0f64;
            for k in 0..398 {
                let [a, b, c, d] = [q(k), q(k + 1), q(k + 2), q(k + 3)];
                for (j, limits) in Gp25::joint_limits().into_iter().enumerate() {
                    let speed = (b[j] - a[j]).abs() / h;
                    let acceleration = (c[j] - 2.0 * b[j] + a[j]).abs() / h.powi(2);
                    let jerk = (d[j] - 3.0 * c[j] + 3.0 * b[j] - a[j]).abs() / h.powi(3);
                    prop_assert!(speed <= limits.speed * (1.0 + 1e-9));
                    prop_assert!(acceleration <= limits.acceleration * (1.0 + 1e-6));
                    prop_assert!(jerk <= limits.jerk * (1.0 + 1e-3));
                    nearest = nearest.max(jerk / limits.jerk);
                }
            }
            prop_assert!(nearest > 0.98, "no joint comes near its limits: {nearest}");
        }

        #[test]
        fn the_way_back_takes_as_long_and_a_longer_one_longer(from in joints(), to in joints()) {
            let there_s = Gp25::travel_s(from, to);
            prop_assert!((there_s - Gp25::travel_s(to, from)).abs() < 1e-12);
            let further: [f64; 6] = std::array::from_fn(|j| from[j] + 1.2 * (to[j] - from[j]));
            prop_assert!(Gp25::travel_s(from, further) > there_s);
            prop_assert_eq!(Gp25::travel_s(from, from), 0.0);
        }

        #[test]
        fn a_straight_line_is_straight_and_no_joint_is_too_fast(
            y in -400.0..400.0f64, z in 200.0..850.0f64, lean in -0.15..0.15f64, speed_mm_s in 50.0..2000.0f64,
        ) {
            let arm = Gp25::new(Transform::from_parts([0.0, -40.0, 300.0], UnitQuaternion::identity()));
            let along = Direction::new(1.0, lean, lean).expect("a direction");
            let tip = Point::new(1070.0, y, z);
            let (from, to) = (tool_pose(tip.moved(along, -60.0), along), tool_pose(tip, along));
            let line = Trajectory::straight(&arm, from, to, speed_mm_s).expect("in reach");
            prop_assert!((arm.forward(line.at(line.duration_s())) * Point::new(0.0, 0.0, 0.0)).distance_mm(tip) < 1e-4);
            let h = line.duration_s() / 300.0;
            for k in 0..300 {
                let (a, b) = (line.at(f64::from(k) * h), line.at(f64::from(k + 1) * h));
                let at = |q| arm.forward(q) * Point::new(0.0, 0.0, 0.0);
                let off = at(a).vector() - tip.vector();
                prop_assert!(off.cross(&along.vector()).norm() < 0.01, "{off}");
                prop_assert!(at(a).distance_mm(at(b)) / h <= speed_mm_s * 1.001);
                for (j, limits) in Gp25::joint_limits().into_iter().enumerate() {
                    prop_assert!((b[j] - a[j]).abs() / h <= limits.speed);
                }
            }
        }
    }

    #[test]
    fn home_to_work_takes_about_a_second() {
        let arm = Gp25::new(Transform::from_parts([0.0, -40.0, 300.0], UnitQuaternion::identity()));
        let ahead = Direction::new(1.0, 0.0, 0.0).expect("a direction");
        let work = arm
            .inverse(tool_pose(Point::new(1060.0, 300.0, 300.0), ahead))
            .expect("in reach");
        let time_s = Gp25::travel_s(HOME_RAD, work);
        assert!((0.5..1.5).contains(&time_s), "{time_s} s from home to work");
    }
}
