//! Rivets, welds and lumps.

use super::head::{Profile, marks};
use super::{Form, SHEET, Spot, between, grey, matt, metal, plating, scaled, seat};
use crate::bake::SheetFinish;
use crate::fastener::{Item, Plating};
use crate::noise::{Grain, Noise, smoothstep};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

pub(super) fn rivet(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn weld(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn blob(item: &Item, rng: &mut Pcg64Mcg) -> Form {
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
