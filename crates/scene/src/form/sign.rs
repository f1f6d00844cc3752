//! What is printed or moulded to be read: marks on the sheet and caps.

use super::head::Profile;
use super::{Form, SHEET, Spot, between, grey, matt, seat, segment};
use crate::bake::SheetFinish;
use crate::fastener::Item;
use crate::noise::{Grain, Noise, smoothstep};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

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

pub(super) fn printed(item: &Item, sheet: &SheetFinish, rng: &mut Pcg64Mcg) -> Form {
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

pub(super) fn cap(item: &Item, rng: &mut Pcg64Mcg) -> Form {
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
