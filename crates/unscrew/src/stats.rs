//! `unscrew stats`: what a run's journal says of rates and times.

use crate::Ended;
use crate::audit::{Actions, audit};
use anyhow::{Result, bail};
use cell::{
    digest::Digest,
    forecast::{Assumptions, Prediction, predictions},
    journal::Journal,
    statistics::{Rate, Shift, Statistics, by_shift},
};
use serde::Serialize;
use sim::{Action, ActionKind};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Rates with Wilson bounds over units in scope and over all, times by resource, causes; from the journal. In simulation, also whether
/// journal and world agree on every action.
#[derive(clap::Args)]
#[command(after_help = "Example: unscrew stats out --json")]
pub struct Args {
    /// Folder of a run (holds journal.db)
    run: PathBuf,
    /// Length of a shift, hours: with more than one, rates by shift are told too
    #[arg(long, value_name = "HOURS", default_value_t = 8.0, value_parser = shift_length)]
    shift_h: f64,
    /// Count every unit anew from its events, instead of from what was written down when it was closed
    #[arg(long)]
    recount: bool,
    /// As JSON
    #[arg(long)]
    json: bool,
}

fn shift_length(text: &str) -> Result<f64, String> {
    let hours: f64 = text.parse().map_err(|_| format!("'{text}' is no number of hours"))?;
    if (0.01..=1000.0).contains(&hours) {
        Ok(hours)
    } else {
        Err("expected 0.01 to 1000 hours".into())
    }
}

/// Units that nothing spoils of what the paper excluded units for, as the simulated world knows them: the nearest to the paper's units in scope.
#[derive(Serialize)]
struct Unspoilt {
    /// OK of them.
    ok_unspoilt: Rate,
    /// Their mean cycle, s.
    cycle_unspoilt_mean_s: Option<f64>,
}

impl Unspoilt {
    /// `None` if the world's log does not say which they are.
    fn of(units: &[Digest], world: &[Action]) -> Option<Self> {
        // the journal counts units from 1, the world from 0
        let known = world.iter().filter_map(|action| match action.kind {
            ActionKind::Loaded { spoilt, .. } => Some((action.unit? + 1, spoilt?)),
            _ => None,
        });
        let is_spoilt: BTreeMap<u64, bool> = known.collect();
        let unspoilt = units.iter().filter(|u| is_spoilt.get(&u.unit) == Some(&false));
        let statistics = Statistics::of(&unspoilt.cloned().collect::<Vec<_>>());
        (!is_spoilt.is_empty()).then_some(Self {
            ok_unspoilt: statistics.ok_of_all,
            cycle_unspoilt_mean_s: statistics.cycle_mean_s,
        })
    }
}

/// What `--json` prints.
#[derive(Serialize)]
struct Printed {
    #[serde(flatten)]
    statistics: Statistics,
    #[serde(flatten)]
    actions: Option<Actions>,
    #[serde(flatten)]
    unspoilt: Option<Unspoilt>,
    /// What its screws' scores and the units before it said of each unit in scope beforehand, beginning with the assumptions of `unscrew simulate`,
    /// and what became of it.
    predictions: Vec<Prediction>,
    /// The trend.
    shifts: Vec<Shift>,
}

pub fn run(args: &Args) -> Result<Ended> {
    let journal = Journal::open_read_only(&args.run)?;
    let world = args.run.join("world.jsonl");
    // the two logs are read side by side: each is long after a shift
    let (units, actions) = std::thread::scope(|scope| {
        let world = scope.spawn(|| world.exists().then(|| sim::read_actions(&world)).transpose());
        (journal.digests(args.recount), world.join())
    });
    let units = units?;
    let actions = match actions {
        Ok(actions) => actions?,
        Err(_) => bail!("the simulated world's log could not be read to its end; report it"),
    };
    let statistics = Statistics::of(&units);
    let unspoilt = actions.as_ref().and_then(|actions| Unspoilt::of(&units, actions));
    let actions = actions.map(|actions| audit(&units, &actions));
    let predictions = predictions(&Assumptions::default(), &units);
    let shifts = by_shift(&units, 3600.0 * args.shift_h);
    if args.json {
        let printed = Printed {
            statistics,
            actions,
            unspoilt,
            predictions,
            shifts,
        };
        println!("{}", serde_json::to_string_pretty(&printed)?);
        return Ok(Ended::Good);
    }
    print!("{}", text(&statistics));
    if shifts.len() > 1 {
        for shift in &shifts {
            println!(
                "  from {:5.1} h: {} units, {} OK of those in scope, {}",
                shift.from_s / 3600.0,
                shift.units,
                percent(&shift.ok_in_scope),
                shift
                    .cycle_mean_s
                    .map_or("no cycle".into(), |t| format!("mean cycle {t:.0} s")),
            );
        }
    }
    if !predictions.is_empty() {
        let n = predictions.len() as f64;
        let square = |p: &Prediction| (p.predicted - f64::from(u8::from(p.finished))).powi(2);
        println!(
            "predicted  {:.1} % finished unaided, each by the scores of its screws and the units before it; {} of {} were (Brier score {:.2})",
            100.0 * predictions.iter().map(|p| p.predicted).sum::<f64>() / n,
            predictions.iter().filter(|p| p.finished).count(),
            predictions.len(),
            predictions.iter().map(square).sum::<f64>() / n
        );
    }
    if let Some(unspoilt) = unspoilt {
        let cycle_s = unspoilt.cycle_unspoilt_mean_s;
        println!(
            "unspoilt   {} of units without what the paper excludes, by the world's own log; mean cycle {}",
            percent(&unspoilt.ok_unspoilt),
            cycle_s.map_or("-".into(), |s| format!("{s:.1} s")),
        );
    }
    if let Some(a) = actions {
        println!(
            "actions    {} by the world's own log; {} repeated, {} lost",
            a.actions_total, a.actions_repeated, a.actions_lost
        );
    }
    Ok(Ended::Good)
}

fn percent(r: &Rate) -> String {
    match r.rate {
        Some(p) => format!(
            "{:5.1} %  ({} of {}; 95 %: {:.1} to {:.1} %)",
            100.0 * p,
            r.hits,
            r.of,
            100.0 * r.low,
            100.0 * r.high
        ),
        None => "    -".into(),
    }
}

/// The statistics as a table for a terminal.
pub fn text(s: &Statistics) -> String {
    let rate = percent;
    let time = |t: Option<f64>| t.map_or("    -".into(), |t| format!("{t:5.1} s"));
    let mut text = format!(
        "units      {} ({} OK, {} NG, {} excluded)\nin scope   {}\nof all     {}\n  unaided  {}\n  by click {}\nscrews out {}\nmean cycle {} (OK {}, NG {})\n",
        s.units,
        s.ok,
        s.ng,
        s.excluded,
        rate(&s.ok_in_scope),
        rate(&s.ok_of_all),
        rate(&s.ok_unaided),
        rate(&s.ok_with_click),
        rate(&s.screws_removed),
        time(s.cycle_mean_s),
        time(s.cycle_ok_mean_s),
        time(s.cycle_ng_mean_s),
    );
    let t = &s.times_mean;
    text.push_str(&format!(
        "           handling {:.1}, screws {:.1}, covers {:.1}, inspection {:.1}, recovery {:.1}; waiting {:.1} s besides\n",
        t.handling_s, t.screws_s, t.covers_s, t.inspection_s, t.recovery_s, t.waiting_s
    ));
    for (cause, count) in &s.causes {
        text.push_str(&format!("  {count:3} x {}\n", cause.replace('_', " ")));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use cell::record::{Event, NgReason, Outcome, UnitRecord};

    #[test]
    fn what_the_world_has_spoilt_is_not_counted_as_the_paper_did_not() {
        let digest = |unit: u64, is_ok: bool| {
            let outcome = match is_ok {
                true => Outcome::Ok,
                false => Outcome::Ng {
                    reason: NgReason::ScrewSeized,
                    detail: String::new(),
                },
            };
            let mut record = UnitRecord::new(unit, 0.0);
            record.apply(100.0, &Event::Decided { outcome });
            record.apply(110.0, &Event::Discharged);
            Digest::of(&record)
        };
        let units = [digest(1, true), digest(2, false), digest(3, false), digest(4, true)];
        let loaded = |unit: u64, spoilt: Option<bool>| Action {
            t_s: 0.0,
            unit: Some(unit),
            kind: ActionKind::Loaded { seed: unit, spoilt },
        };
        let world = [
            loaded(0, Some(false)),
            loaded(1, Some(true)),
            loaded(2, Some(false)),
            loaded(3, None),
        ];
        let rate = Unspoilt::of(&units, &world).expect("known").ok_unspoilt;
        assert_eq!((rate.hits, rate.of), (1, 2));
        assert!(Unspoilt::of(&units, &[loaded(0, None)]).is_none(), "a log of before");
    }
}
