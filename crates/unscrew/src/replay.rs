//! `unscrew replay`: a recorded shift decided again.

use crate::{Ended, output};
use anyhow::{Context, Result, bail};
use calibration::Map;
use cell::{
    CellConfig, Journal, Program,
    basis::Basis,
    look::Judge,
    motion::ArmMotion,
    replay::{Kind, Look, Stepped, UnitReplay},
};
use serde::Serialize;
use std::path::{Path, PathBuf};
use vision::Detector;

/// Decides a recorded shift again, without hardware: every look whose frame was kept (`unscrew run --record`, or `keep_frames = true` in
/// the cell file), with the model, maps and cell file of the run or with others; says face by face what would have changed.
///
/// With the same model, maps and cell file every decision is the same, byte by byte (on the same kind of processor: others round their
/// sums otherwise). Each decision is asked with the unit as it was in the run. What would have come of another decision cannot be known:
/// what the driver would have answered and what the next picture would have shown did not happen.
///
/// Exit code 0: nothing differs; 3: something does; 1: it could not be replayed.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  unscrew run --units 1 --record --out out && unscrew replay out\n  unscrew replay out --model new.unscrew\n  unscrew replay out --map arm_a=realigned.json --json\n  unscrew replay out --cell stricter.toml    # start from a copy of out/basis/*.toml"
)]
pub struct Args {
    /// Folder of a run (holds journal.db)
    run: PathBuf,
    /// Model file instead of the run's
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Map instead of the run's, for this arm; may be given for each arm
    #[arg(long, value_name = "ARM=FILE", value_parser = arm_and_file)]
    map: Vec<(String, PathBuf)>,
    /// Cell file (odds, limits, rules of exclusion) instead of the run's
    #[arg(long, value_name = "FILE")]
    cell: Option<PathBuf>,
    /// Only this unit; may be given more than once
    #[arg(long, value_name = "NUMBER")]
    unit: Vec<u64>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

fn arm_and_file(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((arm, file)) if !arm.is_empty() && !file.is_empty() => Ok((arm.into(), file.into())),
        _ => Err("an arm and a file, such as arm_a=map.json".into()),
    }
}

/// Everything that one start of the run decided with, as far as nothing else was asked for.
struct Bench {
    detector: Detector,
    maps: Vec<Option<Map>>,
    motions: Vec<Option<ArmMotion>>,
    config: CellConfig,
    program: Program,
    basis: Basis,
}

impl Bench {
    fn of(basis: &Basis, args: &Args) -> Result<Self> {
        let detector = match &args.model {
            Some(path) => Detector::load(path)?,
            None => match basis.model_bytes(&args.run)? {
                Some(bytes) => Detector::from_bytes(&bytes)?,
                None => bail!("the run's model {} was no file; give one with --model", basis.model),
            },
        };
        let mut maps = basis.maps(&args.run)?;
        for (arm, path) in &args.map {
            let names = || {
                basis
                    .arms
                    .iter()
                    .map(|a| a.name.as_str())
                    .collect::<Vec<_>>()
                    .join(", ")
            };
            let at = basis.arms.iter().position(|a| a.name == *arm);
            let at = at.with_context(|| format!("the run has no arm '{arm}'; it has {}", names()))?;
            maps[at] = Some(Map::load(path)?);
        }
        let config = match &args.cell {
            Some(path) => CellConfig::read(path)?,
            None => basis.config(&args.run)?,
        };
        Ok(Self {
            detector,
            maps,
            motions: basis.motions(&config),
            config,
            program: basis.program(&args.run)?,
            basis: basis.clone(),
        })
    }

    fn judge(&self) -> Judge<'_> {
        Judge {
            finder: &self.detector,
            reaches: self.basis.reaches(&self.maps, &self.motions),
            config: &self.config,
        }
    }
}

/// What `--json` prints.
#[derive(Default, Serialize)]
struct Printed {
    run: PathBuf,
    /// Models of the run, and that of the replay.
    models: Vec<String>,
    replayed_with: Vec<String>,
    units: usize,
    looks: usize,
    /// Looks whose decision is the same, byte by byte.
    same: usize,
    /// Looks whose frames were not kept: not replayed.
    without_frame: usize,
    #[serde(flatten)]
    totals: Totals,
    /// The looks that differ.
    differing: Vec<Look>,
}

/// What would have changed, over all looks.
#[derive(Default, Serialize)]
struct Totals {
    screws_gained: usize,
    screws_lost: usize,
    verdicts_changed: usize,
    targets_gained: usize,
    targets_lost: usize,
    places_moved: usize,
    moved_max_mm: f64,
    orders_changed: usize,
    exclusions_changed: usize,
    standing_changed: usize,
    covers_changed: usize,
}

impl Totals {
    fn add(&mut self, look: &Look) {
        let c = &look.changes;
        self.screws_gained += c.screws_gained.len();
        self.screws_lost += c.screws_lost.len();
        self.verdicts_changed += c.verdicts.len();
        self.targets_gained += c.targets_gained.len();
        self.targets_lost += c.targets_lost.len();
        self.places_moved += c.moved.len();
        self.moved_max_mm = c.moved.iter().fold(self.moved_max_mm, |most, m| most.max(m.moved_mm));
        self.orders_changed += usize::from(c.order);
        self.exclusions_changed += usize::from(c.excluded.is_some());
        self.standing_changed += c.standing.len();
        self.covers_changed += usize::from(c.cover.is_some());
    }
}

pub fn run(args: &Args) -> Result<Ended> {
    let journal = Journal::open_read_only(&args.run)?;
    let starts = journal.starts()?;
    if starts.is_empty() {
        bail!(
            "{} does not say what it decided with: it was made before runs could be replayed; run again with `unscrew run --record`",
            args.run.display()
        );
    }
    let all = journal.units()?;
    if let Some(unknown) = args.unit.iter().find(|unit| !all.contains(unit)) {
        bail!(
            "{} has no unit {unknown}; it has {} units",
            args.run.display(),
            all.len()
        );
    }
    let units: Vec<u64> = all
        .into_iter()
        .filter(|u| args.unit.is_empty() || args.unit.contains(u))
        .collect();
    let mut printed = Printed {
        run: args.run.clone(),
        units: units.len(),
        ..Printed::default()
    };
    let bar = output::progress(units.len() as u64, "units");
    let mut bench: Option<Bench> = None;
    for unit in units {
        let mut replay = UnitReplay::new(&args.run, unit);
        for entry in journal.entries(unit)? {
            let basis = starts.iter().rev().find(|(after, _)| *after < entry.0);
            let (_, basis) = basis.with_context(|| format!("nothing says what event {} was decided with", entry.0))?;
            // a model is loaded once, not once a look
            let bench = match &mut bench {
                Some(bench) if bench.basis == *basis => bench,
                other => {
                    let new = Bench::of(basis, args)?;
                    note(&mut printed.models, basis.model.clone());
                    note(&mut printed.replayed_with, new.detector.model().id().to_owned());
                    other.insert(new)
                }
            };
            match replay.step(&bench.judge(), &bench.program, &entry)? {
                Stepped::NoLook => {}
                Stepped::NoFrame => printed.without_frame += 1,
                Stepped::Look(look) => {
                    printed.looks += 1;
                    printed.same += usize::from(look.same);
                    if !look.same {
                        printed.totals.add(&look);
                        if !args.json {
                            bar.suspend(|| println!("{}", line(&look)));
                        }
                        printed.differing.push(*look);
                    }
                }
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    if printed.looks == 0 {
        bail!("{}", no_frames(&args.run, printed.without_frame));
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&printed)?);
    } else {
        print!("{}", text(&printed));
    }
    Ok(if printed.same == printed.looks {
        Ended::Good
    } else {
        Ended::NotGoodEnough
    })
}

fn note(names: &mut Vec<String>, name: String) {
    if !names.contains(&name) {
        names.push(name);
    }
}

fn no_frames(run: &Path, looks: usize) -> String {
    format!(
        "{} has {looks} looks and no frames: what was decided on was not kept. Record the next shift with `unscrew run --record` or \
         `[journal] keep_frames = true` in the cell file",
        run.display()
    )
}

/// A look that differs, in a line.
fn line(look: &Look) -> String {
    let c = &look.changes;
    let what = match look.kind {
        Kind::Face => "look",
        Kind::SecondLook => "second look",
        Kind::Check => "check",
        Kind::Cover => "cover",
    };
    let face = look.face.as_ref().map_or("", |face| face.0.as_str());
    let mut parts = Vec::new();
    let mut count = |n: usize, what: &str| {
        if n > 0 {
            parts.push(format!("{n} {what}"));
        }
    };
    count(c.screws_gained.len(), "screws gained");
    count(c.screws_lost.len(), "screws lost");
    count(c.verdicts.len(), "verdicts changed");
    count(c.other_finds, "other finds came or went");
    count(c.targets_gained.len(), "targets gained");
    count(c.targets_lost.len(), "targets lost");
    count(c.standing.len(), "screws stand or not otherwise");
    if let Some(most_mm) = c.moved.iter().map(|m| m.moved_mm).reduce(f64::max) {
        parts.push(format!("{} places moved by up to {most_mm:.3} mm", c.moved.len()));
    }
    if c.order {
        parts.push("another order".into());
    }
    if let Some(excluded) = &c.excluded {
        let words = |why: &Option<String>| why.clone().unwrap_or_else(|| "in scope".into());
        parts.push(format!(
            "'{}' instead of '{}'",
            words(&excluded.is),
            words(&excluded.was)
        ));
    }
    if let Some(cover) = c.cover {
        parts.push(format!("the cover is {cover:?}"));
    }
    if parts.is_empty() {
        parts.push("only scores or sigmas".into());
    }
    format!("unit {:3} {face:12} {what:11} {}", look.unit, parts.join(", "))
}

fn text(p: &Printed) -> String {
    let t = &p.totals;
    let mut text = format!(
        "looks      {} of {} units; {} decided the same byte by byte, {} otherwise\n",
        p.looks,
        p.units,
        p.same,
        p.looks - p.same
    );
    if p.without_frame > 0 {
        text.push_str(&format!(
            "left out   {} looks whose frames were not kept\n",
            p.without_frame
        ));
    }
    if p.same < p.looks {
        text.push_str(&format!(
            "screws     {} gained, {} lost, {} verdicts changed\ntargets    {} gained, {} lost, {} orders changed\n\
             places     {} moved, by up to {:.3} mm\nunits      {} exclusions changed\nchecks     {} screws, {} covers\n",
            t.screws_gained,
            t.screws_lost,
            t.verdicts_changed,
            t.targets_gained,
            t.targets_lost,
            t.orders_changed,
            t.places_moved,
            t.moved_max_mm,
            t.exclusions_changed,
            t.standing_changed,
            t.covers_changed
        ));
    }
    text
}
