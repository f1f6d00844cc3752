//! The disassembly program: device traits, capture, planning, outcomes, journal.
