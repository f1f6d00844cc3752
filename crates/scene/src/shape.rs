//! Flat shapes as signed distances (negative inside), mm in the plane of a face: x right, y down.

/// A place in the plane of a face, mm.
pub(crate) type Xy = [f32; 2];

/// A rectangle along the axes: low corner, high corner, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bounds {
    pub low: Xy,
    pub high: Xy,
}

impl Bounds {
    pub fn around(center: Xy, half: Xy) -> Self {
        Self {
            low: [center[0] - half[0], center[1] - half[1]],
            high: [center[0] + half[0], center[1] + half[1]],
        }
    }
    pub fn of_points(points: impl IntoIterator<Item = Xy>) -> Self {
        let mut b = Self {
            low: [f32::MAX; 2],
            high: [f32::MIN; 2],
        };
        for p in points {
            b.low = [b.low[0].min(p[0]), b.low[1].min(p[1])];
            b.high = [b.high[0].max(p[0]), b.high[1].max(p[1])];
        }
        b
    }
    pub fn grown(&self, by_mm: f32) -> Self {
        Self {
            low: [self.low[0] - by_mm, self.low[1] - by_mm],
            high: [self.high[0] + by_mm, self.high[1] + by_mm],
        }
    }
    /// Its middle, and how far its corners are from there.
    pub fn middle(&self) -> (Xy, f32) {
        let center = [0.5 * (self.low[0] + self.high[0]), 0.5 * (self.low[1] + self.high[1])];
        (
            center,
            0.5 * (self.high[0] - self.low[0]).hypot(self.high[1] - self.low[1]),
        )
    }
    pub fn meets(&self, other: &Bounds) -> bool {
        (0..2).all(|k| self.low[k] <= other.high[k] && other.low[k] <= self.high[k])
    }
}

/// A shape in the plane.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Shape {
    /// Rectangle with rounded corners, turned by `turn` (cos, sin).
    Rect {
        center: Xy,
        half: Xy,
        round: f32,
        turn: Xy,
    },
    Disc {
        center: Xy,
        radius: f32,
    },
    /// Concentric wires.
    Rings {
        center: Xy,
        first: f32,
        pitch: f32,
        count: u32,
        half_width: f32,
    },
    /// Straight wires from `inner` to `outer` around a centre; `sweep` bends them along the radius, rad/mm.
    Spokes {
        center: Xy,
        count: u32,
        phase: f32,
        inner: f32,
        outer: f32,
        half_width: f32,
        sweep: f32,
    },
    /// Rectangular field of equal rounded slots or holes.
    Field {
        center: Xy,
        pitch: Xy,
        count: [u32; 2],
        half: Xy,
        round: f32,
    },
    /// Wire mesh over a rectangle: wires at multiples of the pitch.
    Mesh {
        center: Xy,
        half: Xy,
        pitch: Xy,
        half_width: f32,
    },
}

/// Nearest whole number; several times faster than the standard one where the processor may not be assumed to have it.
#[inline]
pub(crate) fn nearest(v: f32) -> f32 {
    (v + 0.5_f32.copysign(v)) as i32 as f32
}

#[inline]
fn rect_distance(x: f32, y: f32, half: Xy, round: f32) -> f32 {
    let qx = x.abs() - half[0] + round;
    let qy = y.abs() - half[1] + round;
    let outside = (qx.max(0.0).powi(2) + qy.max(0.0).powi(2)).sqrt();
    outside + qx.max(qy).min(0.0) - round
}

impl Shape {
    pub fn rect(center: Xy, half: Xy, round: f32) -> Self {
        Shape::Rect {
            center,
            half,
            round,
            turn: [1.0, 0.0],
        }
    }

    pub fn turned_rect(center: Xy, half: Xy, round: f32, angle_rad: f32) -> Self {
        Shape::Rect {
            center,
            half,
            round,
            turn: [angle_rad.cos(), angle_rad.sin()],
        }
    }

    /// Signed distance to the outline, mm, negative inside; exact near the outline.
    #[inline]
    pub fn distance(&self, p: Xy) -> f32 {
        match *self {
            Shape::Rect {
                center,
                half,
                round,
                turn,
            } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                rect_distance(turn[0] * dx + turn[1] * dy, turn[0] * dy - turn[1] * dx, half, round)
            }
            Shape::Disc { center, radius } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                (dx * dx + dy * dy).sqrt() - radius
            }
            Shape::Rings {
                center,
                first,
                pitch,
                count,
                half_width,
            } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                let r = (dx * dx + dy * dy).sqrt();
                let k = nearest((r - first) / pitch).clamp(0.0, (count - 1) as f32);
                (r - first - k * pitch).abs() - half_width
            }
            Shape::Spokes {
                center,
                count,
                phase,
                inner,
                outer,
                half_width,
                sweep,
            } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                let r = (dx * dx + dy * dy).sqrt();
                let along = (inner - r).max(r - outer);
                if along > 2.0 * half_width + 4.0 {
                    return along; // far inside or outside: no need for the angle
                }
                let sector = std::f32::consts::TAU / count as f32;
                let angle = dy.atan2(dx) - phase - sweep * (r - inner);
                let folded = angle - nearest(angle / sector) * sector;
                // A bent spoke is crossed at an angle: its width along the circle is larger than across.
                let across = r * folded.sin() / (1.0 + (sweep * r).powi(2)).sqrt();
                (across.abs() - half_width).max(along)
            }
            Shape::Field {
                center,
                pitch,
                count,
                half,
                round,
            } => {
                let fold = |d: f32, k: usize| {
                    let n = (count[k] - 1) as f32;
                    let i = nearest(d / pitch[k] + 0.5 * n).clamp(0.0, n);
                    d - (i - 0.5 * n) * pitch[k]
                };
                rect_distance(fold(p[0] - center[0], 0), fold(p[1] - center[1], 1), half, round)
            }
            Shape::Mesh {
                center,
                half,
                pitch,
                half_width,
            } => {
                let (dx, dy) = (p[0] - center[0], p[1] - center[1]);
                let to_wire = |d: f32, pitch: f32| (d - nearest(d / pitch) * pitch).abs();
                let wire = to_wire(dx, pitch[0]).min(to_wire(dy, pitch[1])) - half_width;
                wire.max(rect_distance(dx, dy, half, 0.0))
            }
        }
    }

    /// For wire work: widest gap between wires, mm, and the share of the area that the wires take.
    pub fn wires(&self) -> Option<(f32, f32)> {
        match *self {
            Shape::Rings { pitch, half_width, .. } => Some((pitch, 2.0 * half_width / pitch)),
            Shape::Mesh { pitch, half_width, .. } => Some((
                pitch[0].max(pitch[1]),
                2.0 * half_width / pitch[0] + 2.0 * half_width / pitch[1],
            )),
            Shape::Spokes {
                count,
                outer,
                half_width,
                ..
            } if half_width < 6.0 => {
                let gap = std::f32::consts::TAU * outer / count as f32;
                Some((gap, 3.0 * half_width / gap))
            }
            _ => None,
        }
    }

    /// A rectangle that holds the shape.
    pub fn bounds(&self) -> Bounds {
        match *self {
            Shape::Rect { center, half, turn, .. } => {
                let (c, s) = (turn[0].abs(), turn[1].abs());
                Bounds::around(center, [c * half[0] + s * half[1], s * half[0] + c * half[1]])
            }
            Shape::Disc { center, radius } => Bounds::around(center, [radius; 2]),
            Shape::Rings {
                center,
                first,
                pitch,
                count,
                half_width,
            } => Bounds::around(center, [first + (count - 1) as f32 * pitch + half_width; 2]),
            Shape::Spokes { center, outer, .. } => Bounds::around(center, [outer; 2]),
            Shape::Field {
                center,
                pitch,
                count,
                half,
                ..
            } => Bounds::around(
                center,
                [
                    0.5 * (count[0] - 1) as f32 * pitch[0] + half[0],
                    0.5 * (count[1] - 1) as f32 * pitch[1] + half[1],
                ],
            ),
            Shape::Mesh { center, half, .. } => Bounds::around(center, half),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_distances() {
        let shapes = [
            Shape::turned_rect([3.0, -2.0], [20.0, 10.0], 3.0, 0.4),
            Shape::Disc {
                center: [1.0, 1.0],
                radius: 7.0,
            },
            Shape::Rings {
                center: [0.0, 0.0],
                first: 10.0,
                pitch: 8.0,
                count: 4,
                half_width: 1.0,
            },
            Shape::Field {
                center: [0.0, 0.0],
                pitch: [12.0, 9.0],
                count: [3, 4],
                half: [4.0, 2.0],
                round: 1.0,
            },
        ];
        for shape in shapes {
            for i in 0..400 {
                let p = [(i % 20) as f32 * 2.9 - 27.3, (i / 20) as f32 * 2.7 - 26.1];
                let d = shape.distance(p);
                // never farther than it says it changes: Lipschitz with 1
                let q = [p[0] + 0.3, p[1] - 0.4];
                assert!((shape.distance(q) - d).abs() <= 0.501, "{shape:?} at {p:?}");
                if d < 0.0 {
                    let b = shape.bounds();
                    assert!(
                        b.meets(&Bounds::around(p, [0.0; 2])),
                        "{shape:?} at {p:?} outside {b:?}"
                    );
                }
            }
        }
    }
}
