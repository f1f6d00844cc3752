//! The `unscrew` command line.
fn main() {}
