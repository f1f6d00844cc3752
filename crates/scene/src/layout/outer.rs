//! The faces of a closed unit: front, sides, top.

use super::draft::Draft;
use super::sheet::{body, handle, loose_ends, louvres, ribs};
use super::style::Style;
use super::{Rng, bounds, strip, varied};
use crate::layer::{Bump, Layer};
use crate::paint::{Coat, Paint};
use crate::print::Print;
use crate::product::{FaceDesign, FaceId};
use crate::shape::{Bounds, Shape};
use rand::RngExt;

pub(super) fn front(style: &Style, w: f64, h: f64, depth: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
    let mut draft = Draft::new(style, w, h);
    let (base, y_low, y_high) = body(&mut draft, depth as f32, rng);
    let [hw, _] = draft.half;
    let room_y = y_high - y_low;
    let mid_y = 0.5 * (y_low + y_high);
    let radius = (0.46 * room_y).min(0.62 * hw) * rng.random_range(0.82..0.98);
    let side = if rng.random_bool(0.8) { -1.0 } else { 1.0 };
    let center = [
        side * (hw - radius - rng.random_range(28.0..60.0)),
        mid_y + rng.random_range(-8.0..8.0),
    ];
    // opening with a pressed ring around it
    draft.bump(
        base,
        Bump::Plateau {
            shape: Shape::Disc {
                center,
                radius: radius + rng.random_range(6.0..14.0),
            },
            height: rng.random_range(-6.0..5.0),
            soft: rng.random_range(4.0..9.0),
        },
    );
    draft.work.layers[base].cut(Shape::Disc { center, radius }, rng.random_range(20.0..60.0));
    draft.taken.push((center, radius + 12.0));
    let dark = varied([0.05, 0.05, 0.052], 0.4, rng);
    let shroud = Paint::new(Coat::Plastic, dark, 0.8, rng).worn(style.dirt, style.mud, 0.0, rng);
    draft.add(Layer::new(
        Shape::Disc {
            center,
            radius: radius + 40.0,
        },
        -rng.random_range(110.0..190.0f32),
        0.0,
        0.0,
        shroud,
    ));
    let blade_color = if rng.random_bool(0.4) {
        [0.35; 3]
    } else {
        [0.07, 0.07, 0.075]
    };
    let blades = style.plastic(varied(blade_color, 0.3, rng), rng);
    let fan_top = -rng.random_range(45.0..75.0f32);
    draft.add(Layer::new(
        Shape::Spokes {
            center,
            count: rng.random_range(3..=5),
            phase: rng.random_range(0.0..std::f32::consts::TAU),
            inner: 0.1 * radius,
            outer: 0.93 * radius,
            half_width: 0.2 * radius,
            sweep: rng.random_range(-0.9..0.9) / radius,
        },
        fan_top,
        8.0,
        2.0,
        blades.clone(),
    ));
    draft.add(Layer::new(
        Shape::Disc {
            center,
            radius: 0.2 * radius,
        },
        fan_top + 12.0,
        30.0,
        4.0,
        blades,
    ));
    // guard
    let guard = if rng.random_bool(0.6) {
        style.plastic(
            varied(if rng.random_bool(0.5) { style.panel } else { [0.08; 3] }, 0.05, rng),
            rng,
        )
    } else {
        style.trim(rng)
    };
    let wire = rng.random_range(0.9..2.2f32);
    let lift = rng.random_range(1.0..14.0f32);
    match rng.random_range(0..3) {
        0 => {
            let pitch = rng.random_range(9.0..18.0f32);
            let first = rng.random_range(0.16..0.3) * radius;
            let count = ((radius + 4.0 - first) / pitch) as u32 + 1;
            draft.add(Layer::new(
                Shape::Rings {
                    center,
                    first,
                    pitch,
                    count,
                    half_width: wire,
                },
                lift,
                1.6 * wire,
                wire,
                guard.clone(),
            ));
            draft.add(Layer::new(
                Shape::Spokes {
                    center,
                    count: rng.random_range(4..=12),
                    phase: rng.random_range(0.0..std::f32::consts::TAU),
                    inner: 0.8 * first,
                    outer: radius + 6.0,
                    half_width: 1.3 * wire,
                    sweep: 0.0,
                },
                lift - wire,
                2.0 * wire,
                1.2 * wire,
                guard.clone(),
            ));
            draft.add(Layer::new(
                Shape::Disc { center, radius: first },
                lift + 0.4,
                3.0,
                2.0,
                guard,
            ));
        }
        1 => {
            draft.add(Layer::new(
                Shape::Spokes {
                    center,
                    count: rng.random_range(28..=64),
                    phase: 0.0,
                    inner: 0.22 * radius,
                    outer: radius + 5.0,
                    half_width: wire,
                    sweep: rng.random_range(-0.7..0.7) / radius,
                },
                lift,
                4.0,
                0.8 * wire,
                guard.clone(),
            ));
            let count = rng.random_range(2..=4);
            draft.add(Layer::new(
                Shape::Rings {
                    center,
                    first: 0.35 * radius,
                    pitch: 0.64 * radius / (count - 1).max(1) as f32,
                    count,
                    half_width: 1.5 * wire,
                },
                lift + 0.3,
                4.0,
                wire,
                guard.clone(),
            ));
            let cap = 0.24 * radius;
            draft.add(Layer::new(
                Shape::Disc { center, radius: cap },
                lift + 0.6,
                4.0,
                3.0,
                guard,
            ));
        }
        _ => {
            let pitch = rng.random_range(12.0..26.0);
            draft.add(Layer::new(
                Shape::Mesh {
                    center,
                    half: [radius + 3.0; 2],
                    pitch: [pitch, pitch * rng.random_range(0.8..1.6)],
                    half_width: wire,
                },
                lift,
                2.0 * wire,
                wire,
                guard,
            ));
        }
    }
    // beside the fan: a panel with its own life
    let (free_low, free_high) = if side < 0.0 {
        (center[0] + radius + 22.0, hw - 32.0)
    } else {
        (-hw + 32.0, center[0] - radius - 22.0)
    };
    let beside = bounds([free_low, y_low + 6.0], [free_high, y_high - 6.0]);
    if free_high - free_low > 60.0 {
        let seam_x = if side < 0.0 { free_low } else { free_high };
        if rng.random_bool(0.7) {
            draft.bump(
                base,
                Bump::Plateau {
                    shape: strip([seam_x - 0.8, y_low], [seam_x + 0.8, y_high]),
                    height: -1.5,
                    soft: 1.0,
                },
            );
        }
        if rng.random_bool(0.4) {
            louvres(&mut draft, base, beside, rng);
        } else {
            ribs(&mut draft, base, beside, rng);
        }
        draft.label(base, beside, Print::plate(&style.model, rng), rng);
        if rng.random_bool(0.7) {
            draft.label(base, beside, Print::brand(rng), rng);
        }
        if rng.random_bool(0.5) {
            draft.label(base, beside, Print::warning(rng), rng);
        }
        if rng.random_bool(0.5) {
            draft.label(base, beside, Print::sticker(rng), rng);
        }
        draft.panel(base, beside);
    }
    let everywhere = bounds([-hw + 12.0, y_low], [hw - 12.0, y_high]);
    draft.panel(base, everywhere);
    draft.life(base, everywhere, rng);
    draft.put_screws(rng.random_range(4..=7), rng);
    draft.put_decoys(rng.random_range(5..=16), rng);
    loose_ends(&mut draft, 0.35, rng);
    draft.finish(FaceId::Front, w, h, next, rng)
}

pub(super) fn side(style: &Style, id: FaceId, d: f64, h: f64, width: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
    let mut draft = Draft::new(style, d, h);
    let (base, y_low, y_high) = body(&mut draft, width as f32, rng);
    let [hw, _] = draft.half;
    let inner = bounds([-hw + 34.0, y_low + 8.0], [hw - 34.0, y_high - 8.0]);
    let (iw, ih) = (inner.high[0] - inner.low[0], inner.high[1] - inner.low[1]);
    let mut free = inner;
    if id == FaceId::Left && rng.random_bool(0.5) && iw > 80.0 {
        // the heat exchanger behind its guard
        let half = [
            0.5 * iw * rng.random_range(0.6..0.95),
            0.5 * ih * rng.random_range(0.5..0.85),
        ];
        let center = [0.5 * (inner.low[0] + inner.high[0]), inner.low[1] + half[1] + 4.0];
        draft.work.layers[base].cut(Shape::rect(center, half, 4.0), 10.0);
        let fins =
            Paint::new(Coat::Zinc, [0.4, 0.42, 0.44], 0.55, rng).worn(style.dirt, style.mud, 0.2 * style.rust, rng);
        let shape = Shape::rect(center, [half[0] + 8.0, half[1] + 8.0], 0.0);
        let mut layer = Layer::new(shape.clone(), -12.0, 0.0, 0.0, fins);
        layer.bumps.push(Bump::Wave {
            shape,
            along: [1.0, 0.0],
            wavelength: rng.random_range(2.2..3.2),
            amplitude: 0.6,
        });
        draft.add(layer);
        if rng.random_bool(0.7) {
            let guard = if rng.random_bool(0.5) {
                style.zinc(rng)
            } else {
                style.plastic([0.07; 3], rng)
            };
            let pitch = rng.random_range(14.0..34.0);
            let wire = rng.random_range(0.8..1.6);
            draft.add(Layer::new(
                Shape::Mesh {
                    center,
                    half: [half[0] + 1.0, half[1] + 1.0],
                    pitch: [pitch * rng.random_range(0.7..2.5), pitch],
                    half_width: wire,
                },
                -rng.random_range(0.5..5.0f32),
                2.0 * wire,
                wire,
                guard,
            ));
        }
        draft.labels.push(Bounds::around(center, half));
        free = bounds([inner.low[0], center[1] + half[1] + 4.0], inner.high);
    } else if id == FaceId::Right && rng.random_bool(0.75) && iw > 90.0 {
        // valve cover: a box standing out, with its own flange
        let half = [
            0.5 * iw * rng.random_range(0.5..0.8),
            0.5 * ih * rng.random_range(0.25..0.45),
        ];
        let center = [
            0.5 * (inner.low[0] + inner.high[0]) + rng.random_range(-0.08..0.08) * iw,
            inner.high[1] - half[1] - rng.random_range(4.0..0.3 * ih),
        ];
        let flange = style.trim(rng);
        let wide = rng.random_range(14.0..20.0);
        let plate = draft.add(Layer::new(
            Shape::rect(center, [half[0] + wide, half[1] + wide], 4.0),
            1.2,
            2.0,
            0.6,
            flange,
        ));
        draft.seam(plate, Bounds::around(center, [half[0] + wide, half[1] + wide]));
        let paint = style.trim(rng);
        let rise = rng.random_range(18.0..45.0f32);
        let cover = draft.add(Layer::new(
            Shape::rect(center, half, rng.random_range(3.0..10.0)),
            rise,
            rise,
            rng.random_range(2.0..7.0),
            paint,
        ));
        draft.panel(cover, Bounds::around(center, half));
        let on = Bounds::around(center, half);
        if rng.random_bool(0.6) {
            draft.label(cover, on, Print::warning(rng), rng);
        }
        if rng.random_bool(0.35) {
            handle(&mut draft, cover, [center[0], center[1] - 0.5 * half[1]], rng);
        }
        free = bounds(inner.low, [inner.high[0], center[1] - half[1] - wide - 3.0]);
        // pipes below it
        for k in 0..rng.random_range(0..3) {
            let x = center[0] + (k as f32 - 0.5) * rng.random_range(24.0..40.0);
            let copper = Paint::new(Coat::Zinc, [0.6, 0.32, 0.17], 0.4, rng).worn(style.dirt, style.mud, 0.0, rng);
            let radius = rng.random_range(4.0..8.0);
            let paint = if rng.random_bool(0.5) {
                copper
            } else {
                style.plastic([0.7; 3], rng)
            };
            let low = center[1] + half[1];
            draft.tube(
                [x, low - 5.0, 12.0],
                [x + 30.0, draft.half[1] + 60.0, 25.0],
                0.0,
                radius,
                paint,
                rng,
            );
        }
    }
    let (fw, fh) = (free.high[0] - free.low[0], free.high[1] - free.low[1]);
    if fw > 40.0 && fh > 40.0 {
        match rng.random_range(0..4) {
            0 => louvres(&mut draft, base, free, rng),
            1 | 2 => ribs(&mut draft, base, free, rng),
            _ => {}
        }
        if fw > 130.0 && fh > 70.0 && rng.random_bool(0.5) {
            let at = [0.5 * (free.low[0] + free.high[0]), free.low[1] + 34.0];
            if draft.work.layers[base].solid_distance(at) < -70.0 {
                handle(&mut draft, base, at, rng);
            }
        }
        if rng.random_bool(0.6) {
            draft.label(base, free, Print::plate(&style.model, rng), rng);
        }
        if rng.random_bool(0.5) {
            draft.label(base, free, Print::sticker(rng), rng);
        }
        draft.panel(base, free);
    }
    draft.panel(base, bounds([-hw + 10.0, y_low], [hw - 10.0, y_high]));
    draft.life(base, bounds([-hw + 10.0, y_low], [hw - 10.0, y_high]), rng);
    draft.put_screws(rng.random_range(3..=5), rng);
    draft.put_decoys(rng.random_range(5..=12), rng);
    loose_ends(&mut draft, 0.25, rng);
    draft.finish(id, d, h, next, rng)
}

pub(super) fn top(style: &Style, w: f64, d: f64, height: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
    let mut draft = Draft::new(style, w, d);
    let [hw, hd] = draft.half;
    let edge = rng.random_range(3.0..8.0);
    let paint = style.trim(rng);
    let base = draft.add(Layer::new(
        Shape::rect([0.0, 0.0], [hw, hd], rng.random_range(6.0..24.0)),
        0.0,
        height as f32,
        edge,
        paint,
    ));
    draft.buckle(base, rng);
    let rim = rng.random_range(24.0..40.0f32);
    let inner = bounds([-hw + rim, -hd + rim], [hw - rim, hd - rim]);
    draft.bump(
        base,
        Bump::Plateau {
            shape: strip(inner.low, inner.high),
            height: rng.random_range(-4.0..6.0),
            soft: rng.random_range(4.0..9.0),
        },
    );
    ribs(&mut draft, base, inner, rng);
    if rng.random_bool(0.4) {
        draft.label(base, inner, Print::warning(rng), rng);
    }
    if rng.random_bool(0.4) {
        draft.label(base, inner, Print::sticker(rng), rng);
    }
    let m = rim - 5.0;
    draft.seam(base, bounds([-hw + 4.0, -hd + 2.0], [hw - 4.0, -hd + m]));
    draft.seam(base, bounds([-hw + 4.0, hd - m], [hw - 4.0, hd - 2.0]));
    draft.seam(base, bounds([-hw + 2.0, -hd + 4.0], [-hw + m, hd - 4.0]));
    draft.seam(base, bounds([hw - m, -hd + 4.0], [hw - 2.0, hd - 4.0]));
    draft.panel(base, inner);
    draft.life(base, bounds([-hw + 10.0, -hd + 10.0], [hw - 10.0, hd - 10.0]), rng);
    draft.put_screws(rng.random_range(3..=5), rng);
    draft.put_decoys(rng.random_range(5..=11), rng);
    loose_ends(&mut draft, 0.3, rng);
    draft.finish(FaceId::Top, w, d, next, rng)
}
