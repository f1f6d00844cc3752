//! From what an item is to what it looks like: geometry, surface and wear on one grid.

use crate::fastener::{Decoy, Item, Kind};
use crate::form;
use crate::relief::{Material, Relief};
use crate::wear;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

/// The sheet under an item.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SheetFinish {
    /// Base colour, linear RGB.
    pub albedo: [f32; 3],
    /// Microfacet roughness.
    pub roughness: f32,
    /// 0 painted, 1 bare metal.
    pub metallic: f32,
}

/// One cell of the grid while it is made.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Texel {
    pub height: f32,
    pub material: Material,
    pub cover: f32,
    pub solid: bool,
    /// Part of the form (`u8::MAX`: sheet).
    pub part: u8,
    /// Depth of the clean recess, mm.
    pub recess: f32,
    /// How much of that depth is filled, mm.
    pub filled: f32,
    /// Opaque lumps over it, 0 to 1.
    pub lump: f32,
    /// Hidden by strands, 0 to 1.
    pub hidden: f32,
    /// Bright torn metal, 0 to 1.
    pub burr: f32,
    /// Share of the surroundings it sees.
    pub open: f32,
}

impl Texel {
    /// Lays a material over what is there.
    #[inline]
    pub fn lay(&mut self, material: &Material, alpha: f32) {
        let alpha = alpha.clamp(0.0, 1.0);
        let cover = alpha + self.cover * (1.0 - alpha);
        if cover < 1e-4 {
            return;
        }
        let t = alpha / cover;
        let under = &mut self.material;
        for (a, b) in under.albedo.iter_mut().zip(material.albedo) {
            *a += t * (b - *a);
        }
        under.roughness += t * (material.roughness - under.roughness);
        under.metallic += t * (material.metallic - under.metallic);
        self.cover = cover;
    }
}

/// The grid while it is made.
pub(crate) struct Canvas {
    pub size: usize,
    pub texel_mm: f32,
    /// Radius of the item, mm.
    pub radius: f32,
    /// Where the item's axis meets its rim plane, mm.
    pub center: [f32; 2],
    pub texels: Vec<Texel>,
}

impl Canvas {
    pub fn half_mm(&self) -> f32 {
        0.5 * self.texel_mm * (self.size - 1) as f32
    }

    /// Calls `f` with the place (mm) of every texel within the grid's inner circle: beyond it everything has faded.
    pub fn each(&mut self, mut f: impl FnMut(f32, f32, &mut Texel)) {
        let half = self.half_mm();
        for (row, line) in self.texels.chunks_exact_mut(self.size).enumerate() {
            let y = row as f32 * self.texel_mm - half;
            let chord = (half * half - y * y).max(0.0).sqrt();
            let first = ((half - chord) / self.texel_mm) as usize;
            let end = line.len() - first;
            for (column, texel) in line.iter_mut().enumerate().take(end).skip(first) {
                f(column as f32 * self.texel_mm - half, y, texel);
            }
        }
    }

    /// One pass of a 3 x 3 binomial filter over the heights, `amount` of it, where `keep` holds.
    pub fn smooth(&mut self, amount: f32, keep: impl Fn(&Texel) -> bool) {
        let size = self.size;
        let before: Vec<f32> = self.texels.iter().map(|t| t.height).collect();
        for row in 1..size - 1 {
            for i in row * size + 1..(row + 1) * size - 1 {
                if !keep(&self.texels[i]) {
                    continue;
                }
                let line = |j: usize| before[j - 1] + 2.0 * before[j] + before[j + 1];
                let mean = (line(i - size) + 2.0 * line(i) + line(i + size)) / 16.0;
                self.texels[i].height += amount * (mean - self.texels[i].height);
            }
        }
    }

    /// Ambient occlusion from the horizon in eight directions, on every second texel.
    fn occlude(&mut self) {
        const REACH: [f32; 6] = [1.0, 2.0, 3.5, 6.0, 10.0, 16.0];
        const MARGIN: usize = 17;
        let coarse = self.size.div_ceil(2);
        let step_mm = 2.0 * self.texel_mm;
        // A margin of bare sheet spares every bounds check in the loop.
        let padded = coarse + 2 * MARGIN;
        let mut heights = vec![0.0_f32; padded * padded];
        for row in 0..coarse {
            for column in 0..coarse {
                heights[(row + MARGIN) * padded + column + MARGIN] =
                    self.texels[2 * row * self.size + 2 * column].height;
            }
        }
        let mut looks = [[(0_isize, 0.0_f32); REACH.len()]; 8];
        for (k, direction) in looks.iter_mut().enumerate() {
            let (sin, cos) = (k as f32 * std::f32::consts::FRAC_PI_4).sin_cos();
            for (look, reach) in direction.iter_mut().zip(REACH) {
                let (dx, dy) = ((cos * reach).round(), (sin * reach).round());
                let distance = (dx * dx + dy * dy).sqrt().max(1.0) * step_mm;
                *look = (dy as isize * padded as isize + dx as isize, 1.0 / distance);
            }
        }
        let mut open = vec![1.0_f32; coarse * coarse];
        for row in 0..coarse {
            for column in 0..coarse {
                let at = (row + MARGIN) * padded + column + MARGIN;
                let here = heights[at];
                let mut sum = 0.0;
                for direction in &looks {
                    let mut slope = 0.0_f32;
                    for &(offset, inverse) in direction {
                        slope = slope.max((heights[at.wrapping_add_signed(offset)] - here) * inverse);
                    }
                    sum += 1.0 / (1.0 + slope * slope);
                }
                open[row * coarse + column] = sum / looks.len() as f32;
            }
        }
        let last = coarse - 1;
        for (row, line) in self.texels.chunks_exact_mut(self.size).enumerate() {
            let (y0, y1) = (row / 2 * coarse, row.div_ceil(2).min(last) * coarse);
            for (column, texel) in line.iter_mut().enumerate() {
                let (x0, x1) = (column / 2, column.div_ceil(2).min(last));
                texel.open = 0.25 * (open[y0 + x0] + open[y0 + x1] + open[y1 + x0] + open[y1 + x1]);
            }
        }
    }
}

/// Whether an item is a body of its own that can be askew or stand off.
fn is_body(kind: Kind) -> bool {
    match kind {
        Kind::Screw { .. } => true,
        Kind::Decoy(decoy) => decoy.drive().is_some() || matches!(decoy, Decoy::Rivet | Decoy::PlasticCap),
    }
}

/// Height and material of an item on the sheet it sits in; the same for the same arguments.
///
/// The grid reaches 2.4 radii from the item's place: its seat, the grime and the rust that bleeds from it are inside, and both
/// heights and cover fade to nothing toward the border.
pub fn bake(item: &Item, sheet: &SheetFinish) -> Relief {
    let mut rng = Pcg64Mcg::seed_from_u64(item.seed ^ 0x5eed_cafe);
    let radius = (0.5 * item.diameter_mm as f32).max(0.5);
    let texel_mm = (radius / 40.0).clamp(0.07, 0.13);
    let size = ((4.8 * radius / texel_mm) as usize).clamp(48, 320);
    let form = form::build(item, sheet, &mut rng);

    let body = is_body(item.kind);
    let tilt = if body { item.tilt_rad as f32 } else { 0.0 };
    let (lean_y, lean_x) = (item.tilt_direction_rad as f32).sin_cos();
    let slope = tilt.tan();
    // A head seated askew stands on its low edge.
    let lift = if body {
        item.lift_mm as f32 + 0.5 * radius * slope.abs()
    } else {
        0.0
    };
    let center = [form.rim_mm * tilt.sin() * lean_x, form.rim_mm * tilt.sin() * lean_y];
    let (sin, cos) = (item.rotation_rad as f32).sin_cos();
    let turned = |x: f32, y: f32| (cos * x + sin * y, -sin * x + cos * y);

    let blank = Texel {
        height: 0.0,
        material: Material {
            albedo: sheet.albedo,
            roughness: sheet.roughness,
            metallic: sheet.metallic,
        },
        cover: 0.0,
        solid: false,
        part: u8::MAX,
        recess: 0.0,
        filled: 0.0,
        lump: 0.0,
        hidden: 0.0,
        burr: 0.0,
        open: 1.0,
    };
    let mut canvas = Canvas {
        size,
        texel_mm,
        radius,
        center,
        texels: vec![blank; size * size],
    };
    let reach = form.reach_mm * form.reach_mm;
    let moved = center != [0.0; 2];
    canvas.each(|x, y, texel| {
        if x * x + y * y > reach {
            return;
        }
        let (u, v) = turned(x - center[0], y - center[1]);
        let mut spot = (form.surface)(u, v);
        if !spot.solid && moved {
            let (u, v) = turned(x, y);
            spot = (form.surface)(u, v);
            if spot.solid {
                // What the tilted head no longer covers.
                spot = (form.surface)(form.reach_mm, 0.0);
            }
        }
        texel.height = spot.height;
        if spot.solid {
            let fall = slope * ((x - center[0]) * lean_x + (y - center[1]) * lean_y);
            texel.height = (spot.height + lift - fall).max(if spot.recess > 0.0 { -9.0 } else { 0.03 });
        }
        texel.solid = spot.solid;
        texel.recess = spot.recess;
        texel.burr = spot.burr;
        if let Some(part) = spot.part {
            texel.part = part;
            texel.material = form.materials[part as usize];
            texel.cover = 1.0;
        }
    });

    wear::reshape(&mut canvas, item, &form, &mut rng);
    canvas.smooth(0.7, |t| t.part != u8::MAX);
    canvas.occlude();
    wear::colour(&mut canvas, item, sheet, &form, &mut rng);
    let sums = wear::Sums::of(&canvas);

    let offset = match item.kind {
        Kind::Screw { .. } => item.recess_offset_mm.map(|v| v as f32),
        Kind::Decoy(_) => [0.0; 2],
    };
    let (ox, oy) = (cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1]);
    let rim_center_mm = [
        center[0] + ox,
        center[1] + oy,
        form.rim_mm + lift - slope * (ox * lean_x + oy * lean_y),
    ];
    finish(
        canvas,
        Seat {
            rim_center_mm,
            axis: [tilt.sin() * lean_x, tilt.sin() * lean_y, tilt.cos()],
            rim_height_mm: form.rim_mm + lift,
        },
        sums,
    )
}

/// Where the item ended up.
struct Seat {
    rim_center_mm: [f32; 3],
    axis: [f32; 3],
    rim_height_mm: f32,
}

/// Fades the border, lets light bounce in hollows, and splits the texels into the planes the renderer reads.
fn finish(mut canvas: Canvas, seat: Seat, sums: wear::Sums) -> Relief {
    let half = canvas.half_mm();
    canvas.each(|x, y, texel| {
        let r = (x * x + y * y).sqrt() / half;
        let fade = 1.0 - crate::noise::smoothstep(0.84, 0.985, r);
        texel.height *= fade;
        texel.cover *= fade;
        let m = &texel.material;
        let mean = (m.albedo[0] + m.albedo[1] + m.albedo[2]) / 3.0;
        // Light that bounces between the walls of a hollow comes out weakened by every bounce.
        texel.open = (texel.open / (1.0 - 0.5 * mean * (1.0 - texel.open))).clamp(0.0, 1.0);
    });
    let heights = canvas.texels.iter().map(|t| t.height);
    Relief {
        size: canvas.size,
        texel_mm: canvas.texel_mm,
        top_mm: heights.clone().fold(0.0, f32::max),
        bottom_mm: heights.clone().fold(0.0, f32::min),
        height_mm: heights.collect(),
        material: canvas.texels.iter().map(|t| t.material).collect(),
        cover: canvas.texels.iter().map(|t| t.cover).collect(),
        solid: canvas.texels.iter().map(|t| t.solid).collect(),
        open: canvas.texels.iter().map(|t| t.open).collect(),
        rim_height_mm: seat.rim_height_mm,
        rim_center_mm: seat.rim_center_mm,
        axis: seat.axis,
        slot_fill: sums.slot_fill,
        head_cover: sums.head_cover,
        slot_visible: sums.slot_visible,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fastener::{CrossRecess, Head, Plating, Wear};

    const SHEET: SheetFinish = SheetFinish {
        albedo: [0.5, 0.5, 0.45],
        roughness: 0.5,
        metallic: 0.0,
    };

    fn screw(seed: u64) -> Item {
        Item {
            kind: Kind::Screw {
                head: Head::Pan,
                recess: CrossRecess::Phillips,
                recess_width_mm: 4.6,
            },
            diameter_mm: 8.0,
            rotation_rad: 0.0,
            tilt_rad: 0.0,
            tilt_direction_rad: 0.0,
            lift_mm: 0.0,
            recess_offset_mm: [0.25, -0.125],
            plating: Plating::Zinc,
            wear: Wear::default(),
            seed,
        }
    }

    #[test]
    fn the_same_item_bakes_the_same() {
        let mut item = screw(3);
        item.wear = Wear {
            rust: 0.6,
            web: 0.7,
            mud_in_slot: 0.4,
            bent_head: 0.5,
            ..Wear::default()
        };
        assert_eq!(bake(&item, &SHEET), bake(&item, &SHEET));
        assert_ne!(
            bake(&item, &SHEET),
            bake(
                &Item {
                    seed: 4,
                    ..item.clone()
                },
                &SHEET
            )
        );
    }

    #[test]
    fn height_and_cover_fade_at_the_border_for_every_kind() {
        let mut kinds: Vec<Kind> = Decoy::ALL.iter().map(|&d| Kind::Decoy(d)).collect();
        for head in [Head::Pan, Head::Truss, Head::Binding, Head::Washer, Head::HexFlange] {
            for recess in [CrossRecess::Jis, CrossRecess::Phillips, CrossRecess::Combination] {
                kinds.push(Kind::Screw {
                    head,
                    recess,
                    recess_width_mm: 4.5,
                });
            }
        }
        for (seed, kind) in kinds.into_iter().enumerate() {
            let mut item = screw(seed as u64);
            item.kind = kind;
            item.diameter_mm = 7.0 + 0.2 * seed as f64;
            item.wear = Wear {
                rust: 0.9,
                white_rust: 0.5,
                dirt: 1.0,
                dust: 1.0,
                web: 1.0,
                worn_slot: 0.8,
                bent_head: 0.7,
                chipped: 0.5,
                paint_over: 0.3,
                mud_in_slot: 0.6,
            };
            let relief = bake(&item, &SHEET);
            let n = relief.size;
            for i in 0..n {
                for j in [i, (n - 1) * n + i, i * n, i * n + n - 1] {
                    assert!(relief.cover[j] < 1e-3, "{kind:?} covers its border");
                    assert!(relief.height_mm[j].abs() < 1e-3, "{kind:?} is high at its border");
                }
            }
            let sane = |v: &f32| v.is_finite();
            assert!(relief.height_mm.iter().all(sane) && relief.open.iter().all(sane));
            for m in &relief.material {
                assert!(m.albedo.iter().all(|a| (0.0..=1.0).contains(a)), "{kind:?}: {m:?}");
                assert!((0.05..=1.0).contains(&m.roughness), "{kind:?}: {m:?}");
            }
            for share in [relief.slot_fill, relief.head_cover, relief.slot_visible] {
                assert!((0.0..=1.0).contains(&share), "{kind:?}: {share}");
            }
        }
    }

    #[test]
    fn the_rim_centre_is_where_the_recess_was_put() {
        let relief = bake(&screw(1), &SHEET);
        assert_eq!(relief.rim_center_mm[..2], [0.25, -0.125]);
        assert_eq!(relief.axis, [0.0, 0.0, 1.0]);
        // Turned by a quarter, the offset turns along: x to y (down).
        let mut item = screw(1);
        item.rotation_rad = std::f64::consts::FRAC_PI_2;
        let turned = bake(&item, &SHEET).rim_center_mm;
        assert!(
            (turned[0] - 0.125).abs() < 1e-4 && (turned[1] - 0.25).abs() < 1e-4,
            "{turned:?}"
        );
    }

    /// Centre of the recess' opening, from the heights alone.
    fn opening(relief: &Relief) -> [f32; 2] {
        let (mut x, mut y, mut count) = (0.0, 0.0, 0.0_f32);
        let half = relief.half_mm();
        for (i, &height) in relief.height_mm.iter().enumerate() {
            let px = (i % relief.size) as f32 * relief.texel_mm - half;
            let py = (i / relief.size) as f32 * relief.texel_mm - half;
            let [cx, cy, rim] = relief.rim_center_mm;
            let plane = rim - ((px - cx) * relief.axis[0] + (py - cy) * relief.axis[1]) / relief.axis[2];
            let near = (px - cx).hypot(py - cy) < 2.5;
            if near && relief.solid[i] && height < plane - 0.4 {
                (x, y, count) = (x + px, y + py, count + 1.0);
            }
        }
        [x / count, y / count]
    }

    #[test]
    fn the_rim_centre_of_a_leaning_head_is_the_middle_of_what_shows() {
        for seed in 0..8 {
            let mut item = screw(seed);
            item.tilt_rad = 0.12;
            item.tilt_direction_rad = seed as f64;
            item.lift_mm = 0.5;
            let relief = bake(&item, &SHEET);
            let [x, y] = opening(&relief);
            let [cx, cy, _] = relief.rim_center_mm;
            assert!(
                (x - cx).hypot(y - cy) < 0.12,
                "seed {seed}: {x} {y} {:?}",
                relief.rim_center_mm
            );
        }
    }

    #[test]
    fn mud_fills_the_slot_and_paint_softens_it() {
        let fill = |mud: f32| {
            let mut item = screw(9);
            item.wear.mud_in_slot = mud;
            bake(&item, &SHEET)
        };
        let levels: Vec<Relief> = [0.0, 0.3, 0.6, 0.9].map(fill).into();
        assert_eq!(levels[0].slot_fill, 0.0);
        for pair in levels.windows(2) {
            assert!(pair[1].slot_fill > pair[0].slot_fill + 0.05);
        }
        assert!(levels[3].slot_fill > 0.7 && levels[0].slot_visible > 0.99);
        assert!(levels[3].slot_visible < levels[1].slot_visible);
    }

    #[test]
    fn the_wings_of_a_clean_cross_are_darker_than_the_head_between_them() {
        let flat = crate::shade::Lighting::overcast();
        for seed in 0..10 {
            let mut item = screw(seed);
            item.recess_offset_mm = [0.0; 2];
            let relief = bake(&item, &SHEET);
            let brightness = |angle: f32, r: f32| {
                let (x, y) = (r * angle.cos(), r * angle.sin());
                let (material, _) = relief.material(x, y);
                let point = [x, y, relief.height(x, y)];
                let open = relief.open(x, y);
                flat.radiance(&material, relief.normal(x, y), [0.0, 0.0, 1.0], &[], open, point)[1]
            };
            for quarter in 0..4 {
                let wing = quarter as f32 * std::f32::consts::FRAC_PI_2;
                let between = brightness(wing + std::f32::consts::FRAC_PI_4, 1.7);
                let share = brightness(wing, 1.1) / between;
                assert!(share < 0.75, "seed {seed}, wing {quarter}: {share}");
            }
        }
    }
}
