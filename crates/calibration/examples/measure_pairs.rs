//! Fits maps to a file of pairs and measures them on queries whose true command is known (columns `true_cmd_*_mm`), one
//! line a method. For comparing methods on recorded or simulated runs.
//!
//! `cargo run --release -p calibration --example measure_pairs -- PAIRS.csv QUERIES.csv`

use calibration::{Hull, Map, Method, Settings, read_pairs, read_queries};
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
                .map(|(m, t)| m.base.distance_mm(geometry::Point::new(t[0], t[1], t[2])))
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
            println!("\n{report}");
        }
    }
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
