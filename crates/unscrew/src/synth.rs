//! `unscrew synth`: rendered faces with depth, camera and exact truth, for whoever wants the pictures.

use crate::annotations::{self, Fastener, Format};
use crate::{Ended, output};
use anyhow::Result;
use geometry::{write_camera_info, write_depth_png, write_jpeg};
use scene::{FaceId, FaceTruth, FaceView, Prepared, Unit};
use std::{path::PathBuf, sync::atomic::Ordering};
use vision::Drive;

/// Renders faces of outdoor units: `color_NNNN.jpg`, `depth_NNNN.png` (16 bit, 0.1 mm a unit, half resolution),
/// `camera_NNNN.yaml`, `truth_NNNN.json`.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  unscrew synth --faces 5 --seed 7 --out faces\n  unscrew synth --faces 500 --format yolo --out set"
)]
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
    /// Boxes of all fasteners beside, for other detectors; the pictures then lie in `images`
    #[arg(long, value_enum)]
    format: Option<Format>,
}

pub fn run(args: &Args) -> Result<Ended> {
    output::prepare_folder(&args.out)?;
    let images = match args.format {
        Some(_) => args.out.join("images"),
        None => args.out.clone(),
    };
    output::prepare_folder(&images)?;
    let stop = output::stop_on_ctrl_c();
    let bar = output::progress(args.faces, "rendering");
    let mut annotated = Vec::new();
    for k in 0..args.faces {
        let seed = args.seed + k;
        let unit = Unit::sample(seed);
        let face = FaceId::ALL[(seed % FaceId::ALL.len() as u64) as usize];
        let Some(view) = FaceView::sample(&unit, face, seed) else {
            continue;
        };
        let prepared = Prepared::new(&view);
        let (picture, truth) = (prepared.render(None), prepared.truth());
        let index = k as usize;
        let file = format!("color_{index:04}.jpg");
        write_jpeg(&images.join(&file), &picture.color, 95)?;
        write_depth_png(&args.out.join(format!("depth_{index:04}.png")), &picture.depth, 0.1)?;
        write_camera_info(&args.out.join(format!("camera_{index:04}.yaml")), "synth", &view.camera)?;
        truth.save(&args.out, index)?;
        if args.format.is_some() {
            annotated.push(annotations::Picture {
                file,
                size_px: picture.color.dimensions(),
                fasteners: fasteners(&truth),
            });
        }
        bar.inc(1);
        if stop.load(Ordering::SeqCst) {
            break;
        }
    }
    bar.finish_and_clear();
    if let Some(format) = args.format {
        annotations::write(&args.out, format, &annotated)?;
    }
    Ok(Ended::Good)
}

/// Every fastener of a face, whatever turns it.
fn fasteners(truth: &FaceTruth) -> Vec<Fastener> {
    let screws = truth.screws.iter().map(|s| Fastener {
        drive: Drive::Cross,
        center_px: [s.pixel.u_px, s.pixel.v_px],
        side_px: s.head_d_px,
        score: None,
        hidden: !s.detectable,
    });
    let others = truth.decoys.iter().filter_map(|d| {
        Some(Fastener {
            drive: training::drive_seen(d.drive?),
            center_px: [d.pixel.u_px, d.pixel.v_px],
            side_px: d.d_px,
            score: None,
            hidden: d.visible_fraction < 0.5,
        })
    });
    screws.chain(others).collect()
}
