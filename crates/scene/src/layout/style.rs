//! What all faces of a unit share, and items as such a unit has them.

use super::{Rng, pick, varied};
use crate::fastener::{CrossRecess, Decoy, Head, Item, Kind, Plating, Wear};
use crate::paint::{Coat, Paint};
use crate::product::{Theme, UnitOptions};
use rand::RngExt;
use std::f64::consts::TAU;

/// What all faces of a unit share: colours, the kind of screws it was built with, what it has been through.
pub(super) struct Style {
    pub(super) panel: [f32; 3],
    pub(super) trim: [f32; 3],
    pub(super) roughness: f32,
    pub(super) theme: Theme,
    /// Factor on wear.
    pub(super) scale: f32,
    pub(super) head: Head,
    pub(super) recess: CrossRecess,
    pub(super) plating: Plating,
    pub(super) diameter_mm: f64,
    pub(super) mud: [f32; 3],
    /// Grime and rust of its sheets, 0 to 1.
    pub(super) dirt: f32,
    pub(super) rust: f32,
    pub(super) seats: bool,
    pub(super) model: String,
}

pub(super) const PANELS: [[f32; 3]; 12] = [
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

impl Style {
    pub(super) fn sample(options: &UnitOptions, rng: &mut Rng) -> Self {
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

    pub(super) fn paint(&self, rng: &mut Rng) -> Paint {
        Paint::new(Coat::Painted, varied(self.panel, 0.015, rng), self.roughness, rng)
            .worn(self.dirt, self.mud, self.rust, rng)
    }

    pub(super) fn trim(&self, rng: &mut Rng) -> Paint {
        Paint::new(Coat::Painted, varied(self.trim, 0.02, rng), self.roughness, rng)
            .worn(self.dirt, self.mud, self.rust, rng)
    }

    pub(super) fn zinc(&self, rng: &mut Rng) -> Paint {
        Paint::new(
            Coat::Zinc,
            varied([0.62, 0.64, 0.66], 0.1, rng),
            rng.random_range(0.35..0.6),
            rng,
        )
        .worn((self.dirt + 0.1).min(1.0), self.mud, (1.4 * self.rust).min(1.0), rng)
    }

    pub(super) fn plastic(&self, albedo: [f32; 3], rng: &mut Rng) -> Paint {
        Paint::new(Coat::Plastic, albedo, rng.random_range(0.4..0.75), rng).worn(self.dirt, self.mud, 0.0, rng)
    }

    /// Wear of one item: the unit's theme, varied from one to the next.
    pub(super) fn wear(&self, rng: &mut Rng) -> Wear {
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

    pub(super) fn screw(&self, rng: &mut Rng) -> Item {
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

    pub(super) fn item(&self, kind: Kind, diameter_mm: f64, rng: &mut Rng) -> Item {
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

    pub(super) fn decoy(&self, rng: &mut Rng) -> Item {
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
