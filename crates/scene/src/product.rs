//! Outdoor units: what they are made of, where their screws sit and which cover each screw holds.

use crate::fastener::{Decoy, Item, Kind};
use crate::layer::Sheetwork;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// A face of a unit that is photographed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaceId {
    /// The front panel with the fan grille.
    Front,
    /// The left side.
    Left,
    /// The right side with the valve cover.
    Right,
    /// The top panel.
    Top,
    /// What shows once the top cover is off: brackets, electrical box, motor mount.
    FrontInner,
}

impl FaceId {
    /// Every face, in the order of the paper's program.
    pub const ALL: [FaceId; 5] = [
        FaceId::Front,
        FaceId::Left,
        FaceId::Right,
        FaceId::Top,
        FaceId::FrontInner,
    ];

    /// The snake-case name used in files and reports.
    pub fn name(self) -> &'static str {
        match self {
            FaceId::Front => "front",
            FaceId::Left => "left",
            FaceId::Right => "right",
            FaceId::Top => "top",
            FaceId::FrontInner => "front_inner",
        }
    }
}

/// A cover that comes off once its screws are out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CoverId {
    /// Front cover; the left cover comes off with it.
    Front,
    /// Left cover: has no step of its own, it leaves with the front cover.
    Left,
    /// Right cover.
    Right,
    /// Top cover.
    Top,
    /// Front inner cover, under the top cover.
    FrontInner,
}

impl CoverId {
    /// The snake-case name used in files and reports.
    pub fn name(self) -> &'static str {
        match self {
            CoverId::Front => "front",
            CoverId::Left => "left",
            CoverId::Right => "right",
            CoverId::Top => "top",
            CoverId::FrontInner => "front_inner",
        }
    }
}

/// A screw within its unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ScrewId(pub u16);

/// A cross-recessed screw of a unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Screw {
    /// Unique within the unit.
    pub id: ScrewId,
    /// Where and what it is.
    pub placed: Placed,
    /// Torque that loosens it, N m.
    pub torque_nm: f64,
    /// True if it is rusted solid: no torque of the driver loosens it.
    pub seized: bool,
}

/// An item at its place on a face.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Placed {
    /// What it is.
    pub item: Item,
    /// Place in the plane of the face, mm: x right, y down from the middle of the face.
    pub at_mm: [f64; 2],
    /// Height of the sheet it sits in above the plane of the face, mm.
    pub height_mm: f64,
}

impl Placed {
    /// The kind of a decoy; `None` for a screw.
    pub fn decoy(&self) -> Option<Decoy> {
        match self.item.kind {
            Kind::Decoy(decoy) => Some(decoy),
            Kind::Screw { .. } => None,
        }
    }
}

/// What a cover is held by.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cover {
    /// Which.
    pub id: CoverId,
    /// The face on which its screws are.
    pub face: FaceId,
    /// Its screws.
    pub screws: Vec<ScrewId>,
    /// The cover that takes it along, if it has no step of its own.
    pub leaves_with: Option<CoverId>,
}

/// What a unit has been through.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Theme {
    /// A few years under a roof.
    Clean,
    /// Dust and grime of a street.
    Dusty,
    /// Red rust of a coast.
    Coastal,
    /// Mud splashed up from the ground.
    Muddy,
    /// Painted over together with the wall.
    Repainted,
    /// Zinc gone white, paint chalky.
    Chalky,
    /// Grease and soot from a kitchen outlet.
    Greasy,
}

/// What a unit is spoilt by: why the paper excluded units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Exclusion {
    /// Slots filled with mud.
    MudFilledSlot,
    /// Slots under a dense web.
    DenseWeb,
    /// A screw rusted solid.
    Seized,
    /// A cover bent so far that its screws lean beyond the range of the paper's driver.
    BentCover,
}

/// One face: its sheets, its screws and what may be taken for them.
#[derive(Clone, Debug)]
pub struct FaceDesign {
    /// Which.
    pub id: FaceId,
    /// Width, mm.
    pub width_mm: f64,
    /// Height (along y), mm.
    pub height_mm: f64,
    /// Screws that the cross bit fits.
    pub screws: Vec<Screw>,
    /// Everything else.
    pub decoys: Vec<Placed>,
    pub(crate) sheetwork: Sheetwork,
}

impl FaceDesign {
    /// Reflectance of the brightest of its large sheets, 0 black to 1 white.
    pub fn brightness(&self) -> f32 {
        let size = |b: &crate::shape::Bounds| (b.high[0] - b.low[0]) * (b.high[1] - b.low[1]);
        let largest = self
            .sheetwork
            .layers
            .iter()
            .map(|l| size(&l.bounds))
            .fold(0.0, f32::max);
        let large = self.sheetwork.layers.iter().filter(|l| size(&l.bounds) > 0.5 * largest);
        large
            .map(|l| 0.3 * l.paint.albedo[0] + 0.59 * l.paint.albedo[1] + 0.11 * l.paint.albedo[2])
            .fold(0.0, f32::max)
    }
}

/// An outdoor unit.
#[derive(Clone, Debug)]
pub struct Unit {
    /// What it was drawn from.
    pub seed: u64,
    /// Model number on its plate.
    pub model: String,
    /// Width, depth, height, mm: within 900 x 400 x 750.
    pub size_mm: [f64; 3],
    /// What it has been through.
    pub theme: Theme,
    /// Its faces.
    pub faces: Vec<Arc<FaceDesign>>,
    /// Its covers.
    pub covers: Vec<Cover>,
    /// Why it cannot be done, if it cannot.
    pub exclusion: Option<Exclusion>,
}

/// How hard units are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct UnitOptions {
    /// Factor on every wear level: 0 as new, 1 as collected.
    pub wear: f32,
    /// Whether there is anything that may be taken for a screw.
    pub decoys: bool,
    /// Share of units that cannot be done; in the paper 28 of 120.
    pub excluded_share: f64,
}

impl Default for UnitOptions {
    fn default() -> Self {
        Self {
            wear: 1.0,
            decoys: true,
            excluded_share: 28.0 / 120.0,
        }
    }
}

impl Unit {
    /// A unit as a recycling plant receives it; the same for the same seed.
    pub fn sample(seed: u64) -> Self {
        Self::sample_with(seed, &UnitOptions::default())
    }

    /// A unit of chosen severity.
    pub fn sample_with(seed: u64, options: &UnitOptions) -> Self {
        crate::layout::unit(seed, options)
    }

    /// The paper's gauge: a plate with nothing but screws, as its only face [`FaceId::Front`].
    pub fn gauge(seed: u64) -> Self {
        crate::layout::gauge(seed)
    }

    /// A face; `None` if this unit (a gauge) does not have it.
    pub fn face(&self, id: FaceId) -> Option<&Arc<FaceDesign>> {
        self.faces.iter().find(|face| face.id == id)
    }

    /// Every screw with the face it is on.
    pub fn screws(&self) -> impl Iterator<Item = (FaceId, &Screw)> {
        self.faces
            .iter()
            .flat_map(|face| face.screws.iter().map(move |screw| (face.id, screw)))
    }

    /// The cover that a screw holds.
    pub fn cover_of(&self, screw: ScrewId) -> Option<&Cover> {
        self.covers.iter().find(|cover| cover.screws.contains(&screw))
    }
}
