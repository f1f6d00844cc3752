//! Shapes: heads, recesses and everything else that sits on a sheet, as heights and parts over the item's own axes.

use crate::bake::SheetFinish;
use crate::fastener::{CrossRecess, Decoy, Head, Item, Kind, Plating};
use crate::noise::{Grain, Noise, smoothstep};
use crate::relief::Material;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f32::consts::{PI, TAU};

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

/// Cross recess: depth below the rim over its own axes.
struct Cross {
    half: f32,
    wing: f32,
    taper: f32,
    fillet: f32,
    depth: f32,
    side: f32,
    floor: f32,
    core: f32,
    slot: Option<[f32; 3]>,
    worn: f32,
    ragged: Noise,
    twist: f32,
}

impl Cross {
    fn new(kind: CrossRecess, width: f32, head_radius: f32, head_height: f32, worn: f32, rng: &mut Pcg64Mcg) -> Cross {
        let half = 0.5 * width;
        let jis = kind == CrossRecess::Jis;
        let wing = half
            * if jis {
                between(rng, 0.17, 0.25)
            } else {
                between(rng, 0.19, 0.3)
            };
        let depth = (half * between(rng, 0.85, 1.25)).min(head_height * 0.85 + 0.5).max(0.7);
        let slot = (kind == CrossRecess::Combination).then(|| {
            [
                head_radius * between(rng, 0.72, 1.05),
                between(rng, 0.35, 0.6),
                between(rng, 0.6, 1.1),
            ]
        });
        Cross {
            half,
            wing: wing * (1.0 + 0.25 * worn),
            taper: if jis {
                between(rng, 0.0, 0.2)
            } else {
                between(rng, 0.1, 0.55)
            },
            fillet: if jis {
                between(rng, 0.04, 0.12)
            } else {
                between(rng, 0.15, 0.4)
            } + 0.4 * worn,
            depth: depth * (1.0 - 0.3 * worn),
            side: 7.0 - 4.8 * worn.sqrt(),
            floor: between(rng, 1.4, 2.3),
            core: half * (between(rng, 0.26, 0.4) + 0.38 * worn),
            slot,
            worn,
            ragged: Noise::new(Grain::Cloud, 1.8, rng),
            twist: if rng.random_bool(0.8) { 0.5 * worn } else { -0.5 * worn },
        }
    }

    /// Depth and burr at a place of the recess' own plane.
    fn at(&self, u: f32, v: f32) -> (f32, f32) {
        let r = (u * u + v * v).sqrt();
        let outer = self.slot.map_or(self.half, |slot| slot[0].max(self.half)) + 0.8;
        if r > outer {
            return (0.0, 0.0);
        }
        let wing = |s: f32, t: f32| {
            let half_width = self.wing * (1.0 + self.taper * (1.0 - s / self.half));
            (t - half_width).max(s - self.half)
        };
        let (a, b) = (u.abs(), v.abs());
        let (d1, d2) = (wing(a, b), wing(b, a));
        // Smooth union of the two arms: the fillet at the roots.
        let k = self.fillet.max(0.02);
        let h = (0.5 + 0.5 * (d2 - d1) / k).clamp(0.0, 1.0);
        let mut inside = d2 + h * (d1 - d2) - k * h * (1.0 - h);
        inside = inside.min(r - self.core);
        let mut burr = 0.0;
        if self.worn > 0.02 {
            // A slipping bit tears one flank of every wing, at its edge more than at its root.
            let quadrant = (u * v).signum() * if a > b { 1.0 } else { -1.0 };
            let rough = self.ragged.at(u, v) - 0.35;
            let flank = 0.5 + 0.5 * quadrant * self.twist.signum();
            inside -= self.worn * self.half * (0.16 * flank + 0.22 * rough);
            let edge = inside / 0.22;
            burr = (self.worn * 1.6).min(1.0) * (-edge * edge).exp() * smoothstep(-0.1, 0.35, rough);
        }
        let floor = ((self.half - r) * self.floor + 0.55).clamp(0.1, self.depth) + (0.5 * (self.core - r)).max(0.0);
        let mut depth = (-inside * self.side).min(floor).max(0.0);
        if let Some([length, half_width, slot_depth]) = self.slot {
            let flank = ((half_width - b) * 6.0).min((length - a) * 4.0);
            depth = depth.max(flank.min(slot_depth).max(0.0));
        }
        (depth, burr)
    }
}

/// Profile of a head's top over its radius.
struct Profile {
    height: f32,
    edge: f32,
    power: f32,
    bevel: f32,
}

impl Profile {
    /// Height at `rho` (0 middle, 1 rim).
    fn at(&self, rho: f32) -> f32 {
        let dome = (1.0 - rho.powf(self.power)).max(0.0).sqrt();
        let mut height = self.height * (self.edge + (1.0 - self.edge) * dome);
        if self.bevel > 0.0 && rho > 1.0 - self.bevel {
            height = height.min(self.height * (self.edge + 0.4 * (1.0 - rho) / self.bevel));
        }
        height
    }
}

fn hexagon(u: f32, v: f32) -> f32 {
    let a = u.abs();
    a.max(0.5 * a + 0.866_025_4 * v.abs())
}

/// Top of a hexagon of half width `flat`: flat with the corners chamfered.
fn hex_top(u: f32, v: f32, flat: f32, height: f32, chamfer: f32) -> Option<f32> {
    if hexagon(u, v) > flat {
        return None;
    }
    let r = (u * u + v * v).sqrt();
    Some(height - ((r - flat * chamfer).max(0.0) * 0.6) - 0.3 * (hexagon(u, v) - flat + 0.2).max(0.0))
}

/// Half-width of a hexalobular outline over the angle.
fn lobes(theta: f32, radius: f32, depth: f32) -> f32 {
    radius * (1.0 - depth + depth * (6.0 * theta).cos())
}

/// Concentric turning marks and the waviness of pressing, as a height.
fn marks(radius: f32, rng: &mut Pcg64Mcg) -> impl Fn(f32, f32) -> f32 + 'static {
    let turned = if rng.random_bool(0.5) {
        between(rng, 0.002, 0.008)
    } else {
        0.0
    };
    let rings: Vec<f32> = (0..64).map(|_| between(rng, -1.0, 1.0)).collect();
    let wave = Noise::new(Grain::Cloud, radius * between(rng, 0.5, 1.2), rng);
    let depth = between(rng, 0.01, 0.07);
    let grain = Noise::new(Grain::Even, 0.25, rng);
    let grain_depth = between(rng, 0.0, 0.02);
    move |u, v| {
        let r = (u * u + v * v).sqrt() / (0.13 * radius.max(1.0) / 3.0);
        turned * rings[r as usize % 64] + depth * (wave.at(u, v) - 0.5) + grain_depth * (grain.at(u, v) - 0.5)
    }
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

fn screw(item: &Item, head: Head, recess: CrossRecess, width: f32, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let main = plating(item.plating, sheet, rng);
    let foot = seat(radius, rng);
    let shape = head_shape(head, radius, rng);
    let cross = Cross::new(
        recess,
        width,
        shape.top_radius,
        shape.profile.height,
        item.wear.worn_slot,
        rng,
    );
    let [ox, oy] = item.recess_offset_mm.map(|v| v as f32);
    let relief = marks(radius, rng);
    // The dimple that tells JIS, opposite a quadrant, when there is one.
    let dimple = (recess == CrossRecess::Jis && rng.random_bool(0.5)).then(|| {
        let angle = PI / 4.0 + PI / 2.0 * rng.random_range(0..4) as f32;
        let at = shape.top_radius * between(rng, 0.55, 0.72);
        (at * angle.cos(), at * angle.sin(), between(rng, 0.25, 0.45))
    });
    let top = shape.top(0.0, 0.0).map_or(1.0, |s| s.0);
    let base = foot(0.0);
    let swell = between(rng, 0.0, 0.05);
    // The rim of the recess lies where the wings end, a little below a dome's top.
    let rim_mm = base + shape.top(ox + 0.35 * width, oy).map_or(top, |s| s.0);
    let washer = if rng.random_bool(0.7) {
        main
    } else {
        plating(Plating::Zinc, sheet, rng)
    };
    Form {
        materials: vec![main, washer, matt(grey(0.02), 0.8)],
        rim_mm,
        reach_mm: 2.2 * radius,
        corrodes: 1.0,
        surface: Box::new(move |u, v| {
            let Some((height, part)) = shape.top(u, v) else {
                return Spot::sheet(foot((u * u + v * v).sqrt()));
            };
            let (depth, burr) = cross.at(u - ox, v - oy);
            let mut spot = Spot::body(base + height + relief(u, v), part);
            if let Some((du, dv, size)) = dimple {
                let t = ((u - du).powi(2) + (v - dv).powi(2)) / (size * size);
                spot.height -= 0.6 * size * (1.0 - t).max(0.0).sqrt();
            }
            if depth > 0.0 {
                // The floor is measured from the rim's plane, so a dome does not lift it.
                spot.height = spot.height.min(rim_mm - depth).max(base - 1.5);
                spot.recess = depth;
            } else if swell > 0.0 {
                spot.height += swell * burr;
            }
            spot.height += 0.12 * burr;
            spot.burr = burr;
            spot
        }),
    }
}

/// A head without its recess.
struct HeadShape {
    profile: Profile,
    top_radius: f32,
    washer: Option<[f32; 3]>,
    hex: Option<[f32; 4]>,
}

impl HeadShape {
    /// Height above the seat and part (1: washer or flange), `None` outside.
    fn top(&self, u: f32, v: f32) -> Option<(f32, u8)> {
        let r = (u * u + v * v).sqrt();
        let mut top = None;
        if let Some([radius, thickness, slope]) = self.washer
            && r < radius
        {
            let edge = ((radius - r) / 0.3).min(1.0);
            let rise = slope * (1.0 - r / radius).max(0.0);
            top = Some((thickness * (0.4 + 0.6 * edge) + rise, 1));
        }
        let above = top.map_or(0.0, |t| t.0);
        let head = if let Some([flat, height, chamfer, dish]) = self.hex {
            hex_top(u, v, flat, height, chamfer).map(|h| {
                let hollow = if dish > 0.0 {
                    dish * (1.0 - smoothstep(0.62, 0.78, r / flat))
                } else {
                    0.0
                };
                h - hollow
            })
        } else {
            (r < self.top_radius).then(|| self.profile.at(r / self.top_radius))
        };
        match head {
            Some(height) if height > above || self.washer.is_none() => Some((height.max(above), 0)),
            _ => top,
        }
    }
}

fn head_shape(head: Head, radius: f32, rng: &mut Pcg64Mcg) -> HeadShape {
    let d = 2.0 * radius;
    let dome = |height: f32, edge: f32, power: f32, bevel: f32| Profile {
        height,
        edge,
        power,
        bevel,
    };
    match head {
        Head::Pan => HeadShape {
            profile: dome(
                d * between(rng, 0.3, 0.4),
                between(rng, 0.2, 0.45),
                between(rng, 2.3, 4.5),
                0.0,
            ),
            top_radius: radius,
            washer: None,
            hex: None,
        },
        Head::Truss => HeadShape {
            profile: dome(
                d * between(rng, 0.19, 0.27),
                between(rng, 0.08, 0.2),
                between(rng, 1.9, 2.4),
                0.0,
            ),
            top_radius: radius,
            washer: None,
            hex: None,
        },
        Head::Binding => HeadShape {
            profile: dome(
                d * between(rng, 0.24, 0.32),
                between(rng, 0.25, 0.45),
                between(rng, 2.2, 3.0),
                between(rng, 0.12, 0.25),
            ),
            top_radius: radius,
            washer: None,
            hex: None,
        },
        Head::Washer => {
            let inner = radius * between(rng, 0.62, 0.8);
            let thickness = between(rng, 0.6, 1.2);
            HeadShape {
                profile: dome(
                    thickness + 2.0 * inner * between(rng, 0.3, 0.4),
                    between(rng, 0.4, 0.55),
                    between(rng, 2.3, 4.0),
                    0.0,
                ),
                top_radius: inner,
                washer: Some([radius, thickness, between(rng, 0.0, 0.3)]),
                hex: None,
            }
        }
        Head::HexFlange => {
            let flat = radius * between(rng, 0.62, 0.74);
            let height = d * between(rng, 0.3, 0.42);
            let dish = if rng.random_bool(0.5) {
                between(rng, 0.15, 0.5)
            } else {
                0.0
            };
            HeadShape {
                profile: dome(height, 0.5, 3.0, 0.0),
                top_radius: flat,
                washer: Some([radius, between(rng, 0.5, 0.9), between(rng, 0.5, 1.0)]),
                hex: Some([flat, height, between(rng, 0.88, 1.0), dish]),
            }
        }
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

/// The dark or metallic ground behind a hole.
fn behind(rng: &mut Pcg64Mcg) -> (f32, Material) {
    if rng.random_bool(0.62) {
        (between(rng, 6.0, 14.0), matt(grey(between(rng, 0.004, 0.03)), 0.8))
    } else if rng.random_bool(0.6) {
        let level = between(rng, 0.15, 0.6);
        (between(rng, 1.2, 6.0), metal(grey(level), between(rng, 0.3, 0.7)))
    } else {
        let level = between(rng, 0.03, 0.4);
        let warm = between(rng, 0.7, 1.0);
        (
            between(rng, 1.2, 6.0),
            matt([level, level * warm, level * warm * warm], 0.7),
        )
    }
}

fn hole(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let (depth, ground) = behind(rng);
    let foot = seat(radius, rng);
    let base = foot(0.0);
    let style = rng.random_range(0..10);
    let lip = match style {
        0..=3 => between(rng, 0.05, 0.3),
        4 | 5 => -between(rng, 0.05, 0.3),
        _ => 0.0,
    };
    let lip_width = between(rng, 0.15, 0.6);
    let sink = if style == 6 || style == 7 {
        between(rng, 0.25, 0.5) * radius
    } else {
        0.0
    };
    let bare = if sheet.metallic > 0.5 || rng.random_bool(0.5) {
        None
    } else {
        Some(0)
    };
    let ragged = Noise::new(Grain::Cloud, 1.5, rng);
    let raggedness = if rng.random_bool(0.3) {
        between(rng, 0.05, 0.3)
    } else {
        0.02
    };
    // Slots and keyholes among the round ones.
    let stretch = if rng.random_bool(0.15) {
        between(rng, 0.3, 0.9) * radius
    } else {
        0.0
    };
    let thread = rng.random_bool(0.2);
    Form {
        materials: vec![
            metal(grey(between(rng, 0.35, 0.75)), between(rng, 0.3, 0.6)),
            ground,
            metal(grey(between(rng, 0.15, 0.5)), 0.5),
        ],
        rim_mm: base,
        reach_mm: 2.2 * radius,
        corrodes: 0.6,
        surface: Box::new(move |u, v| {
            let along = (u.abs() - stretch).max(0.0);
            let r = (along * along + v * v).sqrt();
            let edge = (radius - stretch * 0.5) * (1.0 - raggedness * 0.5 * ragged.at(u, v));
            let out = r - edge + sink;
            if out < 0.0 {
                let wall = (-out * 12.0).min(depth);
                if wall < depth {
                    let groove = if thread { 0.08 * (wall * 7.0).sin() } else { 0.0 };
                    return Spot {
                        height: base - wall + groove,
                        part: Some(2),
                        ..SHEET
                    };
                }
                return Spot {
                    height: base - depth,
                    part: Some(1),
                    ..SHEET
                };
            }
            if sink > 0.0 && out < sink {
                return Spot {
                    height: base - (sink - out) * 0.9,
                    part: bare,
                    ..SHEET
                };
            }
            let t = (out - sink) / lip_width;
            let ring = lip * (-t * t * 2.0).exp();
            Spot {
                height: foot(r) + ring,
                part: if lip > 0.1 && out < 0.5 * lip_width { bare } else { None },
                burr: 0.0,
                ..SHEET
            }
        }),
    }
}

fn empty_hole(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let inner = radius * between(rng, 0.3, 0.55);
    let (depth, ground) = behind(rng);
    let foot = seat(radius, rng);
    let base = foot(0.0);
    let clean = match rng.random_range(0..4) {
        0 => metal(grey(between(rng, 0.45, 0.75)), between(rng, 0.3, 0.6)),
        1 => matt(sheet.albedo.map(|v| (v * 0.75).min(0.9)), 0.6),
        _ => Material {
            albedo: sheet.albedo.map(|v| (v * 1.12).min(0.92)),
            roughness: sheet.roughness,
            metallic: sheet.metallic,
        },
    };
    let ring = matt(scaled([0.09, 0.07, 0.055], between(rng, 0.5, 2.5)), 0.8);
    let ring_width = between(rng, 0.0, 0.5);
    let ragged = Noise::new(Grain::Cloud, 2.0, rng);
    let extruded = if rng.random_bool(0.5) {
        between(rng, -0.5, 0.2)
    } else {
        0.0
    };
    let scratch = Noise::new(Grain::Even, 0.4, rng);
    let lip = between(rng, 0.3, 0.7);
    Form {
        materials: vec![clean, ground, metal(grey(between(rng, 0.25, 0.6)), 0.45), ring],
        rim_mm: base,
        reach_mm: 2.2 * radius,
        corrodes: 0.8,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            if r < inner {
                let wall = ((inner - r) * 10.0).min(depth);
                let part = if wall < depth { 2 } else { 1 };
                return Spot {
                    height: base - wall,
                    part: Some(part),
                    ..SHEET
                };
            }
            let t = (r - inner) / lip;
            let height = foot(r) + extruded * (-t * t).exp();
            let edge = radius + 0.35 * (ragged.at(u, v) - 0.5);
            let part = if r < edge - ring_width {
                (scratch.at(r * 1.3, 0.0) > 0.12).then_some(0)
            } else if r < edge {
                Some(3)
            } else {
                None
            };
            Spot { height, part, ..SHEET }
        }),
    }
}

fn rivet(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let main = match rng.random_range(0..6) {
        0..=2 => metal(grey(between(rng, 0.6, 0.85)), between(rng, 0.25, 0.55)),
        3 => plating(Plating::Painted, sheet, rng),
        4 => plating(Plating::BlackOxide, sheet, rng),
        _ => plating(item.plating, sheet, rng),
    };
    let profile = Profile {
        height: radius * between(rng, 0.3, 0.6),
        edge: between(rng, 0.1, 0.4),
        power: between(rng, 1.8, 3.5),
        bevel: 0.0,
    };
    let blind = rng.random_bool(0.75);
    let pit = radius * between(rng, 0.2, 0.42);
    let depth = between(rng, 0.2, 1.6);
    let stub = if rng.random_bool(0.6) {
        between(rng, 0.0, 1.0) * depth
    } else {
        -2.0
    };
    let relief = marks(radius, rng);
    let foot = seat(radius, rng);
    let base = foot(0.0);
    Form {
        materials: vec![main, metal(grey(between(rng, 0.2, 0.5)), 0.5), matt(grey(0.02), 0.8)],
        rim_mm: base + profile.height,
        reach_mm: 2.2 * radius,
        corrodes: 0.7,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            if r >= radius {
                return Spot::sheet(foot(r));
            }
            let top = base + profile.at(r / radius) + relief(u, v);
            if blind && r < pit {
                let wall = ((pit - r) * 6.0).min(depth);
                if stub > -1.0 && r < 0.75 * pit {
                    return Spot::body(top - depth + stub, 1);
                }
                return Spot::body(top - wall, if wall >= depth { 2 } else { 0 });
            }
            Spot::body(top, 0)
        }),
    }
}

fn hexagonal(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let flange = decoy == Decoy::HexFlangeBolt || rng.random_bool(0.3);
    let flat = if flange {
        radius * between(rng, 0.6, 0.76)
    } else {
        radius * 0.866
    };
    let height = flat * between(rng, 0.6, 0.95);
    let chamfer = between(rng, 0.88, 1.02);
    let main = plating(item.plating, sheet, rng);
    let second = if rng.random_bool(0.6) {
        main
    } else {
        plating(Plating::Zinc, sheet, rng)
    };
    let flange_height = between(rng, 0.4, 1.1);
    let cone = if decoy == Decoy::HexFlangeBolt {
        between(rng, 0.4, 1.2)
    } else {
        0.0
    };
    let dish = if decoy != Decoy::Nut && rng.random_bool(0.45) {
        between(rng, 0.1, 0.6)
    } else {
        0.0
    };
    let dish_radius = between(rng, 0.6, 0.8);
    let nut = decoy == Decoy::Nut;
    let bore = flat * between(rng, 0.5, 0.62);
    let stud = if rng.random_bool(0.8) {
        between(rng, -0.6, 2.5)
    } else {
        -20.0
    };
    let pitch = between(rng, 0.7, 1.0);
    let nylon = nut && rng.random_bool(0.25);
    // Stamped strength marks: strokes of letters, dots or radial lines.
    let stamp = rng.random_range(0..4);
    let strokes: Vec<[f32; 4]> = (0..rng.random_range(3..9))
        .map(|i| match stamp {
            1 => {
                let angle = TAU * i as f32 / 3.0;
                let (s, c) = angle.sin_cos();
                [0.35 * flat * c, 0.35 * flat * s, 0.75 * flat * c, 0.75 * flat * s]
            }
            _ => {
                let u = between(rng, -0.5, 0.5) * flat;
                let v = between(rng, -0.35, 0.35) * flat;
                let (du, dv) = (between(rng, -0.25, 0.25) * flat, between(rng, -0.3, 0.3) * flat);
                [u, v, u + du, v + dv]
            }
        })
        .collect();
    let raised = if rng.random_bool(0.6) {
        between(rng, 0.06, 0.2)
    } else {
        -between(rng, 0.06, 0.2)
    };
    let relief = marks(radius, rng);
    let foot = seat(radius, rng);
    let base = foot(0.0);
    let ring = matt(
        [[0.1, 0.15, 0.5], [0.7, 0.7, 0.68], [0.5, 0.1, 0.08]][rng.random_range(0..3)],
        0.5,
    );
    Form {
        materials: vec![main, second, matt(grey(0.02), 0.8), ring],
        rim_mm: base + height,
        reach_mm: 2.2 * radius,
        corrodes: 1.0,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            let mut spot = Spot::sheet(foot(r));
            let mut under = 0.0;
            if flange && r < radius {
                let edge = ((radius - r) / 0.25).min(1.0);
                under = flange_height * (0.4 + 0.6 * edge) + cone * (1.0 - r / radius);
                spot = Spot::body(base + under, 1);
            }
            if let Some(top) = hex_top(u, v, flat, height, chamfer)
                && top > under
            {
                spot = Spot::body(base + top + relief(u, v), 0);
                if !nut {
                    if dish > 0.0 {
                        spot.height -= dish * (1.0 - smoothstep(dish_radius - 0.08, dish_radius + 0.05, r / flat));
                    }
                    if stamp > 0 {
                        for s in &strokes {
                            spot.height += raised * (1.0 - smoothstep(0.12, 0.28, segment(u, v, *s)));
                        }
                    }
                } else if nylon && r < flat * 0.82 && r > bore {
                    spot = Spot::body(base + top + 0.3, 3);
                }
            }
            if nut && r < bore {
                let angle = v.atan2(u) / TAU;
                if r < bore - 0.25 && stud > -10.0 {
                    // End of the stud: chamfered, a turn of thread around it.
                    let end = (bore - 0.25 - r) / 0.5;
                    let turn = ((r / pitch * 2.0 + angle) * TAU).sin();
                    let mut top = height + stud - 0.5 * (1.0 - end.min(1.0));
                    if end < 1.0 {
                        top += 0.1 * turn;
                    }
                    spot = Spot::body(base + top.max(0.3), 1);
                } else {
                    let groove = 0.15 * (angle * TAU).sin();
                    spot = Spot::body(base + (height - 1.6).max(0.0) + groove, 2);
                }
            }
            spot
        }),
    }
}

/// Distance from a point to a segment `[u0, v0, u1, v1]`.
fn segment(u: f32, v: f32, s: [f32; 4]) -> f32 {
    let (du, dv) = (s[2] - s[0], s[3] - s[1]);
    let t = (((u - s[0]) * du + (v - s[1]) * dv) / (du * du + dv * dv).max(1e-6)).clamp(0.0, 1.0);
    ((u - s[0] - t * du).powi(2) + (v - s[1] - t * dv).powi(2)).sqrt()
}

fn driven(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let main = plating(item.plating, sheet, rng);
    let foot = seat(radius, rng);
    let base = foot(0.0);
    let relief = marks(radius, rng);
    let shape = if decoy == Decoy::HexSocket && rng.random_bool(0.55) {
        // Cylinder head: flat top with a narrow bevel, steep sides, often knurled.
        HeadShape {
            profile: Profile {
                height: radius * between(rng, 0.7, 1.2),
                edge: 0.75,
                power: between(rng, 8.0, 24.0),
                bevel: 0.0,
            },
            top_radius: radius,
            washer: None,
            hex: None,
        }
    } else {
        let head = match rng.random_range(0..5) {
            0 | 1 => Head::Pan,
            2 => Head::Truss,
            3 => Head::Binding,
            _ => Head::Washer,
        };
        head_shape(head, radius, rng)
    };
    let knurl = if decoy == Decoy::HexSocket && rng.random_bool(0.5) {
        between(rng, 0.02, 0.05)
    } else {
        0.0
    };
    let span = shape.top_radius;
    let worn = item.wear.worn_slot;
    let socket = span * between(rng, 0.42, 0.6);
    let star = span * between(rng, 0.45, 0.66);
    let star_depth = between(rng, 0.1, 0.17);
    let slot_half = (span * between(rng, 0.11, 0.19)).max(0.3) * (1.0 + 0.4 * worn);
    let slot_length = span
        * if rng.random_bool(0.75) {
            1.2
        } else {
            between(rng, 0.7, 0.92)
        };
    let depth = match decoy {
        Decoy::Slotted => span * between(rng, 0.25, 0.45),
        _ => span * between(rng, 0.4, 0.75),
    }
    .min(shape.profile.height * 0.85 + 0.3);
    let pin = if decoy == Decoy::Torx && rng.random_bool(0.25) {
        star * between(rng, 0.25, 0.4)
    } else {
        0.0
    };
    let side = 7.0 - 4.0 * worn;
    let ragged = Noise::new(Grain::Cloud, 1.8, rng);
    let rim_mm = base + shape.top(0.0, 0.0).map_or(1.0, |s| s.0);
    let washer = if rng.random_bool(0.7) {
        main
    } else {
        plating(Plating::Zinc, sheet, rng)
    };
    Form {
        materials: vec![main, washer, matt(grey(0.02), 0.8)],
        rim_mm,
        reach_mm: 2.2 * radius,
        corrodes: 1.0,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            let theta = v.atan2(u);
            let swell = 1.0 + knurl * (theta * 36.0).sin().max(-0.3) * smoothstep(0.85, 0.98, r / radius);
            let Some((height, part)) = shape.top(u * swell, v * swell) else {
                return Spot::sheet(foot(r));
            };
            let mut spot = Spot::body(base + height + relief(u, v), part);
            let rough = worn * 0.5 * (ragged.at(u, v) - 0.4);
            let inside = match decoy {
                Decoy::HexSocket => hexagon(u, v) - socket - rough,
                Decoy::Torx => (r - lobes(theta, star, star_depth)) - rough,
                _ => (v.abs() - slot_half).max(u.abs() - slot_length) - rough,
            };
            if inside < 0.0 {
                let mut floor = depth;
                if decoy != Decoy::Slotted {
                    floor += 0.35 * (0.7 * socket - r).max(0.0);
                }
                let wall = (-inside * side).min(floor);
                spot.height = spot.height.min(rim_mm - wall).max(base - 2.0);
                spot.recess = wall;
                if r < pin {
                    spot.height = rim_mm - 0.15 * depth;
                }
            } else if worn > 0.02 {
                let edge = inside / 0.2;
                spot.burr = worn * (-edge * edge).exp() * smoothstep(-0.05, 0.1, rough);
                spot.height += 0.08 * spot.burr;
            }
            spot
        }),
    }
}

fn pressed(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let depth = sign * radius * between(rng, 0.06, 0.32);
    let style = rng.random_range(0..4);
    let soft = between(rng, 0.2, 0.7);
    let arm = radius * between(rng, 0.5, 0.95);
    let thick = radius * between(rng, 0.1, 0.22);
    let disc = if rng.random_bool(0.5) {
        radius * between(rng, 0.03, 0.15)
    } else {
        0.0
    };
    let gap = between(rng, 0.25, 0.7);
    let tabs = rng.random_range(1..=4) as f32;
    let tab_width = between(rng, 0.15, 0.35);
    let inner = between(rng, 0.35, 0.6);
    let (_, ground) = behind(rng);
    let wave = Noise::new(Grain::Cloud, radius, rng);
    let bent = between(rng, -0.3, 0.3);
    let phase = between(rng, 0.0, TAU);
    let bare = metal(grey(between(rng, 0.3, 0.7)), 0.5);
    let rim = Material {
        albedo: sheet.albedo.map(|v| v * 0.8),
        roughness: sheet.roughness,
        metallic: sheet.metallic,
    };
    Form {
        materials: vec![bare, ground, rim],
        rim_mm: 0.0,
        reach_mm: 2.2 * radius,
        corrodes: 0.3,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            let rho = r / radius;
            match decoy {
                Decoy::Dimple => Spot::sheet(match style {
                    // Spherical, flat-bottomed, ring, or cone.
                    0 => depth * (1.0 - rho * rho).max(0.0).powf(1.2),
                    1 => depth * (1.0 - smoothstep(1.0 - soft, 1.0, rho)),
                    2 => depth * (1.0 - smoothstep(0.0, 0.5 * soft, (rho - inner - 0.15).abs())),
                    _ => depth * (1.0 - rho).max(0.0).powf(0.8),
                }),
                Decoy::CrossEmboss => {
                    let (a, b) = (u.abs(), v.abs());
                    let arms = (b - thick).max(a - arm).min((a - thick).max(b - arm));
                    let cross = 1.0 - smoothstep(-0.6 * soft, 0.8 * soft, arms);
                    let plate = disc * (1.0 - smoothstep(0.9, 1.1, rho));
                    Spot::sheet(
                        plate
                            + 0.8 * depth.signum() * depth.abs().max(0.25) * cross
                            + 0.05 * (wave.at(u, v) - 0.5) * (1.0 - smoothstep(0.8, 1.2, rho)),
                    )
                }
                _ => {
                    // A disc half punched out: a gap around it, bridged by tabs.
                    let angle = v.atan2(u) + phase;
                    let bridge = ((angle * tabs * 0.5).sin().abs() * radius) < tab_width * 3.0;
                    let lean = depth * 0.6 + bent * u / radius;
                    let out = (r - radius).abs();
                    if out < 0.5 * gap && !bridge {
                        let cut = if style < 2 { 3.0 } else { 0.7 };
                        let part = if style < 2 { 1 } else { 2 };
                        return Spot {
                            height: -cut * (1.0 - 2.0 * out / gap),
                            part: Some(part),
                            ..SHEET
                        };
                    }
                    let mut height = lean * (1.0 - smoothstep(radius - 0.4, radius + 0.2, r));
                    if style % 2 == 0 {
                        let ring = (r - inner * radius).abs();
                        height -= 0.35 * (1.0 - smoothstep(0.1, 0.35, ring));
                    }
                    Spot::sheet(height)
                }
            }
        }),
    }
}

fn flat_spot(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    // Its look is all wear: the shape only lifts the sheet where it blisters.
    let blister = between(rng, 0.0, 0.25);
    let noise = Noise::new(Grain::Cloud, radius, rng);
    Form {
        materials: vec![matt(sheet.albedo, sheet.roughness)],
        rim_mm: 0.0,
        reach_mm: 1.3 * radius,
        corrodes: 1.0,
        surface: Box::new(move |u, v| {
            let rho = (u * u + v * v).sqrt() / radius;
            let inside = 1.0 - smoothstep(0.6, 1.2, rho + 0.5 * (noise.at(u, v) - 0.5));
            Spot::sheet(blister * inside * noise.at(v, u))
        }),
    }
}

fn printed(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let bright = sheet.albedo[1] > 0.25;
    let ink = match rng.random_range(0..8) {
        0 => [0.5, 0.04, 0.03],
        1 => [0.03, 0.08, 0.35],
        2 | 3 => grey(between(rng, 0.12, 0.35)),
        _ if bright => grey(between(rng, 0.01, 0.06)),
        _ => grey(between(rng, 0.4, 0.8)),
    };
    let label = rng.random_bool(0.45);
    let paper = grey(between(rng, 0.6, 0.85));
    let ink = if label && ink[1] > 0.4 { grey(0.03) } else { ink };
    let style = rng.random_range(0..12);
    let line = radius * between(rng, 0.05, 0.14);
    let arm = radius * between(rng, 0.45, 0.8);
    let thick = radius * between(rng, 0.05, 0.16);
    let fill = if rng.random_bool(0.4) {
        let level = between(rng, 0.15, 0.6);
        Some(grey(level))
    } else {
        None
    };
    let worn = Noise::new(Grain::Cloud, 1.5, rng);
    let loss = if rng.random_bool(0.4) {
        between(rng, 0.0, 0.35)
    } else {
        0.0
    };
    let half = [radius * between(rng, 1.15, 1.9), radius * between(rng, 1.15, 1.9)];
    let letter: Vec<[f32; 4]> = GLYPHS[rng.random_range(0..GLYPHS.len())]
        .iter()
        .map(|s| s.map(|v| v * 0.7 * radius))
        .collect();
    Form {
        materials: vec![matt(ink, 0.5), matt(paper, 0.45), matt(fill.unwrap_or(paper), 0.5)],
        rim_mm: 0.0,
        reach_mm: 2.0 * radius,
        corrodes: 0.15,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            let (a, b) = (u.abs(), v.abs());
            let circle = (r - radius + line).abs() - line;
            let plus = (b - thick).max(a - arm).min((a - thick).max(b - arm));
            let glyph = || letter.iter().map(|s| segment(u, v, *s)).fold(9.0, f32::min) - thick;
            let drawn = match style {
                0..=2 => circle.min(plus),
                3 => circle,
                4 => r - radius,
                5 => circle.min((r - 0.35 * radius).max(0.0)),
                6 => {
                    // Ground symbol in its circle.
                    let stem = (a - thick).max((v + 0.3 * radius).abs() - 0.32 * radius);
                    let bar = |at: f32, w: f32| (a - w * radius).max((v - at * radius).abs() - 0.7 * thick);
                    circle
                        .min(stem)
                        .min(bar(0.05, 0.5))
                        .min(bar(0.28, 0.33))
                        .min(bar(0.5, 0.16))
                }
                7 => {
                    // Turning arrow.
                    let theta = v.atan2(u);
                    let arc = if theta > -2.2 {
                        (r - 0.75 * radius).abs() - line
                    } else {
                        9.0
                    };
                    let tip = segment(u, v, [-0.45 * radius, -0.6 * radius, -0.75 * radius, -0.25 * radius]) - line;
                    arc.min(tip)
                }
                8 => plus,
                9 => circle.min((r - 0.55 * radius).abs() - line),
                10 => circle.min(glyph()),
                _ => glyph(),
            };
            let gone = worn.at(u, v) < loss;
            let part = if drawn < 0.0 && !gone {
                Some(0)
            } else if style < 7 && fill.is_some() && r < radius - line {
                Some(2)
            } else if label && a < half[0] && b < half[1] {
                Some(1)
            } else {
                None
            };
            Spot {
                height: if part.is_some() { 0.02 } else { 0.0 },
                part,
                ..SHEET
            }
        }),
    }
}

/// Letters and signs as strokes in a box of -1 to 1.
const GLYPHS: [&[[f32; 4]]; 8] = [
    &[[-0.6, 1.0, 0.0, -1.0], [0.0, -1.0, 0.6, 1.0], [-0.35, 0.3, 0.35, 0.3]],
    &[
        [-0.5, -1.0, -0.5, 1.0],
        [-0.5, -1.0, 0.6, -1.0],
        [-0.5, 0.0, 0.4, 0.0],
        [-0.5, 1.0, 0.6, 1.0],
    ],
    &[[-0.5, -1.0, -0.5, 1.0], [0.5, -1.0, 0.5, 1.0], [-0.5, 0.0, 0.5, 0.0]],
    &[[-0.6, -1.0, 0.6, 1.0], [0.6, -1.0, -0.6, 1.0]],
    &[[-0.6, -1.0, 0.6, -1.0], [0.0, -1.0, 0.0, 1.0]],
    &[[0.0, -1.0, 0.0, 1.0], [0.0, -1.0, -0.5, -0.4], [0.0, -1.0, 0.5, -0.4]],
    &[[-0.5, -1.0, -0.5, 1.0], [-0.5, 1.0, 0.5, 1.0]],
    &[[-0.5, 1.0, -0.5, -1.0], [-0.5, -1.0, 0.5, 1.0], [0.5, 1.0, 0.5, -1.0]],
];

fn cap(item: &Item, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let colour = match rng.random_range(0..8) {
        0..=2 => grey(between(rng, 0.55, 0.85)),
        3 => [0.7, 0.65, 0.52],
        4 | 5 => grey(between(rng, 0.01, 0.05)),
        6 => grey(between(rng, 0.12, 0.4)),
        _ => [
            between(rng, 0.05, 0.5),
            between(rng, 0.05, 0.4),
            between(rng, 0.05, 0.5),
        ],
    };
    let material = matt(colour, between(rng, 0.25, 0.6));
    let profile = Profile {
        height: radius * between(rng, 0.15, 0.6),
        edge: between(rng, 0.1, 0.6),
        power: between(rng, 1.8, 8.0),
        bevel: 0.0,
    };
    let style = rng.random_range(0..6);
    let inner = radius * between(rng, 0.35, 0.75);
    let groove = between(rng, 0.1, 0.5);
    let gate = (between(rng, -0.2, 0.2), between(rng, -0.2, 0.2));
    let foot = seat(radius, rng);
    let base = foot(0.0);
    Form {
        materials: vec![material],
        rim_mm: base + profile.height,
        reach_mm: 2.2 * radius,
        corrodes: 0.08,
        surface: Box::new(move |u, v| {
            let r = (u * u + v * v).sqrt();
            if r >= radius {
                return Spot::sheet(foot(r));
            }
            let mut top = profile.at(r / radius);
            match style {
                0 => top -= groove * (1.0 - smoothstep(0.15, 0.4, (r - inner).abs())),
                1 => top -= groove * (1.0 - smoothstep(inner - 0.3, inner, r)),
                2 => {
                    // A moulded screwdriver slot for prying.
                    let slot = (v.abs() - 0.4).max(u.abs() - inner);
                    top -= groove * (1.0 - smoothstep(-0.15, 0.15, slot));
                }
                3 => {
                    let dot = ((u - gate.0).powi(2) + (v - gate.1).powi(2)).sqrt();
                    top += 0.15 * (1.0 - smoothstep(0.3, 0.5, dot));
                }
                _ => {}
            }
            Spot::body(base + top.max(0.05), 0)
        }),
    }
}

fn weld(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let spot_weld = rng.random_bool(0.6);
    let depth = radius * between(rng, 0.03, 0.12);
    let ring = radius * between(rng, 0.02, 0.1);
    let lumps = Noise::new(Grain::Cloud, 0.8 * radius, rng);
    let height = radius * between(rng, 0.25, 0.5);
    let burnt = if sheet.metallic > 0.5 || rng.random_bool(0.6) {
        metal(
            scaled([0.4, 0.38, 0.37], between(rng, 0.5, 1.5)),
            between(rng, 0.3, 0.6),
        )
    } else {
        matt(scaled(sheet.albedo, between(rng, 0.5, 0.9)), 0.6)
    };
    let blue = metal([0.3, 0.28, 0.33], 0.5);
    let ripple = between(rng, 0.0, 0.12);
    Form {
        materials: vec![burnt, blue],
        rim_mm: 0.0,
        reach_mm: 1.6 * radius,
        corrodes: 0.9,
        surface: Box::new(move |u, v| {
            let wobble = 0.25 * (lumps.at(u, v) - 0.5);
            let rho = (u * u + v * v).sqrt() / radius + if spot_weld { 0.3 * wobble } else { 2.0 * wobble };
            if rho > 1.25 {
                return SHEET;
            }
            let bulk = if spot_weld {
                let edge = (rho - 0.8) / 0.12;
                -depth * (1.0 - smoothstep(0.65, 0.82, rho)) + ring * (-edge * edge).exp()
            } else {
                height * (1.0 - rho * rho).max(0.0).sqrt()
                    + ripple * (u * 6.0).sin() * (1.0 - smoothstep(0.7, 1.0, rho))
                    + 0.25 * (lumps.at(2.0 * u, 2.0 * v) - 0.5) * (1.0 - smoothstep(0.8, 1.1, rho))
            };
            let part = if rho < 0.85 + 0.3 * wobble {
                Some(0)
            } else if rho < 1.02 + wobble {
                Some(1)
            } else {
                None
            };
            Spot {
                height: bulk,
                part,
                ..SHEET
            }
        }),
    }
}

fn blob(item: &Item, rng: &mut Pcg64Mcg) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let material = match rng.random_range(0..6) {
        0 | 1 => {
            let level = between(rng, 0.03, 0.16);
            matt([level, level * 0.82, level * 0.65], between(rng, 0.6, 0.95))
        }
        2 => matt(grey(between(rng, 0.01, 0.05)), between(rng, 0.25, 0.7)),
        3 => matt(grey(between(rng, 0.4, 0.75)), between(rng, 0.25, 0.5)),
        4 => matt([0.5, 0.42, 0.28], between(rng, 0.3, 0.7)),
        _ => matt([0.28, 0.25, 0.21], 0.9),
    };
    let outline = Noise::new(Grain::Cloud, 1.6 * radius, rng);
    let bumps = Noise::new(Grain::Cloud, 0.7 * radius, rng);
    let height = radius * between(rng, 0.15, 0.55);
    let ragged = between(rng, 0.2, 1.1);
    let rough = between(rng, 0.1, 0.9);
    Form {
        materials: vec![material],
        rim_mm: height,
        reach_mm: 1.8 * radius,
        corrodes: 0.1,
        surface: Box::new(move |u, v| {
            let rho = (u * u + v * v).sqrt() / radius + ragged * (outline.at(u, v) - 0.5);
            if rho >= 1.0 {
                return SHEET;
            }
            let body = (1.0 - rho * rho).max(0.0).powf(0.6) * height;
            Spot {
                part: Some(0),
                solid: false,
                height: body * (1.0 + rough * (bumps.at(u, v) - 0.5)) + 0.03,
                ..SHEET
            }
        }),
    }
}
