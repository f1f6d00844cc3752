//! The journal: every event of every unit in SQLite, pictures by their hash beside it.
//!
//! Write-ahead log with full synchronisation: what [`Journal::append`] returned from is on the disk. An act is written down as an
//! intent before it is begun; after a crash an open intent means *look*, never repeat or skip.

use crate::record::{Event, PictureId, UnitRecord};
use geometry::RgbImage;
use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension, params};
use std::{
    fs,
    io::Cursor,
    path::{Path, PathBuf},
};

/// File name of the journal in a run's folder.
pub const JOURNAL_FILE: &str = "journal.db";
/// Folder of the pictures beside it.
pub const PICTURE_FOLDER: &str = "pictures";
const SCHEMA_VERSION: i64 = 1;

/// A journal that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The folder could not be made or written to.
    #[error("cannot write to {path}: {source}; choose a folder that you may write to, with free space")]
    Folder {
        /// File or folder.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// There is no journal where one was expected.
    #[error("there is no journal at {path}; give the folder of an earlier run")]
    Missing {
        /// File.
        path: PathBuf,
    },
    /// SQLite failed.
    #[error("cannot {action} the journal {path}: {source}; {advice}")]
    Database {
        /// File.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// Cause.
        source: rusqlite::Error,
        /// What to do.
        advice: &'static str,
    },
    /// Made by another version.
    #[error(
        "the journal {path} has format {found}, this program reads {SCHEMA_VERSION}; use the version that wrote it"
    )]
    Version {
        /// File.
        path: PathBuf,
        /// Its format.
        found: i64,
    },
    /// An entry that makes no sense.
    #[error("the journal {path} holds an entry that cannot be read ({what}): {reason}; restore it from a copy")]
    Entry {
        /// File.
        path: PathBuf,
        /// Which.
        what: String,
        /// Cause.
        reason: String,
    },
    /// A picture could not be stored.
    #[error("cannot store a picture in {path}: {reason}; check free space and permissions")]
    Picture {
        /// Folder or file.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
}

fn advice(source: &rusqlite::Error) -> &'static str {
    match source.sqlite_error_code() {
        Some(ErrorCode::DiskFull) => "the disk is full: free some space, then go on with --resume",
        Some(ErrorCode::ReadOnly | ErrorCode::CannotOpen | ErrorCode::PermissionDenied) => {
            "it cannot be written: check the permissions of the folder"
        }
        Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => "another program uses it: end that one first",
        Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => {
            "it is damaged: keep it for analysis, restore a copy or start in a new folder"
        }
        Some(ErrorCode::SystemIoFailure) => "the disk failed: check it, then go on with --resume",
        _ => "this is not expected: keep the file and report it",
    }
}

/// Where a picture of a run lies.
pub fn picture_path(folder: &Path, id: &PictureId) -> PathBuf {
    folder.join(PICTURE_FOLDER).join(format!("{}.jpg", id.0))
}

/// The journal of a run.
#[derive(Debug)]
pub struct Journal {
    connection: Connection,
    path: PathBuf,
    folder: PathBuf,
}

impl Journal {
    /// Opens the journal of a folder for writing; makes folder and journal if they are not there.
    ///
    /// # Errors
    /// [`JournalError::Folder`], [`JournalError::Database`] or [`JournalError::Version`].
    pub fn open(folder: &Path) -> Result<Self, JournalError> {
        let pictures = folder.join(PICTURE_FOLDER);
        fs::create_dir_all(&pictures).map_err(|source| JournalError::Folder {
            path: pictures.clone(),
            source,
        })?;
        Self::connect(
            folder,
            OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE,
            |connection| {
                connection.pragma_update(None, "journal_mode", "WAL")?;
                connection.pragma_update(None, "synchronous", "FULL")?;
                connection.pragma_update(None, "foreign_keys", true)?;
                connection.execute_batch(
                "BEGIN IMMEDIATE;
                 CREATE TABLE IF NOT EXISTS units (
                     id INTEGER PRIMARY KEY, started_s REAL NOT NULL, outcome TEXT, record TEXT);
                 CREATE TABLE IF NOT EXISTS events (
                     id INTEGER PRIMARY KEY, unit INTEGER NOT NULL REFERENCES units (id),
                     t_s REAL NOT NULL, kind TEXT NOT NULL, json TEXT NOT NULL);
                 CREATE INDEX IF NOT EXISTS events_of_unit ON events (unit, id);
                 CREATE TABLE IF NOT EXISTS pictures (
                     sha256 TEXT PRIMARY KEY, width_px INTEGER NOT NULL, height_px INTEGER NOT NULL, bytes INTEGER NOT NULL);
                 COMMIT;",
            )?;
                let version: i64 = connection.pragma_query_value(None, "user_version", |row| row.get(0))?;
                if version == 0 {
                    connection.pragma_update(None, "user_version", SCHEMA_VERSION)?;
                }
                Ok(())
            },
        )
    }

    /// Opens the journal of an earlier run, to read it only.
    ///
    /// # Errors
    /// [`JournalError::Missing`], [`JournalError::Database`] or [`JournalError::Version`].
    pub fn open_read_only(folder: &Path) -> Result<Self, JournalError> {
        Self::connect(folder, OpenFlags::SQLITE_OPEN_READ_ONLY, |_| Ok(()))
    }

    fn connect(
        folder: &Path,
        flags: OpenFlags,
        prepare: impl FnOnce(&Connection) -> Result<(), rusqlite::Error>,
    ) -> Result<Self, JournalError> {
        let path = folder.join(JOURNAL_FILE);
        if !flags.contains(OpenFlags::SQLITE_OPEN_CREATE) && !path.exists() {
            return Err(JournalError::Missing { path });
        }
        let failed = |source| database(&path, "open", source);
        let connection = Connection::open_with_flags(&path, flags).map_err(failed)?;
        prepare(&connection).map_err(failed)?;
        let found: i64 = connection
            .pragma_query_value(None, "user_version", |row| row.get(0))
            .map_err(failed)?;
        if found != SCHEMA_VERSION {
            return Err(JournalError::Version { path, found });
        }
        Ok(Self {
            connection,
            folder: folder.into(),
            path,
        })
    }

    /// Opens a unit: its number is the next one, its time starts at `t_s`.
    ///
    /// # Errors
    /// [`JournalError::Database`].
    pub fn begin_unit(&mut self, t_s: f64) -> Result<u64, JournalError> {
        self.connection
            .execute("INSERT INTO units (started_s) VALUES (?1)", [t_s])
            .map_err(|e| self.failed("write", e))?;
        Ok(self.connection.last_insert_rowid().unsigned_abs())
    }

    /// Appends an event. When this returns, it is on the disk.
    ///
    /// # Errors
    /// [`JournalError::Database`]: nothing may be done then that was to be written down.
    pub fn append(&mut self, unit: u64, t_s: f64, event: &Event) -> Result<(), JournalError> {
        let json = serde_json::to_string(event).map_err(|e| self.entry(format!("event of unit {unit}"), e))?;
        self.connection
            .prepare_cached("INSERT INTO events (unit, t_s, kind, json) VALUES (?1, ?2, ?3, ?4)")
            .and_then(|mut insert| insert.execute(params![unit.cast_signed(), t_s, event.kind(), json]))
            .map_err(|e| self.failed("write", e))?;
        Ok(())
    }

    /// Closes a unit with its record.
    ///
    /// # Errors
    /// [`JournalError::Database`].
    pub fn finish_unit(&mut self, record: &UnitRecord) -> Result<(), JournalError> {
        let what = || format!("record of unit {}", record.unit);
        let json = serde_json::to_string(record).map_err(|e| self.entry(what(), e))?;
        let outcome = record.outcome.as_ref().map(|o| o.word());
        self.connection
            .execute(
                "UPDATE units SET outcome = ?2, record = ?3 WHERE id = ?1",
                params![record.unit.cast_signed(), outcome, json],
            )
            .map_err(|e| self.failed("write", e))?;
        Ok(())
    }

    /// Keeps a picture as JPEG under the hash of its bytes; the same picture is kept once.
    ///
    /// # Errors
    /// [`JournalError::Picture`] or [`JournalError::Database`].
    pub fn store_picture(&mut self, picture: &RgbImage, jpeg_quality: u8) -> Result<PictureId, JournalError> {
        let bad = |path: &Path, reason: String| JournalError::Picture {
            path: path.into(),
            reason,
        };
        let mut bytes = Cursor::new(Vec::new());
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, jpeg_quality)
            .encode_image(picture)
            .map_err(|e| bad(&self.folder, e.to_string()))?;
        let bytes = bytes.into_inner();
        let id = PictureId(geometry::sha256_hex(&bytes));
        let path = self.picture_path(&id);
        if !path.exists() {
            geometry::write_aside(&path, &bytes).map_err(|e| bad(&path, e.to_string()))?;
            // The event that names the picture is synchronised: what it names has to be on the disk before.
            fs::File::open(&path)
                .and_then(|file| file.sync_all())
                .map_err(|e| bad(&path, e.to_string()))?;
        }
        self.connection
            .execute(
                "INSERT OR IGNORE INTO pictures (sha256, width_px, height_px, bytes) VALUES (?1, ?2, ?3, ?4)",
                params![id.0, picture.width(), picture.height(), bytes.len() as i64],
            )
            .map_err(|e| self.failed("write", e))?;
        Ok(id)
    }

    /// Where a picture lies.
    pub fn picture_path(&self, id: &PictureId) -> PathBuf {
        picture_path(&self.folder, id)
    }

    /// Events of a unit in order, with their times.
    ///
    /// # Errors
    /// [`JournalError::Database`] or [`JournalError::Entry`].
    pub fn events(&self, unit: u64) -> Result<Vec<(f64, Event)>, JournalError> {
        let rows: Vec<(i64, f64, String)> = self
            .connection
            .prepare_cached("SELECT id, t_s, json FROM events WHERE unit = ?1 ORDER BY id")
            .and_then(|mut select| {
                select
                    .query_map([unit.cast_signed()], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))?
                    .collect()
            })
            .map_err(|e| self.failed("read", e))?;
        rows.into_iter()
            .map(|(id, t_s, json)| {
                let event = serde_json::from_str(&json).map_err(|e| self.entry(format!("event {id}"), e))?;
                Ok((t_s, event))
            })
            .collect()
    }

    /// The state of a unit, rebuilt from its events alone; `None` if there is no such unit.
    ///
    /// # Errors
    /// [`JournalError::Database`] or [`JournalError::Entry`].
    pub fn unit(&self, unit: u64) -> Result<Option<UnitRecord>, JournalError> {
        let started: Option<f64> = self
            .connection
            .query_row(
                "SELECT started_s FROM units WHERE id = ?1",
                [unit.cast_signed()],
                |row| row.get(0),
            )
            .optional()
            .map_err(|e| self.failed("read", e))?;
        let Some(started_s) = started else { return Ok(None) };
        Ok(Some(UnitRecord::from_events(unit, started_s, &self.events(unit)?)))
    }

    /// Numbers of all units in order.
    ///
    /// # Errors
    /// [`JournalError::Database`].
    pub fn units(&self) -> Result<Vec<u64>, JournalError> {
        self.numbers("SELECT id FROM units ORDER BY id")
    }

    /// The unit that was being worked on when the program ended, if any.
    ///
    /// # Errors
    /// [`JournalError::Database`].
    pub fn unfinished(&self) -> Result<Option<u64>, JournalError> {
        Ok(self
            .numbers("SELECT id FROM units WHERE record IS NULL ORDER BY id DESC LIMIT 1")?
            .pop())
    }

    /// Records of all units in order, rebuilt from their events.
    ///
    /// # Errors
    /// [`JournalError::Database`] or [`JournalError::Entry`].
    pub fn records(&self) -> Result<Vec<UnitRecord>, JournalError> {
        let units = self.units()?;
        units
            .into_iter()
            .filter_map(|unit| self.unit(unit).transpose())
            .collect()
    }

    fn numbers(&self, query: &str) -> Result<Vec<u64>, JournalError> {
        self.connection
            .prepare(query)
            .and_then(|mut select| {
                select
                    .query_map([], |row| row.get::<_, i64>(0).map(i64::unsigned_abs))?
                    .collect()
            })
            .map_err(|e| self.failed("read", e))
    }

    fn failed(&self, action: &'static str, source: rusqlite::Error) -> JournalError {
        database(&self.path, action, source)
    }

    fn entry(&self, what: String, reason: serde_json::Error) -> JournalError {
        JournalError::Entry {
            path: self.path.clone(),
            what,
            reason: reason.to_string(),
        }
    }
}

fn database(path: &Path, action: &'static str, source: rusqlite::Error) -> JournalError {
    JournalError::Database {
        path: path.into(),
        action,
        advice: advice(&source),
        source,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::Act;

    fn arrived() -> Event {
        Event::Identified {
            model: Some("CU-X22".into()),
        }
    }

    #[test]
    fn an_open_intent_survives_reopening() -> Result<(), JournalError> {
        let dir = tempfile::tempdir().expect("folder");
        let act = Act::Pull { cover: "top".into() };
        {
            let mut journal = Journal::open(dir.path())?;
            let unit = journal.begin_unit(1.0)?;
            journal.append(unit, 3.0, &arrived())?;
            journal.append(unit, 4.0, &Event::Intent { act: act.clone() })?;
        }
        let journal = Journal::open(dir.path())?;
        let unit = journal.unfinished()?.expect("unit 1 is under way");
        let record = journal.unit(unit)?.expect("unit 1");
        assert_eq!((record.unit, record.open), (1, Some(act)));
        assert_eq!((record.model.as_deref(), record.times.waiting_s), (Some("CU-X22"), 0.0));
        assert_eq!(journal.unit(7)?, None);
        let mode: String = journal
            .connection
            .pragma_query_value(None, "journal_mode", |row| row.get(0))
            .expect("mode");
        let synchronous: i64 = journal
            .connection
            .pragma_query_value(None, "synchronous", |row| row.get(0))
            .expect("synchronous");
        assert_eq!((mode.as_str(), synchronous), ("wal", 2));
        Ok(())
    }

    #[test]
    fn a_finished_unit_is_not_unfinished() -> Result<(), JournalError> {
        let dir = tempfile::tempdir().expect("folder");
        let mut journal = Journal::open(dir.path())?;
        for _ in 0..2 {
            let unit = journal.begin_unit(1.0)?;
            journal.append(unit, 3.0, &arrived())?;
            let record = journal.unit(unit)?.expect("there");
            journal.finish_unit(&record)?;
        }
        assert_eq!(journal.unfinished()?, None);
        assert_eq!(Journal::open_read_only(dir.path())?.records()?.len(), 2);
        Ok(())
    }

    #[test]
    fn pictures_are_kept_once_under_their_hash() -> Result<(), JournalError> {
        let dir = tempfile::tempdir().expect("folder");
        let mut journal = Journal::open(dir.path())?;
        let grey = RgbImage::from_pixel(32, 24, image::Rgb([90, 91, 92]));
        let (a, b) = (journal.store_picture(&grey, 88)?, journal.store_picture(&grey, 88)?);
        assert_eq!(a, b);
        let bytes = fs::read(journal.picture_path(&a)).expect("picture");
        assert_eq!(geometry::sha256_hex(&bytes), a.0);
        assert_eq!(
            fs::read_dir(dir.path().join(PICTURE_FOLDER)).expect("folder").count(),
            1
        );
        Ok(())
    }

    #[test]
    fn a_full_disk_and_a_wrong_file_say_what_to_do() {
        let dir = tempfile::tempdir().expect("folder");
        let mut journal = Journal::open(dir.path()).expect("journal");
        let unit = journal.begin_unit(0.0).expect("unit");
        let pages: i64 = journal
            .connection
            .pragma_query_value(None, "page_count", |row| row.get(0))
            .expect("pages");
        journal
            .connection
            .pragma_update(None, "max_page_count", pages)
            .expect("limit");
        let long = Event::Identified {
            model: Some("x".repeat(100_000)),
        };
        let error = journal.append(unit, 1.0, &long).expect_err("full").to_string();
        assert!(
            error.contains("journal.db") && error.contains("disk is full"),
            "{error}"
        );
        assert!(journal.events(unit).expect("still readable").is_empty());

        let other = tempfile::tempdir().expect("folder");
        fs::write(
            other.path().join(JOURNAL_FILE),
            "no database, but long enough to look like one".repeat(40),
        )
        .expect("written");
        let error = Journal::open(other.path()).expect_err("no database").to_string();
        assert!(error.contains("damaged"), "{error}");
        let nothing = tempfile::tempdir().expect("folder");
        assert!(matches!(
            Journal::open_read_only(nothing.path()),
            Err(JournalError::Missing { .. })
        ));
        let file = nothing.path().join("file");
        fs::write(&file, "x").expect("written");
        assert!(matches!(Journal::open(&file), Err(JournalError::Folder { .. })));
    }
}
