//! Sheet metal as stacked flat shapes with walls, openings, ribs and dents, and how a view ray meets it.
//!
//! Axes: x right, y down, heights out of the face toward the viewer, mm. A ray is the place where it crosses height 0 and
//! how far it moves sideways per millimetre of height.

use crate::paint::{Decal, Paint};
use crate::shape::{Bounds, Shape, Xy};

/// A view ray in the frame of the face.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    /// Where it crosses height 0, mm.
    pub at: Xy,
    /// Sideways motion per millimetre of height.
    pub slope: Xy,
}

impl Ray {
    #[inline]
    pub fn at_height(&self, h: f32) -> Xy {
        [self.at[0] + h * self.slope[0], self.at[1] + h * self.slope[1]]
    }
}

/// An opening in a layer.
#[derive(Clone, Debug)]
pub(crate) struct Cutout {
    pub shape: Shape,
    pub bounds: Bounds,
    /// How deep its wall goes, mm; below it the ray goes on.
    pub wall_mm: f32,
}

/// A change of a layer's height.
#[derive(Clone, Debug)]
pub(crate) enum Bump {
    /// Raised (or sunken) plateau with slanted edges of width `soft`: rib, boss, seat, pressed frame.
    Plateau { shape: Shape, height: f32, soft: f32 },
    /// Round dent (negative) or bulge that fades out.
    Dent { center: Xy, radius: f32, height: f32 },
    /// Waves across a rectangle: corrugated sheet, fins.
    Wave {
        shape: Shape,
        along: Xy,
        wavelength: f32,
        amplitude: f32,
    },
    /// The sheet is not quite flat: three slow waves of this height.
    Buckle {
        waves: [[f32; 3]; 3],
        amplitude: f32,
        bounds: Bounds,
    },
    /// Louvres: a hood over each slot of a field, highest at its lower edge.
    Hood {
        center: Xy,
        half: Xy,
        pitch: f32,
        height: f32,
    },
}

impl Bump {
    pub fn bounds(&self) -> Bounds {
        match self {
            Bump::Plateau { shape, soft, .. } => shape.bounds().grown(soft.max(0.0) + 0.2),
            Bump::Dent { center, radius, .. } => Bounds::around(*center, [1.6 * radius; 2]),
            Bump::Wave { shape, .. } => shape.bounds(),
            Bump::Buckle { bounds, .. } => *bounds,
            Bump::Hood { center, half, .. } => Bounds::around(*center, *half),
        }
    }

    /// Height and slope at a place, for what changes too slowly to be followed within a few millimetres.
    pub fn slow_at(&self, p: Xy) -> Option<(f32, Xy)> {
        let Bump::Buckle { waves, amplitude, .. } = self else {
            return None;
        };
        let (mut height, mut slope) = (0.0, [0.0; 2]);
        for w in waves {
            let (sin, cos) = (p[0] * w[0] + p[1] * w[1] + w[2]).sin_cos();
            height += amplitude * sin;
            slope[0] += amplitude * w[0] * cos;
            slope[1] += amplitude * w[1] * cos;
        }
        Some((height, slope))
    }

    /// Whether it changes nothing within `reach` of a place.
    pub fn is_nothing_within(&self, p: Xy, reach: f32) -> bool {
        match self {
            Bump::Plateau { shape, soft, .. } => shape.distance(p) > reach + soft,
            Bump::Wave { shape, .. } => shape.distance(p) > reach,
            Bump::Dent { center, radius, .. } => (p[0] - center[0]).hypot(p[1] - center[1]) > 1.6 * radius + reach,
            Bump::Buckle { .. } | Bump::Hood { .. } => false,
        }
    }

    /// The most that it may raise the sheet, mm.
    pub fn raise(&self) -> f32 {
        match self {
            Bump::Plateau { height, .. } | Bump::Dent { height, .. } => height.max(0.0),
            Bump::Wave { amplitude, .. } => *amplitude,
            Bump::Buckle { amplitude, .. } => 3.0 * amplitude,
            Bump::Hood { height, .. } => *height,
        }
    }

    /// The most that it may lower the sheet, mm.
    pub fn depth(&self) -> f32 {
        match self {
            Bump::Plateau { height, .. } | Bump::Dent { height, .. } => (-height).max(0.0),
            Bump::Wave { amplitude, .. } => *amplitude,
            Bump::Buckle { amplitude, .. } => 3.0 * amplitude,
            Bump::Hood { .. } => 0.0,
        }
    }

    #[inline]
    pub fn height(&self, p: Xy) -> f32 {
        match self {
            Bump::Plateau { shape, height, soft } => {
                let t = (0.5 - shape.distance(p) / soft).clamp(0.0, 1.0);
                height * t * t * (3.0 - 2.0 * t)
            }
            Bump::Dent { center, radius, height } => {
                let r2 = ((p[0] - center[0]).powi(2) + (p[1] - center[1]).powi(2)) / (radius * radius);
                if r2 > 2.5 {
                    return 0.0;
                }
                let t = 1.0 - r2 / 2.5;
                height * t * t * t
            }
            Bump::Wave {
                shape,
                along,
                wavelength,
                amplitude,
            } => {
                let fade = (-shape.distance(p) / (0.3 * wavelength)).clamp(0.0, 1.0);
                if fade <= 0.0 {
                    return 0.0;
                }
                let phase = (p[0] * along[0] + p[1] * along[1]) * std::f32::consts::TAU / wavelength;
                amplitude * fade * phase.sin()
            }
            Bump::Buckle { waves, amplitude, .. } => {
                let wave = |w: &[f32; 3]| (p[0] * w[0] + p[1] * w[1] + w[2]).sin();
                amplitude * (wave(&waves[0]) + wave(&waves[1]) + wave(&waves[2]))
            }
            Bump::Hood {
                center,
                half,
                pitch,
                height,
            } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                let across = half[0] - dx.abs();
                if across <= 0.0 || dy.abs() >= half[1] {
                    return 0.0;
                }
                let phase = (dy + half[1]) / pitch;
                let f = phase - phase as i32 as f32;
                // rises slowly, falls off at the slot
                let rise = (f / 0.72).min((0.95 - f) / 0.08).clamp(0.0, 1.0);
                let ends = (across / (0.6 * pitch)).min(1.0);
                height * rise * rise * (3.0 - 2.0 * rise) * (ends * (2.0 - ends)).sqrt()
            }
        }
    }
}

/// One flat sheet, bar, box or wire grid.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    pub shape: Shape,
    pub bounds: Bounds,
    /// Height of its upper side, mm.
    pub top_mm: f32,
    /// How far its outer wall goes down, mm.
    pub wall_mm: f32,
    /// Radius of its outer edge, mm.
    pub edge_mm: f32,
    pub cutouts: Vec<Cutout>,
    pub bumps: Vec<Bump>,
    pub decals: Vec<Decal>,
    pub paint: Paint,
    /// The most that its bumps and edge lower and raise it, mm: see [`settle`](Self::settle).
    pub sunk_mm: f32,
    pub raised_mm: f32,
}

impl Layer {
    pub fn new(shape: Shape, top_mm: f32, wall_mm: f32, edge_mm: f32, paint: Paint) -> Self {
        Self {
            bounds: shape.bounds(),
            shape,
            top_mm,
            wall_mm,
            edge_mm,
            cutouts: Vec::new(),
            bumps: Vec::new(),
            decals: Vec::new(),
            paint,
            sunk_mm: 0.0,
            raised_mm: 0.0,
        }
    }

    /// To be called once all bumps are there: between which heights the sheet lies.
    pub fn settle(&mut self) {
        self.sunk_mm = self.edge_mm + self.bumps.iter().map(Bump::depth).sum::<f32>().min(25.0);
        self.raised_mm = self.bumps.iter().map(Bump::raise).sum::<f32>().min(12.0);
    }

    pub fn cut(&mut self, shape: Shape, wall_mm: f32) {
        self.cutouts.push(Cutout {
            bounds: shape.bounds(),
            shape,
            wall_mm,
        });
    }

    /// Positive outside the sheet or inside one of its openings, negative on the sheet.
    pub fn solid_distance(&self, p: Xy) -> f32 {
        let mut d = self.shape.distance(p);
        for cutout in &self.cutouts {
            d = d.max(-cutout.shape.distance(p));
        }
        d
    }

    /// Height of the upper side at a place on it, mm.
    pub fn height(&self, p: Xy) -> f32 {
        self.top_mm + self.bumps.iter().map(|b| b.height(p)).sum::<f32>()
    }
}

/// A cable, pipe, wire or strand: a bent tube.
#[derive(Clone, Debug)]
pub(crate) struct Tube {
    /// Middle line: x, y, height, mm.
    pub points: Vec<[f32; 3]>,
    pub radius: f32,
    pub paint: Paint,
    pub bounds: Bounds,
    /// Lowest and highest point of its surface, mm.
    pub heights: (f32, f32),
}

impl Tube {
    pub fn new(points: Vec<[f32; 3]>, radius: f32, paint: Paint) -> Self {
        let bounds = Bounds::of_points(points.iter().map(|p| [p[0], p[1]])).grown(radius);
        let low = points.iter().map(|p| p[2]).fold(f32::MAX, f32::min);
        let high = points.iter().map(|p| p[2]).fold(f32::MIN, f32::max);
        Self {
            points,
            radius,
            paint,
            bounds,
            heights: (low - radius, high + radius),
        }
    }
}

/// The nearest place on a piece of a tube's middle line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TubeFoot {
    pub distance: f32,
    pub height: f32,
    /// From the middle line to the place, unit.
    pub across: Xy,
}

/// Nearest place on one segment of a tube.
#[inline]
pub(crate) fn segment_foot(a: [f32; 3], b: [f32; 3], p: Xy) -> TubeFoot {
    let (ex, ey) = (b[0] - a[0], b[1] - a[1]);
    let length2 = (ex * ex + ey * ey).max(1e-6);
    let t = (((p[0] - a[0]) * ex + (p[1] - a[1]) * ey) / length2).clamp(0.0, 1.0);
    let (dx, dy) = (p[0] - a[0] - t * ex, p[1] - a[1] - t * ey);
    let distance = (dx * dx + dy * dy).sqrt();
    let scale = 1.0 / distance.max(1e-6);
    TubeFoot {
        distance,
        height: a[2] + t * (b[2] - a[2]),
        across: [dx * scale, dy * scale],
    }
}

/// Everything of a face but its items.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sheetwork {
    pub layers: Vec<Layer>,
    pub tubes: Vec<Tube>,
}
