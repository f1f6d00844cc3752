//! `unscrew simulate`: what a cell would do with thousands of units, under assumptions that are printed beside the figures.

use crate::Ended;
use anyhow::{Context, Result};
use cell::forecast::{Assumptions, Chance, Forecast, Interval, forecast};
use cell::journal::Journal;
use serde::Serialize;
use std::path::PathBuf;

/// Monte Carlo of a cell: completion, cycle time, operator's time, cells for a year's volume, and what to work on first.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  unscrew simulate\n  unscrew simulate --from out --click\n  unscrew simulate --print > assumptions.toml; unscrew simulate assumptions.toml"
)]
pub struct Args {
    /// Assumptions (TOML); left out, the paper's units and times and this detector's figures
    assumptions: Option<PathBuf>,
    /// Folder of a run: its own counts and times instead of assumed ones
    #[arg(long, value_name = "DIR")]
    from: Option<PathBuf>,
    /// A person looks at pictures of covers that stay, and clicks on screws
    #[arg(long)]
    click: bool,
    /// Heads that do not turn are milled
    #[arg(long)]
    mill: bool,
    /// A person takes out by hand what is left
    #[arg(long)]
    hand: bool,
    /// Units of a repetition
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    units: u32,
    /// Repetitions, each with chances drawn anew from what was counted
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    repetitions: u32,
    /// Seed of everything
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print the assumptions as a file to start from, and nothing else
    #[arg(long)]
    print: bool,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// What `--json` prints: no figure without what it rests on.
#[derive(Serialize)]
struct Printed<'a> {
    assumptions: &'a Assumptions,
    forecast: &'a Forecast,
}

pub fn run(args: &Args) -> Result<Ended> {
    let mut assumptions = match &args.assumptions {
        Some(path) => Assumptions::read(path)?,
        None => Assumptions::default(),
    };
    if let Some(folder) = &args.from {
        let records = Journal::open_read_only(folder)?.records()?;
        assumptions = assumptions
            .counted(&records)
            .with_context(|| folder.display().to_string())?;
    }
    assumptions.policy.click |= args.click;
    assumptions.policy.mill |= args.mill;
    assumptions.policy.hand |= args.hand;
    if args.print {
        print!("{}", toml::to_string(&assumptions)?);
        return Ok(Ended::Good);
    }
    let told = forecast(&assumptions, args.units as usize, args.repetitions as usize, args.seed)?;
    if args.json {
        let printed = Printed {
            assumptions: &assumptions,
            forecast: &told,
        };
        println!("{}", serde_json::to_string_pretty(&printed)?);
    } else {
        print!("{}", text(&assumptions, &told));
    }
    Ok(Ended::Good)
}

fn text(a: &Assumptions, f: &Forecast) -> String {
    let share = |i: &Interval| {
        let [mean, low, high] = [i.mean, i.low, i.high].map(|v| 100.0 * v);
        format!("{mean:5.1} %  ({low:.1} to {high:.1} %)")
    };
    let number = |i: &Interval, unit: &str| format!("{:5.1} {unit}  ({:.1} to {:.1})", i.mean, i.low, i.high);
    let chance = |c: Chance| match c {
        Chance::Known(p) => format!("{:.1} % (assumed)", 100.0 * p),
        Chance::Counted { hits, of } => format!("{:.1} % ({hits} of {of})", 100.0 * c.mean()),
    };
    let excluded: Vec<String> = a
        .unit
        .excluded
        .iter()
        .map(|(why, c)| format!("{} {}", why.replace('_', " "), chance(*c)))
        .collect();
    let help: Vec<&str> = [
        (a.policy.click, "clicks"),
        (a.policy.mill, "milling"),
        (a.policy.hand, "hands"),
    ]
    .into_iter()
    .filter_map(|(on, name)| on.then_some(name))
    .collect();
    let help = if help.is_empty() {
        "no help".into()
    } else {
        help.join(", ")
    };
    let (s, t) = (&a.screw, &a.times_s);
    let mut text = format!(
        "{} x {} units under these assumptions (95 % of the repetitions in brackets):\n\
         \x20 a unit has {:.1} screws; out of scope: {}; a cover jams: {}\n\
         \x20 a screw is found {}, later {}, seen by a person {}; out at once {}, after the ladder {}\n\
         \x20 s: handling {:.1}, inspection {:.1}, covers {:.1}, screw {:.1}, ladder {:.1}, excluded unit {:.1}, click {:.0}, hand {:.0}, mill {:.0}\n\
         \x20 policy: {help}; {:.0} units and {:.0} h a year, {:.0} % available\n\n",
        f.repetitions,
        f.units,
        a.unit.screws_mean,
        if excluded.is_empty() {
            "none".into()
        } else {
            excluded.join(", ")
        },
        chance(a.unit.cover_jams),
        chance(s.found),
        chance(s.found_later),
        chance(s.person_sees),
        chance(s.out_at_once),
        chance(s.out_after_ladder),
        t.handling,
        t.inspection,
        t.covers,
        t.screw,
        t.ladder,
        t.excluded,
        t.click,
        t.hand,
        t.mill,
        a.plant.units_a_year,
        a.plant.hours_a_year,
        100.0 * a.plant.availability,
    );
    for (name, value) in [
        ("OK in scope, unaided", share(&f.unaided_in_scope)),
        ("OK of all, unaided", share(&f.unaided_of_all)),
        ("OK of all, this policy", share(&f.ok_of_all)),
        ("mean cycle", number(&f.cycle_mean_s, "s")),
        ("operator a unit", number(&f.operator_s, "s")),
        ("cells for the volume", number(&f.cells, "")),
    ] {
        text.push_str(&format!("{name:<24}{value}\n"));
    }
    for (cause, share) in &f.causes {
        text.push_str(&format!("  {:5.1} %  {cause}\n", 100.0 * share));
    }
    text.push_str("what one perfect step would add to OK of all:\n");
    for (name, gain) in &f.gains {
        text.push_str(&format!("  {:+5.1} %  {name}\n", 100.0 * gain));
    }
    text
}
