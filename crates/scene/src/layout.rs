//! How a unit is drawn: sheets, screws and decoys of every face from one seed.

use crate::fastener::{CrossRecess, Decoy, Head, Item, Kind, Plating, Wear};
use crate::layer::{Bump, Layer, Sheetwork, Tube, segment_foot};
use crate::noise::{Grain, Noise};
use crate::paint::{Coat, Decal, Paint};
use crate::print::Print;
use crate::product::{Cover, CoverId, Exclusion, FaceDesign, FaceId, Placed, Screw, ScrewId, Theme, Unit, UnitOptions};
use crate::shape::{Bounds, Shape, Xy};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::TAU;
use std::sync::Arc;

type Rng = Pcg64Mcg;

/// What all faces of a unit share: colours, the kind of screws it was built with, what it has been through.
struct Style {
    panel: [f32; 3],
    trim: [f32; 3],
    roughness: f32,
    theme: Theme,
    /// Factor on wear.
    scale: f32,
    head: Head,
    recess: CrossRecess,
    plating: Plating,
    diameter_mm: f64,
    mud: [f32; 3],
    /// Grime and rust of its sheets, 0 to 1.
    dirt: f32,
    rust: f32,
    seats: bool,
    model: String,
}

const PANELS: [[f32; 3]; 12] = [
    [0.70, 0.66, 0.54],
    [0.66, 0.60, 0.46],
    [0.60, 0.53, 0.40],
    [0.73, 0.71, 0.64],
    [0.78, 0.78, 0.75],
    [0.55, 0.56, 0.54],
    [0.40, 0.41, 0.41],
    [0.24, 0.25, 0.26],
    [0.055, 0.055, 0.06],
    [0.26, 0.20, 0.145],
    [0.42, 0.47, 0.42],
    [0.36, 0.42, 0.50],
];

fn pick<T: Copy>(rng: &mut Rng, from: &[T]) -> T {
    from[rng.random_range(0..from.len())]
}

fn varied(color: [f32; 3], by: f32, rng: &mut Rng) -> [f32; 3] {
    let all = 1.0 + rng.random_range(-by..by);
    color.map(|c| (c * all * (1.0 + rng.random_range(-0.2..0.2) * by)).clamp(0.02, 0.88))
}

impl Style {
    fn sample(options: &UnitOptions, rng: &mut Rng) -> Self {
        let theme = match rng.random_range(0..100) {
            0..22 => Theme::Clean,
            22..42 => Theme::Dusty,
            42..60 => Theme::Coastal,
            60..70 => Theme::Muddy,
            70..78 => Theme::Repainted,
            78..92 => Theme::Chalky,
            _ => Theme::Greasy,
        };
        let panel_choice = if rng.random_bool(0.72) {
            rng.random_range(0..6)
        } else {
            rng.random_range(0..PANELS.len())
        };
        let panel = varied(PANELS[panel_choice], 0.12, rng);
        let trim = if rng.random_bool(0.6) {
            panel
        } else {
            varied(pick(rng, &PANELS), 0.1, rng)
        };
        let (dirt, rust) = match theme {
            Theme::Clean => (rng.random_range(0.03..0.2), rng.random_range(0.0..0.06)),
            Theme::Dusty => (rng.random_range(0.35..0.85), rng.random_range(0.0..0.25)),
            Theme::Coastal => (rng.random_range(0.15..0.5), rng.random_range(0.3..1.0)),
            Theme::Muddy => (rng.random_range(0.5..1.0), rng.random_range(0.05..0.4)),
            Theme::Repainted => (rng.random_range(0.1..0.4), rng.random_range(0.0..0.3)),
            Theme::Chalky => (rng.random_range(0.2..0.5), rng.random_range(0.05..0.3)),
            Theme::Greasy => (rng.random_range(0.6..1.0), rng.random_range(0.0..0.2)),
        };
        Self {
            panel,
            trim,
            roughness: if theme == Theme::Chalky {
                rng.random_range(0.65..0.9)
            } else {
                rng.random_range(0.28..0.65)
            },
            theme,
            scale: options.wear,
            head: pick(
                rng,
                &[
                    Head::Pan,
                    Head::Pan,
                    Head::Truss,
                    Head::Binding,
                    Head::Washer,
                    Head::HexFlange,
                ],
            ),
            recess: pick(
                rng,
                &[
                    CrossRecess::Jis,
                    CrossRecess::Phillips,
                    CrossRecess::Phillips,
                    CrossRecess::Combination,
                ],
            ),
            plating: pick(
                rng,
                &[
                    Plating::Zinc,
                    Plating::DullZinc,
                    Plating::DullZinc,
                    Plating::Chromate,
                    Plating::BlackOxide,
                    Plating::Stainless,
                    Plating::Nickel,
                    Plating::Painted,
                    Plating::Bronze,
                ],
            ),
            diameter_mm: rng.random_range(7.6..11.2),
            mud: match theme {
                Theme::Greasy => [0.05, 0.04, 0.03],
                Theme::Muddy => [0.2, 0.145, 0.095],
                _ => varied([0.15, 0.13, 0.105], 0.3, rng),
            },
            dirt: (dirt * options.wear).min(1.0),
            rust: (rust * options.wear).min(1.0),
            seats: rng.random_bool(0.55),
            model: format!(
                "{}-{}{}",
                pick(rng, &["RAS", "CU", "AOU", "MUZ", "SRC", "AO"]),
                rng.random_range(18..80) * 10,
                pick(rng, &["A", "D", "SX", "GE", "K", "VX"])
            ),
        }
    }

    fn paint(&self, rng: &mut Rng) -> Paint {
        Paint::new(Coat::Painted, varied(self.panel, 0.015, rng), self.roughness, rng)
            .worn(self.dirt, self.mud, self.rust, rng)
    }

    fn trim(&self, rng: &mut Rng) -> Paint {
        Paint::new(Coat::Painted, varied(self.trim, 0.02, rng), self.roughness, rng)
            .worn(self.dirt, self.mud, self.rust, rng)
    }

    fn zinc(&self, rng: &mut Rng) -> Paint {
        Paint::new(
            Coat::Zinc,
            varied([0.62, 0.64, 0.66], 0.1, rng),
            rng.random_range(0.35..0.6),
            rng,
        )
        .worn((self.dirt + 0.1).min(1.0), self.mud, (1.4 * self.rust).min(1.0), rng)
    }

    fn plastic(&self, albedo: [f32; 3], rng: &mut Rng) -> Paint {
        Paint::new(Coat::Plastic, albedo, rng.random_range(0.4..0.75), rng).worn(self.dirt, self.mud, 0.0, rng)
    }

    /// Wear of one item: the unit's theme, varied from one to the next.
    fn wear(&self, rng: &mut Rng) -> Wear {
        let mut level = |mean: f32, chance: f64| -> f32 {
            if !rng.random_bool(chance) {
                return 0.0;
            }
            let spread = (rng.random::<f32>() + rng.random::<f32>() + rng.random::<f32>()) / 1.5 - 1.0;
            (mean * self.scale * (0.9 * spread).exp()).clamp(0.0, 1.0)
        };
        // (rust, white rust, dirt, dust, mud, paint): mean and how many have it at all
        let t = match self.theme {
            Theme::Clean => [
                (0.08, 0.25),
                (0.08, 0.2),
                (0.1, 0.4),
                (0.12, 0.5),
                (0.05, 0.05),
                (0.0, 0.0),
            ],
            Theme::Dusty => [
                (0.15, 0.35),
                (0.15, 0.3),
                (0.35, 0.8),
                (0.5, 0.9),
                (0.2, 0.3),
                (0.0, 0.0),
            ],
            Theme::Coastal => [
                (0.55, 0.9),
                (0.35, 0.5),
                (0.25, 0.6),
                (0.15, 0.4),
                (0.15, 0.2),
                (0.0, 0.0),
            ],
            Theme::Muddy => [
                (0.25, 0.5),
                (0.15, 0.3),
                (0.5, 0.9),
                (0.35, 0.6),
                (0.35, 0.65),
                (0.0, 0.0),
            ],
            Theme::Repainted => [
                (0.15, 0.3),
                (0.1, 0.2),
                (0.15, 0.5),
                (0.15, 0.5),
                (0.1, 0.15),
                (0.45, 0.75),
            ],
            Theme::Chalky => [
                (0.15, 0.4),
                (0.5, 0.85),
                (0.2, 0.5),
                (0.35, 0.7),
                (0.1, 0.15),
                (0.0, 0.0),
            ],
            Theme::Greasy => [(0.1, 0.3), (0.1, 0.2), (0.6, 0.95), (0.2, 0.4), (0.35, 0.6), (0.0, 0.0)],
        };
        Wear {
            rust: level(t[0].0, t[0].1),
            white_rust: level(t[1].0, t[1].1),
            dirt: level(t[2].0, t[2].1),
            dust: level(t[3].0, t[3].1),
            mud_in_slot: level(t[4].0, t[4].1).min(0.72),
            paint_over: level(t[5].0, t[5].1).min(0.75),
            worn_slot: level(0.3, 0.16),
            bent_head: level(0.25, 0.08),
            web: level(0.25, 0.07).min(0.55),
            chipped: level(0.3, 0.3),
        }
    }

    fn screw(&self, rng: &mut Rng) -> Item {
        let odd = rng.random_bool(0.22);
        let (head, recess, plating) = if odd {
            (
                pick(
                    rng,
                    &[Head::Pan, Head::Truss, Head::Binding, Head::Washer, Head::HexFlange],
                ),
                pick(
                    rng,
                    &[CrossRecess::Jis, CrossRecess::Phillips, CrossRecess::Combination],
                ),
                pick(
                    rng,
                    &[
                        Plating::Zinc,
                        Plating::DullZinc,
                        Plating::Chromate,
                        Plating::BlackOxide,
                        Plating::Stainless,
                        Plating::Nickel,
                        Plating::Bronze,
                        Plating::Painted,
                    ],
                ),
            )
        } else {
            (self.head, self.recess, self.plating)
        };
        let base = if odd {
            rng.random_range(7.0..12.0)
        } else {
            self.diameter_mm
        };
        let wide = match head {
            Head::Pan => 0.92,
            Head::Binding => 0.97,
            Head::Truss => 1.08,
            Head::Washer | Head::HexFlange => 1.12,
        };
        let diameter_mm = (base * wide * (1.0 + rng.random_range(-0.01..0.01f64))).clamp(7.0, 12.0);
        // No. 2 recess, 3.9 to 5.3 mm across the wings, within what the head has room for.
        let room = match head {
            Head::Pan | Head::Binding => 0.56,
            Head::Truss => 0.5,
            Head::Washer => 0.43,
            Head::HexFlange => 0.42,
        };
        let recess_width_mm = (room * diameter_mm * rng.random_range(0.92..1.05)).clamp(3.6, 5.3);
        let mut item = self.item(
            Kind::Screw {
                head,
                recess,
                recess_width_mm,
            },
            diameter_mm,
            rng,
        );
        item.plating = plating;
        let off = 0.06 * rng.random::<f64>() * rng.random::<f64>() * f64::from(self.scale.min(1.0));
        let toward = rng.random_range(0.0..TAU);
        item.recess_offset_mm = [off * toward.cos(), off * toward.sin()];
        let skewed = rng.random_bool(0.12 * f64::from(self.scale.min(1.0)));
        item.tilt_rad = if skewed {
            rng.random_range(1.5..5.0f64)
        } else {
            rng.random_range(0.0..0.9f64)
        }
        .to_radians();
        item.tilt_direction_rad = rng.random_range(0.0..TAU);
        if rng.random_bool(0.08 * f64::from(self.scale.min(1.0))) {
            item.lift_mm = rng.random_range(0.2..1.2);
        }
        item
    }

    fn item(&self, kind: Kind, diameter_mm: f64, rng: &mut Rng) -> Item {
        Item {
            kind,
            diameter_mm,
            rotation_rad: rng.random_range(0.0..TAU),
            tilt_rad: 0.0,
            tilt_direction_rad: 0.0,
            lift_mm: 0.0,
            recess_offset_mm: [0.0; 2],
            plating: self.plating,
            wear: self.wear(rng),
            seed: rng.random(),
        }
    }

    fn decoy(&self, rng: &mut Rng) -> Item {
        const COMMON: [Decoy; 22] = [
            Decoy::Hole,
            Decoy::Hole,
            Decoy::EmptyScrewHole,
            Decoy::Rivet,
            Decoy::Rivet,
            Decoy::HexBolt,
            Decoy::HexFlangeBolt,
            Decoy::HexSocket,
            Decoy::Slotted,
            Decoy::Torx,
            Decoy::Dimple,
            Decoy::Dimple,
            Decoy::CrossEmboss,
            Decoy::RustSpot,
            Decoy::RustSpot,
            Decoy::PrintedMark,
            Decoy::PlasticCap,
            Decoy::Weld,
            Decoy::Nut,
            Decoy::Knockout,
            Decoy::Blob,
            Decoy::PrintedMark,
        ];
        let kind = pick(rng, &COMMON);
        let diameter_mm = match kind {
            Decoy::Hole => rng.random_range(3.5..14.0),
            Decoy::EmptyScrewHole => rng.random_range(7.0..12.0),
            Decoy::Rivet => rng.random_range(5.0..10.0),
            Decoy::Knockout => rng.random_range(12.0..18.0),
            Decoy::Weld => rng.random_range(4.0..9.0),
            Decoy::Dimple => rng.random_range(5.0..13.0),
            Decoy::PrintedMark => rng.random_range(7.0..13.0),
            Decoy::RustSpot | Decoy::Blob => rng.random_range(4.0..13.0),
            _ => rng.random_range(7.0..12.5),
        };
        let mut item = self.item(Kind::Decoy(kind), diameter_mm, rng);
        item.plating = pick(
            rng,
            &[
                self.plating,
                Plating::Zinc,
                Plating::DullZinc,
                Plating::BlackOxide,
                Plating::Stainless,
                Plating::Painted,
            ],
        );
        if kind.drive().is_some() && rng.random_bool(0.1) {
            item.tilt_rad = rng.random_range(0.0..4.0f64).to_radians();
            item.tilt_direction_rad = rng.random_range(0.0..TAU);
        }
        item
    }
}

/// Where items may sit: on a layer, within a shape.
#[derive(Clone)]
struct Site {
    layer: usize,
    within: Bounds,
    weight: f32,
}

/// A face in the making.
struct Draft<'a> {
    style: &'a Style,
    half: Xy,
    work: Sheetwork,
    /// Flanges and seams: screws first.
    seams: Vec<Site>,
    /// Anywhere else.
    panels: Vec<Site>,
    taken: Vec<(Xy, f32)>,
    labels: Vec<Bounds>,
    screws: Vec<Placed>,
    decoys: Vec<Placed>,
}

impl<'a> Draft<'a> {
    fn new(style: &'a Style, width_mm: f64, height_mm: f64) -> Self {
        Self {
            style,
            half: [0.5 * width_mm as f32, 0.5 * height_mm as f32],
            work: Sheetwork::default(),
            seams: Vec::new(),
            panels: Vec::new(),
            taken: Vec::new(),
            labels: Vec::new(),
            screws: Vec::new(),
            decoys: Vec::new(),
        }
    }

    fn add(&mut self, layer: Layer) -> usize {
        self.work.layers.push(layer);
        self.work.layers.len() - 1
    }

    fn bump(&mut self, layer: usize, bump: Bump) {
        self.work.layers[layer].bumps.push(bump);
    }

    fn decal(&mut self, layer: usize, decal: Decal) {
        self.work.layers[layer].decals.push(decal);
    }

    fn seam(&mut self, layer: usize, within: Bounds) {
        let size = (within.high[0] - within.low[0]) + (within.high[1] - within.low[1]);
        self.seams.push(Site {
            layer,
            within,
            weight: size,
        });
    }

    fn panel(&mut self, layer: usize, within: Bounds) {
        let area = (within.high[0] - within.low[0]) * (within.high[1] - within.low[1]);
        self.panels.push(Site {
            layer,
            within,
            weight: area.sqrt(),
        });
    }

    /// Whether an item of this radius can sit at a place on a layer.
    fn free(&self, layer: usize, at: Xy, radius: f32, on_label: bool) -> bool {
        let work = &self.work.layers;
        let own = &work[layer];
        if own.solid_distance(at) > -(radius + 2.5) {
            return false;
        }
        let level = own.height(at);
        let flat = (0..8).all(|k| {
            let angle = k as f32 * std::f32::consts::FRAC_PI_4;
            let p = [
                at[0] + (radius + 1.0) * angle.cos(),
                at[1] + (radius + 1.0) * angle.sin(),
            ];
            (own.height(p) - level).abs() < 0.25
        });
        let covered = work
            .iter()
            .enumerate()
            .any(|(k, l)| k != layer && l.top_mm > own.top_mm && l.solid_distance(at) < radius + 2.0);
        let crowded = self
            .taken
            .iter()
            .any(|(p, r)| (p[0] - at[0]).hypot(p[1] - at[1]) < r + radius + 5.0);
        let labelled = !on_label
            && self
                .labels
                .iter()
                .any(|b| b.meets(&Bounds::around(at, [radius + 1.0; 2])));
        let under_cable = self.work.tubes.iter().any(|t| {
            t.bounds.meets(&Bounds::around(at, [radius + 1.0; 2]))
                && t.points
                    .windows(2)
                    .any(|s| segment_foot(s[0], s[1], at).distance < t.radius + radius + 1.0)
        });
        flat && !covered && !crowded && !labelled && !under_cable
    }

    fn find(&self, sites: &[Site], radius: f32, on_label: bool, rng: &mut Rng) -> Option<(usize, Xy)> {
        let total: f32 = sites.iter().map(|s| s.weight).sum();
        for _ in 0..80 {
            let mut at = rng.random::<f32>() * total;
            let site = sites.iter().find(|s| {
                at -= s.weight;
                at <= 0.0
            })?;
            let room = |k: usize, rng: &mut Rng| {
                let (low, high) = (site.within.low[k] + radius + 2.0, site.within.high[k] - radius - 2.0);
                (high > low).then(|| rng.random_range(low..high))
            };
            let (Some(x), Some(y)) = (room(0, rng), room(1, rng)) else {
                continue;
            };
            if self.free(site.layer, [x, y], radius, on_label) {
                return Some((site.layer, [x, y]));
            }
        }
        None
    }

    fn put_screws(&mut self, count: usize, rng: &mut Rng) {
        let seams = self.seams.clone();
        let panels = self.panels.clone();
        let mut tries = 0;
        while self.screws.len() < count && tries < 12 * count {
            tries += 1;
            let item = self.style.screw(rng);
            let radius = 0.5 * item.diameter_mm as f32;
            let found = self
                .find(&seams, radius, false, rng)
                .or_else(|| self.find(&panels, radius, false, rng));
            let Some((layer, at)) = found else { continue };
            self.seat(layer, at, radius, rng);
            self.run_off(layer, at, radius, &item, rng);
            self.taken.push((at, radius));
            let height_mm = f64::from(self.work.layers[layer].height(at));
            self.screws.push(Placed {
                item,
                at_mm: at.map(f64::from),
                height_mm,
            });
        }
    }

    /// A dimple or boss pressed for a screw.
    fn seat(&mut self, layer: usize, at: Xy, radius: f32, rng: &mut Rng) {
        if !self.style.seats || !rng.random_bool(0.6) {
            return;
        }
        let disc = radius + rng.random_range(2.5..5.5);
        let room = -self.work.layers[layer].solid_distance(at);
        if disc + 2.0 > room {
            return;
        }
        let height = rng.random_range(0.6..1.8) * if rng.random_bool(0.6) { -1.0 } else { 1.0 };
        let shape = Shape::Disc {
            center: at,
            radius: disc,
        };
        let soft = rng.random_range(1.2..2.6);
        self.bump(layer, Bump::Plateau { shape, height, soft });
    }

    /// Rust that has run down from a screw.
    fn run_off(&mut self, layer: usize, at: Xy, radius: f32, item: &Item, rng: &mut Rng) {
        if item.wear.rust > 0.3 && rng.random_bool(0.6) {
            let strength = (0.25 + 0.6 * item.wear.rust) * rng.random_range(0.5..1.0);
            let ragged = Noise::new(Grain::Cloud, 9.0, rng);
            self.decal(
                layer,
                Decal::Streak {
                    from: [at[0] + rng.random_range(-0.4..0.4) * radius, at[1] + 0.5 * radius],
                    length: rng.random_range(15.0..110.0),
                    width: radius * rng.random_range(0.6..1.3),
                    color: [0.3, 0.13, 0.05],
                    strength,
                    ragged,
                },
            );
        }
    }

    fn put_decoys(&mut self, count: usize, rng: &mut Rng) {
        let mut sites = self.panels.clone();
        sites.extend(self.seams.iter().cloned().map(|mut s| {
            s.weight *= 0.5;
            s
        }));
        for _ in 0..count {
            let item = self.style.decoy(rng);
            let radius = 0.5 * item.diameter_mm as f32;
            let printed = item.kind == Kind::Decoy(Decoy::PrintedMark);
            let Some((layer, at)) = self.find(&sites, radius, printed, rng) else {
                continue;
            };
            if matches!(item.kind, Kind::Decoy(k) if k.drive().is_some()) {
                self.seat(layer, at, radius, rng);
            }
            self.run_off(layer, at, radius, &item, rng);
            self.taken.push((at, radius));
            let height_mm = f64::from(self.work.layers[layer].height(at));
            self.decoys.push(Placed {
                item,
                at_mm: at.map(f64::from),
                height_mm,
            });
        }
    }

    /// A label on a layer, if there is room.
    fn label(&mut self, layer: usize, within: Bounds, print: Print, rng: &mut Rng) {
        let (w, h) = (0.5 * print.width_mm(), 0.5 * print.height_mm());
        for _ in 0..20 {
            let room = |k: usize, half: f32, rng: &mut Rng| {
                let (low, high) = (within.low[k] + half + 3.0, within.high[k] - half - 3.0);
                (high > low).then(|| rng.random_range(low..high))
            };
            let (Some(x), Some(y)) = (room(0, w, rng), room(1, h, rng)) else {
                return;
            };
            let bounds = Bounds::around([x, y], [w, h]);
            let own = &self.work.layers[layer];
            let corners = [
                [-w, -h],
                [w, -h],
                [-w, h],
                [w, h],
                [0.0, 0.0],
                [0.0, h],
                [w, 0.0],
                [-w, 0.0],
                [0.0, -h],
            ];
            let level = own.height([x, y]);
            let clear = corners.iter().all(|c| {
                let p = [x + c[0], y + c[1]];
                own.solid_distance(p) < -2.0 && (own.height(p) - level).abs() < 1.0
            });
            let over = self.labels.iter().any(|b| b.meets(&bounds.grown(2.0)));
            let hidden = self.work.layers.iter().enumerate().any(|(k, l)| {
                k != layer && l.top_mm > own.top_mm && l.bounds.meets(&bounds) && l.solid_distance([x, y]) < 20.0
            });
            if !clear || over || hidden {
                continue;
            }
            let angle = rng.random_range(-0.02..0.02f32);
            self.labels.push(bounds);
            self.decal(
                layer,
                Decal::Label {
                    print: Arc::new(print),
                    center: [x, y],
                    turn: [angle.cos(), angle.sin()],
                    gloss: rng.random_range(0.25..0.7),
                },
            );
            return;
        }
    }

    /// Streaks, stains, scratches and dents of a life outdoors.
    fn life(&mut self, layer: usize, within: Bounds, rng: &mut Rng) {
        let style = self.style;
        let area = (within.high[0] - within.low[0]) * (within.high[1] - within.low[1]) / 400_000.0;
        let place = |rng: &mut Rng| -> Xy {
            [
                rng.random_range(within.low[0]..within.high[0]),
                rng.random_range(within.low[1]..within.high[1]),
            ]
        };
        let count = |mean: f32, rng: &mut Rng| {
            (mean * area.min(1.0) * style.scale.min(1.5) * rng.random_range(0.3..1.7)) as usize
        };
        for _ in 0..count(4.0 + 14.0 * style.dirt, rng) {
            let mut from = place(rng);
            if rng.random_bool(0.5) {
                from[1] = within.low[1];
            }
            let ragged = Noise::new(Grain::Cloud, rng.random_range(6.0..14.0), rng);
            let color = if rng.random_bool(0.25 + 0.4 * f64::from(style.rust)) {
                [0.28, 0.13, 0.055]
            } else {
                style.mud.map(|c| 0.8 * c)
            };
            self.decal(
                layer,
                Decal::Streak {
                    from,
                    length: rng.random_range(30.0..300.0),
                    width: rng.random_range(2.0..16.0),
                    color,
                    strength: rng.random_range(0.08..0.5) * (0.3 + style.dirt),
                    ragged,
                },
            );
        }
        for _ in 0..count(2.0 + 10.0 * style.dirt, rng) {
            let ragged = Noise::new(Grain::Cloud, rng.random_range(8.0..40.0), rng);
            self.decal(
                layer,
                Decal::Stain {
                    center: place(rng),
                    radius: rng.random_range(4.0..70.0),
                    color: if rng.random_bool(0.2) {
                        [0.6, 0.58, 0.52]
                    } else {
                        style.mud
                    },
                    strength: rng.random_range(0.1..0.75) * (0.25 + style.dirt),
                    ragged,
                },
            );
        }
        for _ in 0..count(9.0, rng) {
            let from = place(rng);
            let (angle, length) = (
                rng.random_range(0.0..std::f32::consts::TAU),
                rng.random_range(5.0..90.0f32),
            );
            let bright = rng.random_bool(0.5);
            self.decal(
                layer,
                Decal::Scratch {
                    from,
                    to: [from[0] + length * angle.cos(), from[1] + length * angle.sin()],
                    width: rng.random_range(0.2..0.9),
                    color: if bright { [0.6; 3] } else { [0.2, 0.13, 0.09] },
                    metallic: if bright { 0.6 } else { 0.0 },
                    strength: rng.random_range(0.25..0.9),
                },
            );
        }
        for _ in 0..count(3.0, rng) {
            let radius = rng.random_range(6.0..40.0);
            let height = -rng.random_range(0.02..0.07) * radius;
            let center = place(rng);
            self.bump(layer, Bump::Dent { center, radius, height });
        }
    }

    /// The slow unevenness of a thin sheet.
    fn buckle(&mut self, layer: usize, rng: &mut Rng) {
        let waves = std::array::from_fn(|_| {
            let k = std::f32::consts::TAU / rng.random_range(120.0..500.0f32);
            let angle = rng.random_range(0.0..std::f32::consts::TAU);
            [
                k * angle.cos(),
                k * angle.sin(),
                rng.random_range(0.0..std::f32::consts::TAU),
            ]
        });
        let bounds = self.work.layers[layer].bounds;
        let amplitude = rng.random_range(0.05..0.3);
        self.bump(
            layer,
            Bump::Buckle {
                waves,
                amplitude,
                bounds,
            },
        );
    }

    fn tube(&mut self, from: [f32; 3], to: [f32; 3], sag: f32, radius: f32, paint: Paint, rng: &mut Rng) {
        let (bx, by) = (rng.random_range(-0.3..0.3f32), rng.random_range(-0.3..0.3f32));
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        let count = (length / 9.0).clamp(6.0, 44.0) as usize;
        let points = (0..=count)
            .map(|k| {
                let t = k as f32 / count as f32;
                let arc = 4.0 * t * (1.0 - t);
                let s = (std::f32::consts::TAU * t).sin();
                [
                    from[0] + t * (to[0] - from[0]) + arc * length * bx * 0.4 + 0.04 * length * s,
                    from[1] + t * (to[1] - from[1]) + arc * (sag + length * by * 0.4) - 0.05 * length * s,
                    from[2] + t * (to[2] - from[2]) + arc * 0.5 * radius,
                ]
            })
            .collect();
        self.work.tubes.push(Tube::new(points, radius, paint));
    }

    fn finish(mut self, id: FaceId, width_mm: f64, height_mm: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
        let grow = 0.5 * self.half[1];
        for layer in &mut self.work.layers {
            layer.paint.fall = [0.25 * self.half[1], grow];
        }
        let screws = self
            .screws
            .into_iter()
            .map(|placed| {
                let id = ScrewId(*next);
                *next += 1;
                let w = &placed.item.wear;
                let torque_nm =
                    rng.random_range(1.2..2.2) * (1.0 + 1.1 * f64::from(w.rust) + 0.5 * f64::from(w.paint_over));
                Screw {
                    id,
                    placed,
                    torque_nm,
                    seized: false,
                }
            })
            .collect();
        FaceDesign {
            id,
            width_mm,
            height_mm,
            screws,
            decoys: self.decoys,
            sheetwork: self.work,
        }
    }
}

fn strip(low: Xy, high: Xy) -> Shape {
    Shape::rect(
        [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])],
        [0.5 * (high[0] - low[0]), 0.5 * (high[1] - low[1])],
        1.0,
    )
}

fn bounds(low: Xy, high: Xy) -> Bounds {
    Bounds { low, high }
}

/// The body and the skirts that overlap it: top cover's above, base pan's below. Returns body, and what is left free in y.
fn body(draft: &mut Draft, depth_mm: f32, rng: &mut Rng) -> (usize, f32, f32) {
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

fn ribs(draft: &mut Draft, layer: usize, within: Bounds, rng: &mut Rng) {
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

fn louvres(draft: &mut Draft, layer: usize, within: Bounds, rng: &mut Rng) {
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
fn dark_behind(draft: &mut Draft, area: Bounds, depth_mm: f32, rng: &mut Rng) {
    let paint = Paint::new(Coat::Plastic, [0.03, 0.03, 0.032], 0.9, rng);
    let grown = area.grown(depth_mm);
    draft.add(Layer::new(strip(grown.low, grown.high), -depth_mm, 0.0, 0.0, paint));
}

/// A recessed handle.
fn handle(draft: &mut Draft, layer: usize, center: Xy, rng: &mut Rng) {
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

fn front(style: &Style, w: f64, h: f64, depth: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
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

/// Cables, cords and threads that hang over a face; now and then over a screw.
fn loose_ends(draft: &mut Draft, chance: f64, rng: &mut Rng) {
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

fn side(style: &Style, id: FaceId, d: f64, h: f64, width: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
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

fn top(style: &Style, w: f64, d: f64, height: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
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

fn front_inner(style: &Style, w: f64, h: f64, depth: f64, next: &mut u16, rng: &mut Rng) -> FaceDesign {
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

pub(crate) fn unit(seed: u64, options: &UnitOptions) -> Unit {
    let mut rng = Rng::seed_from_u64(seed);
    let size_mm: [f64; 3] = [
        rng.random_range(640.0..895.0),
        rng.random_range(250.0..395.0),
        rng.random_range(500.0..745.0),
    ];
    let style = Style::sample(options, &mut rng);
    let [w, d, h] = size_mm;
    let mut next = 0u16;
    let mut faces = vec![
        front(&style, w, h, d, &mut next, &mut rng),
        side(&style, FaceId::Left, d, h, w, &mut next, &mut rng),
        side(&style, FaceId::Right, d, h, w, &mut next, &mut rng),
        top(&style, w, d, h, &mut next, &mut rng),
        front_inner(&style, w, h, d, &mut next, &mut rng),
    ];
    if !options.decoys {
        for face in &mut faces {
            face.decoys.clear();
        }
    }
    let exclusion = rng
        .random_bool(options.excluded_share.clamp(0.0, 1.0))
        .then(|| exclude(&mut faces, &mut rng));
    let cover = |id: CoverId, face: FaceId, leaves_with: Option<CoverId>| Cover {
        id,
        face,
        screws: faces
            .iter()
            .filter(|f| f.id == face)
            .flat_map(|f| f.screws.iter().map(|s| s.id))
            .collect(),
        leaves_with,
    };
    let covers = vec![
        cover(CoverId::Front, FaceId::Front, None),
        cover(CoverId::Left, FaceId::Left, Some(CoverId::Front)),
        cover(CoverId::Right, FaceId::Right, None),
        cover(CoverId::Top, FaceId::Top, None),
        cover(CoverId::FrontInner, FaceId::FrontInner, None),
    ];
    Unit {
        seed,
        model: style.model.clone(),
        size_mm,
        theme: style.theme,
        faces: faces.into_iter().map(Arc::new).collect(),
        covers,
        exclusion,
    }
}

/// Spoils a unit as those were that the paper excluded.
fn exclude(faces: &mut [FaceDesign], rng: &mut Rng) -> Exclusion {
    let kind = pick(
        rng,
        &[
            Exclusion::MudFilledSlot,
            Exclusion::DenseWeb,
            Exclusion::Seized,
            Exclusion::BentCover,
        ],
    );
    let face = &mut faces[rng.random_range(0..5)];
    let count = face.screws.len();
    if count == 0 {
        return kind;
    }
    match kind {
        Exclusion::BentCover => {
            let toward = rng.random_range(0.0..TAU);
            let lean = rng.random_range(10.0..16.0f64).to_radians();
            for screw in &mut face.screws {
                screw.placed.item.tilt_rad = lean * rng.random_range(0.8..1.1);
                screw.placed.item.tilt_direction_rad = toward;
            }
            if let Some(layer) = face.sheetwork.layers.first_mut() {
                let center = [rng.random_range(-150.0..150.0), rng.random_range(-80.0..80.0)];
                layer.bumps.push(Bump::Dent {
                    center,
                    radius: rng.random_range(60.0..140.0),
                    height: -rng.random_range(8.0..16.0f32),
                });
            }
        }
        _ => {
            for _ in 0..rng.random_range(1..=3) {
                let screw = &mut face.screws[rng.random_range(0..count)];
                let wear = &mut screw.placed.item.wear;
                match kind {
                    Exclusion::MudFilledSlot => {
                        wear.mud_in_slot = 1.0;
                        wear.dirt = wear.dirt.max(0.85);
                    }
                    Exclusion::DenseWeb => wear.web = 1.0,
                    _ => {
                        wear.rust = wear.rust.max(0.9);
                        screw.seized = true;
                        screw.torque_nm = rng.random_range(9.0..20.0);
                    }
                }
            }
        }
    }
    kind
}

pub(crate) fn gauge(seed: u64) -> Unit {
    let mut rng = Rng::seed_from_u64(seed);
    let options = UnitOptions {
        wear: 0.12,
        decoys: false,
        excluded_share: 0.0,
    };
    let mut style = Style::sample(&options, &mut rng);
    style.theme = Theme::Clean;
    let size_mm = [rng.random_range(420.0..640.0), 20.0, rng.random_range(300.0..460.0)];
    let mut draft = Draft::new(&style, size_mm[0], size_mm[2]);
    let paint = if rng.random_bool(0.5) {
        style.zinc(&mut rng)
    } else {
        style.paint(&mut rng)
    };
    let [w, h] = draft.half;
    let plate = draft.add(Layer::new(Shape::rect([0.0, 0.0], [w, h], 4.0), 0.0, 20.0, 1.0, paint));
    draft.seam(plate, bounds([-w + 10.0, -h + 10.0], [w - 10.0, h - 10.0]));
    draft.put_screws(30, &mut rng);
    let mut next = 0;
    let face = draft.finish(FaceId::Front, size_mm[0], size_mm[2], &mut next, &mut rng);
    Unit {
        seed,
        model: "GAUGE".into(),
        size_mm,
        theme: Theme::Clean,
        covers: Vec::new(),
        faces: vec![Arc::new(face)],
        exclusion: None,
    }
}

/// The calibration jig as a face: paddle, handle, disc.
pub(crate) fn jig(seed: u64) -> FaceDesign {
    let mut rng = Rng::seed_from_u64(seed);
    let mut sheetwork = Sheetwork::default();
    let white = Paint::new(Coat::Plastic, [0.82, 0.82, 0.8], 0.7, &mut rng);
    let ink = pick(&mut rng, &[[0.02, 0.40, 0.08], [0.62, 0.02, 0.36], [0.03, 0.38, 0.10]]);
    let disc = Paint::new(Coat::Plastic, ink, 0.75, &mut rng);
    let steel = Paint::new(Coat::Zinc, [0.5; 3], 0.4, &mut rng);
    let radius = rng.random_range(11.0..15.0f32);
    sheetwork.layers.push(Layer::new(
        Shape::Disc {
            center: [0.0, 0.0],
            radius,
        },
        0.0,
        0.1,
        0.0,
        disc,
    ));
    let side = radius + rng.random_range(16.0..26.0);
    sheetwork.layers.push(Layer::new(
        Shape::rect([0.0, 0.0], [side, side], 0.4 * side),
        -0.1,
        6.0,
        0.5,
        white,
    ));
    sheetwork.layers.push(Layer::new(
        strip([-9.0, side - 4.0], [9.0, side + 160.0]),
        -2.0,
        14.0,
        3.0,
        steel,
    ));
    FaceDesign {
        id: FaceId::Front,
        width_mm: f64::from(2.0 * side),
        height_mm: f64::from(2.0 * side),
        screws: Vec::new(),
        decoys: Vec::new(),
        sheetwork,
    }
}
