//! How near the parts of an arm come to what is around it. Every part is a capsule, so that all that is ever asked is how far a
//! line is from a box or from another line: exact, and quick enough to ask thousands of times for a face.

use super::gp25::{C1_MM, C3_MM, Links, model_angles};
use nalgebra::{Isometry3, Point3, Vector3};
use parry3d_f64::math::{Pose, Vector};
use parry3d_f64::query::details::{
    distance_segment_segment, distance_support_map_support_map_with_params as distance_convex,
};
use parry3d_f64::query::gjk::VoronoiSimplex;
use parry3d_f64::shape::{Cuboid, Segment};

/// Names of the parts of an arm that move, and their radii, mm: no less than a GP25 has, motors and cables included.
pub(super) const PARTS: [(&str, f64); 5] = [
    ("shoulder", 150.0),
    ("upper arm", 110.0),
    ("elbow", 110.0),
    ("forearm", 95.0),
    ("wrist", 70.0),
];
/// The first part that could reach its own foot.
pub(super) const FOREARM: usize = 3;
/// Radius of the foot, mm.
const FOOT_RADIUS_MM: f64 = 190.0;

/// All within a radius of a line.
#[derive(Clone, Debug)]
pub(super) struct Capsule {
    from: Point3<f64>,
    to: Point3<f64>,
    radius_mm: f64,
}

impl Capsule {
    pub(super) fn new(from: Point3<f64>, to: Point3<f64>, radius_mm: f64) -> Self {
        Self { from, to, radius_mm }
    }

    pub(super) fn moved(&self, by: &Isometry3<f64>) -> Self {
        Self::new(by * self.from, by * self.to, self.radius_mm)
    }

    /// Largest distance of anything in it from the frame's origin, and from its z axis, mm.
    pub(super) fn reach_mm(&self) -> (f64, f64) {
        let ends = [self.from, self.to];
        let most = |far: fn(&Point3<f64>) -> f64| ends.iter().map(far).fold(0.0, f64::max) + self.radius_mm;
        (most(|p| p.coords.norm()), most(|p| p.x.hypot(p.y)))
    }

    fn middle(&self) -> Point3<f64> {
        nalgebra::center(&self.from, &self.to)
    }

    /// Radius of a ball around its middle that holds it, mm.
    fn ball_mm(&self) -> f64 {
        0.5 * nalgebra::distance(&self.from, &self.to) + self.radius_mm
    }

    /// Clear distance, mm; below zero where they overlap.
    pub(super) fn apart_mm(&self, other: &Self) -> f64 {
        distance_segment_segment(&Pose::identity(), &other.line(), &self.line()) - other.radius_mm - self.radius_mm
    }

    fn line(&self) -> Segment {
        Segment::new(vector(&self.from.coords), vector(&self.to.coords))
    }
}

/// The fixed foot of an arm, in its base.
pub(super) fn foot() -> Capsule {
    let up = |z_mm| Point3::new(0.0, 0.0, z_mm);
    Capsule::new(up(FOOT_RADIUS_MM), up(C1_MM), FOOT_RADIUS_MM)
}

/// The moving parts of an arm, in the order of [`PARTS`], and the pose of its flange, in its base.
pub(super) fn parts(joints_rad: [f64; 6]) -> ([Capsule; 5], Isometry3<f64>) {
    let poses = Links::NOMINAL.poses(model_angles(joints_rad));
    let place = |k: usize| Point3::from(poses[k].translation.vector);
    // the forearm's axis passes the elbow at a distance
    let beside_elbow = poses[3] * Point3::new(0.0, 0.0, -C3_MM);
    let ends = [
        Point3::new(0.0, 0.0, C1_MM),
        place(1),
        place(2),
        beside_elbow,
        place(3),
        place(6),
    ];
    let capsules = std::array::from_fn(|k| Capsule::new(ends[k], ends[k + 1], PARTS[k].1));
    (capsules, poses[6])
}

/// Something to stay away from.
#[derive(Clone, Debug)]
pub(super) enum Solid {
    /// A box about the origin of its own frame.
    Box {
        /// Pose of its frame.
        pose: Isometry3<f64>,
        /// Half of each edge, mm.
        half_mm: Vector3<f64>,
    },
    /// A part of an arm.
    Capsule(Capsule),
}

impl Solid {
    /// Clear distance from a part, mm; below zero where they overlap, though not by how much.
    pub(super) fn clearance_mm(&self, part: &Capsule) -> f64 {
        let apart_mm = match self {
            Self::Box { pose, half_mm } => {
                let part = part.moved(&pose.inverse());
                let towards = Some(vector(&part.middle().coords));
                let (block, line) = (Cuboid::new(vector(half_mm)), part.line());
                distance_convex(&Pose::identity(), &block, &line, &mut VoronoiSimplex::new(), towards)
            }
            Self::Capsule(other) => return part.apart_mm(other),
        };
        apart_mm - part.radius_mm
    }

    /// No more than [`clearance_mm`](Self::clearance_mm), at next to no cost.
    pub(super) fn clearance_at_least_mm(&self, part: &Capsule) -> f64 {
        let apart_mm = match self {
            Self::Box { pose, half_mm } => {
                let middle = pose.inverse_transform_point(&part.middle());
                (middle.coords.abs() - half_mm).sup(&Vector3::zeros()).norm()
            }
            Self::Capsule(other) => nalgebra::distance(&other.middle(), &part.middle()) - other.ball_mm(),
        };
        apart_mm - part.ball_mm()
    }
}

/// The room that an arm takes on a way: its parts at postures so close to each other that in between none is farther from them than half a
/// step.
#[derive(Clone, Debug)]
pub struct Swept {
    parts: Vec<SweptPart>,
    step_mm: f64,
}

/// A part of an arm on a way.
#[derive(Clone, Debug)]
struct SweptPart {
    /// Where it is, posture by posture, in the cell's frame.
    places: Vec<Capsule>,
    /// How far any point of it has come up to each posture, at most, mm.
    come_mm: Vec<f64>,
    /// Corners of a box around all of it.
    low: Point3<f64>,
    high: Point3<f64>,
}

impl SweptPart {
    fn nowhere() -> Self {
        Self {
            places: Vec::new(),
            come_mm: Vec::new(),
            low: Point3::from([f64::INFINITY; 3]),
            high: Point3::from([f64::NEG_INFINITY; 3]),
        }
    }

    fn add(&mut self, capsule: Capsule) {
        for end in [&capsule.from, &capsule.to] {
            for axis in 0..3 {
                self.low[axis] = self.low[axis].min(end[axis] - capsule.radius_mm);
                self.high[axis] = self.high[axis].max(end[axis] + capsule.radius_mm);
            }
        }
        // a point of a line moves no farther than the farther of its ends
        let moved_mm = self.places.last().map_or(0.0, |last| {
            nalgebra::distance(&last.from, &capsule.from).max(nalgebra::distance(&last.to, &capsule.to))
        });
        self.come_mm
            .push(self.come_mm.last().copied().unwrap_or(0.0) + moved_mm);
        self.places.push(capsule);
    }

    /// The first posture after one in which anything of it may be more than so far away from where it was, mm.
    fn after(&self, posture: usize, mm: f64) -> usize {
        let far = self.come_mm[posture] + mm;
        posture + 1 + self.come_mm[posture + 1..].partition_point(|come_mm| *come_mm <= far)
    }

    fn is_clear_of(&self, other: &Self, keep_mm: f64) -> bool {
        let far = (0..3)
            .any(|axis| self.low[axis] - other.high[axis] > keep_mm || other.low[axis] - self.high[axis] > keep_mm);
        if far {
            return true;
        }
        // what has room to spare cannot lose it before it has moved so far: half of it is left for one, half for the other
        let mut own = 0;
        while own < self.places.len() {
            let (mut spare_mm, mut theirs) = (f64::INFINITY, 0);
            while theirs < other.places.len() {
                let half_mm = 0.5 * (self.places[own].apart_mm(&other.places[theirs]) - keep_mm);
                if half_mm < 0.0 {
                    return false;
                }
                spare_mm = half_mm.min(spare_mm);
                theirs = other.after(theirs, half_mm);
            }
            own = self.after(own, spare_mm);
        }
        true
    }
}

impl Swept {
    pub(super) fn new(parts: usize, step_mm: f64) -> Self {
        Self {
            parts: vec![SweptPart::nowhere(); parts],
            step_mm,
        }
    }

    pub(super) fn add(&mut self, body: Vec<Capsule>) {
        for (part, capsule) in self.parts.iter_mut().zip(body) {
            part.add(capsule);
        }
    }

    /// True if two arms keep this distance, wherever each is on its way, mm.
    pub fn is_clear_of(&self, other: &Self, margin_mm: f64) -> bool {
        // each may be half a step from the posture that stands for it
        let keep_mm = margin_mm + 0.5 * (self.step_mm + other.step_mm);
        let pairs = self
            .parts
            .iter()
            .flat_map(|own| other.parts.iter().map(move |part| (own, part)));
        pairs.into_iter().all(|(own, part)| own.is_clear_of(part, keep_mm))
    }
}

fn vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x, v.y, v.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;
    use proptest::prelude::*;

    fn point() -> impl Strategy<Value = Point3<f64>> {
        prop::array::uniform3(-800.0..800.0f64).prop_map(Point3::from)
    }

    proptest! {
        #[test]
        fn a_swept_part_is_clear_if_every_posture_of_it_is(
            ends in prop::collection::vec((point(), point()), 1..5), others in prop::collection::vec((point(), point()), 1..5),
            away_mm in 0.0..1500.0f64, keep_mm in 0.0..80.0f64,
        ) {
            // ways in small steps between some postures
            let way = |ends: &[(Point3<f64>, Point3<f64>)], by_mm: f64| {
                let mut part = SweptPart::nowhere();
                for two in ends.windows(2) {
                    for k in 0..12 {
                        let between = |a: &Point3<f64>, b: &Point3<f64>| a + (b - a) * (f64::from(k) / 12.0) + Vector3::x() * by_mm;
                        part.add(Capsule::new(between(&two[0].0, &two[1].0), between(&two[0].1, &two[1].1), 60.0));
                    }
                }
                part
            };
            let (own, other) = (way(&ends, 0.0), way(&others, away_mm));
            let each = own.places.iter().all(|a| other.places.iter().all(|b| a.apart_mm(b) >= keep_mm));
            prop_assert_eq!(own.is_clear_of(&other, keep_mm), each);
        }
    }

    fn block() -> Solid {
        Solid::Box {
            pose: Isometry3::from_parts(
                nalgebra::Translation3::new(100.0, -50.0, 30.0),
                UnitQuaternion::from_euler_angles(0.3, -0.2, 0.9),
            ),
            half_mm: Vector3::new(200.0, 120.0, 60.0),
        }
    }

    proptest! {
        /// Against the nearest of many points on the line.
        #[test]
        fn clearances_are_distances_less_radii(from in point(), to in point(), radius_mm in 1.0..100.0f64) {
            let part = Capsule::new(from, to, radius_mm);
            let other = Capsule::new(Point3::new(0.0, 300.0, 0.0), Point3::new(50.0, 300.0, 400.0), 40.0);
            let points: Vec<Point3<f64>> = (0..=4000).map(|k| from + (to - from) * (f64::from(k) / 4000.0)).collect();
            let nearest = |far: &dyn Fn(&Point3<f64>) -> f64| points.iter().map(far).fold(f64::INFINITY, f64::min);
            let Solid::Box { pose, half_mm } = block() else { unreachable!("a box") };
            let to_box = nearest(&|p| {
                (pose.inverse_transform_point(p).coords.abs() - half_mm).sup(&Vector3::zeros()).norm()
            });
            let to_other = nearest(&|p| {
                let along = (other.to - other.from).dot(&(p - other.from)) / (other.to - other.from).norm_squared();
                nalgebra::distance(p, &(other.from + (other.to - other.from) * along.clamp(0.0, 1.0)))
            });
            for (solid, clear) in [(block(), to_box - radius_mm), (Solid::Capsule(other.clone()), to_other - radius_mm - 40.0)] {
                let own = solid.clearance_mm(&part);
                prop_assert!((own - clear).abs() < 0.5, "{own} for {clear}");
                prop_assert!(solid.clearance_at_least_mm(&part) <= own + 1e-6);
            }
        }
    }

    #[test]
    fn the_parts_hang_together_and_end_at_the_flange() {
        let (parts, flange) = parts([0.3, 0.4, -0.7, 0.2, 1.2, 0.5]);
        for pair in parts.windows(2) {
            assert!(nalgebra::distance(&pair[0].to, &pair[1].from) < 1e-9);
        }
        let length = |k: usize| nalgebra::distance(&parts[k].from, &parts[k].to);
        for (k, mm) in [(0, 150.0), (1, 760.0), (2, 200.0), (3, 795.0), (4, 100.0)] {
            assert!((length(k) - mm).abs() < 1e-9, "{}: {} mm", PARTS[k].0, length(k));
        }
        assert!(nalgebra::distance(&parts[4].to, &Point3::from(flange.translation.vector)) < 1e-9);
    }
}
