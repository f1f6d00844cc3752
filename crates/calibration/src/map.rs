//! The map from camera to robot: fitted from pairs, kept in a file with all that made it, asked for points with their sigma.

use crate::{
    Figures, FitError, FitReport, Level, Pair, Rejected, Volume,
    arm::Arm,
    correct,
    gp::{self, Choice, Gp, Stance},
    lattice::{Estimate, Grid, LEVELS, MAX_LEVERAGE, Model, Shape, believable, split},
    pair, realign,
    rigid::{self, Points, quantile},
    tps::{self, Spline},
};
use geometry::{Base, Camera, CameraModel, Point, Transform};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// How a map is fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// One rigid motion: what hand-eye calibration gives.
    Rigid,
    /// One affine map: the paper's global linear map alone.
    Affine,
    /// The paper's Algorithm 2: global map, then second order among the 27 points around.
    Lattice,
    /// A thin-plate spline of what the rigid motion leaves, smoothed by the least left-out error.
    Tps,
    /// A Gaussian process of what the rigid motion leaves, and the ripple of the gears where the pairs have joint angles of a
    /// GP25: 100 points do as well as thousands do for the others.
    #[default]
    Gp,
}

impl Method {
    /// Name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rigid => "rigid",
            Self::Affine => "affine",
            Self::Lattice => "lattice",
            Self::Tps => "tps",
            Self::Gp => "gp",
        }
    }

    /// Fewest pairs for which the fit and its held-out figures mean something.
    fn fewest_pairs(self) -> usize {
        match self {
            Self::Rigid => 5,
            Self::Affine => 8,
            Self::Lattice | Self::Tps | Self::Gp => 20,
        }
    }
}

/// Where J1 to J3 at a query come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ArmModel {
    /// From the kinematics of a GP25 where the pairs' joint angles are of one, else from a regression on them.
    #[default]
    FromPairs,
    /// From the kinematics of a GP25; pairs with other joint angles are refused.
    Gp25,
}

/// Whose map it is: a map is true for one arm and one camera only.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// The arm, as the cell's file names it.
    pub arm: String,
    /// The camera: see [`camera_identity`].
    pub camera: String,
}

/// A name for a camera that changes whenever its intrinsics do, since pairs and queries must share them.
pub fn camera_identity(model: &CameraModel) -> String {
    let text = format!("{model:?}");
    format!("sha256:{}", &geometry::sha256_hex(text.as_bytes())[..16])
}

/// What the user chooses about a fit, and what the file should remember.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The method.
    pub method: Method,
    /// Exactly as published: no rejection, no fallback, steps between neighbourhoods. For comparison.
    #[serde(default)]
    pub as_published: bool,
    /// Where joint angles at a query come from, where the pairs have any (method `gp`).
    #[serde(default)]
    pub arm_model: ArmModel,
    /// The arm and the camera that the pairs come from.
    pub identity: Identity,
    /// When the pairs were taken, RFC 3339.
    pub date: String,
}

/// Where a point lies with respect to the calibrated volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Hull {
    /// Between calibrated points.
    Inside,
    /// Within one spacing outside, or where the neighbourhood is too thin to be sure.
    Edge,
    /// Beyond: never a target.
    Outside,
}

/// A camera point in the robot's base frame, and how sure that is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MappedPoint {
    /// Where to command the tool to go.
    pub base: Point<Base>,
    /// Standard deviation along each of the two axes across the viewing ray, mm: of the map and of one measurement such as the pairs'.
    pub sigma_lateral_mm: f64,
    /// Standard deviation along the viewing ray, mm: likewise.
    pub sigma_depth_mm: f64,
    /// Whether the point lies in the calibrated volume.
    pub hull: Hull,
}

/// What the last check with fresh pairs said.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Check {
    /// When, RFC 3339.
    pub date: String,
    /// True if the map passed.
    pub passed: bool,
    /// 95 % of the errors were within this, mm.
    pub p95_mm: f64,
}

/// Why a map file cannot be used, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The file could not be read.
    #[error("cannot read map {path}: {source}; check the path, or fit one with `unscrew calibrate fit`")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error("cannot write map: {0}")]
    Write(#[from] geometry::FileError),
    /// Not a map file, or a damaged one.
    #[error("{path} is not a whole map file ({reason}); fit it again with `unscrew calibrate fit`")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A map of a later program.
    #[error("{path} is a map of version {found}, this program reads up to {VERSION}; update it or fit the map again")]
    Version {
        /// The file.
        path: PathBuf,
        /// The version in the file.
        found: u64,
    },
    /// A map that was fitted with another camera.
    #[error("{path} was fitted for camera '{found}', not for '{wanted}'; calibrate with this camera")]
    WrongCamera {
        /// The file.
        path: PathBuf,
        /// The camera in the file.
        found: String,
        /// The camera of the cell.
        wanted: String,
    },
    /// A map that failed its last check.
    #[error(
        "{path} failed its check of {date} (95 % within {p95_mm:.3} mm): realign it with `unscrew calibrate realign`, or calibrate anew"
    )]
    FailedCheck {
        /// The file.
        path: PathBuf,
        /// When it was checked.
        date: String,
        /// What the check gave, mm.
        p95_mm: f64,
    },
    /// A map that was fitted with another arm.
    #[error("{path} was fitted for arm '{found}', not for '{wanted}'; calibrate this arm")]
    WrongArm {
        /// The file.
        path: PathBuf,
        /// The arm in the file.
        found: String,
        /// The arm of the cell.
        wanted: String,
    },
}

const FORMAT: &str = "unscrew-map";
const VERSION: u64 = 4;
/// What a map with layers is written as, if nothing is known of its arm's flaws, and what one without layers: programs of before read them.
const VERSION_WITHOUT_FLAWS: u64 = 3;
const VERSION_WITHOUT_LAYERS: u64 = 2;

/// Standard deviation of one measurement about the map for each level of the fallback: across the ray and along it, mm.
type Scales = [[f64; 2]; 4];

/// A map from camera to base.
#[derive(Clone)]
pub struct Map {
    file: MapFile,
    model: Model,
    gp: Option<Gp>,
    spline: Option<Spline>,
}

/// What is written: the points that the map rests on; everything else follows from them.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct MapFile {
    format: String,
    version: u64,
    made_by: String,
    pairs_sha256: String,
    settings: Settings,
    held_out: Figures,
    rejected: usize,
    base_from_camera: Transform<Base, Camera>,
    volume: Volume,
    scales_mm: Scales,
    /// What a Gaussian process rests on beside the points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    gp: Option<Choice>,
    /// What has moved since.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    realigned: Option<realign::Layer>,
    /// What the last check said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    checked: Option<Check>,
    /// What a needle showed to be left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    correction: Option<correct::Layer>,
    grid: Grid,
    points: Vec<Support>,
}

/// One accepted pair.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Support {
    id: u64,
    camera: Point<Camera>,
    command: Point<Base>,
    /// J1 to J3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    joints_rad: Option<[f64; 3]>,
    /// The sign of each one's last motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    came_from: Option<[f64; 3]>,
}

impl Support {
    /// How the arm stood.
    fn stance(&self) -> Option<Stance> {
        Some(Stance {
            joints_rad: self.joints_rad?,
            came_from: self.came_from.unwrap_or_default(),
        })
    }
}

impl std::fmt::Debug for Map {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut out = f.debug_struct("Map");
        out.field("settings", &self.file.settings)
            .field("points", &self.file.points.len())
            .finish_non_exhaustive()
    }
}

impl Map {
    /// Fits a map to pairs; rows that missed the marker are passed over.
    ///
    /// # Errors
    /// [`FitError`]: too few points, all in a plane, duplicate ids, metres, swapped columns, a mirrored frame, no common motion.
    pub fn fit(pairs: &[Pair], settings: &Settings) -> Result<(Self, FitReport), FitError> {
        let method = settings.method;
        let points = rigid::usable(pairs, method.fewest_pairs(), method.name())?;
        let motion = rigid::robust_rigid(&points)?;
        let nodes: Vec<_> = points.index.iter().map(|&i| pairs[i].node).collect();
        let grid = Grid::over(&nodes, &points.command);
        let mut keep = if settings.as_published {
            vec![true; points.index.len()]
        } else {
            believable(&points, &motion, &grid)
        };
        let stances = stances(pairs);
        let fitted = match method {
            Method::Gp => Some(gaussian(settings.arm_model, &stances, &points, &mut keep)?),
            _ => None,
        };
        let used: Vec<usize> = (0..keep.len()).filter(|&i| keep[i]).collect();
        if used.len() < method.fewest_pairs() {
            return Err(FitError::TooFew {
                have: used.len(),
                need: method.fewest_pairs(),
                method: method.name(),
            });
        }
        let camera: Vec<_> = used.iter().map(|&i| points.camera[i]).collect();
        let command: Vec<_> = used.iter().map(|&i| points.command[i]).collect();
        let model = Model::bake(shape(settings), grid, &camera, &command);

        let ray = |i: usize| model.ray(camera[i]);
        let bent = match method {
            Method::Tps => Some(spline(&camera, &command).ok_or(FitError::TooFew {
                have: used.len(),
                need: method.fewest_pairs(),
                method: method.name(),
            })?),
            _ => None,
        };
        let held: Vec<Estimate> = model.leave_one_out(&camera, &command);
        let errors: Vec<_> = match (&fitted, &bent) {
            (Some(fitted), _) => fitted
                .choice
                .points
                .iter()
                .zip(&fitted.left_out)
                .map(|(&i, e)| (*e, ray(i)))
                .collect(),
            (None, Some(bent)) => bent
                .0
                .iter()
                .zip(&bent.1.left_out)
                .map(|(&i, e)| (*e, ray(i)))
                .collect(),
            (None, None) => (0..).zip(&held).map(|(i, e)| (e.base - command[i], ray(i))).collect(),
        };
        let rigid_errors: Vec<_> = (0..used.len())
            .map(|i| {
                (
                    model.motion * nalgebra::Point3::from(camera[i]) - nalgebra::Point3::from(command[i]),
                    ray(i),
                )
            })
            .collect();
        let mut rejected: Vec<Rejected> = (0..keep.len())
            .filter(|&i| !keep[i])
            .map(|i| {
                let says = match &fitted {
                    Some(fitted) => fitted.gp.at(points.camera[i]).base,
                    None => model.estimate(points.camera[i]).base,
                };
                let error = points.command[i] - says;
                let (lateral_mm, depth_mm) = split(error, -model.ray(points.camera[i]));
                Rejected {
                    id: pairs[points.index[i]].id,
                    residual_mm: error.norm(),
                    lateral_mm,
                    depth_mm,
                }
            })
            .collect();
        rejected.sort_by(|a, b| b.residual_mm.total_cmp(&a.residual_mm));

        let mut report = FitReport {
            n_pairs: pairs.len(),
            n_invalid: pairs.len() - points.index.len(),
            n_used: used.len(),
            rejected,
            spacing_mm: model.grid.spacing_mm(),
            held_out: Figures::of(&errors),
            rigid_only: Figures::of(&rigid_errors),
            neighbourhoods: LEVELS.into_iter().zip(model.levels()).filter(|(_, n)| *n > 0).collect(),
            notes: Vec::new(),
        };
        report.remark();
        if let Some(ripple) = fitted.as_ref().and_then(|f| f.choice.ripple.as_ref()) {
            report.notes.push(format!("ripple of the gears is taken out: {ripple}"));
        }
        let armed = fitted.as_ref().is_some_and(|f| f.choice.flawed.is_some());
        let support = |(&i, (c, t)): (&usize, (&Vector3<f64>, &Vector3<f64>))| {
            let stance = stances[points.index[i]].filter(|_| armed);
            Support {
                id: pairs[points.index[i]].id,
                camera: Point::from_vector(*c),
                command: Point::from_vector(*t),
                joints_rad: stance.map(|s| s.joints_rad),
                came_from: stance.map(|s| s.came_from),
            }
        };
        let (low, high) = command
            .iter()
            .fold((command[0], command[0]), |(l, h), p| (l.inf(p), h.sup(p)));
        let file = MapFile {
            format: FORMAT.into(),
            version: if armed { VERSION } else { VERSION_WITHOUT_LAYERS },
            made_by: concat!("unscrew ", env!("CARGO_PKG_VERSION")).into(),
            pairs_sha256: format!("sha256:{}", geometry::sha256_hex(pair::to_csv(pairs).as_bytes())),
            settings: settings.clone(),
            held_out: report.held_out,
            rejected: report.rejected.len(),
            base_from_camera: Transform::from_isometry(model.motion),
            volume: Volume::between(Point::from_vector(low), Point::from_vector(high)),
            scales_mm: match &bent {
                Some(_) => [measured(&errors); 4],
                None => scales(&model, &camera, &command, &held),
            },
            gp: fitted.as_ref().map(|f| f.choice.clone()),
            realigned: None,
            checked: None,
            correction: None,
            grid: model.grid.clone(),
            points: used.iter().zip(camera.iter().zip(&command)).map(support).collect(),
        };
        let (gp, spline) = (fitted.map(|f| f.gp), bent.map(|b| b.1.spline));
        Ok((
            Self {
                file,
                model,
                gp,
                spline,
            },
            report,
        ))
    }

    /// Where a camera point is in the robot's base frame.
    pub fn apply(&self, camera: Point<Camera>) -> MappedPoint {
        let Some(layer) = &self.file.realigned else {
            return self.corrected(self.as_fitted(camera));
        };
        let then = layer.before(camera);
        let mapped = self.as_fitted(then);
        let base = mapped.base.vector();
        let rotation = self.model.motion.rotation.to_rotation_matrix();
        let [lateral, depth] = layer.variance(rotation.matrix(), then.vector(), base);
        self.corrected(MappedPoint {
            base: Point::from_vector(base + layer.after(base)),
            sigma_lateral_mm: (mapped.sigma_lateral_mm.powi(2) + lateral).sqrt(),
            sigma_depth_mm: (mapped.sigma_depth_mm.powi(2) + depth).sqrt(),
            hull: mapped.hull,
        })
    }

    fn corrected(&self, mapped: MappedPoint) -> MappedPoint {
        let Some(layer) = &self.file.correction else {
            return mapped;
        };
        let base = mapped.base.vector();
        MappedPoint {
            base: Point::from_vector(base + layer.at(base)),
            ..mapped
        }
    }

    /// As it was when it was fitted.
    fn as_fitted(&self, camera: Point<Camera>) -> MappedPoint {
        let e = self.model.estimate(camera.vector());
        // nothing measured supports a point outside or in a hole: its sigma grows with the distance
        let beyond = 1.0 + e.outside.max(e.nearest.clamp(1.0, 2.0) - 1.0);
        if let Some(gp) = &self.gp {
            let answer = gp.at(camera.vector());
            let [lateral, depth] = answer.sigma_mm;
            return MappedPoint {
                base: Point::from_vector(answer.base),
                sigma_lateral_mm: lateral * beyond,
                sigma_depth_mm: depth * beyond,
                hull: hull(&e, answer.leverage, 1.5),
            };
        }
        let sigma = |component: usize| {
            let variance: f64 = (0..LEVELS.len())
                .map(|l| self.file.scales_mm[l][component].powi(2) * (e.share[l] + e.variance[l]))
                .sum();
            variance.sqrt() * beyond
        };
        let base = self.spline.as_ref().map_or(e.base, |spline| spline.at(camera.vector()));
        MappedPoint {
            base: Point::from_vector(base),
            sigma_lateral_mm: sigma(0),
            sigma_depth_mm: sigma(1),
            hull: hull(&e, e.variance.iter().sum(), 1.2),
        }
    }

    /// How far baking moves the answers of a `gp` map at places of the camera's frame, 3D, mm: what queries of a microsecond cost. Nothing
    /// for other methods. Takes as long as baking does.
    pub fn baking_errors_mm(&self, places: &[Point<Camera>]) -> Vec<f64> {
        let (Some(gp), Some(choice)) = (&self.gp, &self.file.gp) else {
            return Vec::new();
        };
        let points: Vec<&Support> = choice.points.iter().map(|&i| &self.file.points[i]).collect();
        let camera: Vec<_> = points.iter().map(|p| p.camera.vector()).collect();
        let command: Vec<_> = points.iter().map(|p| p.command.vector()).collect();
        let stances = points.iter().map(|p| p.stance()).collect();
        let asked: Vec<_> = places.iter().map(|p| p.vector()).collect();
        gp.baking_errors(&camera, &command, stances, choice, &asked)
            .unwrap_or_default()
    }

    /// Writes the map, aside and then renamed.
    ///
    /// # Errors
    /// [`MapError::Write`].
    pub fn save(&self, path: &Path) -> Result<(), MapError> {
        let text = serde_json::to_vec(&self.file).map_err(|e| MapError::Format {
            path: path.into(),
            reason: e.to_string(),
        })?;
        Ok(geometry::write_aside(path, &text)?)
    }

    /// Reads a map.
    ///
    /// # Errors
    /// [`MapError`]: no map file, a damaged one, or one of a later program.
    pub fn load(path: &Path) -> Result<Self, MapError> {
        let bytes = std::fs::read(path).map_err(|source| MapError::Read {
            path: path.into(),
            source,
        })?;
        let bad = |reason: String| MapError::Format {
            path: path.into(),
            reason,
        };
        #[derive(Deserialize)]
        struct Head {
            format: String,
            version: u64,
        }
        let head: Head = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
        if head.format != FORMAT {
            return Err(bad(format!("its format is '{}', not '{FORMAT}'", head.format)));
        }
        if head.version > VERSION {
            return Err(MapError::Version {
                path: path.into(),
                found: head.version,
            });
        }
        let file: MapFile = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
        if file.points.len() < file.settings.method.fewest_pairs() {
            return Err(bad(format!("it holds only {} points", file.points.len())));
        }
        let camera: Vec<_> = file.points.iter().map(|p| p.camera.vector()).collect();
        let command: Vec<_> = file.points.iter().map(|p| p.command.vector()).collect();
        let model = Model::bake(shape(&file.settings), file.grid.clone(), &camera, &command);
        let gp = match &file.gp {
            Some(choice) => {
                let points: Option<Vec<&Support>> = choice.points.iter().map(|&i| file.points.get(i)).collect();
                let points = points.ok_or_else(|| bad("it rests on points that it does not hold".into()))?;
                let camera: Vec<_> = points.iter().map(|p| p.camera.vector()).collect();
                let command: Vec<_> = points.iter().map(|p| p.command.vector()).collect();
                let stances: Option<Vec<_>> = points.iter().map(|p| p.stance()).collect();
                let again = Gp::again(&camera, &command, stances, choice);
                Some(again.ok_or_else(|| bad("its points do not determine it".into()))?)
            }
            None => None,
        };
        let spline = match file.settings.method {
            Method::Tps => {
                let again = spline(&camera, &command);
                Some(
                    again
                        .ok_or_else(|| bad("its points do not determine it".into()))?
                        .1
                        .spline,
                )
            }
            _ => None,
        };
        Ok(Self {
            file,
            model,
            gp,
            spline,
        })
    }

    /// Reads a map and makes sure that it belongs to this arm and this camera.
    ///
    /// # Errors
    /// As for [`load`](Self::load), [`MapError::WrongCamera`], [`MapError::WrongArm`], [`MapError::FailedCheck`].
    pub fn load_for(path: &Path, identity: &Identity) -> Result<Self, MapError> {
        let map = Self::load(path)?;
        map.belongs_to(Some(&identity.arm), Some(&identity.camera), path)?;
        if let Some(check) = map.file.checked.as_ref().filter(|c| !c.passed) {
            return Err(MapError::FailedCheck {
                path: path.into(),
                date: check.date.clone(),
                p95_mm: check.p95_mm,
            });
        }
        Ok(map)
    }

    /// Makes sure that a map, which was read from `path`, is of this arm and of this camera (see [`camera_identity`]), as far as they are
    /// given.
    ///
    /// # Errors
    /// [`MapError::WrongCamera`], [`MapError::WrongArm`].
    pub fn belongs_to(&self, arm: Option<&str>, camera: Option<&str>, path: &Path) -> Result<(), MapError> {
        let own = self.identity();
        if let Some(wanted) = camera.filter(|c| *c != own.camera) {
            return Err(MapError::WrongCamera {
                path: path.into(),
                found: own.camera.clone(),
                wanted: wanted.into(),
            });
        }
        if let Some(wanted) = arm.filter(|a| *a != own.arm) {
            return Err(MapError::WrongArm {
                path: path.into(),
                found: own.arm.clone(),
                wanted: wanted.into(),
            });
        }
        Ok(())
    }

    pub(crate) fn with_layer(&self, layer: realign::Layer) -> Self {
        let mut map = self.clone();
        (map.file.version, map.file.realigned) = (map.file.version.max(VERSION_WITHOUT_FLAWS), Some(layer));
        map.file.checked = None; // of how it was before
        map
    }

    pub(crate) fn with_correction(&self, layer: correct::Layer) -> Self {
        let mut map = self.clone();
        (map.file.version, map.file.correction) = (map.file.version.max(VERSION_WITHOUT_FLAWS), Some(layer));
        map
    }

    /// The map as before any realignment.
    pub(crate) fn without_realignment(&self) -> Self {
        let mut map = self.clone();
        map.file.realigned = None;
        map
    }

    /// What the last realignment found.
    pub fn realigned(&self) -> Option<&realign::Realignment> {
        self.file.realigned.as_ref().map(|layer| &layer.told)
    }

    /// The map with what a check said of it.
    pub fn with_check(&self, check: Check) -> Self {
        let mut map = self.clone();
        (map.file.version, map.file.checked) = (map.file.version.max(VERSION_WITHOUT_FLAWS), Some(check));
        map
    }

    /// When it was last known to be true, RFC 3339: fitted, realigned or checked.
    pub fn known_good_on(&self) -> &str {
        let checked = self.file.checked.as_ref().filter(|c| c.passed).map(|c| c.date.as_str());
        let realigned = self.realigned().map(|r| r.date.as_str());
        [checked, realigned, Some(self.file.settings.date.as_str())]
            .into_iter()
            .flatten()
            .max()
            .unwrap_or_default()
    }

    /// The arm's lengths and tool, where the pairs had joint angles.
    pub(crate) fn arm(&self) -> Option<&Arm> {
        let choice = self.file.gp.as_ref()?;
        choice.flawed.as_ref().or(choice.ripple.as_ref().map(|r| &r.arm))
    }

    /// The arm and the camera that the map is true for.
    pub fn identity(&self) -> &Identity {
        &self.file.settings.identity
    }

    /// How it was fitted.
    pub fn settings(&self) -> &Settings {
        &self.file.settings
    }

    /// Errors at points left out of the fit.
    pub fn held_out(&self) -> &Figures {
        &self.file.held_out
    }

    /// Noise of one measurement such as the pairs', as their likelihood tells it apart from what is smooth or ripple: standard deviation
    /// along each axis across the viewing ray, and along it, mm. Only a `gp` map knows it.
    pub fn noise_mm(&self) -> Option<[f64; 2]> {
        let choice = self.file.gp.as_ref()?;
        Some([choice.across.noise_mm, choice.along.noise_mm])
    }

    /// Hash of the pairs that it was fitted to (of their contract CSV).
    pub fn pairs_sha256(&self) -> &str {
        &self.file.pairs_sha256
    }

    /// Pairs that the map rests on.
    pub fn n_used(&self) -> usize {
        self.file.points.len()
    }

    /// The calibrated volume: the box of the accepted commands.
    pub fn volume(&self) -> Volume {
        self.file.volume
    }

    /// The rigid part of the map: good to some millimetres, for directions and for planning.
    pub fn base_from_camera(&self) -> Transform<Base, Camera> {
        match &self.file.realigned {
            Some(layer) => Transform::from_isometry(self.file.base_from_camera.isometry() * layer.then_from_now()),
            None => self.file.base_from_camera,
        }
    }

    pub(crate) fn ray(&self, camera: Point<Camera>) -> Vector3<f64> {
        self.model.ray(camera.vector())
    }
}

/// Where a point lies that is so far (in nodes) from the nearest calibrated one at most, if it is to be inside.
fn hull(e: &Estimate, leverage: f64, reach: f64) -> Hull {
    // a point measured on the border falls on either side of it by noise
    if e.outside <= 0.01 && e.nearest <= reach && leverage <= MAX_LEVERAGE {
        Hull::Inside
    } else if e.outside <= 1.0 && e.nearest <= 2.0 {
        Hull::Edge
    } else {
        Hull::Outside
    }
}

/// How the arm stood at every visit; where each joint came from is known from the visit before, whether the marker was seen there or not.
fn stances(pairs: &[Pair]) -> Vec<Option<Stance>> {
    /// A joint that turned less kept its side, rad.
    const STILL_RAD: f64 = 1e-4;
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by(|&a, &b| pairs[a].t_s.total_cmp(&pairs[b].t_s));
    let mut stances = vec![None; pairs.len()];
    let mut before: Option<Stance> = None;
    for i in order {
        let now = pairs[i].joints_rad.map(|[j1, j2, j3, ..]| {
            let joints_rad = [j1, j2, j3];
            let came_from = before.map_or([0.0; 3], |before| {
                std::array::from_fn(|j| match joints_rad[j] - before.joints_rad[j] {
                    turned if turned.abs() > STILL_RAD => turned.signum(),
                    _ => before.came_from[j],
                })
            });
            Stance { joints_rad, came_from }
        });
        before = now.or(before);
        stances[i] = now;
    }
    stances
}

/// The Gaussian process of the points that are believed, or of as many of them as it needs; `keep` says which are, before and after.
fn gaussian(
    model: ArmModel,
    stances: &[Option<Stance>],
    points: &Points,
    keep: &mut [bool],
) -> Result<gp::Fitted, FitError> {
    let believed = keep.iter().filter(|&&k| k).count();
    let method = Method::Gp;
    let too_few = FitError::TooFew {
        have: believed,
        need: method.fewest_pairs(),
        method: method.name(),
    };
    if believed < method.fewest_pairs() {
        return Err(too_few);
    }
    // doubted points have another chance, unless there are more than enough of the others
    let asked: Vec<usize> = (0..keep.len())
        .filter(|&i| keep[i] || keep.len() <= gp::MOST_POINTS)
        .collect();
    let used: Vec<usize> = spread(asked.len(), gp::MOST_POINTS)
        .into_iter()
        .map(|k| asked[k])
        .collect();
    let of = |all: &[Vector3<f64>]| -> Vec<Vector3<f64>> { used.iter().map(|&i| all[i]).collect() };
    let stances: Option<Vec<_>> = used.iter().map(|&i| stances[points.index[i]]).collect();
    let command = of(&points.command);
    let joints: Option<Vec<_>> = stances.as_ref().map(|s| s.iter().map(|s| s.joints_rad).collect());
    let arm = match (model, &joints) {
        (_, None) => None,
        (ArmModel::FromPairs, Some(joints)) => Arm::of(&command, joints),
        (ArmModel::Gp25, Some(joints)) => {
            Some(Arm::gp25(&command, joints).map_err(|scatter_mm| FitError::NotThisArm { scatter_mm })?)
        }
    };
    let at_first = used.iter().map(|&i| keep[i]).collect();
    let mut fitted = gp::fit(&of(&points.camera), &command, stances.as_deref(), arm, at_first).ok_or(too_few)?;
    for (&i, &kept) in used.iter().zip(&fitted.keep) {
        keep[i] = kept;
    }
    // from places among the usable points to places among the believed
    let mut place = 0;
    for (i, &kept) in keep.iter().enumerate() {
        if kept && used.binary_search(&i).is_ok() {
            fitted.choice.points.push(place);
        }
        place += usize::from(kept);
    }
    Ok(fitted)
}

/// The spline over the believed points, or over as many of them as it needs, and which these are.
fn spline(camera: &[Vector3<f64>], command: &[Vector3<f64>]) -> Option<(Vec<usize>, tps::Fitted)> {
    let picked = spread(camera.len(), gp::MOST_POINTS);
    let of = |all: &[Vector3<f64>]| -> Vec<Vector3<f64>> { picked.iter().map(|&i| all[i]).collect() };
    let fitted = Spline::fit(&of(camera), &of(command))?;
    Some((picked, fitted))
}

/// At most `most` of `n` places, spread also where they are in the order of a lattice.
fn spread(n: usize, most: usize) -> Vec<usize> {
    let mut places: Vec<usize> = (0..n).collect();
    if n > most {
        let key = |i: usize| (i as f64 * 0.618_033_988_749_895).fract();
        places.sort_by(|&a, &b| key(a).total_cmp(&key(b)));
        places.truncate(most);
        places.sort_unstable();
    }
    places
}

/// Sigma of one measurement and the map from left-out errors: across the ray, along each axis, and along it.
fn measured(errors: &[(Vector3<f64>, Vector3<f64>)]) -> [f64; 2] {
    let parts: Vec<_> = errors.iter().map(|(error, ray)| split(*error, *ray)).collect();
    let at = |values: Vec<f64>| quantile(values, 0.6827);
    // the length of two components is within 1.515 sigma in 68.27 % of cases
    [
        at(parts.iter().map(|p| p.0).collect()) / 1.5151,
        at(parts.iter().map(|p| p.1.abs()).collect()),
    ]
}

fn shape(settings: &Settings) -> Shape {
    Shape {
        affine: settings.method != Method::Rigid,
        local: settings.method == Method::Lattice,
        published: settings.as_published,
    }
}

/// Sigma of one measurement for each level: the error that 68.27 % of the held-out components do not exceed, each divided by
/// what its own fit adds. A quantile, since the few large errors of a lens or of gears would make sigma too wide for the many.
fn scales(model: &Model, camera: &[Vector3<f64>], command: &[Vector3<f64>], held: &[Estimate]) -> Scales {
    const ONE_SIGMA: f64 = 0.6827;
    let scale = |errors: Vec<(usize, Vector3<f64>, f64)>| -> Option<[f64; 2]> {
        if errors.len() < 5 {
            return None;
        }
        let (mut lateral, mut depth) = (Vec::new(), Vec::new());
        for (i, error, leverage) in errors {
            let (across, along) = split(error, model.ray(camera[i]));
            let s = (1.0 + leverage).sqrt();
            lateral.push(across / s);
            depth.push(along.abs() / s);
        }
        // the length of two components is within 1.515 sigma in 68.27 % of cases
        Some([quantile(lateral, ONE_SIGMA) / 1.5151, quantile(depth, ONE_SIGMA)])
    };
    let pure = |level: Level| -> Vec<(usize, Vector3<f64>, f64)> {
        let l = level as usize;
        let own = held.iter().enumerate().filter(|(_, e)| e.share[l] > 0.999);
        own.map(|(i, e)| (i, e.base - command[i], e.variance[l])).collect()
    };
    let global = scale(model.leave_one_out_at(Level::Global, camera, command)).unwrap_or([1.0; 2]);
    let mut scales = [global; 4];
    if model.shape.local {
        for level in [Level::Linear, Level::Wide, Level::Local] {
            let own = pure(level);
            let errors = if own.len() >= 50 {
                own
            } else {
                model.leave_one_out_at(level, camera, command)
            };
            scales[level as usize] = scale(errors).unwrap_or(global);
        }
    }
    scales
}
