//! Trains several architectures of stage 2 alike, for a fixed number of steps, and measures each on units that none learned from.
//!
//! `cargo run --release -p training --example compare_networks -- WORK_FOLDER UNITS STEPS [NAME...]`

use nn::{LayerSpec, Spec};
use std::path::PathBuf;
use training::{Progress, TrainSettings, try_network};
use vision::layout::{CLIP_PX, FINE_CHANNELS, FINE_INPUT_CHANNELS, fine_spec};

struct Loss;

impl Progress for Loss {
    fn report(&self, _: &str, done: u64, _: u64, loss: Option<f32>) {
        if done.is_multiple_of(250) {
            eprintln!("{done} {loss:?}");
        }
    }
}

/// Kernel side, stride, dilation, channels of each layer before the output; three halvings are followed by a doubling.
fn network(layers: &[[usize; 4]]) -> Spec {
    let halvings = layers.iter().filter(|l| l[1] == 2).count();
    let mut layers: Vec<_> = layers
        .iter()
        .map(|&[k, s, d, out]| LayerSpec::conv(k, s, d, out))
        .collect();
    layers.extend((halvings == 3).then_some(LayerSpec::Upsample2));
    layers.push(LayerSpec::output(FINE_CHANNELS));
    Spec {
        input_channels: FINE_INPUT_CHANNELS,
        layers,
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [work, units, steps, wanted @ ..] = args.as_slice() else {
        return Err("usage: compare_networks WORK_FOLDER UNITS STEPS [NAME...]".into());
    };
    let settings = TrainSettings {
        units: units.parse()?,
        fine_steps: steps.parse()?,
        work: Some(PathBuf::from(work)),
        ..TrainSettings::default()
    };
    #[rustfmt::skip]
    let all = [
        ("shipped", fine_spec()),
        ("narrow", network(&[[3, 2, 1, 24], [3, 2, 1, 48], [3, 1, 1, 48], [3, 1, 2, 48], [3, 1, 2, 48]])), // the first version's
        ("quarter", network(&[[3, 2, 1, 32], [3, 2, 1, 64], [3, 1, 1, 64], [3, 1, 2, 64], [3, 1, 2, 64]])), // the second version's
        ("eighth", network(&[[3, 2, 1, 32], [3, 2, 1, 64], [3, 2, 1, 128], [3, 1, 1, 128], [3, 1, 1, 128], [3, 1, 1, 128]])),
        ("stem", network(&[[3, 2, 1, 32], [3, 1, 1, 32], [3, 2, 1, 64], [3, 2, 1, 128], [3, 1, 1, 128], [3, 1, 1, 128]])),
        ("deep", network(&[[3, 2, 1, 32], [3, 2, 1, 64], [3, 1, 1, 64], [3, 1, 1, 64], [3, 2, 1, 128], [3, 1, 1, 128], [3, 1, 1, 128]])),
        ("deeper", network(&[[3, 2, 1, 32], [3, 1, 1, 32], [3, 2, 1, 64], [3, 1, 1, 64], [3, 1, 1, 64], [3, 2, 1, 128], [3, 1, 1, 128], [3, 1, 1, 128], [3, 1, 1, 128]])),
        ("wide", network(&[[3, 2, 1, 32], [3, 2, 1, 64], [3, 1, 1, 64], [3, 2, 1, 160], [3, 1, 1, 160], [3, 1, 1, 160]])),
    ];
    println!("name     parameters  MFLOP  train s   loss  recall  log loss  drive  centre median p95 px");
    for (name, spec) in all {
        if !wanted.is_empty() && !wanted.iter().any(|w| w == name) {
            continue;
        }
        let (parameters, flops) = (spec.parameters(), spec.flops(CLIP_PX, CLIP_PX) as f64 / 1e6);
        let t = try_network(spec, &settings, 40, &Loss)?;
        println!(
            "{name:8} {parameters:10} {flops:6.1} {:8.0} {:6.3} {:7.4} {:9.4} {:6.3} {:7.3} {:.3}   ({} screws, {} others)",
            t.train_s, t.loss, t.recall, t.log_loss, t.drive_right, t.center_px[0], t.center_px[1], t.screws, t.others
        );
    }
    Ok(())
}
