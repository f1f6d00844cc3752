//! Calibrates simulated cells, each with its own arms, lens and camera stand, and measures the maps where nobody has been:
//! the figures of `docs/calibration.md`, by anyone, on seeds of their own.
//!
//! `cargo run --release -p sim --example calibration_figures -- POINTS FIRST_SEED CELLS`

use calibration::{Hull, Map, Method, Moved, Pair, Settings, read_pairs, scattered};
use cell::{CaptureSettings, capture_pairs, device::Motion};
use geometry::{Base, Camera, Direction, Point};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use sim::{SimSettings, SimulatedCell, layout};
use std::{error::Error, path::Path};

/// Places of a cell where the map is asked without noise.
const QUERIES: usize = 400;
/// Places of a cell that are measured as a screw would be, with several frames.
const REACHED: usize = 100;
const FRAMES: usize = 8;
/// How long a move may take, s of the cell's clock.
const TIMEOUT_S: f64 = 30.0;

const METHODS: [(&str, Method, bool); 5] = [
    ("gp", Method::Gp, false),
    ("lattice, robust", Method::Lattice, false),
    ("thin-plate spline", Method::Tps, false),
    ("affine", Method::Affine, false),
    ("rigid hand-eye", Method::Rigid, false),
];

/// A simulated cell with the jig on its first arm, and pairs of so many places with so many frames of depth each.
async fn visited(cell: &SimulatedCell, points: usize, frames: usize, path: &Path) -> Result<Vec<Pair>, Box<dyn Error>> {
    let [low, high] = layout::volume(0);
    let plan = scattered(&calibration::Volume::between(low, high), points)?;
    let approach = Direction::<Base>::new(1.0, 0.0, 0.0).ok_or("no direction")?;
    let settings = CaptureSettings {
        depth_frames: frames,
        ..CaptureSettings::along(approach)
    };
    capture_pairs(&cell.devices, 0, &plan, &settings, path, |_| true).await?;
    Ok(read_pairs(path)?)
}

/// Where the tool really is after it was sent to places anywhere in the volume, with these places.
async fn truth(cell: &SimulatedCell, rng: &mut Pcg64Mcg) -> Result<Vec<(Point<Camera>, Point<Base>)>, Box<dyn Error>> {
    let [low, high] = layout::volume(0).map(|p| p.to_array());
    let robot = &cell.devices.arms[0].robot;
    let mut places = Vec::new();
    for _ in 0..QUERIES {
        let [x, y, z] = [0, 1, 2].map(|a| rng.random_range(low[a]..high[a]));
        let command = Point::<Base>::new(x, y, z);
        let Ok(ticket) = robot.move_to(layout::tool_at(command), Motion::Joint).await else {
            continue; // beyond the joints' limits
        };
        robot.wait(ticket, TIMEOUT_S).await?;
        places.push((cell.tool_truth(0).ok_or("no such arm")?, command));
    }
    Ok(places)
}

struct Errors(Vec<f64>);

impl std::fmt::Display for Errors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len();
        let at = |share: f64| {
            sorted
                .get(((n as f64 * share).ceil() as usize).clamp(1, n.max(1)) - 1)
                .copied()
        };
        let rms = (sorted.iter().map(|e| e * e).sum::<f64>() / n.max(1) as f64).sqrt();
        let over = sorted.iter().filter(|e| **e > 0.35).count();
        write!(
            f,
            "rms {rms:.3}  p95 {:.3}  p99.9 {:.3} mm  {:.1} % over 0.35 mm  (n = {n})",
            at(0.95).unwrap_or(f64::NAN),
            at(0.999).unwrap_or(f64::NAN),
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
    let mut without_noise: Vec<Errors> = METHODS.iter().map(|_| Errors(Vec::new())).collect();
    let (mut reached, mut bumped, mut realigned) = (Errors(Vec::new()), Errors(Vec::new()), Errors(Vec::new()));
    let (mut within, mut asked) = ([0usize; 2], 0usize);
    for seed in first..first + cells {
        let cell = SimulatedCell::new(SimSettings {
            seed,
            ..SimSettings::default()
        });
        cell.mount_jig(Some(0));
        let file = |name: &str| folder.path().join(format!("{name}_{seed}.csv"));
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let pairs = runtime.block_on(visited(&cell, points as usize, 4, &file("pairs")))?;
        let measured = runtime.block_on(visited(&cell, REACHED, FRAMES, &file("reached")))?;
        let queries = runtime.block_on(truth(&cell, rng))?;
        for (k, (_, method, as_published)) in METHODS.into_iter().enumerate() {
            let settings = Settings {
                method,
                as_published,
                ..Settings::default()
            };
            let (map, _) = Map::fit(&pairs, &settings)?;
            let inside = queries
                .iter()
                .map(|(c, b)| (map.apply(*c), b))
                .filter(|(m, _)| m.hull == Hull::Inside);
            without_noise[k].0.extend(inside.map(|(m, b)| m.base.distance_mm(*b)));
            if method == Method::Gp {
                for pair in measured.iter().filter(|p| p.valid) {
                    let Some(camera) = pair.camera else { continue };
                    let mapped = map.apply(camera);
                    if mapped.hull == Hull::Inside {
                        reached.0.push(mapped.base.distance_mm(pair.command));
                    }
                }
                bump(&map, &measured, &queries, rng, &mut bumped, &mut realigned)?;
                covered(&map, &measured, &mut within, &mut asked);
            }
        }
        eprintln!(
            "cell {seed}: {} pairs, {} queries",
            pairs.iter().filter(|p| p.valid).count(),
            queries.len()
        );
    }
    println!("{points} points with 4 frames each, {cells} cells from seed {first}; 3D errors inside the hull");
    for ((name, ..), errors) in METHODS.iter().zip(&without_noise) {
        println!("  {name:<34} {errors}");
    }
    println!(
        "  {:<34} {reached}",
        format!("gp, a point measured with {FRAMES} frames")
    );
    println!("  {:<34} {bumped}", "gp, after 1 mm and 2 mrad");
    println!("  {:<34} {realigned}", "gp, realigned with 10 points");
    println!(
        "  of {asked} points measured with {FRAMES} frames, {:.1} % across and {:.1} % along the ray lie in the 95 % interval stated for pairs of 4",
        100.0 * within[0] as f64 / asked.max(1) as f64,
        100.0 * within[1] as f64 / asked.max(1) as f64
    );
    Ok(())
}

/// Counts measured points that lie in the interval that the map states.
fn covered(map: &Map, measured: &[Pair], within: &mut [usize; 2], asked: &mut usize) {
    for pair in measured.iter().filter(|p| p.valid) {
        let Some(camera) = pair.camera else { continue };
        let mapped = map.apply(camera);
        if mapped.hull != Hull::Inside {
            continue;
        }
        let error = mapped.base.vector() - pair.command.vector();
        let ray = map.base_from_camera().isometry().rotation * camera.vector().normalize();
        let along = error.dot(&ray);
        let across = (error - ray * along).norm();
        *asked += 1;
        // 95 % of lengths of two components lie within 2.448 sigma
        within[0] += usize::from(across < 2.448 * mapped.sigma_lateral_mm);
        within[1] += usize::from(along.abs() < 1.96 * mapped.sigma_depth_mm);
    }
}

/// The camera is pushed by 1 mm and turned by 2 mrad, then the map is realigned with ten points that are seen anew.
fn bump(
    map: &Map,
    pairs: &[Pair],
    queries: &[(Point<Camera>, Point<Base>)],
    rng: &mut Pcg64Mcg,
    bumped: &mut Errors,
    realigned: &mut Errors,
) -> Result<(), Box<dyn Error>> {
    let mut part = || rng.random_range(-1.0..1.0f64);
    let push = Vector3::new(part(), part(), part()).normalize();
    let turn = Vector3::new(part(), part(), part()).normalize() * 2e-3;
    let bump = Isometry3::new(push, turn);
    let moved = |at: Point<Camera>| Point::<Camera>::from_vector((bump * Point3::from(at.vector())).coords);
    let step = (pairs.len() / 10).max(1);
    let fresh: Vec<Pair> = pairs
        .iter()
        .filter(|p| p.valid)
        .step_by(step)
        .take(10)
        .map(|p| Pair {
            camera: p.camera.map(moved),
            ..p.clone()
        })
        .collect();
    let (map_now, _) = map.realign(&fresh, Moved::Pose, "")?;
    for (camera, base) in queries.iter().filter(|(c, _)| map.apply(*c).hull == Hull::Inside) {
        bumped.0.push(map.apply(moved(*camera)).base.distance_mm(*base));
        realigned.0.push(map_now.apply(moved(*camera)).base.distance_mm(*base));
    }
    Ok(())
}
