//! Fasteners that another bit drives.

use super::head::{HeadShape, Profile, head_shape, hex_top, hexagon, marks};
use super::{Form, Spot, between, grey, matt, plating, seat, segment, washer_plating};
use crate::bake::SheetFinish;
use crate::fastener::{Decoy, Head, Item, Plating};
use crate::noise::{Grain, Noise, smoothstep};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f32::consts::TAU;

/// Half-width of a hexalobular outline over the angle.
pub(super) fn lobes(theta: f32, radius: f32, depth: f32) -> f32 {
    radius * (1.0 - depth + depth * (6.0 * theta).cos())
}

pub(super) fn hexagonal(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn driven(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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
    let washer = washer_plating(main, sheet, rng);
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
