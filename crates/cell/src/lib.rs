//! The disassembly program: device traits, capture, planning, removal, outcomes, journal.
//!
//! It is the middle and the end of the way of one unit: a face is presented and captured ([`capture`]), the detector's finds
//! become targets ([`plan`]) that an arm may be sent to, screws are driven ([`removal`]) and looked at again, covers are pulled, and
//! every act is in the journal ([`journal`]) before it is begun. [`run::Runner`] walks through a [`program::Program`], which is data.
//! What stands behind [`device`]'s traits, a simulated cell or a real one, it cannot tell; nothing here sees a simulator's truth.
//!
//! A robot is only ever sent to a [`plan::SafeTarget`], and only a map whose calibrated volume holds the place makes one, once
//! [`motion`] has found the whole way there free.
//!
//! ```
//! use cell::program::Program;
//! let program = Program::paper()?;
//! let names: Vec<&str> = program.steps.iter().map(|step| step.name.as_str()).collect();
//! assert_eq!(names[..4], ["front screws", "left screws", "right screws", "top cover"]);
//! // a product of one's own is a file
//! let text = r#"
//!     product = "microwave oven"
//!     [[steps]]
//!     name = "back screws"
//!     present = "back"
//!     work = { kind = "screws", least = 4 }
//!     [[steps]]
//!     name = "hood"
//!     present = "back"
//!     requires = ["back screws"]
//!     work = { kind = "cover", cover = "hood", by = "arm_b", held_by = ["back"] }
//! "#;
//! assert_eq!(Program::parse(text, "microwave.toml")?.covers(), ["hood"]);
//! # Ok::<(), cell::program::ProgramError>(())
//! ```

pub mod basis;
pub mod calibrate;
pub mod capture;
pub mod config;
pub mod device;
pub mod digest;
pub mod forecast;
pub mod frames;
pub mod journal;
pub mod ladder;
pub mod look;
pub mod motion;
pub mod packml;
pub mod plan;
pub mod plane;
pub mod policy;
pub mod program;
pub mod record;
pub mod removal;
pub mod replay;
pub mod run;
pub mod schedule;
pub mod seal;
pub mod statistics;
pub mod store;

pub use calibrate::{CaptureSettings, CaptureSummary, capture_pairs};
pub use config::CellConfig;
pub use device::Devices;
pub use digest::Digest;
pub use journal::Journal;
pub use program::Program;
pub use record::{Outcome, UnitRecord};
pub use run::{Finder, Observer, Runner};
pub use statistics::Statistics;
