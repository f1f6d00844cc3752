//! The cell file: which devices, which limits. TOML, unknown keys refused.

use crate::device::{Bit, DriveProgram};
use crate::ladder::{Ladder, Rung};
use crate::motion::CellDrawing;
use crate::policy::Destructive;
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
    /// What the arms could run into.
    #[serde(default)]
    pub motion: CellDrawing,
    /// Who works when.
    #[serde(default)]
    pub work: Work,
    /// How screws are driven.
    #[serde(default)]
    pub drive: Drive,
    /// What is tried when a screw does not come out at once.
    #[serde(default)]
    pub ladder: Ladder,
    /// What a person may be asked.
    #[serde(default)]
    pub help: Help,
    /// When a head may be milled off.
    #[serde(default)]
    pub destructive: Destructive,
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
    /// The same once everything likelier has been tried, and a person, if one may be asked, has been: only what is surely something else is left.
    pub last_try_odds: f64,
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
            last_try_odds: 10_000.0,
            doubtful_max: 6,
            vision_s_per_mpx: 0.02,
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
    /// Largest tilt of a face against the camera's axis, rad: so far the bit follows it.
    pub face_tilt_max_rad: f64,
    /// Largest lean of a face's screws together against the face, rad: so far the bit follows them.
    pub heads_lean_max_rad: f64,
    /// Largest lean of the sheet around a screw and of its head from the way in which the bit comes, rad.
    pub screw_tilt_max_rad: f64,
    /// Screws of a face that may lean beyond that before it is excluded.
    pub bent_max: usize,
}

impl Default for Exclusion {
    fn default() -> Self {
        Self {
            review_max: 2,
            review_score_min: 0.3,
            face_tilt_max_rad: 20f64.to_radians(),
            heads_lean_max_rad: 20f64.to_radians(),
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
    /// The sheet around a screw is followed instead of the whole face if both it and the screw's head lean further from it than this, and alike,
    /// rad: else the face's plane is the better measurement.
    pub local_normal_from_rad: f64,
    /// Age from which a map is not trusted any more, days since it was fitted, realigned or last passed a check.
    pub map_age_max_days: f64,
}

impl Default for Approach {
    fn default() -> Self {
        Self {
            standoff_mm: 30.0,
            approach_mm_s: 200.0,
            retract_mm_s: 400.0,
            local_normal_from_rad: 6f64.to_radians(),
            map_age_max_days: 30.0,
        }
    }
}

/// Who works when.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Work {
    /// Arms that take screws out at the same time, 1 or 2. With 1 a second arm does only what the first cannot reach, and pulls covers.
    pub arms: usize,
}

impl Default for Work {
    fn default() -> Self {
        Self { arms: 2 }
    }
}

/// The bounded programme that every screw is begun with; what follows is the [`Ladder`]'s.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Drive {
    /// First attempt.
    pub first: DriveProgram,
}

impl Default for Drive {
    fn default() -> Self {
        Self {
            first: DriveProgram {
                axial_force_n: 150.0,
                max_time_s: 2.5,
                max_torque_nm: 12.0,
                stroke_mm: 10.0,
                bit: Bit::Cross,
            },
        }
    }
}

/// What a person may be asked.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Help {
    /// Whether a person may be asked to click on screws in a picture.
    pub click: bool,
    /// Whether a person can be called to take out by hand what the cell may not mill: such a unit leaves with a note.
    pub hand: bool,
    /// How long an answer is waited for, s.
    pub timeout_s: f64,
}

impl Default for Help {
    fn default() -> Self {
        Self {
            click: false,
            hand: false,
            timeout_s: 120.0,
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
            motion: CellDrawing::default(),
            work: Work::default(),
            drive: Drive::default(),
            ladder: Ladder::default(),
            help: Help::default(),
            destructive: Destructive::default(),
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
        for program in std::iter::once(self.drive.first).chain(self.ladder.rungs().filter_map(Rung::program)) {
            within(
                "max_time_s of a programme",
                program.max_time_s,
                0.1,
                20.0,
                "0.1 to 20 s",
            )?;
            let torque = program.max_torque_nm;
            within("max_torque_nm of a programme", torque, 0.5, 40.0, "0.5 to 40 N m")?;
            let force = program.axial_force_n;
            within("axial_force_n of a programme", force, 10.0, 500.0, "10 to 500 N")?;
            let deepest = if program.bit == Bit::Mill { 8.0 } else { 60.0 };
            let limit = "1 to 60 mm, of a mill at most 8";
            within("stroke_mm of a programme", program.stroke_mm, 1.0, deepest, limit)?;
        }
        if self.drive.first.bit == Bit::Mill {
            return within(
                "drive.first.bit = mill",
                f64::NAN,
                0.0,
                0.0,
                "nothing is begun by destroying it",
            );
        }
        for rung in self.ladder.rungs() {
            if let Rung::Search {
                places,
                radius_mm,
                deeper_mm,
            } = *rung
            {
                within("ladder.*.deeper_mm", deeper_mm, 0.0, 3.0, "0 to 3 mm")?;
                within("places of a search", f64::from(places), 1.0, 24.0, "1 to 24")?;
                within("radius_mm of a search", radius_mm, 0.1, 3.0, "0.1 to 3 mm")?;
            }
        }
        within("ladder.bursts_max", self.ladder.bursts_max as f64, 1.0, 40.0, "1 to 40")?;
        within("help.timeout_s", self.help.timeout_s, 1.0, 3600.0, "1 s to an hour")?;
        within(
            "destructive.part_value",
            self.destructive.part_value,
            0.0,
            1e6,
            "0 to 1,000,000",
        )?;
        within("work.arms", self.work.arms as f64, 1.0, 2.0, "1 or 2")?;
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
        let rules = &self.exclusion;
        for tilt in [
            rules.screw_tilt_max_rad,
            rules.face_tilt_max_rad,
            rules.heads_lean_max_rad,
        ] {
            within("exclusion.*_max_rad", tilt, 0.0, 0.5, "at most 0.5 rad")?;
        }
        for odds in [self.inspection.stuck_cover_odds, self.inspection.last_try_odds] {
            within("inspection.*_odds", odds, 1.0, 1e9, "1 to 1e9")?;
        }
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
        let motion = &self.motion;
        within("motion.margin_mm", motion.margin_mm, 2.0, 200.0, "2 to 200 mm")?;
        let unit = &motion.unit;
        for size_mm in [unit.face_mm[0], unit.face_mm[1], unit.depth_mm] {
            within("motion.unit.*_mm", size_mm, 1.0, 5000.0, "a size of 1 to 5000 mm")?;
        }
        for size_mm in motion.obstacles.iter().flat_map(|block| block.size_mm) {
            within("motion.obstacles.size_mm", size_mm, 1.0, 100_000.0, "above 1 mm")?;
        }
        let drawn = motion.obstacles.iter().map(|block| block.middle_mm);
        let feet = motion.arms.iter().flat_map(|arm| [arm.foot_mm, arm.tip_mm]);
        for mm in drawn.chain(feet).chain([unit.middle_mm]).flatten() {
            within("motion.*_mm", mm, -100_000.0, 100_000.0, "a place within 100 m")?;
        }
        for arm in &motion.arms {
            within("motion.arms.turn_rad", arm.turn_rad, -7.0, 7.0, "a turn at most")?;
            for angle_rad in arm.home_rad {
                within("motion.arms.home_rad", angle_rad, -8.0, 8.0, "-8 to 8 rad")?;
            }
            let parts = arm.tool.len() as f64;
            within(
                "motion.arms.tool, number of capsules",
                parts,
                1.0,
                32.0,
                "1 to 32, the bit first",
            )?;
            for part in &arm.tool {
                within(
                    "motion.arms.tool.radius_mm",
                    part.radius_mm,
                    0.1,
                    1000.0,
                    "0.1 to 1000 mm",
                )?;
                for mm in part.from_mm.into_iter().chain(part.to_mm) {
                    within("motion.arms.tool.*_mm", mm, -3000.0, 3000.0, "-3000 to 3000 mm")?;
                }
            }
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
        let text = "name = 'x'\nbackend = 'simulated'\n[[motion.obstacles]]\nname = 'post'\nmiddle_mm = [0, 0, 0]";
        let error = CellConfig::parse(&format!("{text}\nsize = [1, 1, 1]"), "c.toml").expect_err("unknown key");
        assert!(error.to_string().contains("size"), "{error}");
        let error = CellConfig::parse(&format!("{text}\nsize_mm = [1.0, -1.0, 1.0]"), "c.toml").expect_err("no size");
        assert!(error.to_string().contains("motion.obstacles.size_mm"), "{error}");
        let error = CellConfig::parse("name = 'x'\nbackend = 'hses'", "c.toml")
            .expect_err("backend")
            .to_string();
        assert!(error.contains("simulated"), "{error}");
    }
}
