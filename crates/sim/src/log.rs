//! The world's own log: one JSON line a physical action, kept apart from the program's journal so that a wrong journal cannot hide.

use crate::score::Action;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// A log of the simulated world that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file could not be read or written.
    #[error("cannot use the simulated world's log {path}: {source}; check the folder and its permissions")]
    File {
        /// File.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// A line is no action.
    #[error("{path}, line {line}, is no action of the simulated world ({reason}); remove the file to start anew")]
    Line {
        /// File.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Cause.
        reason: String,
    },
    /// The units in the log are not those of the settings.
    #[error(
        "{path}: unit {unit} is not from units_seed = {units_seed}; go on with the seed that the run began with, or choose another folder"
    )]
    OtherUnits {
        /// File.
        path: PathBuf,
        /// Unit, from 0.
        unit: u64,
        /// The seed in the settings.
        units_seed: u64,
    },
}

/// Reads a world's log: every physical action so far, in order. A last line that a crash cut off is passed over.
///
/// # Errors
/// [`LogError::File`], [`LogError::Line`].
pub fn read_actions(path: &Path) -> Result<Vec<Action>, LogError> {
    let text = std::fs::read_to_string(path).map_err(|source| LogError::File {
        path: path.to_owned(),
        source,
    })?;
    parse(path, &text[..whole(&text)])
}

/// Bytes of the whole lines.
fn whole(text: &str) -> usize {
    text.rfind('\n').map_or(0, |end| end + 1)
}

fn parse(path: &Path, text: &str) -> Result<Vec<Action>, LogError> {
    let lines = text.lines().enumerate();
    let actions = lines.map(|(k, line)| {
        serde_json::from_str(line).map_err(|e| LogError::Line {
            path: path.to_owned(),
            line: k + 1,
            reason: e.to_string(),
        })
    });
    actions.collect()
}

/// Room that is held ready beside the log. A real world needs none on the computer's disk to go on: when that is full, this is given back.
const SPARE_FILE: &str = "world.spare";
const SPARE_BYTES: usize = 64 * 1024;

/// A log that is open for appending.
#[derive(Debug)]
pub(crate) struct ActionLog {
    file: File,
    bytes: u64,
    spare: PathBuf,
    /// Why writing stopped, if it did.
    pub(crate) error: Option<String>,
}

impl ActionLog {
    /// Opens or makes a log; returns what it holds. A last line that was cut off by a crash was never acted upon and is cut.
    pub(crate) fn open(path: &Path) -> Result<(Vec<Action>, Self), LogError> {
        let file_error = |source| LogError::File {
            path: path.to_owned(),
            source,
        };
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(file_error(e)),
        };
        let whole = whole(&text);
        let actions = parse(path, &text[..whole])?;
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .map_err(file_error)?;
        file.set_len(whole as u64).map_err(file_error)?;
        let spare = path.with_file_name(SPARE_FILE);
        // a disk that is full already: the log then fails as any other file would
        let _ = std::fs::write(&spare, vec![b'.'; SPARE_BYTES]);
        let log = Self {
            file,
            bytes: whole as u64,
            spare,
            error: None,
        };
        Ok((actions, log))
    }

    /// Appends an action at once.
    pub(crate) fn append(&mut self, action: &Action) {
        if self.error.is_some() {
            return;
        }
        let written = serde_json::to_string(action)
            .map_err(std::io::Error::other)
            .and_then(|line| self.write(format!("{line}\n").as_bytes()));
        self.error = written.err().map(|e| e.to_string());
    }

    fn write(&mut self, line: &[u8]) -> Result<(), std::io::Error> {
        if self.file.write_all(line).is_err() {
            self.file.set_len(self.bytes)?; // what was written of it
            std::fs::remove_file(&self.spare)?;
            self.file.write_all(line)?;
        }
        self.bytes += line.len() as u64;
        Ok(())
    }
}

impl Drop for ActionLog {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.spare);
    }
}
