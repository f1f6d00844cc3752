//! How well the plane of a face is measured, and how its screws lean against it: on rendered faces as the simulated cell's cameras see them.
//!
//! `cargo run --release -p sim --example face_plane -- [UNITS] [FIRST_SEED]` (about 4 s a face, five faces a unit)

use cell::plane::FaceFit;
use geometry::{Direction, RgbdFrame};
use nalgebra::Vector3;
use scene::{FaceId, FaceView, Prepared, Unit, UnitOptions};
use sim::SimSettings;
use vision::{Detector, ModelError, Options, Verdict};

/// Screws that truly lean together by this or more are those of a bent cover.
const BENT_DEG: f64 = 7.0;
const WORKING_DEPTH_MM: [f64; 2] = [1100.0, 1900.0];

fn main() -> Result<(), ModelError> {
    let mut numbers = std::env::args().skip(1).map_while(|text| text.parse::<u64>().ok());
    let (units, first_seed) = (numbers.next().unwrap_or(12), numbers.next().unwrap_or(770_000));
    let settings = SimSettings::default();
    let options = UnitOptions {
        wear: settings.wear,
        decoys: settings.decoys,
        excluded_share: settings.excluded_share,
    };
    let detector = Detector::embedded()?;
    let (mut off_deg, mut straight_deg, mut bent_deg) = (Vec::new(), Vec::new(), Vec::new());
    let (mut straight, mut bent) = (0, 0);
    for seed in first_seed..first_seed + units {
        let unit = Unit::sample_with(seed, &options);
        for face in FaceId::ALL {
            let Some(mut view) = FaceView::sample(&unit, face, seed) else {
                continue;
            };
            view.sensor.depth_window_px = 0; // as the cell's depth camera
            let prepared = Prepared::new(&view);
            let (truth, picture) = (prepared.truth(), prepared.render(None));
            let frame = RgbdFrame {
                color: picture.color,
                depth: Some(picture.depth),
                camera: Some(view.camera),
                t_s: 0.0,
            };
            let found = detector.detect(&frame, &Options::default()).screws;
            let is_certain = |s: &&vision::Screw| !cell::plan::is_doubtful(s.fits, 1.0) || s.verdict == Verdict::Other;
            let certain = found.iter().filter(is_certain);
            let heads: Vec<_> = certain.map(|s| (s.pixel, s.diameter_px)).collect();
            let Some(fit) = FaceFit::around(&frame, &heads, WORKING_DEPTH_MM) else {
                continue;
            };
            let looks = view.camera_from_face.isometry().rotation * -Vector3::z();
            let Some(looks) = Direction::from_vector(looks) else {
                continue;
            };
            off_deg.push(fit.normal().angle_rad(looks).to_degrees());
            let mut leans: Vec<f64> = truth
                .screws
                .iter()
                .map(|s| s.axis.angle_rad(looks).to_degrees())
                .collect();
            leans.sort_by(f64::total_cmp);
            let is_bent = leans.get(leans.len() / 2).is_some_and(|lean| *lean >= BENT_DEG);
            let heads = found
                .iter()
                .filter(|s| s.verdict == Verdict::Screw)
                .filter_map(|s| s.top_normal);
            let together = fit.look_together(heads);
            let lean_deg = together.map(|look| look.angle_rad(fit.normal()).to_degrees());
            let (count, measured) = match is_bent {
                true => (&mut bent, &mut bent_deg),
                false => (&mut straight, &mut straight_deg),
            };
            *count += 1;
            measured.extend(lean_deg);
        }
    }
    let of = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get(((values.len() as f64 - 1.0) * share).round() as usize);
        [0.0, 0.5, 0.95, 1.0]
            .map(|share| at(share).map_or("-".into(), |v| format!("{v:.2}")))
            .join(" / ")
    };
    let n = off_deg.len();
    println!("{units} units from seed {first_seed}, {n} faces; least / median / p95 / most, degrees");
    println!("plane of the face off by: {}", of(off_deg));
    println!(
        "screws lean together, straight faces ({} of {straight} measured): {}",
        straight_deg.len(),
        of(straight_deg)
    );
    println!(
        "screws lean together, bent covers ({} of {bent} measured): {}",
        bent_deg.len(),
        of(bent_deg)
    );
    Ok(())
}
