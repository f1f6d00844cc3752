//! A model's stage 2 on patches that it learned from and on others: how much of what it knows is learned by heart; and on pictures
//! with exact truth from elsewhere.
//!
//! `cargo run --release -p training --example seen_and_unseen -- MODEL WORK_FOLDER [PICTURES]`

use std::path::{Path, PathBuf};
use training::{TUNING_SEEDS, TrainSettings, Trial, measure_networks, measure_networks_on_pictures};

fn say(name: &str, looks: &str, t: &Trial) {
    println!(
        "{name:9} {looks:14} recall {:.4}  log loss {:.4}  drive {:.3}  centre {:.3} {:.3} px  ({} screws, {} others)",
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
    let mut looks = vec![("one network", &model.fine[..1], None)];
    looks.extend((model.fine.len() > 1).then_some(("all networks", &model.fine[..], None)));
    looks.extend(
        model
            .close
            .as_ref()
            .map(|close| ("a closer look", &model.fine[..], Some(close))),
    );
    for (looks, fine, close) in looks {
        for (name, units) in [("seen", 0..40), ("unseen", unseen..unseen + 40)] {
            say(name, looks, &measure_networks(fine, close, units, &settings)?);
        }
        for folder in pictures {
            say(
                "pictures",
                looks,
                &measure_networks_on_pictures(fine, close, Path::new(folder))?,
            );
        }
    }
    Ok(())
}
