//! How fast this machine runs and trains networks of the size that the detector uses.
//!
//! ```sh
//! cargo run --release -p nn --example throughput [training]
//! # beside ONNX Runtime, whose library ORT_DYLIB_PATH names; RAYON_NUM_THREADS=1 for one core
//! cargo run --release -p nn --features ort --example throughput
//! ```

use std::hint::black_box;
use std::time::Instant;

use nn::{LayerSpec, RowSource, Spec, Step, Tensor, Trainer};

/// A picture that costs nothing to read.
struct Grey(usize, usize, usize);

impl RowSource for Grey {
    fn height(&self) -> usize {
        self.0
    }
    fn width(&self) -> usize {
        self.1
    }
    fn channels(&self) -> usize {
        self.2
    }
    fn row(&self, y: usize, out: &mut [f32]) {
        out.fill(y as f32 * 1e-3);
    }
}

/// Seconds of the fastest of several runs.
fn fastest(runs: usize, mut work: impl FnMut()) -> f64 {
    (0..runs)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .fold(f64::INFINITY, f64::min)
}

/// Fused multiplications and additions that depend on nothing but themselves: operations done.
fn multiply_add(steps: usize) -> u64 {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::*;
        #[target_feature(enable = "avx512f")]
        fn wide(steps: usize) {
            let mut sums = [_mm512_set1_ps(black_box(0.1)); 16];
            let factor = _mm512_set1_ps(black_box(0.9));
            for _ in 0..steps {
                for sum in &mut sums {
                    *sum = _mm512_fmadd_ps(*sum, factor, factor);
                }
            }
            black_box(sums);
        }
        #[target_feature(enable = "avx2,fma")]
        fn narrow(steps: usize) {
            let mut sums = [_mm256_set1_ps(black_box(0.1)); 12];
            let factor = _mm256_set1_ps(black_box(0.9));
            for _ in 0..steps {
                for sum in &mut sums {
                    *sum = _mm256_fmadd_ps(*sum, factor, factor);
                }
            }
            black_box(sums);
        }
        // SAFETY: each is called only where the processor has its instructions.
        if is_x86_feature_detected!("avx512f") {
            unsafe { wide(steps) };
            return 16 * 16 * 2 * steps as u64;
        } else if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            unsafe { narrow(steps) };
            return 12 * 8 * 2 * steps as u64;
        }
    }
    let mut sums = [black_box(0.1f32); 32];
    for _ in 0..steps {
        for sum in &mut sums {
            *sum = *sum * 0.9 + 0.9;
        }
    }
    black_box(sums);
    32 * 2 * steps as u64
}

/// Highest memory that this process has had, MB.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

/// The same networks by each engine: a whole picture through one as in stage 1, many clips through one as in stage 2.
fn engines(whole: &Spec) {
    let conv = LayerSpec::conv;
    let mut clips = [32, 64, 64, 64, 128, 128, 128].map(|out| conv(3, 1, 1, out));
    for k in [0, 1, 4] {
        clips[k] = conv(3, 2, 1, [32, 64, 0, 0, 128][k]);
    }
    let clips = Spec {
        input_channels: 4,
        layers: clips
            .into_iter()
            .chain([LayerSpec::Upsample2, LayerSpec::output(10)])
            .collect(),
    };
    let (h, w, n) = (3006, 4104, 128);
    let (whole, clips) = (
        Trainer::new(whole.clone(), 1).network(),
        Trainer::new(clips, 1).network(),
    );
    let (picture, batch) = (Grey(h, w, 3), Tensor::zeros(n, 64, 64, 4));
    let (whole_gflop, clips_gflop) = (
        whole.spec().flops(h, w) as f64 / 1e9,
        (n as u64 * clips.spec().flops(64, 64)) as f64 / 1e9,
    );
    println!("engines: {h} x {w} pixels ({whole_gflop:.1} GFLOP); {n} clips of 64 x 64 ({clips_gflop:.1} GFLOP)");
    let say = |name: &str, whole_s: f64, clips_s: f64| {
        let peak = peak_mb().map_or(String::new(), |mb| format!(", {mb:.0} MB at most so far"));
        println!("  {name:12} {:7.1} ms, {:7.1} ms{peak}", 1e3 * whole_s, 1e3 * clips_s);
    };
    let own = [
        fastest(8, || drop(black_box(whole.forward(&picture)))),
        fastest(8, || drop(black_box(clips.forward_batch(&batch)))),
    ];
    say("own kernels", own[0], own[1]);
    let [whole8, clips8] = [(&whole, 3), (&clips, 4)].map(|(network, channels)| {
        let input = vec![Step::between(-1.0, 1.0); channels];
        network.clone().in_eight_bits(&input)
    });
    say(
        "in 8 bits",
        fastest(8, || drop(black_box(whole8.forward(&picture)))),
        fastest(8, || drop(black_box(clips8.forward_batch(&batch)))),
    );
    #[cfg(feature = "ort")]
    {
        let session = |network: &nn::Network| network.through_onnx_runtime(nn::onnx_runtime::Provider::Cpu);
        match (session(&whole), session(&clips)) {
            (Ok(whole), Ok(clips)) => say(
                "ONNX Runtime",
                fastest(8, || drop(black_box(whole.forward(&picture)))),
                fastest(8, || drop(black_box(clips.forward_batch(&batch)))),
            ),
            (Err(error), _) | (_, Err(error)) => println!("  {error}"),
        }
    }
}

fn main() {
    let threads = rayon::current_num_threads();
    let mut operations = 0;
    let seconds = fastest(20, || {
        operations = rayon::broadcast(|_| multiply_add(1 << 21)).into_iter().sum::<u64>();
    });
    let peak = operations as f64 / seconds / 1e9;
    println!("{threads} threads, {peak:.0} GFLOP/s of multiplications and additions");

    let training_only = std::env::args().any(|argument| argument == "training");
    let layers = |channels: usize, count: usize| vec![LayerSpec::conv(3, 1, 1, channels); count];
    let mut cases: Vec<(String, Spec, usize, usize)> = [16, 24, 32, 48, 64]
        .into_iter()
        .map(|c| {
            let spec = Spec {
                input_channels: c,
                layers: layers(c, 4),
            };
            (format!("4 x 3x3, {c} channels"), spec, 1503 / 2, 2052 / 2)
        })
        .collect();
    let mut detector = vec![LayerSpec::conv(3, 2, 1, 16), LayerSpec::conv(3, 2, 1, 32)];
    detector.extend([1, 1, 2, 1].map(|dilation| LayerSpec::conv(3, 1, dilation, 32)));
    detector.push(LayerSpec::output(11));
    let detector = Spec {
        input_channels: 3,
        layers: detector,
    };
    cases.push(("detector, 3 channels".into(), detector.clone(), 1503, 2052));
    if training_only {
        cases.clear();
    } else {
        println!("inference, 1503 x 2052 pixels");
    }
    for (name, spec, h, w) in cases {
        let network = Trainer::new(spec.clone(), 1).network();
        let source = Grey(h, w, spec.input_channels);
        let seconds = fastest(8, || {
            black_box(network.forward(&source));
        });
        let rate = spec.flops(h, w) as f64 / seconds / 1e9;
        let (share, ms) = (100.0 * rate / peak, 1e3 * seconds);
        println!("  {name:24} {h:5} x {w:4} {ms:8.1} ms {rate:6.0} GFLOP/s {share:4.0} %");
    }

    if !training_only {
        engines(&detector);
    }
    println!("training, batch 128 of 64 x 64 x 3");
    let mut trainer = Trainer::new(detector.clone(), 1);
    let mut batch = Tensor::zeros(128, 64, 64, 3);
    for (i, value) in batch.data.iter_mut().enumerate() {
        *value = (i * 7919 % 1013) as f32 / 1013.0 - 0.5;
    }
    let mut output = trainer.forward(&batch);
    output.data.fill(1e-3);
    let forward = fastest(30, || {
        black_box(trainer.forward(&batch));
    });
    let step = fastest(30, || {
        black_box(trainer.forward(&batch));
        trainer.backward(&output);
        trainer.adam_step(1e-3, 0.0);
    });
    let rate = 3.0 * 128.0 * detector.flops(64, 64) as f64 / step / 1e9;
    println!(
        "  {:.0} images/s ({:.1} ms forward, {:.1} ms in all, about {rate:.0} GFLOP/s)",
        128.0 / step,
        1e3 * forward,
        1e3 * step,
    );
}
