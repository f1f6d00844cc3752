//! Trains several architectures of stage 2 alike, for a fixed number of steps, and measures each on units that none learned from.
//!
//! `cargo run --release -p training --example compare_networks -- WORK_FOLDER UNITS STEPS [NAME...]`

use nn::{LayerSpec, Spec};
use std::path::PathBuf;
use training::{Progress, TrainSettings, try_network};
use vision::layout::{CLIP_PX, FINE_CHANNELS, fine_spec};

struct Loss;

impl Progress for Loss {
    fn report(&self, _: &str, done: u64, _: u64, loss: Option<f32>) {
        if done.is_multiple_of(250) {
            eprintln!("{done} {loss:?}");
        }
    }
}

/// Kernel side, stride, dilation, channels of each layer before the output.
fn network(layers: &[[usize; 4]]) -> Spec {
    let conv = |&[kernel, stride, dilation, out]: &[usize; 4]| LayerSpec::Conv {
        kernel,
        stride,
        dilation,
        out,
        batch_norm: true,
        relu: true,
    };
    let mut layers: Vec<LayerSpec> = layers.iter().map(conv).collect();
    if layers
        .iter()
        .map(|l| {
            if matches!(l, LayerSpec::Conv { stride: 2, .. }) {
                2
            } else {
                1
            }
        })
        .product::<usize>()
        == 8
    {
        layers.push(LayerSpec::Upsample2);
    }
    layers.push(LayerSpec::Conv {
        kernel: 1,
        stride: 1,
        dilation: 1,
        out: FINE_CHANNELS,
        batch_norm: false,
        relu: false,
    });
    Spec {
        input_channels: 3,
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
    let all = [
        ("shipped", fine_spec()),
        // the first version's
        (
            "narrow",
            network(&[
                [3, 2, 1, 24],
                [3, 2, 1, 48],
                [3, 1, 1, 48],
                [3, 1, 2, 48],
                [3, 1, 2, 48],
            ]),
        ),
        (
            "eighth",
            network(&[
                [3, 2, 1, 32],
                [3, 2, 1, 64],
                [3, 2, 1, 128],
                [3, 1, 1, 128],
                [3, 1, 1, 128],
                [3, 1, 1, 128],
            ]),
        ),
        (
            "deep",
            network(&[
                [3, 2, 1, 32],
                [3, 2, 1, 48],
                [3, 1, 1, 48],
                [3, 1, 1, 48],
                [3, 1, 2, 48],
                [3, 1, 2, 48],
                [3, 1, 2, 48],
            ]),
        ),
        (
            "full",
            network(&[
                [3, 1, 1, 16],
                [3, 2, 1, 32],
                [3, 2, 1, 64],
                [3, 1, 1, 64],
                [3, 1, 2, 64],
                [3, 1, 2, 64],
            ]),
        ),
        (
            "half",
            network(&[
                [3, 2, 1, 32],
                [3, 1, 1, 32],
                [3, 2, 1, 64],
                [3, 1, 1, 64],
                [3, 1, 2, 64],
                [3, 1, 2, 64],
            ]),
        ),
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
