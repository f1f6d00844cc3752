//! Pairs to the map from camera to robot: plan, fit, apply, report.
//!
//! Between finding a screw in the camera's frame and driving to it stands this crate. [`lattice`] says where the marker goes,
//! a capture appends a [`Pair`] for every visit ([`PairWriter`]), [`Map::fit`] makes of them a [`Map`], and [`Map::apply`] turns a
//! `Point<Camera>` into a `Point<Base>` with a sigma across and along the viewing ray and a word on whether it lies in the
//! calibrated volume. [`verify`] tells from fresh pairs whether a map still holds; [`Map::realign`] makes it true again after a bump or a
//! crash, and [`Map::correct`] takes out what a needle shows to be left. It uses only `geometry`.
//!
//! Methods stand side by side. `gp`, the default, is a Gaussian process of what a rigid motion leaves, across and along the
//! viewing ray, with waves of the joint angles for the ripple of the gears: 100 points do. `lattice` is the paper's Algorithm 2
//! (global linear map, 27 neighbours, second-order interpolation) with what real data needs: outliers are rejected by robust local
//! prediction, and thin neighbourhoods fall back to wider ones, to first order, and at last to the global map.
//!
//! ```
//! use calibration::{Map, Pair, Settings, Volume, lattice};
//! use geometry::{Base, Camera, Point, Transform};
//!
//! // the arm visits a lattice; here the camera sees it perfectly, from 2 m away
//! let camera_from_base: Transform<Camera, Base> =
//!     Transform::from_parts([0.0, 0.0, 2000.0], nalgebra::UnitQuaternion::from_euler_angles(0.3, -0.2, 1.5));
//! let volume = Volume::between(Point::new(950.0, -450.0, 150.0), Point::new(1350.0, 450.0, 900.0));
//! let pairs: Vec<Pair> = lattice(&volume, 150.0)?
//!     .into_iter()
//!     .map(|target| Pair {
//!         id: target.id,
//!         node: target.node,
//!         t_s: 6.0 * target.id as f64,
//!         command: target.command,
//!         pixel: None,
//!         depth_mm: None,
//!         camera: Some(camera_from_base * target.command),
//!         joints_rad: None,
//!         valid: true,
//!     })
//!     .collect();
//! let (map, report) = Map::fit(&pairs, &Settings::default())?;
//! println!("{report}");
//!
//! let screw: Point<Base> = Point::new(1100.0, 20.0, 600.0);
//! let found = map.apply(camera_from_base * screw);
//! assert!(found.base.distance_mm(screw) < 1e-3);
//! assert_eq!(found.hull, calibration::Hull::Inside);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod arm;
mod correct;
mod diagnose;
mod gp;
mod lattice;
mod map;
mod pair;
mod plan;
mod pose;
mod realign;
mod report;
mod rigid;
mod ripple;
mod tps;

pub use correct::{Between, CorrectError, Mark};
pub use diagnose::{Diagnosis, Drift, Judged, WithFewer, diagnose, volume_covered};
pub use lattice::Level;
pub use map::{ArmModel, Check, Hull, Identity, Map, MapError, MappedPoint, Method, Settings, camera_identity};
pub use pair::{Pair, PairError, PairWriter, Query, read_marks, read_pairs, read_queries, write_pairs};
pub use plan::{PlanError, Target, Volume, lattice, node_counts, scattered};
pub use pose::{HandEye, PoseError};
pub use realign::{Moved, RealignError, Realignment};
pub use report::{Figures, FitReport, Rejected, Spread, Verification, rigid_figures, verify};
pub use rigid::FitError;
