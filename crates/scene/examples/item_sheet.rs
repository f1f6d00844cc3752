//! A contact sheet of baked items as the camera would see them, for judging by eye: one row a kind, random variants beside one another.
//!
//! ```sh
//! cargo run --release -p scene --example item_sheet -- OUT.png [SEED] [screws|decoys] [WEAR 0..1]
//! ```

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use scene::bake::{SheetFinish, bake};
use scene::fastener::{CrossRecess, Decoy, Head, Item, Kind, Plating, Wear};
use scene::relief::{Material, Relief};
use scene::shade::Lighting;

const TILE_PX: usize = 64;
const ZOOM: usize = 2;
const COLUMNS: usize = 14;
const MM_PER_PX: f32 = 0.32;
const SUPERSAMPLES: usize = 3;

fn wear(rng: &mut Pcg64Mcg, level: f32) -> Wear {
    let mut draw = |chance: f64| {
        if rng.random_bool(chance * f64::from(level)) {
            rng.random::<f32>()
        } else {
            0.0
        }
    };
    Wear {
        rust: draw(0.4),
        white_rust: draw(0.2),
        dirt: draw(0.5),
        dust: draw(0.4),
        mud_in_slot: draw(0.2),
        paint_over: draw(0.12),
        worn_slot: draw(0.2),
        bent_head: draw(0.12),
        web: draw(0.15),
        chipped: draw(0.25),
    }
}

fn item(kind: Option<Decoy>, head: usize, rng: &mut Pcg64Mcg, level: f32) -> Item {
    const HEADS: [Head; 5] = [Head::Pan, Head::Truss, Head::Binding, Head::Washer, Head::HexFlange];
    const RECESSES: [CrossRecess; 3] = [CrossRecess::Jis, CrossRecess::Phillips, CrossRecess::Combination];
    const PLATINGS: [Plating; 8] = [
        Plating::Zinc,
        Plating::DullZinc,
        Plating::Chromate,
        Plating::BlackOxide,
        Plating::Stainless,
        Plating::Nickel,
        Plating::Bronze,
        Plating::Painted,
    ];
    let diameter_mm = rng.random_range(7.0..12.0);
    let head = HEADS[head % 5];
    let share = match head {
        Head::Pan | Head::Binding => rng.random_range(0.5..0.62),
        Head::Truss => rng.random_range(0.38..0.5),
        Head::Washer | Head::HexFlange => rng.random_range(0.36..0.46),
    };
    Item {
        kind: kind.map_or(
            Kind::Screw {
                head,
                recess: RECESSES[[0, 0, 1, 1, 2][rng.random_range(0..5)]],
                recess_width_mm: diameter_mm * share,
            },
            Kind::Decoy,
        ),
        diameter_mm,
        rotation_rad: rng.random_range(0.0..std::f64::consts::TAU),
        tilt_rad: if rng.random_bool(0.2) {
            rng.random_range(0.0..0.15)
        } else {
            0.0
        },
        tilt_direction_rad: rng.random_range(0.0..std::f64::consts::TAU),
        lift_mm: if rng.random_bool(0.1) {
            rng.random_range(0.0..1.5)
        } else {
            0.0
        },
        recess_offset_mm: [rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2)],
        plating: PLATINGS[rng.random_range(0..8)],
        wear: wear(rng, level),
        seed: rng.random(),
    }
}

fn tile(relief: &Relief, sheet: &SheetFinish, lighting: &Lighting, slant: [f32; 2], gain: f32) -> Vec<[f32; 3]> {
    let bare = Material {
        albedo: sheet.albedo,
        roughness: sheet.roughness,
        metallic: sheet.metallic,
    };
    let length = (1.0 + slant[0] * slant[0] + slant[1] * slant[1]).sqrt();
    let view = [slant[0] / length, slant[1] / length, 1.0 / length];
    let down = view.map(|v| -v);
    let mut out = vec![[0.0_f32; 3]; TILE_PX * TILE_PX];
    let mut visibility = vec![1.0; lighting.lights.len()];
    for (i, pixel) in out.iter_mut().enumerate() {
        for sub in 0..SUPERSAMPLES * SUPERSAMPLES {
            let at = |index: usize, sub: usize| {
                (index as f32 - 0.5 * TILE_PX as f32 + (sub as f32 + 0.5) / SUPERSAMPLES as f32) * MM_PER_PX
            };
            let origin = [
                at(i % TILE_PX, sub % SUPERSAMPLES),
                at(i / TILE_PX, sub / SUPERSAMPLES),
                0.0,
            ];
            let (point, normal, material, open) = match relief.march(origin, down) {
                Some(hit) => {
                    let (mut material, cover) = relief.material(hit[0], hit[1]);
                    for (a, b) in material.albedo.iter_mut().zip(bare.albedo) {
                        *a = b + cover * (*a - b);
                    }
                    material.roughness = bare.roughness + cover * (material.roughness - bare.roughness);
                    material.metallic = bare.metallic + cover * (material.metallic - bare.metallic);
                    (
                        hit,
                        relief.normal(hit[0], hit[1]),
                        material,
                        relief.open(hit[0], hit[1]),
                    )
                }
                None => (origin, [0.0, 0.0, 1.0], bare, 1.0),
            };
            for (seen, light) in visibility.iter_mut().zip(&lighting.lights) {
                let incoming = light.at(point);
                *seen = relief.visibility(point, incoming.toward, incoming.softness);
            }
            let radiance = lighting.radiance(&material, normal, view, &visibility, open, point);
            for (p, r) in pixel.iter_mut().zip(radiance) {
                *p += gain * r / (SUPERSAMPLES * SUPERSAMPLES) as f32;
            }
        }
    }
    out
}

/// Blur of a real lens, noise of a real sensor, gamma.
fn develop(linear: &[[f32; 3]], rng: &mut Pcg64Mcg) -> Vec<[u8; 3]> {
    let width: f32 = rng.random_range(0.35..0.8);
    let kernel: Vec<f32> = (-2..=2)
        .map(|i| (-(i * i) as f32 / (2.0 * width * width)).exp())
        .collect();
    let total: f32 = kernel.iter().sum();
    let clip = |v: i32| v.clamp(0, TILE_PX as i32 - 1) as usize;
    let pass = |from: &[[f32; 3]], dx: i32, dy: i32| -> Vec<[f32; 3]> {
        (0..from.len())
            .map(|i| {
                let (x, y) = ((i % TILE_PX) as i32, (i / TILE_PX) as i32);
                let mut sum = [0.0; 3];
                for (k, weight) in kernel.iter().enumerate() {
                    let k = k as i32 - 2;
                    let p = from[clip(y + dy * k) * TILE_PX + clip(x + dx * k)];
                    for (s, v) in sum.iter_mut().zip(p) {
                        *s += weight / total * v.min(3.0);
                    }
                }
                sum
            })
            .collect()
    };
    let noise: f32 = rng.random_range(0.002..0.012);
    pass(&pass(linear, 1, 0), 0, 1)
        .iter()
        .map(|p| {
            p.map(|v| {
                let grain = (0..3).map(|_| rng.random_range(-1.0..1.0_f32)).sum::<f32>();
                let v = (v + noise * grain * (0.3 + v.max(0.0)).sqrt()).clamp(0.0, 1.0);
                (255.0 * v.powf(1.0 / 2.2) + 0.5) as u8
            })
        })
        .collect()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let out = args.next().unwrap_or_else(|| "item_sheet.png".into());
    let seed = args.next().map_or(Ok(1), |s| s.parse::<u64>())?;
    let which = args.next().unwrap_or_else(|| "all".into());
    let level = args.next().map_or(Ok(0.7), |s| s.parse::<f32>())?;
    let mut rows: Vec<(Option<Decoy>, usize)> = Vec::new();
    if which != "decoys" {
        rows.extend((0..10).map(|head| (None, head)));
    }
    if which != "screws" {
        rows.extend(Decoy::ALL.iter().map(|&d| (Some(d), 0)));
    }
    let pitch = TILE_PX * ZOOM + 2;
    let mut picture = image::RgbImage::new((COLUMNS * pitch) as u32, (rows.len() * pitch) as u32);
    let mut baking = std::time::Duration::ZERO;
    for (row, &(decoy, head)) in rows.iter().enumerate() {
        for column in 0..COLUMNS {
            let mut rng = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(1_000_003) + (1000 * row + column) as u64);
            let level_sheet = rng.random_range(0.04..0.75_f32);
            let sheet = SheetFinish {
                albedo: [
                    level_sheet,
                    level_sheet * rng.random_range(0.9..1.0),
                    level_sheet * rng.random_range(0.75..1.0),
                ],
                roughness: rng.random_range(0.35..0.7),
                metallic: if rng.random_bool(0.15) { 1.0 } else { 0.0 },
            };
            let item = item(decoy, head, &mut rng, level);
            let start = std::time::Instant::now();
            let relief = bake(&item, &sheet);
            baking += start.elapsed();
            let lighting = Lighting::sample(&mut rng);
            let slant = [rng.random_range(-0.3..0.3), rng.random_range(-0.3..0.3)];
            let gain = rng.random_range(0.45..1.25_f32);
            let pixels = develop(&tile(&relief, &sheet, &lighting, slant, gain), &mut rng);
            for y in 0..TILE_PX * ZOOM {
                for x in 0..TILE_PX * ZOOM {
                    let p = pixels[(y / ZOOM) * TILE_PX + x / ZOOM];
                    picture.put_pixel((column * pitch + x) as u32, (row * pitch + y) as u32, image::Rgb(p));
                }
            }
        }
    }
    picture.save(&out)?;
    println!(
        "{out}: {} items, {:.2} ms to bake one",
        rows.len() * COLUMNS,
        1e3 * baking.as_secs_f64() / (rows.len() * COLUMNS) as f64
    );
    Ok(())
}
