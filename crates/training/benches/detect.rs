//! Time of each stage of detection, and of the whole, on a face of 4104 x 3006 pixels: `cargo bench -p training`; on one core, and on all.
//!
//! `whole` is a decoded picture with depth to centres in the camera's frame; `decode` is the JPEG file.

use divan::Bencher;
use geometry::RgbdFrame;
use scene::{FaceId, FaceView, Prepared, Unit};
use std::sync::LazyLock;
use vision::{Detector, Options, candidates, coarse_map, cross, look, outer_circle};

/// A unit of the evaluation's seeds.
const SEED: u64 = 1_000_000;

struct Face {
    frame: RgbdFrame,
    jpeg: Vec<u8>,
}

static FACE: LazyLock<Face> = LazyLock::new(|| {
    let unit = Unit::sample(SEED);
    let view = FaceView::sample(&unit, FaceId::Front, SEED).expect("every unit has a front");
    let picture = Prepared::new(&view).render(None);
    let mut jpeg = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 92);
    picture.color.write_with_encoder(encoder).expect("a picture");
    let frame = RgbdFrame {
        color: picture.color,
        depth: Some(picture.depth),
        camera: Some(view.camera),
        t_s: 0.0,
    };
    Face { frame, jpeg }
});

static DETECTOR: LazyLock<Detector> = LazyLock::new(|| Detector::embedded().expect("the built-in model"));

/// Runs a piece of work on so many cores; 0 is all.
fn on<R: Send>(cores: usize, work: impl Fn() -> R + Send + Sync) -> impl Fn() -> R {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(cores)
        .build()
        .expect("threads");
    move || pool.install(&work)
}

fn main() {
    let size = FACE.frame.color.dimensions();
    let found = DETECTOR.detect(&FACE.frame, &Options::default()).screws.len();
    println!(
        "{} x {} px, {found} finds, model {}",
        size.0,
        size.1,
        DETECTOR.model().id()
    );
    divan::main();
}

#[divan::bench(sample_count = 10)]
fn decode(bencher: Bencher<'_, '_>) {
    bencher.bench(|| image::load_from_memory(&FACE.jpeg));
}

#[divan::bench(args = [1, 0], sample_count = 10)]
fn stage_1(bencher: Bencher<'_, '_>, cores: usize) {
    let model = DETECTOR.model();
    bencher.bench(on(cores, || {
        coarse_map(&model.coarse, &FACE.frame.color).map(|map| candidates(&map, &model.settings.thresholds))
    }));
}

#[divan::bench(args = [1, 0], sample_count = 10)]
fn stage_2(bencher: Bencher<'_, '_>, cores: usize) {
    let model = DETECTOR.model();
    let map = coarse_map(&model.coarse, &FACE.frame.color).expect("own kernels");
    let places: Vec<_> = candidates(&map, &model.settings.thresholds)
        .iter()
        .map(|c| c.pixel)
        .collect();
    bencher.bench(on(cores, || {
        look(&model.fine, model.close.as_ref(), &FACE.frame.color, &places)
    }));
}

#[divan::bench(sample_count = 10)]
fn centres(bencher: Bencher<'_, '_>) {
    let finds = DETECTOR.detect(&FACE.frame, &Options::default()).screws;
    bencher.bench(|| {
        let found = finds.iter().map(|f| {
            let picture = &FACE.frame.color;
            (
                outer_circle(picture, f.pixel, f.diameter_px),
                cross(picture, f.pixel, f.diameter_px),
            )
        });
        found.count()
    });
}

#[divan::bench(args = [1, 0], sample_count = 10)]
fn whole(bencher: Bencher<'_, '_>, cores: usize) {
    bencher.bench(on(cores, || DETECTOR.detect(&FACE.frame, &Options::default())));
}
