//! `unscrew detect`: the screws in photographs, as a table, as JSON lines or drawn on the picture.

use crate::annotations::{self, Fastener, Format};
use crate::{Ended, model::ModelArgs, output};
use anyhow::{Context, Result, bail};
use calibration::{Map, camera_identity};
use geometry::{RgbdFrame, read_camera_info, read_rgbd};
use std::{
    io::Write,
    ops::RangeInclusive,
    path::{Path, PathBuf},
    time::Instant,
};
use vision::{Detections, Detector, Hull, Mapped, Options, Screw, Verdict};

/// Finds the screws in photographs: where, how sure, which drive, and in millimetres where depth, camera and map are given.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  unscrew detect photo.jpg --head-px 15..80 --overlay out\n  unscrew detect front.jpg --depth front.png --depth-scale 0.1 --camera camera.yaml --map map_a.json --json"
)]
pub struct Args {
    /// Pictures (PNG, JPEG, TIFF)
    #[arg(required = true)]
    images: Vec<PathBuf>,
    /// Depth registered to each picture: 16-bit PNG or float TIFF, in the same order
    #[arg(long, num_args = 1..)]
    depth: Vec<PathBuf>,
    /// Millimetres per unit of the depth files
    #[arg(long, default_value_t = 1.0, value_name = "MM")]
    depth_scale: f64,
    /// Camera intrinsics: ROS camera_info YAML (plumb_bob)
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// Map from camera to robot, from `unscrew calibrate fit`
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
    /// Head diameters to look for, px
    #[arg(long, default_value = "20..40", value_name = "MIN..MAX", value_parser = head_range)]
    head_px: RangeInclusive<f64>,
    #[command(flatten)]
    model: ModelArgs,
    /// Write each picture with the finds drawn on it into this folder
    #[arg(long, value_name = "DIR")]
    overlay: Option<PathBuf>,
    /// One JSON object a picture and line
    #[arg(long)]
    json: bool,
    /// Write the finds of all pictures into this folder as boxes, for other tools
    #[arg(long, value_name = "DIR")]
    boxes: Option<PathBuf>,
    /// Format of these boxes
    #[arg(long, value_enum, default_value = "coco", requires = "boxes")]
    format: Format,
}

/// `15..80`, px.
pub(crate) fn head_range(text: &str) -> Result<RangeInclusive<f64>, String> {
    let parse = |t: &str| {
        t.trim()
            .parse::<f64>()
            .map_err(|_| format!("'{t}' is not a number of pixels"))
    };
    let (low, high) = text.split_once("..").ok_or("expected MIN..MAX, such as 15..80")?;
    let (low, high) = (parse(low)?, parse(high.trim_start_matches('='))?);
    if !(low >= 4.0 && high >= low && high <= 2000.0) {
        return Err(format!("{low}..{high} is no range between 4 and 2000 px"));
    }
    Ok(low..=high)
}

/// What the map adds to a find: sigmas are those of map and measurement together.
fn mapped(screw: &Screw, map: Option<&Map>) -> Option<Mapped> {
    let point = map?.apply(screw.camera?);
    let both = |measured: Option<f64>, map: f64| measured.unwrap_or(0.0).hypot(map);
    Some(Mapped {
        base: point.base,
        sigma_lateral_mm: both(screw.sigma_lateral_mm, point.sigma_lateral_mm),
        sigma_depth_mm: both(screw.sigma_depth_mm, point.sigma_depth_mm),
        hull: match point.hull {
            calibration::Hull::Inside => Hull::Inside,
            calibration::Hull::Edge => Hull::Edge,
            calibration::Hull::Outside => Hull::Outside,
        },
    })
}

pub fn run(args: &Args) -> Result<Ended> {
    if !args.depth.is_empty() && args.depth.len() != args.images.len() {
        bail!(
            "{} pictures but {} depth files; give one depth file for each picture",
            args.images.len(),
            args.depth.len()
        );
    }
    if !(args.depth_scale > 0.0 && args.depth_scale.is_finite()) {
        bail!(
            "--depth-scale {} is not a positive number of millimetres a unit",
            args.depth_scale
        );
    }
    if args.map.is_some() && (args.camera.is_none() || args.depth.is_empty()) {
        bail!("--map needs --depth and --camera: without them there is no point in space to map");
    }
    let detector = args.model.detector()?;
    // a bad camera file is said before any picture is worked on
    let camera = args.camera.as_deref().map(read_camera_info).transpose()?;
    let map = args.map.as_deref().map(Map::load).transpose()?;
    if let (Some(map), Some(path), Some(camera)) = (&map, &args.map, &camera)
        && !map.identity().camera.is_empty()
    {
        map.belongs_to(None, Some(&camera_identity(camera)), path)?;
    }
    for folder in args.overlay.iter().chain(&args.boxes) {
        output::prepare_folder(folder)?;
    }
    let options = Options {
        head_px: args.head_px.clone(),
        ..Options::default()
    };
    let stop = output::stop_on_ctrl_c();
    let (mut failed, mut doubtful) = (0, false);
    let mut annotated = Vec::new();
    let mut out = std::io::stdout().lock();
    for (k, image) in args.images.iter().enumerate() {
        if stop.load(std::sync::atomic::Ordering::SeqCst) {
            bail!("stopped after {k} of {} pictures", args.images.len());
        }
        let depth = args.depth.get(k).map(|p| (p.as_path(), args.depth_scale));
        // one bad picture does not cost the others
        let found = one(args, image, depth, &detector, &options, map.as_ref(), &mut out);
        if let Ok(found) = &found {
            for doubt in &found.doubts {
                eprintln!("unscrew: {}: {doubt}", image.display());
                doubtful = true;
            }
            annotated.push(boxes(image, found));
        }
        if let Err(error) = found {
            if error
                .downcast_ref::<std::io::Error>()
                .is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
            {
                return Ok(Ended::Good);
            }
            eprintln!("unscrew: {}", output::with_causes(&error));
            failed += 1;
        }
    }
    if let Some(folder) = args.boxes.as_ref() {
        annotations::write(folder, args.format, &annotated)?;
    }
    if failed > 0 {
        bail!("{failed} of {} pictures could not be used", args.images.len());
    }
    Ok(if doubtful { Ended::NotGoodEnough } else { Ended::Good })
}

fn one(
    args: &Args,
    image: &Path,
    depth: Option<(&Path, f64)>,
    detector: &Detector,
    options: &Options,
    map: Option<&Map>,
    out: &mut impl Write,
) -> Result<Detections> {
    let begin = Instant::now();
    let frame: RgbdFrame = read_rgbd(image, depth, args.camera.as_deref())?;
    let decode_ms = begin.elapsed().as_secs_f64() * 1e3;
    let mut found: Detections = detector.detect(&frame, options);
    found.timing_ms.decode = decode_ms;
    found.timing_ms.total += decode_ms;
    let name = image.display().to_string();
    if args.json {
        writeln!(
            out,
            "{}",
            serde_json::to_string(&found.report(&name, |screw| mapped(screw, map)))?
        )?;
    } else {
        table(out, &name, &found, map)?;
    }
    if let Some(folder) = &args.overlay {
        let stem = image.file_stem().with_context(|| format!("{name} has no file name"))?;
        let path = folder.join(format!("{}.jpg", stem.to_string_lossy()));
        geometry::write_jpeg(&path, &vision::overlay(&frame.color, &found), 92)?;
    }
    Ok(found)
}

/// The finds of a picture as boxes; what a person should look at is among them, with its score.
fn boxes(image: &Path, found: &Detections) -> annotations::Picture {
    let fastener = |screw: &Screw| Fastener {
        drive: screw.drive,
        center_px: [screw.pixel.u_px, screw.pixel.v_px],
        side_px: screw.diameter_px,
        score: Some(screw.score),
        hidden: false,
    };
    annotations::Picture {
        file: image.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        size_px: found.size_px,
        fasteners: found.screws.iter().map(fastener).collect(),
    }
}

fn table(out: &mut impl Write, name: &str, found: &Detections, map: Option<&Map>) -> Result<()> {
    let count = |v| found.screws.iter().filter(|s| s.verdict == v).count();
    writeln!(
        out,
        "{name}  {} x {} px: {} screws, {} other fasteners, {} to review ({:.0} ms)",
        found.size_px.0,
        found.size_px.1,
        count(Verdict::Screw),
        count(Verdict::Other),
        count(Verdict::Review),
        found.timing_ms.total
    )?;
    if found.screws.is_empty() {
        return Ok(());
    }
    writeln!(
        out,
        "  verdict  drive       score      u px      v px   ± px  head px  base x, y, z mm (or camera)"
    )?;
    for screw in &found.screws {
        let place = match (mapped(screw, map), screw.camera) {
            (Some(m), _) => {
                let [x, y, z] = m.base.to_array();
                format!("{x:9.2} {y:9.2} {z:9.2}  {:?}", m.hull).to_lowercase()
            }
            (None, Some(p)) => format!("{:9.2} {:9.2} {:9.2}  camera", p.x_mm(), p.y_mm(), p.z_mm()),
            (None, None) => "-".into(),
        };
        writeln!(
            out,
            "  {:<7}  {:<10}  {:.3}  {:8.2}  {:8.2}  {:5.2}  {:7.1}  {place}",
            format!("{:?}", screw.verdict).to_lowercase(),
            screw.drive.name(),
            screw.score,
            screw.pixel.u_px,
            screw.pixel.v_px,
            screw.sigma_px,
            screw.diameter_px,
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn head_ranges() {
        assert_eq!(head_range("15..80"), Ok(15.0..=80.0));
        for bad in ["15", "80..15", "a..b", "0..5", "15..NaN"] {
            assert!(head_range(bad).is_err(), "{bad}");
        }
    }
}
