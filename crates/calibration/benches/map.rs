//! Time of a query and of a fit. `cargo bench -p calibration`

#[path = "../examples/common/mod.rs"]
mod common;

use calibration::{Map, Pair, Settings};
use common::world::{Severity, World, anywhere};
use geometry::{Camera, Point};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use std::hint::black_box;

/// Queries in one sample, so that the clock's own time does not count.
const BATCH: usize = 1000;

fn main() {
    divan::main();
}

fn world() -> World {
    World::new(5001, Severity::NOMINAL)
}

fn fitted(pairs: &[Pair]) -> Map {
    let (map, report) = Map::fit(pairs, &Settings::default()).expect("the simulated pairs make a map");
    assert!(
        report.notes.iter().any(|n| n.contains("waves a turn")),
        "a query without waves says nothing: {report}"
    );
    map
}

fn places() -> Vec<Point<Camera>> {
    let (world, rng) = (world(), &mut Pcg64Mcg::seed_from_u64(1));
    (0..BATCH).map(|_| world.sight(anywhere(rng))).collect()
}

/// Queries anywhere in the volume, ripple of the gears included.
#[divan::bench(args = [100, 300])]
fn query(bencher: divan::Bencher, points: usize) {
    let map = fitted(&world().capture(5001, points, 4));
    let places = places();
    bencher.counter(divan::counter::ItemsCount::new(BATCH)).bench_local(|| {
        for place in &places {
            black_box(map.apply(black_box(*place)));
        }
    });
}

/// A fit, choice of kernels, waves and sigma included.
#[divan::bench(args = [100, 200], sample_count = 5, sample_size = 1)]
fn fit(points: usize) -> usize {
    fitted(&world().capture(5001, points, 4)).n_used()
}

/// The paper's lattice with misses, a missing corner and outliers.
#[divan::bench(sample_count = 5, sample_size = 1)]
fn fit_lattice_of_2736() -> usize {
    fitted(&world().lattice(5001).0).n_used()
}
