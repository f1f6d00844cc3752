//! `unscrew synth`: rendered faces with depth, camera and exact truth, for whoever wants the pictures.

use crate::{Ended, output};
use anyhow::Result;
use geometry::{write_camera_info, write_depth_png, write_jpeg};
use scene::{FaceId, FaceView, Unit, render, truth};
use std::{path::PathBuf, sync::atomic::Ordering};

/// Renders faces of outdoor units: `color_NNNN.jpg`, `depth_NNNN.png` (16 bit, 0.1 mm a unit, half resolution),
/// `camera_NNNN.yaml`, `truth_NNNN.json`.
#[derive(clap::Args)]
#[command(after_help = "Example: unscrew synth --faces 5 --seed 7 --out faces")]
pub struct Args {
    /// Number of faces
    #[arg(long, default_value_t = 5)]
    faces: u64,
    /// Seed of the first face; every face has its own unit, pose, light and camera
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for the files
    #[arg(long)]
    out: PathBuf,
}

pub fn run(args: &Args) -> Result<Ended> {
    output::prepare_folder(&args.out)?;
    let stop = output::stop_on_ctrl_c();
    let bar = output::progress(args.faces, "rendering");
    for k in 0..args.faces {
        let seed = args.seed + k;
        let unit = Unit::sample(seed);
        let face = FaceId::ALL[(seed % FaceId::ALL.len() as u64) as usize];
        let Some(view) = FaceView::sample(&unit, face, seed) else {
            continue;
        };
        let picture = render(&view, None);
        let index = k as usize;
        write_jpeg(&args.out.join(format!("color_{index:04}.jpg")), &picture.color, 95)?;
        write_depth_png(&args.out.join(format!("depth_{index:04}.png")), &picture.depth, 0.1)?;
        write_camera_info(&args.out.join(format!("camera_{index:04}.yaml")), "synth", &view.camera)?;
        truth(&view).save(&args.out, index)?;
        bar.inc(1);
        if stop.load(Ordering::SeqCst) {
            break;
        }
    }
    bar.finish_and_clear();
    Ok(Ended::Good)
}
