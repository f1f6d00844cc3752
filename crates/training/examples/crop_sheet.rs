//! A sheet of random crops of what is learned from: real ones, rendered ones, and those of more pictures, to be looked at.
//!
//! `cargo run --release -p training --example crop_sheet -- OUT.jpg SEED UNITS [PICTURES]`

use std::path::{Path, PathBuf};
use training::{TrainSettings, crop_sheet};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [out, seed, units, pictures @ ..] = args.as_slice() else {
        return Err("usage: crop_sheet OUT.jpg SEED UNITS [PICTURES]".into());
    };
    let settings = TrainSettings {
        seed: seed.parse()?,
        units: units.parse()?,
        pictures: pictures.first().map(PathBuf::from),
        ..TrainSettings::default()
    };
    geometry::write_jpeg(Path::new(out), &crop_sheet(&settings)?, 88)?;
    Ok(())
}
