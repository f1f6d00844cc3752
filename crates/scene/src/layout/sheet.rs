//! What sheets of several faces have in common: body and skirts, ribs, louvres, handles, cables.

use super::draft::Draft;
use super::{Rng, bounds, pick, strip};
use crate::layer::{Bump, Layer, Tube};
use crate::paint::{Coat, Paint};
use crate::shape::{Bounds, Shape, Xy};
use rand::RngExt;

/// The body and the skirts that overlap it: top cover's above, base pan's below. Returns body, and what is left free in y.
pub(super) fn body(draft: &mut Draft, depth_mm: f32, rng: &mut Rng) -> (usize, f32, f32) {
    let [w, h] = draft.half;
    let edge = rng.random_range(2.0..6.0);
    let panel = draft.style.paint(rng);
    let base = draft.add(Layer::new(
        Shape::rect([0.0, 0.0], [w, h], rng.random_range(3.0..14.0)),
        0.0,
        depth_mm,
        edge,
        panel,
    ));
    draft.buckle(base, rng);
    let top_skirt = rng.random_range(18.0..36.0f32);
    let paint = draft.style.trim(rng);
    let step = rng.random_range(0.9..2.2);
    let top = draft.add(Layer::new(
        strip([-w, -h], [w, -h + top_skirt]),
        step,
        step + 30.0,
        rng.random_range(0.6..2.0),
        paint,
    ));
    draft.seam(top, bounds([-w + 6.0, -h], [w - 6.0, -h + top_skirt]));
    let bottom_skirt = rng.random_range(16.0..34.0f32);
    let paint = if rng.random_bool(0.5) {
        draft.style.zinc(rng)
    } else {
        draft.style.trim(rng)
    };
    let rises = rng.random_bool(0.6);
    let level = if rises {
        rng.random_range(0.8..1.8)
    } else {
        -rng.random_range(1.0..4.0)
    };
    let bottom = if rises {
        let l = draft.add(Layer::new(
            strip([-w, h - bottom_skirt], [w, h]),
            level,
            40.0,
            0.8,
            paint,
        ));
        draft.seam(l, bounds([-w + 6.0, h - bottom_skirt], [w - 6.0, h]));
        l
    } else {
        // a groove instead: the panel's own lower flange
        draft.bump(
            base,
            Bump::Plateau {
                shape: strip([-w - 5.0, h - bottom_skirt - 1.2], [w + 5.0, h - bottom_skirt + 1.2]),
                height: -1.2,
                soft: 1.2,
            },
        );
        draft.seam(base, bounds([-w + 8.0, h - bottom_skirt + 2.0], [w - 8.0, h - 3.0]));
        base
    };
    let _ = bottom;
    for sign in [-1.0f32, 1.0] {
        if rng.random_bool(0.5) {
            let width = rng.random_range(16.0..30.0f32);
            let (a, b) = (sign * w, sign * (w - width));
            let (low, high) = (a.min(b), a.max(b));
            if rng.random_bool(0.5) {
                let paint = draft.style.trim(rng);
                let column = draft.add(Layer::new(
                    strip([low, -h + top_skirt], [high, h - bottom_skirt]),
                    rng.random_range(0.6..1.6),
                    20.0,
                    0.8,
                    paint,
                ));
                draft.seam(column, bounds([low, -h + top_skirt], [high, h - bottom_skirt]));
            } else {
                let line = sign * (w - width);
                draft.bump(
                    base,
                    Bump::Plateau {
                        shape: strip([line - 0.9, -h], [line + 0.9, h]),
                        height: -1.0,
                        soft: 1.0,
                    },
                );
                draft.seam(
                    base,
                    bounds([low + 2.0, -h + top_skirt + 2.0], [high - 2.0, h - bottom_skirt - 2.0]),
                );
            }
        }
    }
    (base, -h + top_skirt, h - bottom_skirt)
}

pub(super) fn ribs(draft: &mut Draft, layer: usize, within: Bounds, rng: &mut Rng) {
    let count = rng.random_range(0..4);
    let vertical = rng.random_bool(0.5);
    let height = rng.random_range(0.8..3.0) * if rng.random_bool(0.75) { 1.0 } else { -1.0 };
    let soft = rng.random_range(2.0..5.0);
    let half = rng.random_range(3.0..9.0f32);
    for k in 0..count {
        let t = (k as f32 + 0.5) / count as f32;
        let at = |i: usize| within.low[i] + t * (within.high[i] - within.low[i]);
        let mid = |i: usize| 0.5 * (within.low[i] + within.high[i]);
        let long = |i: usize| 0.36 * (within.high[i] - within.low[i]);
        let shape = if vertical {
            Shape::rect([at(0), mid(1)], [half, long(1).max(half)], half)
        } else {
            Shape::rect([mid(0), at(1)], [long(0).max(half), half], half)
        };
        draft.bump(layer, Bump::Plateau { shape, height, soft });
    }
    if rng.random_bool(0.3) {
        // a pressed frame
        let center = [
            0.5 * (within.low[0] + within.high[0]),
            0.5 * (within.low[1] + within.high[1]),
        ];
        let half = [
            0.42 * (within.high[0] - within.low[0]),
            0.42 * (within.high[1] - within.low[1]),
        ];
        draft.bump(
            layer,
            Bump::Plateau {
                shape: Shape::rect(center, half, 14.0),
                height: rng.random_range(-2.5..2.5),
                soft: rng.random_range(3.0..7.0),
            },
        );
    }
}

pub(super) fn louvres(draft: &mut Draft, layer: usize, within: Bounds, rng: &mut Rng) {
    let (w, h) = (within.high[0] - within.low[0], within.high[1] - within.low[1]);
    if w < 60.0 || h < 40.0 {
        return;
    }
    let pitch = rng.random_range(9.0..20.0f32);
    let rows = ((rng.random_range(0.3..0.9) * h / pitch) as u32).clamp(2, 14);
    let half_w = rng.random_range(0.2..0.46) * w;
    let half_h = 0.5 * rows as f32 * pitch;
    let free = |low: f32, high: f32, half: f32, rng: &mut Rng| {
        if high - low > 2.0 * half + 6.0 {
            rng.random_range(low + half + 3.0..high - half - 3.0)
        } else {
            0.5 * (low + high)
        }
    };
    let center = [
        free(within.low[0], within.high[0], half_w, rng),
        free(within.low[1], within.high[1], half_h, rng),
    ];
    if rng.random_bool(0.6) {
        draft.bump(
            layer,
            Bump::Hood {
                center,
                half: [half_w, half_h],
                pitch,
                height: rng.random_range(2.5..5.5),
            },
        );
        let slots = Shape::Field {
            center: [center[0], center[1] + 0.42 * pitch],
            pitch: [1.0, pitch],
            count: [1, rows],
            half: [half_w - 0.3 * pitch, 0.07 * pitch],
            round: 0.05 * pitch,
        };
        draft.work.layers[layer].cut(slots, 2.0);
    } else {
        let slots = Shape::Field {
            center,
            pitch: [1.0, pitch],
            count: [1, rows],
            half: [half_w, (0.2 * pitch).min(3.0)],
            round: (0.2 * pitch).min(3.0),
        };
        draft.work.layers[layer].cut(slots, 1.2);
    }
    let area = Bounds::around(center, [half_w + 2.0, half_h + 2.0]);
    draft.labels.push(area);
    dark_behind(draft, area, 35.0, rng);
}

/// A dark floor behind openings of the body.
pub(super) fn dark_behind(draft: &mut Draft, area: Bounds, depth_mm: f32, rng: &mut Rng) {
    let paint = Paint::new(Coat::Plastic, [0.03, 0.03, 0.032], 0.9, rng);
    let grown = area.grown(depth_mm);
    draft.add(Layer::new(strip(grown.low, grown.high), -depth_mm, 0.0, 0.0, paint));
}

/// A recessed handle.
pub(super) fn handle(draft: &mut Draft, layer: usize, center: Xy, rng: &mut Rng) {
    let half = [rng.random_range(35.0..60.0f32), rng.random_range(12.0..20.0f32)];
    let depth = rng.random_range(14.0..28.0f32);
    let round = rng.random_range(4.0..half[1]);
    draft.work.layers[layer].cut(Shape::rect(center, half, round), depth);
    draft.bump(
        layer,
        Bump::Plateau {
            shape: Shape::rect(center, [half[0] + 4.0, half[1] + 4.0], round + 3.0),
            height: rng.random_range(0.6..1.6),
            soft: 2.5,
        },
    );
    let paint = if rng.random_bool(0.5) {
        draft.style.paint(rng)
    } else {
        draft.style.plastic([0.06; 3], rng)
    };
    draft.add(Layer::new(
        Shape::rect(center, [half[0] + 2.0, half[1] + 2.0], round),
        -depth,
        0.0,
        0.0,
        paint,
    ));
    draft.taken.push((center, half[0] + 6.0));
}

/// Cables, cords and threads that hang over a face; now and then over a screw.
pub(super) fn loose_ends(draft: &mut Draft, chance: f64, rng: &mut Rng) {
    let [w, h] = draft.half;
    if rng.random_bool(chance) {
        for _ in 0..rng.random_range(1..=2) {
            let color = pick(
                rng,
                &[
                    [0.03; 3],
                    [0.75, 0.75, 0.72],
                    [0.5, 0.04, 0.04],
                    [0.04, 0.12, 0.45],
                    [0.3; 3],
                ],
            );
            let paint = draft.style.plastic(color, rng);
            let x = rng.random_range(-w..w);
            let to = [
                x + rng.random_range(-200.0..200.0),
                rng.random_range(-0.2 * h..1.1 * h),
                4.0,
            ];
            let radius = rng.random_range(1.2..4.5);
            draft.tube([x, -h - 20.0, 6.0], to, 30.0, radius, paint, rng);
        }
    }
    for _ in 0..rng.random_range(0..4) {
        let paint = Paint::new(Coat::Plastic, [0.6, 0.6, 0.57], 0.6, rng);
        let from = [rng.random_range(-w..w), rng.random_range(-h..h), 1.5];
        let to = [
            from[0] + rng.random_range(-80.0..80.0),
            from[1] + rng.random_range(-60.0..60.0),
            2.5,
        ];
        draft.tube(from, to, 5.0, rng.random_range(0.12..0.3), paint, rng);
    }
    // a cord or clip over part of a head
    for k in 0..draft.screws.len() {
        if !rng.random_bool(0.03 * f64::from(draft.style.scale.min(1.0))) {
            continue;
        }
        let screw = &draft.screws[k];
        let (radius, at) = (0.5 * screw.item.diameter_mm as f32, screw.at_mm.map(|v| v as f32));
        let angle = rng.random_range(0.0..std::f32::consts::TAU);
        let cord = rng.random_range(0.8..2.6f32);
        let off = radius * rng.random_range(0.35..1.0) + cord;
        let (nx, ny) = (angle.cos(), angle.sin());
        let mid = [at[0] + off * nx, at[1] + off * ny];
        let top = screw.height_mm as f32 + 5.0 + cord;
        let reach = rng.random_range(30.0..120.0);
        let color = pick(
            rng,
            &[
                [0.03; 3],
                [0.7, 0.7, 0.66],
                [0.5, 0.05, 0.04],
                [0.05, 0.15, 0.5],
                [0.6, 0.5, 0.06],
            ],
        );
        let paint = draft.style.plastic(color, rng);
        let points = (0..=16)
            .map(|i| {
                let t = (i as f32 / 8.0 - 1.0) * reach;
                let bow = 0.0012 * t * t;
                [mid[0] - ny * t + nx * bow, mid[1] + nx * t + ny * bow, top]
            })
            .collect();
        draft.work.tubes.push(Tube::new(points, cord, paint));
    }
}
