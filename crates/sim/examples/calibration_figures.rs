//! Calibrates simulated cells through rendered pictures of the marker, as `unscrew calibrate capture` does, and measures the maps at
//! places of their own, each looked at as a screw would be. What the cameras say is all there is here: their noise is in every figure.
//! Takes minutes a cell; `simulated_cells` of the crate `calibration` draws the pairs without pictures, in a second.
//!
//! `cargo run --release -p sim --example calibration_figures -- POINTS FIRST_SEED CELLS`

use calibration::{Hull, Map, Method, Pair, Settings, Target, Volume, read_pairs, scattered};
use cell::{CaptureSettings, capture_pairs};
use geometry::{Base, Direction};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use sim::{SimSettings, SimulatedCell, layout};
use std::{error::Error, path::Path};

/// Places of a cell that are measured as a screw would be, and their frames of depth.
const REACHED: u64 = 100;
const FRAMES: usize = 8;
/// Frames of depth at each point of a calibration.
const PAIR_FRAMES: usize = 4;

const METHODS: [(&str, Method); 5] = [
    ("gp", Method::Gp),
    ("lattice, robust", Method::Lattice),
    ("thin-plate spline", Method::Tps),
    ("affine", Method::Affine),
    ("rigid hand-eye", Method::Rigid),
];

/// Pairs of a plan, with so many frames of depth each.
async fn visited(
    cell: &SimulatedCell,
    plan: &[Target],
    frames: usize,
    path: &Path,
) -> Result<Vec<Pair>, Box<dyn Error>> {
    let approach = Direction::<Base>::new(1.0, 0.0, 0.0).ok_or("no direction")?;
    let settings = CaptureSettings {
        depth_frames: frames,
        ..CaptureSettings::along(approach)
    };
    capture_pairs(&cell.devices, 0, plan, &settings, path, |_| true).await?;
    Ok(read_pairs(path)?)
}

/// Places anywhere in a volume.
fn anywhere(volume: &Volume, rng: &mut Pcg64Mcg) -> Vec<Target> {
    let place = |id| Target {
        id,
        node: None,
        command: volume.at(std::array::from_fn(|_| rng.random_range(0.0..1.0))),
    };
    (0..REACHED).map(place).collect()
}

struct Errors(Vec<f64>);

impl std::fmt::Display for Errors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len();
        let at = |share: f64| {
            let rank = ((n as f64 * share).ceil() as usize).max(1) - 1;
            sorted.get(rank).copied().unwrap_or(f64::NAN)
        };
        let rms = (sorted.iter().map(|e| e * e).sum::<f64>() / n.max(1) as f64).sqrt();
        let over = sorted.iter().filter(|e| **e > 0.35).count();
        write!(
            f,
            "rms {rms:.3}  p95 {:.3}  p99.9 {:.3} mm  {:.1} % over 0.35 mm  (n = {n})",
            at(0.95),
            at(0.999),
            100.0 * over as f64 / n.max(1) as f64
        )
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<u64> = std::env::args().skip(1).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let [points, first, cells] = arguments[..] else {
        return Err("usage: calibration_figures POINTS FIRST_SEED CELLS".into());
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let folder = tempfile::tempdir()?;
    let [low, high] = layout::volume(0);
    let volume = Volume::between(low, high);
    let mut errors: Vec<Errors> = METHODS.iter().map(|_| Errors(Vec::new())).collect();
    for seed in first..first + cells {
        let cell = SimulatedCell::new(SimSettings {
            seed,
            ..SimSettings::default()
        });
        cell.mount_jig(Some(0));
        let file = |name: &str| folder.path().join(format!("{name}_{seed}.csv"));
        let plan = scattered(&volume, points as usize)?;
        let pairs = runtime.block_on(visited(&cell, &plan, PAIR_FRAMES, &file("pairs")))?;
        let plan = anywhere(&volume, &mut Pcg64Mcg::seed_from_u64(seed));
        let measured = runtime.block_on(visited(&cell, &plan, FRAMES, &file("measured")))?;
        for ((_, method), errors) in METHODS.into_iter().zip(&mut errors) {
            let settings = Settings {
                method,
                ..Settings::default()
            };
            let (map, _) = Map::fit(&pairs, &settings)?;
            let seen = measured.iter().filter_map(|p| Some((map.apply(p.camera?), p.command)));
            let inside = seen.filter(|(m, _)| m.hull == Hull::Inside);
            errors.0.extend(inside.map(|(m, command)| m.base.distance_mm(command)));
        }
        let found = |pairs: &[Pair]| pairs.iter().filter(|p| p.valid).count();
        eprintln!("cell {seed}: {} pairs, {} places", found(&pairs), found(&measured));
    }
    println!(
        "{points} points with {PAIR_FRAMES} frames each, {cells} cells from seed {first}; 3D errors of places measured with {FRAMES} frames, inside the hull"
    );
    for ((name, ..), errors) in METHODS.iter().zip(&errors) {
        println!("  {name:<20} {errors}");
    }
    Ok(())
}
