//! The cell as drawn: where arms stand, what is on their flanges, what stands around them. Part of the cell file.
//!
//! The cell's frame is that of its drawing, by custom the base of its first arm: x towards the unit, y left, z up from the floor.

use super::gp25::HOME_RAD;
use serde::{Deserialize, Serialize};

/// What an arm could run into; `[motion]` in a cell file. The defaults are the simulated cell's drawing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellDrawing {
    /// Nothing that moves comes nearer to anything than this, mm: what the cell is off its drawing, and what arms swing over.
    pub margin_mm: f64,
    /// The unit before the camera.
    pub unit: DrawnUnit,
    /// Arms that are sent to screws, and any others that stand there.
    pub arms: Vec<DrawnArm>,
    /// What stands still.
    pub obstacles: Vec<DrawnBox>,
}

/// The space that a unit may take. Its front is not drawn but measured: it lies where the screw is that the bit goes to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrawnUnit {
    /// Its middle in the cell's frame, mm.
    pub middle_mm: [f64; 3],
    /// Largest width and height of a face, mm.
    pub face_mm: [f64; 2],
    /// Largest depth behind a face, mm.
    pub depth_mm: f64,
}

/// An arm: a GP25, its place and its tool.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrawnArm {
    /// Name of the device.
    pub name: String,
    /// Its foot in the cell's frame, mm.
    pub foot_mm: [f64; 3],
    /// How far it is turned about the vertical, rad.
    #[serde(default)]
    pub turn_rad: f64,
    /// Where its job HOME ends: it stands there while another arm works.
    #[serde(default = "home_rad")]
    pub home_rad: [f64; 6],
    /// The tip of the bit in the flange's frame, mm; the bit is parallel to the flange's axis.
    pub tip_mm: [f64; 3],
    /// The tool, bit first. Only the first capsule may come up to a face.
    pub tool: Vec<DrawnCapsule>,
}

fn home_rad() -> [f64; 6] {
    HOME_RAD
}

/// Part of a tool: all within a radius of a line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrawnCapsule {
    /// Name in messages.
    pub name: String,
    /// One end of the line, from the tip: z along the bit, so that what lies behind the tip is negative, mm.
    pub from_mm: [f64; 3],
    /// The other end, mm.
    pub to_mm: [f64; 3],
    /// Radius, mm.
    pub radius_mm: f64,
}

/// Something that stands still.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DrawnBox {
    /// Name in messages.
    pub name: String,
    /// Its middle in the cell's frame, mm.
    pub middle_mm: [f64; 3],
    /// Its edges along x, y and z, mm.
    pub size_mm: [f64; 3],
}

impl Default for CellDrawing {
    fn default() -> Self {
        let capsule = |name: &str, from_mm, to_mm, radius_mm| DrawnCapsule {
            name: name.into(),
            from_mm,
            to_mm,
            radius_mm,
        };
        let arm = |name: &str, foot_mm, home_rad| DrawnArm {
            name: name.into(),
            foot_mm,
            turn_rad: 0.0,
            home_rad,
            tip_mm: [0.0, -40.0, 300.0],
            tool: vec![
                capsule("bit", [0.0, 0.0, -80.0], [0.0, 0.0, -6.0], 6.0),
                capsule("driver", [0.0, 0.0, -250.0], [0.0, 0.0, -110.0], 32.0),
                capsule("bracket", [0.0, 40.0, -290.0], [0.0, 0.0, -250.0], 45.0),
            ],
        };
        let block = |name: &str, middle_mm, size_mm| DrawnBox {
            name: name.into(),
            middle_mm,
            size_mm,
        };
        Self {
            margin_mm: 20.0,
            unit: DrawnUnit {
                middle_mm: [1270.0, 0.0, 525.0],
                face_mm: [900.0, 750.0],
                depth_mm: 900.0,
            },
            // the bit rests 560 mm beside the middle of the table, 470 mm before the face and 750 mm high, each arm's on its own side: out of the
            // camera's view and of the other arm's way, and from there most ways lead straight to a face
            arms: vec![
                arm("arm_a", [0.0; 3], [-1.249, -0.226, -1.122, 1.316, 1.372, -0.65]),
                arm(
                    "arm_b",
                    [0.0, 700.0, 0.0],
                    [-0.733, -1.167, -1.479, 1.242, 0.785, -1.122],
                ),
            ],
            obstacles: vec![
                block("floor", [800.0, 350.0, -50.0], [5000.0, 4000.0, 100.0]),
                block("table", [1500.0, 0.0, 45.0], [1000.0, 1000.0, 90.0]),
                block("camera", [-430.0, 0.0, 320.0], [160.0, 200.0, 640.0]),
            ],
        }
    }
}
