//! `unscrew train`: data to model file, with progress and a report.

use crate::{Ended, output};
use anyhow::{Context, Result};
use indicatif::ProgressBar;
use std::{
    path::PathBuf,
    sync::Mutex,
    time::{Duration, Instant},
};
use training::{Progress, TrainSettings, train};

/// Trains the detector's three networks from rendered faces and the real photographs in the repository; the same file for the same
/// settings. About two hours on 2 cores.
#[derive(clap::Args)]
#[command(after_help = "Example: unscrew train --out model.unscrew\nThen:    unscrew evaluate --model model.unscrew")]
pub struct Args {
    /// Model file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Folder of the real photographs
    #[arg(long, default_value = "crates/training/data", value_name = "DIR")]
    data: PathBuf,
    /// Folder for what has been rendered and learned so far: a training that was stopped goes on from there
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Folder of more pictures with exact truth (rgb/, truth/), for instance from crates/training/path_traced.py
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// Model to train further; left out, training starts anew
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,
    /// Seed of the first unit to learn from
    #[arg(long, default_value_t = 0)]
    first_unit: u64,
    /// Units whose faces are rendered to learn from
    #[arg(long, default_value_t = TrainSettings::default().units)]
    units: u64,
    /// Steps of the coarse network
    #[arg(long, default_value_t = TrainSettings::default().coarse_steps)]
    coarse_steps: usize,
    /// Steps of the fine network
    #[arg(long, default_value_t = TrainSettings::default().fine_steps)]
    fine_steps: usize,
    /// Steps of the network that looks closer; left out, 6000, or none where --fine-steps is 0
    #[arg(long)]
    close_steps: Option<usize>,
    /// First learning rate
    #[arg(long, default_value_t = TrainSettings::default().learning_rate)]
    learning_rate: f32,
    /// Faces that the half-trained networks look at, to learn from where they are wrong; --work gets a list of it (mined.jsonl)
    #[arg(long, default_value_t = TrainSettings::default().mining_faces)]
    mining_faces: u64,
    /// Faces that set thresholds and sigma factors
    #[arg(long, default_value_t = TrainSettings::default().tuning_faces)]
    tuning_faces: u64,
    /// Seed of everything
    #[arg(long, default_value_t = TrainSettings::default().seed)]
    seed: u64,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// A bar a phase, or a line every half minute where stderr is no terminal.
struct Bars {
    now: Mutex<(String, ProgressBar, Instant)>,
}

impl Progress for Bars {
    fn report(&self, phase: &str, done: u64, total: u64, loss: Option<f32>) {
        let Ok(mut now) = self.now.lock() else { return };
        if now.0 != phase {
            now.1.finish_and_clear();
            *now = (phase.into(), output::progress(total, phase), Instant::now());
        }
        let text = loss.map_or(String::new(), |l| format!("loss {l:.4}"));
        now.1.set_position(done);
        now.1.set_message(text.clone());
        if now.1.is_hidden() && (now.2.elapsed() > Duration::from_secs(30) || done == total) {
            eprintln!("unscrew: {phase} {done}/{total} {text}");
            now.2 = Instant::now();
        }
    }
}

pub fn run(args: &Args) -> Result<Ended> {
    let folder = args.out.parent().filter(|p| !p.as_os_str().is_empty());
    if let Some(folder) = folder {
        output::prepare_folder(folder)?;
    }
    if let Some(folder) = &args.work {
        output::prepare_folder(folder)?;
    }
    let settings = TrainSettings {
        from: args.from.clone(),
        pictures: args.pictures.clone(),
        work: args.work.clone(),
        first_unit: args.first_unit,
        units: args.units,
        coarse_steps: args.coarse_steps,
        fine_steps: args.fine_steps,
        close_steps: args.close_steps.unwrap_or(match args.fine_steps {
            0 => 0,
            _ => TrainSettings::default().close_steps,
        }),
        learning_rate: args.learning_rate,
        mining_faces: args.mining_faces,
        tuning_faces: args.tuning_faces,
        seed: args.seed,
        data: args.data.clone(),
        date: output::now_utc(),
        ..TrainSettings::default()
    };
    let begin = Instant::now();
    let bars = Bars {
        now: Mutex::new((String::new(), ProgressBar::hidden(), Instant::now())),
    };
    let report = train(&settings, &args.out, &bars).context("training")?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(Ended::Good);
    }
    for (kind, count) in &report.patches {
        println!("{count:7} patches of {kind}");
    }
    for (network, loss) in &report.loss {
        println!("{network}: loss {loss:.4}");
    }
    let t = &report.tuning;
    println!(
        "on {} faces not learned from: {} detectable screws, {} without a candidate; accept from {:.3}, review from {:.3}",
        t.faces, t.screws, t.without_candidate, t.thresholds.accept, t.thresholds.review
    );
    println!(
        "{} ({} bytes, {}) after {:.0} min",
        args.out.display(),
        report.bytes,
        report.model,
        begin.elapsed().as_secs_f64() / 60.0
    );
    Ok(Ended::Good)
}
