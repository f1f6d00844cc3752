//! The disassembly program: device traits and drivers, capture loop, planning, outcomes, journal.

pub mod calibrate;
pub mod capture;
pub mod config;
pub mod device;
pub mod journal;
pub mod plan;
pub mod program;
pub mod record;
pub mod removal;
pub mod run;
pub mod statistics;
