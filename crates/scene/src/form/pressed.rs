//! What is in the sheet itself: holes, dimples, embossed crosses, rust.

use super::{Form, SHEET, Spot, between, grey, matt, metal, scaled, seat};
use crate::bake::SheetFinish;
use crate::fastener::{Decoy, Item};
use crate::noise::{Grain, Noise, smoothstep};
use crate::relief::Material;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f32::consts::TAU;

/// The dark or metallic ground behind a hole.
pub(super) fn behind(rng: &mut Pcg64Mcg) -> (f32, Material) {
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

pub(super) fn hole(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn empty_hole(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn pressed(item: &Item, decoy: Decoy, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn flat_spot(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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
