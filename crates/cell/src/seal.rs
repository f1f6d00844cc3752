//! Is the journal whole? Every event carries a sum over itself and the events of its unit before it, and the last event's number and sum
//! stand in a small file beside the journal.
//!
//! SQLite proves what a crash can do to it, not what a disk or a person can: a flipped bit in a page, a page of zeros, `journal.db` copied
//! without its `-wal`. The sums show the first two, the file the third: nothing is acted on that is not what was written down.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

/// File name of the end mark in a run's folder.
pub const END_FILE: &str = "journal.end";
const SUM_CHARS: usize = 16;

/// Sum of an event that follows the one with the sum `before` (empty for the first of its unit).
pub(crate) fn sum(before: &str, unit: u64, t_s: f64, json: &str) -> String {
    let text = format!("{before} {unit} {:016x} {json}", t_s.to_bits());
    let mut sum = geometry::sha256_hex(text.as_bytes());
    sum.truncate(SUM_CHARS);
    sum
}

/// Number and sum of the last event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct End {
    pub(crate) event: i64,
    pub(crate) sum: String,
}

impl End {
    /// The end that is on file; `None` if there is none, or a crash cut it off.
    pub(crate) fn read(folder: &Path) -> Result<Option<Self>, io::Error> {
        let text = match std::fs::read_to_string(folder.join(END_FILE)) {
            Ok(text) => text,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(e),
        };
        let end = text.trim_end().split_once(' ').and_then(|(event, sum)| {
            Some(Self {
                event: event.parse().ok()?,
                sum: (sum.len() == SUM_CHARS).then(|| sum.to_owned())?,
            })
        });
        Ok(end)
    }
}

/// The file, open for writing.
#[derive(Debug)]
pub(crate) struct EndFile(File);

impl EndFile {
    pub(crate) fn open(folder: &Path) -> Result<Self, io::Error> {
        let mut options = OpenOptions::new();
        let file = options.write(true).create(true).truncate(false);
        file.open(folder.join(END_FILE)).map(Self)
    }

    /// Always the same length at the same place: a full disk has room for it, and a crash leaves the old or the new one. It is not
    /// synchronised: it may be behind the journal, which is, but never before it.
    pub(crate) fn write(&mut self, end: &End) -> Result<(), io::Error> {
        let line = format!("{:020} {}\n", end.event, end.sum);
        #[cfg(unix)]
        {
            std::os::unix::fs::FileExt::write_all_at(&self.0, line.as_bytes(), 0)?;
        }
        #[cfg(not(unix))]
        {
            io::Seek::rewind(&mut self.0)?;
            self.0.write_all(line.as_bytes())?;
        }
        self.0.flush()
    }
}
