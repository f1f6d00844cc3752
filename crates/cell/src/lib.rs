//! The disassembly program: device traits and drivers, capture loop, planning, outcomes, journal.

pub mod device;
