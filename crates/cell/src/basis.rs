//! What a run decides with: model, maps, cell file, program. Each start of the program writes down which, and keeps a copy of each by its
//! hash beside the journal, so that a shift can be decided again, with these or with others.

use crate::config::{CellConfig, ConfigError};
use crate::journal::JournalError;
use crate::motion::ArmMotion;
use crate::plan::Reach;
use crate::program::{Program, ProgramError};
use crate::store::{self, Sha, StoreError};
use calibration::{Map, MapError};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Folder of the copies in a run's folder.
pub const BASIS_FOLDER: &str = "basis";

/// What one start of the program decides with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Basis {
    /// Version of the program.
    pub version: String,
    /// The model's id.
    pub model: String,
    /// The model's file, if it has one (`HASH.unscrew`).
    pub model_file: Option<Sha>,
    /// The arms, in their order.
    pub arms: Vec<ArmBasis>,
    /// The cell file (`HASH.toml`).
    pub cell: Sha,
    /// The program of steps (`HASH.toml`).
    pub program: Sha,
}

/// An arm and its map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmBasis {
    /// Name of the arm.
    pub name: String,
    /// Its map (`HASH.json`); `None`: it is never sent to a screw.
    pub map: Option<Sha>,
    /// True if it carries a driver.
    pub drives: bool,
}

/// A basis that cannot be kept or read back.
#[derive(Debug, thiserror::Error)]
pub enum BasisError {
    /// A kept file.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The journal.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// A map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The cell file.
    #[error(transparent)]
    Cell(#[from] ConfigError),
    /// The program.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// A text that cannot be written or read.
    #[error("{what} cannot be kept beside the journal: {reason}; report it")]
    Text {
        /// What.
        what: &'static str,
        /// Cause.
        reason: String,
    },
}

/// What there is to keep of an arm.
#[derive(Clone, Copy, Debug)]
pub struct ArmParts<'a> {
    /// Name of the arm.
    pub name: &'a str,
    /// Its map's file.
    pub map: Option<&'a Path>,
    /// True if it carries a driver.
    pub drives: bool,
}

impl Basis {
    /// Keeps copies of everything in a run's folder.
    ///
    /// # Arguments
    /// * `model` – the model's id, and the bytes of its file.
    ///
    /// # Errors
    /// [`BasisError`].
    pub fn keep(
        run: &Path,
        model: (&str, Option<&[u8]>),
        arms: &[ArmParts<'_>],
        config: &CellConfig,
        program: &Program,
    ) -> Result<Self, BasisError> {
        let folder = run.join(BASIS_FOLDER);
        let toml = |what, text: Result<String, toml::ser::Error>| {
            text.map_err(|e| BasisError::Text {
                what,
                reason: e.to_string(),
            })
            .and_then(|text| Ok(store::keep(&folder, "toml", text.as_bytes())?))
        };
        let arm = |arm: &ArmParts<'_>| -> Result<ArmBasis, BasisError> {
            let copy = |path: &Path| {
                let bytes = std::fs::read(path).map_err(|source| StoreError::Read {
                    path: path.into(),
                    source,
                })?;
                store::keep(&folder, "json", &bytes)
            };
            Ok(ArmBasis {
                name: arm.name.into(),
                map: arm.map.map(copy).transpose()?,
                drives: arm.drives,
            })
        };
        Ok(Self {
            version: env!("CARGO_PKG_VERSION").into(),
            model: model.0.into(),
            model_file: model
                .1
                .map(|bytes| store::keep(&folder, "unscrew", bytes))
                .transpose()?,
            arms: arms.iter().map(arm).collect::<Result<_, _>>()?,
            cell: toml("the cell file", toml::to_string(config))?,
            program: toml("the program", toml::to_string(program))?,
        })
    }

    /// Bytes of the model's file; `None` if it has none.
    ///
    /// # Errors
    /// [`BasisError::Store`].
    pub fn model_bytes(&self, run: &Path) -> Result<Option<Vec<u8>>, BasisError> {
        let read = |sha| store::read(&run.join(BASIS_FOLDER), sha, "unscrew");
        Ok(self.model_file.as_ref().map(read).transpose()?)
    }

    /// Maps of the arms, in their order.
    ///
    /// # Errors
    /// [`BasisError`].
    pub fn maps(&self, run: &Path) -> Result<Vec<Option<Map>>, BasisError> {
        let folder = run.join(BASIS_FOLDER);
        let load = |arm: &ArmBasis| -> Result<Option<Map>, BasisError> {
            let Some(sha) = &arm.map else { return Ok(None) };
            store::read(&folder, sha, "json")?; // proves the hash
            Ok(Some(Map::load(&store::path_of(&folder, sha, "json"))?))
        };
        self.arms.iter().map(load).collect()
    }

    /// The cell file.
    ///
    /// # Errors
    /// [`BasisError`].
    pub fn config(&self, run: &Path) -> Result<CellConfig, BasisError> {
        let (text, origin) = text(run, &self.cell)?;
        Ok(CellConfig::parse(&text, &origin)?)
    }

    /// The program.
    ///
    /// # Errors
    /// [`BasisError`].
    pub fn program(&self, run: &Path) -> Result<Program, BasisError> {
        let (text, origin) = text(run, &self.program)?;
        Ok(Program::parse(&text, &origin)?)
    }

    /// The arms that can take screws out, with these maps and what is around them.
    pub fn reaches<'a>(&self, maps: &'a [Option<Map>], motions: &'a [Option<ArmMotion>]) -> Vec<Reach<'a>> {
        let arms = self.arms.iter().zip(maps).zip(motions).enumerate();
        arms.filter(|(_, ((arm, _), _))| arm.drives)
            .filter_map(|(arm, ((_, map), motion))| Some(Reach::from_rest(arm, map.as_ref()?, motion.as_ref()?)))
            .collect()
    }

    /// What is around each arm, as this cell file draws it.
    pub fn motions(&self, config: &CellConfig) -> Vec<Option<ArmMotion>> {
        let drawn = |arm: &ArmBasis| ArmMotion::new(&config.motion, &arm.name);
        self.arms.iter().map(drawn).collect()
    }
}

fn text(run: &Path, sha: &Sha) -> Result<(String, String), StoreError> {
    let folder = run.join(BASIS_FOLDER);
    let path: PathBuf = store::path_of(&folder, sha, "toml");
    let text = String::from_utf8(store::read(&folder, sha, "toml")?).map_err(|e| StoreError::Damaged {
        path: path.clone(),
        reason: e.to_string(),
    })?;
    Ok((text, path.display().to_string()))
}
