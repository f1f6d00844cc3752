//! Fits maps to a file of pairs and measures them on queries whose true command is known (columns `true_cmd_*_mm`), one
//! line a method. For comparing methods on recorded or simulated runs.
//!
//! `cargo run --release -p calibration --example measure_pairs -- PAIRS.csv QUERIES.csv [NOISE.csv]`
//!
//! The noise of a measurement is what the pairs' likelihood says it is; NOISE.csv are pairs of the same cameras with as many frames a
//! point that tell it better, since they are more.

mod common;

use calibration::{Hull, Map, Method, Moved, Pair, Query, Settings, diagnose, read_pairs, read_queries};
use common::world::{gauss, gauss3};
use common::{Errors, METHODS};
use geometry::{Base, Camera, Point};
use nalgebra::{Isometry3, Point3};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use std::{error::Error, path::Path, time::Instant};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (pairs, queries, telling) = match arguments.as_slice() {
        [pairs, queries] => (pairs, queries, pairs),
        [pairs, queries, telling] => (pairs, queries, telling),
        _ => return Err("usage: measure_pairs PAIRS.csv QUERIES.csv [NOISE.csv]".into()),
    };
    let pairs = read_pairs(Path::new(pairs))?;
    let (telling, _) = Map::fit(&read_pairs(Path::new(telling))?, &Settings::default())?;
    let noise = telling.noise_mm().ok_or("a gp map knows its noise")?;
    let truth = read_truth(queries)?;
    let queries = read_queries(Path::new(queries))?;
    for (name, method, as_published) in METHODS {
        let settings = Settings {
            method,
            as_published,
            ..Settings::default()
        };
        let start = Instant::now();
        let (map, report) = Map::fit(&pairs, &settings)?;
        let fit_ms = start.elapsed().as_millis();
        let start = Instant::now();
        let mapped: Vec<_> = queries
            .iter()
            .zip(&truth)
            .filter_map(|(q, t)| Some((map.apply(q.camera?), *t)))
            .collect();
        let query_ns = start.elapsed().as_nanos() / mapped.len().max(1) as u128;
        let off = |wanted: &dyn Fn(Hull) -> bool| {
            let of = mapped.iter().filter(|(m, _)| wanted(m.hull));
            Errors(of.map(|(m, t)| m.base.distance_mm(*t)).collect())
        };
        println!("{name:<24} {}; fit {fit_ms} ms, query {query_ns} ns", off(&|_| true));
        println!("{:<24} {}", "  inside", off(&|hull| hull == Hull::Inside));
        if method == Method::Gp {
            println!("\n{report}\n");
            let (_, diagnosis) = diagnose(&pairs, &settings)?;
            with_noise(&map, noise, &queries, &truth);
            after_a_bump(&map, noise, &queries, &truth)?;
            println!(
                "gp, left-out pairs in the stated 95 % interval: {:.1} % (n = {})\n",
                100.0 * diagnosis.coverage[1],
                diagnosis.held_out.n
            );
        }
    }
    Ok(())
}

/// What the camera would measure there with noise of this size.
fn measured(at: Point<Camera>, [lateral_mm, depth_mm]: [f64; 2], rng: &mut Pcg64Mcg) -> Point<Camera> {
    let c = at.vector();
    let ray = c.normalize();
    let noise = gauss3(rng) * lateral_mm;
    let across = noise - ray * noise.dot(&ray);
    Point::from_vector(c + across + ray * (gauss(rng) * depth_mm))
}

/// A point that is measured twice as long as the pairs were: twice the frames.
fn with_noise(map: &Map, noise: [f64; 2], queries: &[Query], truth: &[Point<Base>]) {
    let rng = &mut Pcg64Mcg::seed_from_u64(1);
    let [lateral, depth] = noise;
    let twice = noise.map(|s| s / 2f64.sqrt());
    let rows = || queries.iter().zip(truth);
    let errors = (0..20)
        .flat_map(|_| rows())
        .filter_map(|(q, t)| Some(map.apply(measured(q.camera?, twice, rng)).base.distance_mm(*t)));
    println!(
        "noise of the pairs, by their likelihood: {lateral:.3} mm across (each axis), {depth:.3} mm along the ray\ngp, a point measured with twice the frames of the pairs: {}",
        Errors(errors.collect())
    );
}

/// The camera is pushed by 1 mm and turned by 2 mrad; ten fresh points; the other queries, 20 times over.
fn after_a_bump(map: &Map, noise: [f64; 2], queries: &[Query], truth: &[Point<Base>]) -> Result<(), Box<dyn Error>> {
    let rng = &mut Pcg64Mcg::seed_from_u64(2);
    let (mut before, mut after) = (Errors::default(), Errors::default());
    for trial in 0..20 {
        let bump = Isometry3::new(gauss3(rng).normalize(), 2e-3 * gauss3(rng).normalize());
        let moved = |at: Point<Camera>| Point::from_vector((bump * Point3::from(at.vector())).coords);
        let is_fresh = |k: usize| k % 97 == 3 * trial % 97;
        let rows = || {
            let all = queries.iter().zip(truth).enumerate();
            all.filter_map(|(k, (q, t))| Some((k, q.camera?, *t)))
        };
        let fresh: Vec<Pair> = rows()
            .filter(|(k, ..)| is_fresh(*k))
            .take(10)
            .map(|(k, camera, command)| Pair {
                id: k as u64,
                node: None,
                t_s: 6.0 * k as f64,
                command,
                pixel: None,
                depth_mm: None,
                camera: Some(measured(moved(camera), noise, rng)),
                joints_rad: None,
                valid: true,
            })
            .collect();
        let (realigned, _) = map.realign(&fresh, Moved::Pose, "")?;
        for (_, camera, command) in rows().filter(|(k, ..)| !is_fresh(*k)) {
            before.0.push(map.apply(moved(camera)).base.distance_mm(command));
            after.0.push(realigned.apply(moved(camera)).base.distance_mm(command));
        }
    }
    println!("gp, after a bump of 1 mm and 2 mrad: {before}");
    println!("gp, realigned with 10 points:        {after}");
    Ok(())
}

fn read_truth(path: &str) -> Result<Vec<Point<Base>>, Box<dyn Error>> {
    let mut reader = csv::Reader::from_path(path)?;
    let header = reader.headers()?.clone();
    let mut columns = [0; 3];
    for (column, name) in columns
        .iter_mut()
        .zip(["true_cmd_x_mm", "true_cmd_y_mm", "true_cmd_z_mm"])
    {
        *column = header
            .iter()
            .position(|h| h == name)
            .ok_or_else(|| format!("{path} has no column {name}"))?;
    }
    let mut truth = Vec::new();
    for record in reader.records() {
        let record = record?;
        let number = |c: usize| record[c].parse::<f64>();
        let [x, y, z] = columns;
        truth.push(Point::new(number(x)?, number(y)?, number(z)?));
    }
    Ok(truth)
}
