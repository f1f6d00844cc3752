//! A plan carried out: what may begin is commanded, what ended is told, and nothing is ever waited for in a circle.
//!
//! The dispatcher knows no clock: it keeps the plan's order wherever two tasks need the same thing, and begins everything else as soon as
//! it may. Real durations differ from planned ones, so the room before the tables is divided into zones with a lock each:
//!
//! - an arm takes all zones of its next motion at once, or none of them;
//! - an arm that does not get them waits where it stands while the other one is in motion or at work; otherwise it goes back to rest, where it
//!   holds none, and waits there.
//!
//! Of two arms that hold zones at least one is therefore in motion or at work and waits for nobody: no circle of waits can form. What an arm
//! takes reaches from its own side to its furthest place, so that arms can neither meet nor cross.
//!
//! A screw that does not come out is tried again after the others of its arm; if it stays, the covers that it holds stay too, and whatever
//! needs them off is dropped. A unit is discharged in any case, once it was loaded.

use super::station::Station;
use super::task::{Kind, Placed, Problem};
use std::collections::{BTreeMap, VecDeque};

/// Width of a zone, mm.
const ZONE_MM: f64 = 20.0;

/// One thing to do, for one device.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Work {
    /// Feed a unit onto its table.
    Load {
        /// Number of the unit.
        unit: usize,
        /// Number of the table.
        table: usize,
    },
    /// Turn a side to the camera.
    Turn {
        /// Number of the table.
        table: usize,
        /// Number of the side in [`Problem::sides`].
        side: usize,
    },
    /// Take a picture; the view is clear.
    Picture {
        /// Number of the task, a first or a second look.
        task: usize,
    },
    /// Work out what the picture says. A second look that finds a screw still in has failed.
    Process {
        /// Number of the task, a first or a second look.
        task: usize,
    },
    /// Go to a screw and drive it out.
    Drive {
        /// Number of the task.
        task: usize,
        /// Number of the arm.
        arm: usize,
        /// Number of the screw on its face.
        screw: usize,
        /// 0 the first time.
        attempt: u8,
    },
    /// Go back to rest.
    Withdraw {
        /// Number of the arm.
        arm: usize,
    },
    /// Pull a cover off.
    Pull {
        /// Number of the task.
        task: usize,
        /// Number of the arm.
        arm: usize,
    },
    /// Lay the cover aside.
    LayAside {
        /// Number of the task.
        task: usize,
        /// Number of the arm.
        arm: usize,
    },
    /// Take the unit away.
    Discharge {
        /// Number of the unit.
        unit: usize,
        /// Number of the table.
        table: usize,
    },
}

/// What is to be begun now.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Command {
    /// Names it in its event; never used twice.
    pub ticket: u32,
    /// What to do.
    pub work: Work,
}

/// What has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Event {
    /// Begin: nothing has ended yet.
    Begin,
    /// Done as commanded.
    Done(u32),
    /// Ended, but not as it should: the screw is in, the cover on, the picture of no use.
    Failed(u32),
}

/// How far a task is.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
struct Progress {
    begun: bool,
    /// It will not be begun any more.
    dropped: bool,
    /// The table is not needed any more.
    table_free: bool,
    /// Its result is there, or will not come.
    known: bool,
    /// The result is that it failed.
    failed: bool,
}

/// What a task waits for in another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Until {
    TableFree,
    Known,
}

/// Where an arm is.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct ArmState {
    /// Task that it belongs to, until it is back at rest from it.
    task: Option<usize>,
    /// How far across it reaches from its own side at the screw where it is, the way back included, whole mm; `None` at rest.
    at_mm: Option<i64>,
    /// Screws to do for its task, with attempts so far.
    left: VecDeque<(usize, u8)>,
    /// In motion or at work.
    busy: bool,
}

/// Executes a plan event by event. It is a value: clone it, compare it, try it out.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Dispatcher {
    tasks: Vec<Fixed>,
    progress: Vec<Progress>,
    arms: Vec<ArmState>,
    /// Who holds each zone, from right to left.
    zones: Vec<Option<usize>>,
    /// Side that each table shows, and if it is turning.
    tables: Vec<(Option<usize>, bool)>,
    open: BTreeMap<u32, Work>,
    next_ticket: u32,
    /// The arm that is asked first.
    first: usize,
    retries: u8,
    /// Rightmost of all zones, mm.
    right_mm: i64,
    left_in: Vec<(usize, usize)>,
}

/// What does not change about a task.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Fixed {
    kind: Kind,
    unit: usize,
    table: usize,
    side: Option<usize>,
    after: Vec<(usize, Until)>,
    after_any: Vec<Vec<(usize, Until)>>,
    /// Tasks that need something that it needs too, and whether they stand before it in the plan.
    rivals: Vec<(usize, bool)>,
    /// Screws by arm, in their order, and how far across it reaches for each from its own side, the way from rest and back included, mm.
    screws: Vec<Vec<(usize, i64)>>,
    /// Arm that pulls, and how far across it reaches, mm.
    pull: Option<(usize, i64)>,
}

impl Dispatcher {
    /// A dispatcher for a plan of a problem.
    ///
    /// # Arguments
    /// * `retries` – how often a screw is tried again.
    pub fn new(problem: &Problem, placed: &[Placed], retries: u8) -> Self {
        let station: &Station = &problem.station;
        let mut tasks: Vec<Option<Fixed>> = vec![None; problem.tasks.len()];
        for (k, p) in placed.iter().enumerate() {
            let task = &problem.tasks[p.task];
            let mode = &task.modes[p.mode];
            let until = |after: &super::After| {
                let is_look = matches!(problem.tasks[after.task].kind, Kind::Look | Kind::SecondLook);
                let until = if is_look && after.lag_s > 0.0 {
                    Until::Known
                } else {
                    Until::TableFree
                };
                (after.task, until)
            };
            let needs_same = |q: &Placed| {
                let other = &problem.tasks[q.task];
                let other_mode = &other.modes[q.mode];
                let turned = task.side.is_some() && other.side.is_some() && task.side != other.side;
                let at_table = task.unit == other.unit && (task.alone || other.alone || turned);
                at_table
                    || mode
                        .arms
                        .iter()
                        .zip(&other_mode.arms)
                        .any(|(a, b)| a.is_some() && b.is_some())
            };
            let middle_mm = station.tables_y_mm[task.table];
            // from its own side, with half of the room that has to stay between two arms
            let reach_mm = |arm: usize, low_mm: f64, high_mm: f64| {
                let (half_mm, rest_mm) = (0.5 * station.clearance_mm, station.arms[arm].rest_y_mm);
                if arm == 0 {
                    (high_mm.max(rest_mm) + half_mm).ceil() as i64
                } else {
                    (low_mm.min(rest_mm) - half_mm).floor() as i64
                }
            };
            let pull = mode
                .arms
                .iter()
                .position(Option::is_some)
                .filter(|_| task.kind == Kind::Cover);
            let of_arm = |arm: usize| {
                let stops = mode.stops.iter().filter(|s| s.arm == arm).map(|s| s.screw);
                let y_mm = |screw: usize| middle_mm + problem.product.faces[task.part].screws_mm[screw][0];
                stops
                    .map(|screw| (screw, reach_mm(arm, y_mm(screw), y_mm(screw))))
                    .collect()
            };
            tasks[p.task] = Some(Fixed {
                kind: task.kind,
                unit: task.unit,
                table: task.table,
                side: task.side,
                after: task.after.iter().map(until).collect(),
                after_any: task
                    .after_any
                    .iter()
                    .map(|way| way.iter().map(until).collect())
                    .collect(),
                rivals: placed
                    .iter()
                    .enumerate()
                    .filter(|(n, q)| *n != k && needs_same(q))
                    .map(|(n, q)| (q.task, n < k))
                    .collect(),
                screws: (0..station.arms.len()).map(of_arm).collect(),
                pull: pull.map(|arm| {
                    let half_mm = 0.5 * problem.product.covers[task.part].width_mm;
                    (arm, reach_mm(arm, middle_mm - half_mm, middle_mm + half_mm))
                }),
            });
        }
        let tasks: Vec<Fixed> = tasks.into_iter().flatten().collect();
        Self::of(tasks, station.tables_y_mm.len(), station.arms.len(), retries)
    }

    /// A dispatcher for one face whose screws are known: which arm does which, in which order.
    ///
    /// # Arguments
    /// * `screws` – for the arm on the right and the one on the left: number of each screw, and how far the arm reaches across for it from
    ///   its own side (on the way there, at it and on the way back), in steps from right to left. Both may be at work where the right one's
    ///   reach is less than the left one's. `None`: the other arm rests meanwhile.
    /// * `first` – the arm that may begin if not both can.
    /// * `retries` – how often a screw is tried again, after the others of its arm.
    pub fn at_face(screws: [Vec<(usize, Option<usize>)>; 2], first: usize, retries: u8) -> Self {
        let most = screws
            .iter()
            .flatten()
            .filter_map(|(_, reach)| *reach)
            .max()
            .unwrap_or(0);
        let [right, left] = screws;
        // a zone for each step
        let of = |list: Vec<(usize, Option<usize>)>, whole: usize| {
            let reach =
                |(screw, reach): (usize, Option<usize>)| (screw, reach.unwrap_or(whole) as i64 * ZONE_MM as i64);
            list.into_iter().map(reach).collect()
        };
        let task = Fixed {
            kind: Kind::Screws,
            unit: 0,
            table: 0,
            side: None,
            after: Vec::new(),
            after_any: Vec::new(),
            rivals: Vec::new(),
            screws: vec![of(right, most), of(left, 0)],
            pull: None,
        };
        Self {
            first,
            ..Self::of(vec![task], 1, 2, retries)
        }
    }

    fn of(tasks: Vec<Fixed>, tables: usize, arms: usize, retries: u8) -> Self {
        let screws = tasks.iter().flat_map(|t| t.screws.iter().flatten().map(|(_, mm)| *mm));
        let pulls = tasks.iter().filter_map(|t| t.pull.map(|(_, mm)| mm));
        let all_mm: Vec<i64> = screws.chain(pulls).collect();
        let (low_mm, high_mm) = (all_mm.iter().min().copied(), all_mm.iter().max().copied());
        let (low_mm, high_mm) = (low_mm.unwrap_or(0), high_mm.unwrap_or(0));
        Self {
            progress: vec![Progress::default(); tasks.len()],
            tasks,
            arms: vec![
                ArmState {
                    task: None,
                    at_mm: None,
                    left: VecDeque::new(),
                    busy: false,
                };
                arms
            ],
            zones: vec![None; ((high_mm - low_mm) / ZONE_MM as i64 + 1) as usize],
            tables: vec![(None, false); tables],
            open: BTreeMap::new(),
            next_ticket: 1,
            first: 0,
            retries,
            right_mm: low_mm,
            left_in: Vec::new(),
        }
    }

    /// Takes note of an event and says what to begin. An event of an unknown ticket changes nothing.
    pub fn step(&mut self, event: Event) -> Vec<Command> {
        let mut commands = Vec::new();
        if let Event::Done(ticket) | Event::Failed(ticket) = event {
            let Some(work) = self.open.remove(&ticket) else {
                return commands;
            };
            if let Some(next) = self.ended(&work, matches!(event, Event::Done(_))) {
                self.begin(next, &mut commands);
            }
        }
        // what begins may let something else begin or be dropped: until nothing changes
        while self.advance(&mut commands) {}
        commands
    }

    /// True if every task is over or dropped and nothing is under way.
    pub fn is_finished(&self) -> bool {
        let over = |p: &Progress| p.dropped || (p.table_free && p.known);
        self.open.is_empty() && self.progress.iter().all(over)
    }

    /// What is under way.
    pub fn open(&self) -> impl Iterator<Item = (u32, &Work)> {
        self.open.iter().map(|(ticket, work)| (*ticket, work))
    }

    /// True if the screw that is being driven is tried again, after the others of its arm, should this fail.
    pub fn comes_back(&self, ticket: u32) -> bool {
        matches!(self.open.get(&ticket), Some(Work::Drive { attempt, .. }) if *attempt < self.retries)
    }

    /// Screws that stayed in: number of the task and of the screw.
    pub fn left_in(&self) -> &[(usize, usize)] {
        &self.left_in
    }

    /// Tasks that were dropped, by number.
    pub fn dropped(&self) -> impl Iterator<Item = usize> {
        self.progress
            .iter()
            .enumerate()
            .filter(|(_, p)| p.dropped)
            .map(|(k, _)| k)
    }

    /// Takes note of what ended; returns what follows at once.
    fn ended(&mut self, work: &Work, is_done: bool) -> Option<Work> {
        match *work {
            Work::Load { unit, table } => {
                self.tables[table] = (is_done.then_some(0), false);
                self.over(self.find(Kind::Load, unit), is_done);
            }
            Work::Discharge { unit, table } => {
                self.tables[table] = (None, false);
                self.over(self.find(Kind::Discharge, unit), is_done);
            }
            // a table that did not turn shows what nobody knows: it is turned again
            Work::Turn { table, side } => self.tables[table] = (is_done.then_some(side), false),
            Work::Picture { task } => {
                self.progress[task].table_free = true;
                if is_done {
                    return Some(Work::Process { task });
                }
                self.over(Some(task), false);
            }
            Work::Process { task } => self.over(Some(task), is_done),
            Work::Drive {
                task,
                arm,
                screw,
                attempt,
            } => {
                self.arms[arm].busy = false;
                // on the way it may have held more than it needs where it stands
                if let Some(at_mm) = self.arms[arm].at_mm {
                    self.take(arm, at_mm);
                }
                if !is_done {
                    if attempt < self.retries {
                        self.arms[arm].left.push_back((screw, attempt + 1));
                    } else {
                        self.left_in.push((task, screw));
                        self.progress[task].failed = true;
                    }
                }
            }
            Work::Withdraw { arm } => {
                self.free(arm);
                self.arms[arm].busy = false;
                self.arms[arm].at_mm = None;
                if self.arms[arm].left.is_empty() {
                    self.leave(arm);
                }
            }
            Work::Pull { task, arm } => {
                self.free(arm);
                if is_done {
                    self.progress[task].table_free = true;
                    self.progress[task].known = true;
                    return Some(Work::LayAside { task, arm });
                }
                self.arms[arm].busy = false;
                self.leave(arm);
                self.over(Some(task), false);
            }
            Work::LayAside { arm, .. } => {
                self.arms[arm].busy = false;
                self.leave(arm);
            }
        }
        None
    }

    fn find(&self, kind: Kind, unit: usize) -> Option<usize> {
        self.tasks.iter().position(|t| t.kind == kind && t.unit == unit)
    }

    fn over(&mut self, task: Option<usize>, is_done: bool) {
        if let Some(task) = task {
            let progress = &mut self.progress[task];
            progress.table_free = true;
            progress.known = true;
            progress.failed |= !is_done;
        }
    }

    /// An arm is done with its task; the last one ends the task.
    fn leave(&mut self, arm: usize) {
        let Some(task) = self.arms[arm].task.take() else { return };
        if self.tasks[task].kind == Kind::Screws && !self.arms.iter().any(|other| other.task == Some(task)) {
            let is_done = !self.progress[task].failed;
            self.over(Some(task), is_done);
        }
    }

    fn free(&mut self, arm: usize) {
        for zone in &mut self.zones {
            if *zone == Some(arm) {
                *zone = None;
            }
        }
    }

    /// Takes everything from the arm's own side to where it reaches, or nothing.
    fn take(&mut self, arm: usize, reach_mm: i64) -> bool {
        let last = self.zones.len() - 1;
        let zone = |mm: i64| (mm - self.right_mm).max(0) as usize / ZONE_MM as usize;
        let range = if arm == 0 {
            0..=zone(reach_mm).min(last)
        } else {
            zone(reach_mm).min(last)..=last
        };
        if self.zones[range.clone()]
            .iter()
            .any(|held| held.is_some_and(|by| by != arm))
        {
            return false;
        }
        self.free(arm);
        for zone in &mut self.zones[range] {
            *zone = Some(arm);
        }
        true
    }

    fn begin(&mut self, work: Work, commands: &mut Vec<Command>) {
        commands.push(Command {
            ticket: self.next_ticket,
            work: work.clone(),
        });
        self.open.insert(self.next_ticket, work);
        self.next_ticket += 1;
    }

    /// One pass over arms and tasks; true if something changed.
    fn advance(&mut self, commands: &mut Vec<Command>) -> bool {
        let mut changed = false;
        let (first, arms) = (self.first, self.arms.len());
        for arm in (0..arms).map(|k| (first + k) % arms) {
            changed |= self.move_arm(arm, commands);
        }
        for task in 0..self.tasks.len() {
            if !self.progress[task].begun && !self.progress[task].dropped {
                changed |= self.drop_if_hopeless(task) || self.begin_task(task, commands);
            }
        }
        changed
    }

    /// The next screw of an arm at work, or the way back.
    fn move_arm(&mut self, arm: usize, commands: &mut Vec<Command>) -> bool {
        let Some(task) = self.arms[arm].task else { return false };
        if self.arms[arm].busy || self.tasks[task].kind != Kind::Screws {
            return false;
        }
        if let Some(&(screw, attempt)) = self.arms[arm].left.front() {
            let of_screw = self.tasks[task].screws[arm].iter().find(|(k, _)| *k == screw);
            let to_mm = of_screw.map_or(self.right_mm, |(_, mm)| *mm);
            let reach_mm = match (self.arms[arm].at_mm, arm) {
                (None, _) => to_mm,
                (Some(at_mm), 0) => to_mm.max(at_mm),
                (Some(at_mm), _) => to_mm.min(at_mm),
            };
            if self.take(arm, reach_mm) {
                self.arms[arm].left.pop_front();
                self.arms[arm].at_mm = Some(to_mm);
                self.arms[arm].busy = true;
                self.begin(
                    Work::Drive {
                        task,
                        arm,
                        screw,
                        attempt,
                    },
                    commands,
                );
                return true;
            }
        }
        // who stands at the face may wait for one that is in motion or at work, which waits for nobody
        let others_go_on = self.arms.iter().enumerate().any(|(k, other)| k != arm && other.busy);
        let may_wait = others_go_on && !self.arms[arm].left.is_empty();
        if self.arms[arm].at_mm.is_some() && !may_wait {
            self.arms[arm].busy = true;
            self.begin(Work::Withdraw { arm }, commands);
            return true;
        }
        false
    }

    /// True where what a task waits for has come.
    fn has_come(&self, (task, until): (usize, Until)) -> bool {
        let p = &self.progress[task];
        match until {
            Until::TableFree => p.table_free,
            Until::Known => p.known,
        }
    }

    /// True where what a task needs will never come.
    fn is_lost(&self, (task, _): (usize, Until)) -> bool {
        let p = &self.progress[task];
        p.dropped || (p.known && p.failed)
    }

    /// Drops a task whose preconditions cannot come any more.
    fn drop_if_hopeless(&mut self, task: usize) -> bool {
        let fixed = &self.tasks[task];
        let is_hopeless = match fixed.kind {
            // a unit that was loaded is taken away, whatever happened to it; a table whose unit stayed on it takes no other
            Kind::Discharge => self
                .find(Kind::Load, fixed.unit)
                .is_some_and(|load| self.is_lost((load, Until::Known))),
            // a face is looked at again even if a screw stayed: the picture is the record
            Kind::SecondLook => fixed.after.iter().any(|(before, _)| self.progress[*before].dropped),
            _ => {
                let any = &fixed.after_any;
                fixed.after.iter().any(|a| self.is_lost(*a))
                    || fixed.after.iter().any(|a| self.has_screws_in(a.0))
                    || (!any.is_empty()
                        && any
                            .iter()
                            .all(|way| way.iter().any(|a| self.is_lost(*a) || self.has_screws_in(a.0))))
            }
        };
        if is_hopeless {
            self.progress[task].dropped = true;
        }
        is_hopeless
    }

    /// True for a second look at a face with a screw that is known to be in.
    fn has_screws_in(&self, task: usize) -> bool {
        let fixed = &self.tasks[task];
        fixed.kind == Kind::SecondLook
            && fixed
                .after
                .iter()
                .any(|(screws, _)| self.is_lost((*screws, Until::Known)))
    }

    /// True for a task that was planned after an alternative which is lost: others need not wait for it, as it may wait for them.
    fn is_put_back(&self, task: usize) -> bool {
        let any = &self.tasks[task].after_any;
        any.iter()
            .any(|way| way.iter().any(|a| self.is_lost(*a) || self.has_screws_in(a.0)))
    }

    fn begin_task(&mut self, task: usize, commands: &mut Vec<Command>) -> bool {
        let fixed = &self.tasks[task];
        let (unit, table, side) = (fixed.unit, fixed.table, fixed.side);
        let is_gone = |k: usize| self.progress[k].dropped;
        let ready = |a: &(usize, Until)| is_gone(a.0) || self.has_come(*a);
        let in_turn = |&(rival, is_before): &(usize, bool)| {
            let p = &self.progress[rival];
            p.dropped || p.table_free || (!p.begun && (!is_before || self.is_put_back(rival)))
        };
        let any = fixed.after_any.is_empty()
            || fixed
                .after_any
                .iter()
                .any(|way| way.iter().all(|a| self.has_come(*a) && !self.is_lost(*a)));
        if !(fixed.after.iter().all(ready) && fixed.rivals.iter().all(in_turn) && any) {
            return false;
        }
        if let Some(side) = side {
            let (shown, turning) = self.tables[table];
            if turning {
                return false;
            }
            if shown != Some(side) {
                self.tables[table].1 = true;
                self.begin(Work::Turn { table, side }, commands);
                return true;
            }
        }
        match fixed.kind {
            Kind::Load => self.begin(Work::Load { unit, table }, commands),
            Kind::Discharge => self.begin(Work::Discharge { unit, table }, commands),
            Kind::Look | Kind::SecondLook => self.begin(Work::Picture { task }, commands),
            Kind::Screws => {
                let screws = fixed.screws.clone();
                if (0..self.arms.len()).any(|arm| !screws[arm].is_empty() && self.arms[arm].task.is_some()) {
                    return false;
                }
                for (arm, screws) in screws.into_iter().enumerate().filter(|(_, screws)| !screws.is_empty()) {
                    self.arms[arm].task = Some(task);
                    self.arms[arm].left = screws.into_iter().map(|(screw, _)| (screw, 0)).collect();
                }
            }
            Kind::Cover => {
                let Some((arm, reach_mm)) = fixed.pull else {
                    return false;
                };
                if self.arms[arm].task.is_some() || !self.take(arm, reach_mm) {
                    return false;
                }
                self.arms[arm].task = Some(task);
                self.arms[arm].busy = true;
                self.begin(Work::Pull { task, arm }, commands);
            }
        }
        self.progress[task].begun = true;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::{Limits, Product, solve};
    use stateright::{Checker, Model, Property};

    const SMALL: &str = r#"
        product = "small"
        loaded = "front"
        [[faces]]
        name = "front"
        side = "front"
        screws_mm = [[-350, 300], [60, 300], [350, 300]]
        [[faces]]
        name = "inner"
        side = "front"
        screws_mm = [[-200, 500], [300, 500]]
        after_covers = ["lid"]
        [[covers]]
        name = "lid"
        side = "top"
        width_mm = 800
        held_by = ["front"]
        [[covers]]
        name = "back"
        side = "front"
        width_mm = 800
        requires_any = [{ covers = ["lid"] }, { faces = ["front"] }]
    "#;

    fn problem(text: &str, arms: usize, tables: usize, units: usize) -> (Problem, Vec<Placed>) {
        let product = Product::parse(text, "small.toml").expect("product");
        let station = Station::new(arms, tables).expect("station");
        let problem = Problem::new(&product, &station, units).expect("problem");
        let limits = Limits {
            rounds: 3,
            steps: 2000,
            ..Limits::default()
        };
        let plan = solve(&problem, &limits, |_| {});
        problem.check(&plan.placed).expect("valid");
        (problem, plan.placed)
    }

    /// A dispatcher and the world that it sees: where each arm comes from and goes to.
    #[derive(Clone, Debug, PartialEq, Eq, Hash)]
    struct Cell {
        dispatcher: Dispatcher,
        /// Where each arm is across, `None` at rest.
        at_mm: Vec<Option<i64>>,
        sweeps_mm: Vec<Option<(i64, i64)>>,
        begun: Vec<Work>,
        repeated: bool,
        meets: bool,
    }

    impl Cell {
        /// Tells it of an event, and notes which strip of the room each arm sweeps by the problem's own places: from where it stands to the
        /// screw and back to its rest.
        fn told(&mut self, event: Event, model: &AllOrders) {
            let before = self.at_mm.clone();
            let commands = self.dispatcher.step(event);
            let under_way: Vec<usize> = self.dispatcher.open.values().filter_map(arm_of).collect();
            for (arm, sweep) in self.sweeps_mm.iter_mut().enumerate() {
                let at_rest = !under_way.contains(&arm) && self.dispatcher.arms[arm].at_mm.is_none();
                if at_rest {
                    self.at_mm[arm] = None;
                }
                if at_rest
                    || self
                        .dispatcher
                        .open
                        .values()
                        .any(|w| matches!(w, Work::LayAside { arm: a, .. } if *a == arm))
                {
                    *sweep = None;
                }
            }
            for command in commands {
                let rest_mm = |arm: usize| model.problem.station.arms[arm].rest_y_mm as i64;
                let over =
                    |places: &[i64]| Some((*places.iter().min().expect("one"), *places.iter().max().expect("one")));
                match command.work {
                    Work::Drive { task, arm, screw, .. } => {
                        let task = &model.problem.tasks[task];
                        let table_mm = model.problem.station.tables_y_mm[task.table];
                        let to = (table_mm + model.problem.product.faces[task.part].screws_mm[screw][0]) as i64;
                        self.sweeps_mm[arm] = over(&[before[arm].unwrap_or(rest_mm(arm)), to, rest_mm(arm)]);
                        self.at_mm[arm] = Some(to);
                    }
                    Work::Withdraw { arm } => {
                        self.sweeps_mm[arm] = over(&[before[arm].unwrap_or(rest_mm(arm)), rest_mm(arm)]);
                    }
                    Work::Pull { task, arm } => {
                        let task = &model.problem.tasks[task];
                        let table_mm = model.problem.station.tables_y_mm[task.table] as i64;
                        let half_mm = (0.5 * model.problem.product.covers[task.part].width_mm) as i64;
                        self.sweeps_mm[arm] = over(&[table_mm - half_mm, table_mm + half_mm, rest_mm(arm)]);
                    }
                    _ => {}
                }
                if !matches!(command.work, Work::Withdraw { .. } | Work::Turn { .. }) {
                    self.repeated |= self.begun.contains(&command.work);
                    self.begun.push(command.work);
                    self.begun.sort();
                }
            }
            if let [Some((_, right)), Some((left, _))] = self.sweeps_mm[..] {
                self.meets |= right + model.problem.station.clearance_mm as i64 > left;
            }
        }
    }

    fn arm_of(work: &Work) -> Option<usize> {
        match work {
            Work::Drive { arm, .. } | Work::Withdraw { arm } | Work::Pull { arm, .. } | Work::LayAside { arm, .. } => {
                Some(*arm)
            }
            _ => None,
        }
    }

    /// Every order in which events can come, and every failure; a turn that fails would be tried for ever.
    struct AllOrders {
        dispatcher: Dispatcher,
        problem: Problem,
    }

    impl Model for AllOrders {
        type State = Cell;
        type Action = Event;

        fn init_states(&self) -> Vec<Cell> {
            let mut cell = Cell {
                at_mm: vec![None; self.dispatcher.arms.len()],
                sweeps_mm: vec![None; self.dispatcher.arms.len()],
                dispatcher: self.dispatcher.clone(),
                begun: Vec::new(),
                repeated: false,
                meets: false,
            };
            cell.told(Event::Begin, self);
            vec![cell]
        }

        fn actions(&self, cell: &Cell, actions: &mut Vec<Event>) {
            for (ticket, work) in cell.dispatcher.open() {
                actions.push(Event::Done(ticket));
                if !matches!(work, Work::Turn { .. } | Work::Withdraw { .. } | Work::LayAside { .. }) {
                    actions.push(Event::Failed(ticket));
                }
            }
        }

        fn next_state(&self, cell: &Cell, event: Event) -> Option<Cell> {
            let mut next = cell.clone();
            next.told(event, self);
            Some(next)
        }

        fn properties(&self) -> Vec<Property<Self>> {
            vec![
                Property::always("arms keep their distance", |_, cell: &Cell| !cell.meets),
                Property::always("nothing is begun twice", |_, cell: &Cell| !cell.repeated),
                Property::always("something is under way, or all is over", |_, cell: &Cell| {
                    cell.dispatcher.open.is_empty() == cell.dispatcher.is_finished()
                }),
                Property::sometimes("everything comes off", |_, cell: &Cell| {
                    cell.dispatcher.is_finished() && cell.dispatcher.dropped().next().is_none()
                }),
                Property::sometimes("a screw stays", |_, cell: &Cell| !cell.dispatcher.left_in().is_empty()),
            ]
        }
    }

    fn check_all(text: &str, arms: usize, tables: usize, units: usize, retries: u8) -> usize {
        let (problem, placed) = problem(text, arms, tables, units);
        let model = AllOrders {
            dispatcher: Dispatcher::new(&problem, &placed, retries),
            problem,
        };
        let checker = model.checker().threads(2).spawn_bfs().join();
        checker.assert_properties();
        checker.unique_state_count()
    }

    #[test]
    fn no_order_of_events_and_no_failure_leads_astray() {
        let states = check_all(SMALL, 2, 1, 1, 1);
        assert!(states > 1000, "{states} states");
        check_all(SMALL, 1, 1, 1, 1);
    }

    /// Two tables with one face each, so that the arms cross between them if they are let.
    #[test]
    fn two_tables_neither() {
        let text = r#"
            product = "plate"
            loaded = "front"
            [[faces]]
            name = "front"
            side = "front"
            screws_mm = [[-350, 300], [0, 300], [350, 300]]
        "#;
        let states = check_all(text, 2, 2, 2, 0);
        assert!(states > 100, "{states} states");
    }

    /// One face that two arms share, and where each of them is or goes by its commands.
    #[derive(Clone, Debug, PartialEq, Eq, Hash)]
    struct Face {
        dispatcher: Dispatcher,
        /// Screws of each arm: where it stands or comes from, and where it goes.
        at: [Vec<usize>; 2],
        driven: Vec<(usize, u8)>,
        meets: bool,
    }

    /// Every order of events and every failure at a face: reach of each screw by its number.
    struct AtFace {
        dispatcher: Dispatcher,
        reach: [usize; 6],
    }

    impl AtFace {
        fn told(&self, face: &mut Face, event: Event) {
            let ended = match event {
                Event::Done(ticket) | Event::Failed(ticket) => face.dispatcher.open.get(&ticket).cloned(),
                Event::Begin => None,
            };
            match ended {
                Some(Work::Drive { arm, screw, .. }) => face.at[arm] = vec![screw],
                Some(Work::Withdraw { arm }) => face.at[arm].clear(),
                _ => {}
            }
            for command in face.dispatcher.step(event) {
                if let Work::Drive {
                    arm, screw, attempt, ..
                } = command.work
                {
                    face.at[arm].push(screw);
                    face.driven.push((screw, attempt));
                    face.driven.sort_unstable();
                }
            }
            let [right, left] = [0, 1].map(|arm| face.at[arm].iter().map(|screw| self.reach[*screw]));
            if let (Some(right), Some(left)) = (right.max(), left.min()) {
                face.meets |= right >= left;
            }
        }
    }

    impl Model for AtFace {
        type State = Face;
        type Action = Event;

        fn init_states(&self) -> Vec<Face> {
            let mut face = Face {
                dispatcher: self.dispatcher.clone(),
                at: [Vec::new(), Vec::new()],
                driven: Vec::new(),
                meets: false,
            };
            self.told(&mut face, Event::Begin);
            vec![face]
        }

        fn actions(&self, face: &Face, actions: &mut Vec<Event>) {
            for (ticket, work) in face.dispatcher.open() {
                actions.push(Event::Done(ticket));
                if matches!(work, Work::Drive { .. }) {
                    actions.push(Event::Failed(ticket));
                }
            }
        }

        fn next_state(&self, face: &Face, event: Event) -> Option<Face> {
            let mut next = face.clone();
            self.told(&mut next, event);
            Some(next)
        }

        fn properties(&self) -> Vec<Property<Self>> {
            vec![
                Property::always("arms keep apart", |_, face: &Face| !face.meets),
                Property::always("no burst is begun twice", |_, face: &Face| {
                    face.driven.windows(2).all(|pair| pair[0] != pair[1])
                }),
                Property::always("something is under way, or all is over", |_, face: &Face| {
                    face.dispatcher.open.is_empty() == face.dispatcher.is_finished()
                }),
                Property::always("no screw is left out", |_, face: &Face| {
                    let all = (0..6).all(|screw| face.driven.contains(&(screw, 0)));
                    all || !face.dispatcher.is_finished()
                }),
                Property::sometimes("both are at work", |_, face: &Face| {
                    face.at.iter().all(|at| !at.is_empty())
                }),
            ]
        }
    }

    #[test]
    fn two_arms_at_a_face_never_wait_for_each_other_in_a_circle() {
        // the right arm's screws and the left one's, with how far each reaches
        for reach in [
            [0, 2, 3, 4, 2, 1],
            [0, 3, 1, 1, 3, 2],
            [1, 3, 0, 2, 4, 1],
            [1, 2, 3, 3, 2, 1],
        ] {
            for first in [0, 1] {
                let of = |screws: std::ops::Range<usize>| screws.map(|k| (k, Some(reach[k]))).collect();
                let model = AtFace {
                    dispatcher: Dispatcher::at_face([of(0..3), of(3..6)], first, 1),
                    reach,
                };
                let checker = model.checker().threads(2).spawn_bfs().join();
                checker.assert_properties();
                assert!(checker.unique_state_count() > 100, "{}", checker.unique_state_count());
            }
        }
    }

    /// Where nothing is said of the room, one arm does all of its own before the other begins.
    #[test]
    fn without_room_one_arm_rests() {
        let mut dispatcher = Dispatcher::at_face([vec![(0, None), (1, None)], vec![(2, None)]], 1, 0);
        let mut commands: VecDeque<Command> = dispatcher.step(Event::Begin).into();
        let mut order = Vec::new();
        while let Some(command) = commands.pop_front() {
            assert!(commands.is_empty(), "one at a time: {commands:?}");
            order.push(match command.work {
                Work::Drive { screw, .. } => format!("screw {screw}"),
                Work::Withdraw { arm } => format!("arm {arm} home"),
                other => format!("{other:?}"),
            });
            commands.extend(dispatcher.step(Event::Done(command.ticket)));
        }
        assert_eq!(order, ["screw 2", "arm 1 home", "screw 0", "screw 1", "arm 0 home"]);
    }

    /// The shipped unit with events in the order of planned times; one screw never comes out.
    #[test]
    fn a_screw_that_stays_keeps_its_covers() {
        let product = Product::outdoor_unit().expect("built-in");
        let problem = Problem::new(&product, &Station::new(2, 1).expect("station"), 1).expect("problem");
        let plan = solve(
            &problem,
            &Limits {
                rounds: 2,
                ..Limits::default()
            },
            |_| {},
        );
        let run = |stuck: Option<(usize, usize)>| {
            let mut dispatcher = Dispatcher::new(&problem, &plan.placed, 2);
            let mut commands: VecDeque<Command> = dispatcher.step(Event::Begin).into();
            let mut count = 0;
            while let Some(command) = commands.pop_front() {
                let fails = matches!(command.work, Work::Drive { task, screw, .. } if stuck == Some((task, screw)));
                count += usize::from(fails);
                let event = if fails {
                    Event::Failed(command.ticket)
                } else {
                    Event::Done(command.ticket)
                };
                commands.extend(dispatcher.step(event));
            }
            assert!(dispatcher.is_finished());
            (dispatcher, count)
        };
        let (all, _) = run(None);
        assert_eq!(all.dropped().count(), 0);
        let right = problem
            .tasks
            .iter()
            .position(|t| t.name == "1 right screws")
            .expect("task");
        let (stuck, attempts) = run(Some((right, 3)));
        assert_eq!(attempts, 3);
        assert_eq!(stuck.left_in(), [(right, 3)]);
        let dropped: Vec<&str> = stuck.dropped().map(|k| problem.tasks[k].name.as_str()).collect();
        assert!(
            dropped.contains(&"1 top cover") && dropped.contains(&"1 right cover"),
            "{dropped:?}"
        );
        assert!(!dropped.contains(&"1 discharge"), "{dropped:?}");
    }
}
