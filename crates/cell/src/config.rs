//! The cell file: which devices, which limits. TOML, unknown keys refused.

use crate::device::DriveProgram;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A cell file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("cannot read the cell file {path}: {source}; check the path")]
    Read {
        /// File.
        path: String,
        /// Cause.
        source: std::io::Error,
    },
    /// The text is no cell file.
    #[error("{origin} is not a cell file: {reason}")]
    Syntax {
        /// File.
        origin: String,
        /// Line, key and cause.
        reason: String,
    },
    /// A value that would not work or not be safe.
    #[error("{origin}: {key} = {value} is not allowed: {reason}")]
    Value {
        /// File.
        origin: String,
        /// Key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        reason: &'static str,
    },
}

/// What stands behind the device traits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Backend {
    /// The simulated cell.
    Simulated,
}

/// One cell: its devices and the limits of its program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellConfig {
    /// Name in reports.
    pub name: String,
    /// What stands behind the device traits.
    pub backend: Backend,
    /// Settings of the simulated cell, which reads (and checks) them itself.
    #[serde(default)]
    pub simulated: toml::Table,
    /// How faces are looked at.
    #[serde(default)]
    pub inspection: Inspection,
    /// What is not even begun.
    #[serde(default)]
    pub exclusion: Exclusion,
    /// How the arms come to a screw.
    #[serde(default)]
    pub approach: Approach,
    /// How screws are driven.
    #[serde(default)]
    pub drive: Drive,
    /// How long anything may take.
    #[serde(default)]
    pub timeouts: Timeouts,
    /// What is kept.
    #[serde(default)]
    pub journal: JournalConfig,
}

/// How faces are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Inspection {
    /// Depths at which a face can stand, mm: everything else in the picture is background.
    pub working_depth_mm: [f64; 2],
    /// Diameters that a screw's head can have, mm: anything else is not acted on.
    pub head_mm: [f64; 2],
    /// Frames of depth that are averaged for a face.
    pub depth_frames: usize,
    /// Half width of the region for a second look, mm.
    pub second_look_mm: f64,
    /// A screw seen within this distance of a target is that target, mm.
    pub same_screw_mm: f64,
    /// How much likelier a doubtful head is a screw once the cover that it may hold has not come off: a missed screw always holds
    /// it, and of covers without one about one in 150 jams.
    pub stuck_cover_odds: f64,
    /// Heads at most that are tried on such a face for no other reason, the likeliest first.
    pub doubtful_max: usize,
    /// Time that is budgeted for computing on a picture, s per megapixel. Only a simulated clock needs it.
    pub vision_s_per_mpx: f64,
}

impl Default for Inspection {
    fn default() -> Self {
        Self {
            working_depth_mm: [1100.0, 1900.0],
            head_mm: [5.5, 15.0],
            depth_frames: 1,
            second_look_mm: 32.0,
            same_screw_mm: 4.0,
            stuck_cover_odds: 150.0,
            doubtful_max: 6,
            vision_s_per_mpx: 0.05,
        }
    }
}

/// Rules that exclude a unit before anything on the face is touched (the paper's class III: slots under mud or webs, covers
/// bent beyond range).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Exclusion {
    /// Candidates for review that a face may have before it is excluded: heads whose recess cannot be judged. Fewer are left alone;
    /// if the cover then does not come off, one of them is probably a screw.
    pub review_max: usize,
    /// Only candidates with at least this score count.
    pub review_score_min: f64,
    /// Largest tilt of a face against the camera's axis, rad: ±6° by specification, and 2° for the measurement.
    pub face_tilt_max_rad: f64,
    /// Largest lean of a face's screws together against the face, rad: beyond, the bit slips out of them.
    pub heads_lean_max_rad: f64,
    /// Largest tilt of the sheet around a screw against the camera's axis, rad.
    pub screw_tilt_max_rad: f64,
    /// Screws of a face that may sit on sheet bent beyond that before it is excluded.
    pub bent_max: usize,
}

impl Default for Exclusion {
    fn default() -> Self {
        Self {
            review_max: 2,
            review_score_min: 0.3,
            face_tilt_max_rad: 8f64.to_radians(),
            heads_lean_max_rad: 9f64.to_radians(),
            screw_tilt_max_rad: 11f64.to_radians(),
            bent_max: 0,
        }
    }
}

/// How an arm comes to a screw.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Approach {
    /// Distance in front of the screw from which the bit goes straight in, mm.
    pub standoff_mm: f64,
    /// Speed on that way, mm/s.
    pub approach_mm_s: f64,
    /// Speed back, mm/s.
    pub retract_mm_s: f64,
    /// The sheet around a screw is followed instead of the whole face if it leans further from it than this, rad: below, the
    /// face's plane is the better measurement.
    pub local_normal_from_rad: f64,
    /// Age from which a map is not trusted any more, days since it was fitted, realigned or last passed a check.
    pub map_age_max_days: f64,
}

impl Default for Approach {
    fn default() -> Self {
        Self {
            standoff_mm: 40.0,
            approach_mm_s: 150.0,
            retract_mm_s: 400.0,
            local_normal_from_rad: 3f64.to_radians(),
            map_age_max_days: 30.0,
        }
    }
}

/// Bounded programmes of the driver.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Drive {
    /// First attempt.
    pub first: DriveProgram,
    /// Once more after the bit slipped out: pressed harder.
    pub after_cam_out: DriveProgram,
    /// Once more after the screw did not turn: a longer burst.
    pub after_seized: DriveProgram,
    /// Places around a screw that the camera sees and the bit does not meet; 0: none.
    pub search_steps: u32,
    /// How far from it they are, mm: the bit's cone reaches 0.75 mm.
    pub search_mm: f64,
}

impl Default for Drive {
    fn default() -> Self {
        let first = DriveProgram {
            axial_force_n: 150.0,
            max_time_s: 2.5,
            max_torque_nm: 12.0,
            stroke_mm: 10.0,
        };
        Self {
            first,
            after_cam_out: DriveProgram {
                axial_force_n: 250.0,
                ..first
            },
            after_seized: DriveProgram {
                max_time_s: 6.0,
                max_torque_nm: 18.0,
                axial_force_n: 200.0,
                ..first
            },
            search_steps: 6,
            search_mm: 0.8,
        }
    }
}

/// How long anything may take, s. After that the state is read; nothing is sent again.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Timeouts {
    /// A unit on the table.
    pub load_s: f64,
    /// A face before the camera.
    pub present_s: f64,
    /// A move of an arm.
    pub move_s: f64,
    /// A job of an arm: pulling a cover, laying it aside.
    pub job_s: f64,
    /// The table cleared.
    pub discharge_s: f64,
    /// Oldest state of an arm that may be acted on.
    pub state_age_s: f64,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            load_s: 600.0,
            present_s: 30.0,
            move_s: 10.0,
            job_s: 40.0,
            discharge_s: 60.0,
            state_age_s: 0.5,
        }
    }
}

/// What is kept.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JournalConfig {
    /// Quality of the kept pictures, 1 to 100.
    pub jpeg_quality: u8,
    /// Keep every frame that was decided on without loss, so that `unscrew replay` can decide again.
    pub keep_frames: bool,
}

impl Default for JournalConfig {
    fn default() -> Self {
        Self {
            jpeg_quality: 88,
            keep_frames: false,
        }
    }
}

impl CellConfig {
    /// The simulated cell with the limits as shipped.
    pub fn simulated() -> Self {
        Self {
            name: "simulated cell".into(),
            backend: Backend::Simulated,
            simulated: toml::Table::new(),
            inspection: Inspection::default(),
            exclusion: Exclusion::default(),
            approach: Approach::default(),
            drive: Drive::default(),
            timeouts: Timeouts::default(),
            journal: JournalConfig::default(),
        }
    }

    /// Reads a cell file.
    ///
    /// # Errors
    /// [`ConfigError`], with the file's name and the key.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let origin = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read {
            path: origin.clone(),
            source,
        })?;
        Self::parse(&text, &origin)
    }

    /// Reads a cell file's text; `origin` names it in messages.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn parse(text: &str, origin: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| ConfigError::Syntax {
            origin: origin.into(),
            reason: e.to_string(),
        })?;
        config.check(origin)?;
        Ok(config)
    }

    /// Limits that no cell file may exceed: whatever it says, a programme of the driver stays bounded.
    fn check(&self, origin: &str) -> Result<(), ConfigError> {
        let within = |key, value: f64, low: f64, high: f64, reason| {
            if value.is_finite() && (low..=high).contains(&value) {
                Ok(())
            } else {
                Err(ConfigError::Value {
                    origin: origin.into(),
                    key,
                    value,
                    reason,
                })
            }
        };
        let drive = &self.drive;
        for program in [drive.first, drive.after_cam_out, drive.after_seized] {
            within("drive.*.max_time_s", program.max_time_s, 0.1, 15.0, "0.1 to 15 s")?;
            within(
                "drive.*.max_torque_nm",
                program.max_torque_nm,
                0.5,
                40.0,
                "0.5 to 40 N m",
            )?;
            within(
                "drive.*.axial_force_n",
                program.axial_force_n,
                10.0,
                500.0,
                "10 to 500 N",
            )?;
            within("drive.*.stroke_mm", program.stroke_mm, 1.0, 60.0, "1 to 60 mm")?;
        }
        let approach = &self.approach;
        within("approach.standoff_mm", approach.standoff_mm, 10.0, 60.0, "10 to 60 mm")?;
        within(
            "approach.approach_mm_s",
            approach.approach_mm_s,
            1.0,
            500.0,
            "1 to 500 mm/s",
        )?;
        within(
            "approach.retract_mm_s",
            approach.retract_mm_s,
            1.0,
            1500.0,
            "1 to 1500 mm/s",
        )?;
        let [near, far] = self.inspection.working_depth_mm;
        within(
            "inspection.working_depth_mm[0]",
            near,
            1.0,
            far,
            "nearer than the far end",
        )?;
        let tilt = self.exclusion.screw_tilt_max_rad;
        within("exclusion.screw_tilt_max_rad", tilt, 0.0, 0.5, "at most 0.5 rad")?;
        let quality = f64::from(self.journal.jpeg_quality);
        within("journal.jpeg_quality", quality, 1.0, 100.0, "1 to 100")?;
        let times = &self.timeouts;
        let all = [
            times.load_s,
            times.present_s,
            times.move_s,
            times.job_s,
            times.discharge_s,
        ];
        for time_s in all {
            within("timeouts.*", time_s, 0.1, 86_400.0, "0.1 s to a day")?;
        }
        within("timeouts.state_age_s", times.state_age_s, 0.01, 5.0, "0.01 to 5 s")?;
        within(
            "inspection.depth_frames",
            self.inspection.depth_frames as f64,
            1.0,
            16.0,
            "1 to 16",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shipped_cell_file_loads() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("cells");
        let mut files = 0;
        for entry in std::fs::read_dir(folder).expect("cells folder") {
            let path = entry.expect("entry").path();
            CellConfig::read(&path).unwrap_or_else(|e| panic!("{e}"));
            files += 1;
        }
        assert!(files >= 1);
    }

    #[test]
    fn the_example_says_what_the_defaults_are() {
        let text = include_str!("../cells/simulated.toml");
        assert_eq!(
            CellConfig::parse(text, "simulated.toml").expect("parsed"),
            CellConfig::simulated()
        );
    }

    #[test]
    fn unknown_keys_and_unsafe_values_are_refused() {
        let error = CellConfig::parse("name = 'x'\nbackend = 'simulated'\n[drive.first]\naxial = 3", "c.toml")
            .expect_err("unknown key")
            .to_string();
        assert!(error.contains("c.toml") && error.contains("axial"), "{error}");
        let text = "name = 'x'\nbackend = 'simulated'\n[approach]\nstandoff_mm = 400.0";
        let error = CellConfig::parse(text, "c.toml").expect_err("unsafe").to_string();
        assert!(
            error.contains("approach.standoff_mm") && error.contains("10 to 60"),
            "{error}"
        );
        let error = CellConfig::parse("name = 'x'\nbackend = 'hses'", "c.toml")
            .expect_err("backend")
            .to_string();
        assert!(error.contains("simulated"), "{error}");
    }
}
