//! Years outdoors: what bends, fills, corrodes and soils an item, as changes of its heights and colours.

use crate::bake::{Canvas, SheetFinish, Texel};
use crate::fastener::{Decoy, Item, Kind, Plating};
use crate::form::{Form, between};
use crate::noise::{Grain, Noise, smoothstep};
use crate::relief::Material;
use crate::texture::{Surface, Texture};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f32::consts::TAU;

/// Levels below this are not worth a pass.
const NOTHING: f32 = 0.01;

fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    [
        a[0] + t * (b[0] - a[0]),
        a[1] + t * (b[1] - a[1]),
        a[2] + t * (b[2] - a[2]),
    ]
}

fn scaled(albedo: [f32; 3], by: f32) -> [f32; 3] {
    albedo.map(|v| (v * by).min(0.95))
}

fn matt(albedo: [f32; 3], roughness: f32) -> Material {
    Material {
        albedo,
        roughness,
        metallic: 0.0,
    }
}

/// What is left of head and slot.
pub(crate) struct Sums {
    pub slot_fill: f32,
    pub head_cover: f32,
    pub slot_visible: f32,
}

impl Sums {
    /// Adds up what the layers have noted on the texels.
    pub fn of(canvas: &Canvas) -> Sums {
        let (mut depth, mut filled, mut head, mut lumps) = (0.0_f32, 0.0, 0.0_f32, 0.0);
        let (mut slot, mut seen) = (0.0_f32, 0.0);
        for t in canvas.texels.iter().filter(|t| t.solid) {
            head += 1.0;
            lumps += t.lump;
            if t.recess > 0.3 {
                let share = (t.filled / t.recess).clamp(0.0, 1.0);
                depth += t.recess;
                filled += t.filled.clamp(0.0, t.recess);
                slot += 1.0;
                // Filled to the brim, a wing has no outline any more.
                let buried = smoothstep(0.88, 1.0, share);
                seen += (1.0 - t.hidden) * (1.0 - buried);
            }
        }
        Sums {
            slot_fill: filled / depth.max(1e-6),
            head_cover: lumps / head.max(1.0),
            slot_visible: if slot > 0.0 { seen / slot } else { 1.0 },
        }
    }
}

/// Wear that changes the shape: blows, fillings, blisters, thick paint.
pub(crate) fn reshape(canvas: &mut Canvas, item: &Item, form: &Form, rng: &mut Pcg64Mcg) {
    let wear = &item.wear;
    if wear.bent_head > NOTHING {
        bend(canvas, wear.bent_head, rng);
    }
    if wear.rust > NOTHING || wear.white_rust > NOTHING {
        let blister = Noise::new(Grain::Cloud, 1.6, rng);
        let pits = Noise::new(Grain::Even, 0.5, rng);
        let amount = (wear.rust.max(0.8 * wear.white_rust) * form.corrodes).min(1.0);
        let depth = between(rng, 0.08, 0.3) * amount;
        let grain = between(rng, 0.04, 0.2) * amount;
        let clog = amount * between(rng, 0.0, 0.35);
        canvas.each(|x, y, t| {
            if t.part == u8::MAX {
                return;
            }
            t.height += depth * (blister.at(x, y) - 0.5) + grain * (pits.at(x, y) - 0.5);
            if t.recess > 0.0 {
                let fill = clog * t.recess * blister.at(y, x);
                t.height += fill;
                t.filled += fill;
            }
        });
        if amount > 0.4 {
            canvas.smooth(amount, |t| t.solid);
        }
    }
    if wear.paint_over > NOTHING {
        // Paint runs into the slot and rounds every edge.
        let level = wear.paint_over.powf(1.2) * between(rng, 0.6, 0.8);
        let wave = Noise::new(Grain::Cloud, 1.5, rng);
        let deepest = deepest(canvas);
        canvas.each(|x, y, t| {
            if t.recess > 0.0 {
                let rim = t.height + t.recess - t.filled;
                let fill = (rim - deepest * (1.0 - level) + 0.15 * (wave.at(x, y) - 0.5) - t.height)
                    .clamp(0.0, (t.recess - t.filled).max(0.0));
                t.height += fill;
                t.filled += fill;
            }
        });
        for _ in 0..(1.0 + 4.0 * wear.paint_over) as usize {
            canvas.smooth(1.0, |t| t.solid);
        }
    }
    if wear.mud_in_slot > NOTHING {
        mud(canvas, item, rng);
    }
}

fn deepest(canvas: &Canvas) -> f32 {
    canvas.texels.iter().map(|t| t.recess).fold(0.0, f32::max)
}

fn bend(canvas: &mut Canvas, level: f32, rng: &mut Pcg64Mcg) {
    let radius = canvas.radius;
    let [cx, cy] = canvas.center;
    let angle = between(rng, 0.0, TAU);
    let (sin, cos) = angle.sin_cos();
    let from = radius * between(rng, 0.0, 0.6);
    let fold = level * between(rng, 0.2, 0.9);
    let nick_angle = between(rng, 0.0, TAU);
    let nick = radius * level * between(rng, 0.0, 0.3);
    let dents: Vec<[f32; 4]> = (0..rng.random_range(1..=4))
        .map(|_| {
            let (s, c) = between(rng, 0.0, TAU).sin_cos();
            let at = radius * between(rng, 0.3, 1.0);
            [
                at * c,
                at * s,
                radius * between(rng, 0.12, 0.35),
                level * between(rng, 0.15, 0.7),
            ]
        })
        .collect();
    let (nick_sin, nick_cos) = nick_angle.sin_cos();
    canvas.each(|x, y, t| {
        if !t.solid {
            return;
        }
        let (u, v) = (x - cx, y - cy);
        let over = (u * cos + v * sin - from).max(0.0);
        let mut drop = fold * over * over / radius * 1.6;
        for [du, dv, width, depth] in &dents {
            let q = ((u - du).powi(2) + (v - dv).powi(2)) / (width * width);
            if q < 4.0 {
                let blow = (-1.5 * q).exp();
                drop += depth * blow;
                t.burr = t.burr.max(0.6 * level * blow);
            }
        }
        let out = u * nick_cos + v * nick_sin - (radius - nick);
        if out > 0.0 {
            drop += 3.0 * out;
        }
        t.height = (t.height - drop).max(if t.recess > 0.0 { -2.0 } else { 0.05 });
    });
}

fn mud(canvas: &mut Canvas, item: &Item, rng: &mut Pcg64Mcg) {
    let level = item.wear.mud_in_slot;
    let wave = Noise::new(Grain::Cloud, 1.8, rng);
    let grain = Noise::new(Grain::Even, 0.35, rng);
    let deepest = deepest(canvas);
    let half = match item.kind {
        Kind::Screw { recess_width_mm, .. } => 0.5 * recess_width_mm as f32,
        Kind::Decoy(_) => 0.5 * canvas.radius,
    };
    let spill = smoothstep(0.55, 1.0, level) * between(rng, 0.5, 1.3);
    let [cx, cy] = canvas.center;
    canvas.each(|x, y, t| {
        if !t.solid {
            return;
        }
        let uneven = wave.at(x, y);
        if t.recess > 0.0 {
            let rim = t.height + t.recess - t.filled;
            let surface =
                rim - deepest * (1.0 - 1.04 * level) + (0.35 * uneven - 0.18) * (0.3 + level) + 0.06 * grain.at(x, y);
            let room = (t.recess - t.filled).max(0.0);
            let fill = (surface - t.height).clamp(0.0, room);
            t.height += fill;
            t.filled += fill;
            // What shows of it is as deep as it lies, not as wide as the slot.
            t.lump = t
                .lump
                .max(smoothstep(0.02, 0.25, fill) * smoothstep(0.5, 0.9, t.filled / t.recess));
        }
        let r = ((x - cx).powi(2) + (y - cy).powi(2)).sqrt() / half;
        let cake = smoothstep(0.0, 0.5, spill * 1.6 - r * 0.7 + 1.1 * (uneven - 0.5));
        if spill > 0.0 && cake > 0.0 {
            t.height += cake * (0.12 + 0.25 * spill * uneven);
            t.lump = t.lump.max(cake);
        }
    });
}

/// Wear that changes the colour, from the plating outward.
pub(crate) fn colour(canvas: &mut Canvas, item: &Item, sheet: &SheetFinish, form: &Form, rng: &mut Pcg64Mcg) {
    let wear = &item.wear;
    finish(canvas, item, rng);
    if wear.chipped > NOTHING || wear.worn_slot > NOTHING || wear.bent_head > NOTHING {
        chip(canvas, item, form, rng);
    }
    if wear.paint_over > NOTHING {
        paint(canvas, wear.paint_over, sheet, rng);
    }
    if wear.white_rust > NOTHING {
        white_rust(canvas, wear.white_rust * form.corrodes, rng);
    }
    let spot = item.kind == Kind::Decoy(Decoy::RustSpot);
    if wear.rust > NOTHING || spot {
        rust(canvas, wear.rust, form.corrodes, spot, rng);
    }
    if wear.dirt > NOTHING {
        dirt(canvas, wear.dirt, rng);
    }
    if wear.mud_in_slot > NOTHING {
        let base = match rng.random_range(0..5) {
            0 => [0.03, 0.03, 0.03],
            1 => [0.16, 0.15, 0.14],
            2 => [0.24, 0.18, 0.12],
            _ => [0.12, 0.085, 0.055],
        };
        let base = scaled(base, between(rng, 0.7, 1.4));
        let rough = between(rng, 0.5, 0.95);
        let grain = Noise::new(Grain::Even, 0.5, rng);
        canvas.each(|x, y, t| {
            let alpha = t.lump.max(smoothstep(0.0, 0.2, t.filled) * 0.9);
            if alpha > 0.0 && t.solid {
                let shade = 0.7 + 0.6 * grain.at(x, y);
                t.lay(&matt(base.map(|v| v * shade), rough), alpha);
            }
        });
    }
    if wear.dust > NOTHING {
        dust(canvas, wear.dust, rng);
    }
    if wear.web > NOTHING {
        web(canvas, wear.web, rng);
    }
}

/// The plating itself: never one even colour.
fn finish(canvas: &mut Canvas, item: &Item, rng: &mut Pcg64Mcg) {
    let worn = Texture::new(Surface::WornMetal, 0.12, rng);
    let smear = Noise::new(Grain::Cloud, canvas.radius * 1.2, rng);
    let hue = Noise::new(Grain::Cloud, canvas.radius * 0.9, rng);
    let depth = between(rng, 0.05, 0.5);
    let rough = between(rng, 0.05, 0.3);
    let other = match item.plating {
        Plating::Chromate => [[1.0, 1.05, 0.95], [0.95, 0.85, 0.95]][rng.random_range(0..2)],
        Plating::Zinc | Plating::DullZinc => [[0.94, 0.98, 1.06], [1.04, 1.0, 0.9]][rng.random_range(0..2)],
        _ => [1.0; 3],
    };
    let turn = between(rng, 0.0, 1.0);
    let sunk = between(rng, 0.05, 0.5);
    canvas.each(|x, y, t| {
        if t.part == u8::MAX {
            return;
        }
        // The photograph's mean is about 0.5.
        let shade =
            1.0 + depth * ((worn.at(x, y)[1] / 0.48).clamp(0.5, 1.4) - 1.0) + 0.35 * depth * (smear.at(x, y) - 0.5);
        let cast = mix([1.0; 3], other, turn * hue.at(x, y));
        let m = &mut t.material;
        for (a, c) in m.albedo.iter_mut().zip(cast) {
            *a = (*a * shade * c).clamp(0.003, 0.97);
        }
        m.roughness = (m.roughness + rough * (smear.at(y, x) - 0.35)).clamp(0.08, 1.0);
        if t.recess > 0.0 {
            // The punch leaves its own scale, and oil keeps the dirt of years.
            let depth = smoothstep(0.1, 0.8, t.recess) * sunk;
            m.roughness = (m.roughness + 0.5 * depth).min(0.9);
            for a in &mut m.albedo {
                *a *= 1.0 - depth;
            }
        }
        if t.burr > 0.0 && m.metallic > 0.5 {
            m.roughness = (m.roughness - 0.1 * t.burr).max(0.08);
        }
    });
}

fn chip(canvas: &mut Canvas, item: &Item, form: &Form, rng: &mut Pcg64Mcg) {
    let level = item.wear.chipped * form.corrodes;
    let flakes = Noise::new(Grain::Cloud, 0.55 * canvas.radius, rng);
    let fine = Noise::new(Grain::Vein, 0.8, rng);
    let coated = matches!(item.plating, Plating::Painted | Plating::BlackOxide);
    let steel = Material {
        albedo: scaled([0.52, 0.5, 0.48], between(rng, 0.6, 1.3)),
        roughness: between(rng, 0.25, 0.5),
        metallic: 1.0,
    };
    let under = if coated {
        steel
    } else {
        // Bared iron under zinc is darker.
        Material {
            albedo: scaled([0.3, 0.28, 0.27], between(rng, 0.6, 1.3)),
            roughness: 0.55,
            metallic: 0.9,
        }
    };
    let threshold = 1.0 - 0.75 * level;
    canvas.each(|x, y, t| {
        if t.part == u8::MAX {
            return;
        }
        let edge = if t.recess > 0.0 { 0.1 } else { 0.0 };
        let value = 0.75 * flakes.at(x, y) + 0.25 * fine.at(x, y) + edge;
        let gone = if level > NOTHING {
            smoothstep(threshold - 0.02, threshold + 0.02, value)
        } else {
            0.0
        };
        if gone > 0.0 {
            t.lay(&under, gone);
        }
        if t.burr > 0.02 {
            t.lay(&steel, 0.9 * t.burr);
        }
    });
}

fn paint(canvas: &mut Canvas, level: f32, sheet: &SheetFinish, rng: &mut Pcg64Mcg) {
    let patch = Noise::new(Grain::Cloud, 1.5 * canvas.radius, rng);
    let tone = between(rng, 0.85, 1.1);
    let coat = matt(
        sheet.albedo.map(|v| (v * tone).min(0.9)),
        (sheet.roughness + between(rng, -0.1, 0.15)).clamp(0.2, 0.9),
    );
    let threshold = 1.0 - smoothstep(0.0, 0.55, level) * 1.1;
    canvas.each(|x, y, t| {
        if t.part != u8::MAX {
            let hollow = 0.25 * (1.0 - t.open) * (1.0 - level);
            t.lay(
                &coat,
                smoothstep(threshold - 0.05, threshold + 0.05, patch.at(x, y) - hollow),
            );
        }
    });
}

fn white_rust(canvas: &mut Canvas, level: f32, rng: &mut Pcg64Mcg) {
    let patch = Noise::new(Grain::Cloud, canvas.radius * between(rng, 0.5, 1.3), rng);
    let grain = Noise::new(Grain::Even, 0.3, rng);
    let tone = between(rng, 0.42, 0.78);
    let cool = between(rng, 0.97, 1.04);
    let threshold = 1.0 - level * 1.05;
    let (radius, [cx, cy]) = (canvas.radius, canvas.center);
    let halo = level * between(rng, 0.0, 0.6);
    canvas.each(|x, y, t| {
        let rho = ((x - cx).powi(2) + (y - cy).powi(2)).sqrt() / radius;
        if t.part == u8::MAX && rho > 1.4 + halo {
            return;
        }
        let value = 0.72 * patch.at(x, y) + 0.28 * grain.at(x, y);
        let alpha = if t.part != u8::MAX {
            smoothstep(threshold - 0.1, threshold + 0.12, value + 0.1 * (1.0 - t.open)) * 0.95
        } else {
            let near = 1.0 - smoothstep(0.0, 0.4 + halo, rho - 1.0);
            0.6 * halo * smoothstep(0.3, 0.8, value) * near
        };
        if alpha > 0.004 {
            let shade = tone * (0.75 + 0.5 * grain.at(y, x));
            t.lay(&matt([shade, shade, (shade * cool).min(0.95)], 0.92), alpha);
        }
    });
}

/// Fresh rust: orange and pale.
const FRESH: [f32; 3] = [0.42, 0.17, 0.07];

fn rust(canvas: &mut Canvas, level: f32, corrodes: f32, spot: bool, rng: &mut Pcg64Mcg) {
    let young = Texture::new(Surface::Rust, 0.08, rng);
    let old = Texture::new(Surface::Rust, 0.05, rng);
    let broken = Texture::new(Surface::RustyMetal, between(rng, 0.02, 0.06), rng);
    let patch = Noise::new(Grain::Cloud, canvas.radius * between(rng, 0.6, 1.6), rng);
    let stain = Noise::new(Grain::Cloud, canvas.radius * between(rng, 0.7, 2.0), rng);
    let grain = Noise::new(Grain::Even, 0.35, rng);
    let columns = Noise::new(Grain::Cloud, canvas.radius * 0.7, rng);
    // Orange, red-brown, dark brown.
    let lightness = between(rng, -0.6, 0.9).exp();
    let hue = [
        between(rng, 0.9, 1.15),
        between(rng, 0.85, 1.25),
        between(rng, 0.7, 1.5),
    ];
    let age = between(rng, 0.1, 1.0);
    let contrast = between(rng, 0.3, 0.75);
    let fresh = if rng.random_bool(0.55) {
        between(rng, 0.1, 0.9)
    } else {
        0.0
    };
    let head = (level * corrodes).powf(0.8) * 1.05;
    let threshold = 1.0 - head;
    let around = level * between(rng, 0.2, 1.0);
    let extent = between(rng, 0.35, 1.1);
    let strength = between(rng, 0.3, 0.9);
    let edge = between(rng, 0.04, 0.35);
    let run = if rng.random_bool(0.4) {
        between(rng, 0.3, 1.2)
    } else {
        0.0
    };
    let spread = if spot { between(rng, 0.15, 0.9) } else { 0.0 };
    let spot_strength = between(rng, 0.55, 1.0);
    let (radius, [cx, cy]) = (canvas.radius, canvas.center);
    canvas.each(|x, y, t| {
        let (u, v) = (x - cx, y - cy);
        let rho = (u * u + v * v).sqrt() / radius;
        let alpha = if spot {
            let value = 1.0 - rho + 1.3 * spread * (patch.at(x, y) - 0.5) + 0.2 * (grain.at(x, y) - 0.5);
            smoothstep(0.0, edge + 0.05, value) * spot_strength
        } else if t.part != u8::MAX {
            let favour = 0.12 * smoothstep(0.75, 1.0, rho) + 0.14 * (1.0 - t.open) + 0.2 * t.burr;
            let value = 0.64 * patch.at(x, y) + 0.36 * grain.at(x, y) + favour;
            smoothstep(threshold - 0.05, threshold + 0.1, value) * 0.97
        } else {
            let mut far = (rho - 1.0) / (extent * (0.4 + around));
            if far > 1.9 + 1.2 * run {
                return;
            }
            if run > 0.0 && v > 0.0 {
                // Water carries it down the sheet.
                let band = (u / radius).abs();
                let column = columns.at(u, 0.12 * v) * (1.0 - smoothstep(0.5, 1.05, band));
                far -= run * column * (v / radius).min(1.3) * 0.9;
            }
            let value = 1.0 - far + 1.5 * (stain.at(x, y) - 0.6) + 0.25 * (grain.at(x, y) - 0.5);
            smoothstep(0.35, 0.35 + edge + 0.05, value * (0.3 + around)) * strength * smoothstep(0.0, 0.25, around)
        };
        if alpha < 0.004 {
            return;
        }
        let a = young.at(x, y);
        let b = old.at(x, y).map(|v| v * 0.5);
        let mut albedo = mix(a, b, smoothstep(age - 0.25, age + 0.25, stain.at(y, x)));
        albedo = mix(albedo, FRESH, fresh * smoothstep(0.15, 0.85, patch.at(y, x)));
        let scale = broken.at(x, y)[0] / 0.38;
        let shade = lightness * (1.0 - contrast + 2.0 * contrast * grain.at(y, x)) * (0.75 + 0.25 * scale.min(1.6));
        for (c, h) in albedo.iter_mut().zip(hue) {
            *c = (*c * h * shade).clamp(0.004, 0.8);
        }
        t.lay(&matt(albedo, 0.88), alpha);
    });
}

fn dirt(canvas: &mut Canvas, level: f32, rng: &mut Pcg64Mcg) {
    let patch = Noise::new(Grain::Cloud, canvas.radius * between(rng, 0.5, 1.5), rng);
    let ring = Noise::new(Grain::Cloud, canvas.radius * 0.8, rng);
    let grain = Noise::new(Grain::Even, 0.3, rng);
    let tone = between(rng, 0.02, 0.14);
    let warm = between(rng, 0.65, 1.0);
    let soil = [tone, tone * (0.5 + 0.5 * warm), tone * warm];
    let rough = between(rng, 0.55, 0.95);
    let ground = between(rng, 0.2, 1.0);
    let run = if rng.random_bool(0.4) {
        between(rng, 0.2, 1.0)
    } else {
        0.0
    };
    let thick = smoothstep(0.65, 1.0, level);
    let (radius, [cx, cy]) = (canvas.radius, canvas.center);
    canvas.each(|x, y, t| {
        let (u, v) = (x - cx, y - cy);
        let cavity = 1.0 - t.open;
        let cloud = patch.at(x, y);
        let alpha = if t.part != u8::MAX {
            let value = 0.75 * cavity + 0.75 * (cloud - 0.55) + 0.35 * (grain.at(x, y) - 0.5) + 0.7 * thick;
            let alpha = level * smoothstep(0.0, 0.75, value + 0.35 * level);
            if t.solid && thick > 0.0 {
                t.lump = t.lump.max(smoothstep(0.7, 0.95, alpha));
            }
            alpha
        } else {
            let rho = (u * u + v * v).sqrt() / radius;
            let mut near = 0.0;
            if rho < 1.8 {
                near = (-(rho - 1.0).max(0.0) / 0.22).exp() * smoothstep(0.2, 0.8, ring.at(x, y));
            }
            if run > 0.0 && v > 0.0 && u.abs() < radius {
                near += run
                    * 0.7
                    * (1.0 - smoothstep(0.3, 1.0, u.abs() / radius))
                    * smoothstep(0.35, 0.9, ring.at(u, 0.15 * v));
            }
            let far = 0.6 * smoothstep(0.62, 0.85, cloud) * ground;
            let alpha = level * (0.75 * near + 0.5 * far + 0.4 * cavity);
            if alpha < 0.004 {
                return;
            }
            alpha * (0.7 + 0.5 * grain.at(x, y))
        };
        if alpha > 0.004 {
            t.lay(&matt(soil, rough), alpha);
        }
    });
}

fn dust(canvas: &mut Canvas, level: f32, rng: &mut Pcg64Mcg) {
    let patch = Noise::new(Grain::Cloud, canvas.radius * 1.5, rng);
    let grain = Noise::new(Grain::Even, 0.3, rng);
    let tone = between(rng, 0.28, 0.6);
    let powder = [tone, tone * between(rng, 0.88, 0.98), tone * between(rng, 0.68, 0.95)];
    let spread = between(rng, 0.1, 0.7);
    let [cx, cy] = canvas.center;
    let reach = canvas.radius * 2.1;
    canvas.each(|x, y, t| {
        let mut alpha = level * (0.25 + 0.6 * patch.at(x, y)) * (0.6 + 0.5 * grain.at(x, y));
        alpha *= 0.75 + 0.5 * (1.0 - t.open);
        if t.part == u8::MAX {
            let r = ((x - cx).powi(2) + (y - cy).powi(2)).sqrt();
            alpha *= spread * (1.0 - smoothstep(0.5 * reach, reach, r));
        }
        if alpha > 0.004 {
            t.lay(&matt(powder, 0.95), alpha.min(0.9));
        }
    });
}

fn web(canvas: &mut Canvas, level: f32, rng: &mut Pcg64Mcg) {
    let half = canvas.half_mm();
    let size = canvas.size;
    let texel_mm = canvas.texel_mm;
    let [cx, cy] = canvas.center;
    let top = canvas
        .texels
        .iter()
        .filter(|t| t.solid)
        .map(|t| t.height)
        .fold(0.0, f32::max);
    let tone = between(rng, 0.55, 0.95);
    let silk = matt([tone, tone, tone * between(rng, 0.85, 1.0)], between(rng, 0.4, 0.9));
    let count = 2 + (level * level * between(rng, 20.0, 80.0) + 6.0 * level) as usize;
    let strand = |canvas: &mut Canvas, from: [f32; 2], to: [f32; 2], sag: [f32; 2], width: f32, strength: f32| {
        let length = ((to[0] - from[0]).powi(2) + (to[1] - from[1]).powi(2)).sqrt();
        let steps = (length / (0.7 * texel_mm)).ceil().max(1.0) as usize;
        for i in 0..=steps {
            let s = i as f32 / steps as f32;
            let bow = 4.0 * s * (1.0 - s);
            let x = from[0] + s * (to[0] - from[0]) + bow * sag[0];
            let y = from[1] + s * (to[1] - from[1]) + bow * sag[1];
            let (gx, gy) = ((x + half) / texel_mm + 0.5, (y + half) / texel_mm + 0.5);
            if gx < 0.0 || gy < 0.0 || gx >= size as f32 || gy >= size as f32 {
                continue;
            }
            // Strands end at the grid's border: let them thin out before it shows.
            let away = (x * x + y * y).sqrt() / half;
            let alpha = strength * (width / texel_mm).min(1.0) * (1.0 - smoothstep(0.6, 0.96, away));
            if alpha <= 0.0 {
                continue;
            }
            let r = ((x - cx).powi(2) + (y - cy).powi(2)).sqrt();
            let t: &mut Texel = &mut canvas.texels[gy as usize * size + gx as usize];
            let lying = (top + 0.05) * (1.0 - smoothstep(0.5, 1.0, r / half));
            if t.recess > 0.0 && lying > t.height {
                t.height += alpha * (lying - t.height);
            }
            t.open = t.open.max(0.6 * alpha);
            t.hidden = t.hidden.max(alpha);
            t.lay(&silk, alpha);
        }
    };
    for _ in 0..count {
        let angle = between(rng, 0.0, TAU);
        let (sin, cos) = angle.sin_cos();
        let aside = half * between(rng, -0.75, 0.75);
        let reach = half * between(rng, 0.7, 1.4);
        let back = half * between(rng, 0.4, 1.4);
        let from = [cx - sin * aside - cos * back, cy + cos * aside - sin * back];
        let to = [cx - sin * aside + cos * reach, cy + cos * aside + sin * reach];
        let bow = between(rng, -0.12, 0.12) * half;
        let width = between(rng, 0.015, 0.09);
        let strength = between(rng, 0.35, 0.95);
        strand(canvas, from, to, [-sin * bow, cos * bow], width, strength);
    }
    if level > 0.45 {
        // Old webs mat into gauze.
        let gauze = Noise::new(Grain::Vein, 1.2, rng);
        let where_mm = Noise::new(Grain::Cloud, canvas.radius * 1.6, rng);
        let most = (level - 0.45) * between(rng, 0.4, 1.3);
        canvas.each(|x, y, t| {
            let away = (x * x + y * y).sqrt() / half;
            let alpha = most
                * smoothstep(0.3, 0.8, where_mm.at(x, y))
                * (0.3 + 0.7 * gauze.at(x, y))
                * (1.0 - smoothstep(0.4, 0.92, away));
            if alpha > 0.004 {
                t.hidden = t.hidden.max(alpha);
                t.open = t.open.max(0.6 * alpha);
                t.lay(&silk, alpha.min(0.9));
            }
        });
    }
}
