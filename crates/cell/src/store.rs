//! Files kept by the hash of their bytes: what has been written once is never changed, and the same thing is kept once.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Hexadecimal SHA-256 of a kept file's bytes.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Sha(pub String);

impl fmt::Display for Sha {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A kept file that cannot be written or read back.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// It could not be written.
    #[error("cannot keep {path}: {reason}; check free space and permissions, then go on with --resume")]
    Write {
        /// File.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
    /// It could not be read.
    #[error(
        "cannot read {path}: {source}; copy the run's whole folder, with everything that was kept beside its journal"
    )]
    Read {
        /// File.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
    /// Its bytes are not those that were written, or cannot be understood.
    #[error("{path} is not what was kept: {reason}; restore it from a copy")]
    Damaged {
        /// File.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
}

/// Keeps bytes as `folder/HASH.extension`, once. When this returns, they are on the disk: an event that names them may be written.
///
/// # Errors
/// [`StoreError::Write`].
pub fn keep(folder: &Path, extension: &str, bytes: &[u8]) -> Result<Sha, StoreError> {
    let sha = Sha(geometry::sha256_hex(bytes));
    let path = path_of(folder, &sha, extension);
    let failed = |reason: String| StoreError::Write {
        path: path.clone(),
        reason,
    };
    if !path.exists() {
        fs::create_dir_all(folder).map_err(|e| failed(e.to_string()))?;
        geometry::write_aside(&path, bytes).map_err(|e| match e {
            // the path and the advice are said once
            geometry::FileError::Write { source, .. } => failed(source.to_string()),
            other => failed(other.to_string()),
        })?;
        fs::File::open(&path)
            .and_then(|file| file.sync_all())
            .map_err(|e| failed(e.to_string()))?;
    }
    Ok(sha)
}

/// Reads kept bytes back and proves them by their hash.
///
/// # Errors
/// [`StoreError::Read`] or [`StoreError::Damaged`].
pub fn read(folder: &Path, sha: &Sha, extension: &str) -> Result<Vec<u8>, StoreError> {
    let path = path_of(folder, sha, extension);
    let bytes = fs::read(&path).map_err(|source| StoreError::Read {
        path: path.clone(),
        source,
    })?;
    if geometry::sha256_hex(&bytes) != sha.0 {
        let reason = "its bytes do not give its name".into();
        return Err(StoreError::Damaged { path, reason });
    }
    Ok(bytes)
}

/// Where a kept file lies.
pub fn path_of(folder: &Path, sha: &Sha, extension: &str) -> PathBuf {
    folder.join(format!("{sha}.{extension}"))
}
