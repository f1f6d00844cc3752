//! Shapes: heads, recesses and everything else that sits on a sheet, as heights and parts over the item's own axes.

mod drive;
mod head;
mod pressed;
mod screw;
mod sign;
mod solid;

use crate::bake::SheetFinish;
use crate::fastener::{Decoy, Item, Kind, Plating};
use crate::noise::smoothstep;
use crate::relief::Material;
use drive::{driven, hexagonal};
use pressed::{empty_hole, flat_spot, hole, pressed};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use screw::screw;
use sign::{cap, printed};
use solid::{blob, rivet, weld};

/// What an item consists of at one place of its own plane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Spot {
    /// Height above the sheet, mm.
    pub height: f32,
    /// Index into [`Form::materials`]; `None`: the sheet itself.
    pub part: Option<u8>,
    /// Depth of the recess here, mm (0 outside it).
    pub recess: f32,
    /// Bright torn metal, 0 to 1.
    pub burr: f32,
    /// Whether the place moves with a tilted item.
    pub solid: bool,
}

const SHEET: Spot = Spot {
    height: 0.0,
    part: None,
    recess: 0.0,
    burr: 0.0,
    solid: false,
};

impl Spot {
    fn body(height: f32, part: u8) -> Spot {
        Spot {
            height,
            part: Some(part),
            solid: true,
            ..SHEET
        }
    }

    fn sheet(height: f32) -> Spot {
        Spot { height, ..SHEET }
    }
}

/// Height and part over the item's own plane.
type Surface = Box<dyn Fn(f32, f32) -> Spot>;

/// A shape ready to be laid on the grid.
pub(crate) struct Form {
    /// Materials of its parts.
    pub materials: Vec<Material>,
    /// Height of the recess rim (or of the top), mm.
    pub rim_mm: f32,
    /// Nothing but sheet beyond this radius, mm.
    pub reach_mm: f32,
    /// Surface over the item's own axes.
    pub surface: Surface,
    /// Where rust, grime and chips may attack its parts: 1 metal, less for plastic or print.
    pub corrodes: f32,
}

pub(crate) fn between(rng: &mut Pcg64Mcg, low: f32, high: f32) -> f32 {
    rng.random_range(low..=high)
}

fn grey(value: f32) -> [f32; 3] {
    [value; 3]
}

fn scaled(albedo: [f32; 3], by: f32) -> [f32; 3] {
    albedo.map(|v| v * by)
}

fn matt(albedo: [f32; 3], roughness: f32) -> Material {
    Material {
        albedo,
        roughness,
        metallic: 0.0,
    }
}

fn metal(albedo: [f32; 3], roughness: f32) -> Material {
    Material {
        albedo,
        roughness,
        metallic: 1.0,
    }
}

/// A colour near `base`: `spread` in level, less in hue.
fn tint(rng: &mut Pcg64Mcg, base: [f32; 3], spread: f32) -> [f32; 3] {
    let level = between(rng, 1.0 - 1.5 * spread, 1.0 + spread);
    base.map(|v| {
        let hue = between(rng, 1.0 - 0.4 * spread, 1.0 + 0.4 * spread);
        (v * level * hue).clamp(0.01, 0.95)
    })
}

/// The surface of a plating, unlike any other of its kind.
pub(crate) fn plating(kind: Plating, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Material {
    match kind {
        Plating::Zinc => metal(tint(rng, [0.76, 0.78, 0.82], 0.1), between(rng, 0.24, 0.46)),
        Plating::DullZinc => Material {
            metallic: between(rng, 0.75, 1.0),
            ..metal(tint(rng, [0.58, 0.59, 0.61], 0.18), between(rng, 0.42, 0.68))
        },
        Plating::Chromate => metal(tint(rng, [0.82, 0.66, 0.34], 0.12), between(rng, 0.26, 0.48)),
        Plating::BlackOxide => Material {
            metallic: between(rng, 0.3, 0.9),
            ..metal(tint(rng, [0.065, 0.065, 0.07], 0.4), between(rng, 0.34, 0.6))
        },
        Plating::Stainless => metal(tint(rng, [0.64, 0.62, 0.60], 0.1), between(rng, 0.2, 0.4)),
        Plating::Nickel => metal(tint(rng, [0.72, 0.68, 0.61], 0.1), between(rng, 0.14, 0.32)),
        Plating::Bronze => metal(tint(rng, [0.66, 0.44, 0.27], 0.16), between(rng, 0.26, 0.5)),
        Plating::Painted => {
            let base = match rng.random_range(0..10) {
                0 => [0.75, 0.72, 0.62],
                1 => [0.68, 0.70, 0.70],
                _ => sheet.albedo,
            };
            let level = between(rng, 0.85, 1.1);
            matt(
                base.map(|v| (v * level).clamp(0.02, 0.9)),
                (sheet.roughness + between(rng, -0.15, 0.1)).clamp(0.25, 0.8),
            )
        }
    }
}

/// A pressed-on washer has its head's plating, or zinc.
fn washer_plating(head: Material, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Material {
    if rng.random_bool(0.7) {
        head
    } else {
        plating(Plating::Zinc, sheet, rng)
    }
}

/// Form pressed into the sheet under an item.
#[derive(Clone, Copy)]
enum Seat {
    Flat,
    /// Plateau (or, negative, dish): height, inner and outer radius of its flank.
    Step(f32, f32, f32),
    /// Ring around the item: height, radius, width.
    Bead(f32, f32, f32),
}

impl Seat {
    fn at(self, r: f32) -> f32 {
        match self {
            Seat::Flat => 0.0,
            Seat::Step(height, inner, outer) => height * (1.0 - smoothstep(inner, outer, r)),
            Seat::Bead(height, ring, width) => {
                let t = (r - ring) / width;
                height * (-t * t).exp()
            }
        }
    }
}

/// Most items sit on plain sheet, some on a boss, in a dish or inside a bead.
fn seat(radius: f32, rng: &mut Pcg64Mcg) -> impl Fn(f32) -> f32 + 'static {
    let inner = radius * between(rng, 1.1, 1.6);
    let flank = radius * between(rng, 0.15, 0.5);
    let seat = match rng.random_range(0..10) {
        0 => Seat::Step(between(rng, 0.3, 1.2), inner, inner + flank),
        1 => Seat::Step(-between(rng, 0.2, 1.0), inner, inner + flank),
        2 => Seat::Bead(between(rng, 0.1, 0.4), inner + 0.2 * radius, 0.5 * flank),
        _ => Seat::Flat,
    };
    move |r| seat.at(r)
}

/// Distance from a point to a segment `[u0, v0, u1, v1]`.
fn segment(u: f32, v: f32, s: [f32; 4]) -> f32 {
    let (du, dv) = (s[2] - s[0], s[3] - s[1]);
    let t = (((u - s[0]) * du + (v - s[1]) * dv) / (du * du + dv * dv).max(1e-6)).clamp(0.0, 1.0);
    ((u - s[0] - t * du).powi(2) + (v - s[1] - t * dv).powi(2)).sqrt()
}

/// The shape of an item.
pub(crate) fn build(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    match item.kind {
        Kind::Screw {
            head,
            recess,
            recess_width_mm,
        } => screw(item, head, recess, recess_width_mm as f32, sheet, rng),
        Kind::Decoy(decoy) => build_decoy(item, decoy, sheet, rng),
    }
}

fn build_decoy(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    match decoy {
        Decoy::Hole => hole(item, sheet, rng),
        Decoy::EmptyScrewHole => empty_hole(item, sheet, rng),
        Decoy::Rivet => rivet(item, sheet, rng),
        Decoy::HexBolt | Decoy::HexFlangeBolt | Decoy::Nut => hexagonal(item, decoy, sheet, rng),
        Decoy::HexSocket | Decoy::Torx | Decoy::Slotted => driven(item, decoy, sheet, rng),
        Decoy::Dimple | Decoy::CrossEmboss | Decoy::Knockout => pressed(item, decoy, sheet, rng),
        Decoy::RustSpot => flat_spot(item, sheet, rng),
        Decoy::PrintedMark => printed(item, sheet, rng),
        Decoy::PlasticCap => cap(item, rng),
        Decoy::Weld => weld(item, sheet, rng),
        Decoy::Blob => blob(item, rng),
    }
}
