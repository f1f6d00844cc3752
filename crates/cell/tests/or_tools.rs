//! Ten fixtures against OR-Tools CP-SAT: its makespans are in `fixtures/or_tools.json`, made by `or_tools.py`.

use cell::schedule::{Limits, Problem, Product, Station, solve};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::path::Path;

/// Name, screws by face, arms, tables, units, seed, precedence (0 a chain of covers, 1 free, 2 with alternatives).
type Fixture = (&'static str, &'static [usize], usize, usize, usize, u64, u8);

const FIXTURES: [Fixture; 10] = [
    ("01_6_screws", &[6], 1, 1, 1, 1, 0),
    ("02_8_screws_two_arms", &[4, 4], 2, 1, 1, 2, 1),
    ("03_12_screws_alternatives", &[4, 4, 4], 2, 1, 1, 3, 2),
    ("04_20_screws_one_face", &[20], 2, 1, 1, 4, 0),
    ("05_20_screws", &[6, 4, 4, 6], 2, 1, 1, 5, 0),
    ("06_24_screws_one_arm", &[6, 6, 6, 6], 1, 1, 1, 6, 2),
    ("07_30_screws_free", &[6, 6, 6, 6, 6], 2, 1, 1, 7, 1),
    ("08_40_screws", &[10, 6, 8, 8, 8], 2, 1, 1, 8, 0),
    ("09_12_screws_two_tables", &[6, 6], 2, 2, 2, 9, 0),
    ("10_16_screws_two_tables_one_arm", &[8, 8], 1, 2, 2, 10, 1),
];

fn problem(&(_, faces, arms, tables, units, seed, precedence): &Fixture) -> Problem {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let sides = ["front", "left", "top"];
    let mut text = String::from("product = \"fixture\"\nloaded = \"front\"\n");
    for (k, &screws) in faces.iter().enumerate() {
        let side = sides[k % sides.len()];
        let half = if side == "left" { 170.0 } else { 400.0 };
        let places: Vec<String> = (0..screws)
            .map(|_| {
                let across: f64 = rng.random_range(-half..half);
                let up: f64 = rng.random_range(180.0..870.0);
                format!("[{across:.0}, {up:.0}]")
            })
            .collect();
        let after = match precedence {
            0 if k > 0 => format!("after_covers = [\"c{}\"]\n", k - 1),
            _ => String::new(),
        };
        let places = places.join(", ");
        text.push_str(&format!(
            "[[faces]]\nname = \"f{k}\"\nside = \"{side}\"\nscrews_mm = [{places}]\n{after}"
        ));
    }
    for k in 0..faces.len() {
        let side = sides[k % sides.len()];
        let any = match precedence {
            2 if k + 1 == faces.len() && k > 1 => {
                "requires_any = [{ covers = [\"c0\"] }, { covers = [\"c1\"], faces = [\"f0\"] }]\n"
            }
            _ => "",
        };
        text.push_str(&format!(
            "[[covers]]\nname = \"c{k}\"\nside = \"{side}\"\nwidth_mm = 800\nheld_by = [\"f{k}\"]\n{any}"
        ));
    }
    let product = Product::parse(&text, "fixture.toml").expect("a product");
    Problem::new(&product, &Station::new(arms, tables).expect("a station"), units).expect("a problem")
}

/// Writes the problems for `or_tools.py`.
#[test]
#[ignore = "writes files; needed when fixtures change"]
fn write_problems() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("or_tools");
    std::fs::create_dir_all(&folder).expect("a folder");
    for fixture in &FIXTURES {
        let text = serde_json::to_string(&problem(fixture)).expect("as text");
        std::fs::write(folder.join(format!("{}.json", fixture.0)), text).expect("written");
    }
    println!("{}", folder.display());
}

#[test]
fn never_worse_than_or_tools_by_more_than_two_percent() {
    let told: serde_json::Value =
        serde_json::from_str(include_str!("fixtures/or_tools.json")).expect("the fixture file");
    for fixture in &FIXTURES {
        let problem = problem(fixture);
        let limits = Limits {
            time_s: 5.0,
            rounds: 5,
            ..Limits::default()
        };
        let plan = solve(&problem, &limits, |_| {});
        problem
            .check(&plan.placed)
            .unwrap_or_else(|e| panic!("{}: {e}", fixture.0));
        let theirs = &told["fixtures"][fixture.0];
        let theirs_s = theirs["makespan_s"].as_f64().expect("a makespan");
        println!(
            "{:32} ours {:7.2} s (bound {:7.2}, {:4.1} % to gain, {:.2} s), CP-SAT {theirs_s:7.2} s ({}, {} s)",
            fixture.0,
            plan.makespan_s,
            plan.bound_s,
            100.0 * plan.gap(),
            plan.searched_s,
            theirs["status"].as_str().unwrap_or(""),
            theirs["time_s"]
        );
        assert!(
            plan.makespan_s <= 1.02 * theirs_s,
            "{}: {} s, CP-SAT {theirs_s} s",
            fixture.0,
            plan.makespan_s
        );
        // both solve the same model: whoever proves, the other is not below (theirs is rounded up to ms)
        if theirs["status"] == "optimal" {
            assert!(plan.makespan_s >= theirs_s - 0.001 * problem.tasks.len() as f64);
        }
        assert!(plan.bound_s <= theirs_s + 1e-6);
    }
}
