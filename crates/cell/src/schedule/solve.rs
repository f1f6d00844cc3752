//! The best schedule that can be found in the time, and a lower bound that says how much better any could be.
//!
//! Every rule is either "not before" or "one after the other, with a gap", so a schedule is an order of the tasks, each begun as early as
//! what stands before it in the order allows; an optimal one can be written with its tasks sorted by their begin. Three parts build on that:
//!
//! - **local search** over orders, from the first moment on: tasks moved, swapped, done another way (simulated annealing);
//! - **branch and bound** in layers, one task more in each: nodes that can be no better than the best plan are cut, of two nodes with the
//!   same tasks done the one that is nowhere earlier is dropped, and of the rest a number goes on which quadruples from round to round.
//!   A round in which none was left out has proven its best;
//! - **the bound**: the same search on relaxed tasks, in which arms that share a face take what no division of its screws can be below and
//!   never wait for each other (a face is done in one go, its arms taken from its begin). The least bound of whatever a round left out is a lower bound of everything.

use super::task::{After, Placed, Problem, SLACK_S, Task};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// How long to look for a better plan. For one seed the result depends on the machine only if the time ends it.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Wall clock at most, s.
    pub time_s: f64,
    /// Rounds of branch and bound at most.
    pub rounds: u32,
    /// Steps of the local search.
    pub steps: u32,
    /// Seed of the local search.
    pub seed: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            time_s: 10.0,
            rounds: 7,
            steps: 30_000,
            seed: 1,
        }
    }
}

/// A schedule and how good it is.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// The tasks in the order of their begin.
    pub placed: Vec<Placed>,
    /// Until everything is over, s.
    pub makespan_s: f64,
    /// No schedule is shorter, however the screws of a face are divided, s.
    pub bound_s: f64,
    /// True if no schedule of these tasks and ways is shorter; the bound may be lower, as it allows every division of a face.
    pub is_best: bool,
    /// When it was found, s after the search began.
    pub found_after_s: f64,
    /// How long the search took, s.
    pub searched_s: f64,
}

impl Plan {
    /// How far the plan may be above the best, as a part of the bound.
    pub fn gap(&self) -> f64 {
        self.makespan_s / self.bound_s.max(SLACK_S) - 1.0
    }
}

/// Nodes of a layer in the first round.
const FIRST_WIDTH: usize = 16;
/// How much wider each round is.
const WIDER: usize = 4;
/// Of the nodes with the same tasks done, so many are compared with a new one.
const COMPARED: usize = 48;

/// Sums of the same times in another order differ by less, s: well below what makes a begin earlier.
const ROUNDING_S: f64 = 1e-9;

/// Plans, better and better: `on_better` is called for the first plan, for each that is shorter, and when the bound has risen.
pub fn solve(problem: &Problem, limits: &Limits, mut on_better: impl FnMut(&Plan)) -> Plan {
    let began = Instant::now();
    let until = began + Duration::from_secs_f64(limits.time_s.clamp(0.0, 1e6));
    let turn_s = problem.product.times_s.turn;
    let clearance_mm = problem.station.clearance_mm;
    let search = Search::new(&problem.tasks, turn_s, clearance_mm);
    let relaxed = Search::new(&problem.relaxed, turn_s, clearance_mm);
    let order = search.greedy();
    let mut plan = Plan {
        makespan_s: search.evaluate(&order).1,
        placed: search.placed(&order),
        bound_s: relaxed.root_bound_s(),
        is_best: false,
        found_after_s: began.elapsed().as_secs_f64(),
        searched_s: 0.0,
    };
    on_better(&plan);
    let mut take = |plan: &mut Plan, order: &[usize], makespan_s: f64| {
        if makespan_s + SLACK_S < plan.makespan_s {
            plan.makespan_s = makespan_s;
            plan.placed = search.placed(order);
            plan.found_after_s = began.elapsed().as_secs_f64();
            on_better(plan);
        }
    };
    // a short bound first, so that the first good plan knows how good it is
    let mut is_bounded = false;
    let raise = |plan: &mut Plan, is_bounded: &mut bool, width: usize| {
        if !*is_bounded {
            let round = relaxed.round(width, plan.makespan_s, until);
            plan.bound_s = plan.bound_s.max(round.bound_s.min(plan.makespan_s));
            *is_bounded = round.is_whole;
        }
    };
    raise(&mut plan, &mut is_bounded, FIRST_WIDTH);
    let (order, makespan_s) = search.anneal(order, limits, until);
    take(&mut plan, &order, makespan_s);
    let mut width = FIRST_WIDTH;
    for _ in 0..limits.rounds {
        if (plan.is_best && is_bounded) || plan.gap() < 1e-6 || Instant::now() >= until {
            break;
        }
        // two cores: one looks for a better plan, the other for a better bound
        let best_s = plan.makespan_s;
        let (found, bound) = std::thread::scope(|scope| {
            let bound = (!is_bounded).then(|| scope.spawn(|| relaxed.round(width, best_s, until)));
            let found = (!plan.is_best).then(|| search.round(width, best_s, until));
            (found, bound.and_then(|job| job.join().ok()))
        });
        if let Some(round) = bound {
            plan.bound_s = plan.bound_s.max(round.bound_s.min(plan.makespan_s));
            is_bounded = round.is_whole;
        }
        if let Some(round) = found {
            plan.is_best = round.is_whole;
            if let Some((order, makespan_s)) = round.best {
                take(&mut plan, &order, makespan_s);
            }
        }
        width *= WIDER;
    }
    plan.bound_s = plan.bound_s.min(plan.makespan_s);
    plan.is_best |= plan.gap() < 1e-6;
    plan.searched_s = began.elapsed().as_secs_f64();
    on_better(&plan);
    plan
}

/// A task done in one of its ways.
#[derive(Clone, Copy)]
struct Variant {
    task: usize,
    mode: usize,
    table_s: f64,
    end_s: f64,
    lead_s: f64,
}

/// Everything about the tasks that the search needs, as numbers.
struct Search<'a> {
    tasks: &'a [Task],
    variants: Vec<Variant>,
    /// Variants of each task.
    of_task: Vec<std::ops::Range<usize>>,
    /// Gap between the begins of two variants if the first stands before the second in the order; below 0: none.
    gap_s: Vec<f64>,
    /// Tasks that have to stand before each.
    before: Vec<u128>,
    /// How long each task binds the table at least.
    least_table_s: Vec<f64>,
    /// Time from the begin of each task to the end of everything, at least.
    tail_s: Vec<f64>,
    /// Tasks of a unit that can never overlap, whatever way they are done: for the bound.
    chains: Vec<Vec<usize>>,
    turn_s: f64,
    arms: usize,
}

/// A beginning of an order.
#[derive(Clone)]
struct Node {
    done: u128,
    /// Earliest begin of each variant, as far as what is done says.
    ready_s: Vec<f64>,
    /// End at the table of each task that is done.
    end_s: Vec<f64>,
    order: Vec<usize>,
    last_s: f64,
    /// Sum of the begins, s.
    sum_s: f64,
    over_s: f64,
    bound_s: f64,
}

/// What a round of branch and bound found.
struct Round {
    /// An order better than the one to beat.
    best: Option<(Vec<usize>, f64)>,
    /// No order is shorter.
    bound_s: f64,
    /// Nothing was left out.
    is_whole: bool,
}

impl<'a> Search<'a> {
    fn new(tasks: &'a [Task], turn_s: f64, clearance_mm: f64) -> Self {
        let mut variants = Vec::new();
        let mut of_task = Vec::new();
        for (k, task) in tasks.iter().enumerate() {
            let first = variants.len();
            variants.extend(task.modes.iter().enumerate().map(|(m, mode)| Variant {
                task: k,
                mode: m,
                table_s: mode.table_s,
                end_s: mode.end_s(),
                lead_s: mode.lead_s,
            }));
            of_task.push(first..variants.len());
        }
        let mut search = Self {
            tasks,
            gap_s: vec![-1.0; variants.len() * variants.len()],
            before: tasks
                .iter()
                .map(|t| t.after.iter().fold(0, |set, a| set | 1 << a.task))
                .collect(),
            least_table_s: tasks
                .iter()
                .map(|t| t.modes.iter().map(|m| m.table_s).fold(f64::INFINITY, f64::min))
                .collect(),
            tail_s: vec![0.0; tasks.len()],
            chains: Vec::new(),
            turn_s,
            arms: tasks.first().map_or(0, |t| t.modes[0].arms.len()),
            variants,
            of_task,
        };
        let count = search.variants.len();
        for (v, w) in (0..count).flat_map(|v| (0..count).map(move |w| (v, w))) {
            search.gap_s[v * count + w] = search.gap(v, w, clearance_mm);
        }
        search.set_tails();
        search.set_chains();
        search
    }

    /// Gap between the begins of `v` and `w` if `v` comes first.
    fn gap(&self, v: usize, w: usize, clearance_mm: f64) -> f64 {
        let (a, b) = (&self.variants[v], &self.variants[w]);
        let (ta, tb) = (&self.tasks[a.task], &self.tasks[b.task]);
        if a.task == b.task {
            return -1.0;
        }
        let mut gap_s = -1.0f64;
        for after in tb.after.iter().filter(|after| after.task == a.task) {
            gap_s = gap_s.max(lagged_s(after, a, b));
        }
        if ta.unit == tb.unit {
            if ta.alone || tb.alone {
                gap_s = gap_s.max(a.table_s);
            }
            if ta.side.is_some() && tb.side.is_some() && ta.side != tb.side {
                gap_s = gap_s.max(a.table_s + self.turn_s);
            }
        }
        let (ma, mb) = (&ta.modes[a.mode], &tb.modes[b.mode]);
        for (i, one) in ma.arms.iter().enumerate() {
            for (j, other) in mb.arms.iter().enumerate() {
                let (Some(one), Some(other)) = (one, other) else {
                    continue;
                };
                let apart = match i.cmp(&j) {
                    std::cmp::Ordering::Equal => {
                        gap_s = gap_s.max(one.busy_s);
                        continue;
                    }
                    std::cmp::Ordering::Less => one.strip.is_clear_of(&other.strip, clearance_mm),
                    std::cmp::Ordering::Greater => other.strip.is_clear_of(&one.strip, clearance_mm),
                };
                if !apart {
                    gap_s = gap_s.max(one.strip_s);
                }
            }
        }
        gap_s
    }

    fn gap_between(&self, v: usize, w: usize) -> f64 {
        self.gap_s[v * self.variants.len() + w]
    }

    /// Least gap between two tasks in this order, over all ways; below 0 if some ways may overlap.
    fn least_gap_s(&self, first: usize, second: usize) -> f64 {
        let pairs = self.of_task[first]
            .clone()
            .flat_map(|v| self.of_task[second].clone().map(move |w| (v, w)));
        pairs.map(|(v, w)| self.gap_between(v, w)).fold(f64::INFINITY, f64::min)
    }

    /// Longest ways to the end, by relaxation: predecessors may have higher numbers.
    fn set_tails(&mut self) {
        for k in 0..self.tasks.len() {
            self.tail_s[k] = self.of_task[k]
                .clone()
                .map(|v| self.variants[v].end_s)
                .fold(f64::INFINITY, f64::min);
        }
        for _ in 0..self.tasks.len() {
            let mut is_still = true;
            for (k, after) in self
                .tasks
                .iter()
                .enumerate()
                .flat_map(|(k, t)| t.after.iter().map(move |a| (k, a)))
            {
                let tail_s = self.least_gap_s(after.task, k) + self.tail_s[k];
                if tail_s > self.tail_s[after.task] + SLACK_S {
                    self.tail_s[after.task] = tail_s;
                    is_still = false;
                }
            }
            if is_still {
                break;
            }
        }
    }

    fn set_chains(&mut self) {
        // what comes before what, through others too
        let n = self.tasks.len();
        let mut before = self.before.clone();
        for _ in 0..n {
            for k in 0..n {
                let through = (0..n)
                    .filter(|i| before[k] >> i & 1 == 1)
                    .fold(0, |set, i| set | before[i]);
                before[k] |= through;
            }
        }
        let exclude = |a: usize, b: usize| {
            before[a] >> b & 1 == 1
                || before[b] >> a & 1 == 1
                || (self.least_gap_s(a, b) >= self.least_table_s[a] && self.least_gap_s(b, a) >= self.least_table_s[b])
        };
        let units = self.tasks.iter().map(|t| t.unit).max().map_or(0, |last| last + 1);
        let mut chains = Vec::new();
        for unit in 0..units {
            let mut tasks: Vec<usize> = (0..n).filter(|&k| self.tasks[k].unit == unit).collect();
            tasks.sort_by(|&a, &b| self.least_table_s[b].total_cmp(&self.least_table_s[a]));
            let mut chain: Vec<usize> = Vec::new();
            for task in tasks {
                if chain.iter().all(|&other| exclude(task, other)) {
                    chain.push(task);
                }
            }
            chains.push(chain);
        }
        self.chains = chains;
    }

    fn root(&self) -> Node {
        Node {
            done: 0,
            ready_s: vec![0.0; self.variants.len()],
            end_s: vec![0.0; self.tasks.len()],
            order: Vec::new(),
            last_s: 0.0,
            sum_s: 0.0,
            over_s: 0.0,
            bound_s: 0.0,
        }
    }

    fn root_bound_s(&self) -> f64 {
        self.bound_s(&self.root())
    }

    /// Earliest begin of a variant after a node; `None` if something is still missing.
    fn begin_s(&self, node: &Node, v: usize) -> Option<f64> {
        let variant = &self.variants[v];
        let task = &self.tasks[variant.task];
        if node.done >> variant.task & 1 == 1 || self.before[variant.task] & !node.done != 0 {
            return None;
        }
        if task.after_any.is_empty() {
            return Some(node.ready_s[v]);
        }
        let way = |way: &Vec<After>| {
            let over = |a: &After| node.end_s[a.task] + (a.lag_s - variant.lead_s).max(0.0);
            let is_done = way.iter().all(|a| node.done >> a.task & 1 == 1);
            is_done.then(|| way.iter().map(over).fold(0.0, f64::max))
        };
        let free_s = task.after_any.iter().filter_map(way).fold(f64::INFINITY, f64::min);
        free_s.is_finite().then_some(node.ready_s[v].max(free_s))
    }

    fn place(&self, node: &mut Node, v: usize, start_s: f64) {
        let variant = &self.variants[v];
        node.done |= 1 << variant.task;
        node.end_s[variant.task] = start_s + variant.table_s;
        node.over_s = node.over_s.max(start_s + variant.end_s);
        node.last_s = start_s;
        node.sum_s += start_s;
        node.order.push(v);
        let gaps = &self.gap_s[v * self.variants.len()..(v + 1) * self.variants.len()];
        for (ready, gap) in node.ready_s.iter_mut().zip(gaps) {
            if *gap >= 0.0 {
                *ready = ready.max(start_s + gap);
            }
        }
    }

    /// No way of going on from a node ends earlier.
    fn bound_s(&self, node: &Node) -> f64 {
        let mut bound_s = node.over_s;
        let (mut work_s, mut tail_s) = (0.0, f64::INFINITY);
        let mut arms_s = vec![f64::INFINITY; self.arms];
        let mut begins_s = vec![0.0; self.tasks.len()];
        for (k, task) in self.tasks.iter().enumerate().filter(|(k, _)| node.done >> k & 1 == 0) {
            let variants = self.of_task[k].clone();
            let begin_s = variants.clone().map(|v| node.ready_s[v]).fold(f64::INFINITY, f64::min);
            let begin_s = begin_s.max(node.last_s);
            begins_s[k] = begin_s;
            bound_s = bound_s.max(begin_s + self.tail_s[k]);
            let least_s = task.modes.iter().map(|m| m.work_s).fold(f64::INFINITY, f64::min);
            if least_s > 0.0 {
                work_s += least_s;
                let longest_s = task.modes.iter().map(|m| m.end_s()).fold(0.0, f64::max);
                tail_s = f64::min(tail_s, self.tail_s[k] - longest_s);
                for (v, mode) in variants.zip(&task.modes) {
                    for (free_s, _) in arms_s.iter_mut().zip(&mode.arms).filter(|(_, used)| used.is_some()) {
                        *free_s = free_s.min(node.ready_s[v].max(node.last_s));
                    }
                }
            }
        }
        if work_s > 0.0 {
            arms_s.retain(|s| s.is_finite());
            bound_s = bound_s.max(shared_until_s(arms_s, work_s) + tail_s.max(0.0));
        }
        for chain in &self.chains {
            let (mut begin_s, mut sum_s, mut tail_s) = (f64::INFINITY, 0.0, f64::INFINITY);
            let mut sides = 0u64;
            for &k in chain.iter().filter(|&&k| node.done >> k & 1 == 0) {
                let table_s = self.least_table_s[k];
                begin_s = begin_s.min(begins_s[k]);
                sum_s += table_s;
                tail_s = tail_s.min(self.tail_s[k] - table_s);
                sides |= self.tasks[k].side.map_or(0, |side| 1 << side.min(63));
            }
            if sum_s > 0.0 {
                let turns = sides.count_ones().saturating_sub(1);
                bound_s = bound_s.max(begin_s + sum_s + f64::from(turns) * self.turn_s + tail_s.max(0.0));
            }
        }
        bound_s
    }

    /// A first order: always what can begin earliest, then what has most behind it.
    fn greedy(&self) -> Vec<usize> {
        let mut node = self.root();
        while node.order.len() < self.tasks.len() {
            let next = (0..self.variants.len())
                .filter_map(|v| self.begin_s(&node, v).map(|start_s| (v, start_s)))
                .min_by(|a, b| {
                    let rank = |&(v, start_s): &(usize, f64)| {
                        let variant = &self.variants[v];
                        start_s + variant.table_s - 0.01 * self.tail_s[variant.task]
                    };
                    rank(a).total_cmp(&rank(b))
                });
            let Some((v, start_s)) = next else { break };
            self.place(&mut node, v, start_s);
        }
        node.order
    }

    /// Begins and end of an order of variants; an order that does the second before the first never ends.
    fn evaluate(&self, order: &[usize]) -> (Vec<f64>, f64) {
        let mut node = self.root();
        let mut starts_s = Vec::with_capacity(order.len());
        for &v in order {
            let Some(start_s) = self.begin_s(&node, v) else {
                return (starts_s, f64::INFINITY);
            };
            self.place(&mut node, v, start_s);
            starts_s.push(start_s);
        }
        (starts_s, node.over_s)
    }

    fn placed(&self, order: &[usize]) -> Vec<Placed> {
        let (starts_s, _) = self.evaluate(order);
        let mut placed: Vec<Placed> = order
            .iter()
            .zip(starts_s)
            .map(|(&v, start_s)| Placed {
                task: self.variants[v].task,
                mode: self.variants[v].mode,
                start_s,
            })
            .collect();
        placed.sort_by(|a, b| a.start_s.total_cmp(&b.start_s));
        placed
    }

    /// Simulated annealing over orders and ways.
    fn anneal(&self, order: Vec<usize>, limits: &Limits, until: Instant) -> (Vec<usize>, f64) {
        let mut rng = Pcg64Mcg::seed_from_u64(limits.seed);
        let mut now_s = self.evaluate(&order).1;
        let (mut best, mut best_s) = (order.clone(), now_s);
        let mut order = order;
        let n = order.len();
        if n < 2 {
            return (best, best_s);
        }
        for step in 0..limits.steps {
            if step % 256 == 0 && Instant::now() >= until {
                break;
            }
            let heat_s = 3.0 * (1.0 - f64::from(step) / f64::from(limits.steps));
            let mut tried = order.clone();
            let from = rng.random_range(0..n);
            if rng.random_range(0..3) == 0 {
                let ways = self.of_task[self.variants[tried[from]].task].clone();
                tried[from] = rng.random_range(ways);
            } else {
                let reach = 8.min(n - 1);
                let to = (from + rng.random_range(1..=2 * reach))
                    .saturating_sub(reach)
                    .min(n - 1);
                let moved = tried.remove(from);
                tried.insert(to, moved);
            }
            if tried == order {
                continue;
            }
            let tried_s = self.evaluate(&tried).1;
            let worse_s = tried_s - now_s;
            if worse_s <= 0.0 || (worse_s.is_finite() && rng.random::<f64>() < (-worse_s / heat_s.max(1e-9)).exp()) {
                (order, now_s) = (tried, tried_s);
                if now_s + SLACK_S < best_s {
                    (best, best_s) = (order.clone(), now_s);
                }
            }
        }
        (best, best_s)
    }

    /// Branch and bound with at most so many nodes a layer.
    fn round(&self, width: usize, to_beat_s: f64, until: Instant) -> Round {
        let mut round = Round {
            best: None,
            bound_s: to_beat_s,
            is_whole: true,
        };
        let mut best_s = to_beat_s;
        let mut layer = vec![self.root()];
        while !layer.is_empty() {
            let mut children: Vec<Node> = Vec::new();
            for node in &layer {
                if Instant::now() >= until {
                    // what is open stays open
                    let open = layer.iter().chain(&children).map(|n| n.bound_s);
                    round.bound_s = open.fold(round.bound_s, f64::min);
                    round.is_whole = false;
                    return round;
                }
                for v in 0..self.variants.len() {
                    let Some(start_s) = self.begin_s(node, v) else { continue };
                    // sorted by begin: what could have begun before the last one belongs before it
                    if start_s < node.last_s - SLACK_S {
                        continue;
                    }
                    let mut child = node.clone();
                    self.place(&mut child, v, start_s);
                    if child.order.len() == self.tasks.len() {
                        if child.over_s + SLACK_S < best_s {
                            best_s = child.over_s;
                            round.best = Some((child.order, best_s));
                        }
                        continue;
                    }
                    child.bound_s = self.bound_s(&child).max(node.bound_s);
                    if child.bound_s + SLACK_S < best_s {
                        children.push(child);
                    }
                }
            }
            let promise = |n: &Node| n.bound_s + 0.02 * n.last_s;
            children.sort_by(|a, b| promise(a).total_cmp(&promise(b)));
            layer = self.undominated(children);
            if layer.len() > width {
                let left = layer.drain(width..);
                round.bound_s = left.map(|n| n.bound_s).fold(round.bound_s, f64::min);
                round.is_whole = false;
            }
        }
        round.bound_s = round.bound_s.min(best_s);
        round
    }

    /// Drops nodes with the same tasks done that are nowhere earlier than another one.
    fn undominated(&self, nodes: Vec<Node>) -> Vec<Node> {
        let mut kept: Vec<Node> = Vec::new();
        let mut groups: HashMap<u128, Vec<usize>> = HashMap::new();
        for node in nodes {
            let group = groups.entry(node.done).or_default();
            if group.iter().take(COMPARED).any(|&k| self.is_no_later(&kept[k], &node)) {
                continue;
            }
            group.push(kept.len());
            kept.push(node);
        }
        kept
    }

    /// True if whatever follows can begin no later after `a` than after `b`; both have done the same tasks.
    ///
    /// The begins of `a` may not add up to more either. What follows `b` may, after `a`, begin even before the last task of `a`; then it is
    /// the order sorted by begin that has to be found, elsewhere, and there it may be dropped for a third node, and so on round to `b`. With
    /// the sum no such circle closes: of the best schedules, the one with the least sum has no earlier begin left, whichever node it goes on from.
    fn is_no_later(&self, a: &Node, b: &Node) -> bool {
        if a.over_s > b.over_s + SLACK_S || a.sum_s > b.sum_s + ROUNDING_S {
            return false;
        }
        let is_open = |task: usize| a.done >> task & 1 == 0;
        let variants = self
            .variants
            .iter()
            .enumerate()
            .filter(|(_, variant)| is_open(variant.task));
        for (v, _) in variants {
            if a.ready_s[v].max(a.last_s) > b.ready_s[v].max(b.last_s) + SLACK_S {
                return false;
            }
        }
        let alternatives = self.tasks.iter().enumerate().filter(|(k, _)| is_open(*k));
        let mut members = alternatives.flat_map(|(_, task)| task.after_any.iter().flatten());
        members.all(|after| is_open(after.task) || a.end_s[after.task] <= b.end_s[after.task] + SLACK_S)
    }
}

/// When arms that are free from these moments on can have done so much work together, at the earliest. An arm that is free only after
/// that moment takes no part: a mean over all of them would count its wait as work that the others have done less of.
fn shared_until_s(mut free_s: Vec<f64>, work_s: f64) -> f64 {
    free_s.sort_by(f64::total_cmp);
    let (mut sum_s, mut until_s) = (work_s, f64::INFINITY);
    for (k, free_s) in free_s.into_iter().enumerate() {
        sum_s += free_s;
        until_s = until_s.min(sum_s / (k + 1) as f64);
    }
    until_s
}

/// Gap between begins by a precedence: the second one's approach may overlap the wait for the result.
fn lagged_s(after: &After, first: &Variant, second: &Variant) -> f64 {
    first.table_s + (after.lag_s - second.lead_s).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::{Product, Station};
    use proptest::prelude::*;

    /// A small product: faces on random sides, covers in a random precedence, with alternatives or not.
    fn small(
        faces: &[(u8, u8)],
        chained: bool,
        any: bool,
        seed: u64,
        arms: usize,
        tables: usize,
        units: usize,
    ) -> Problem {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut text = String::from("product = \"small\"\nloaded = \"s0\"\n");
        for (k, (side, screws)) in faces.iter().enumerate() {
            let mut places = String::new();
            for _ in 0..*screws {
                let (across, up) = (rng.random_range(-400..400), rng.random_range(200..850));
                places.push_str(&format!("[{across}, {up}],"));
            }
            text.push_str(&format!(
                "[[faces]]\nname = \"f{k}\"\nside = \"s{side}\"\nscrews_mm = [{places}]\n"
            ));
            if chained && k > 0 {
                text.push_str(&format!("after_covers = [\"c{}\"]\n", k - 1));
            }
        }
        for (k, (side, _)) in faces.iter().enumerate() {
            let width: u32 = rng.random_range(200..800);
            text.push_str(&format!(
                "[[covers]]\nname = \"c{k}\"\nside = \"s{side}\"\nwidth_mm = {width}\n"
            ));
            if any && faces.len() > 1 {
                text.push_str("requires_any = [{ faces = [\"f0\"] }, { faces = [\"f1\"] }]\n");
            } else {
                text.push_str(&format!("held_by = [\"f{k}\"]\n"));
            }
        }
        let product = Product::parse(&text, "small.toml").expect("product");
        Problem::new(&product, &Station::new(arms, tables).expect("station"), units).expect("problem")
    }

    /// The best of all orders and ways, by trying all of them.
    fn brute_force_s(search: &Search) -> f64 {
        fn go(search: &Search, node: &Node, best_s: &mut f64) {
            if node.order.len() == search.tasks.len() {
                *best_s = best_s.min(node.over_s);
                return;
            }
            for v in 0..search.variants.len() {
                if let Some(start_s) = search.begin_s(node, v)
                    && start_s < *best_s
                {
                    let mut next = node.clone();
                    search.place(&mut next, v, start_s);
                    go(search, &next, best_s);
                }
            }
        }
        let mut best_s = f64::INFINITY;
        go(search, &search.root(), &mut best_s);
        best_s
    }

    fn searched(problem: &Problem) -> Search<'_> {
        Search::new(
            &problem.tasks,
            problem.product.times_s.turn,
            problem.station.clearance_mm,
        )
    }

    /// The least end of all that can follow a node, in the order of its begin; no node on the way may claim more.
    fn least_after_s(search: &Search, node: &Node) -> f64 {
        if node.order.len() == search.tasks.len() {
            return node.over_s;
        }
        let mut least_s = f64::INFINITY;
        for v in 0..search.variants.len() {
            if let Some(start_s) = search.begin_s(node, v)
                && start_s >= node.last_s - SLACK_S
            {
                let mut next = node.clone();
                search.place(&mut next, v, start_s);
                least_s = least_s.min(least_after_s(search, &next));
            }
        }
        let bound_s = search.bound_s(node);
        assert!(
            bound_s <= least_s + 1e-6,
            "bound {bound_s} of {:?}, after which {least_s}",
            node.order
        );
        least_s
    }

    /// One arm lays a cover aside while the other one takes the last screw: the first is free only after that screw is out. A bound that
    /// counted it in cut the best plan.
    #[test]
    fn an_arm_that_is_free_too_late_raises_no_bound() {
        let problem = small(&[(1, 1), (0, 1)], false, true, 76, 2, 1, 1);
        let search = searched(&problem);
        let best_s = brute_force_s(&search);
        assert!((least_after_s(&search, &search.root()) - best_s).abs() < 1e-6);
        for steps in [0, 500] {
            let limits = Limits {
                steps,
                ..Limits::default()
            };
            let plan = solve(&problem, &limits, |_| {});
            assert_eq!(problem.check(&plan.placed), Ok(()));
            assert!(plan.is_best);
            assert!(
                (plan.makespan_s - best_s).abs() < 1e-6,
                "found {} best {best_s}",
                plan.makespan_s
            );
            assert!(plan.bound_s <= best_s + 1e-6);
        }
    }

    #[test]
    fn work_is_shared_by_the_arms_that_are_free() {
        for (free_s, work_s, until_s) in [
            (vec![3.0], 10.0, 13.0),
            (vec![4.0, 0.0], 10.0, 7.0),
            (vec![100.0, 0.0], 10.0, 10.0),
            (vec![0.0, 9.0, 2.0], 10.0, 6.0),
        ] {
            assert_eq!(shared_until_s(free_s.clone(), work_s), until_s, "{free_s:?}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// No beginning of an order claims more than the best that follows it, with the ways as they are and with relaxed ones.
        #[test]
        fn bounds_of_all_beginnings(
            faces in prop::collection::vec((0u8..2, 1u8..4), 1..3), any: bool, seed in 0u64..1000, arms in 1usize..3
        ) {
            let problem = small(&faces, !any, any, seed, arms, 1, 1);
            let search = searched(&problem);
            let best_s = least_after_s(&search, &search.root());
            prop_assert!((best_s - brute_force_s(&search)).abs() < 1e-6);
            let relaxed = Search::new(&problem.relaxed, problem.product.times_s.turn, problem.station.clearance_mm);
            if faces.iter().map(|(_, screws)| screws).sum::<u8>() <= 2 {
                prop_assert!(least_after_s(&relaxed, &relaxed.root()) <= best_s + 1e-6);
            }
        }

        /// Nothing is below the bound, and the search finds the best of all orders where it says so.
        #[test]
        fn bound_and_best_against_all_orders(
            faces in prop::collection::vec((0u8..2, 1u8..4), 1..3), chained: bool, any: bool, seed in 0u64..1000, arms in 1usize..3
        ) {
            let problem = small(&faces, chained && !any, any, seed, arms, 1, 1);
            let plan = solve(&problem, &Limits { steps: 500, ..Limits::default() }, |_| {});
            prop_assert_eq!(problem.check(&plan.placed), Ok(()));
            let search = searched(&problem);
            let best_s = brute_force_s(&search);
            prop_assert!(plan.bound_s <= best_s + 1e-6, "bound {} best {best_s}", plan.bound_s);
            prop_assert!(plan.is_best);
            prop_assert!((plan.makespan_s - best_s).abs() < 1e-6, "found {} best {best_s}", plan.makespan_s);
            // a search that is cut short still tells no bound above the best
            let short = solve(&problem, &Limits { steps: 0, rounds: 1, ..Limits::default() }, |_| {});
            prop_assert!(short.bound_s <= best_s + 1e-6);
            let root = Search::new(&problem.relaxed, problem.product.times_s.turn, problem.station.clearance_mm);
            prop_assert!(root.root_bound_s() <= best_s + 1e-6);
        }

        /// Every plan keeps every rule, whatever the station.
        #[test]
        fn plans_are_valid(
            faces in prop::collection::vec((0u8..3, 1u8..6), 1..4), chained: bool, seed in 0u64..1000, arms in 1usize..3, tables in 1usize..3
        ) {
            let problem = small(&faces, chained, false, seed, arms, tables, 2);
            let mut plans = 0;
            let limits = Limits { steps: 1000, rounds: 2, ..Limits::default() };
            let plan = solve(&problem, &limits, |better| {
                assert_eq!(problem.check(&better.placed), Ok(()));
                assert!(better.bound_s <= better.makespan_s + 1e-6);
                plans += 1;
            });
            prop_assert!(plans >= 2);
            // the same seed, the same plan
            let again = solve(&problem, &limits, |_| {});
            prop_assert_eq!(plan.placed, again.placed);
        }
    }

    #[test]
    fn the_check_finds_what_is_wrong() {
        let problem = small(&[(0, 3), (1, 3)], true, false, 1, 2, 1, 1);
        let plan = solve(&problem, &Limits::default(), |_| {});
        let moved = |k: usize, by_s: f64| {
            let mut placed = plan.placed.clone();
            placed[k].start_s += by_s;
            problem.check(&placed)
        };
        assert_eq!(problem.check(&plan.placed), Ok(()));
        for k in 1..plan.placed.len() {
            assert!(moved(k, -30.0).is_err(), "{k}");
        }
        assert!(problem.check(&plan.placed[1..]).is_err());
    }

    /// The figures of the shipped unit: the paper's parts for one arm, what overlap and a second arm give.
    #[test]
    fn cycles_of_the_shipped_unit() {
        let product = Product::outdoor_unit().expect("built-in");
        for (arms, most_s) in [(1, 185.0), (2, 140.0)] {
            let problem = Problem::new(&product, &Station::new(arms, 1).expect("station"), 1).expect("problem");
            let screws = problem.tasks.iter().filter(|t| !t.modes[0].stops.is_empty());
            let alone_s: f64 = screws.map(|t| t.modes[0].table_s).sum();
            assert!((77.0..83.0).contains(&alone_s), "{alone_s} s of screws, the paper's 80");
            let plan = solve(&problem, &Limits::default(), |_| {});
            assert!(plan.makespan_s <= most_s, "{arms} arm(s): {} s", plan.makespan_s);
            assert!(plan.gap() <= 0.1, "{arms} arm(s): {} above the bound", plan.gap());
        }
    }
}
