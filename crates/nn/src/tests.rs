//! The networks against a plain reference in double precision, and against themselves.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::eight::Eight;
use crate::kernel::Level;
use crate::kernel8::Level8;
use crate::{LayerSpec, Network, NnError, RowSource, Spec, Step, Tensor, Trainer, metadata, softmax_cross_entropy};

fn conv(kernel: usize, stride: usize, dilation: usize, out: usize, full: bool) -> LayerSpec {
    LayerSpec::Conv {
        kernel,
        stride,
        dilation,
        out,
        batch_norm: full,
        relu: full,
    }
}

fn random_tensor(seed: u64, n: usize, h: usize, w: usize, c: usize) -> Tensor {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut tensor = Tensor::zeros(n, h, w, c);
    tensor.data.fill_with(|| random.random_range(-1.0..1.0));
    tensor
}

/// One net for each kind of layer, with channels that fill no vector and odd sizes.
fn specs() -> Vec<(Spec, usize, usize)> {
    let spec = |layers: &[LayerSpec]| Spec {
        input_channels: 3,
        layers: layers.to_vec(),
    };
    vec![
        (
            spec(&[
                conv(3, 2, 1, 16, true),
                conv(3, 1, 2, 24, true),
                conv(1, 1, 1, 11, false),
            ]),
            14,
            11,
        ),
        (
            spec(&[
                conv(5, 1, 1, 8, false),
                conv(5, 2, 1, 33, true),
                conv(3, 1, 1, 3, false),
            ]),
            9,
            8,
        ),
        (
            spec(&[
                conv(3, 1, 1, 5, true),
                LayerSpec::MaxPool2,
                conv(3, 1, 4, 6, true),
                LayerSpec::Upsample2,
                conv(1, 2, 1, 4, true),
            ]),
            7,
            9,
        ),
        (
            spec(&[LayerSpec::Upsample2, conv(3, 2, 1, 6, true), LayerSpec::MaxPool2]),
            5,
            3,
        ),
    ]
}

/// The forward pass as one would write it first; returns the output, and batch means and variances if it normalises by
/// the batch. `values` are the parameters in the order of files (running statistics are 0 and 1).
fn reference(spec: &Spec, values: &[f64], input: &Tensor, by_batch: bool) -> Vec<f64> {
    let (n, mut h, mut w, mut c) = (input.n, input.h, input.w, input.c);
    let mut x: Vec<f64> = input.data.iter().map(|&v| v.into()).collect();
    let mut values = values.iter().copied();
    for layer in &spec.layers {
        let at = |b: usize, y: usize, xx: usize, ch: usize| ((b * h + y) * w + xx) * c + ch;
        let mut y = Vec::new();
        match *layer {
            LayerSpec::Conv {
                kernel,
                stride,
                dilation,
                out,
                batch_norm,
                relu,
            } => {
                let weight: Vec<f64> = values.by_ref().take(out * c * kernel * kernel).collect();
                let first: Vec<f64> = values.by_ref().take(out).collect();
                let (oh, ow) = (h.div_ceil(stride), w.div_ceil(stride));
                let pad = dilation * (kernel - 1) / 2;
                for b in 0..n {
                    for oy in 0..oh {
                        for ox in 0..ow {
                            for o in 0..out {
                                let mut sum = if batch_norm { 0.0 } else { first[o] };
                                for (ky, kx) in (0..kernel * kernel).map(|t| (t / kernel, t % kernel)) {
                                    let iy = (oy * stride + ky * dilation).wrapping_sub(pad);
                                    let ix = (ox * stride + kx * dilation).wrapping_sub(pad);
                                    if iy < h && ix < w {
                                        for i in 0..c {
                                            sum +=
                                                x[at(b, iy, ix, i)] * weight[((o * c + i) * kernel + ky) * kernel + kx];
                                        }
                                    }
                                }
                                y.push(sum);
                            }
                        }
                    }
                }
                (h, w, c) = (oh, ow, out);
                if batch_norm {
                    let shift: Vec<f64> = values.by_ref().take(out).collect();
                    let count = (n * h * w) as f64;
                    for o in 0..out {
                        let channel = || y.iter().skip(o).step_by(out);
                        let (mut mean, mut variance) = (0.0, 1.0);
                        if by_batch {
                            mean = channel().sum::<f64>() / count;
                            variance = channel().map(|v| (v - mean).powi(2)).sum::<f64>() / count;
                        }
                        for v in y.iter_mut().skip(o).step_by(out) {
                            *v = (*v - mean) / (variance + 1e-5).sqrt() * first[o] + shift[o];
                        }
                    }
                }
                if relu {
                    y.iter_mut().for_each(|v| *v = v.max(0.0));
                }
            }
            LayerSpec::MaxPool2 | LayerSpec::Upsample2 => {
                let pool = matches!(layer, LayerSpec::MaxPool2);
                let (oh, ow) = if pool {
                    (h.div_ceil(2), w.div_ceil(2))
                } else {
                    (2 * h, 2 * w)
                };
                for b in 0..n {
                    for (oy, ox) in (0..oh * ow).map(|i| (i / ow, i % ow)) {
                        for ch in 0..c {
                            y.push(if pool {
                                (0..4)
                                    .map(|i| (2 * oy + i / 2, 2 * ox + i % 2))
                                    .filter(|&(iy, ix)| iy < h && ix < w)
                                    .map(|(iy, ix)| x[at(b, iy, ix, ch)])
                                    .fold(f64::MIN, f64::max)
                            } else {
                                let side = |o: usize, size: usize| {
                                    let p = ((o as f64 + 0.5) / 2.0 - 0.5).clamp(0.0, size as f64 - 1.0);
                                    let i = (p as usize).min(size.saturating_sub(2));
                                    (i, (i + 1).min(size - 1), p - i as f64)
                                };
                                let ((y0, y1, ty), (x0, x1, tx)) = (side(oy, h), side(ox, w));
                                let row = |y: usize| x[at(b, y, x0, ch)] * (1.0 - tx) + x[at(b, y, x1, ch)] * tx;
                                row(y0) * (1.0 - ty) + row(y1) * ty
                            });
                        }
                    }
                }
                (h, w) = (oh, ow);
            }
        }
        x = y;
    }
    x
}

fn assert_close(got: &[f32], want: &[f64], tolerance: f64, what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let largest = want.iter().fold(1e-3f64, |m, v| m.max(v.abs()));
    for (i, (&got, &want)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(got) - want).abs() / largest;
        assert!(error < tolerance, "{what}, value {i}: {got} is not {want}");
    }
}

fn doubles(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

#[test]
fn every_level_agrees_with_the_reference() {
    for (case, (spec, h, w)) in specs().into_iter().enumerate() {
        for level in Level::all() {
            let batch = random_tensor(case as u64, 3, h, w, 3);
            let mut trainer = Trainer::new(spec.clone(), 7);
            trainer.set_level(level);
            let values = doubles(&trainer.flat().0);
            let network = trainer.network();
            let what = format!("case {case}, {level:?}");
            let want = reference(&spec, &values, &batch, false);
            assert_close(&network.forward_batch(&batch).data, &want, 1e-5, &what);
            let want = reference(&spec, &values, &batch, true);
            assert_close(&trainer.forward(&batch).data, &want, 1e-5, &what);
        }
    }
}

#[test]
fn gradients_are_the_slopes_of_the_reference() {
    for (case, (spec, h, w)) in specs().into_iter().enumerate() {
        for level in Level::all() {
            let batch = random_tensor(10 + case as u64, 5, h, w, 3);
            let mut trainer = Trainer::new(spec.clone(), 3);
            trainer.set_level(level);
            let output = trainer.forward(&batch);
            let grad = random_tensor(20, output.n, output.h, output.w, output.c);
            trainer.backward(&grad);
            let (values, gradients) = trainer.flat();
            let values = doubles(&values);
            let loss = |i: usize, by: f64| -> f64 {
                let mut moved = values.clone();
                moved[i] += by;
                let output = reference(&spec, &moved, &batch, true);
                output.iter().zip(&grad.data).map(|(o, &g)| o * f64::from(g)).sum()
            };
            let mut random = Pcg64Mcg::seed_from_u64(5);
            let checked: Vec<usize> = (0..60).map(|_| random.random_range(0..values.len())).collect();
            let slopes: Vec<f64> = checked
                .iter()
                .map(|&i| (loss(i, 1e-6) - loss(i, -1e-6)) / 2e-6)
                .collect();
            let found: Vec<f32> = checked.iter().map(|&i| gradients[i]).collect();
            assert_close(&found, &slopes, 1e-4, &format!("case {case}, {level:?}"));
        }
    }
}

/// Hides everything but rows.
struct Rows(Tensor);

impl RowSource for Rows {
    fn height(&self) -> usize {
        self.0.h
    }
    fn width(&self) -> usize {
        self.0.w
    }
    fn channels(&self) -> usize {
        self.0.c
    }
    fn row(&self, y: usize, out: &mut [f32]) {
        self.0.row(y, out);
    }
}

#[test]
fn strips_give_the_bits_of_the_whole() {
    for (spec, h, w) in specs() {
        let network = Trainer::new(spec, 1).network();
        let picture = random_tensor(2, 1, 5 * h, 3 * w, 3);
        let whole = network.forward_batch(&picture);
        for rows in [1, 2, 5, whole.h] {
            let strips = network.forward_strips(&Rows(picture.clone()), rows, whole.h, whole.w);
            assert_eq!(strips, whole, "{rows} rows");
        }
        assert_eq!(network.forward(&picture), whole);
    }
}

/// Trains on pictures whose class is the brighter half; returns first and last loss and the trainer.
fn train_a_little(threads: usize, steps: usize) -> (f32, f32, Trainer) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let layers = vec![conv(3, 2, 1, 8, true), conv(3, 1, 2, 16, true), conv(1, 1, 1, 2, false)];
        let spec = Spec {
            input_channels: 1,
            layers,
        };
        let mut trainer = Trainer::new(spec, 11);
        let mut losses = Vec::new();
        for step in 0..steps {
            let mut batch = random_tensor(step as u64, 10, 8, 8, 1);
            let target: Vec<u8> = (0..10 * 16).map(|i| (i % 4 >= 2) as u8).collect();
            for (i, value) in batch.data.iter_mut().enumerate() {
                *value += if i % 8 >= 4 { 0.7 } else { -0.7 };
            }
            let logits = trainer.forward(&batch);
            let mut grad = Tensor::default();
            losses.push(softmax_cross_entropy(&logits, 0..2, &target, &[1.0; 160], &mut grad));
            trainer.backward(&grad);
            trainer.adam_step(0.01, 1e-4);
        }
        (losses[0], losses[steps - 1], trainer)
    })
}

#[test]
fn training_reduces_the_loss_with_the_same_bits_on_any_threads() {
    let (first, last, one) = train_a_little(1, 40);
    assert!(last < 0.2 * first, "{first} to {last}");
    let (_, _, three) = train_a_little(3, 40);
    let none = BTreeMap::new();
    assert_eq!(one.to_bytes(&none).unwrap(), three.to_bytes(&none).unwrap());
    // The running statistics describe the data, so the folded network answers as the trained one does.
    let mut batch = random_tensor(99, 6, 8, 8, 1);
    for (i, value) in batch.data.iter_mut().enumerate() {
        *value += if i % 8 >= 4 { 0.7 } else { -0.7 };
    }
    let logits = one.network().forward_batch(&batch);
    let right = |(i, p): (usize, &[f32])| (p[1] > p[0]) == (i % 4 >= 2);
    let hits = logits.data.chunks_exact(2).enumerate().filter(|&p| right(p)).count();
    assert!(hits > 90, "{hits} of 96");
}

#[test]
fn files_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let (_, _, trainer) = train_a_little(2, 3);
    let told = BTreeMap::from([("data".to_owned(), "sha256:1234 \"quoted\" µ".to_owned())]);
    let path = folder.path().join("net.safetensors");
    trainer.save(&path, &told).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(bytes, trainer.to_bytes(&told).unwrap());
    assert_eq!(metadata(&bytes).unwrap()["data"], told["data"]);
    let picture = random_tensor(1, 1, 20, 30, 1);
    let want = trainer.network().forward(&picture);
    assert_eq!(Network::load(&path).unwrap().forward(&picture), want);

    // A resumed training goes on with the same bits, for its batch statistics and Adam moments are all there.
    let path = folder.path().join("checkpoint.safetensors");
    trainer.save_checkpoint(&path, &told).unwrap();
    let mut resumed = Trainer::load_checkpoint(&path).unwrap();
    let mut trainer = trainer;
    for trainer in [&mut trainer, &mut resumed] {
        let output = trainer.forward(&random_tensor(5, 4, 8, 8, 1));
        trainer.backward(&random_tensor(6, output.n, output.h, output.w, output.c));
        trainer.adam_step(0.01, 0.0);
    }
    assert_eq!(trainer.to_bytes(&told).unwrap(), resumed.to_bytes(&told).unwrap());
}

#[test]
fn bad_files_are_refused_in_words() {
    let none = BTreeMap::new();
    let bytes = train_a_little(1, 1).2.to_bytes(&none).unwrap();
    let error = |bytes: &[u8]| Network::from_bytes(bytes).unwrap_err();
    assert!(matches!(error(b"nonsense"), NnError::Format(_)));
    assert!(matches!(error(&bytes[..bytes.len() - 4]), NnError::Format(_)));
    let swap = |from: &str, to: &str| {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let mut bytes = bytes.clone();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        bytes
    };
    assert!(matches!(error(&swap("\"spec\"", "\"none\"")), NnError::NoSpec));
    assert!(matches!(
        error(&swap("kernel\\\":3", "kernel\\\":4")),
        NnError::Spec { layer: 0, .. }
    ));
    assert!(matches!(
        error(&swap("layers.1.weight", "layers.9.weight")),
        NnError::MissingTensor(_)
    ));
    assert!(matches!(error(&swap("out\\\":8", "out\\\":9")), NnError::Shape { .. }));
    let mut diverged = bytes.clone();
    let end = diverged.len();
    diverged[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(matches!(error(&diverged), NnError::NotFinite(_)));
    // The last tensor but two (weight and bias of the last layer) is a running variance.
    let mut negative = bytes.clone();
    let at = end - 4 * (2 + 2 * 16 + 1);
    negative[at..at + 4].copy_from_slice(&(-1f32).to_le_bytes());
    assert!(matches!(error(&negative), NnError::Format(_)));
    let missing = Network::load("no/such.safetensors").unwrap_err().to_string();
    assert!(missing.contains("no/such.safetensors"), "{missing}");
}

#[test]
fn a_spec_knows_its_geometry() {
    let spec = Spec {
        input_channels: 3,
        layers: vec![
            conv(3, 2, 1, 16, true),
            conv(3, 1, 2, 32, true),
            LayerSpec::MaxPool2,
            conv(1, 1, 1, 4, false),
        ],
    };
    assert_eq!((spec.stride(), spec.output_channels()), (4, 4));
    // Pooling sees two pixels, the dilated layer four more on... 2 + 4 = 6, and stride 2: 5 * 2 + 3.
    assert_eq!(spec.receptive_field(), 13);
    assert_eq!(spec.pixel_map(), (4.0, 1.0));
    assert_eq!(spec.parameters(), 27 * 16 + 32 + 144 * 32 + 64 + 128 + 4);
    assert_eq!(spec.output_size(9, 8), (3, 2));
    assert_eq!(spec.flops(8, 8), 2 * (16 * 27 * 16 + 16 * 144 * 32 + 4 * 128));
}

/// Networks as those of `vision` are, with what a byte of their input means: one that ends with an enlargement, one with a dilation.
fn chains() -> Vec<(Network, Vec<Step>, Tensor)> {
    let layers = [
        vec![
            LayerSpec::conv(5, 2, 1, 16),
            LayerSpec::conv(3, 2, 1, 24),
            LayerSpec::conv(3, 1, 2, 40),
            LayerSpec::Upsample2,
            LayerSpec::output(2),
        ],
        vec![
            LayerSpec::conv(3, 2, 1, 32),
            LayerSpec::conv(3, 1, 1, 32),
            LayerSpec::output(10),
        ],
    ];
    let mut made = Vec::new();
    for (layers, inputs) in layers.into_iter().zip([3, 4]) {
        let spec = Spec {
            input_channels: inputs,
            layers,
        };
        let mut trainer = Trainer::new(spec, 7);
        let batch = random_tensor(3, 6, 33, 41, inputs);
        for _ in 0..60 {
            // so that the running statistics are those of the batch
            trainer.forward(&batch);
        }
        made.push((trainer.network(), vec![Step::between(-1.0, 1.0); inputs], batch));
    }
    made
}

#[test]
fn eight_bits_say_nearly_what_floats_say() {
    for (network, input, batch) in chains() {
        let exact = network.forward_batch(&batch);
        let network = network.in_eight_bits(&input);
        assert!(network.has_eight_bits());
        let eight = network.forward_batch(&batch);
        assert_eq!(
            (eight.n, eight.h, eight.w, eight.c),
            (exact.n, exact.h, exact.w, exact.c)
        );
        let mean = exact.data.iter().sum::<f32>() / exact.data.len() as f32;
        let power = |t: &[f32], by: &dyn Fn(usize) -> f32| {
            (0..t.len()).map(|i| (t[i] - by(i)).powi(2)).sum::<f32>() / t.len() as f32
        };
        let (noise, signal) = (power(&eight.data, &|i| exact.data[i]), power(&exact.data, &|_| mean));
        assert!(noise < 0.03f32.powi(2) * signal, "noise {noise}, signal {signal}");
    }
}

#[test]
fn eight_bits_are_the_same_on_every_processor_and_in_every_strip() {
    for (network, input, batch) in chains() {
        let run = |level: Level8| Eight::new(&network, &input, level).unwrap();
        let picture = |n: usize| Tensor {
            n: 1,
            data: batch.data[batch.index(n, 0, 0)..batch.index(n + 1, 0, 0)].to_vec(),
            h: batch.h,
            w: batch.w,
            c: batch.c,
        };
        let whole = run(Level8::Portable).forward_batch(batch.n, batch.h, batch.w, picture);
        for level in Level8::all() {
            let eight = run(level);
            assert_eq!(
                eight.forward_batch(batch.n, batch.h, batch.w, picture).data,
                whole.data,
                "{level:?}"
            );
            for strips in [1, 2, 5] {
                let first = eight.forward(&picture(0), strips);
                assert_eq!(first.data, whole.data[..first.data.len()], "{level:?} in {strips}");
            }
        }
    }
}

#[test]
fn a_network_that_does_not_fit_eight_bits_stays_in_floats() {
    // the others begin without normalisation, or have layers that are no convolutions
    for ((spec, ..), fits) in specs().into_iter().zip([true, false, false, false]) {
        let input = vec![Step::between(-1.0, 1.0); spec.input_channels];
        let network = Trainer::new(spec, 1).network();
        let batch = random_tensor(1, 1, 9, 9, 3);
        let before = network.forward_batch(&batch);
        let network = network.in_eight_bits(&input);
        assert_eq!(network.has_eight_bits(), fits);
        assert_eq!(network.forward_batch(&batch).data == before.data, !fits);
    }
}
