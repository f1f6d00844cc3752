//! The whole way in Rust: a plan, a capture (simulated here), a fit, a question, a file, a check, and a bump.
//!
//! `cargo run --release -p calibration --example calibrate`

mod common;

use calibration::{Hull, Map, Moved, Settings, scattered, verify};
use common::world::{Severity, World};
use geometry::{Camera, Point};
use nalgebra::{Isometry3, Vector3};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // where the marker goes: in a real cell, `unscrew calibrate plan` and `capture` do this and the next step
    let plan = scattered(&World::volume(), 100)?;
    println!(
        "{} places, the first at {:?} mm",
        plan.len(),
        plan[0].command.to_array()
    );
    let mut cell = World::new(1, Severity::NOMINAL);
    let pairs = cell.capture(1, plan.len(), 4);

    let (map, report) = Map::fit(&pairs, &Settings::default())?;
    println!("\n{report}\n");

    // where is what the camera sees at (20, -60, 1500) mm?
    let found = map.apply(Point::<Camera>::new(20.0, -60.0, 1500.0));
    println!(
        "base {:?} mm, sigma {:.3} mm across the view and {:.3} mm along it",
        found.base.to_array(),
        found.sigma_lateral_mm,
        found.sigma_depth_mm
    );
    // nothing outside is ever a target
    let beyond = map.apply(Point::<Camera>::new(20.0, -60.0, 4000.0));
    println!("inside: {}; 4 m away: {:?}", found.hull == Hull::Inside, beyond.hull);

    let path = std::env::temp_dir().join(format!("unscrew-example-map-{}.json", std::process::id()));
    map.save(&path)?;
    let map = Map::load(&path)?;
    std::fs::remove_file(&path)?;

    // a month later: does it still hold?
    println!("\n{}\n", verify(&map, &cell.fresh(2, 20, 4), 0.35));

    // somebody pushes the camera; ten fresh points make the map true again
    cell.bump = Isometry3::new(Vector3::new(0.6, -0.5, 0.6), Vector3::new(1e-3, -1e-3, 1e-3));
    let (map, told) = map.realign(&cell.fresh(3, 10, 4), Moved::Pose, "2026-01-01T00:00:00Z")?;
    println!("{told}\n\n{}", verify(&map, &cell.fresh(4, 20, 4), 0.35));
    Ok(())
}
