//! The journal: every event of every unit in SQLite, pictures by their hash beside it.
//!
//! Write-ahead log with full synchronisation: what [`Journal::append`] returned from is on the disk. An act is written down as an
//! intent before it is begun; after a crash an open intent means *look*, never repeat or skip.

use crate::basis::Basis;
use crate::capture::Shot;
use crate::digest::Digest;
use crate::frames::{self, KeptFrame};
use crate::record::{Event, PictureId, UnitRecord};
use crate::seal::{self, End, EndFile};
use crate::store::{self, Sha, StoreError};
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
const SCHEMA_VERSION: i64 = 2;
/// Format without sums; it is read, and taken further in the new format.
const UNSEALED_VERSION: i64 = 1;

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
    /// What was written is not there any more, or not as it was written.
    #[error(
        "the journal {path} is not whole: {what}. Nothing may be done on its word: put back what is missing (a copy needs journal.db-wal \
         beside journal.db) or restore both from a backup; if there is none, clear the table by hand and start in a new folder"
    )]
    NotWhole {
        /// File.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A picture or frame could not be kept.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A picture could not be encoded.
    #[error("cannot encode a picture for {path}: {reason}; report it")]
    Picture {
        /// Folder.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
}

fn advice(source: &rusqlite::Error) -> &'static str {
    use rusqlite::Error::{FromSqlConversionFailure, IntegralValueOutOfRange, InvalidColumnType, Utf8Error};
    if let FromSqlConversionFailure(..) | IntegralValueOutOfRange(..) | InvalidColumnType(..) | Utf8Error(..) = source {
        return "it is damaged: keep it for analysis, restore a copy or start in a new folder";
    }
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
    store::path_of(&folder.join(PICTURE_FOLDER), &Sha(id.0.clone()), "jpg")
}

/// The journal of a run.
#[derive(Debug)]
pub struct Journal {
    connection: Connection,
    path: PathBuf,
    folder: PathBuf,
    /// Whether events carry sums; not in one of the old format that is only read.
    sealed: bool,
    /// Where the end is kept, if it is open for writing.
    end: Option<EndFile>,
    /// Unit and sum of the last event that was appended.
    last: Option<(u64, String)>,
}

/// One row of the events.
struct Row {
    id: i64,
    t_s: f64,
    json: String,
    sum: Option<String>,
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
        let mut journal = Self::connect(
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
                     t_s REAL NOT NULL, kind TEXT NOT NULL, json TEXT NOT NULL, sum TEXT);
                 CREATE INDEX IF NOT EXISTS events_of_unit ON events (unit, id);
                 CREATE TABLE IF NOT EXISTS pictures (
                     sha256 TEXT PRIMARY KEY, width_px INTEGER NOT NULL, height_px INTEGER NOT NULL, bytes INTEGER NOT NULL);
                 CREATE TABLE IF NOT EXISTS digests (
                     unit INTEGER PRIMARY KEY REFERENCES units (id), json TEXT NOT NULL, sum TEXT NOT NULL);
                 CREATE TABLE IF NOT EXISTS starts (
                     id INTEGER PRIMARY KEY, after_event INTEGER NOT NULL, json TEXT NOT NULL);
                 COMMIT;",
            )?;
                let version: i64 = connection.pragma_query_value(None, "user_version", |row| row.get(0))?;
                match version {
                    0 => connection.pragma_update(None, "user_version", SCHEMA_VERSION),
                    UNSEALED_VERSION => connection.execute_batch(
                        "BEGIN IMMEDIATE; ALTER TABLE events ADD COLUMN sum TEXT; PRAGMA user_version = 2; COMMIT;",
                    ),
                    _ => Ok(()),
                }
            },
        )?;
        let unusable = |source| JournalError::Folder {
            path: folder.join(seal::END_FILE),
            source,
        };
        let mut file = EndFile::open(folder).map_err(unusable)?;
        if let Some(end) = journal.last_event()? {
            file.write(&end).map_err(unusable)?;
        }
        journal.end = Some(file);
        Ok(journal)
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
        if ![UNSEALED_VERSION, SCHEMA_VERSION].contains(&found) {
            return Err(JournalError::Version { path, found });
        }
        let journal = Self {
            connection,
            folder: folder.into(),
            path,
            sealed: found == SCHEMA_VERSION,
            end: None,
            last: None,
        };
        journal.prove_end()?;
        Ok(journal)
    }

    /// That the last event on file is in the journal, as it was written.
    fn prove_end(&self) -> Result<(), JournalError> {
        let unreadable = |source| JournalError::Folder {
            path: self.folder.join(seal::END_FILE),
            source,
        };
        let Some(end) = End::read(&self.folder).map_err(unreadable)? else {
            return Ok(());
        };
        if !self.sealed {
            return Ok(());
        }
        let sum: Option<Option<String>> = self
            .connection
            .query_row("SELECT sum FROM events WHERE id = ?1", [end.event], |row| row.get(0))
            .optional()
            .map_err(|e| self.failed("read", e))?;
        match sum {
            Some(Some(sum)) if sum == end.sum => Ok(()),
            Some(_) => Err(self.not_whole(format!("event {} is another one than was written", end.event))),
            None => Err(self.not_whole(format!("it had {} events, the last of them are gone", end.event))),
        }
    }

    fn last_event(&self) -> Result<Option<End>, JournalError> {
        let last = self
            .connection
            .query_row("SELECT id, sum FROM events ORDER BY id DESC LIMIT 1", [], |row| {
                Ok((row.get::<_, i64>(0)?, row.get::<_, Option<String>>(1)?))
            });
        let last = last.optional().map_err(|e| self.failed("read", e))?;
        Ok(last.and_then(|(event, sum)| Some(End { event, sum: sum? })))
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

    /// Writes down what this start of the program decides with; nothing if it is what the last one did.
    ///
    /// # Errors
    /// [`JournalError::Database`].
    pub fn begin_start(&mut self, basis: &Basis) -> Result<(), JournalError> {
        if self.starts()?.last().is_some_and(|(_, last)| last == basis) {
            return Ok(());
        }
        let json = serde_json::to_string(basis).map_err(|e| self.entry("what the run decides with".into(), e))?;
        self.connection
            .execute(
                "INSERT INTO starts (after_event, json) VALUES ((SELECT coalesce(max(id), 0) FROM events), ?1)",
                [json],
            )
            .map_err(|e| self.failed("write", e))?;
        Ok(())
    }

    /// What each start of the program decided with, and the number of the last event before it.
    ///
    /// # Errors
    /// [`JournalError::Database`] or [`JournalError::Entry`].
    pub fn starts(&self) -> Result<Vec<(i64, Basis)>, JournalError> {
        if !self.sealed {
            return Ok(Vec::new());
        }
        let rows: Vec<(i64, String)> = self
            .connection
            .prepare("SELECT after_event, json FROM starts ORDER BY id")
            .and_then(|mut select| select.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?.collect())
            .map_err(|e| self.failed("read", e))?;
        let parse = |(after, json): (i64, String)| {
            let basis = serde_json::from_str(&json).map_err(|e| self.entry("what the run decides with".into(), e))?;
            Ok((after, basis))
        };
        rows.into_iter().map(parse).collect()
    }

    /// Appends an event. When this returns, it is on the disk.
    ///
    /// # Errors
    /// [`JournalError::Database`]: nothing may be done then that was to be written down.
    pub fn append(&mut self, unit: u64, t_s: f64, event: &Event) -> Result<(), JournalError> {
        let json = serde_json::to_string(event).map_err(|e| self.entry(format!("event of unit {unit}"), e))?;
        let before = match &self.last {
            Some((of, sum)) if *of == unit => sum.clone(),
            _ => self.last_sum(unit)?,
        };
        let sum = seal::sum(&before, unit, t_s, &json);
        self.connection
            .prepare_cached("INSERT INTO events (unit, t_s, kind, json, sum) VALUES (?1, ?2, ?3, ?4, ?5)")
            .and_then(|mut insert| insert.execute(params![unit.cast_signed(), t_s, event.kind(), json, sum]))
            .map_err(|e| self.failed("write", e))?;
        self.last = Some((unit, sum.clone()));
        // outside a transaction it is on the disk now
        if self.connection.is_autocommit() {
            let event = self.connection.last_insert_rowid();
            self.write_end(&End { event, sum })?;
        }
        Ok(())
    }

    /// For tests of a full disk: the file may grow by so many pages.
    #[doc(hidden)]
    pub fn limit_pages(&self, more: u32) -> Result<(), JournalError> {
        let pages: i64 = self
            .connection
            .pragma_query_value(None, "page_count", |row| row.get(0))
            .map_err(|e| self.failed("read", e))?;
        let limit = self
            .connection
            .pragma_update(None, "max_page_count", pages + i64::from(more));
        limit.map_err(|e| self.failed("limit", e))
    }

    /// For journals that are made, not lived through: does not wait for the disk.
    #[doc(hidden)]
    pub fn unsynchronised(&self) -> Result<(), JournalError> {
        let set = self.connection.pragma_update(None, "synchronous", "OFF");
        set.map_err(|e| self.failed("set", e))
    }

    fn write_end(&mut self, end: &End) -> Result<(), JournalError> {
        let path = self.folder.join(seal::END_FILE);
        let written = self.end.as_mut().map_or(Ok(()), |file| file.write(end));
        written.map_err(|source| JournalError::Folder { path, source })
    }

    fn last_sum(&self, unit: u64) -> Result<String, JournalError> {
        let sum = self.connection.query_row(
            "SELECT sum FROM events WHERE unit = ?1 ORDER BY id DESC LIMIT 1",
            [unit.cast_signed()],
            |row| row.get::<_, Option<String>>(0),
        );
        let sum = sum.optional().map_err(|e| self.failed("read", e))?;
        Ok(sum.flatten().unwrap_or_default())
    }

    /// Closes a unit with its last event, its record and its digest, all or nothing.
    ///
    /// # Errors
    /// [`JournalError::Database`] or [`JournalError::Entry`].
    pub fn close_unit(&mut self, t_s: f64, event: &Event, record: &UnitRecord) -> Result<(), JournalError> {
        self.begin()?;
        let closed = self
            .append(record.unit, t_s, event)
            .and_then(|()| self.write_record(record));
        self.end(closed)
    }

    /// Closes a unit that has its last event already.
    ///
    /// # Errors
    /// [`JournalError::Database`] or [`JournalError::Entry`].
    pub fn finish_unit(&mut self, record: &UnitRecord) -> Result<(), JournalError> {
        self.begin()?;
        let closed = self.write_record(record);
        self.end(closed)
    }

    fn begin(&self) -> Result<(), JournalError> {
        let begun = self.connection.execute_batch("BEGIN IMMEDIATE");
        begun.map_err(|e| self.failed("write", e))
    }

    fn end(&mut self, done: Result<(), JournalError>) -> Result<(), JournalError> {
        let end = done.and_then(|()| {
            let committed = self.connection.execute_batch("COMMIT");
            committed.map_err(|e| self.failed("write", e))
        });
        if let Err(error) = end {
            // what failed may have ended the transaction already
            let _ = self.connection.execute_batch("ROLLBACK");
            self.last = None;
            return Err(error);
        }
        match self.last_event()? {
            Some(end) => self.write_end(&end),
            None => Ok(()),
        }
    }

    fn write_record(&self, record: &UnitRecord) -> Result<(), JournalError> {
        let what = || format!("record of unit {}", record.unit);
        let json = serde_json::to_string(record).map_err(|e| self.entry(what(), e))?;
        let outcome = record.outcome.as_ref().map(|o| o.word());
        let digest = Digest::from_events(record.unit, record.started_s, &self.events(record.unit)?);
        let digest = serde_json::to_string(&digest).map_err(|e| self.entry(what(), e))?;
        let sum = seal::sum("", record.unit, 0.0, &digest);
        let unit = record.unit.cast_signed();
        let update = "UPDATE units SET outcome = ?2, record = ?3 WHERE id = ?1";
        let insert = "INSERT OR REPLACE INTO digests (unit, json, sum) VALUES (?1, ?2, ?3)";
        self.connection
            .execute(update, params![unit, outcome, json])
            .and_then(|_| self.connection.execute(insert, params![unit, digest, sum]))
            .map_err(|e| self.failed("write", e))?;
        Ok(())
    }

    /// Every unit as it is counted, in order: what was written down when it was closed, or its events.
    ///
    /// # Arguments
    /// * `from_events` – count everything anew from the events.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn digests(&self, from_events: bool) -> Result<Vec<Digest>, JournalError> {
        let mut digests = Vec::new();
        if self.sealed && !from_events {
            let rows: Vec<(i64, String, String)> = self
                .connection
                .prepare("SELECT unit, json, sum FROM digests ORDER BY unit")
                .and_then(|mut select| {
                    select
                        .query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))?
                        .collect()
                })
                .map_err(|e| self.failed("read", e))?;
            for (unit, json, sum) in rows {
                if seal::sum("", unit.unsigned_abs(), 0.0, &json) != sum {
                    return Err(self.not_whole(format!("what was counted of unit {unit} is not what was written")));
                }
                let digest: Digest = serde_json::from_str(&json).map_err(|e| self.entry(format!("unit {unit}"), e))?;
                digests.push(digest);
            }
        }
        let has = |digests: &[Digest], unit: u64| digests.binary_search_by_key(&unit, |d| d.unit).is_ok();
        let counted = digests.len();
        for (unit, started_s) in self.begun()? {
            if !has(&digests[..counted], unit) {
                digests.push(Digest::from_events(unit, started_s, &self.events(unit)?));
            }
        }
        digests.sort_by_key(|d| d.unit);
        Ok(digests)
    }

    /// Keeps a picture as JPEG under the hash of its bytes; the same picture is kept once.
    ///
    /// # Errors
    /// [`JournalError::Store`], [`JournalError::Picture`] or [`JournalError::Database`].
    pub fn store_picture(&mut self, picture: &RgbImage, jpeg_quality: u8) -> Result<PictureId, JournalError> {
        let mut bytes = Cursor::new(Vec::new());
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, jpeg_quality)
            .encode_image(picture)
            .map_err(|e| JournalError::Picture {
                path: self.folder.clone(),
                reason: e.to_string(),
            })?;
        let bytes = bytes.into_inner();
        let id = PictureId(store::keep(&self.folder.join(PICTURE_FOLDER), "jpg", &bytes)?.0);
        self.connection
            .execute(
                "INSERT OR IGNORE INTO pictures (sha256, width_px, height_px, bytes) VALUES (?1, ?2, ?3, ?4)",
                params![id.0, picture.width(), picture.height(), bytes.len() as i64],
            )
            .map_err(|e| self.failed("write", e))?;
        Ok(id)
    }

    /// Keeps a frame without loss beside the pictures.
    ///
    /// # Errors
    /// [`JournalError::Store`].
    pub fn keep_frame(&self, shot: &Shot) -> Result<KeptFrame, JournalError> {
        Ok(frames::keep(&self.folder, shot)?)
    }

    /// Where a picture lies.
    pub fn picture_path(&self, id: &PictureId) -> PathBuf {
        picture_path(&self.folder, id)
    }

    /// Events of a unit in order, with their times.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn events(&self, unit: u64) -> Result<Vec<(f64, Event)>, JournalError> {
        let entries = self.entries(unit)?;
        Ok(entries.into_iter().map(|(_, t_s, event)| (t_s, event)).collect())
    }

    /// Events of a unit in order, with their numbers in the journal and their times; proven to be those that were written.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn entries(&self, unit: u64) -> Result<Vec<(i64, f64, Event)>, JournalError> {
        let select = if self.sealed {
            "SELECT id, t_s, json, sum FROM events WHERE unit = ?1 ORDER BY id"
        } else {
            "SELECT id, t_s, json, NULL FROM events WHERE unit = ?1 ORDER BY id"
        };
        let rows: Vec<Row> = self
            .connection
            .prepare_cached(select)
            .and_then(|mut select| {
                let row = |row: &rusqlite::Row<'_>| {
                    Ok(Row {
                        id: row.get(0)?,
                        t_s: row.get(1)?,
                        json: row.get(2)?,
                        sum: row.get(3)?,
                    })
                };
                select.query_map([unit.cast_signed()], row)?.collect()
            })
            .map_err(|e| self.failed("read", e))?;
        let mut before = String::new();
        let mut entries = Vec::with_capacity(rows.len());
        for Row { id, t_s, json, sum } in rows {
            if let Some(sum) = &sum
                && seal::sum(&before, unit, t_s, &json) != *sum
            {
                return Err(self.not_whole(format!(
                    "event {id} of unit {unit}, or one before it, is not as it was written"
                )));
            }
            before = sum.unwrap_or_default();
            let event = serde_json::from_str(&json).map_err(|e| self.entry(format!("event {id}"), e))?;
            entries.push((id, t_s, event));
        }
        Ok(entries)
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

    /// The state of the unit that was being worked on when the program ended, if any, and proof that it is the last state.
    ///
    /// # Errors
    /// [`JournalError::NotWhole`] if the journal's last event belongs to another unit or is missing from this one.
    pub fn under_way(&self) -> Result<Option<UnitRecord>, JournalError> {
        let last: Option<(i64, i64, String)> = self
            .connection
            .query_row(
                "SELECT id, unit, kind FROM events ORDER BY id DESC LIMIT 1",
                [],
                |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)),
            )
            .optional()
            .map_err(|e| self.failed("read", e))?;
        let unfinished = self.unfinished()?;
        if let Some((event, unit, kind)) = last {
            let unit = unit.unsigned_abs();
            // an event alone does not prove itself: those of its unit do, together
            let proven = self.entries(unit)?.last().map(|e| e.0) == Some(event);
            // a unit that is begun and has no event yet comes after the last one that has
            let fits = match unfinished {
                None => kind == Event::Discharged.kind(),
                Some(under_way) => under_way >= unit,
            };
            if !(proven && fits) {
                return Err(self.not_whole(format!("event {event} of unit {unit} ({kind}) cannot be the last one")));
            }
        }
        unfinished.map_or(Ok(None), |unit| self.unit(unit))
    }

    /// Numbers of all units in order, with the times when they were asked for.
    fn begun(&self) -> Result<Vec<(u64, f64)>, JournalError> {
        self.connection
            .prepare("SELECT id, started_s FROM units ORDER BY id")
            .and_then(|mut select| {
                select
                    .query_map([], |row| Ok((row.get::<_, i64>(0)?.unsigned_abs(), row.get(1)?)))?
                    .collect()
            })
            .map_err(|e| self.failed("read", e))
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

    fn not_whole(&self, what: String) -> JournalError {
        JournalError::NotWhole {
            path: self.path.clone(),
            what,
        }
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
