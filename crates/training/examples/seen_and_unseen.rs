//! A model's stage 2 on patches that it learned from and on others: how much of what it knows is learned by heart; and on pictures
//! with exact truth from elsewhere.
//!
//! `cargo run --release -p training --example seen_and_unseen -- MODEL WORK_FOLDER [PICTURES]`

use std::path::{Path, PathBuf};
use training::{TUNING_SEEDS, TrainSettings, Trial, measure_networks, measure_networks_on_pictures};

fn say(name: &str, networks: usize, t: &Trial) {
    println!(
        "{name:9} {networks} networks: recall {:.4}  log loss {:.4}  drive {:.3}  centre {:.3} {:.3} px  ({} screws, {} others)",
        t.recall, t.log_loss, t.drive_right, t.center_px[0], t.center_px[1], t.screws, t.others
    );
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [model, work, pictures @ ..] = args.as_slice() else {
        return Err("usage: seen_and_unseen MODEL WORK_FOLDER [PICTURES]".into());
    };
    let model = vision::Model::load(Path::new(model))?;
    let settings = TrainSettings {
        work: Some(PathBuf::from(work)),
        ..TrainSettings::default()
    };
    let unseen = TUNING_SEEDS.start + 100_000;
    let mut counts = vec![1, model.fine.len()];
    counts.dedup();
    for count in counts {
        let networks = &model.fine[..count];
        for (name, units) in [("seen", 0..40), ("unseen", unseen..unseen + 40)] {
            say(name, count, &measure_networks(networks, units, &settings)?);
        }
        for folder in pictures {
            say(
                "pictures",
                count,
                &measure_networks_on_pictures(networks, Path::new(folder))?,
            );
        }
    }
    Ok(())
}
