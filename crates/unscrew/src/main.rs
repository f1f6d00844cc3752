//! The `unscrew` command line: one file a subcommand, each a thin layer over the libraries.
//!
//! Exit codes: 0 done; 1 could not do it (the message says what, where and what to do next); 2 wrong usage; 3 done, but
//! the result is not good enough (screws left, verification failed).

mod annotations;
mod audit;
mod calibrate;
mod capture_page;
mod curve;
mod detect;
mod diagnosis;
mod evaluate;
mod gantt;
mod model;
mod output;
mod plan;
mod replay;
mod report;
mod run;
mod simulate;
mod stats;
mod synth;
mod train;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Finds every screw on a worn appliance, says where it is in the robot's coordinates, and takes it out.
#[derive(Parser)]
#[command(
    name = "unscrew",
    version,
    propagate_version = true,
    after_help = "Start with: unscrew run --units 1"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run the cell: take units apart, write journal, report and summary.
    Run(run::Args),
    /// Find the screws in photographs.
    Detect(detect::Args),
    /// Plan, capture, fit, apply and verify the map from camera to robot.
    #[command(subcommand)]
    Calibrate(calibrate::Command),
    /// Measure the detector: recall, precision and centre error with confidence bounds.
    Evaluate(evaluate::Args),
    /// Train the detector's networks and write a model file.
    Train(train::Args),
    /// Networks to ONNX files and from them.
    #[command(subcommand)]
    Model(model::Command),
    /// Render faces of outdoor units with depth and exact truth.
    Synth(synth::Args),
    /// What a cell would do with thousands of units: completion, time, people, cells for a year's volume.
    Simulate(simulate::Args),
    /// Schedule for a product description over arms and tables, with a lower bound and a chart.
    Plan(plan::Args),
    /// Decide a recorded shift again, with the same or another model, map or cell file, and say what would have changed.
    Replay(replay::Args),
    /// Rates with bounds and times by resource, from a run's journal.
    Stats(stats::Args),
}

/// How a command ended that did what it was asked.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Ended {
    /// Exit code 0.
    Good,
    /// Exit code 3: done, but the result is not good enough.
    NotGoodEnough,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    // a reader that has seen enough, such as `head`, ends a command quietly; but never one that moves robots or has learned for an hour
    if !matches!(cli.command, Command::Run(_) | Command::Train(_)) {
        sigpipe::reset();
    }
    let result = match cli.command {
        Command::Run(args) => run::run(&args),
        Command::Detect(args) => detect::run(&args),
        Command::Calibrate(command) => calibrate::run(&command),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Train(args) => train::run(&args),
        Command::Model(command) => model::run(&command),
        Command::Synth(args) => synth::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Stats(args) => stats::run(&args),
    };
    match result {
        Ok(Ended::Good) => ExitCode::SUCCESS,
        Ok(Ended::NotGoodEnough) => ExitCode::from(3),
        Err(error) => {
            eprintln!("unscrew: {}", output::with_causes(&error));
            ExitCode::from(1)
        }
    }
}
