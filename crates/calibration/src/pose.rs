//! Poses of other tools: a hand-eye calibration is a map that knows one rigid motion.
//!
//! easy_handeye's YAML file and a ROS transform are in metres with the quaternion's w last; a Yaskawa's base frame lies 0.505 m above ROS's
//! `base_link`, which is for the reader of the file to add.

use crate::PairError;
use geometry::{Base, Camera, Transform};
use nalgebra::{Quaternion, UnitQuaternion};
use serde::Deserialize;
use std::path::Path;

/// A fixed camera's pose in a robot's base, as easy_handeye keeps it (`eye_on_base`).
///
/// ```
/// let text = "parameters:\n  eye_on_hand: false\n  robot_base_frame: base_link\n  tracking_base_frame: camera\n\
///             transformation: {x: 1.0, y: 0.5, z: 2.0, qx: 1.0, qy: 0.0, qz: 0.0, qw: 0.0}\n";
/// let pose = calibration::HandEye::from_yaml(text)?;
/// let seen = geometry::Point::<geometry::Camera>::new(10.0, 20.0, 1500.0);
/// assert!((pose.base_from_camera * seen).distance_mm(geometry::Point::new(1010.0, 480.0, 500.0)) < 1e-9);
/// assert_eq!(calibration::HandEye::from_yaml(&pose.to_yaml())?, pose);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct HandEye {
    /// The robot's frame.
    pub base_frame: String,
    /// The camera's frame.
    pub camera_frame: String,
    /// The pose.
    pub base_from_camera: Transform<Base, Camera>,
}

/// Why text is no hand-eye pose, and what to do about it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// Not the YAML of a hand-eye calibration.
    #[error(
        "neither a hand-eye calibration as easy_handeye writes it (parameters, transformation) nor a ROS transform (header, transform): {0}"
    )]
    Syntax(String),
    /// Several transforms, or none.
    #[error("{found} transforms in one file: leave only that from the robot's base to the camera")]
    Several {
        /// How many.
        found: usize,
    },
    /// A camera on the robot's hand.
    #[error(
        "the camera of this pose is on the robot's hand (eye_on_hand); a cell has it fixed: calibrate with eye_on_base"
    )]
    EyeOnHand,
    /// A quaternion that is none.
    #[error("its quaternion has length {length:.4} instead of 1; check the file")]
    Quaternion {
        /// What it has.
        length: f64,
    },
    /// A length that cannot be metres.
    #[error(
        "the camera would be {metres:.0} m from the robot: easy_handeye's lengths are metres, divide millimetres by 1000"
    )]
    Millimetres {
        /// What it says.
        metres: f64,
    },
}

/// Easy_handeye's file, a ROS transform or a message of some: whichever keys are there.
#[derive(Deserialize)]
struct File {
    parameters: Option<Parameters>,
    transformation: Option<Transformation>,
    header: Option<Header>,
    #[serde(default)]
    child_frame_id: String,
    transform: Option<RosTransform>,
    transforms: Option<Vec<Stamped>>,
}

/// ROS's `geometry_msgs/TransformStamped`.
#[derive(Deserialize)]
struct Stamped {
    header: Header,
    #[serde(default)]
    child_frame_id: String,
    transform: RosTransform,
}

#[derive(Deserialize)]
struct Header {
    #[serde(default)]
    frame_id: String,
}

#[derive(Deserialize)]
struct RosTransform {
    translation: Xyz,
    rotation: Xyzw,
}

#[derive(Deserialize)]
struct Xyz {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Deserialize)]
struct Xyzw {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

/// Keys that are not needed are passed over.
#[derive(Deserialize)]
struct Parameters {
    #[serde(default)]
    eye_on_hand: bool,
    #[serde(default)]
    robot_base_frame: String,
    #[serde(default)]
    tracking_base_frame: String,
}

#[derive(Deserialize)]
struct Transformation {
    x: f64,
    y: f64,
    z: f64,
    qx: f64,
    qy: f64,
    qz: f64,
    qw: f64,
}

impl From<RosTransform> for Transformation {
    fn from(
        RosTransform {
            translation: t,
            rotation: q,
        }: RosTransform,
    ) -> Self {
        Self {
            x: t.x,
            y: t.y,
            z: t.z,
            qx: q.x,
            qy: q.y,
            qz: q.z,
            qw: q.w,
        }
    }
}

/// Farther than any arm reaches, m.
const FAR_M: f64 = 50.0;

impl HandEye {
    /// From the text of easy_handeye's file, or of a ROS transform from the robot's base (its parent frame) to the camera.
    ///
    /// # Errors
    /// [`PoseError`].
    pub fn from_yaml(text: &str) -> Result<Self, PoseError> {
        // `ros2 topic echo` ends every message with a line of three dashes
        let text = text.trim_end().trim_end_matches("---");
        let file: File = serde_saphyr::from_str(text).map_err(|e| PoseError::Syntax(e.to_string()))?;
        let (base_frame, camera_frame, t) = match file {
            File {
                parameters: Some(p),
                transformation: Some(t),
                ..
            } => {
                if p.eye_on_hand {
                    return Err(PoseError::EyeOnHand);
                }
                (p.robot_base_frame, p.tracking_base_frame, t)
            }
            File {
                header: Some(header),
                child_frame_id,
                transform: Some(transform),
                ..
            } => (header.frame_id, child_frame_id, transform.into()),
            File {
                transforms: Some(mut all),
                ..
            } => match (all.pop(), all.len()) {
                (Some(only), 0) => (only.header.frame_id, only.child_frame_id, only.transform.into()),
                (last, more) => {
                    return Err(PoseError::Several {
                        found: more + usize::from(last.is_some()),
                    });
                }
            },
            _ => return Err(PoseError::Syntax("it has the keys of neither".into())),
        };
        let quaternion = Quaternion::new(t.qw, t.qx, t.qy, t.qz);
        let length = quaternion.norm();
        if length.is_nan() || (length - 1.0).abs() > 1e-2 {
            return Err(PoseError::Quaternion { length });
        }
        let metres = t.x.abs() + t.y.abs() + t.z.abs();
        if metres.is_nan() || metres > FAR_M {
            return Err(PoseError::Millimetres { metres });
        }
        Ok(Self {
            base_frame,
            camera_frame,
            base_from_camera: Transform::from_parts(
                [t.x, t.y, t.z].map(|m| 1000.0 * m),
                UnitQuaternion::from_quaternion(quaternion),
            ),
        })
    }

    /// As easy_handeye keeps it.
    pub fn to_yaml(&self) -> String {
        let [x, y, z, qx, qy, qz, qw] = self.numbers();
        format!(
            "# pose of the camera in the robot's base: metres, unit quaternion\nparameters:\n  eye_on_hand: false\n  robot_base_frame: {}\n  \
             tracking_base_frame: {}\ntransformation:\n  x: {x:.9}\n  y: {y:.9}\n  z: {z:.9}\n  qx: {qx:.12}\n  qy: {qy:.12}\n  qz: {qz:.12}\n  qw: {qw:.12}\n",
            quoted(&self.base_frame),
            quoted(&self.camera_frame)
        )
    }

    /// The command that publishes it in ROS 2.
    pub fn to_ros(&self) -> String {
        let [x, y, z, qx, qy, qz, qw] = self.numbers();
        format!(
            "ros2 run tf2_ros static_transform_publisher --x {x:.9} --y {y:.9} --z {z:.9} --qx {qx:.12} --qy {qy:.12} --qz {qz:.12} --qw {qw:.12} \
             --frame-id {} --child-frame-id {}",
            self.base_frame, self.camera_frame
        )
    }

    /// x, y, z in metres, then the quaternion, w last and not negative.
    fn numbers(&self) -> [f64; 7] {
        let pose = self.base_from_camera.isometry();
        let sign = if pose.rotation.w < 0.0 { -1.0 } else { 1.0 };
        let (t, q) = (pose.translation.vector / 1000.0, pose.rotation.coords * sign);
        [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
    }

    /// Reads easy_handeye's file or a ROS transform, as [`from_yaml`](Self::from_yaml).
    ///
    /// # Errors
    /// [`PairError::Read`], [`PairError::Pose`].
    pub fn read(path: &Path) -> Result<Self, PairError> {
        let text = std::fs::read_to_string(path).map_err(|source| PairError::Read {
            path: path.into(),
            source,
        })?;
        Self::from_yaml(&text).map_err(|reason| PairError::Pose {
            path: path.into(),
            reason,
        })
    }
}

/// A YAML string whatever is in it.
fn quoted(name: &str) -> String {
    format!("\"{}\"", name.replace('\\', "\\\\").replace('"', "\\\""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ros_transforms_are_read() {
        let one = "header:\n  stamp: {sec: 1, nanosec: 2}\n  frame_id: base_link\nchild_frame_id: camera\ntransform:\n  \
                   translation: {x: 1.0, y: 0.5, z: 2.0}\n  rotation: {x: 1.0, y: 0.0, z: 0.0, w: 0.0}\n";
        let pose = HandEye::from_yaml(one).expect("a transform");
        assert_eq!(
            (pose.base_frame.as_str(), pose.camera_frame.as_str()),
            ("base_link", "camera")
        );
        assert_eq!(
            pose.base_from_camera.isometry().translation.vector.as_slice(),
            [1000.0, 500.0, 2000.0]
        );
        let listed: String = one.lines().map(|line| format!("  {line}\n")).collect();
        let listed = listed.replacen("  header", "- header", 1);
        assert_eq!(HandEye::from_yaml(&format!("transforms:\n{listed}---\n")), Ok(pose));
        let two = HandEye::from_yaml(&format!("transforms:\n{listed}{listed}"));
        assert_eq!(two, Err(PoseError::Several { found: 2 }));
    }

    #[test]
    fn what_is_no_fixed_camera_is_refused() {
        let with = |transformation: &str, on_hand: bool| {
            HandEye::from_yaml(&format!(
                "parameters: {{eye_on_hand: {on_hand}}}\ntransformation: {{{transformation}}}\n"
            ))
        };
        let right = "x: 1, y: 0, z: 2, qx: 0, qy: 0, qz: 0, qw: 1";
        assert!(with(right, false).is_ok());
        assert_eq!(with(right, true), Err(PoseError::EyeOnHand));
        let long = with("x: 1, y: 0, z: 2, qx: 0, qy: 1, qz: 0, qw: 1", false);
        assert!(matches!(long, Err(PoseError::Quaternion { .. })), "{long:?}");
        let mm = with("x: 1000, y: 0, z: 2, qx: 0, qy: 0, qz: 0, qw: 1", false);
        assert!(matches!(mm, Err(PoseError::Millimetres { .. })), "{mm:?}");
        for text in [
            "",
            "x",
            "transformation: {x: 1}",
            "parameters: [",
            "transformation: {x: .nan, y: 0, z: 2, qx: 0, qy: 0, qz: 0, qw: 1}",
        ] {
            assert!(HandEye::from_yaml(text).is_err(), "{text}");
        }
    }
}
