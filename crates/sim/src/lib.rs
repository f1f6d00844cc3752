//! A simulated cell behind the device traits.
