//! What a fastener or something that may be taken for one *is*: kind, size, finish and wear, before it is turned into a relief.

use serde::{Deserialize, Serialize};

/// Shape of a cross-recessed screw's head.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Head {
    /// High, rounded edge, flat top.
    Pan,
    /// Low and wide dome.
    Truss,
    /// Pan with a bevelled rim.
    Binding,
    /// Pan head with a pressed-on washer.
    Washer,
    /// Hexagon with a flange and a cross recess in its top.
    HexFlange,
}

/// Shape of the cross recess.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CrossRecess {
    /// Japanese cross recess: sharp corners, a dimple on the head.
    Jis,
    /// Phillips: rounded root, tapered wings.
    Phillips,
    /// Phillips crossed by one long slot.
    Combination,
}

/// Surface of a fastener.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Plating {
    /// Bright zinc.
    Zinc,
    /// Weathered zinc.
    DullZinc,
    /// Yellow chromate.
    Chromate,
    /// Black oxide.
    BlackOxide,
    /// Stainless steel.
    Stainless,
    /// Bright nickel.
    Nickel,
    /// Bronze or copper tone.
    Bronze,
    /// Painted in the panel's colour.
    Painted,
}

/// Things on an outdoor unit that are not a cross-recessed screw.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decoy {
    /// A punched or drilled hole.
    Hole,
    /// The empty hole of a removed screw, with the mark of its head around it.
    EmptyScrewHole,
    /// Blind or solid rivet.
    Rivet,
    /// Hexagon head without a recess.
    HexBolt,
    /// Hexagon head with a flange, without a recess.
    HexFlangeBolt,
    /// Cylinder or button head with a hexagon socket.
    HexSocket,
    /// Head with one slot.
    Slotted,
    /// Head with a hexalobular recess.
    Torx,
    /// Pressed dimple in the sheet.
    Dimple,
    /// Cross pressed into the sheet.
    CrossEmboss,
    /// Patch of rust.
    RustSpot,
    /// Printed symbol: ring, disc, plus in a circle, letter.
    PrintedMark,
    /// Plastic cap or plug.
    PlasticCap,
    /// Spot weld.
    Weld,
    /// Nut on a stud.
    Nut,
    /// Half-punched knock-out disc.
    Knockout,
    /// Lump of mud or sealant.
    Blob,
}

/// What drives a fastener: the answer that stage 2 of the detector has to give.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Drive {
    /// Cross recess (Phillips, JIS, combination).
    Cross,
    /// One slot.
    Slotted,
    /// Hexagon socket.
    HexSocket,
    /// Hexalobular recess.
    Torx,
    /// External hexagon without a recess.
    HexHead,
}

impl Decoy {
    /// Every kind, in a fixed order.
    pub const ALL: [Decoy; 17] = [
        Decoy::Hole,
        Decoy::EmptyScrewHole,
        Decoy::Rivet,
        Decoy::HexBolt,
        Decoy::HexFlangeBolt,
        Decoy::HexSocket,
        Decoy::Slotted,
        Decoy::Torx,
        Decoy::Dimple,
        Decoy::CrossEmboss,
        Decoy::RustSpot,
        Decoy::PrintedMark,
        Decoy::PlasticCap,
        Decoy::Weld,
        Decoy::Nut,
        Decoy::Knockout,
        Decoy::Blob,
    ];

    /// The drive of a decoy that is a fastener, `None` for what is no fastener at all.
    pub fn drive(self) -> Option<Drive> {
        match self {
            Decoy::HexBolt | Decoy::HexFlangeBolt | Decoy::Nut => Some(Drive::HexHead),
            Decoy::HexSocket => Some(Drive::HexSocket),
            Decoy::Slotted => Some(Drive::Slotted),
            Decoy::Torx => Some(Drive::Torx),
            _ => None,
        }
    }

    /// The snake-case name used in files and reports.
    pub fn name(self) -> &'static str {
        match self {
            Decoy::Hole => "hole",
            Decoy::EmptyScrewHole => "empty_screw_hole",
            Decoy::Rivet => "rivet",
            Decoy::HexBolt => "hex_bolt",
            Decoy::HexFlangeBolt => "hex_flange_bolt",
            Decoy::HexSocket => "hex_socket",
            Decoy::Slotted => "slotted",
            Decoy::Torx => "torx",
            Decoy::Dimple => "dimple",
            Decoy::CrossEmboss => "cross_emboss",
            Decoy::RustSpot => "rust_spot",
            Decoy::PrintedMark => "printed_mark",
            Decoy::PlasticCap => "plastic_cap",
            Decoy::Weld => "weld",
            Decoy::Nut => "nut",
            Decoy::Knockout => "knockout",
            Decoy::Blob => "blob",
        }
    }
}

/// Kind of one item on a face.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A screw that the cross bit fits.
    Screw {
        /// Shape of the head.
        head: Head,
        /// Shape of the recess.
        recess: CrossRecess,
        /// Width across the recess wings, mm.
        recess_width_mm: f64,
    },
    /// Anything else.
    Decoy(Decoy),
}

/// Wear, every level 0 (none) to 1 (worst).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Wear {
    /// Red rust on head and around it.
    pub rust: f32,
    /// White zinc corrosion.
    pub white_rust: f32,
    /// Dark grime.
    pub dirt: f32,
    /// Pale dust.
    pub dust: f32,
    /// Mud or grease filling the slot.
    pub mud_in_slot: f32,
    /// Panel paint laid over head and slot.
    pub paint_over: f32,
    /// Slot rounded by an earlier bit (cam-out).
    pub worn_slot: f32,
    /// Head dented or bent out of shape.
    pub bent_head: f32,
    /// Strands of spider web across.
    pub web: f32,
    /// Coating chipped off.
    pub chipped: f32,
}

/// One item on a face, in the face's own plane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Item {
    /// What it is.
    pub kind: Kind,
    /// Diameter of head, hole or mark, mm.
    pub diameter_mm: f64,
    /// Rotation about its own axis, rad.
    pub rotation_rad: f64,
    /// Tilt of its axis against the sheet's normal (seated askew), rad.
    pub tilt_rad: f64,
    /// Direction of the tilt in the face's plane, rad.
    pub tilt_direction_rad: f64,
    /// How far it stands off the sheet (not screwed home), mm.
    pub lift_mm: f64,
    /// Offset of the recess from the head's middle (eccentric recess), mm, in the item's own axes.
    pub recess_offset_mm: [f64; 2],
    /// Surface.
    pub plating: Plating,
    /// Wear levels.
    pub wear: Wear,
    /// Seed of everything random in its appearance.
    pub seed: u64,
}
