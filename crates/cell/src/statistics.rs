//! Rates with their bounds, and times by resource: what a number of units says.

use crate::digest::Digest;
use crate::record::{Assist, Method, Outcome, Times, UnitRecord};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

pub use geometry::{Rate, wilson};

/// What a number of units says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Statistics {
    /// Finished units.
    pub units: usize,
    /// Taken apart.
    pub ok: usize,
    /// Begun, not finished.
    pub ng: usize,
    /// Out of scope.
    pub excluded: usize,
    /// Of the excluded, those of which a screw of another face had been taken out before.
    pub excluded_after_acting: usize,
    /// OK of those in scope (paper: 78.3 %).
    pub ok_in_scope: Rate,
    /// OK of all (paper: 60.0 %).
    pub ok_of_all: Rate,
    /// Of all: OK without a person and without a milled head.
    pub ok_unaided: Rate,
    /// Of all: OK without a milled head, with no more than a person's clicks in pictures.
    pub ok_with_click: Rate,
    /// Mean cycle over OK and NG units, as the paper counts it, s (paper: 193, its parts 195.7).
    pub cycle_mean_s: Option<f64>,
    /// Mean cycle of OK units, s (paper: 197).
    pub cycle_ok_mean_s: Option<f64>,
    /// Mean cycle of NG units, s (paper: 191).
    pub cycle_ng_mean_s: Option<f64>,
    /// Mean times by resource over OK and NG units, s.
    pub times_mean: Times,
    /// Screws that were acted on.
    pub screws_attempted: usize,
    /// Of these out, as far as driver and camera say.
    pub screws_removed: Rate,
    /// Of these, with more than one burst.
    pub screws_retried: usize,
    /// Units by reason: `ng: screw_seized`, `excluded: cover_bent`.
    pub causes: BTreeMap<String, usize>,
}

impl Statistics {
    /// Over finished units; those under way are left out.
    pub fn over(records: &[UnitRecord]) -> Self {
        Self::of(&records.iter().map(Digest::of).collect::<Vec<_>>())
    }

    /// The same over units as they are counted.
    pub fn of(records: &[Digest]) -> Self {
        let mut causes = BTreeMap::new();
        let (mut ok, mut ng, mut excluded, mut after) = (Vec::new(), Vec::new(), 0, 0);
        let (mut attempted, mut removed, mut retried) = (0, 0, 0);
        for record in records {
            let Some(outcome) = &record.outcome else { continue };
            attempted += record.attempted;
            removed += record.removed;
            retried += record.retried;
            let cause = match outcome {
                Outcome::Ok => {
                    ok.push(record);
                    continue;
                }
                Outcome::Ng { reason, .. } => {
                    ng.push(record);
                    format!("ng: {}", word(reason))
                }
                Outcome::Excluded {
                    reason,
                    screws_out_before,
                    ..
                } => {
                    excluded += 1;
                    after += usize::from(*screws_out_before > 0);
                    format!("excluded: {}", word(reason))
                }
            };
            *causes.entry(cause).or_default() += 1;
        }
        let whole: Vec<Assist> = ok
            .iter()
            .filter(|r| r.method == Method::NonDestructive)
            .map(|r| r.assist)
            .collect();
        let with = |most: Assist| whole.iter().filter(|assist| **assist <= most).count();
        let in_scope: Vec<&Digest> = ok.iter().chain(&ng).copied().collect();
        let units = in_scope.len() + excluded;
        let mut times_mean = Times::default();
        for record in &in_scope {
            let share = 1.0 / in_scope.len() as f64;
            times_mean.handling_s += share * record.times.handling_s;
            times_mean.screws_s += share * record.times.screws_s;
            times_mean.covers_s += share * record.times.covers_s;
            times_mean.inspection_s += share * record.times.inspection_s;
            times_mean.waiting_s += share * record.times.waiting_s;
            times_mean.recovery_s += share * record.times.recovery_s;
        }
        Self {
            units,
            ok: ok.len(),
            ng: ng.len(),
            excluded,
            excluded_after_acting: after,
            ok_in_scope: Rate::of(ok.len(), in_scope.len()),
            ok_of_all: Rate::of(ok.len(), units),
            ok_unaided: Rate::of(with(Assist::None), units),
            ok_with_click: Rate::of(with(Assist::Remote), units),
            cycle_mean_s: mean_cycle_s(&in_scope),
            cycle_ok_mean_s: mean_cycle_s(&ok),
            cycle_ng_mean_s: mean_cycle_s(&ng),
            times_mean,
            screws_attempted: attempted,
            screws_removed: Rate::of(removed, attempted),
            screws_retried: retried,
            causes,
        }
    }
}

/// What one shift's units say.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shift {
    /// When it began, cell clock, s.
    pub from_s: f64,
    /// Finished units.
    pub units: usize,
    /// OK of those in scope.
    pub ok_in_scope: Rate,
    /// OK of all.
    pub ok_of_all: Rate,
    /// Mean cycle over OK and NG units, s.
    pub cycle_mean_s: Option<f64>,
}

/// The trend: units by the shift in which they were begun. Shifts without a unit are left out.
///
/// # Arguments
/// * `shift_s` – length of a shift, s; more than 0.
pub fn by_shift(records: &[Digest], shift_s: f64) -> Vec<Shift> {
    let mut shifts: BTreeMap<u64, Vec<Digest>> = BTreeMap::new();
    for record in records.iter().filter(|r| r.outcome.is_some()) {
        let shift = (record.started_s.max(0.0) / shift_s.max(1e-9)) as u64;
        shifts.entry(shift).or_default().push(record.clone());
    }
    let of = |(shift, records): (u64, Vec<Digest>)| {
        let s = Statistics::of(&records);
        Shift {
            from_s: shift as f64 * shift_s,
            units: s.units,
            ok_in_scope: s.ok_in_scope,
            ok_of_all: s.ok_of_all,
            cycle_mean_s: s.cycle_mean_s,
        }
    };
    shifts.into_iter().map(of).collect()
}

fn mean_cycle_s(records: &[&Digest]) -> Option<f64> {
    (!records.is_empty()).then(|| records.iter().map(|r| r.times.cycle_s()).sum::<f64>() / records.len() as f64)
}

/// The snake-case name of a reason, as in the files.
fn word(reason: &impl Serialize) -> String {
    match serde_json::to_value(reason) {
        Ok(serde_json::Value::String(word)) => word,
        _ => "unknown".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::{ExclusionReason, NgReason};

    #[test]
    fn excluded_units_count_in_one_rate_and_not_in_the_other() {
        let unit = |n: u64, outcome, cycle_s| {
            let mut record = UnitRecord::new(n, 0.0);
            record.outcome = outcome;
            record.times.screws_s = cycle_s;
            record
        };
        let ng = Outcome::Ng {
            reason: NgReason::ScrewSeized,
            detail: String::new(),
        };
        let excluded = Outcome::Excluded {
            reason: ExclusionReason::CoverBent,
            detail: String::new(),
            screws_out_before: 3,
        };
        let milled = UnitRecord {
            assist: Assist::Remote,
            method: Method::Destructive,
            ..unit(2, Some(Outcome::Ok), 180.0)
        };
        let records = [
            unit(1, Some(Outcome::Ok), 200.0),
            milled,
            unit(3, Some(ng), 100.0),
            unit(4, Some(excluded), 20.0),
            unit(5, None, 0.0),
        ];
        let s = Statistics::over(&records);
        assert_eq!(
            (s.units, s.ok, s.ng, s.excluded, s.excluded_after_acting),
            (4, 2, 1, 1, 1)
        );
        assert_eq!(s.ok_in_scope.rate, Some(2.0 / 3.0));
        assert_eq!(s.ok_of_all.rate, Some(0.5));
        assert_eq!((s.ok_unaided.hits, s.ok_with_click.hits, s.ok_with_click.of), (1, 1, 4));
        assert_eq!((s.cycle_mean_s, s.cycle_ok_mean_s), (Some(160.0), Some(190.0)));
        assert!((s.times_mean.screws_s - 160.0).abs() < 1e-9);
        assert_eq!(s.causes["ng: screw_seized"], 1);
        assert_eq!(s.causes["excluded: cover_bent"], 1);
    }
    #[test]
    fn shifts_are_told_apart_by_when_a_unit_was_begun() {
        let begun = |n: u64, at_s: f64, outcome| UnitRecord {
            outcome,
            ..UnitRecord::new(n, at_s)
        };
        let ng = Outcome::Ng {
            reason: NgReason::CoverStuck,
            detail: String::new(),
        };
        let hour = 3600.0;
        let records = [
            begun(1, 0.0, Some(Outcome::Ok)),
            begun(2, 7.9 * hour, Some(ng)),
            begun(3, 17.0 * hour, Some(Outcome::Ok)),
            begun(4, 17.5 * hour, None),
        ];
        let digests: Vec<Digest> = records.iter().map(Digest::of).collect();
        let shifts = by_shift(&digests, 8.0 * hour);
        assert_eq!(
            shifts.iter().map(|s| (s.from_s / hour, s.units)).collect::<Vec<_>>(),
            [(0.0, 2), (16.0, 1)]
        );
        assert_eq!(shifts[0].ok_of_all.rate, Some(0.5));
    }
}
