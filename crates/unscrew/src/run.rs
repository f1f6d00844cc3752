//! `unscrew run`: units through the cell, with journal, report and summary. Without a cell file the cell is the simulated one.

use crate::calibrate::Visits;
use crate::{
    Ended,
    capture_page::{CapturePage, Shown},
    model::ModelArgs,
    output,
    report::{self, Missed, Report},
    stats,
};
use anyhow::{Context, Result, bail};
use calibration::{Identity, Map, Settings, Volume, camera_identity, read_pairs};
use cell::{
    CaptureSettings, CellConfig, Journal, Observer, Outcome, Program, Runner, Statistics, UnitRecord,
    basis::{ArmParts, Basis},
    capture_pairs as capture,
    config::Backend,
    device::Devices,
    record::{Assist, FaceRecord, Method, PullEnd, Verdict},
};
use geometry::{Base, Direction};
use indicatif::ProgressBar;
use serde::Serialize;
use sim::{SimSettings, SimulatedCell};
use std::{
    cell::RefCell,
    collections::HashMap,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};
use vision::Detector;

/// Takes units apart: finds their screws, maps them into the robot's base, takes them out, pulls the covers.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  unscrew run --units 3 --seed 1 --out out\n  unscrew run --out out --resume")]
pub struct Args {
    /// Units to take apart
    #[arg(long, default_value_t = 3)]
    units: u64,
    /// Seed of the units that come in
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for journal, pictures, report and summary
    #[arg(long, default_value = "out")]
    out: PathBuf,
    /// Cell file (TOML); left out, the simulated cell
    #[arg(long, value_name = "FILE")]
    cell: Option<PathBuf>,
    /// A person may be asked to click on screws in pictures (as `click = true` in table help in the cell file)
    #[arg(long)]
    click: bool,
    /// Heads may be milled off where product description and plant controller allow it (as `mill = true` in table destructive)
    #[arg(long)]
    mill: bool,
    /// Arms that take screws out at the same time, 1 or 2 (as `arms` in table work); left out, what the cell file says
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=2))]
    arms: Option<u8>,
    /// Go on with the run in --out, in the middle of a unit if need be
    #[arg(long)]
    resume: bool,
    /// Folder of the cell's maps: calibrated on the first run, used again after that
    #[arg(long, default_value = "unscrew-cell", value_name = "DIR")]
    maps: PathBuf,
    #[command(flatten)]
    visits: Visits,
    #[command(flatten)]
    model: ModelArgs,
    /// Keep every frame that is decided on without loss, for `unscrew replay`: about 140 MB a unit, where its pictures are 10
    #[arg(long)]
    record: bool,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// A screw within this share of its head's diameter of a find is that find.
const SAME: f64 = 0.5;

pub fn run(args: &Args) -> Result<Ended> {
    let begin = Instant::now();
    output::prepare_folder(&args.out)?;
    if args.out.join("journal.db").exists() && !args.resume {
        bail!(
            "{} already holds a run; go on with it by --resume, or choose another folder with --out",
            args.out.display()
        );
    }
    let mut config = match &args.cell {
        Some(path) => CellConfig::read(path)?,
        None => CellConfig::simulated(),
    };
    config.help.click |= args.click;
    config.destructive.mill |= args.mill;
    if let Some(arms) = args.arms {
        config.work.arms = arms.into();
    }
    let detector = args.model.detector()?;
    let Backend::Simulated = config.backend;
    let settings = SimSettings {
        units_seed: args.seed,
        ..SimSettings::from_table(&config.simulated)?
    };
    let simulated = SimulatedCell::open(settings.clone(), &args.out.join("world.jsonl"))?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the event loop")?;
    let stop = output::stop_on_ctrl_c();
    let (maps, calibration) = runtime.block_on(calibrated(&settings, &simulated.devices, &config, args, &stop))?;
    let provenance = format!(
        "{} units of seed {}, {} arm(s) at the screws, cell seed {}, model {}, unscrew {}; a person's clicks {}, milling {}. Simulated: a claim about {}.",
        args.units,
        args.seed,
        config.work.arms,
        settings.seed,
        detector.model().id(),
        env!("CARGO_PKG_VERSION"),
        if config.help.click { "allowed" } else { "not allowed" },
        if config.destructive.mill {
            "allowed"
        } else {
            "not allowed"
        },
        assumptions(&settings),
    );
    let mut journal = Journal::open(&args.out)?;
    config.journal.keep_frames |= args.record || recorded_so_far(&journal, &args.out)?;
    let program = Program::paper()?;
    let basis = basis(args, &simulated.devices, &detector, &config, &program)?;
    journal.begin_start(&basis)?;
    let mut runner = Runner::new(
        simulated.devices.clone(),
        Arc::new(detector),
        maps,
        program,
        config,
        journal,
    )?;
    // whoever runs this command asks for the start; with --resume too, and again after every stop
    runner.start()?;
    let live = Live::new(&simulated, args.units, args.json);
    let finish = |records: &[UnitRecord]| write_results(args, records, &live, &calibration, &provenance);
    // the unit that stands on the table first: counting those before it can wait
    if args.resume {
        runtime.block_on(runner.resume_unit(&live))?;
    }
    let mut records = runner.journal().records()?;
    while (records.len() as u64) < args.units && !stop.load(Ordering::SeqCst) {
        let first = records.is_empty();
        records.push(runtime.block_on(runner.run_unit(&live))?);
        finish(&records)?; // after every unit: whatever comes, what is done can be read
        if first {
            live.say(&format!(
                "first unit finished {:.0} s after the start",
                begin.elapsed().as_secs_f64()
            ));
        }
    }
    runner.complete();
    live.bar.finish_and_clear();
    if let Some(error) = simulated.log_error() {
        bail!("the simulated world's log could not be written: {error}");
    }
    let statistics = finish(&records)?;
    if args.json {
        println!(
            "{}",
            serde_json::to_string_pretty(&summary(&statistics, &records, &calibration, &provenance))?
        );
    } else {
        print!("{}", stats::text(&statistics));
        println!("report     {}", args.out.join("report.html").display());
    }
    if stop.load(Ordering::SeqCst) {
        bail!(
            "stopped after {} of {} units; go on with --resume",
            records.len(),
            args.units
        );
    }
    Ok(if statistics.ok == statistics.units {
        Ended::Good
    } else {
        Ended::NotGoodEnough
    })
}

/// What a simulated figure rests on, in one line.
fn assumptions(settings: &SimSettings) -> String {
    let shares = format!(
        "wear {}, {:.0} % of the units spoilt",
        settings.wear,
        100.0 * settings.excluded_share
    );
    match serde_json::to_value(settings.assumed) {
        Ok(serde_json::Value::Object(assumed)) => {
            let pairs = assumed.iter().map(|(key, value)| format!("{key} {value}"));
            format!("{shares}, {}", pairs.collect::<Vec<_>>().join(", "))
        }
        _ => shares,
    }
}

/// Whether the run that is gone on with keeps its frames.
fn recorded_so_far(journal: &Journal, run: &Path) -> Result<bool> {
    Ok(match journal.starts()?.last() {
        Some((_, basis)) => basis.config(run)?.journal.keep_frames,
        None => false,
    })
}

/// Copies of what the run decides with, beside its journal.
fn basis(args: &Args, devices: &Devices, detector: &Detector, config: &CellConfig, program: &Program) -> Result<Basis> {
    let arms: Vec<(&str, PathBuf, bool)> = devices
        .arms
        .iter()
        .map(|arm| {
            let name = arm.robot.name();
            (name, map_path(&args.maps, name), arm.driver.is_some())
        })
        .collect();
    let parts: Vec<ArmParts<'_>> = arms
        .iter()
        .map(|(name, map, drives)| ArmParts {
            name,
            map: Some(map),
            drives: *drives,
        })
        .collect();
    let model = (detector.model().id(), Some(&args.model.bytes()?[..]));
    Ok(Basis::keep(&args.out, model, &parts, config, program)?)
}

fn map_path(folder: &Path, arm: &str) -> PathBuf {
    folder.join(format!("map_{arm}.json"))
}

/// A map for every arm: those in the folder if they are this cell's, else captured and fitted now.
async fn calibrated(
    settings: &SimSettings,
    real: &Devices,
    config: &CellConfig,
    args: &Args,
    stop: &AtomicBool,
) -> Result<(Vec<Map>, String)> {
    let folder = &args.maps;
    let camera = camera_identity(&real.color.intrinsics());
    let (mut maps, mut notes) = (Vec::new(), Vec::new());
    for (k, arm) in real.arms.iter().enumerate() {
        let name = arm.robot.name().to_owned();
        let identity = Identity {
            arm: format!("{name} of simulated cell {}", settings.seed),
            camera: camera.clone(),
        };
        let path = map_path(folder, &name);
        if path.exists() {
            let map = Map::load_for(&path, &identity)?;
            let (age_days, most) = (output::age_days(map.known_good_on()), config.approach.map_age_max_days);
            if age_days.is_none_or(|days| days > most) {
                bail!(
                    "{} is of {}, more than {most} days ago: check it with `unscrew calibrate verify --record`, realign it, or delete it \
                     and its pairs to calibrate anew",
                    path.display(),
                    map.known_good_on()
                );
            }
            notes.push(format!(
                "{name}: map of {}, {} pairs",
                map.settings().date,
                map.n_used()
            ));
            maps.push(map);
            continue;
        }
        output::prepare_folder(folder)?;
        let pairs = folder.join(format!("pairs_{name}.csv"));
        eprintln!(
            "unscrew: {name} has no map in {} yet: calibrating it once",
            folder.display()
        );
        // a cell of the same seed with an empty table: what a person prepares before a calibration
        let bench = SimulatedCell::new(settings.clone());
        bench.mount_jig(Some(k));
        let started_s = bench.devices.clock.now_s();
        capture_with(&bench, k, &args.visits, &pairs, &Shown::default(), stop).await?;
        let minutes = (bench.devices.clock.now_s() - started_s) / 60.0;
        let settings = Settings {
            identity,
            date: output::now_utc(),
            ..Settings::default()
        };
        let (map, report) = Map::fit(&read_pairs(&pairs)?, &settings)?;
        map.save(&path)?;
        let note = format!(
            "{name}: {} pairs in {minutes:.0} simulated minutes, {} without marker, {} rejected; held out rms {:.3} mm, p99.9 {:.3} mm",
            report.n_used,
            report.n_invalid,
            report.rejected.len(),
            report.held_out.total.rms_mm,
            report.held_out.total.p999_mm
        );
        eprintln!("unscrew: {note}");
        notes.push(note);
        maps.push(map);
    }
    Ok((maps, format!("Calibration: {}.", notes.join("; "))))
}

async fn capture_with(
    bench: &SimulatedCell,
    arm: usize,
    visits: &Visits,
    path: &Path,
    shown: &Shown,
    stop: &AtomicBool,
) -> Result<()> {
    let [low, high] = sim::layout::volume(arm);
    let volume = Volume::between(low, high);
    let plan = visits.over(&volume)?;
    let Some(approach) = Direction::<Base>::new(1.0, 0.0, 0.0) else {
        bail!("the approach has no direction");
    };
    let before = if path.exists() {
        read_pairs(path).unwrap_or_default()
    } else {
        Vec::new()
    };
    let mut page = CapturePage::new(shown, &plan, volume, before)?;
    let mut unshown = None;
    let bar = output::progress(plan.len() as u64, "calibrating");
    let summary = capture(
        &bench.devices,
        arm,
        &plan,
        &CaptureSettings {
            depth_frames: visits.depth_frames(),
            ..CaptureSettings::along(approach)
        },
        path,
        |visit| {
            bar.set_position(visit.done as u64);
            unshown = page.add(visit.pair, visit.miss, visit.picture).err();
            unshown.is_none() && !stop.load(Ordering::SeqCst)
        },
    )
    .await?;
    bar.finish_and_clear();
    if let Some(error) = unshown {
        return Err(error);
    }
    page.write(true)?;
    if !summary.complete {
        bail!(
            "calibration stopped after {} visits; run again to go on from there",
            summary.visits
        );
    }
    Ok(())
}

/// What `calibrate capture` reports.
pub struct Captured {
    pub visits: usize,
    pub found: usize,
    pub cell_s: f64,
}

/// Captures pairs of one arm of the simulated cell: `unscrew calibrate capture`.
pub fn capture_pairs(cell_seed: u64, arm: &str, visits: &Visits, path: &Path, shown: &Shown) -> Result<Captured> {
    let bench = SimulatedCell::new(SimSettings {
        seed: cell_seed,
        ..SimSettings::default()
    });
    let names: Vec<String> = bench.devices.arms.iter().map(|a| a.robot.name().to_owned()).collect();
    let Some(k) = names.iter().position(|n| n == arm) else {
        bail!("the cell has no arm '{arm}'; it has {}", names.join(", "));
    };
    bench.mount_jig(Some(k));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the event loop")?;
    let stop = output::stop_on_ctrl_c();
    runtime.block_on(capture_with(&bench, k, visits, path, shown, &stop))?;
    let pairs = read_pairs(path)?;
    Ok(Captured {
        visits: pairs.len(),
        found: pairs.iter().filter(|p| p.valid).count(),
        cell_s: bench.devices.clock.now_s(),
    })
}

/// The live line, and what the simulator alone knows: which screws each look missed.
struct Live<'a> {
    simulated: &'a SimulatedCell,
    bar: ProgressBar,
    quiet: bool,
    looks: RefCell<HashMap<u64, usize>>,
    missed: RefCell<HashMap<(u64, usize), Vec<Missed>>>,
    step: RefCell<String>,
}

impl<'a> Live<'a> {
    fn new(simulated: &'a SimulatedCell, units: u64, quiet: bool) -> Self {
        let bar = output::progress(units, "units");
        Self {
            simulated,
            bar,
            quiet,
            looks: RefCell::default(),
            missed: RefCell::default(),
            step: RefCell::default(),
        }
    }

    fn say(&self, text: &str) {
        if !self.quiet {
            self.bar.suspend(|| eprintln!("unscrew: {text}"));
        }
    }
}

impl Observer for Live<'_> {
    fn step(&self, unit: u64, step: usize, of: usize, name: &str) {
        *self.step.borrow_mut() = format!("unit {unit}: {}/{of} {name}", step + 1);
        self.bar.set_message(self.step.borrow().clone());
    }

    fn seen(&self, unit: u64, face: &FaceRecord) {
        let mut looks = self.looks.borrow_mut();
        let look = looks.entry(unit).or_default();
        if let Some(truth) = self.simulated.face_truth() {
            let missed = truth.screws.iter().filter(|s| {
                !face.found.iter().any(|f| {
                    f.verdict == Verdict::Screw
                        && (f.u_px - s.pixel.u_px).hypot(f.v_px - s.pixel.v_px) < SAME * s.head_d_px
                })
            });
            let missed: Vec<Missed> = missed
                .map(|s| Missed {
                    u_px: s.pixel.u_px,
                    v_px: s.pixel.v_px,
                    diameter_px: s.head_d_px,
                    detectable: s.detectable,
                })
                .collect();
            if !missed.is_empty() {
                self.missed.borrow_mut().insert((unit, *look), missed);
            }
        }
        *look += 1;
    }

    fn screw(&self, screw: usize, of: usize) {
        self.bar
            .set_message(format!("{}, screw {}/{of}", self.step.borrow(), screw + 1));
    }

    fn finished(&self, record: &UnitRecord) {
        self.bar.inc(1);
        let outcome = record.outcome.as_ref().map_or("unfinished".into(), Outcome::to_string);
        self.say(&format!(
            "unit {} ({}): {outcome}; {} screws, {} covers, {:.0} s",
            record.unit,
            record.model.as_deref().unwrap_or("model unknown"),
            record.faces.iter().map(FaceRecord::removed).sum::<usize>(),
            record
                .covers
                .iter()
                .filter(|c| c.end == PullEnd::Off)
                .map(|c| 1 + c.takes_along.len())
                .sum::<usize>(),
            record.times.cycle_s()
        ));
    }
}

#[derive(Serialize)]
struct Summary<'a> {
    statistics: &'a Statistics,
    /// What was run, with which policy, and what the simulation assumes.
    provenance: &'a str,
    calibration: &'a str,
    units: Vec<UnitLine<'a>>,
}

#[derive(Serialize)]
struct UnitLine<'a> {
    unit: u64,
    model: Option<&'a str>,
    #[serde(flatten)]
    outcome: Option<&'a Outcome>,
    assist: Assist,
    method: Method,
    screws_removed: usize,
    cycle_s: f64,
    times: &'a cell::record::Times,
}

fn summary<'a>(
    statistics: &'a Statistics,
    records: &'a [UnitRecord],
    calibration: &'a str,
    provenance: &'a str,
) -> Summary<'a> {
    let line = |r: &'a UnitRecord| UnitLine {
        unit: r.unit,
        model: r.model.as_deref(),
        outcome: r.outcome.as_ref(),
        assist: r.assist,
        method: r.method,
        screws_removed: r.faces.iter().map(FaceRecord::removed).sum(),
        cycle_s: r.times.cycle_s(),
        times: &r.times,
    };
    Summary {
        statistics,
        provenance,
        calibration,
        units: records.iter().map(line).collect(),
    }
}

fn write_results(
    args: &Args,
    records: &[UnitRecord],
    live: &Live,
    calibration: &str,
    provenance: &str,
) -> Result<Statistics> {
    let statistics = Statistics::over(records);
    let page = Report {
        records,
        statistics: &statistics,
        calibration,
        provenance,
        missed: &live.missed.borrow(),
    };
    report::write(&args.out, &page)?;
    output::write_json(
        &args.out.join("summary.json"),
        &summary(&statistics, records, calibration, provenance),
    )?;
    Ok(statistics)
}
