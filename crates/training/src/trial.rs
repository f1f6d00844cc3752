//! One network of stage 2, or several, judged on patches alone: quick enough to compare architectures.

use crate::batch::Stage;
use crate::samples::{PATCH_PX, Patch, only, rendered};
use crate::train::{Lesson, Progress, TUNING_SEEDS, TrainError, TrainSettings};
use crate::{pictures, real};
use geometry::{Pixel, RgbImage};
use nn::{Engine, NnError, Spec, Trainer};
use serde::Serialize;
use std::{collections::BTreeMap, ops::Range, path::Path, time::Instant};
use vision::layout::Class;

/// How one architecture of stage 2 does, alone, on patches of units that it did not learn from.
#[derive(Clone, Debug, Serialize)]
pub struct Trial {
    /// Loss over the last steps of training.
    pub loss: f32,
    /// Time to train, s.
    pub train_s: f64,
    /// Patches of cross screws.
    pub screws: usize,
    /// Patches of other things and of background.
    pub others: usize,
    /// Share of the screws with a score above that of all but 3 in 1000 of the others.
    pub recall: f64,
    /// Mean of -ln of the probability of what is there: cross screw or not.
    pub log_loss: f64,
    /// Share of other fasteners whose drive is the likeliest of all.
    pub drive_right: f64,
    /// Median and 95th percentile of the centre's error on screws, px.
    pub center_px: [f64; 2],
}

/// Trains one network of stage 2 on the rendered patches of `settings` and measures it on those of `units` units of the tuning seeds.
///
/// # Errors
/// As [`train`](crate::train()).
pub fn try_network(
    spec: Spec,
    settings: &TrainSettings,
    units: u64,
    progress: &dyn Progress,
) -> Result<Trial, TrainError> {
    let work = settings.work.as_deref();
    let seeds = settings.first_unit..settings.first_unit + settings.units;
    let mut patches = rendered(seeds, settings.background, work, &|_| {})?;
    patches.extend(real::patches(&settings.data, settings.seed)?);
    let lesson = Lesson {
        settings: &TrainSettings {
            work: None,
            ..settings.clone()
        },
        pools: vec![(1.0, &patches)],
        progress,
    };
    let begin = Instant::now();
    let mut losses = BTreeMap::new();
    let start = Trainer::new(spec, settings.seed);
    let trainer = lesson.learn("trial", start, Stage::Fine, settings.fine_steps, &mut losses)?;
    let train_s = begin.elapsed().as_secs_f64();
    let first = TUNING_SEEDS.start + 100_000;
    let unseen = rendered(first..first + units, settings.background, work, &|_| {})?;
    Ok(Trial {
        loss: losses.get("trial").copied().unwrap_or(f32::NAN),
        train_s,
        ..judged(&[trainer.network().into()], None, &unseen)?
    })
}

/// What networks of stage 2 say of the patches of units, for instance to compare those that they learned from with others.
///
/// # Arguments
/// * `close` – the network that looks closer, if it is to.
///
/// # Errors
/// As [`train`](crate::train()), for the work folder.
pub fn measure_networks(
    fine: &[Engine],
    close: Option<&Engine>,
    units: Range<u64>,
    settings: &TrainSettings,
) -> Result<Trial, TrainError> {
    let patches = rendered(units, settings.background, settings.work.as_deref(), &|_| {})?;
    Ok(judged(fine, close, &patches)?)
}

/// The same on a folder of pictures with exact truth (see `pictures.rs`).
///
/// # Errors
/// [`TrainError`] that names the file.
pub fn measure_networks_on_pictures(
    fine: &[Engine],
    close: Option<&Engine>,
    folder: &Path,
) -> Result<Trial, TrainError> {
    let (patches, _) = pictures::patches(folder, 0)?;
    Ok(judged(fine, close, &patches)?)
}

fn judged(fine: &[Engine], close: Option<&Engine>, patches: &[Patch]) -> Result<Trial, NnError> {
    let (mut screws, mut others, mut errors) = (Vec::new(), Vec::new(), Vec::new());
    let (mut drives, mut right) = (0, 0);
    for patch in patches {
        let Some(picture) = RgbImage::from_raw(PATCH_PX as u32, PATCH_PX as u32, patch.rgb.clone()) else {
            continue;
        };
        let label = patch.labels.first().filter(|_| patch.focused);
        let middle = PATCH_PX as f64 / 2.0;
        // stage 1 is off by a few pixels
        let place = label.map_or([middle; 2], |l| [f64::from(l.u_px) + 2.0, f64::from(l.v_px) - 2.0]);
        let Some(found) = vision::look(fine, close, &picture, &[Pixel::new(place[0], place[1])])?.pop() else {
            continue;
        };
        let score = f64::from(found.of(Class::Cross));
        match label {
            Some(l) if l.classes == only(Class::Cross) => {
                screws.push(score);
                errors.push((found.center.u_px - f64::from(l.u_px)).hypot(found.center.v_px - f64::from(l.v_px)));
            }
            Some(l) => {
                others.push(score);
                let drive = Class::ALL
                    .into_iter()
                    .find(|&c| c.is_fastener() && only(c) == l.classes);
                let likeliest = Class::ALL
                    .into_iter()
                    .max_by(|a, b| found.of(*a).total_cmp(&found.of(*b)));
                drives += usize::from(drive.is_some());
                right += usize::from(drive.is_some() && drive == likeliest);
            }
            None if patch.labels.is_empty() => others.push(score),
            None => {}
        }
    }
    let sorted = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v
    };
    let (screws, others, errors) = (sorted(screws), sorted(others), sorted(errors));
    let at = |v: &[f64], share: f64| v.get((share * v.len() as f64) as usize).copied().unwrap_or(f64::NAN);
    let limit = at(&others, 0.997);
    let part = |hits: usize, of: usize| hits as f64 / of.max(1) as f64;
    let sure = |p: &f64| -p.max(1e-6).ln();
    let log_loss = screws.iter().map(sure).sum::<f64>() + others.iter().map(|p| sure(&(1.0 - p))).sum::<f64>();
    Ok(Trial {
        loss: f32::NAN,
        train_s: 0.0,
        screws: screws.len(),
        others: others.len(),
        recall: part(screws.iter().filter(|s| **s > limit).count(), screws.len()),
        log_loss: log_loss / (screws.len() + others.len()).max(1) as f64,
        drive_right: part(right, drives),
        center_px: [at(&errors, 0.5), at(&errors, 0.95)],
    })
}
