//! A face in the making: sheets first, then screws along its seams and decoys where there is room.

use super::Rng;
use super::style::Style;
use crate::fastener::{Decoy, Item, Kind};
use crate::layer::{Bump, Layer, Sheetwork, Tube, segment_foot};
use crate::noise::{Grain, Noise};
use crate::paint::{Decal, Paint};
use crate::print::Print;
use crate::product::{FaceDesign, FaceId, Placed, Screw, ScrewId};
use crate::shape::{Bounds, Shape, Xy};
use rand::RngExt;
use std::sync::Arc;

/// Where items may sit: on a layer, within a shape.
#[derive(Clone)]
pub(super) struct Site {
    pub(super) layer: usize,
    pub(super) within: Bounds,
    pub(super) weight: f32,
}

/// A face in the making.
pub(super) struct Draft<'a> {
    pub(super) style: &'a Style,
    pub(super) half: Xy,
    pub(super) work: Sheetwork,
    /// Flanges and seams: screws first.
    pub(super) seams: Vec<Site>,
    /// Anywhere else.
    pub(super) panels: Vec<Site>,
    pub(super) taken: Vec<(Xy, f32)>,
    pub(super) labels: Vec<Bounds>,
    pub(super) screws: Vec<Placed>,
    pub(super) decoys: Vec<Placed>,
}

impl<'a> Draft<'a> {
    pub(super) fn new(style: &'a Style, width_mm: f64, height_mm: f64) -> Self {
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

    pub(super) fn add(&mut self, layer: Layer) -> usize {
        self.work.layers.push(layer);
        self.work.layers.len() - 1
    }

    pub(super) fn bump(&mut self, layer: usize, bump: Bump) {
        self.work.layers[layer].bumps.push(bump);
    }

    pub(super) fn decal(&mut self, layer: usize, decal: Decal) {
        self.work.layers[layer].decals.push(decal);
    }

    pub(super) fn seam(&mut self, layer: usize, within: Bounds) {
        let size = (within.high[0] - within.low[0]) + (within.high[1] - within.low[1]);
        self.seams.push(Site {
            layer,
            within,
            weight: size,
        });
    }

    pub(super) fn panel(&mut self, layer: usize, within: Bounds) {
        let area = (within.high[0] - within.low[0]) * (within.high[1] - within.low[1]);
        self.panels.push(Site {
            layer,
            within,
            weight: area.sqrt(),
        });
    }

    /// Whether an item of this radius can sit at a place on a layer.
    pub(super) fn free(&self, layer: usize, at: Xy, radius: f32, on_label: bool) -> bool {
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

    pub(super) fn find(&self, sites: &[Site], radius: f32, on_label: bool, rng: &mut Rng) -> Option<(usize, Xy)> {
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

    pub(super) fn put_screws(&mut self, count: usize, rng: &mut Rng) {
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
    pub(super) fn seat(&mut self, layer: usize, at: Xy, radius: f32, rng: &mut Rng) {
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
    pub(super) fn run_off(&mut self, layer: usize, at: Xy, radius: f32, item: &Item, rng: &mut Rng) {
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

    pub(super) fn put_decoys(&mut self, count: usize, rng: &mut Rng) {
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
    pub(super) fn label(&mut self, layer: usize, within: Bounds, print: Print, rng: &mut Rng) {
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
    pub(super) fn life(&mut self, layer: usize, within: Bounds, rng: &mut Rng) {
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
    pub(super) fn buckle(&mut self, layer: usize, rng: &mut Rng) {
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

    pub(super) fn tube(&mut self, from: [f32; 3], to: [f32; 3], sag: f32, radius: f32, paint: Paint, rng: &mut Rng) {
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

    pub(super) fn finish(
        mut self,
        id: FaceId,
        width_mm: f64,
        height_mm: f64,
        next: &mut u16,
        rng: &mut Rng,
    ) -> FaceDesign {
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
