//! A model's stage 2 on patches that it learned from and on others: how much of what it knows is learned by heart.
//!
//! `cargo run --release -p training --example seen_and_unseen -- MODEL WORK_FOLDER`

use std::path::{Path, PathBuf};
use training::{TUNING_SEEDS, TrainSettings, measure_networks};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [model, work] = args.as_slice() else {
        return Err("usage: seen_and_unseen MODEL WORK_FOLDER".into());
    };
    let model = vision::Model::load(Path::new(model))?;
    let settings = TrainSettings {
        work: Some(PathBuf::from(work)),
        ..TrainSettings::default()
    };
    let unseen = TUNING_SEEDS.start + 100_000;
    for (name, units) in [("seen", 0..40), ("unseen", unseen..unseen + 40)] {
        for count in [1, model.fine.len()] {
            let t = measure_networks(&model.fine[..count], units.clone(), &settings)?;
            println!(
                "{name:7} {count} networks: recall {:.4}  log loss {:.4}  drive {:.3}  centre {:.3} {:.3} px  ({} screws, {} others)",
                t.recall, t.log_loss, t.drive_right, t.center_px[0], t.center_px[1], t.screws, t.others
            );
        }
    }
    Ok(())
}
