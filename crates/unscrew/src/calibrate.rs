//! `unscrew calibrate`: plan, capture, fit, report, apply, verify, export, realign, correct.

use crate::{Ended, capture_page::Shown, diagnosis, output};
use anyhow::{Result, bail};
use calibration::{
    ArmModel, Between, Check, HandEye, Identity, Map, Method, Moved, PlanError, Settings, Target, Volume,
    camera_identity, diagnose, lattice, read_marks, read_pairs, read_queries, rigid_figures, scattered, verify,
};
use cell::CellConfig;
use cell::motion::{ArmMotion, CellDrawing, DrawnUnit, Gp25};
use geometry::{Base, Point, read_camera_info};
use serde::Serialize;
use sim::layout;
use std::path::{Path, PathBuf};

/// From marker positions to a map from camera to robot.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Points for the marker, in a short tour, as CSV
    #[command(after_help = "Example: unscrew calibrate plan --spacing-mm 50 > plan.csv")]
    Plan(Plan),
    /// Drive an arm with the marker over the lattice and write a pair a visit (simulated cell)
    #[command(
        after_help = "Example: unscrew calibrate capture --arm arm_a --out pairs_a.csv --page capture.html --pictures seen"
    )]
    Capture(Capture),
    /// Fit a map to pairs
    #[command(after_help = "Example: unscrew calibrate fit pairs_a.csv --out map_a.json")]
    Fit(Fit),
    /// Is the map good, where is it not, and what limits it: a page with pictures, from the pairs
    #[command(after_help = "Example: unscrew calibrate report pairs_a.csv --out report.html")]
    Report(Report),
    /// Map observations to the robot's base
    #[command(after_help = "Example: unscrew calibrate apply --map map_a.json queries.csv")]
    Apply(Apply),
    /// Check a map against fresh pairs
    #[command(after_help = "Example: unscrew calibrate verify --map map_a.json fresh_pairs.csv --limit-mm 0.35")]
    Verify(Verify),
    /// Print a map's rigid part as other tools want it: easy_handeye's YAML or a ROS 2 command
    #[command(after_help = "Example: unscrew calibrate export --map map_a.json > handeye.yaml")]
    Export(Export),
    /// Make a map true again after a bump or a crash, from 5 to 20 fresh pairs
    #[command(after_help = "Example: unscrew calibrate realign --map map_a.json fresh_pairs.csv --out map_a.json")]
    Realign(Realign),
    /// Lay a correction over a map: what a needle on millimetre paper showed to be left
    #[command(
        after_help = "Example: unscrew calibrate correct --map map_a.json marks.csv --out map_a.json\n\nmarks.csv: id,target_x_mm,target_y_mm,target_z_mm,mark_x_mm,mark_y_mm,mark_z_mm (base frame; the map's answer, and where the needle stood)"
    )]
    Correct(Correct),
}

/// Where the marker goes.
#[derive(Clone, Copy, clap::Args)]
pub struct Visits {
    /// Points spread evenly and towards the borders; 100 take 10 minutes
    #[arg(long, default_value_t = 150)]
    points: usize,
    /// The paper's lattice instead, with so many mm between neighbours (the paper has 50)
    #[arg(long, value_name = "MM", conflicts_with = "points")]
    spacing_mm: Option<f64>,
}

impl Visits {
    /// The tour through a volume.
    pub fn over(&self, volume: &Volume) -> Result<Vec<Target>, PlanError> {
        match self.spacing_mm {
            Some(spacing_mm) => lattice(volume, spacing_mm),
            None => scattered(volume, self.points),
        }
    }

    /// Frames of depth at each: the lattice averages over neighbours, scattered points have none.
    pub fn depth_frames(&self) -> usize {
        if self.spacing_mm.is_some() { 1 } else { 4 }
    }
}

/// Whose map it has to be.
#[derive(clap::Args)]
pub struct Whose {
    /// Refuse a map that was fitted for another arm
    #[arg(long)]
    arm: Option<String>,
    /// Refuse a map that was fitted for another camera (ROS camera_info YAML)
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
}

impl Whose {
    /// Reads a map if it is the right one.
    fn load(&self, path: &Path) -> Result<Map> {
        let map = Map::load(path)?;
        let camera = self.camera.as_deref().map(identity_of).transpose()?;
        map.belongs_to(self.arm.as_deref(), camera.as_deref(), path)?;
        Ok(map)
    }
}

fn identity_of(camera_info: &Path) -> Result<String> {
    Ok(camera_identity(&read_camera_info(camera_info)?))
}

#[derive(clap::Args)]
pub struct Plan {
    #[command(flatten)]
    visits: Visits,
    /// Opposite corners of the volume in the robot's base, mm: x,y,z,x,y,z
    #[arg(long, value_name = "CORNERS", allow_hyphen_values = true, default_value = "950,-450,150,1350,450,900", value_parser = volume)]
    volume_mm: Volume,
    /// Cell file whose drawing (`[motion]`) the arm has to stay clear of, on an empty table; without it only reach, joint limits and the
    /// wrist singularity of a GP25 are looked at
    #[arg(long, value_name = "FILE")]
    cell: Option<PathBuf>,
    /// The arm in that drawing
    #[arg(long, default_value = "arm_a", requires = "cell")]
    arm: String,
    /// As JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
pub struct Capture {
    /// Arm that carries the marker: arm_a or arm_b
    #[arg(long, default_value = "arm_a")]
    arm: String,
    #[command(flatten)]
    visits: Visits,
    /// Seed of the simulated cell: its robots' and lens's true errors
    #[arg(long, default_value_t = 1)]
    cell_seed: u64,
    /// File of pairs; visits that it holds already are not repeated
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    shown: Shown,
}

#[derive(clap::Args)]
pub struct Fit {
    /// Pairs (CSV)
    pairs: PathBuf,
    /// Map file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// gp (Gaussian process and ripple of the gears), lattice (the paper's, with rejection of outliers), tps (thin-plate spline), affine or rigid
    #[arg(long, default_value = "gp", value_parser = method)]
    method: Method,
    /// With --method lattice exactly as published: no rejection, no fallback
    #[arg(long)]
    as_published: bool,
    /// Arm that the map belongs to. gp25: joint angles at a query come from the kinematics of a GP25, and pairs of another arm are refused;
    /// with any other name they do where the pairs' own angles are those of a GP25, and come from a regression on these where not
    #[arg(long, default_value = "")]
    arm: String,
    /// Camera that the pairs come from (ROS camera_info YAML): the map is then refused for another
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
pub struct Report {
    /// Pairs (CSV)
    pairs: PathBuf,
    /// Page to write (HTML)
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Method of the map: gp, lattice, tps, affine or rigid
    #[arg(long, default_value = "gp", value_parser = method)]
    method: Method,
    /// Folder of what the camera saw at each visit (`calibrate capture --pictures`), to show the pairs that were not believed
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// The figures as JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
pub struct Apply {
    /// Map file
    #[arg(long, value_name = "FILE")]
    map: PathBuf,
    /// Observations: CSV with the columns of pairs, without cmd_* and q*
    queries: PathBuf,
    #[command(flatten)]
    whose: Whose,
    /// One JSON object a row
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
pub struct Verify {
    /// Map file
    #[arg(long, value_name = "FILE", required_unless_present = "pose")]
    map: Option<PathBuf>,
    /// Another tool's hand-eye calibration instead (easy_handeye's YAML, eye_on_base), to compare with
    #[arg(long, value_name = "FILE", conflicts_with = "map")]
    pose: Option<PathBuf>,
    /// Write the outcome into the map file: a cell refuses a map that failed, or that was not checked for long
    #[arg(long, requires = "map")]
    record: bool,
    /// Pairs that the map was not fitted to (CSV)
    pairs: PathBuf,
    /// Passes if 95 % of the 3D errors are at most this, mm
    #[arg(long, default_value_t = 0.35)]
    limit_mm: f64,
    #[command(flatten)]
    whose: Whose,
    /// As JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
pub struct Export {
    /// Map file
    #[arg(long, value_name = "FILE")]
    map: PathBuf,
    /// What it is for
    #[arg(long, value_enum, default_value_t = ExportAs::EasyHandeye)]
    format: ExportAs,
    /// Name of the robot's frame
    #[arg(long, default_value = "base")]
    base_frame: String,
    /// Name of the camera's frame
    #[arg(long, default_value = "camera_optical_frame")]
    camera_frame: String,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum ExportAs {
    /// YAML as easy_handeye keeps it (eye_on_base)
    EasyHandeye,
    /// Command that publishes the transform in ROS 2
    Ros,
}

#[derive(clap::Args)]
pub struct Realign {
    /// Map file
    #[arg(long, value_name = "FILE")]
    map: PathBuf,
    /// Fresh pairs (CSV)
    pairs: PathBuf,
    /// Map file to write; may be the same
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// What may have moved: shift (5 points), pose (10) or pose-and-zeros (20, with joint angles). Left out: as many as the points tell
    #[arg(long, value_parser = moved)]
    moved: Option<Moved>,
    /// Good enough if 95 % of the errors that are left are at most this, mm
    #[arg(long, default_value_t = 0.35)]
    limit_mm: f64,
    #[command(flatten)]
    whose: Whose,
    /// As JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
pub struct Correct {
    /// Map file
    #[arg(long, value_name = "FILE")]
    map: PathBuf,
    /// Targets and marks (CSV)
    marks: PathBuf,
    /// Map file to write; may be the same
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// What holds between the targets: interpolated, or nearest as in the paper
    #[arg(long, default_value = "interpolated", value_parser = between)]
    between: Between,
    /// How far from a target its mark still says something, mm
    #[arg(long, default_value_t = 120.0)]
    reach_mm: f64,
}

fn volume(corners: &str) -> Result<Volume, String> {
    let numbers: Result<Vec<f64>, _> = corners
        .split([',', ' '])
        .filter(|n| !n.is_empty())
        .map(str::parse)
        .collect();
    match numbers.as_deref() {
        Ok([a, b, c, d, e, f]) => Ok(Volume::between(
            Point::<Base>::new(*a, *b, *c),
            Point::<Base>::new(*d, *e, *f),
        )),
        _ => Err("six numbers are needed, x,y,z of two opposite corners".into()),
    }
}

fn moved(name: &str) -> Result<Moved, String> {
    [Moved::Shift, Moved::Pose, Moved::PoseAndZeros]
        .into_iter()
        .find(|m| m.name() == name)
        .ok_or_else(|| format!("'{name}' is not one of shift, pose, pose-and-zeros"))
}

fn between(name: &str) -> Result<Between, String> {
    match name {
        "interpolated" => Ok(Between::Interpolated),
        "nearest" => Ok(Between::Nearest),
        _ => Err(format!("'{name}' is not one of interpolated, nearest")),
    }
}

fn method(name: &str) -> Result<Method, String> {
    [Method::Gp, Method::Lattice, Method::Tps, Method::Affine, Method::Rigid]
        .into_iter()
        .find(|m| m.name() == name)
        .ok_or_else(|| format!("'{name}' is not one of gp, lattice, tps, affine, rigid"))
}

pub fn run(command: &Command) -> Result<Ended> {
    match command {
        Command::Plan(args) => plan(args),
        Command::Capture(args) => capture(args),
        Command::Fit(args) => fit(args),
        Command::Report(args) => report(args),
        Command::Apply(args) => apply(args),
        Command::Verify(args) => check(args),
        Command::Export(args) => export(args),
        Command::Realign(args) => realign(args),
        Command::Correct(args) => correct(args),
    }
}

fn plan(args: &Plan) -> Result<Ended> {
    let targets = args.visits.over(&args.volume_mm)?;
    let targets = reachable(targets, args.cell.as_deref(), &args.arm)?;
    if args.json {
        println!(
            "{}",
            serde_json::to_string(&targets.iter().map(|t| t.command).collect::<Vec<_>>())?
        );
        return Ok(Ended::Good);
    }
    println!("id,i,j,k,cmd_x_mm,cmd_y_mm,cmd_z_mm");
    for t in &targets {
        let [x, y, z] = t.command.to_array();
        let node = t.node.map_or(",,".into(), |[i, j, k]| format!("{i},{j},{k}"));
        println!("{},{node},{x:.4},{y:.4},{z:.4}", t.id);
    }
    // the paper's robot needed 4.5 h for 2,736 points
    eprintln!(
        "{} points, about {:.0} minutes at the paper's 5.9 s a point",
        targets.len(),
        targets.len() as f64 * 5.92 / 60.0
    );
    Ok(Ended::Good)
}

/// How far before a place the arm begins its straight way into it, and how fast it goes there, mm and mm/s.
const STANDOFF_MM: f64 = 40.0;
const APPROACH_MM_S: f64 = 100.0;
/// What is kept between the arm and the cell, mm.
const MARGIN_MM: f64 = 5.0;

/// The places that the arm reaches with the tool along the camera's view, clear of the wrist singularity and, where a cell is given, of what
/// it has drawn; the others are said and left out.
fn reachable(targets: Vec<Target>, cell: Option<&Path>, arm: &str) -> Result<Vec<Target>> {
    let motion = cell.map(|path| in_cell(path, arm)).transpose()?;
    let gp25 = Gp25::new(layout::flange_from_tool());
    let why_not = |command: Point<Base>| -> Option<String> {
        let contact = layout::tool_at(command);
        // the tool looks along x
        let [x, y, z] = command.to_array();
        let before = layout::tool_at(Point::new(x - STANDOFF_MM, y, z));
        match &motion {
            Some(motion) => {
                let way = motion.check(motion.home_rad(), before, contact, APPROACH_MM_S);
                way.err().map(|refusal| refusal.to_string())
            }
            None => {
                let poses = [before, contact];
                poses
                    .into_iter()
                    .find_map(|pose| gp25.inverse(pose).err())
                    .map(|e| e.to_string())
            }
        }
    };
    let planned = targets.len();
    let (mut left, mut reason) = (Vec::with_capacity(planned), None);
    let bar = output::progress(planned as u64, "places checked");
    for target in targets {
        match why_not(target.command) {
            None => left.push(Target {
                id: left.len() as u64,
                ..target
            }),
            Some(why) => reason = Some(why),
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let Some(reason) = reason else { return Ok(left) };
    let out = planned - left.len();
    if 2 * out > planned {
        bail!(
            "{out} of {planned} places cannot be visited ({reason}): move the volume (--volume-mm) nearer to the arm"
        );
    }
    eprintln!("unscrew: {out} of {planned} places are left out, such as one where {reason}");
    Ok(left)
}

/// An arm of a cell as drawn. A calibration is on an empty table, with one arm at a time at its own pace.
fn in_cell(path: &Path, arm: &str) -> Result<ArmMotion> {
    let drawn = CellConfig::read(path)?.motion;
    let names: Vec<String> = drawn.arms.iter().map(|a| a.name.clone()).collect();
    let empty = CellDrawing {
        margin_mm: MARGIN_MM,
        unit: DrawnUnit {
            face_mm: [1.0; 2],
            depth_mm: 1.0,
            ..drawn.unit
        },
        ..drawn
    };
    match ArmMotion::new(&empty, arm) {
        Some(motion) => Ok(motion),
        None => bail!("{} draws no arm '{arm}'; it has {}", path.display(), names.join(", ")),
    }
}

fn capture(args: &Capture) -> Result<Ended> {
    let done = crate::run::capture_pairs(args.cell_seed, &args.arm, &args.visits, &args.out, &args.shown)?;
    println!(
        "{}: {} visits, marker found at {}, {:.0} simulated minutes",
        args.out.display(),
        done.visits,
        done.found,
        done.cell_s / 60.0
    );
    Ok(Ended::Good)
}

fn fit(args: &Fit) -> Result<Ended> {
    if args.as_published && args.method != Method::Lattice {
        bail!("--as-published is for the paper's method: add --method lattice");
    }
    let pairs = read_pairs(&args.pairs)?;
    let settings = Settings {
        method: args.method,
        as_published: args.as_published,
        arm_model: if args.arm.eq_ignore_ascii_case("gp25") {
            ArmModel::Gp25
        } else {
            ArmModel::FromPairs
        },
        identity: Identity {
            arm: args.arm.clone(),
            camera: args.camera.as_deref().map(identity_of).transpose()?.unwrap_or_default(),
        },
        date: output::now_utc(),
    };
    let (map, report) = Map::fit(&pairs, &settings)?;
    map.save(&args.out)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        println!("{report}\nmap written to {}", args.out.display());
    }
    Ok(Ended::Good)
}

fn report(args: &Report) -> Result<Ended> {
    let pairs = read_pairs(&args.pairs)?;
    let settings = Settings {
        method: args.method,
        date: output::now_utc(),
        ..Settings::default()
    };
    if pairs.len() > 400 {
        eprintln!(
            "unscrew: fitting some twenty maps to parts of {} pairs: about a minute",
            pairs.len()
        );
    }
    let (map, found) = diagnose(&pairs, &settings)?;
    let name = args.pairs.file_name().unwrap_or(args.pairs.as_os_str());
    diagnosis::write(
        &map,
        &found,
        &name.to_string_lossy(),
        args.pictures.as_deref(),
        &args.out,
    )?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&found)?);
        return Ok(Ended::Good);
    }
    println!(
        "{} pairs, each predicted by a map fitted without it:\n{}",
        found.held_out.n, found.held_out
    );
    println!(
        "  within the stated sigma: {:.0} % (68 % expected); within the 95 % interval: {:.0} %",
        100.0 * found.coverage[0],
        100.0 * found.coverage[1]
    );
    found.advice.iter().for_each(|word| println!("note: {word}"));
    println!("report     {}", args.out.display());
    Ok(Ended::Good)
}

#[derive(Serialize)]
struct AppliedRow {
    id: u64,
    base_x_mm: Option<f64>,
    base_y_mm: Option<f64>,
    base_z_mm: Option<f64>,
    sigma_lateral_mm: Option<f64>,
    sigma_depth_mm: Option<f64>,
    hull: Option<calibration::Hull>,
}

fn apply(args: &Apply) -> Result<Ended> {
    let map = args.whose.load(&args.map)?;
    let queries = read_queries(&args.queries)?;
    if !args.json {
        println!("id,base_x_mm,base_y_mm,base_z_mm,sigma_lateral_mm,sigma_depth_mm,hull");
    }
    for query in &queries {
        let mapped = query.camera.filter(|_| query.valid).map(|p| map.apply(p));
        if args.json {
            let row = AppliedRow {
                id: query.id,
                base_x_mm: mapped.map(|m| m.base.x_mm()),
                base_y_mm: mapped.map(|m| m.base.y_mm()),
                base_z_mm: mapped.map(|m| m.base.z_mm()),
                sigma_lateral_mm: mapped.map(|m| m.sigma_lateral_mm),
                sigma_depth_mm: mapped.map(|m| m.sigma_depth_mm),
                hull: mapped.map(|m| m.hull),
            };
            println!("{}", serde_json::to_string(&row)?);
            continue;
        }
        match mapped {
            Some(m) => println!(
                "{},{:.4},{:.4},{:.4},{:.4},{:.4},{}",
                query.id,
                m.base.x_mm(),
                m.base.y_mm(),
                m.base.z_mm(),
                m.sigma_lateral_mm,
                m.sigma_depth_mm,
                format!("{:?}", m.hull).to_lowercase()
            ),
            // a row without observation stays a row, so that lines never shift
            None => println!("{},,,,,,", query.id),
        }
    }
    Ok(Ended::Good)
}

fn check(args: &Verify) -> Result<Ended> {
    if args.limit_mm.is_nan() || args.limit_mm <= 0.0 {
        bail!("--limit-mm {} is not a positive number of millimetres", args.limit_mm);
    }
    let pairs = read_pairs(&args.pairs)?;
    let Some(path) = &args.map else {
        let pose = args.pose.as_deref().map(HandEye::read).transpose()?;
        let Some(pose) = pose else {
            bail!("give a map by --map, or a pose by --pose")
        };
        let figures = rigid_figures(&pose.base_from_camera, &pairs);
        if args.json {
            println!("{}", serde_json::to_string_pretty(&figures)?);
        } else {
            println!("{} points under this pose alone:\n{figures}", figures.n);
        }
        let good = figures.n > 0 && figures.total.p95_mm <= args.limit_mm;
        return Ok(if good { Ended::Good } else { Ended::NotGoodEnough });
    };
    let map = args.whose.load(path)?;
    let verification = verify(&map, &pairs, args.limit_mm);
    if args.record {
        let check = Check {
            date: output::now_utc(),
            passed: verification.passed,
            p95_mm: verification.figures.total.p95_mm,
        };
        map.with_check(check).save(path)?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&verification)?);
    } else {
        println!("{verification}");
    }
    Ok(if verification.passed {
        Ended::Good
    } else {
        Ended::NotGoodEnough
    })
}

fn export(args: &Export) -> Result<Ended> {
    let pose = HandEye {
        base_frame: args.base_frame.clone(),
        camera_frame: args.camera_frame.clone(),
        base_from_camera: Map::load(&args.map)?.base_from_camera(),
    };
    match args.format {
        ExportAs::EasyHandeye => print!("{}", pose.to_yaml()),
        ExportAs::Ros => println!("{}", pose.to_ros()),
    }
    Ok(Ended::Good)
}

fn realign(args: &Realign) -> Result<Ended> {
    let map = args.whose.load(&args.map)?;
    let pairs = read_pairs(&args.pairs)?;
    let moved = args.moved.unwrap_or_else(|| Moved::for_pairs(&pairs));
    let (realigned, told) = map.realign(&pairs, moved, &output::now_utc())?;
    realigned.save(&args.out)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&told)?);
    } else {
        println!("{told}\nmap written to {}", args.out.display());
    }
    let left_mm = told.after.total.p95_mm;
    if left_mm > args.limit_mm {
        eprintln!(
            "{left_mm:.3} mm are left, more than {:.3}: visit more points, or calibrate anew",
            args.limit_mm
        );
        return Ok(Ended::NotGoodEnough);
    }
    Ok(Ended::Good)
}

fn correct(args: &Correct) -> Result<Ended> {
    let map = Map::load(&args.map)?;
    let marks = read_marks(&args.marks)?;
    map.correct(&marks, args.between, args.reach_mm)?.save(&args.out)?;
    let n = marks.len() as f64;
    let off_mm = marks.iter().map(|m| m.target.distance_mm(m.mark).powi(2)).sum::<f64>() / n;
    println!(
        "{} marks, off by {:.3} mm (rms): taken out within {:.0} mm of each; map written to {}",
        marks.len(),
        off_mm.sqrt(),
        args.reach_mm,
        args.out.display()
    );
    Ok(Ended::Good)
}
