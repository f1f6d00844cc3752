//! `unscrew evaluate`: what the detector is worth, with bounds: on rendered faces, on pictures with exact truth, on photographs,
//! on crops.

use crate::{Ended, detect::head_range, model::ModelArgs, output};
use anyhow::{Result, bail};
use serde::Serialize;
use std::{
    fmt::Display,
    io::Write,
    ops::RangeInclusive,
    path::{Path, PathBuf},
    sync::atomic::Ordering,
};
use training::{
    EvaluateError, Evaluator, FIRST_EVALUATION_SEED, Product, evaluate_crops, evaluate_photographs, truth_files,
};
use vision::Options;

/// Measures the detector: recall, precision and centre error with 95 % bounds, by wear and by what may be taken for a screw.
///
/// On rendered faces that training never saw; with --truth on a folder of pictures with exact truth; with --photos on photographs
/// with boxes; with --crops on real crops that training left out, which stage 2 alone tells apart.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  unscrew evaluate --faces 300 --out figures.json\n  unscrew evaluate --gauge --faces 20\n  unscrew evaluate --truth rendered_faces\n  unscrew evaluate --photos appliance_scenes --scene calc_side --head-px 15..80\n  unscrew evaluate --crops crates/training/data"
)]
pub struct Args {
    /// Rendered faces to measure on, each of its own unit
    #[arg(long, default_value_t = 50, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    faces: u64,
    /// Seed of the first face; smaller ones than the default belong to training
    #[arg(long, default_value_t = FIRST_EVALUATION_SEED, value_name = "S")]
    seed: u64,
    /// Rendered gauges with nothing but screws, as in the paper, instead of worn units
    #[arg(long, conflicts_with_all = ["truth", "photos"])]
    gauge: bool,
    /// Rendered faces from which every screw has been taken out: every find is a false one
    #[arg(long, conflicts_with_all = ["truth", "photos", "gauge"])]
    bare: bool,
    /// Folder with rgb/*.jpg, depth/*.png and truth/*.json, instead of rendered faces
    #[arg(long, value_name = "DIR", conflicts_with_all = ["faces", "seed", "photos"])]
    truth: Option<PathBuf>,
    /// Folder of photographs with boxes (COCO, YOLO or Pascal VOC), perhaps with manifest.csv (file, scene), instead of rendered faces
    #[arg(long, value_name = "DIR", conflicts_with_all = ["faces", "seed"])]
    photos: Option<PathBuf>,
    /// Folder of the training data with ewaste.csv and ewaste_*.jpg, for its held-out crops, instead of rendered faces
    #[arg(long, value_name = "DIR", conflicts_with_all = ["faces", "seed", "gauge", "truth", "photos", "scene", "head_px"])]
    crops: Option<PathBuf>,
    /// Only the photographs of these scenes
    #[arg(long, value_name = "NAME", num_args = 1.., requires = "photos")]
    scene: Vec<String>,
    #[command(flatten)]
    model: ModelArgs,
    /// Head diameters to look for, px; left out, 20..40, and 15..80 in photographs
    #[arg(long, value_name = "MIN..MAX", value_parser = head_range)]
    head_px: Option<RangeInclusive<f64>>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Write the figures into this JSON file too, with every miss and false find (up to 200)
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Draw reliability of the scores, and recall and precision over the threshold, to this SVG file
    #[arg(long, value_name = "FILE", conflicts_with_all = ["photos", "crops"])]
    plot: Option<PathBuf>,
}

pub fn run(args: &Args) -> Result<Ended> {
    let detector = args.model.detector()?;
    for path in [&args.out, &args.plot].into_iter().flatten() {
        let folder = path
            .parent()
            .filter(|p| !p.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        output::prepare_folder(folder)?;
    }
    if let Some(data) = &args.crops {
        say(args, &evaluate_crops(&detector, data)?)?;
        return Ok(Ended::Good);
    }
    let usual = Options::default();
    let usual_px = if args.photos.is_some() {
        15.0..=80.0
    } else {
        usual.head_px.clone()
    };
    let options = Options {
        head_px: args.head_px.clone().unwrap_or(usual_px),
        ..usual
    };
    if let Some(folder) = &args.photos {
        let bar = output::progress(0, "photographs");
        let evaluation = evaluate_photographs(
            &detector,
            &options,
            folder,
            (!args.scene.is_empty()).then_some(args.scene.as_slice()),
            &|done, all| {
                bar.set_length(all);
                bar.set_position(done);
            },
        );
        bar.finish_and_clear();
        say(args, &evaluation?)?;
        return Ok(Ended::Good);
    }
    let evaluator = Evaluator::new(&detector, &options);
    match &args.truth {
        Some(folder) => {
            let files = truth_files(folder)?;
            let all = files.len() as u64;
            measure(args, evaluator, files.into_iter(), all, |e, path| {
                e.truth_file(folder, &path)
            })
        }
        None => {
            let product = match (args.gauge, args.bare) {
                (true, _) => Product::Gauge,
                (_, true) => Product::Bare,
                _ => Product::Units,
            };
            let seeds = args.seed..args.seed.saturating_add(args.faces);
            measure(args, evaluator, seeds, args.faces, |e, seed| e.face(product, seed))
        }
    }
}

/// Picture by picture, so that Ctrl-C still gives the figures of those done.
fn measure<T>(
    args: &Args,
    mut evaluator: Evaluator,
    pictures: impl Iterator<Item = T>,
    all: u64,
    mut one: impl FnMut(&mut Evaluator, T) -> Result<(), EvaluateError>,
) -> Result<Ended> {
    let stop = output::stop_on_ctrl_c();
    let bar = output::progress(all, "measuring");
    for picture in pictures {
        if stop.load(Ordering::SeqCst) {
            break;
        }
        one(&mut evaluator, picture)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    let done = evaluator.pictures();
    let evaluation = evaluator.finish();
    say(args, &evaluation)?;
    if let Some(path) = &args.plot {
        crate::curve::draw(&evaluation, path)?;
    }
    if stop.load(Ordering::SeqCst) && (done as u64) < all {
        bail!("stopped after {done} of {all} pictures; the figures are of those");
    }
    Ok(Ended::Good)
}

fn say(args: &Args, evaluation: &(impl Display + Serialize)) -> Result<()> {
    if let Some(path) = &args.out {
        output::write_json(path, evaluation)?;
    }
    let text = if args.json {
        serde_json::to_string_pretty(evaluation)? + "\n"
    } else {
        evaluation.to_string()
    };
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()), // a reader that has seen enough, such as `head`, is no failure
    }
}
