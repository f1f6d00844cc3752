//! Screws with a cross recess.

use super::head::{head_shape, marks};
use super::{Form, Spot, between, grey, matt, plating, seat, washer_plating};
use crate::bake::SheetFinish;
use crate::fastener::{CrossRecess, Head, Item};
use crate::noise::{Grain, Noise, smoothstep};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f32::consts::PI;

/// Cross recess: depth below the rim over its own axes.
pub(super) struct Cross {
    half: f32,
    wing: f32,
    taper: f32,
    fillet: f32,
    depth: f32,
    side: f32,
    floor: f32,
    core: f32,
    slot: Option<[f32; 3]>,
    worn: f32,
    ragged: Noise,
    twist: f32,
}

impl Cross {
    fn new(kind: CrossRecess, width: f32, head_radius: f32, head_height: f32, worn: f32, rng: &mut Pcg64Mcg) -> Cross {
        let half = 0.5 * width;
        let jis = kind == CrossRecess::Jis;
        let wing = half
            * if jis {
                between(rng, 0.17, 0.25)
            } else {
                between(rng, 0.19, 0.3)
            };
        let depth = (half * between(rng, 0.85, 1.25)).min(head_height * 0.85 + 0.5).max(0.7);
        let slot = (kind == CrossRecess::Combination).then(|| {
            [
                head_radius * between(rng, 0.72, 1.05),
                between(rng, 0.35, 0.6),
                between(rng, 0.6, 1.1),
            ]
        });
        Cross {
            half,
            wing: wing * (1.0 + 0.25 * worn),
            taper: if jis {
                between(rng, 0.0, 0.2)
            } else {
                between(rng, 0.1, 0.55)
            },
            fillet: if jis {
                between(rng, 0.04, 0.12)
            } else {
                between(rng, 0.15, 0.4)
            } + 0.4 * worn,
            depth: depth * (1.0 - 0.3 * worn),
            side: 7.0 - 4.8 * worn.sqrt(),
            floor: between(rng, 1.4, 2.3),
            core: half * (between(rng, 0.26, 0.4) + 0.38 * worn),
            slot,
            worn,
            ragged: Noise::new(Grain::Cloud, 1.8, rng),
            twist: if rng.random_bool(0.8) { 0.5 * worn } else { -0.5 * worn },
        }
    }

    /// Depth and burr at a place of the recess' own plane.
    fn at(&self, u: f32, v: f32) -> (f32, f32) {
        let r = (u * u + v * v).sqrt();
        let outer = self.slot.map_or(self.half, |slot| slot[0].max(self.half)) + 0.8;
        if r > outer {
            return (0.0, 0.0);
        }
        let wing = |s: f32, t: f32| {
            let half_width = self.wing * (1.0 + self.taper * (1.0 - s / self.half));
            (t - half_width).max(s - self.half)
        };
        let (a, b) = (u.abs(), v.abs());
        let (d1, d2) = (wing(a, b), wing(b, a));
        // Smooth union of the two arms: the fillet at the roots.
        let k = self.fillet.max(0.02);
        let h = (0.5 + 0.5 * (d2 - d1) / k).clamp(0.0, 1.0);
        let mut inside = d2 + h * (d1 - d2) - k * h * (1.0 - h);
        inside = inside.min(r - self.core);
        let mut burr = 0.0;
        if self.worn > 0.02 {
            // A slipping bit tears one flank of every wing, at its edge more than at its root.
            let quadrant = (u * v).signum() * if a > b { 1.0 } else { -1.0 };
            let rough = self.ragged.at(u, v) - 0.35;
            let flank = 0.5 + 0.5 * quadrant * self.twist.signum();
            inside -= self.worn * self.half * (0.16 * flank + 0.22 * rough);
            let edge = inside / 0.22;
            burr = (self.worn * 1.6).min(1.0) * (-edge * edge).exp() * smoothstep(-0.1, 0.35, rough);
        }
        let floor = ((self.half - r) * self.floor + 0.55).clamp(0.1, self.depth) + (0.5 * (self.core - r)).max(0.0);
        let mut depth = (-inside * self.side).min(floor).max(0.0);
        if let Some([length, half_width, slot_depth]) = self.slot {
            let flank = ((half_width - b) * 6.0).min((length - a) * 4.0);
            depth = depth.max(flank.min(slot_depth).max(0.0));
        }
        (depth, burr)
    }
}

pub(super) fn screw(
    item: &Item,
    head: Head,
    recess: CrossRecess,
    width: f32,
    sheet: &SheetFinish,
    rng: &mut Pcg64Mcg,
) -> Form {
    let radius = 0.5 * item.diameter_mm as f32;
    let main = plating(item.plating, sheet, rng);
    let foot = seat(radius, rng);
    let shape = head_shape(head, radius, rng);
    let cross = Cross::new(
        recess,
        width,
        shape.top_radius,
        shape.profile.height,
        item.wear.worn_slot,
        rng,
    );
    let [ox, oy] = item.recess_offset_mm.map(|v| v as f32);
    let relief = marks(radius, rng);
    // The dimple that tells JIS, opposite a quadrant, when there is one.
    let dimple = (recess == CrossRecess::Jis && rng.random_bool(0.5)).then(|| {
        let angle = PI / 4.0 + PI / 2.0 * rng.random_range(0..4) as f32;
        let at = shape.top_radius * between(rng, 0.55, 0.72);
        (at * angle.cos(), at * angle.sin(), between(rng, 0.25, 0.45))
    });
    let top = shape.top(0.0, 0.0).map_or(1.0, |s| s.0);
    let base = foot(0.0);
    let swell = between(rng, 0.0, 0.05);
    // The rim of the recess lies where the wings end, a little below a dome's top.
    let rim_mm = base + shape.top(ox + 0.35 * width, oy).map_or(top, |s| s.0);
    let washer = washer_plating(main, sheet, rng);
    Form {
        materials: vec![main, washer, matt(grey(0.02), 0.8)],
        rim_mm,
        reach_mm: 2.2 * radius,
        corrodes: 1.0,
        surface: Box::new(move |u, v| {
            let Some((height, part)) = shape.top(u, v) else {
                return Spot::sheet(foot((u * u + v * v).sqrt()));
            };
            let (depth, burr) = cross.at(u - ox, v - oy);
            let mut spot = Spot::body(base + height + relief(u, v), part);
            if let Some((du, dv, size)) = dimple {
                let t = ((u - du).powi(2) + (v - dv).powi(2)) / (size * size);
                spot.height -= 0.6 * size * (1.0 - t).max(0.0).sqrt();
            }
            if depth > 0.0 {
                // The floor is measured from the rim's plane, so a dome does not lift it.
                spot.height = spot.height.min(rim_mm - depth).max(base - 1.5);
                spot.recess = depth;
            } else if swell > 0.0 {
                spot.height += swell * burr;
            }
            spot.height += 0.12 * burr;
            spot.burr = burr;
            spot
        }),
    }
}
