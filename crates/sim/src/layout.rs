//! Where everything of the simulated cell stands, as drawn, and how far it really stands off the drawing.
//!
//! The base of arm A is the cell's frame. The camera looks along its +x from behind, the face stands about 1.05 m before
//! it, arm B stands 0.7 m to the left.

use crate::draw::{draw, signed};
use geometry::{Base, Camera, CameraModel, Face, Flange, Point, Tool, Transform};
use nalgebra::{Isometry3, Rotation3, UnitQuaternion, Vector3};

/// Name and place of each arm's base in the base of arm A, mm.
pub(crate) const ARMS: [(&str, [f64; 3]); 2] = [("arm_a", [0.0, 0.0, 0.0]), ("arm_b", [0.0, 700.0, 0.0])];
/// The camera in the base of arm A, mm.
const CAMERA_MM: [f64; 3] = [-430.0, 0.0, 540.0];
/// Distance from the camera to the middle of a presented face, mm.
pub(crate) const FACE_DEPTH_MM: f64 = 1500.0;
/// How much further back the inner front stands, mm.
pub(crate) const INNER_DEPTH_MM: f64 = 45.0;
/// The volume of the paper, in the base of arm A: smallest and largest corner, mm.
const VOLUME_MM: [[f64; 3]; 2] = [[950.0, -450.0, 150.0], [1350.0, 450.0, 900.0]];
/// The bit's tip from the flange, mm: straight ahead and 40 mm aside.
const TOOL_MM: [f64; 3] = [0.0, -40.0, 300.0];

/// The tool as the controllers hold it: z along the bit, away from the flange.
pub fn flange_from_tool() -> Transform<Flange, Tool> {
    Transform::from_parts(TOOL_MM, UnitQuaternion::identity())
}

/// Orientation of the tool for looking square at a face: bit along +x of the base, as for every visit of the marker.
pub fn approach() -> UnitQuaternion<f64> {
    let columns = [Vector3::z(), -Vector3::y(), Vector3::x()];
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(nalgebra::Matrix3::from_columns(
        &columns,
    )))
}

/// Pose of the tool at a place, square to a face.
pub fn tool_at(at: Point<Base>) -> Transform<Base, Tool> {
    Transform::from_parts(at.to_array(), approach())
}

/// The volume to calibrate, in an arm's own base: smallest and largest corner. Every presented face lies inside it.
pub fn volume(arm: usize) -> [Point<Base>; 2] {
    let place = ARMS.get(arm).map_or([0.0; 3], |(_, at)| *at);
    VOLUME_MM.map(|corner| Point::new(corner[0] - place[0], corner[1] - place[1], corner[2] - place[2]))
}

/// Drawn place of the camera in an arm's base: z along base x, x along base -y, y along base -z.
pub(crate) fn drawn_base_from_camera(arm: usize) -> Transform<Base, Camera> {
    let columns = [-Vector3::y(), -Vector3::z(), Vector3::x()];
    let rotation = Rotation3::from_matrix_unchecked(nalgebra::Matrix3::from_columns(&columns));
    let place = ARMS.get(arm).map_or([0.0; 3], |(_, at)| *at);
    Transform::from_parts(
        (Vector3::from(CAMERA_MM) - Vector3::from(place)).into(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// Where the camera really is in an arm's base: bolted a few millimetres and tenths of a degree off the drawing.
pub(crate) fn true_base_from_camera(arm: usize, seed: u64) -> Transform<Base, Camera> {
    let off = |purpose: u64, mm: f64, deg: f64| {
        let mut rng = draw(seed, &[60, purpose]);
        let mut three = |scale: f64| Vector3::from_fn(|_, _| scale * signed(&mut rng));
        let shift = three(mm);
        Isometry3::from_parts(shift.into(), UnitQuaternion::from_scaled_axis(three(deg.to_radians())))
    };
    // One deviation of the camera for all arms, and one of each base but the first.
    let base = if arm == 0 {
        Isometry3::identity()
    } else {
        off(arm as u64, 2.0, 0.1)
    };
    Transform::from_isometry(base * drawn_base_from_camera(arm).isometry() * off(0, 4.0, 0.25))
}

/// The lens as it is, for the lens as the camera states it: up to about a pixel apart, smoothly.
pub(crate) fn true_camera(stated: &CameraModel, seed: u64) -> CameraModel {
    let mut rng = draw(seed, &[61]);
    let mut by = |scale: f64| scale * (0.4 + 0.6 * signed(&mut rng).abs()) * signed(&mut rng).signum();
    let mut lens = *stated;
    lens.fx_px *= 1.0 + by(2e-4);
    lens.fy_px *= 1.0 + by(2e-4);
    lens.cx_px += by(0.8);
    lens.cy_px += by(0.8);
    for (k, scale) in lens.distortion.iter_mut().zip([1.6e-3, 4e-3, 6e-5, 6e-5, 0.0]) {
        *k += by(scale);
    }
    lens
}

/// Where a face stands before the camera as drawn: its middle at the middle of the volume, turned and tilted about it, but
/// never so far that a screw leaves the volume.
pub(crate) fn station(
    size_mm: [f64; 2],
    deeper_mm: f64,
    turn_rad: f64,
    tilt: UnitQuaternion<f64>,
    offset_mm: [f64; 3],
) -> Transform<Camera, Face> {
    let [low, high] = VOLUME_MM;
    let middle_up = CAMERA_MM[2] - 0.5 * (low[2] + high[2]);
    // Half of the volume, less what the base of arm B may stand off its place.
    let room = [0.5 * (high[1] - low[1]) - 8.0, 0.5 * (high[2] - low[2]) - 8.0];
    // Screws sit at least this far inside the outline.
    let half = size_mm.map(|s| (0.5 * s - 8.0).max(0.0));
    let reach = |turn: f64, a: usize| half[a] * turn.cos() + half[1 - a] * turn.abs().sin();
    let mut turn = turn_rad;
    while turn.abs() > 1e-4 && (0..2).any(|a| reach(turn, a) > room[a]) {
        turn *= 0.9;
    }
    let within = |a: usize| {
        offset_mm[a].clamp(
            -(room[a] - reach(turn, a)).max(0.0),
            (room[a] - reach(turn, a)).max(0.0),
        )
    };
    Transform::from_parts(
        [
            within(0),
            middle_up + within(1),
            FACE_DEPTH_MM + deeper_mm + offset_mm[2],
        ],
        tilt * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use cell::motion::{ArmMotion, CellDrawing, Gp25};

    fn arm() -> Gp25 {
        Gp25::new(flange_from_tool())
    }

    /// Places of the paper's lattice in an arm's base, and 40 mm before each: from there the bit goes in.
    fn lattice(arm: usize) -> impl Iterator<Item = (Point<Base>, Point<Base>)> {
        let low = volume(arm)[0];
        let nodes = (0..9).flat_map(|i| (0..19).flat_map(move |j| (0..16).map(move |k| [i, j, k])));
        nodes.map(move |node| {
            let [x, y, z] = node.map(|n| 50.0 * f64::from(n));
            let at = |back_mm: f64| Point::new(low.x_mm() + x - back_mm, low.y_mm() + y, low.z_mm() + z);
            (at(40.0), at(0.0))
        })
    }

    #[test]
    fn both_arms_reach_the_whole_lattice_clear_of_the_singularity() {
        for index in 0..2 {
            for at in lattice(index).flat_map(|(before, at)| [before, at]) {
                let q = arm().inverse(tool_at(at));
                let q = q.unwrap_or_else(|e| panic!("arm {index} at {at:?}: {e}"));
                let reached = arm().forward(q) * Point::new(0.0, 0.0, 0.0);
                assert!(reached.distance_mm(at) < 1e-3);
                assert!(q[4] > 0.5, "J5 at {} rad is near its singularity at {at:?}", q[4]);
            }
        }
    }

    #[test]
    fn the_cell_s_drawing_is_this_layout() {
        let drawing = CellDrawing::default();
        for (index, (name, foot_mm)) in ARMS.into_iter().enumerate() {
            let motion = ArmMotion::new(&drawing, name).expect("a drawn arm");
            assert_eq!(motion.arm().flange_from_tool(), flange_from_tool());
            assert_eq!(drawing.arms[index].foot_mm, foot_mm);
        }
        let camera = drawing
            .obstacles
            .iter()
            .find(|block| block.name == "camera")
            .expect("drawn");
        let inside = |axis: usize| (CAMERA_MM[axis] - camera.middle_mm[axis]).abs() < 0.5 * camera.size_mm[axis];
        assert!((0..3).all(inside), "{camera:?}");
        let middle = |axis: usize| 0.5 * (VOLUME_MM[0][axis] + VOLUME_MM[1][axis]);
        assert_eq!(drawing.unit.middle_mm[1..], [middle(1), middle(2)]);
    }

    #[test]
    fn one_configuration_everywhere() {
        let [low, high] = volume(0);
        let mut last: Option<[f64; 6]> = None;
        for step in 0..=200 {
            let t = f64::from(step) / 200.0;
            let at = Point::from_vector(low.vector() + (high.vector() - low.vector()) * t);
            let q = arm().inverse(tool_at(at)).expect("in reach");
            if let Some(before) = last {
                assert!((0..6).all(|j| (q[j] - before[j]).abs() < 0.1), "a jump at {at:?}");
            }
            last = Some(q);
        }
    }
}
