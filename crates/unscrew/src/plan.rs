//! `unscrew plan`: who does what when for a product, on one or two arms and one or two tables; with a bound, and as a chart.

use crate::{Ended, gantt};
use anyhow::{Context, Result};
use cell::schedule::{Kind, Limits, Plan, Problem, Product, Station, solve};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// Schedule for a product description: screws, covers, pictures and handling over arms and tables, with a lower bound of any schedule.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  unscrew plan --arms 2 --gantt plan.html\n  unscrew plan crates/cell/products/outdoor_unit_cad.toml --arms 2 --tables 2 --json\n\nA product is a TOML or JSON file with [[faces]] and [[covers]]; crates/cell/products holds examples."
)]
pub struct Args {
    /// Product description (TOML or JSON); left out, an outdoor unit with the paper's precedence
    product: Option<PathBuf>,
    /// Arms
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=2))]
    arms: u8,
    /// Tables
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=2))]
    tables: u8,
    /// Units to plan together; left out, one a table
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=6))]
    units: Option<u8>,
    /// Longest time to look for a better plan, s
    #[arg(long, default_value_t = 10.0, value_name = "S")]
    time_limit_s: f64,
    /// Seed of the local search
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Exit code 3 if the plan is further above its bound, %
    #[arg(long, value_name = "PERCENT")]
    gap_max: Option<f64>,
    /// Draw the plan into this page
    #[arg(long, value_name = "FILE.html")]
    gantt: Option<PathBuf>,
    /// As JSON, with the whole problem
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Printed<'a> {
    #[serde(flatten)]
    plan: &'a Plan,
    /// How far the plan may be above the best, as a part of the bound.
    gap: f64,
    /// Time a unit, s.
    cycle_s: f64,
    /// Time of the first plan within 10 % of the final bound, s; tours of the faces included.
    within_tenth_after_s: Option<f64>,
    steps: Vec<Step<'a>>,
    problem: &'a Problem,
}

/// A task of the plan, in words.
#[derive(Serialize)]
struct Step<'a> {
    name: &'a str,
    kind: Kind,
    table: usize,
    arms: Vec<&'a str>,
    start_s: f64,
    end_s: f64,
    /// Screws by arm, in their order.
    screws: Vec<Vec<usize>>,
}

pub fn run(args: &Args) -> Result<Ended> {
    let product = match &args.product {
        Some(path) => Product::read(path)?,
        None => Product::outdoor_unit()?,
    };
    let began = Instant::now();
    let station = Station::new(args.arms.into(), args.tables.into())?;
    let units = args.units.unwrap_or(args.tables);
    let problem = Problem::new(&product, &station, units.into())?;
    let set_up_s = began.elapsed().as_secs_f64();
    let limits = Limits {
        time_s: args.time_limit_s,
        seed: args.seed,
        ..Limits::default()
    };
    let mut history: Vec<(f64, f64)> = Vec::new();
    let plan = solve(&problem, &limits, |better| {
        history.push((set_up_s + better.found_after_s, better.makespan_s));
    });
    problem
        .check(&plan.placed)
        .context("the plan breaks a rule: this is a mistake of the planner, please report it with the product file")?;
    let within = history
        .iter()
        .find(|(_, makespan_s)| *makespan_s <= 1.1 * plan.bound_s)
        .map(|(after_s, _)| *after_s);
    let cycle_s = plan.makespan_s / f64::from(units);
    if let Some(path) = &args.gantt {
        let page = gantt::page(&problem, &plan)?;
        std::fs::write(path, page).with_context(|| format!("cannot write {}; give another --gantt", path.display()))?;
    }
    if args.json {
        let printed = Printed {
            plan: &plan,
            gap: plan.gap(),
            cycle_s,
            within_tenth_after_s: within,
            steps: steps(&problem, &plan),
            problem: &problem,
        };
        println!("{}", serde_json::to_string_pretty(&printed)?);
    } else {
        print!("{}", text(&problem, &plan));
        println!("{}", summary(&problem, &plan));
        if let Some(after_s) = within {
            println!(
                "first plan within 10 % of the bound after {after_s:.2} s, this one after {:.2} s, {:.1} s searched",
                set_up_s + plan.found_after_s,
                set_up_s + plan.searched_s
            );
        }
    }
    let is_wide = args.gap_max.is_some_and(|percent| 100.0 * plan.gap() > percent);
    Ok(if is_wide { Ended::NotGoodEnough } else { Ended::Good })
}

/// One line on how good the plan is.
pub fn summary(problem: &Problem, plan: &Plan) -> String {
    let units = problem.tasks.iter().filter(|t| t.kind == Kind::Load).count();
    let each = if units > 1 {
        format!(" ({:.1} s a unit)", plan.makespan_s / units as f64)
    } else {
        String::new()
    };
    let best = if plan.is_best {
        "; no better one of these ways"
    } else {
        ""
    };
    format!(
        "{} screw(s), {} arm(s), {} table(s), {units} unit(s): {:.1} s{each}; no plan is below {:.1} s, so at most {:.1} % to gain{best}",
        problem.product.screws() * units,
        problem.station.arms.len(),
        problem.station.tables_y_mm.len(),
        plan.makespan_s,
        plan.bound_s,
        100.0 * plan.gap(),
    )
}

fn steps<'a>(problem: &'a Problem, plan: &Plan) -> Vec<Step<'a>> {
    let arms = &problem.station.arms;
    let step = |placed: &cell::schedule::Placed| {
        let task = &problem.tasks[placed.task];
        let mode = &task.modes[placed.mode];
        let used: Vec<usize> = (0..arms.len()).filter(|&a| mode.arms[a].is_some()).collect();
        let screws = |arm: &usize| mode.stops.iter().filter(|s| s.arm == *arm).map(|s| s.screw).collect();
        Step {
            name: &task.name,
            kind: task.kind,
            table: task.table,
            arms: used.iter().map(|&a| arms[a].name.as_str()).collect(),
            start_s: placed.start_s,
            end_s: placed.start_s + mode.end_s(),
            screws: used.iter().map(screws).collect(),
        }
    };
    plan.placed.iter().map(step).collect()
}

fn text(problem: &Problem, plan: &Plan) -> String {
    let mut text = String::from("  begin     end  task                        by\n");
    for step in steps(problem, plan) {
        let by: Vec<String> = step
            .arms
            .iter()
            .zip(&step.screws)
            .map(|(arm, screws)| match screws.len() {
                0 => (*arm).into(),
                n => format!("{arm} ({n})"),
            })
            .collect();
        text.push_str(&format!(
            "{:7.1} {:7.1}  {:<27} {}\n",
            step.start_s,
            step.end_s,
            step.name,
            by.join(", ")
        ));
    }
    text
}
