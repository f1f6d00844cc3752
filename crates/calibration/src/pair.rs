//! Calibration pairs and their CSV files: what a capture records, one row a visit, misses included.

use crate::Mark;
use geometry::{Base, Camera, Pixel, Point};
use std::{
    collections::HashMap,
    fs::{self, File, OpenOptions},
    io::Write,
    path::{Path, PathBuf},
};

/// One visit of the marker: where the arm was told to go and what the camera saw there.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// Number of the visit, unique in a file.
    pub id: u64,
    /// Lattice node (i along x, j along y, k along z of the base); `None` off a lattice.
    pub node: Option<[i32; 3]>,
    /// Time of the visit in the cell's clock, s.
    pub t_s: f64,
    /// Commanded position of the marker.
    pub command: Point<Base>,
    /// Centre of the marker in the image.
    pub pixel: Option<Pixel>,
    /// Depth of the marker along the optical axis, mm.
    pub depth_mm: Option<f64>,
    /// The marker in the camera's frame.
    pub camera: Option<Point<Camera>>,
    /// Joint angles J1 to J6 at the visit, rad.
    pub joints_rad: Option<[f64; 6]>,
    /// False where the marker was not found: the row stays, so that a miss never shifts the pairing.
    pub valid: bool,
}

/// One observation to be mapped: the columns of a pair without `cmd_*` and `q*`.
#[derive(Clone, Debug, PartialEq)]
pub struct Query {
    /// Number of the observation, unique in a file.
    pub id: u64,
    /// Where it is in the image.
    pub pixel: Option<Pixel>,
    /// Where it is in the camera's frame; `None` where `valid` is 0.
    pub camera: Option<Point<Camera>>,
    /// False where nothing was found.
    pub valid: bool,
}

/// What is wrong with a file of pairs or queries, where, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum PairError {
    /// The file could not be read.
    #[error("cannot read {path}: {source}; check the path and its permissions")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error("cannot write {path}: {source}; check that the folder exists, is writable and has space")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Not a CSV file of text.
    #[error("{path} line {line}: not CSV ({reason}); expected text, comma-separated, with a header")]
    NotCsv {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
        /// The parser's reason.
        reason: String,
    },
    /// The file has no rows, or not even a header.
    #[error("{path} holds no rows; record or export the pairs again")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The first line is data.
    #[error("{path} line 1: no header, the first line is numbers; put the column names first: {HEADER}")]
    NoHeader {
        /// The file.
        path: PathBuf,
    },
    /// A column that is needed is not there.
    #[error("{path} line 1: column '{column}' is missing (found: {found}); add it or rename yours")]
    MissingColumn {
        /// The file.
        path: PathBuf,
        /// The column.
        column: String,
        /// The columns that are there.
        found: String,
    },
    /// A column stands in the header twice.
    #[error("{path} line 1: column '{column}' stands in the header twice; remove one")]
    DoubleColumn {
        /// The file.
        path: PathBuf,
        /// The column.
        column: String,
    },
    /// A row with more or fewer fields than the header.
    #[error(
        "{path} line {line}: {fields} fields but the header has {expected}; a row cut short by a crash can be deleted"
    )]
    Fields {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
        /// Fields in the row.
        fields: usize,
        /// Columns of the header.
        expected: usize,
    },
    /// A field that does not hold what its column promises.
    #[error("{path} line {line}, column '{column}': '{value}' {problem}")]
    Value {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
        /// The column.
        column: String,
        /// What stands there.
        value: String,
        /// Why it cannot be used and what to do.
        problem: &'static str,
    },
    /// Not a pose.
    #[error("{path}: {reason}")]
    Pose {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: crate::PoseError,
    },
    /// Two rows with the same id.
    #[error("{path} line {line}: id {id} stands already in line {first}; a visit may be in the file once")]
    DuplicateId {
        /// The file.
        path: PathBuf,
        /// Line of the second, from 1.
        line: u64,
        /// The id.
        id: u64,
        /// Line of the first, from 1.
        first: u64,
    },
}

const HEADER: &str = "id,i,j,k,t_s,cmd_x_mm,cmd_y_mm,cmd_z_mm,u_px,v_px,depth_mm,cam_x_mm,cam_y_mm,cam_z_mm,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,valid";
const NODE: [&str; 3] = ["i", "j", "k"];
const COMMAND: [&str; 3] = ["cmd_x_mm", "cmd_y_mm", "cmd_z_mm"];
const CAMERA: [&str; 3] = ["cam_x_mm", "cam_y_mm", "cam_z_mm"];
const JOINTS: [&str; 6] = ["q1_rad", "q2_rad", "q3_rad", "q4_rad", "q5_rad", "q6_rad"];

/// Reads pairs, columns in any order; columns that are not known are passed over, `i j k`, `t_s`, `u_px v_px`,
/// `depth_mm` and `q*` may be absent or empty.
///
/// # Errors
/// [`PairError`], with file, line and column: no header, a missing column, NaN, duplicate ids, a row cut short.
pub fn read_pairs(path: &Path) -> Result<Vec<Pair>, PairError> {
    let table = Table::read(path)?;
    for column in ["id", "valid"].into_iter().chain(COMMAND).chain(CAMERA) {
        table.require(column)?;
    }
    table
        .rows()
        .map(|row| {
            let row = row?;
            let valid = row.flag("valid")?;
            let node = row.group(NODE, |r, c| r.integer(c))?;
            let command = row.group(COMMAND, |r, c| r.number(c))?;
            let Some([x, y, z]) = command else {
                return Err(row.value_error(
                    "cmd_x_mm",
                    "is empty: every visit has its command, also where the marker was missed",
                ));
            };
            let joints_rad = row.group(JOINTS, |r, c| r.number(c))?;
            Ok(Pair {
                id: row.id()?,
                node,
                t_s: row.number("t_s")?.unwrap_or(0.0),
                command: Point::new(x, y, z),
                pixel: row.pixel(valid)?,
                depth_mm: row.seen("depth_mm", valid)?,
                camera: row.camera(valid)?,
                joints_rad,
                valid,
            })
        })
        .collect()
}

/// Reads queries: `id`, `cam_*` and, if there, `u_px v_px` and `valid` (1 where it is absent).
///
/// # Errors
/// As for [`read_pairs`].
pub fn read_queries(path: &Path) -> Result<Vec<Query>, PairError> {
    let table = Table::read(path)?;
    for column in ["id"].into_iter().chain(CAMERA) {
        table.require(column)?;
    }
    let flagged = table.columns.contains_key("valid");
    table
        .rows()
        .map(|row| {
            let row = row?;
            let valid = !flagged || row.flag("valid")?;
            Ok(Query {
                id: row.id()?,
                pixel: row.pixel(valid)?,
                camera: row.camera(valid)?,
                valid,
            })
        })
        .collect()
}

/// Reads needle marks: `id`, `target_*_mm` and `mark_*_mm`, base frame.
///
/// # Errors
/// As for [`read_pairs`].
pub fn read_marks(path: &Path) -> Result<Vec<Mark>, PairError> {
    const TARGET: [&str; 3] = ["target_x_mm", "target_y_mm", "target_z_mm"];
    const MARK: [&str; 3] = ["mark_x_mm", "mark_y_mm", "mark_z_mm"];
    let table = Table::read(path)?;
    for column in ["id"].into_iter().chain(TARGET).chain(MARK) {
        table.require(column)?;
    }
    table
        .rows()
        .map(|row| {
            let row = row?;
            let point = |columns: [&'static str; 3]| match row.group(columns, |r, c| r.number(c))? {
                Some([x, y, z]) => Ok(Point::new(x, y, z)),
                None => Err(row.value_error(columns[0], "is empty: every row has its target and its mark")),
            };
            Ok(Mark {
                id: row.id()?,
                target: point(TARGET)?,
                mark: point(MARK)?,
            })
        })
        .collect()
}

/// Writes pairs as one file, aside and then renamed.
///
/// # Errors
/// [`PairError::Write`].
pub fn write_pairs(path: &Path, pairs: &[Pair]) -> Result<(), PairError> {
    geometry::write_aside(path, to_csv(pairs).as_bytes()).map_err(|e| PairError::Write {
        path: path.into(),
        source: std::io::Error::other(e),
    })
}

pub(crate) fn to_csv(pairs: &[Pair]) -> String {
    let mut text = format!("{HEADER}\n");
    pairs.iter().for_each(|pair| text.push_str(&row_of(pair)));
    text
}

fn row_of(pair: &Pair) -> String {
    let number = |v: Option<f64>, digits: usize| v.map(|v| format!("{v:.digits$}")).unwrap_or_default();
    let mut fields = vec![pair.id.to_string()];
    fields.extend((0..3).map(|a| pair.node.map(|n| n[a].to_string()).unwrap_or_default()));
    fields.push(number(Some(pair.t_s), 4));
    fields.extend(pair.command.to_array().map(|v| number(Some(v), 4)));
    fields.push(number(pair.pixel.map(|p| p.u_px), 4));
    fields.push(number(pair.pixel.map(|p| p.v_px), 4));
    fields.push(number(pair.depth_mm, 4));
    fields.extend((0..3).map(|a| number(pair.camera.map(|p| p.to_array()[a]), 4)));
    fields.extend((0..6).map(|a| number(pair.joints_rad.map(|q| q[a]), 6)));
    fields.push(u8::from(pair.valid).to_string());
    fields.join(",") + "\n"
}

/// Appends pairs as they come: after a crash at most the row being written is lost.
#[derive(Debug)]
pub struct PairWriter {
    path: PathBuf,
    file: File,
}

impl PairWriter {
    /// Starts a new file; one that exists already is an error, since hours of capture must not be lost to a slip.
    ///
    /// # Errors
    /// [`PairError::Write`].
    pub fn create(path: &Path) -> Result<Self, PairError> {
        let write = |source| PairError::Write {
            path: path.into(),
            source,
        };
        let file = OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(path)
            .map_err(write)?;
        let mut writer = Self {
            path: path.into(),
            file,
        };
        writer.put(&format!("{HEADER}\n"))?;
        Ok(writer)
    }

    /// Goes on with a capture: the pairs that are there, and a writer behind them. A row cut short by a crash is dropped.
    ///
    /// # Errors
    /// [`PairError`] as for [`read_pairs`], or [`PairError::Value`] if the columns are not in this writer's order.
    pub fn resume(path: &Path) -> Result<(Self, Vec<Pair>), PairError> {
        let text = fs::read_to_string(path).map_err(|source| PairError::Read {
            path: path.into(),
            source,
        })?;
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        if whole == 0 || text.lines().next() != Some(HEADER) {
            return Err(PairError::Value {
                path: path.into(),
                line: 1,
                column: "id".into(),
                value: text.lines().next().unwrap_or_default().chars().take(60).collect(),
                problem: "is not the header that a capture writes; start a new file",
            });
        }
        let write = |source| PairError::Write {
            path: path.into(),
            source,
        };
        let file = OpenOptions::new().append(true).open(path).map_err(write)?;
        file.set_len(whole as u64).map_err(write)?;
        let pairs = match read_pairs(path) {
            Err(PairError::Empty { .. }) => Vec::new(),
            other => other?,
        };
        Ok((
            Self {
                path: path.into(),
                file,
            },
            pairs,
        ))
    }

    /// Appends one row and hands it to the disk.
    ///
    /// # Errors
    /// [`PairError::Write`].
    pub fn append(&mut self, pair: &Pair) -> Result<(), PairError> {
        self.put(&row_of(pair))
    }

    fn put(&mut self, row: &str) -> Result<(), PairError> {
        // one write call a row: a reader sees whole rows only
        self.file
            .write_all(row.as_bytes())
            .and_then(|()| self.file.sync_data())
            .map_err(|source| PairError::Write {
                path: self.path.clone(),
                source,
            })
    }
}

/// A CSV file with its header looked up, and the line of every row for messages.
struct Table {
    path: PathBuf,
    columns: HashMap<String, usize>,
    rows: Vec<(u64, csv::StringRecord)>,
}

struct Row<'a> {
    table: &'a Table,
    line: u64,
    record: &'a csv::StringRecord,
}

impl Table {
    fn read(path: &Path) -> Result<Self, PairError> {
        let bytes = fs::read(path).map_err(|source| PairError::Read {
            path: path.into(),
            source,
        })?;
        let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes);
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .flexible(true)
            .comment(Some(b'#'))
            .trim(csv::Trim::All)
            .from_reader(bytes);
        let mut records = Vec::new();
        for record in reader.records() {
            let record = record.map_err(|e| PairError::NotCsv {
                path: path.into(),
                line: e.position().map_or(0, csv::Position::line),
                reason: match e.kind() {
                    csv::ErrorKind::Utf8 { .. } => "not UTF-8 text".into(),
                    _ => e.to_string(),
                },
            })?;
            records.push((record.position().map_or(0, csv::Position::line), record));
        }
        if records.is_empty() {
            return Err(PairError::Empty { path: path.into() });
        }
        let (_, header) = records.remove(0);
        if header
            .iter()
            .filter(|f| !f.is_empty())
            .all(|f| f.parse::<f64>().is_ok())
        {
            return Err(PairError::NoHeader { path: path.into() });
        }
        let mut columns = HashMap::new();
        for (at, name) in header.iter().enumerate() {
            if columns.insert(name.to_string(), at).is_some() && !name.is_empty() {
                return Err(PairError::DoubleColumn {
                    path: path.into(),
                    column: name.into(),
                });
            }
        }
        let table = Self {
            path: path.into(),
            columns,
            rows: records,
        };
        table.require("id")?;
        if table.rows.is_empty() {
            return Err(PairError::Empty { path: path.into() });
        }
        if let Some((line, record)) = table.rows.iter().find(|(_, r)| r.len() != header.len()) {
            return Err(PairError::Fields {
                path: path.into(),
                line: *line,
                fields: record.len(),
                expected: header.len(),
            });
        }
        let mut lines = HashMap::new();
        for row in table.rows() {
            let row = row?;
            let id = row.id()?;
            if let Some(first) = lines.insert(id, row.line) {
                return Err(PairError::DuplicateId {
                    path: path.into(),
                    line: row.line,
                    id,
                    first,
                });
            }
        }
        Ok(table)
    }

    fn require(&self, column: &str) -> Result<(), PairError> {
        if self.columns.contains_key(column) {
            return Ok(());
        }
        let mut found: Vec<_> = self.columns.iter().map(|(name, at)| (*at, name.as_str())).collect();
        found.sort_unstable();
        Err(PairError::MissingColumn {
            path: self.path.clone(),
            column: column.into(),
            found: found.iter().map(|(_, name)| *name).collect::<Vec<_>>().join(", "),
        })
    }

    fn rows(&self) -> impl Iterator<Item = Result<Row<'_>, PairError>> {
        self.rows.iter().map(|(line, record)| {
            Ok(Row {
                table: self,
                line: *line,
                record,
            })
        })
    }
}

impl Row<'_> {
    fn text(&self, column: &str) -> &str {
        self.table
            .columns
            .get(column)
            .and_then(|&at| self.record.get(at))
            .unwrap_or_default()
    }

    fn value_error(&self, column: &str, problem: &'static str) -> PairError {
        PairError::Value {
            path: self.table.path.clone(),
            line: self.line,
            column: column.into(),
            value: self.text(column).into(),
            problem,
        }
    }

    fn id(&self) -> Result<u64, PairError> {
        self.text("id")
            .parse()
            .map_err(|_| self.value_error("id", "is not a whole number; number the visits from 0"))
    }

    fn flag(&self, column: &str) -> Result<bool, PairError> {
        match self.text(column) {
            "1" => Ok(true),
            "0" => Ok(false),
            _ => Err(self.value_error(column, "is neither 1 (marker found) nor 0 (not found)")),
        }
    }

    fn integer(&self, column: &str) -> Result<Option<i32>, PairError> {
        match self.text(column) {
            "" => Ok(None),
            text => text
                .parse()
                .map(Some)
                .map_err(|_| self.value_error(column, "is not a whole number")),
        }
    }

    fn number(&self, column: &str) -> Result<Option<f64>, PairError> {
        match self.text(column) {
            "" => Ok(None),
            text => match text.parse::<f64>() {
                Ok(v) if v.is_finite() => Ok(Some(v)),
                Ok(_) => Err(self.value_error(
                    column,
                    "is not a finite number; set 'valid' to 0 where the marker was not found",
                )),
                Err(_) => Err(self.value_error(column, "is not a number")),
            },
        }
    }

    /// A measured number: of a visit that missed the marker, whatever stands there counts as nothing unless it is a number.
    fn seen(&self, column: &str, valid: bool) -> Result<Option<f64>, PairError> {
        match self.number(column) {
            Err(_) if !valid => Ok(None),
            other => other,
        }
    }

    /// All columns of a group filled, or all empty.
    fn group<T: Copy, const N: usize>(
        &self,
        columns: [&'static str; N],
        get: impl Fn(&Self, &str) -> Result<Option<T>, PairError>,
    ) -> Result<Option<[T; N]>, PairError> {
        let mut filled = Vec::with_capacity(N);
        for column in columns {
            filled.extend(get(self, column)?);
        }
        match <[T; N]>::try_from(filled) {
            Ok(all) => Ok(Some(all)),
            Err(some) if some.is_empty() => Ok(None),
            Err(_) => {
                let empty = columns
                    .into_iter()
                    .find(|c| self.text(c).is_empty())
                    .unwrap_or(columns[0]);
                Err(self.value_error(empty, "is empty while its neighbours are not; fill all of them or none"))
            }
        }
    }

    fn pixel(&self, valid: bool) -> Result<Option<Pixel>, PairError> {
        let (u, v) = (self.seen("u_px", valid)?, self.seen("v_px", valid)?);
        Ok(u.zip(v).map(|(u, v)| Pixel::new(u, v)))
    }

    fn camera(&self, valid: bool) -> Result<Option<Point<Camera>>, PairError> {
        let mut xyz = [0.0; 3];
        for (value, column) in xyz.iter_mut().zip(CAMERA) {
            match self.seen(column, valid)? {
                Some(v) => *value = v,
                None if valid => {
                    return Err(self.value_error(
                        column,
                        "is empty although 'valid' is 1; set 'valid' to 0 where the marker was not found",
                    ));
                }
                None => return Ok(None),
            }
        }
        Ok(Some(Point::new(xyz[0], xyz[1], xyz[2])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<Pair> {
        let seen = Pair {
            id: 7,
            node: Some([0, 3, -1]),
            t_s: 41.5,
            command: Point::new(950.0, -450.0, 150.1234),
            pixel: Some(Pixel::new(3550.8211, 2843.4209)),
            depth_mm: Some(1355.8252),
            camera: Some(Point::new(439.0789, 396.13, 1355.8252)),
            joints_rad: Some([-0.645958, 0.916555, -0.826299, 0.653123, 1.707941, 0.104228]),
            valid: true,
        };
        let missed = Pair {
            id: 8,
            node: None,
            pixel: None,
            depth_mm: None,
            camera: None,
            joints_rad: None,
            valid: false,
            ..seen.clone()
        };
        vec![seen, missed]
    }

    fn written(text: &str) -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join("pairs.csv");
        fs::write(&path, text).expect("written");
        (dir, path)
    }

    fn message(text: &str) -> String {
        let (_dir, path) = written(text);
        read_pairs(&path).expect_err("must be refused").to_string()
    }

    #[test]
    fn columns_are_the_contract() {
        let text = to_csv(&sample());
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some(HEADER));
        assert_eq!(
            lines.next(),
            Some(
                "7,0,3,-1,41.5000,950.0000,-450.0000,150.1234,3550.8211,2843.4209,1355.8252,439.0789,396.1300,1355.8252,-0.645958,0.916555,-0.826299,0.653123,1.707941,0.104228,1"
            )
        );
        assert_eq!(
            lines.next(),
            Some("8,,,,41.5000,950.0000,-450.0000,150.1234,,,,,,,,,,,,,0")
        );
    }

    #[test]
    fn any_column_order_reads_the_same() {
        let text = to_csv(&sample());
        let reversed: String = text
            .lines()
            .map(|line| line.split(',').rev().chain(["more"]).collect::<Vec<_>>().join(", ") + "\r\n")
            .collect();
        let (_dir, path) = written(&format!("\u{feff}{reversed}"));
        assert_eq!(read_pairs(&path).expect("read"), sample());
    }

    #[test]
    fn a_miss_may_hold_anything_measured() {
        let text = "id,valid,cmd_x_mm,cmd_y_mm,cmd_z_mm,cam_x_mm,cam_y_mm,cam_z_mm\n1,0,1,2,3,nan,nan,nan\n";
        let (_dir, path) = written(text);
        let pairs = read_pairs(&path).expect("read");
        assert!(!pairs[0].valid && pairs[0].camera.is_none());
    }

    #[test]
    fn errors_say_where_and_what_to_do() {
        let good = to_csv(&sample());
        let row = good.lines().nth(1).expect("a row");
        for (text, expected) in [
            (row.to_string(), vec!["line 1", "no header", "id,i,j,k"]),
            (
                good.replace("cam_y_mm", "kam_y"),
                vec!["line 1", "'cam_y_mm' is missing", "kam_y"],
            ),
            (
                good.replace("396.1300", "NaN"),
                vec!["line 2", "'cam_y_mm'", "'NaN'", "'valid' to 0"],
            ),
            (
                good.replace("396.1300", ""),
                vec!["line 2", "'cam_y_mm'", "is empty although"],
            ),
            (good.replace("396.1300", "3,9"), vec!["line 2", "22 fields", "21"]),
            (
                good.replace("-450.0000", "left"),
                vec!["line 2", "'cmd_y_mm'", "'left' is not a number"],
            ),
            (format!("{good}{row}\n"), vec!["line 4", "id 7", "line 2"]),
            (
                good.replace("7,0,3,-1", "7,0,,-1"),
                vec!["line 2", "'j'", "all of them or none"],
            ),
            (good.replace("u_px", "v_px"), vec!["'v_px'", "twice"]),
            (format!("{HEADER}\n"), vec!["no rows"]),
            (String::new(), vec!["no rows"]),
        ] {
            let message = message(&text);
            assert!(message.contains("pairs.csv"), "{message}");
            for part in expected {
                assert!(message.contains(part), "'{part}' is not in: {message}");
            }
        }
    }

    #[test]
    fn a_capture_goes_on_after_a_crash() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join("pairs.csv");
        let pairs = sample();
        let mut writer = PairWriter::create(&path).expect("created");
        writer.append(&pairs[0]).expect("appended");
        drop(writer);
        assert!(
            matches!(PairWriter::create(&path), Err(PairError::Write { .. })),
            "never over a capture"
        );
        let whole = fs::read_to_string(&path).expect("text");
        fs::write(&path, format!("{whole}8,1,2")).expect("written");
        let (mut writer, done) = PairWriter::resume(&path).expect("resumed");
        assert_eq!(done, pairs[..1]);
        writer.append(&pairs[1]).expect("appended");
        assert_eq!(read_pairs(&path).expect("read"), pairs);
    }
}
