//! What there is to do, as tasks with alternatives that exclude each other or follow each other, and the check of a schedule against them.

use super::product::{Cover, Face, Product};
use super::station::{Station, Strip};
use super::tour::{self, Costs, Tours};
use serde::Serialize;
use std::collections::HashMap;

/// Tasks of a plan at most: a set of them is one number.
const TASKS_MAX: usize = 128;

/// A product that cannot be taken apart at a station.
#[derive(Debug, thiserror::Error)]
pub enum ProblemError {
    /// Nobody can do it.
    #[error("{what}: no arm can do it: {reason}")]
    NoArm {
        /// Face or cover.
        what: String,
        /// What is missing.
        reason: String,
    },
    /// Too many tasks for one plan.
    #[error("{tasks} tasks in one plan are more than {TASKS_MAX}; plan fewer units at once")]
    TooLarge {
        /// How many.
        tasks: usize,
    },
}

/// What kind of work a task is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Feeding a unit onto a table.
    Load,
    /// Picture and depth of a face before its screws.
    Look,
    /// The screws of a face.
    Screws,
    /// Picture of a face after its screws: are they out?
    SecondLook,
    /// Pulling a cover and laying it aside.
    Cover,
    /// Taking the unit away.
    Discharge,
}

/// One task, with the ways of doing it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Task {
    /// Name, unique in the plan.
    pub name: String,
    /// Kind.
    pub kind: Kind,
    /// Number of the unit.
    pub unit: usize,
    /// Number of the table that the unit is on.
    pub table: usize,
    /// Number of its face or cover in the product.
    pub part: usize,
    /// Side that has to face the camera, as a number; `None`: any.
    pub side: Option<usize>,
    /// Nothing else may go on at this table meanwhile.
    pub alone: bool,
    /// What has to be done before.
    pub after: Vec<After>,
    /// Alternatives: if there are any, all of at least one have to be done before.
    pub after_any: Vec<Vec<After>>,
    /// The ways of doing it: one is chosen.
    pub modes: Vec<Mode>,
}

/// A task that has to be over before.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct After {
    /// Its number.
    pub task: usize,
    /// Time from its end until the result is there, s: a mode's approach may begin before.
    pub lag_s: f64,
}

/// One way of doing a task.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Mode {
    /// Which arm it takes, and for how long.
    pub arms: Vec<Option<ArmUse>>,
    /// How long it binds the table, s: the task's duration for what comes after it.
    pub table_s: f64,
    /// Its beginning that needs no result yet, s: arms on their way from rest.
    pub lead_s: f64,
    /// Time of all arms together that it takes at least, s.
    pub work_s: f64,
    /// What is done when, from its begin.
    pub stops: Vec<Stop>,
}

impl Mode {
    /// Until everything about it is over, s.
    pub fn end_s(&self) -> f64 {
        let arms = self.arms.iter().flatten().map(|used| used.busy_s);
        arms.fold(self.table_s, f64::max)
    }
}

/// An arm's part in a task.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ArmUse {
    /// Taken from the task's begin for so long, s.
    pub busy_s: f64,
    /// The room that it sweeps.
    pub strip: Strip,
    /// Until it has left that room, s.
    pub strip_s: f64,
}

/// A screw that is driven within a task.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Stop {
    /// Number of the arm.
    pub arm: usize,
    /// Number of the screw on its face.
    pub screw: usize,
    /// From the task's begin, s.
    pub start_s: f64,
    /// From the task's begin, s.
    pub end_s: f64,
}

/// When a task is done, and how.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Placed {
    /// Number of the task.
    pub task: usize,
    /// Number of the way chosen.
    pub mode: usize,
    /// Its begin, s.
    pub start_s: f64,
}

/// A schedule that breaks a rule.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Violation {
    /// Not every task exactly once.
    #[error("{task} is planned {times} times")]
    Times {
        /// Which task.
        task: String,
        /// How often.
        times: usize,
    },
    /// Too early.
    #[error("{task} begins before {before} is done")]
    Order {
        /// The later task.
        task: String,
        /// The earlier one.
        before: String,
    },
    /// Two tasks that exclude each other.
    #[error("{first} and {second} overlap: {reason}")]
    Overlap {
        /// One task.
        first: String,
        /// The other.
        second: String,
        /// What they both need.
        reason: &'static str,
    },
}

/// Tasks of some units of a product at a station.
#[derive(Clone, Debug, Serialize)]
pub struct Problem {
    /// The product.
    pub product: Product,
    /// The station.
    pub station: Station,
    /// Names of the sides.
    pub sides: Vec<String>,
    /// The tasks.
    pub tasks: Vec<Task>,
    /// The same tasks, but with ways that no division of a face's screws between the arms can be below: for bounds only.
    #[serde(skip)]
    pub(super) relaxed: Vec<Task>,
}

impl Problem {
    /// Sets up the tasks for so many units, which go to the tables in turn.
    ///
    /// # Errors
    /// [`ProblemError`] naming the face or cover.
    pub fn new(product: &Product, station: &Station, units: usize) -> Result<Self, ProblemError> {
        let mut sides = vec![product.loaded.clone()];
        let named = product
            .faces
            .iter()
            .map(|f| &f.side)
            .chain(product.covers.iter().map(|c| &c.side));
        for side in named {
            if !sides.contains(side) {
                sides.push(side.clone());
            }
        }
        let mut builder = Builder {
            product,
            station,
            sides: &sides,
            faces: HashMap::new(),
            tasks: Vec::new(),
            relaxed: Vec::new(),
        };
        let mut discharged = Vec::new();
        for unit in 0..units {
            let free = unit
                .checked_sub(station.tables_y_mm.len())
                .map(|before| discharged[before]);
            discharged.push(builder.unit(unit, free)?);
        }
        let (tasks, relaxed) = (builder.tasks, builder.relaxed);
        if tasks.len() > TASKS_MAX {
            return Err(ProblemError::TooLarge { tasks: tasks.len() });
        }
        Ok(Self {
            product: product.clone(),
            station: station.clone(),
            sides,
            tasks,
            relaxed,
        })
    }

    /// Checks a schedule against every rule, by the intervals themselves.
    ///
    /// # Errors
    /// The first [`Violation`].
    pub fn check(&self, placed: &[Placed]) -> Result<(), Violation> {
        let name = |task: usize| self.tasks[task].name.clone();
        let mut at: Vec<Option<&Placed>> = vec![None; self.tasks.len()];
        for p in placed {
            at[p.task] = Some(p);
        }
        for task in 0..self.tasks.len() {
            let times = placed.iter().filter(|p| p.task == task).count();
            if times != 1 {
                return Err(Violation::Times {
                    task: name(task),
                    times,
                });
            }
        }
        let mode = |p: &Placed| &self.tasks[p.task].modes[p.mode];
        let is_over = |after: &After, p: &Placed| {
            let lag_s = (after.lag_s - mode(p).lead_s).max(0.0);
            at[after.task].is_some_and(|b| p.start_s >= b.start_s + mode(b).table_s + lag_s - SLACK_S)
        };
        for p in placed {
            let task = &self.tasks[p.task];
            if let Some(after) = task.after.iter().find(|after| !is_over(after, p)) {
                return Err(Violation::Order {
                    task: name(p.task),
                    before: name(after.task),
                });
            }
            let any = |way: &Vec<After>| way.iter().all(|after| is_over(after, p));
            if !task.after_any.is_empty() && !task.after_any.iter().any(any) {
                return Err(Violation::Order {
                    task: name(p.task),
                    before: "any of what frees it".into(),
                });
            }
        }
        let pairs = placed.iter().flat_map(|p| placed.iter().map(move |q| (p, q)));
        for (p, q) in pairs.filter(|(p, q)| p.task != q.task) {
            if let Some(reason) = self.meets(p, q) {
                return Err(Violation::Overlap {
                    first: name(p.task),
                    second: name(q.task),
                    reason,
                });
            }
        }
        Ok(())
    }

    /// What two placed tasks both need at the same time.
    fn meets(&self, p: &Placed, q: &Placed) -> Option<&'static str> {
        let (tp, tq) = (&self.tasks[p.task], &self.tasks[q.task]);
        let (mp, mq) = (&tp.modes[p.mode], &tq.modes[q.mode]);
        let overlap = |until_p: f64, until_q: f64| {
            p.start_s < q.start_s + until_q - SLACK_S && q.start_s < p.start_s + until_p - SLACK_S
        };
        if tp.table == tq.table && tp.unit != tq.unit && overlap(mp.table_s, mq.table_s) {
            return Some("two units on one table");
        }
        if tp.unit == tq.unit {
            if (tp.alone || tq.alone) && overlap(mp.table_s, mq.table_s) {
                return Some("a clear view");
            }
            let turn_s = self.product.times_s.turn;
            let is_turned = tp.side.is_some() && tq.side.is_some() && tp.side != tq.side;
            if is_turned && overlap(mp.table_s + turn_s, mq.table_s + turn_s) {
                return Some("another side of the table");
            }
        }
        for (a, used) in mp
            .arms
            .iter()
            .enumerate()
            .filter_map(|(a, u)| u.as_ref().map(|u| (a, u)))
        {
            for (b, other) in mq
                .arms
                .iter()
                .enumerate()
                .filter_map(|(b, u)| u.as_ref().map(|u| (b, u)))
            {
                if a == b && overlap(used.busy_s, other.busy_s) {
                    return Some("one arm");
                }
                let apart = used.strip.is_clear_of(&other.strip, self.station.clearance_mm);
                if a < b && !apart && overlap(used.strip_s, other.strip_s) {
                    return Some("the same room");
                }
            }
        }
        None
    }
}

/// Times that differ by less are equal, s.
pub(super) const SLACK_S: f64 = 1e-6;

/// Sets up tasks unit by unit.
struct Builder<'a> {
    product: &'a Product,
    station: &'a Station,
    sides: &'a [String],
    /// Ways of doing a face at a table, and relaxed ones: the same for all units.
    faces: HashMap<(usize, usize), (Vec<Mode>, Vec<Mode>)>,
    tasks: Vec<Task>,
    relaxed: Vec<Task>,
}

impl Builder<'_> {
    /// Adds a unit's tasks; returns the number of its discharge.
    fn unit(&mut self, unit: usize, free: Option<usize>) -> Result<usize, ProblemError> {
        let table = unit % self.station.tables_y_mm.len();
        let times = self.product.times_s;
        let blank = |kind: Kind, part: usize, what: &str, side: Option<usize>, alone: bool, modes: Vec<Mode>| Task {
            name: format!("{} {what}", unit + 1),
            kind,
            unit,
            table,
            part,
            side,
            alone,
            after: Vec::new(),
            after_any: Vec::new(),
            modes,
        };
        let idle = |table_s: f64| Mode {
            arms: vec![None; self.station.arms.len()],
            table_s,
            lead_s: 0.0,
            work_s: 0.0,
            stops: Vec::new(),
        };
        let mut load = blank(Kind::Load, 0, "load", None, true, vec![idle(times.load)]);
        load.after.extend(free.map(|task| After { task, lag_s: 0.0 }));
        let load = self.push(load, None);
        let loaded = |side: Option<usize>| After {
            task: load,
            lag_s: if side == Some(0) { 0.0 } else { times.turn },
        };
        let side_of = |name: &str| self.sides.iter().position(|side| side == name);
        let mut second_looks = HashMap::new();
        let mut looks = Vec::new();
        for (k, face) in self.product.faces.iter().enumerate() {
            let side = side_of(&face.side);
            let name = &face.name;
            let look = idle(times.picture);
            let mut first = blank(Kind::Look, k, &format!("{name} look"), side, true, vec![look.clone()]);
            first.after.push(loaded(side));
            let first = self.push(first, None);
            let (modes, least) = self.face_modes(k, table)?;
            let mut screws = blank(Kind::Screws, k, &format!("{name} screws"), side, false, modes);
            screws.after.push(After {
                task: first,
                lag_s: times.process,
            });
            let screws = self.push(screws, Some(least));
            let mut second = blank(
                Kind::SecondLook,
                k,
                &format!("{name} second look"),
                side,
                true,
                vec![look],
            );
            second.after.push(After {
                task: screws,
                lag_s: 0.0,
            });
            let second = self.push(second, None);
            second_looks.insert(name.as_str(), second);
            looks.push(first);
        }
        let first_cover = self.tasks.len();
        let off = |name: &str| {
            let is_it = |c: &Cover| c.name == name || c.takes_along.iter().any(|n| n == name);
            let cover = self.product.covers.iter().position(is_it);
            cover.map(|c| After {
                task: first_cover + c,
                lag_s: 0.0,
            })
        };
        let out = |name: &String| {
            second_looks.get(name.as_str()).map(|&task| After {
                task,
                lag_s: times.process,
            })
        };
        let mut covers = Vec::new();
        for (k, cover) in self.product.covers.iter().enumerate() {
            let side = side_of(&cover.side);
            let modes = self.cover_modes(cover, table)?;
            let mut pull = blank(Kind::Cover, k, &format!("{} cover", cover.name), side, false, modes);
            pull.after.push(loaded(side));
            pull.after.extend(cover.held_by.iter().filter_map(out));
            pull.after
                .extend(cover.after_covers.iter().filter_map(|name| off(name)));
            pull.after_any = cover
                .requires_any
                .iter()
                .map(|way| {
                    let faces = way.faces.iter().filter_map(out);
                    faces.chain(way.covers.iter().filter_map(|name| off(name))).collect()
                })
                .collect();
            covers.push(pull);
        }
        let befores: Vec<Vec<After>> = self
            .product
            .faces
            .iter()
            .map(|face| face.after_covers.iter().filter_map(|name| off(name)).collect())
            .collect();
        for (&look, before) in looks.iter().zip(&befores) {
            self.tasks[look].after.extend(before);
            self.relaxed[look].after.extend(before);
        }
        let mut last: Vec<usize> = second_looks.into_values().collect();
        last.sort_unstable();
        for cover in covers {
            last.push(self.push(cover, None));
        }
        let mut discharge = blank(Kind::Discharge, 0, "discharge", None, true, vec![idle(times.discharge)]);
        discharge.after = last
            .into_iter()
            .chain([load])
            .map(|task| After { task, lag_s: 0.0 })
            .collect();
        Ok(self.push(discharge, None))
    }

    fn push(&mut self, task: Task, least: Option<Vec<Mode>>) -> usize {
        let mut relaxed = task.clone();
        if let Some(modes) = least {
            relaxed.modes = modes;
        }
        self.tasks.push(task);
        self.relaxed.push(relaxed);
        self.tasks.len() - 1
    }

    /// Where the screws of a face are when it is presented at a table, in the first arm's base, mm.
    fn places(&self, face: &Face, table: usize) -> Vec<[f64; 3]> {
        let middle_mm = self.station.tables_y_mm[table];
        let at = |[across, up]: &[f64; 2]| [face.depth_mm, middle_mm + across, *up];
        face.screws_mm.iter().map(at).collect()
    }

    /// Every way of taking out the screws of a face, and ways that no division of its screws between the arms is below.
    fn face_modes(&mut self, face: usize, table: usize) -> Result<(Vec<Mode>, Vec<Mode>), ProblemError> {
        if let Some(known) = self.faces.get(&(face, table)) {
            return Ok(known.clone());
        }
        let number = face;
        let face = &self.product.faces[face];
        let places = self.places(face, table);
        let mut able: Vec<(usize, Costs)> = Vec::new();
        for (a, arm) in self.station.arms.iter().enumerate() {
            if arm.driver && (face.arms.is_empty() || face.arms.contains(&arm.name)) {
                able.extend(self.costs(a, &places).map(|costs| (a, costs)));
            }
        }
        if able.is_empty() {
            return Err(ProblemError::NoArm {
                what: format!("face '{}'", face.name),
                reason: "none with a driver reaches all of its screws; correct screws_mm, depth_mm or arms".into(),
            });
        }
        // each arm's exact tours on a core of its own: the largest faces take half a second
        let tours: Vec<Option<Tours>> = std::thread::scope(|scope| {
            let jobs: Vec<_> = able
                .iter()
                .map(|(_, costs)| scope.spawn(|| Tours::new(costs)))
                .collect();
            jobs.into_iter().map(|job| job.join().unwrap_or(None)).collect()
        });
        let y_mm: Vec<f64> = places.iter().map(|at| at[1]).collect();
        let all: Vec<usize> = (0..places.len()).collect();
        let mut modes = Vec::new();
        for ((a, costs), tours) in able.iter().zip(&tours) {
            let order = match tours {
                Some(tours) => tours.order((1 << all.len()) - 1),
                None => tour::improved(costs, &all),
            };
            modes.push(self.screws_mode(&[(*a, costs, &order, 0.0)], &y_mm));
        }
        if let [(a, first), (b, second)] = &able[..] {
            let arms = [(first, tours[0].as_ref()), (second, tours[1].as_ref())];
            let rest_y_mm = [*a, *b].map(|arm| self.station.arms[arm].rest_y_mm);
            let apart = tour::strips_apart(&y_mm, rest_y_mm, self.station.clearance_mm);
            if let Some(shared) = tour::share(arms, &y_mm, &apart) {
                let [right, left] = &shared.orders;
                let parts = [
                    (*a, first, right, shared.wait_s[0]),
                    (*b, second, left, shared.wait_s[1]),
                ];
                modes.push(self.screws_mode(&parts, &y_mm));
            }
        }
        // the same ways at their least, and the two arms together in classes of divisions
        let longest_lead_s = able
            .iter()
            .flat_map(|(_, costs)| &costs.out_s)
            .copied()
            .fold(0.0, f64::max);
        let mut relaxed: Vec<Mode> = Vec::new();
        for (((_, costs), tours), mode) in able.iter().zip(&tours).zip(&modes) {
            let least_s = tour::least_alone_s(costs, tours.as_ref());
            let mut mode = mode.clone();
            (mode.table_s, mode.work_s, mode.lead_s) = (least_s, least_s, longest_lead_s);
            for used in mode.arms.iter_mut().flatten() {
                (used.busy_s, used.strip_s) = (least_s, least_s);
            }
            relaxed.push(mode);
        }
        if let [(a, first), (b, second)] = &able[..] {
            for times_s in tour::least_shared_s([(first, tours[0].as_ref()), (second, tours[1].as_ref())]) {
                let mut mode = relaxed[0].clone();
                for (arm, busy_s) in [*a, *b].into_iter().zip(times_s) {
                    // each is somewhere at its own place of rest, at least
                    let strip = Strip::over([self.station.arms[arm].rest_y_mm]);
                    mode.arms[arm] = Some(ArmUse {
                        busy_s,
                        strip,
                        strip_s: 0.0,
                    });
                }
                (mode.table_s, mode.work_s) = (times_s[0].max(times_s[1]), times_s[0] + times_s[1]);
                relaxed.push(mode);
            }
        }
        let known = (modes, relaxed);
        self.faces.insert((number, table), known.clone());
        Ok(known)
    }

    /// Times of an arm between the screws of a face; `None` if it does not reach one.
    fn costs(&self, arm: usize, places: &[[f64; 3]]) -> Option<Costs> {
        let travel_s = |from: Option<[f64; 3]>, to: Option<[f64; 3]>| self.station.travel_s(arm, from, to);
        let between = |&from: &[f64; 3]| places.iter().map(|&to| travel_s(Some(from), Some(to))).collect();
        Some(Costs {
            between_s: places.iter().map(between).collect::<Option<_>>()?,
            out_s: places
                .iter()
                .map(|&to| travel_s(None, Some(to)))
                .collect::<Option<_>>()?,
            back_s: places
                .iter()
                .map(|&from| travel_s(Some(from), None))
                .collect::<Option<_>>()?,
            drive_s: self.product.times_s.drive,
        })
    }

    /// One or two arms, each through its screws after its wait.
    fn screws_mode(&self, parts: &[(usize, &Costs, &Vec<usize>, f64)], y_mm: &[f64]) -> Mode {
        let mut arms = vec![None; self.station.arms.len()];
        let mut stops = Vec::new();
        let mut lead_s = f64::INFINITY;
        for &(arm, costs, order, wait_s) in parts {
            let busy_s = wait_s + costs.time_s(order);
            let rest_y_mm = self.station.arms[arm].rest_y_mm;
            arms[arm] = Some(ArmUse {
                busy_s,
                strip: Strip::over(order.iter().map(|&k| y_mm[k]).chain([rest_y_mm])),
                strip_s: busy_s,
            });
            let mut now_s = wait_s;
            for (k, &screw) in order.iter().enumerate() {
                now_s += match k {
                    0 => costs.out_s[screw],
                    _ => costs.between_s[order[k - 1]][screw],
                };
                if k == 0 {
                    lead_s = lead_s.min(now_s);
                }
                stops.push(Stop {
                    arm,
                    screw,
                    start_s: now_s,
                    end_s: now_s + costs.drive_s,
                });
                now_s += costs.drive_s;
            }
        }
        let busy = || arms.iter().flatten().map(|used: &ArmUse| used.busy_s);
        Mode {
            table_s: busy().fold(0.0, f64::max),
            work_s: busy().sum(),
            lead_s: if lead_s.is_finite() { lead_s } else { 0.0 },
            stops,
            arms,
        }
    }

    fn cover_modes(&self, cover: &Cover, table: usize) -> Result<Vec<Mode>, ProblemError> {
        let times = &self.product.times_s;
        let middle_mm = self.station.tables_y_mm[table];
        let mut modes = Vec::new();
        for (a, arm) in self.station.arms.iter().enumerate() {
            if !arm.gripper || !(cover.arms.is_empty() || cover.arms.contains(&arm.name)) {
                continue;
            }
            let busy_s = times.pull + times.lay_aside;
            let half_mm = 0.5 * cover.width_mm;
            let mut arms = vec![None; self.station.arms.len()];
            arms[a] = Some(ArmUse {
                busy_s,
                strip: Strip::over([middle_mm - half_mm, middle_mm + half_mm, arm.rest_y_mm]),
                strip_s: times.pull,
            });
            modes.push(Mode {
                arms,
                table_s: times.pull,
                lead_s: 0.0,
                work_s: busy_s,
                stops: Vec::new(),
            });
        }
        if modes.is_empty() {
            return Err(ProblemError::NoArm {
                what: format!("cover '{}'", cover.name),
                reason: "none has a gripper and is allowed to; correct arms".into(),
            });
        }
        Ok(modes)
    }
}
