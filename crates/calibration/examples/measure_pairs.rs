//! Fits maps to a file of pairs and measures them on queries whose true command is known (columns `true_cmd_*_mm`), one
//! line a method. For comparing methods on recorded or simulated runs.
//!
//! `cargo run --release -p calibration --example measure_pairs -- PAIRS.csv QUERIES.csv`

use calibration::{Hull, Map, Method, Moved, Pair, Query, Settings, read_pairs, read_queries};
use geometry::{Camera, Point};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::{error::Error, path::Path, time::Instant};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [pairs, queries] = arguments.as_slice() else {
        return Err("usage: measure_pairs PAIRS.csv QUERIES.csv".into());
    };
    let pairs = read_pairs(Path::new(pairs))?;
    let truth = read_truth(queries)?;
    let queries = read_queries(Path::new(queries))?;
    println!(
        "{:<28} {:>6} {:>4} {:>7} {:>7} {:>7} {:>8} {:>9}  inside: {:>5} {:>7} {:>9}  {:>6} {:>8}",
        "error at the queries, mm",
        "used",
        "rej",
        "rms",
        "p95",
        "p99.9",
        "max",
        "> 0.35",
        "n",
        "max",
        "> 0.35",
        "fit ms",
        "query ns"
    );
    let cases = [
        ("rigid", Method::Rigid, false),
        ("affine", Method::Affine, false),
        ("lattice, as published", Method::Lattice, true),
        ("lattice, robust", Method::Lattice, false),
        ("tps", Method::Tps, false),
        ("gp", Method::Gp, false),
    ];
    for (name, method, as_published) in cases {
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
        let off = |inside_only: bool| {
            let mut off: Vec<f64> = mapped
                .iter()
                .filter(|(m, _)| !inside_only || m.hull == Hull::Inside)
                .map(|(m, t)| m.base.distance_mm(Point::new(t[0], t[1], t[2])))
                .collect();
            off.sort_by(f64::total_cmp);
            off
        };
        let (all, inside) = (off(false), off(true));
        let at = |q: f64| all[((all.len() as f64 * q).ceil() as usize).clamp(1, all.len()) - 1];
        let rms = (all.iter().map(|e| e * e).sum::<f64>() / all.len() as f64).sqrt();
        let over = |v: &[f64]| 100.0 * v.iter().filter(|e| **e > 0.35).count() as f64 / v.len().max(1) as f64;
        println!(
            "{name:<28} {:>6} {:>4} {rms:>7.3} {:>7.3} {:>7.3} {:>8.3} {:>7.2} %          {:>5} {:>7.3} {:>7.2} %  {fit_ms:>6} {query_ns:>8}",
            report.n_used,
            report.rejected.len(),
            at(0.95),
            at(0.999),
            at(1.0),
            over(&all),
            inside.len(),
            inside.last().copied().unwrap_or_default(),
            over(&inside),
        );
        if name == "gp" {
            println!("\n{report}\n");
            with_noise(&map, &queries, &truth);
            after_a_bump(&map, &queries, &truth)?;
        }
    }
    Ok(())
}

fn gauss(rng: &mut Pcg64Mcg) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// What the camera would measure there: the map's own sigma, which holds its error too, is more than the noise alone.
fn measured(map: &Map, at: Point<Camera>, share: f64, rng: &mut Pcg64Mcg) -> Point<Camera> {
    let (sigma, c) = (map.apply(at), at.vector());
    let ray = c.normalize();
    let noise = Vector3::new(gauss(rng), gauss(rng), gauss(rng)) * sigma.sigma_lateral_mm;
    let across = noise - ray * noise.dot(&ray);
    Point::from_vector(c + (across + ray * (gauss(rng) * sigma.sigma_depth_mm)) * share)
}

fn tail(mut errors: Vec<f64>) -> String {
    errors.sort_by(f64::total_cmp);
    let at = |q: f64| errors[((errors.len() as f64 * q).ceil() as usize).clamp(1, errors.len()) - 1];
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    format!(
        "rms {rms:.3}, p95 {:.3}, p99.9 {:.3} mm (n = {})",
        at(0.95),
        at(0.999),
        errors.len()
    )
}

/// A point that is measured twice as long as the pairs were: twice the frames.
fn with_noise(map: &Map, queries: &[Query], truth: &[[f64; 3]]) {
    let rng = &mut Pcg64Mcg::seed_from_u64(1);
    let errors = queries.iter().zip(truth).filter_map(|(q, [x, y, z])| {
        let at = measured(map, q.camera?, 0.5f64.sqrt(), rng);
        Some(map.apply(at).base.distance_mm(Point::new(*x, *y, *z)))
    });
    println!(
        "gp, a point measured with twice the frames of the pairs: {}",
        tail(errors.collect())
    );
}

/// The camera is pushed by 1 mm and turned by 2 mrad; ten fresh points; the other queries, 20 times over.
fn after_a_bump(map: &Map, queries: &[Query], truth: &[[f64; 3]]) -> Result<(), Box<dyn Error>> {
    let rng = &mut Pcg64Mcg::seed_from_u64(2);
    let (mut before, mut after) = (Vec::new(), Vec::new());
    for trial in 0..20 {
        let unit = |rng: &mut Pcg64Mcg| Vector3::new(gauss(rng), gauss(rng), gauss(rng)).normalize();
        let bump = Isometry3::new(unit(rng), 2e-3 * unit(rng));
        let moved = |at: Point<Camera>| Point::from_vector((bump * Point3::from(at.vector())).coords);
        let is_fresh = |k: usize| k % 97 == 3 * trial % 97;
        let rows = || {
            queries
                .iter()
                .zip(truth)
                .enumerate()
                .filter_map(|(k, (q, t))| Some((k, q.camera?, Point::new(t[0], t[1], t[2]))))
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
                camera: Some(measured(map, moved(camera), 1.0, rng)),
                joints_rad: None,
                valid: true,
            })
            .collect();
        let (realigned, _) = map.realign(&fresh, Moved::Pose, "")?;
        for (_, camera, command) in rows().filter(|(k, ..)| !is_fresh(*k)) {
            before.push(map.apply(moved(camera)).base.distance_mm(command));
            after.push(realigned.apply(moved(camera)).base.distance_mm(command));
        }
    }
    println!("gp, after a bump of 1 mm and 2 mrad: {}", tail(before));
    println!("gp, realigned with 10 points:        {}", tail(after));
    Ok(())
}

fn read_truth(path: &str) -> Result<Vec<[f64; 3]>, Box<dyn Error>> {
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
        truth.push([
            record[columns[0]].parse()?,
            record[columns[1]].parse()?,
            record[columns[2]].parse()?,
        ]);
    }
    Ok(truth)
}
