//! What stands around the unit: wall or floor, the magnetic table, clamps, pallets, other hardware.

use crate::layer::{Layer, Sheetwork, Tube};
use crate::noise::{Grain, Noise};
use crate::paint::{Coat, Decal, Paint};
use crate::product::FaceDesign;
use crate::shape::{Bounds, Shape, Xy};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

fn gray(level: f32, rng: &mut Pcg64Mcg) -> [f32; 3] {
    let warm = rng.random_range(-0.06..0.08f32);
    [level * (1.0 + warm), level, level * (1.0 - warm)]
}

/// Adds the surroundings of a face.
pub(crate) fn surround(sheetwork: &mut Sheetwork, design: &FaceDesign, rng: &mut Pcg64Mcg) {
    let half: Xy = [0.5 * design.width_mm as f32, 0.5 * design.height_mm as f32];
    let lowest = sheetwork
        .layers
        .iter()
        .map(|l| l.top_mm - l.wall_mm)
        .fold(-40.0, f32::min)
        .max(-520.0);
    // what the unit stands before or lies on
    let back = lowest - rng.random_range(0.0..1.0f32).powi(2) * 900.0 - 1.0;
    let (coat, level, rough) = match rng.random_range(0..4) {
        0 => (Coat::Mineral, rng.random_range(0.12..0.5f32), 0.95),
        1 => (Coat::Painted, rng.random_range(0.05..0.6), 0.6),
        2 => (Coat::Zinc, rng.random_range(0.3..0.55), 0.5),
        _ => (Coat::Mineral, rng.random_range(0.04..0.2), 0.9),
    };
    let color = if coat == Coat::Painted && rng.random_bool(0.4) {
        [
            [0.05, 0.16, 0.1],
            [0.04, 0.09, 0.2],
            [0.5, 0.36, 0.04],
            [0.3, 0.05, 0.03],
        ][rng.random_range(0..4)]
    } else {
        gray(level, rng)
    };
    let mud = gray(0.1, rng);
    let paint = Paint::new(coat, color, rough, rng)
        .far(rng)
        .worn(rng.random_range(0.05..0.45), mud, 0.0, rng);
    let mut wall = Layer::new(Shape::rect([0.0; 2], [6000.0; 2], 0.0), back, 0.0, 0.0, paint);
    // joints of tiles, boards or plates; T-slots of a table
    if rng.random_bool(0.6) {
        let pitch = rng.random_range(80.0..420.0f32);
        let width = rng.random_range(0.8..7.0);
        let count = (1600.0 / pitch) as u32 * 2 + 1;
        let turned = rng.random_bool(0.5);
        let shift = rng.random_range(-0.5..0.5) * pitch;
        let lines = Shape::Field {
            center: [shift, shift],
            pitch: if turned { [1.0, pitch] } else { [pitch, 1.0] },
            count: if turned { [1, count] } else { [count, 1] },
            half: if turned { [3000.0, width] } else { [width, 3000.0] },
            round: 0.0,
        };
        wall.bumps.push(crate::layer::Bump::Plateau {
            shape: lines,
            height: -rng.random_range(2.0..10.0f32),
            soft: 1.5,
        });
    }
    for _ in 0..rng.random_range(2..9) {
        let ragged = Noise::new(Grain::Cloud, rng.random_range(30.0..120.0), rng);
        wall.decals.push(Decal::Stain {
            center: [rng.random_range(-900.0..900.0), rng.random_range(-700.0..700.0)],
            radius: rng.random_range(30.0..220.0),
            color: mud,
            strength: rng.random_range(0.2..0.8),
            ragged,
        });
    }
    sheetwork.layers.push(wall);
    // hardware around the unit, clear of the face itself
    let own = Bounds::around([0.0; 2], half);
    for _ in 0..rng.random_range(2..9) {
        let vertical = rng.random_bool(0.5);
        let (long, wide) = (rng.random_range(30.0..320.0f32), rng.random_range(12.0..70.0f32));
        let size = if vertical { [wide, long] } else { [long, wide] };
        let center = [rng.random_range(-850.0..850.0f32), rng.random_range(-640.0..640.0f32)];
        let place = Bounds::around(center, size);
        if place.meets(&own.grown(6.0)) {
            continue;
        }
        let top = back + rng.random_range(8.0..(0.9 * -back).clamp(30.0, 420.0));
        let color = if rng.random_bool(0.3) {
            [
                [0.6, 0.4, 0.03],
                [0.03, 0.12, 0.35],
                [0.5, 0.05, 0.03],
                [0.05, 0.25, 0.1],
            ][rng.random_range(0..4)]
        } else {
            let level = rng.random_range(0.05..0.6);
            gray(level, rng)
        };
        let coat = if rng.random_bool(0.4) {
            Coat::Zinc
        } else {
            Coat::Painted
        };
        let paint = Paint::new(coat, color, rng.random_range(0.3..0.8), rng).far(rng).worn(
            rng.random_range(0.0..0.6),
            mud,
            rng.random_range(0.0..0.3),
            rng,
        );
        let mut layer = Layer::new(
            Shape::turned_rect(center, size, 3.0, rng.random_range(-0.25..0.25)),
            top,
            top - back,
            rng.random_range(0.5..5.0),
            paint,
        );
        for _ in 0..rng.random_range(0..3) {
            // bolt holes and pads
            let at = [
                center[0] + rng.random_range(-0.7..0.7) * size[0],
                center[1] + rng.random_range(-0.7..0.7) * size[1],
            ];
            let radius = rng.random_range(3.0..9.0);
            if rng.random_bool(0.5) {
                layer.cut(Shape::Disc { center: at, radius }, 12.0);
            } else {
                layer.bumps.push(crate::layer::Bump::Plateau {
                    shape: Shape::Disc { center: at, radius },
                    height: rng.random_range(-2.0..4.0),
                    soft: 1.2,
                });
            }
        }
        sheetwork.layers.push(layer);
    }
    // clamps that touch the unit's flanks, below the face
    for sign in [-1.0f32, 1.0] {
        if !rng.random_bool(0.4) {
            continue;
        }
        let reach = rng.random_range(25.0..70.0f32);
        let across = rng.random_bool(0.5);
        let t = rng.random_range(-0.7..0.7f32);
        let (center, size) = if across {
            (
                [sign * (half[0] + reach), t * half[1]],
                [reach, rng.random_range(15.0..50.0)],
            )
        } else {
            (
                [t * half[0], sign * (half[1] + reach)],
                [rng.random_range(15.0..60.0), reach],
            )
        };
        let level = rng.random_range(0.1..0.6);
        let color = gray(level, rng);
        let paint = Paint::new(Coat::Zinc, color, rng.random_range(0.3..0.6), rng)
            .far(rng)
            .worn(0.3, mud, 0.1, rng);
        let top = -rng.random_range(4.0..60.0f32);
        sheetwork
            .layers
            .push(Layer::new(Shape::rect(center, size, 2.0), top, top - back, 1.5, paint));
    }
    // hoses on the ground
    for _ in 0..rng.random_range(0..3) {
        let color = [[0.03, 0.03, 0.03], [0.5, 0.3, 0.02], [0.03, 0.1, 0.3]][rng.random_range(0..3)];
        let paint = Paint::new(Coat::Plastic, color, 0.6, rng)
            .far(rng)
            .worn(0.3, mud, 0.0, rng);
        let radius = rng.random_range(4.0..12.0f32);
        let from = [rng.random_range(-900.0..900.0f32), -900.0];
        let bend = rng.random_range(-500.0..500.0f32);
        let points = (0..=30)
            .map(|k| {
                let t = k as f32 / 30.0;
                [from[0] + bend * (3.0 * t).sin(), from[1] + 1800.0 * t, back + radius]
            })
            .collect();
        sheetwork.tubes.push(Tube::new(points, radius, paint));
    }
}
