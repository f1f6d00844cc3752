//! Whether an arm can go somewhere without harm: kinematics, limits, times, and what stands in the way.
//!
//! [`ArmMotion::check`] looks at the whole way to a screw before anything moves: that the arm can take the poses, that nothing comes
//! nearer to anything than the drawing's margin on the joint move and on the straight line. The way is not sampled at fixed
//! steps: after each posture the next one looked at is as far on as the clearance there lets every part safely go.
//!
//! Joints that all turn together swing the tool in an arc, from a rest above the unit often right through it. Then the arm goes by way of
//! a place farther back and higher up, in the direction it will work in.
//!
//! ```
//! use cell::motion::{ArmMotion, CellDrawing, HOME_RAD, Refusal};
//! use cell::plan::tool_pose;
//! use geometry::{Direction, Point};
//! let arm = ArmMotion::new(&CellDrawing::default(), "arm_a").expect("it is drawn");
//! let ahead = Direction::new(1.0, 0.0, 0.0).expect("a direction");
//! let at = |x_mm| tool_pose(Point::new(x_mm, 200.0, 500.0), ahead);
//! let way = arm.check(HOME_RAD, at(1030.0), at(1070.0), 150.0)?;
//! assert!((0.5..1.5).contains(&way.joint_s()));
//! // out of reach: the arm stays where it is
//! assert!(matches!(arm.check(HOME_RAD, at(2160.0), at(2200.0), 150.0), Err(Refusal::Unreachable { .. })));
//! # Ok::<(), Refusal>(())
//! ```

mod collision;
mod drawing;
mod gp25;
mod profile;
mod trajectory;

pub use collision::Swept;
pub use drawing::{CellDrawing, DrawnArm, DrawnBox, DrawnCapsule, DrawnUnit};
pub use gp25::{
    A1_MM, A2_MM, C1_MM, C2_MM, C3_MM, C4_MM, Gp25, HOME_RAD, Links, Unreachable, model_angles, within_limits,
};
pub use profile::{Limits, Profile};
pub use trajectory::Trajectory;

use crate::record::LeftAlone;
use collision::{Capsule, FOREARM, PARTS, Solid, foot, parts};
use geometry::{Base, Flange, Tool, Transform};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

/// How near the bit may come to a face before it is in front of its screw, mm.
const BIT_MARGIN_MM: f64 = 2.0;
/// Shortest way of any part of the arm between two postures that are looked at, mm: what a margin may be undercut by, unseen.
const STEP_MM: f64 = 4.0;
/// Places to go by way of, from in front of a screw, mm back and mm up: the fastest that is free is taken. Between screws a little
/// back is enough, from the rest it takes the height.
const VIA_MM: [[f64; 2]; 10] = [
    [60.0, 0.0],
    [150.0, 0.0],
    [250.0, 100.0],
    [100.0, 400.0],
    [200.0, 200.0],
    [200.0, 400.0],
    [100.0, 600.0],
    [200.0, 600.0],
    [300.0, 500.0],
    [350.0, 300.0],
];
/// Where the front of the unit is taken to be on the way home, before the tip, mm: nearer than any standoff.
const FACE_AHEAD_MM: f64 = 5.0;
/// Joints this near to their rest are there, rad.
const AT_HOME_RAD: f64 = 1e-3;
/// Way of any part between two postures that stand for the room that an arm sweeps, mm.
const SWEPT_STEP_MM: f64 = 30.0;
/// Number of the bit among the parts of arm and tool.
const BIT: usize = PARTS.len();

/// A part of the way to a screw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leg {
    /// All joints together, to in front of the screw.
    Joint,
    /// Straight along the screw's axis.
    Approach,
}

/// Why an arm is not sent to a place. Nothing has moved.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The arm cannot take a pose on the way.
    #[error("{arm}: {source}")]
    Unreachable {
        /// Name of the arm.
        arm: String,
        /// Why not.
        source: Unreachable,
    },
    /// Something would come too near to something.
    #[error("{arm}: its {part} would come too near to {obstacle} {}: {}", on(.leg), gap(*.clearance_mm, *.margin_mm))]
    Collision {
        /// Name of the arm.
        arm: String,
        /// Part of the arm or of its tool.
        part: String,
        /// What it would meet.
        obstacle: String,
        /// Where on the way.
        leg: Leg,
        /// How near it would come, mm; below zero where they overlap.
        clearance_mm: f64,
        /// How near it may come, mm.
        margin_mm: f64,
    },
}

fn on(leg: &Leg) -> &'static str {
    match leg {
        Leg::Joint => "on the way to the front of the screw",
        Leg::Approach => "on the straight way to the screw",
    }
}

fn gap(clearance_mm: f64, margin_mm: f64) -> String {
    if clearance_mm > 0.0 {
        format!("{clearance_mm:.0} mm, {margin_mm:.0} mm are kept")
    } else {
        "they would touch".into()
    }
}

impl From<&Refusal> for LeftAlone {
    fn from(refusal: &Refusal) -> Self {
        match refusal {
            Refusal::Unreachable { .. } => Self::Unreachable,
            Refusal::Collision { .. } => Self::Collision,
        }
    }
}

/// A way to a screw on which nothing is in the way.
#[derive(Clone, Debug, PartialEq)]
pub struct Way {
    /// To in front of the screw: one move, or two by way of a place farther back.
    pub joint: Vec<JointMove>,
    /// The straight line into it.
    pub approach: Trajectory,
}

impl Way {
    /// Time of the joint moves, s.
    pub fn joint_s(&self) -> f64 {
        self.joint.iter().map(|leg| leg.trajectory.duration_s()).sum()
    }

    /// Where the arm goes by way of, if not straight to in front of the screw.
    pub fn via(&self) -> Option<Transform<Base, Tool>> {
        via(&self.joint)
    }
}

/// A move of all joints together.
#[derive(Clone, Debug, PartialEq)]
pub struct JointMove {
    /// Pose of the tool at its end.
    pub to: Transform<Base, Tool>,
    /// Joint angles on the way.
    pub trajectory: Trajectory,
}

fn via(moves: &[JointMove]) -> Option<Transform<Base, Tool>> {
    match moves {
        [first, _, ..] => Some(first.to),
        _ => None,
    }
}

/// One arm among what stands around it, all in its base. Other arms stand at their rest: one works while the others are at home.
#[derive(Clone, Debug)]
pub struct ArmMotion {
    name: String,
    arm: Gp25,
    home_rad: [f64; 6],
    margin_mm: f64,
    /// In the flange's frame; the bit first.
    tool: Vec<(String, Capsule)>,
    obstacles: Vec<(String, Solid)>,
    own_foot: Solid,
    unit: UnitSpace,
    /// How far any part of the arm can be from each joint's axis, mm.
    levers_mm: [f64; 6],
    cell_from_base: Isometry3<f64>,
    is_right: Option<bool>,
}

/// The space that the unit may take, but for where its front is.
#[derive(Clone, Copy, Debug)]
struct UnitSpace {
    middle: Point3<f64>,
    /// Along the tool's axes when it looks at a face: up, across, into it.
    half_mm: Vector3<f64>,
}

impl UnitSpace {
    /// As a box whose front goes through the tip of a tool that stands square to it.
    fn behind(&self, contact: &Isometry3<f64>) -> Solid {
        let middle = contact.inverse_transform_point(&self.middle);
        Solid::Box {
            pose: contact * nalgebra::Translation3::new(middle.x, middle.y, self.half_mm.z),
            half_mm: self.half_mm,
        }
    }
}

impl ArmMotion {
    /// An arm as drawn; `None` if the drawing has no arm of that name.
    pub fn new(drawing: &CellDrawing, name: &str) -> Option<Self> {
        let own = drawing.arms.iter().find(|arm| arm.name == name)?;
        let base_from_cell = cell_from_base(own).inverse();
        let flange_from_tip: Transform<Flange, Tool> = Transform::from_parts(own.tip_mm, UnitQuaternion::identity());
        let tool: Vec<(String, Capsule)> = own.tool.iter().map(|part| in_flange(part, own)).collect();
        let still = drawing.obstacles.iter().map(|block| {
            let pose = base_from_cell * nalgebra::Translation3::from(Vector3::from(block.middle_mm));
            let half_mm = 0.5 * Vector3::from(block.size_mm);
            (format!("the {}", block.name), Solid::Box { pose, half_mm })
        });
        let neighbours = drawing.arms.iter().filter(|arm| arm.name != name).flat_map(|arm| {
            let base_from_neighbour = base_from_cell * cell_from_base(arm);
            let (moving, flange) = parts(arm.home_rad);
            let tool = arm.tool.iter().map(|part| in_flange(part, arm));
            let tool: Vec<(String, Capsule)> = tool.map(|(name, c)| (name, c.moved(&flange))).collect();
            let moving = PARTS.iter().zip(moving).map(|((name, _), c)| ((*name).to_owned(), c));
            let all = moving.chain(tool).chain([("foot".to_owned(), foot())]);
            all.map(|(part, c)| {
                let solid = Solid::Capsule(c.moved(&base_from_neighbour));
                (format!("{}'s {part}", arm.name), solid)
            })
            .collect::<Vec<_>>()
        });
        let [width_mm, height_mm] = drawing.unit.face_mm;
        Some(Self {
            name: name.to_owned(),
            arm: Gp25::new(flange_from_tip),
            home_rad: own.home_rad,
            margin_mm: drawing.margin_mm,
            levers_mm: levers_mm(&tool),
            tool,
            obstacles: still.chain(neighbours).collect(),
            own_foot: Solid::Capsule(foot()),
            cell_from_base: cell_from_base(own),
            is_right: is_right(drawing, own),
            unit: UnitSpace {
                middle: base_from_cell * Point3::from(drawing.unit.middle_mm),
                half_mm: 0.5 * Vector3::new(height_mm, width_mm, drawing.unit.depth_mm),
            },
        })
    }

    /// Its kinematics.
    pub fn arm(&self) -> &Gp25 {
        &self.arm
    }

    /// Where it stands at rest.
    pub fn home_rad(&self) -> [f64; 6] {
        self.home_rad
    }

    /// Looks at the whole way to a screw, before anything moves.
    ///
    /// # Arguments
    /// * `from_rad` – where the joints are now.
    /// * `standoff`, `contact` – the tool in front of the screw and in it, square to the face, whose front lies at the contact.
    /// * `approach_mm_s` – speed of the straight line.
    ///
    /// # Errors
    /// [`Refusal`], with what is in the way.
    pub fn check(
        &self,
        from_rad: [f64; 6],
        standoff: Transform<Base, Tool>,
        contact: Transform<Base, Tool>,
        approach_mm_s: f64,
    ) -> Result<Way, Refusal> {
        let approach = Trajectory::straight(&self.arm, standoff, contact, approach_mm_s).map_err(|source| {
            Refusal::Unreachable {
                arm: self.name.clone(),
                source,
            }
        })?;
        let unit = self.unit.behind(contact.isometry());
        self.sweep(&approach, &unit, Leg::Approach)?;
        let joint = self.joint_way(from_rad, approach.begin_rad(), standoff, &unit)?;
        Ok(Way { joint, approach })
    }

    /// Where to go by way of from in front of a face to the rest; `None` if straight there is free, or no way is known to be.
    pub fn via_home(&self, from_rad: [f64; 6]) -> Option<Transform<Base, Tool>> {
        if self.is_home(from_rad) {
            return None;
        }
        let here = self.arm.forward(from_rad);
        let face = here.isometry() * nalgebra::Translation3::new(0.0, 0.0, FACE_AHEAD_MM);
        // a way is as free backwards
        let moves = self.joint_way(self.home_rad, from_rad, here, &self.unit.behind(&face));
        moves.ok().and_then(|moves| via(&moves))
    }

    /// Clear distance between two arms, mm; below zero where they touch.
    ///
    /// # Arguments
    /// * `joints_rad`, `other_rad` – where their joints are.
    pub fn apart_mm(&self, joints_rad: [f64; 6], other: &ArmMotion, other_rad: [f64; 6]) -> f64 {
        let (own, other) = (self.body(joints_rad), other.body(other_rad));
        let pairs = own.iter().flat_map(|a| other.iter().map(move |b| a.apart_mm(b)));
        pairs.fold(f64::INFINITY, f64::min)
    }

    /// Everything of the arm but its foot, in the cell's frame.
    fn body(&self, joints_rad: [f64; 6]) -> Vec<Capsule> {
        let (arm, flange) = parts(joints_rad);
        let tool = self.tool.iter().map(|(_, part)| part.moved(&flange));
        arm.into_iter()
            .chain(tool)
            .map(|c| c.moved(&self.cell_from_base))
            .collect()
    }

    /// The room that the arm takes on its way, wherever it is on it.
    pub fn swept<'a>(&self, ways: impl IntoIterator<Item = &'a Trajectory>) -> Swept {
        let mut swept = Swept::new(self.tool.len() + PARTS.len(), SWEPT_STEP_MM);
        for way in ways {
            let turns = way.steepest_rad();
            let travel_mm: f64 = turns.iter().zip(self.levers_mm).map(|(turn, lever)| turn * lever).sum();
            let steps = (travel_mm / SWEPT_STEP_MM).ceil().max(1.0);
            for step in 0..=steps as usize {
                swept.add(self.body(way.along(step as f64 / steps)));
            }
        }
        swept
    }

    /// True if the arm stands on the right of its neighbour; `None` where there are not two.
    pub fn is_right(&self) -> Option<bool> {
        self.is_right
    }

    /// Joint moves from in front of a face to the rest, the way that [`via_home`](Self::via_home) leads.
    pub fn way_home(&self, from_rad: [f64; 6]) -> Vec<Trajectory> {
        match self.via_home(from_rad).and_then(|via| self.arm.inverse(via).ok()) {
            Some(via_rad) => vec![
                Trajectory::joint(from_rad, via_rad),
                Trajectory::joint(via_rad, self.home_rad),
            ],
            None => vec![Trajectory::joint(from_rad, self.home_rad)],
        }
    }

    /// True if these are the joint angles of its rest.
    pub fn is_home(&self, joints_rad: [f64; 6]) -> bool {
        (0..6).all(|j| (joints_rad[j] - self.home_rad[j]).abs() < AT_HOME_RAD)
    }

    /// Joint moves to a pose, by way of another one if need be.
    fn joint_way(
        &self,
        from_rad: [f64; 6],
        to_rad: [f64; 6],
        to: Transform<Base, Tool>,
        unit: &Solid,
    ) -> Result<Vec<JointMove>, Refusal> {
        let free = |from_rad, to_rad, to| {
            let trajectory = Trajectory::joint(from_rad, to_rad);
            self.sweep(&trajectory, unit, Leg::Joint)
                .map(|()| JointMove { to, trajectory })
        };
        let refused = match free(from_rad, to_rad, to) {
            Ok(straight) => return Ok(vec![straight]),
            Err(refused) => refused,
        };
        let vias = VIA_MM.into_iter().filter_map(|[back_mm, up_mm]| {
            let back = to.isometry().rotation * Vector3::z() * -back_mm;
            let moved = nalgebra::Translation3::from(back + Vector3::z() * up_mm) * to.isometry();
            let via = Transform::from_isometry(moved);
            let via_rad = self.arm.inverse(via).ok()?;
            let time_s = Gp25::travel_s(from_rad, via_rad) + Gp25::travel_s(via_rad, to_rad);
            Some((time_s, via, via_rad))
        });
        let mut vias: Vec<_> = vias.collect();
        vias.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, via, via_rad) in vias {
            if let Ok(second) = free(via_rad, to_rad, to)
                && let Ok(first) = free(from_rad, via_rad, via)
            {
                return Ok(vec![first, second]);
            }
        }
        Err(refused)
    }

    /// Goes along a trajectory, each time as far on as the clearance lets every part safely go.
    fn sweep(&self, way: &Trajectory, unit: &Solid, leg: Leg) -> Result<(), Refusal> {
        let turns = way.steepest_rad();
        let travel_mm: f64 = turns.iter().zip(self.levers_mm).map(|(turn, lever)| turn * lever).sum();
        let mut share = 0.0;
        loop {
            let nearest = self.nearest(way.along(share), unit, leg);
            if nearest.spare_mm < 0.0 {
                return Err(self.collision(nearest, leg));
            }
            if share >= 1.0 {
                return Ok(());
            }
            share = (share + nearest.spare_mm.max(STEP_MM) / travel_mm).min(1.0);
        }
    }

    /// The pair of a part and an obstacle that are nearest to each other, beyond what has to be kept.
    fn nearest(&self, joints_rad: [f64; 6], unit: &Solid, leg: Leg) -> Nearest {
        let (arm, flange) = parts(joints_rad);
        let tool = self.tool.iter().map(|(_, part)| part.moved(&flange));
        let mut nearest = Nearest {
            part: 0,
            obstacle: Obstacle::Unit,
            spare_mm: f64::INFINITY,
            margin_mm: 0.0,
        };
        for (part, capsule) in arm.into_iter().chain(tool).enumerate() {
            let mut against = |obstacle: Obstacle, solid: &Solid, margin_mm: f64| {
                if solid.clearance_at_least_mm(&capsule) - margin_mm < nearest.spare_mm {
                    let spare_mm = solid.clearance_mm(&capsule) - margin_mm;
                    if spare_mm < nearest.spare_mm {
                        nearest = Nearest {
                            part,
                            obstacle,
                            spare_mm,
                            margin_mm,
                        };
                    }
                }
            };
            match (part == BIT, leg) {
                // it is what touches the screw
                (true, Leg::Approach) => {}
                (true, Leg::Joint) => against(Obstacle::Unit, unit, BIT_MARGIN_MM.min(self.margin_mm)),
                (false, _) => against(Obstacle::Unit, unit, self.margin_mm),
            }
            for (k, (_, solid)) in self.obstacles.iter().enumerate() {
                against(Obstacle::Drawn(k), solid, self.margin_mm);
            }
            if part >= FOREARM {
                against(Obstacle::OwnFoot, &self.own_foot, self.margin_mm);
            }
        }
        nearest
    }

    fn collision(&self, nearest: Nearest, leg: Leg) -> Refusal {
        let part = match nearest.part.checked_sub(PARTS.len()) {
            None => PARTS[nearest.part].0.to_owned(),
            Some(tool) => self.tool[tool].0.clone(),
        };
        let obstacle = match nearest.obstacle {
            Obstacle::Unit => "the unit".to_owned(),
            Obstacle::OwnFoot => "its own foot".to_owned(),
            Obstacle::Drawn(k) => self.obstacles[k].0.clone(),
        };
        Refusal::Collision {
            arm: self.name.clone(),
            part,
            obstacle,
            leg,
            clearance_mm: nearest.spare_mm + nearest.margin_mm,
            margin_mm: nearest.margin_mm,
        }
    }
}

#[derive(Clone, Copy)]
enum Obstacle {
    Unit,
    OwnFoot,
    Drawn(usize),
}

#[derive(Clone, Copy)]
struct Nearest {
    part: usize,
    obstacle: Obstacle,
    /// Clearance beyond the margin, mm.
    spare_mm: f64,
    margin_mm: f64,
}

fn cell_from_base(arm: &DrawnArm) -> Isometry3<f64> {
    Isometry3::new(Vector3::from(arm.foot_mm), Vector3::z() * arm.turn_rad)
}

fn is_right(drawing: &CellDrawing, own: &DrawnArm) -> Option<bool> {
    let [a, b] = &drawing.arms[..] else { return None };
    let neighbour = if a.name == own.name { b } else { a };
    (own.foot_mm[1] != neighbour.foot_mm[1]).then_some(own.foot_mm[1] < neighbour.foot_mm[1])
}

/// A part of a tool, drawn from the bit's tip, in the flange's frame.
fn in_flange(part: &DrawnCapsule, arm: &DrawnArm) -> (String, Capsule) {
    let at = |mm: [f64; 3]| Point3::from(Vector3::from(mm) + Vector3::from(arm.tip_mm));
    (
        part.name.clone(),
        Capsule::new(at(part.from_mm), at(part.to_mm), part.radius_mm),
    )
}

/// How far any part of an arm with this tool can be from each joint's axis, mm: a stretched arm, which is more than it ever is.
fn levers_mm(tool: &[(String, Capsule)]) -> [f64; 6] {
    let (ahead, aside): (Vec<f64>, Vec<f64>) = tool.iter().map(|(_, part)| part.reach_mm()).unzip();
    let most = |reaches: Vec<f64>| reaches.into_iter().fold(0.0, f64::max);
    let radius = |part: usize| PARTS[part].1;
    let wrist = C4_MM + most(ahead).max(radius(4));
    let elbow = A2_MM.hypot(C3_MM) + wrist.max(radius(3));
    let shoulder = C2_MM + elbow.max(radius(2));
    [
        A1_MM + shoulder,
        shoulder,
        elbow,
        wrist,
        wrist,
        most(aside).max(radius(4)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tool_pose;
    use geometry::{Direction, Point};

    fn arm_among(obstacles: &[(&str, [f64; 3], [f64; 3])]) -> ArmMotion {
        let mut drawing = CellDrawing::default();
        drawing
            .obstacles
            .extend(obstacles.iter().map(|(name, middle_mm, size_mm)| DrawnBox {
                name: (*name).to_owned(),
                middle_mm: *middle_mm,
                size_mm: *size_mm,
            }));
        ArmMotion::new(&drawing, "arm_a").expect("a drawn arm")
    }

    /// To a screw, square to the face, 40 mm of standoff.
    fn check(arm: &ArmMotion, from_rad: [f64; 6], at: [f64; 3]) -> Result<Way, Refusal> {
        let ahead = Direction::new(1.0, 0.0, 0.0).expect("a direction");
        let tip = Point::new(at[0], at[1], at[2]);
        let standoff = tool_pose(tip.moved(ahead, -40.0), ahead);
        arm.check(from_rad, standoff, tool_pose(tip, ahead), 150.0)
    }

    /// Clearance of everything but the bit, beyond the margin, at a few hundred postures of a way.
    fn spare_mm(arm: &ArmMotion, way: &Way, contact: [f64; 3]) -> f64 {
        let ahead = Direction::new(1.0, 0.0, 0.0).expect("a direction");
        let unit = arm
            .unit
            .behind(tool_pose(Point::new(contact[0], contact[1], contact[2]), ahead).isometry());
        let moves = way.joint.iter().map(|leg| (&leg.trajectory, Leg::Joint));
        let all = moves.chain([(&way.approach, Leg::Approach)]);
        all.flat_map(|(way, leg)| (0..=300).map(move |k| (way.at(way.duration_s() * f64::from(k) / 300.0), leg)))
            .map(|(q, leg)| arm.nearest(q, &unit, leg).spare_mm)
            .fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn a_way_that_was_found_free_is_free_everywhere() {
        let arm = arm_among(&[]);
        let mut around = 0;
        for (y, z) in [
            (-400.0, 200.0),
            (-400.0, 800.0),
            (0.0, 500.0),
            (300.0, 300.0),
            (420.0, 880.0),
        ] {
            let contact = [1070.0, y, z];
            let way = check(&arm, HOME_RAD, contact).unwrap_or_else(|e| panic!("{contact:?}: {e}"));
            around += usize::from(way.via().is_some());
            // the moves hang together
            assert_eq!(way.joint[0].trajectory.begin_rad(), HOME_RAD);
            let last = &way.joint[way.joint.len() - 1].trajectory;
            assert_eq!(last.end_rad(), way.approach.begin_rad());
            let spare = spare_mm(&arm, &way, contact);
            assert!(spare > -STEP_MM, "{contact:?}: {spare} mm beyond the margin");
        }
        // low screws are gone to around the edge of the unit
        assert!((1..5).contains(&around), "{around}");
    }

    #[test]
    fn a_target_behind_something_is_refused_and_it_is_named() {
        let target = [1070.0, 200.0, 500.0];
        check(&arm_among(&[]), HOME_RAD, target).expect("free without it");
        // right before the screw: the straight line does not lead there
        let pole = arm_among(&[("pole", [1010.0, 200.0, 500.0], [30.0, 30.0, 900.0])]);
        let refused = check(&pole, HOME_RAD, target).expect_err("a pole stands there");
        let text = refused.to_string();
        assert!(
            matches!(&refused, Refusal::Collision { obstacle, leg: Leg::Approach, .. } if obstacle == "the pole"),
            "{text}"
        );
        assert!(
            text.contains("arm_a") && text.contains("the pole") && text.contains("straight way"),
            "{text}"
        );
        assert_eq!(LeftAlone::from(&refused), LeftAlone::Collision);
        // a wall between the arm and the place, with a gap where it will stand: no way in
        let walls = [
            ("roof", [900.0, 200.0, 1150.0], [1400.0, 2400.0, 60.0]),
            ("fence", [420.0, -700.0, 500.0], [30.0, 900.0, 1300.0]),
        ];
        let refused = check(&arm_among(&walls), HOME_RAD, target).expect_err("a roof over it");
        assert!(
            matches!(&refused, Refusal::Collision { obstacle, .. } if obstacle == "the roof"),
            "{refused}"
        );
    }

    #[test]
    fn what_the_arm_cannot_do_is_refused_with_the_reason() {
        let arm = arm_among(&[]);
        let far = check(&arm, HOME_RAD, [2200.0, 0.0, 500.0]).expect_err("beyond its reach");
        assert!(far.to_string().contains("within limits"), "{far}");
        assert_eq!(LeftAlone::from(&far), LeftAlone::Unreachable);
        // the forearm along the bit
        let contact = arm.arm().forward([0.0, 0.4, -0.7, 0.0, 0.05, 0.0]);
        let back = contact.isometry() * nalgebra::Translation3::new(0.0, 0.0, -40.0);
        let singular = arm.check(HOME_RAD, Transform::from_isometry(back), contact, 150.0);
        let singular = singular.expect_err("singular").to_string();
        assert!(singular.contains("singularity"), "{singular}");
    }

    #[test]
    fn the_other_arm_at_rest_is_in_the_way_of_one_that_reaches_over_to_it() {
        let mut drawing = CellDrawing::default();
        // it rests stretched out in front of the face
        drawing.arms[1].home_rad = [0.0, 0.4, -0.7, 0.0, 1.2, 0.0];
        let arm = ArmMotion::new(&drawing, "arm_a").expect("a drawn arm");
        let refused = check(&arm, HOME_RAD, [1070.0, 640.0, 600.0]).expect_err("the other arm");
        assert!(refused.to_string().contains("arm_b's"), "{refused}");
        assert!(ArmMotion::new(&drawing, "arm_c").is_none());
    }

    #[test]
    fn home_is_gone_to_the_way_one_came() {
        let mut drawing = CellDrawing::default();
        drawing.arms[0].home_rad = HOME_RAD;
        let arm = ArmMotion::new(&drawing, "arm_a").expect("a drawn arm");
        let way = check(&arm, HOME_RAD, [1070.0, -400.0, 200.0]).expect("free");
        let standoff_rad = way.approach.begin_rad();
        assert!(way.via().is_some() && arm.via_home(standoff_rad).is_some());
        assert_eq!(arm.via_home(HOME_RAD), None);
        // from high up it is free
        let high = check(&arm, HOME_RAD, [1070.0, 0.0, 880.0]).expect("free");
        assert_eq!((high.via(), arm.via_home(high.approach.begin_rad())), (None, None));
    }

    #[test]
    fn a_face_full_of_screws_is_looked_at_in_no_time() {
        let arm = arm_among(&[]);
        let begin = std::time::Instant::now();
        for k in 0..20 {
            let (y, z) = (-400.0 + 200.0 * f64::from(k % 5), 200.0 + 200.0 * f64::from(k / 5));
            check(&arm, HOME_RAD, [1070.0, y, z]).unwrap_or_else(|e| panic!("({y}, {z}): {e}"));
        }
        let ms = begin.elapsed().as_secs_f64() * 1e3;
        println!("20 screws in {ms:.1} ms");
        // far from what it takes (about 15 ms): other tests run beside it
        assert!(ms < 1000.0, "{ms} ms");
    }
}
