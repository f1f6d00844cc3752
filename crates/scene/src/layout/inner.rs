//! The face behind the front cover.

use super::draft::Draft;
use super::sheet::loose_ends;
use super::style::Style;
use super::{Rng, bounds, pick, strip};
use crate::layer::{Bump, Layer};
use crate::paint::{Coat, Paint};
use crate::print::Print;
use crate::product::{FaceDesign, FaceId};
use crate::shape::{Bounds, Shape};
use rand::RngExt;

pub(super) fn front_inner(style: &Style, w: f64, h: f64, depth: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
    let mut draft = Draft::new(style, w, h);
    let [hw, hh] = draft.half;
    // frame
    let paint = if rng.random_bool(0.6) {
        style.zinc(rng)
    } else {
        style.trim(rng)
    };
    let rim: [f32; 4] = std::array::from_fn(|_| rng.random_range(18.0..40.0));
    let frame = draft.add(Layer::new(
        Shape::rect([0.0, 0.0], [hw, hh], 3.0),
        0.0,
        60.0,
        1.5,
        paint,
    ));
    let (low, high) = ([-hw + rim[0], -hh + rim[1]], [hw - rim[2], hh - rim[3]]);
    draft.work.layers[frame].cut(strip(low, high), depth.min(90.0) as f32);
    draft.seam(frame, bounds([-hw + 4.0, -hh + 1.0], [hw - 4.0, -hh + rim[1]]));
    draft.seam(frame, bounds([-hw + 4.0, hh - rim[3]], [hw - 4.0, hh - 1.0]));
    draft.seam(frame, bounds([-hw + 1.0, -hh + 4.0], [-hw + rim[0], hh - 4.0]));
    draft.seam(frame, bounds([hw - rim[2], -hh + 4.0], [hw - 1.0, hh - 4.0]));
    // back: heat exchanger fins or dark sheet
    let back = -rng.random_range(130.0..0.75 * depth) as f32;
    let grey = rng.random_range(0.06..0.22f32);
    let paint = Paint::new(Coat::Plastic, [grey, grey, 1.03 * grey], 0.75, rng).worn(
        style.dirt,
        style.mud,
        0.4 * style.rust,
        rng,
    );
    let mut floor = Layer::new(strip([-hw, -hh], [hw, hh]), back, 0.0, 0.0, paint);
    if rng.random_bool(0.6) {
        floor.bumps.push(Bump::Wave {
            shape: strip(low, high),
            along: [1.0, 0.0],
            wavelength: rng.random_range(2.6..4.0),
            amplitude: 0.7,
        });
    }
    draft.add(floor);
    // partition between fan room and compressor room
    let split = low[0] + (high[0] - low[0]) * rng.random_range(0.55..0.72);
    let paint = style.zinc(rng);
    let wall = draft.add(Layer::new(
        strip([split - 14.0, low[1] - 1.0], [split + 6.0, high[1] + 1.0]),
        -rng.random_range(2.0..14.0f32),
        60.0,
        1.0,
        paint,
    ));
    draft.seam(wall, bounds([split - 14.0, low[1]], [split + 6.0, high[1]]));
    // motor mount: two posts and a motor between them
    let mid = [0.5 * (low[0] + split), 0.5 * (low[1] + high[1])];
    let posts = rng.random_range(30.0..70.0f32);
    let mount = -rng.random_range(25.0..70.0f32);
    for sign in [-1.0f32, 1.0] {
        let x = mid[0] + sign * posts;
        let half = rng.random_range(10.0..16.0f32);
        let paint = style.zinc(rng);
        let post = draft.add(Layer::new(
            strip([x - half, low[1] - 1.0], [x + half, high[1] + 1.0]),
            mount,
            18.0,
            1.2,
            paint,
        ));
        if rng.random_bool(0.5) {
            draft.bump(
                post,
                Bump::Plateau {
                    shape: Shape::rect([x, mid[1]], [3.0, 0.4 * (high[1] - low[1])], 3.0),
                    height: -1.5,
                    soft: 2.0,
                },
            );
        }
        draft.seam(post, bounds([x - half, low[1]], [x + half, high[1]]));
    }
    let motor = rng.random_range(42.0..60.0);
    let paint = Paint::new(Coat::Zinc, [0.35; 3], 0.5, rng).worn(style.dirt, style.mud, style.rust, rng);
    let plate = draft.add(Layer::new(
        Shape::rect([mid[0], mid[1]], [posts + 12.0, motor * 0.75], 6.0),
        mount + 2.0,
        4.0,
        1.0,
        paint.clone(),
    ));
    draft.seam(plate, Bounds::around(mid, [posts + 12.0, motor * 0.75]));
    let body = draft.add(Layer::new(
        Shape::Disc {
            center: mid,
            radius: motor,
        },
        mount + 26.0,
        26.0,
        7.0,
        paint,
    ));
    let _ = body;
    let shaft = Paint::new(Coat::Zinc, [0.6; 3], 0.3, rng);
    draft.add(Layer::new(
        Shape::Disc {
            center: mid,
            radius: 5.0,
        },
        mount + 50.0,
        26.0,
        1.0,
        shaft,
    ));
    // compressor room: electrical box above, compressor below
    let room = [split + 10.0, high[0]];
    let box_height = rng.random_range(0.3..0.5) * (high[1] - low[1]);
    let paint = match rng.random_range(0..3) {
        0 => style.plastic([0.05; 3], rng),
        1 => style.zinc(rng),
        _ => style.plastic([0.6, 0.6, 0.56], rng),
    };
    let box_low = [room[0] + 3.0, low[1] + rng.random_range(4.0..20.0)];
    let box_high = [room[1] - rng.random_range(3.0..20.0), box_low[1] + box_height];
    let lid = draft.add(Layer::new(
        strip(box_low, box_high),
        -rng.random_range(6.0..40.0f32),
        50.0,
        3.0,
        paint,
    ));
    let on = bounds(box_low, box_high);
    draft.seam(lid, on);
    draft.panel(lid, on);
    draft.label(lid, on, Print::plate(&style.model, rng), rng);
    if rng.random_bool(0.6) {
        draft.label(lid, on, Print::warning(rng), rng);
    }
    let below = [0.5 * (room[0] + room[1]), 0.5 * (box_high[1] + high[1])];
    let radius = 0.46 * (room[1] - room[0]).min(high[1] - box_high[1]);
    if radius > 15.0 {
        let paint = Paint::new(Coat::Painted, [0.03; 3], 0.45, rng).worn(style.dirt, style.mud, style.rust, rng);
        draft.add(Layer::new(
            Shape::Disc { center: below, radius },
            -60.0,
            120.0,
            0.5 * radius,
            paint,
        ));
    }
    // cables and pipes
    for _ in 0..rng.random_range(3..=8) {
        let color = pick(
            rng,
            &[
                [0.55, 0.03, 0.03],
                [0.03, 0.1, 0.45],
                [0.7, 0.7, 0.68],
                [0.03; 3],
                [0.65, 0.5, 0.03],
                [0.05, 0.3, 0.08],
                [0.3, 0.12, 0.05],
            ],
        );
        let paint = style.plastic(color, rng);
        let from = [
            rng.random_range(box_low[0]..box_high[0]),
            box_high[1] - rng.random_range(0.0..40.0),
            rng.random_range(-20.0..5.0),
        ];
        let to = [
            rng.random_range(low[0]..high[0]),
            rng.random_range(low[1]..high[1]),
            rng.random_range(-90.0..-10.0f32),
        ];
        draft.tube(from, to, 40.0, rng.random_range(1.2..3.5), paint, rng);
    }
    for _ in 0..rng.random_range(1..=3) {
        let paint = Paint::new(Coat::Zinc, [0.6, 0.33, 0.18], 0.35, rng).worn(0.6 * style.dirt, style.mud, 0.0, rng);
        let x = rng.random_range(room[0]..room[1]);
        draft.tube(
            [x, below[1], -50.0],
            [x + rng.random_range(-60.0..60.0), high[1], -30.0],
            10.0,
            rng.random_range(3.0..7.0),
            paint,
            rng,
        );
    }
    draft.panel(frame, bounds([-hw, -hh], [hw, hh]));
    draft.life(frame, bounds([-hw, -hh], [hw, hh]), rng);
    draft.put_screws(rng.random_range(4..=8), rng);
    draft.put_decoys(rng.random_range(6..=18), rng);
    loose_ends(&mut draft, 0.2, rng);
    draft.finish(FaceId::FrontInner, w, h, next, rng)
}
