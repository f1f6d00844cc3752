//! What a cell would do with thousands of units: Monte Carlo of its policy under stated assumptions, or under a journal's own counts.
//!
//! A forecast is a claim about its assumptions. Where a chance was counted, each repetition of the whole forecast draws it anew from what
//! the counts leave open (Beta, Jeffreys), so that the interval around a result holds what is not known beside what is chance.

use crate::device::DriveEnd;
use crate::digest::Digest;
use crate::record::{NgReason, Outcome, UnitRecord};
use rand::{RngExt, SeedableRng};
use rand_distr::{Beta, Distribution, Poisson};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Assumptions that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ForecastError {
    /// The file cannot be read.
    #[error(
        "cannot read {path}: {source}; check the path, or print a file to start from with `unscrew simulate --print`"
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// It is not of this form.
    #[error("{path}: {reason}; `unscrew simulate --print` shows every key")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A number that means nothing.
    #[error("{key} is {value}; expected {expected}")]
    OutOfRange {
        /// Where in the assumptions.
        key: String,
        /// What stands there.
        value: f64,
        /// What could.
        expected: &'static str,
    },
    /// A journal without anything to count.
    #[error(
        "the journal holds {units} units in scope with {screws} screws; a forecast needs at least one of each: run some units first"
    )]
    TooLittle {
        /// Units in scope.
        units: usize,
        /// Screws that were acted on.
        screws: usize,
    },
}

/// A probability: known, or counted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Chance {
    /// Taken as it is.
    Known(f64),
    /// So many of so many.
    Counted {
        /// Times that it happened.
        hits: usize,
        /// Times that it could have.
        of: usize,
    },
}

impl Chance {
    /// Its best estimate.
    pub fn mean(self) -> f64 {
        match self {
            Chance::Known(p) => p,
            Chance::Counted { hits, of } => (hits as f64 + 0.5) / (of as f64 + 1.0),
        }
    }

    /// What it may be.
    fn drawn(self, rng: &mut Pcg64Mcg) -> f64 {
        match self {
            Chance::Known(p) => p,
            // both parameters are positive: this cannot fail
            Chance::Counted { hits, of } => Beta::new(hits as f64 + 0.5, (of - hits.min(of)) as f64 + 0.5)
                .map_or_else(|_| self.mean(), |beta| beta.sample(rng)),
        }
    }
}

/// Everything that a forecast rests on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Assumptions {
    /// The units that come.
    pub unit: UnitAssumptions,
    /// What happens to a screw.
    pub screw: ScrewAssumptions,
    /// How long things take.
    pub times_s: TimeAssumptions,
    /// What is done about what the cell cannot do.
    pub policy: Policy,
    /// The plant.
    pub plant: Plant,
}

/// The units that come.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UnitAssumptions {
    /// Screws on a unit, mean.
    pub screws_mean: f64,
    /// Units that are out of scope, by cause.
    pub excluded: BTreeMap<String, Chance>,
    /// A cover stays though no screw holds it.
    pub cover_jams: Chance,
}

/// What happens to a screw.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScrewAssumptions {
    /// Called a screw at the first look.
    pub found: Chance,
    /// Called a screw or left in doubt at the first look: what is in doubt is driven at when its cover stays.
    #[serde(default = "seen")]
    pub seen: Chance,
    /// Of those that were not: found when the cover that it holds stays.
    pub found_later: Chance,
    /// Of those that were not: seen at all, so that a person who looks at the picture would say that it is one.
    pub person_sees: Chance,
    /// Out at the first burst.
    pub out_at_once: Chance,
    /// Of those that were not: out after the cell's own ladder (harder, look again, search).
    pub out_after_ladder: Chance,
}

/// This detector's on its own rendered faces.
fn seen() -> Chance {
    Chance::Counted { hits: 700, of: 706 }
}

/// How long things take, s.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeAssumptions {
    /// Loading, turning, discharging, a unit.
    pub handling: f64,
    /// Pictures, a unit.
    pub inspection: f64,
    /// Covers, a unit.
    pub covers: f64,
    /// A screw that comes out at once.
    pub screw: f64,
    /// The ladder of a screw that does not.
    pub ladder: f64,
    /// Looking for missed screws when a cover stays.
    pub look_for_missed: f64,
    /// A unit that is excluded.
    pub excluded: f64,
    /// A person's click on a picture.
    pub click: f64,
    /// A person's hand on a screw or a cover, the way to the cell included.
    pub hand: f64,
    /// Milling one head.
    pub mill: f64,
}

/// What is done about what the cell cannot do by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Policy {
    /// A person looks at pictures of stuck covers and clicks on screws.
    pub click: bool,
    /// Heads that do not turn are milled, where the plant's controller permits it.
    pub mill: bool,
    /// A person takes out by hand what is left.
    pub hand: bool,
}

/// The plant.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plant {
    /// Units a year.
    pub units_a_year: f64,
    /// Hours a year that a cell could work.
    pub hours_a_year: f64,
    /// Share of them in which it does.
    pub availability: f64,
}

impl Default for Assumptions {
    /// The paper's units and times, this project's detector on its own rendered faces, and no help.
    fn default() -> Self {
        Self {
            unit: UnitAssumptions {
                screws_mean: 22.0,
                excluded: BTreeMap::from([("out_of_scope".into(), Chance::Counted { hits: 28, of: 120 })]),
                cover_jams: Chance::Known(0.005),
            },
            screw: ScrewAssumptions {
                found: Chance::Counted { hits: 692, of: 706 },
                seen: seen(),
                found_later: Chance::Known(0.5),
                person_sees: Chance::Known(0.9),
                out_at_once: Chance::Known(0.96),
                out_after_ladder: Chance::Known(0.6),
            },
            times_s: TimeAssumptions {
                handling: 35.0,
                inspection: 12.0,
                covers: 40.0,
                screw: 4.5,
                ladder: 9.0,
                look_for_missed: 8.0,
                excluded: 25.0,
                click: 15.0,
                hand: 90.0,
                mill: 30.0,
            },
            policy: Policy {
                click: false,
                mill: false,
                hand: false,
            },
            plant: Plant {
                units_a_year: 100_000.0,
                hours_a_year: 4_000.0,
                availability: 0.85,
            },
        }
    }
}

impl Assumptions {
    /// Reads a TOML file with every key.
    ///
    /// # Errors
    /// [`ForecastError`] that names the file or the key.
    pub fn read(path: &Path) -> Result<Self, ForecastError> {
        let text = std::fs::read_to_string(path).map_err(|source| ForecastError::Read {
            path: path.into(),
            source,
        })?;
        let read: Self = toml::from_str(&text).map_err(|e| ForecastError::Format {
            path: path.into(),
            reason: e.message().to_owned(),
        })?;
        read.check()?;
        Ok(read)
    }

    /// With the chances and times that a journal's units had, and the rest of these assumptions.
    ///
    /// Chances that the journal says nothing of (a person's) stay as they are.
    ///
    /// # Errors
    /// [`ForecastError::TooLittle`].
    pub fn counted(mut self, records: &[UnitRecord]) -> Result<Self, ForecastError> {
        let finished: Vec<(&UnitRecord, &Outcome)> =
            records.iter().filter_map(|r| Some((r, r.outcome.as_ref()?))).collect();
        let in_scope: Vec<&UnitRecord> = finished
            .iter()
            .filter(|(_, o)| !matches!(o, Outcome::Excluded { .. }))
            .map(|(r, _)| *r)
            .collect();
        let attempts = || in_scope.iter().flat_map(|r| r.attempts());
        let left = finished.iter().map(|(_, outcome)| left_in(outcome));
        let (stayed, not_found) = left.fold((0, 0), |sum, left| (sum.0 + left.0, sum.1 + left.1));
        let screws = attempts().filter(|a| a.removed()).count() + stayed;
        if in_scope.is_empty() || screws == 0 {
            return Err(ForecastError::TooLittle {
                units: in_scope.len(),
                screws,
            });
        }
        let units = in_scope.len() as f64;
        let mut excluded: BTreeMap<String, usize> = BTreeMap::new();
        for (_, outcome) in &finished {
            if let Outcome::Excluded { reason, .. } = outcome {
                *excluded.entry(format!("{reason:?}")).or_default() += 1;
            }
        }
        let of = finished.len();
        self.unit.excluded = excluded
            .into_iter()
            .map(|(why, hits)| (why, Chance::Counted { hits, of }))
            .collect();
        self.unit.screws_mean = screws as f64 / units;
        let later: usize = in_scope.iter().map(|r| r.found_later()).sum();
        self.screw.found = Chance::Counted {
            hits: screws - later,
            of: screws + not_found,
        };
        self.screw.found_later = Chance::Counted {
            hits: later,
            of: later + not_found,
        };
        let at_once = attempts()
            .filter(|a| a.removed() && a.bursts.first().and_then(|b| b.end) == Some(DriveEnd::Removed))
            .count();
        let after = attempts().filter(|a| a.removed()).count() - at_once;
        self.screw.out_at_once = Chance::Counted {
            hits: at_once,
            of: screws,
        };
        self.screw.out_after_ladder = Chance::Counted {
            hits: after,
            of: screws - at_once,
        };
        let mean = |of: &dyn Fn(&UnitRecord) -> f64| in_scope.iter().map(|r| of(r)).sum::<f64>() / units;
        self.times_s.handling = mean(&|r| r.times.handling_s);
        self.times_s.inspection = mean(&|r| r.times.inspection_s);
        self.times_s.covers = mean(&|r| r.times.covers_s);
        self.times_s.screw = mean(&|r| r.times.screws_s) * units / screws as f64;
        let recoveries = (screws - at_once + not_found).max(1) as f64;
        self.times_s.ladder = mean(&|r| r.times.recovery_s) * units / recoveries;
        self.times_s.look_for_missed = self.times_s.ladder;
        let out: Vec<f64> = finished
            .iter()
            .filter(|(_, o)| matches!(o, Outcome::Excluded { .. }))
            .map(|(r, _)| r.times.cycle_s())
            .collect();
        if !out.is_empty() {
            self.times_s.excluded = out.iter().sum::<f64>() / out.len() as f64;
        }
        Ok(self)
    }

    fn check(&self) -> Result<(), ForecastError> {
        let s = &self.screw;
        let chances = [
            ("unit.cover_jams", self.unit.cover_jams),
            ("screw.found", s.found),
            ("screw.seen", s.seen),
            ("screw.found_later", s.found_later),
            ("screw.person_sees", s.person_sees),
            ("screw.out_at_once", s.out_at_once),
            ("screw.out_after_ladder", s.out_after_ladder),
        ];
        let excluded = self
            .unit
            .excluded
            .iter()
            .map(|(k, c)| (format!("unit.excluded.{k}"), *c));
        for (key, chance) in chances.into_iter().map(|(k, c)| (k.to_owned(), c)).chain(excluded) {
            let good = match chance {
                Chance::Known(p) => (0.0..=1.0).contains(&p),
                Chance::Counted { hits, of } => hits <= of,
            };
            if !good {
                return Err(ForecastError::OutOfRange {
                    key,
                    value: chance.mean(),
                    expected: "a probability, 0 to 1, or hits that are no more than of",
                });
            }
        }
        let all: f64 = self.unit.excluded.values().map(|c| c.mean()).sum();
        let t = &self.times_s;
        let bounded = [
            ("sum of unit.excluded", all, 0.0, 1.0, "at most 1"),
            (
                "unit.screws_mean",
                self.unit.screws_mean,
                1e-9,
                1000.0,
                "more than 0, at most 1000",
            ),
            (
                "plant.availability",
                self.plant.availability,
                1e-9,
                1.0,
                "more than 0, at most 1",
            ),
            (
                "plant.hours_a_year",
                self.plant.hours_a_year,
                1e-9,
                8784.0,
                "more than 0, at most 8784",
            ),
            (
                "plant.units_a_year",
                self.plant.units_a_year,
                0.0,
                1e12,
                "a number of units",
            ),
            ("times_s.handling", t.handling, 0.0, 1e6, "seconds"),
            ("times_s.inspection", t.inspection, 0.0, 1e6, "seconds"),
            ("times_s.covers", t.covers, 0.0, 1e6, "seconds"),
            ("times_s.screw", t.screw, 0.0, 1e6, "seconds"),
            ("times_s.ladder", t.ladder, 0.0, 1e6, "seconds"),
            ("times_s.look_for_missed", t.look_for_missed, 0.0, 1e6, "seconds"),
            ("times_s.excluded", t.excluded, 0.0, 1e6, "seconds"),
            ("times_s.click", t.click, 0.0, 1e6, "seconds"),
            ("times_s.hand", t.hand, 0.0, 1e6, "seconds"),
            ("times_s.mill", t.mill, 0.0, 1e6, "seconds"),
        ];
        for (key, value, low, high, expected) in bounded {
            if !(low..=high).contains(&value) {
                return Err(ForecastError::OutOfRange {
                    key: key.into(),
                    value,
                    expected,
                });
            }
        }
        Ok(())
    }
}

/// A figure with the interval in which it lies in 95 % of the repetitions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Over all repetitions.
    pub mean: f64,
    /// 2.5 % are below.
    pub low: f64,
    /// 2.5 % are above.
    pub high: f64,
}

impl Interval {
    fn of(mut values: Vec<f64>) -> Self {
        values.retain(|v| v.is_finite());
        values.sort_by(f64::total_cmp);
        let at = |share: f64| {
            let last = values.len().saturating_sub(1);
            values
                .get((share * last as f64).round() as usize)
                .copied()
                .unwrap_or(f64::NAN)
        };
        Self {
            mean: values.iter().sum::<f64>() / values.len() as f64,
            low: at(0.025),
            high: at(0.975),
        }
    }
}

/// What became of the units of one forecast.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Units of a repetition, and repetitions.
    pub units: usize,
    /// Repetitions, each with chances drawn anew where they were counted.
    pub repetitions: usize,
    /// OK of those in scope, by the cell alone and without damage.
    pub unaided_in_scope: Interval,
    /// OK of all, by the cell alone and without damage.
    pub unaided_of_all: Interval,
    /// OK of all under the policy: with clicks, milling and hands where it has them.
    pub ok_of_all: Interval,
    /// Mean cycle over units in scope, s.
    pub cycle_mean_s: Interval,
    /// Operator's time a unit that came in, s.
    pub operator_s: Interval,
    /// Cells for the plant's volume.
    pub cells: Interval,
    /// Share of all units that failed or needed help, by what came first.
    pub causes: BTreeMap<String, f64>,
    /// How much `ok_of_all` would gain if one chance were perfect: what to work on first.
    pub gains: Vec<(String, f64)>,
}

/// The chances of one repetition.
#[derive(Clone)]
struct Drawn {
    excluded: f64,
    cover_jams: f64,
    found: f64,
    found_later: f64,
    person_sees: f64,
    out_at_once: f64,
    out_after_ladder: f64,
}

/// Sums over the units of one repetition.
#[derive(Default)]
struct Sums {
    in_scope: usize,
    unaided: usize,
    ok: usize,
    cycle_s: f64,
    excluded_s: f64,
    operator_s: f64,
    causes: BTreeMap<&'static str, usize>,
}

/// What would be perfect, and how.
type Perfect = (&'static str, fn(&mut Drawn));

/// Lets `repetitions` times `units` units come to the cell.
///
/// # Errors
/// [`ForecastError::OutOfRange`].
pub fn forecast(a: &Assumptions, units: usize, repetitions: usize, seed: u64) -> Result<Forecast, ForecastError> {
    a.check()?;
    let (units, repetitions) = (units.max(1), repetitions.max(1));
    let drawn: Vec<Drawn> = (0..repetitions as u64)
        .map(|r| {
            draw(
                a,
                &mut Pcg64Mcg::seed_from_u64(seed ^ r.wrapping_mul(0x9E37_79B9_7F4A_7C15)),
            )
        })
        .collect();
    let run = |change: &dyn Fn(&mut Drawn)| -> Vec<Sums> {
        drawn
            .iter()
            .enumerate()
            .map(|(r, drawn)| {
                let mut drawn = drawn.clone();
                change(&mut drawn);
                // the same luck for every change: what differs is what was changed
                let mut rng = Pcg64Mcg::seed_from_u64(seed.wrapping_add(r as u64).wrapping_mul(0xD134_2543_DE82_EF95));
                let mut sums = Sums::default();
                for _ in 0..units {
                    unit(a, &drawn, &mut rng, &mut sums);
                }
                sums
            })
            .collect()
    };
    let sums = run(&|_| {});
    let interval = |of: &dyn Fn(&Sums) -> f64| Interval::of(sums.iter().map(of).collect());
    let n = units as f64;
    let mut causes: BTreeMap<String, f64> = BTreeMap::new();
    for (cause, count) in sums.iter().flat_map(|s| &s.causes) {
        *causes.entry((*cause).into()).or_default() += *count as f64 / (n * repetitions as f64);
    }
    let ok = |sums: &[Sums]| sums.iter().map(|s| s.ok as f64).sum::<f64>() / (n * repetitions as f64);
    let now = ok(&sums);
    let perfect: [Perfect; 5] = [
        ("nothing out of scope", |d| d.excluded = 0.0),
        ("every screw found at the first look", |d| d.found = 1.0),
        ("every screw out at the first burst", |d| d.out_at_once = 1.0),
        ("every screw out after the ladder", |d| d.out_after_ladder = 1.0),
        ("no cover jams", |d| d.cover_jams = 0.0),
    ];
    let mut gains: Vec<(String, f64)> = perfect
        .into_iter()
        .map(|(name, change)| (name.to_owned(), ok(&run(&change)) - now))
        .collect();
    gains.sort_by(|x, y| y.1.total_cmp(&x.1));
    let seconds = 3600.0 * a.plant.hours_a_year * a.plant.availability;
    Ok(Forecast {
        units,
        repetitions,
        unaided_in_scope: interval(&|s| s.unaided as f64 / s.in_scope as f64),
        unaided_of_all: interval(&|s| s.unaided as f64 / n),
        ok_of_all: interval(&|s| s.ok as f64 / n),
        cycle_mean_s: interval(&|s| s.cycle_s / s.in_scope as f64),
        operator_s: interval(&|s| s.operator_s / n),
        cells: interval(&|s| a.plant.units_a_year * (s.cycle_s + s.excluded_s) / n / seconds),
        causes,
        gains,
    })
}

fn draw(a: &Assumptions, rng: &mut Pcg64Mcg) -> Drawn {
    Drawn {
        excluded: a.unit.excluded.values().map(|c| c.drawn(rng)).sum::<f64>().min(1.0),
        cover_jams: a.unit.cover_jams.drawn(rng),
        found: a.screw.found.drawn(rng),
        found_later: a.screw.found_later.drawn(rng),
        person_sees: a.screw.person_sees.drawn(rng),
        out_at_once: a.screw.out_at_once.drawn(rng),
        out_after_ladder: a.screw.out_after_ladder.drawn(rng),
    }
}

/// One unit's way. The same number of random numbers is drawn whatever happens, so that two forecasts can be compared.
fn unit(a: &Assumptions, d: &Drawn, rng: &mut Pcg64Mcg, sums: &mut Sums) {
    let t = &a.times_s;
    let mut chance = |p: f64| rng.random::<f64>() < p;
    let (excluded, jams) = (chance(d.excluded), chance(d.cover_jams));
    // a mean above 0 was checked
    let screws = Poisson::new(a.unit.screws_mean).map_or(a.unit.screws_mean, |p| p.sample(rng)) as usize;
    let (mut out_time_s, mut unseen, mut clicked, mut stuck) = (0.0, 0, 0, 0);
    let mut looked = false;
    for _ in 0..screws {
        let luck: [f64; 5] = std::array::from_fn(|_| rng.random());
        let mut found = luck[0] < d.found;
        if !found {
            looked = true;
            found = luck[1] < d.found_later;
        }
        if !found && luck[2] < d.person_sees {
            // found for whoever clicks
            clicked += 1;
            found = a.policy.click;
        }
        if !found {
            unseen += 1;
            continue;
        }
        out_time_s += t.screw;
        if luck[3] >= d.out_at_once {
            out_time_s += t.ladder;
            stuck += usize::from(luck[4] >= d.out_after_ladder);
        }
    }
    if excluded {
        sums.excluded_s += t.excluded;
        *sums.causes.entry("out of scope").or_default() += 1;
        return;
    }
    sums.in_scope += 1;
    let mut cycle_s = t.handling + t.inspection + t.covers + out_time_s;
    if looked {
        cycle_s += t.look_for_missed;
    }
    let mut operator_s = 0.0;
    if a.policy.click && clicked > 0 {
        cycle_s += t.click * clicked as f64;
        operator_s += t.click * clicked as f64;
    }
    let cause = match (unseen > 0 || clicked > 0, stuck > 0, jams) {
        (true, ..) => Some("screw not found"),
        (_, true, _) => Some("screw does not come out"),
        (.., true) => Some("cover jams"),
        _ => None,
    };
    if let Some(cause) = cause {
        *sums.causes.entry(cause).or_default() += 1;
    } else {
        sums.unaided += 1;
    }
    let mut left = unseen + stuck + usize::from(jams);
    if a.policy.mill {
        cycle_s += t.mill * stuck as f64;
        left -= stuck;
    }
    if a.policy.hand && left > 0 {
        // a person at the table sees what no camera did
        cycle_s += t.hand * left as f64;
        operator_s += t.hand * left as f64;
        left = 0;
    }
    sums.ok += usize::from(left == 0);
    sums.cycle_s += cycle_s;
    sums.operator_s += operator_s;
}

/// A unit's chance of being finished unaided, and whether it was.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// Number of the unit.
    pub unit: u64,
    /// From the scores of its own screws, as they were before anything was done to them, and from the units before it.
    pub predicted: f64,
    /// What became of it.
    pub finished: bool,
}

/// Screws that are left in a unit: found but not to be taken out, and not found. What stayed in a unit whose covers all came off was no screw,
/// nor is what the bit never met: where a cover stays all the same, what holds it was not found.
fn left_in(outcome: &Outcome) -> (usize, usize) {
    match outcome {
        Outcome::Ng { reason, .. } => match reason {
            NgReason::CoverStuck | NgReason::ScrewMissed => (0, 1),
            NgReason::ScrewSeized | NgReason::ScrewCamOut => (1, 0),
            _ => (0, 0),
        },
        _ => (0, 0),
    }
}

/// What an assumed chance is worth beside counts, as so many trials.
const ASSUMED_WORTH: f64 = 10.0;

/// A chance that is learnt from unit to unit: an assumption, and what was counted since (the mean of a Beta distribution).
#[derive(Clone, Copy)]
struct Learnt {
    hits: f64,
    of: f64,
}

impl Learnt {
    fn from(chance: Chance) -> Self {
        match chance {
            Chance::Known(p) => Self {
                hits: p * ASSUMED_WORTH,
                of: ASSUMED_WORTH,
            },
            Chance::Counted { hits, of } => Self {
                hits: hits as f64 + 0.5,
                of: of as f64 + 1.0,
            },
        }
    }

    fn saw(&mut self, hits: f64, misses: f64) {
        self.hits += hits;
        self.of += hits + misses;
    }

    fn mean(self) -> f64 {
        self.hits / self.of
    }
}

/// The chances of a unit's screws, as far as they are known before it comes.
struct Chances {
    seen: Learnt,
    found_later: Learnt,
    out_at_once: Learnt,
    out_after_ladder: Learnt,
    cover_jams: f64,
}

impl Chances {
    fn of(a: &Assumptions) -> Self {
        Self {
            seen: Learnt::from(a.screw.seen),
            found_later: Learnt::from(a.screw.found_later),
            out_at_once: Learnt::from(a.screw.out_at_once),
            out_after_ladder: Learnt::from(a.screw.out_after_ladder),
            cover_jams: a.unit.cover_jams.mean(),
        }
    }

    /// Takes note of a unit that is done.
    fn learn(&mut self, unit: &Digest) {
        let (stayed, not_found) = unit.outcome.as_ref().map_or((0, 0), left_in);
        let (stayed, not_found) = (stayed as f64, not_found as f64);
        let (at_once, later) = (unit.out_at_once as f64, unit.out_later as f64);
        self.out_at_once.saw(at_once, later + stayed);
        self.out_after_ladder.saw(later, stayed);
        let found_later = unit.found_later as f64;
        self.found_later.saw(found_later, not_found);
        // some of those found later had been seen, in doubt
        let in_doubt: f64 = unit.scores_in_doubt.iter().sum();
        let unseen = not_found + (found_later - in_doubt).max(0.0);
        self.seen.saw(unit.removed as f64 + stayed + not_found - unseen, unseen);
    }

    /// Probability that all comes out.
    ///
    /// # Arguments
    /// * `finds` – for each find, the probability that it is a screw: those that are driven at, and those that are left in doubt, which are
    ///   driven at when their cover stays.
    fn unaided(&self, finds: &[f64]) -> f64 {
        let once = self.out_at_once.mean();
        let out = once + (1.0 - once) * self.out_after_ladder.mean();
        // a find that is no screw holds nothing: the cover comes off without it
        let seen: f64 = finds.iter().map(|p| 1.0 - p * (1.0 - out)).product();
        // beside the screws that are seen there are some that are not
        let unseen = finds.iter().sum::<f64>() * (1.0 / self.seen.mean() - 1.0);
        let each_stays = 1.0 - self.found_later.mean() * out;
        seen * (-unseen * each_stays).exp() * (1.0 - self.cover_jams)
    }
}

/// Predictions for the finished units in scope. Each knows its own finds and what became of the units before it, nothing of what came after.
///
/// # Arguments
/// * `units` – in the order in which they came.
pub fn predictions(a: &Assumptions, units: &[Digest]) -> Vec<Prediction> {
    let mut chances = Chances::of(a);
    let mut predictions = Vec::new();
    for unit in units {
        let finished = match unit.outcome {
            Some(Outcome::Ok) => Some(true),
            Some(Outcome::Ng { .. }) => Some(false),
            Some(Outcome::Excluded { .. }) | None => None,
        };
        if let Some(finished) = finished {
            let finds = [&unit.scores_acted_on[..], &unit.scores_in_doubt[..]].concat();
            predictions.push(Prediction {
                unit: unit.unit,
                predicted: chances.unaided(&finds),
                finished,
            });
        }
        chances.learn(unit);
    }
    predictions
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forecast_is_what_can_be_computed() -> Result<(), ForecastError> {
        let mut a = Assumptions::default();
        a.unit.excluded = BTreeMap::from([("any".into(), Chance::Known(0.2))]);
        a.screw.found = Chance::Known(1.0);
        let f = forecast(&a, 4000, 20, 7)?;
        // Poisson screws, each out with 0.96 + 0.04 * 0.6: exp(-22 * 0.016) of the units have them all out
        let expected = (-22.0f64 * 0.016).exp() * 0.995;
        assert!((f.unaided_in_scope.mean - expected).abs() < 0.01, "{f:?}");
        assert!((f.unaided_of_all.mean - 0.8 * expected).abs() < 0.01);
        assert_eq!(f.ok_of_all, f.unaided_of_all);
        assert!(
            (f.cycle_mean_s.mean - (35.0 + 12.0 + 40.0 + 22.0 * (4.5 + 0.04 * 9.0))).abs() < 1.0,
            "{f:?}"
        );
        assert_eq!(f.operator_s.mean, 0.0);
        Ok(())
    }

    #[test]
    fn counts_widen_what_is_known_exactly() -> Result<(), ForecastError> {
        let width = |found| {
            let mut a = Assumptions::default();
            a.screw.found = found;
            forecast(&a, 500, 200, 3).map(|f| f.unaided_of_all.high - f.unaided_of_all.low)
        };
        let known = width(Chance::Known(0.97))?;
        let counted = width(Chance::Counted { hits: 97, of: 100 })?;
        assert!(counted > 1.5 * known, "{counted} {known}");
        Ok(())
    }

    #[test]
    fn help_helps_and_costs_a_persons_time() -> Result<(), ForecastError> {
        let with = |click, mill, hand| {
            let a = Assumptions {
                policy: Policy { click, mill, hand },
                ..Assumptions::default()
            };
            forecast(&a, 2000, 10, 1)
        };
        let (none, click, mill, all) = (
            with(false, false, false)?,
            with(true, false, false)?,
            with(true, true, false)?,
            with(true, true, true)?,
        );
        assert!(none.ok_of_all.mean < click.ok_of_all.mean && click.ok_of_all.mean < mill.ok_of_all.mean);
        assert!((all.ok_of_all.mean - (1.0 - 28.5 / 121.0)).abs() < 0.03, "{all:?}");
        assert!(none.operator_s.mean == 0.0 && click.operator_s.mean > 0.0);
        assert_eq!(none.unaided_of_all, all.unaided_of_all); // what the cell does alone does not depend on help
        Ok(())
    }

    #[test]
    fn nonsense_names_its_key() {
        let mut a = Assumptions::default();
        a.screw.found = Chance::Known(1.2);
        let error = forecast(&a, 1, 1, 1).expect_err("no probability");
        assert!(error.to_string().contains("screw.found is 1.2"), "{error}");
        let mut a = Assumptions::default();
        a.times_s.mill = f64::NAN;
        assert!(
            forecast(&a, 1, 1, 1)
                .expect_err("NaN")
                .to_string()
                .contains("times_s.mill")
        );
    }

    #[test]
    fn a_prediction_falls_with_every_screw_that_there_may_be() {
        let chances = Chances::of(&Assumptions::default());
        assert!((chances.unaided(&[]) - 0.995).abs() < 1e-9);
        assert!(chances.unaided(&[1.0; 20]) < chances.unaided(&[1.0; 10]));
        assert!(chances.unaided(&[0.5; 10]) > chances.unaided(&[1.0; 10]));
        assert!((chances.unaided(&[0.0; 10]) - 0.995).abs() < 1e-9); // what is no screw holds nothing
    }

    /// Units drawn from chances that differ from the assumed ones: what is predicted becomes what happens, and no unit is told its own end.
    #[test]
    fn predictions_come_to_be_what_happens() {
        let (once, ladder, doubt) = (0.9, 0.9, 0.4);
        let mut rng = Pcg64Mcg::seed_from_u64(11);
        let units: Vec<Digest> = (0..1200)
            .map(|number| {
                let mut unit = Digest::of(&UnitRecord::new(number, 0.0));
                let mut left = 0;
                for k in 0..22 {
                    let (score, is_screw) = if k < 2 {
                        (doubt, rng.random_bool(doubt))
                    } else {
                        (1.0, true)
                    };
                    if k < 2 {
                        unit.scores_in_doubt.push(score);
                    } else {
                        unit.scores_acted_on.push(score);
                    }
                    match (is_screw, rng.random_bool(once), rng.random_bool(ladder)) {
                        // what is no screw does not come out either
                        (false, ..) => unit.stayed += 1,
                        (_, true, _) => unit.out_at_once += 1,
                        (_, _, true) => unit.out_later += 1,
                        _ => left += 1,
                    }
                }
                unit.stayed += left;
                unit.removed = unit.out_at_once + unit.out_later;
                let stays = NgReason::ScrewSeized;
                unit.outcome = Some(if left == 0 {
                    Outcome::Ok
                } else {
                    Outcome::Ng {
                        reason: stays,
                        detail: String::new(),
                    }
                });
                unit
            })
            .collect();
        let told = predictions(&Assumptions::default(), &units);
        let mean = |of: &dyn Fn(&Prediction) -> f64| told[200..].iter().map(of).sum::<f64>() / 1000.0;
        let (predicted, finished) = (mean(&|p| p.predicted), mean(&|p| f64::from(u8::from(p.finished))));
        assert!((0.7..0.9).contains(&finished), "{finished}");
        assert!(
            (predicted - finished).abs() < 0.05,
            "{predicted} predicted, {finished} finished"
        );
        // what comes later changes nothing
        assert_eq!(predictions(&Assumptions::default(), &units[..50]), told[..50]);
    }
}
