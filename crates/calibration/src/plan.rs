//! Where to take the marker: the paper's lattice, or fewer points spread evenly; ordered for a short tour.

use geometry::{Base, Point};
use serde::{Deserialize, Serialize};

/// A cuboid in the robot's base frame, edges along its axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Volume {
    /// Corner with the smallest coordinates.
    pub min: Point<Base>,
    /// Corner with the largest coordinates.
    pub max: Point<Base>,
}

impl Volume {
    /// The cuboid between two opposite corners.
    pub fn between(a: Point<Base>, b: Point<Base>) -> Self {
        Self {
            min: Point::from_vector(a.vector().inf(&b.vector())),
            max: Point::from_vector(a.vector().sup(&b.vector())),
        }
    }

    /// True if the point lies in the cuboid or on its surface.
    pub fn contains(&self, p: Point<Base>) -> bool {
        (0..3).all(|a| (self.min.to_array()[a]..=self.max.to_array()[a]).contains(&p.to_array()[a]))
    }

    /// The place at these shares of the edges: 0 at the low corner, 1 at the high one.
    pub fn at(&self, share: [f64; 3]) -> Point<Base> {
        let extent = self.extent_mm();
        let low = self.min.to_array();
        let along = |a: usize| low[a] + share[a] * extent[a];
        Point::new(along(0), along(1), along(2))
    }

    /// Edge lengths, mm.
    pub fn extent_mm(&self) -> [f64; 3] {
        (self.max.vector() - self.min.vector()).into()
    }
}

/// One place to visit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Number of the visit, in order.
    pub id: u64,
    /// Lattice node (i along x, j along y, k along z); `None` off a lattice.
    pub node: Option<[i32; 3]>,
    /// Where the marker goes.
    pub command: Point<Base>,
}

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The spacing is not a length.
    #[error("a spacing of {spacing_mm} mm gives no lattice; choose 20 to 200 mm")]
    Spacing {
        /// What was asked for, mm.
        spacing_mm: f64,
    },
    /// The volume is flat or its corners are not numbers.
    #[error("a volume of {extent_mm:?} mm cannot hold a lattice; every edge must be longer than 0")]
    Volume {
        /// Its edges, mm.
        extent_mm: [f64; 3],
    },
    /// Too few or too many points.
    #[error("{points} points make no calibration; choose 20 to 2,000 (100 take 10 minutes)")]
    Points {
        /// What was asked for.
        points: usize,
    },
    /// More nodes than anyone would visit.
    #[error("{nodes} nodes at {spacing_mm} mm would take days; choose a wider spacing (the limit is 100,000)")]
    TooMany {
        /// Nodes of the lattice.
        nodes: f64,
        /// What was asked for, mm.
        spacing_mm: f64,
    },
}

/// Nodes along each axis: as many as cover the volume at no more than `spacing_mm`, at least three, which the second-order
/// interpolation needs. The paper's 400 x 900 x 750 mm at 50 mm has 9 x 19 x 16.
///
/// # Errors
/// [`PlanError`] for a spacing or a volume that makes no lattice.
pub fn node_counts(volume: &Volume, spacing_mm: f64) -> Result<[i32; 3], PlanError> {
    if !(spacing_mm.is_finite() && spacing_mm > 0.0) {
        return Err(PlanError::Spacing { spacing_mm });
    }
    let extent_mm = volume.extent_mm();
    if !extent_mm.iter().all(|e| e.is_finite() && *e > 0.0) {
        return Err(PlanError::Volume { extent_mm });
    }
    let counts = extent_mm.map(|e| ((e / spacing_mm - 1e-6).ceil() + 1.0).max(3.0));
    let nodes = counts.iter().product();
    if nodes > 1e5 {
        return Err(PlanError::TooMany { nodes, spacing_mm });
    }
    Ok(counts.map(|n| n as i32))
}

/// The paper's lattice over a volume, borders included, as a tour in which each step is one spacing long: along y, back along
/// the next row, and layer upon layer in z.
///
/// # Errors
/// As for [`node_counts`].
pub fn lattice(volume: &Volume, spacing_mm: f64) -> Result<Vec<Target>, PlanError> {
    let counts = node_counts(volume, spacing_mm)?;
    let [nx, ny, nz] = counts;
    let (min, extent) = (volume.min.to_array(), volume.extent_mm());
    // a walk of length `n`, reversed on every other pass
    let sweep = |n: i32, pass: i32| (0..n).map(move |s| if pass % 2 == 0 { s } else { n - 1 - s });
    let mut targets = Vec::with_capacity((nx * ny * nz) as usize);
    for k in 0..nz {
        for (row, i) in sweep(nx, k).enumerate() {
            for j in sweep(ny, k * nx + row as i32) {
                let node = [i, j, k];
                let at = |a: usize| min[a] + extent[a] * f64::from(node[a]) / f64::from(counts[a] - 1);
                targets.push(Target {
                    id: targets.len() as u64,
                    node: Some(node),
                    command: Point::new(at(0), at(1), at(2)),
                });
            }
        }
    }
    Ok(targets)
}

/// So many points over a volume, its corners first among them, the others spread evenly (the R3 sequence, Roberts 2018) and drawn
/// towards the borders, where a fit is least certain; as a short tour.
///
/// # Errors
/// [`PlanError::Points`], [`PlanError::Volume`].
pub fn scattered(volume: &Volume, points: usize) -> Result<Vec<Target>, PlanError> {
    if !(20..=2000).contains(&points) {
        return Err(PlanError::Points { points });
    }
    let extent_mm = volume.extent_mm();
    if !extent_mm.iter().all(|e| e.is_finite() && *e > 0.0) {
        return Err(PlanError::Volume { extent_mm });
    }
    let corner = |c: usize| [0, 1, 2].map(|a| (c >> a & 1) as f64);
    // powers of the number whose fourth power is itself and one
    let steps = [
        0.819_172_513_396_164_5,
        0.671_043_606_703_789_2,
        0.549_700_477_901_970_3,
    ];
    let inner = |n: usize| {
        steps.map(|step| {
            let even = (0.5 + n as f64 * step).fract();
            0.5 * (even + 0.5 - 0.5 * (std::f64::consts::PI * even).cos())
        })
    };
    let min = volume.min.to_array();
    let places = (0..8).map(corner).chain((1..=points - 8).map(inner));
    let commands: Vec<Point<Base>> = places
        .map(|u| {
            Point::new(
                min[0] + extent_mm[0] * u[0],
                min[1] + extent_mm[1] * u[1],
                min[2] + extent_mm[2] * u[2],
            )
        })
        .collect();
    let visit = |(id, command): (usize, Point<Base>)| Target {
        id: id as u64,
        node: None,
        command,
    };
    Ok(tour(commands).into_iter().enumerate().map(visit).collect())
}

/// The points in the order of a short way from the first: always to the nearest, then crossings taken out (2-opt).
fn tour(mut points: Vec<Point<Base>>) -> Vec<Point<Base>> {
    for k in 1..points.len() {
        let here = points[k - 1];
        let nearest =
            (k..points.len()).min_by(|&a, &b| here.distance_mm(points[a]).total_cmp(&here.distance_mm(points[b])));
        points.swap(k, nearest.unwrap_or(k));
    }
    for _ in 0..20 {
        let mut shorter = false;
        for a in 0..points.len().saturating_sub(2) {
            for b in a + 2..points.len() {
                let step = |p: usize, q: usize| {
                    if q < points.len() {
                        points[p].distance_mm(points[q])
                    } else {
                        0.0
                    }
                };
                if step(a, b) + step(a + 1, b + 1) + 1e-9 < step(a, a + 1) + step(b, b + 1) {
                    points[a + 1..=b].reverse();
                    shorter = true;
                }
            }
        }
        if !shorter {
            break;
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paper() -> Volume {
        Volume::between(Point::new(1350.0, -450.0, 900.0), Point::new(950.0, 450.0, 150.0))
    }

    #[test]
    fn the_papers_lattice_is_a_tour_of_single_steps() -> Result<(), PlanError> {
        let targets = lattice(&paper(), 50.0)?;
        assert_eq!(targets.len(), 2736);
        assert_eq!(node_counts(&paper(), 50.0)?, [9, 19, 16]);
        for pair in targets.windows(2) {
            assert!((pair[0].command.distance_mm(pair[1].command) - 50.0).abs() < 1e-9);
        }
        let nodes: std::collections::HashSet<_> = targets.iter().map(|t| t.node).collect();
        assert_eq!(nodes.len(), 2736);
        assert!(targets.iter().all(|t| paper().contains(t.command)));
        Ok(())
    }

    #[test]
    fn a_spacing_that_does_not_divide_still_reaches_the_borders() -> Result<(), PlanError> {
        let targets = lattice(&paper(), 130.0)?;
        assert_eq!(node_counts(&paper(), 130.0)?, [5, 8, 7]);
        assert!(targets.iter().any(|t| t.command == paper().max));
        assert_eq!(node_counts(&paper(), 5000.0)?, [3, 3, 3]);
        Ok(())
    }

    #[test]
    fn scattered_points_fill_the_volume_in_a_short_tour() -> Result<(), PlanError> {
        let targets = scattered(&paper(), 100)?;
        assert_eq!(targets.len(), 100);
        assert!(targets.iter().all(|t| paper().contains(t.command) && t.node.is_none()));
        for c in 0..8 {
            let at = |a: usize| if c >> a & 1 == 0 { paper().min } else { paper().max }.to_array()[a];
            let corner = Point::new(at(0), at(1), at(2));
            assert!(
                targets.iter().any(|t| t.command.distance_mm(corner) < 1e-9),
                "{corner:?}"
            );
        }
        // nowhere far from all of them
        for k in 0..500 {
            let u = |m: f64| (f64::from(k) * m).fract();
            let place = Point::new(
                950.0 + 400.0 * u(0.618),
                -450.0 + 900.0 * u(0.414),
                150.0 + 750.0 * u(0.732),
            );
            let nearest = targets
                .iter()
                .map(|t| t.command.distance_mm(place))
                .fold(f64::INFINITY, f64::min);
            assert!(nearest < 200.0, "{place:?}: {nearest}");
        }
        let way: f64 = targets.windows(2).map(|w| w[0].command.distance_mm(w[1].command)).sum();
        assert!(way < 100.0 * 160.0, "{way} mm"); // an even spread has neighbours 140 mm apart
        assert!(matches!(scattered(&paper(), 10), Err(PlanError::Points { .. })));
        Ok(())
    }

    #[test]
    fn nonsense_is_refused() {
        assert!(matches!(lattice(&paper(), 0.0), Err(PlanError::Spacing { .. })));
        assert!(matches!(lattice(&paper(), 1.0), Err(PlanError::TooMany { .. })));
        let flat = Volume::between(Point::new(0.0, 0.0, 0.0), Point::new(1.0, 1.0, 0.0));
        assert!(matches!(lattice(&flat, 50.0), Err(PlanError::Volume { .. })));
    }
}
