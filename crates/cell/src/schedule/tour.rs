//! The way through the screws of a face: exact for one arm up to 20 screws (Held and Karp, 1962), 2-opt and Or-opt beyond; two arms share.

use super::station::Strip;

/// Most screws of an exact tour.
pub const EXACT_MAX: usize = 20;

/// Times of one arm at one face, s.
#[derive(Clone, Debug)]
pub struct Costs {
    /// From screw to screw.
    pub between_s: Vec<Vec<f64>>,
    /// From rest to each screw.
    pub out_s: Vec<f64>,
    /// From each screw to rest.
    pub back_s: Vec<f64>,
    /// Driving a screw.
    pub drive_s: f64,
}

impl Costs {
    fn len(&self) -> usize {
        self.out_s.len()
    }

    /// The same for some of the screws, in this order.
    pub fn of(&self, screws: &[usize]) -> Self {
        let pick = |times: &Vec<f64>| screws.iter().map(|k| times[*k]).collect::<Vec<f64>>();
        Self {
            between_s: screws.iter().map(|k| pick(&self.between_s[*k])).collect(),
            out_s: pick(&self.out_s),
            back_s: pick(&self.back_s),
            drive_s: self.drive_s,
        }
    }

    /// The shortest way through all screws; exact up to [`EXACT_MAX`].
    pub fn order(&self) -> Vec<usize> {
        match Tours::new(self) {
            Some(tours) => tours.order((1 << self.len()) - 1),
            None => improved(self, &(0..self.len()).collect::<Vec<_>>()),
        }
    }

    /// Time from rest through these screws and back, s.
    pub fn time_s(&self, order: &[usize]) -> f64 {
        let (Some(&first), Some(&last)) = (order.first(), order.last()) else {
            return 0.0;
        };
        let ways: f64 = order.windows(2).map(|w| self.between_s[w[0]][w[1]]).sum();
        self.out_s[first] + ways + self.back_s[last] + self.drive_s * order.len() as f64
    }

    /// Less than any tour that visits these screws can take, s; for more screws than can be solved exactly.
    fn least_s(&self, screws: impl Iterator<Item = usize>) -> f64 {
        let nearest = |i: usize| {
            let others = (0..self.len()).filter(|&j| j != i).map(|j| self.between_s[j][i]);
            others.fold(self.out_s[i], f64::min)
        };
        screws.map(|i| self.drive_s + nearest(i)).sum::<f64>()
            + self.back_s.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

/// Exact tours of every subset of a face's screws, for one arm.
pub struct Tours<'a> {
    costs: &'a Costs,
    /// Time from rest through a set to one of its screws, by set and screw.
    to_s: Vec<f32>,
    /// Time of the closed tour, by set.
    closed_s: Vec<f32>,
    stride: usize,
}

/// Numbers that one step compares at once.
const LANES: usize = 8;

impl<'a> Tours<'a> {
    /// Held and Karp's recursion over all subsets; `None` beyond [`EXACT_MAX`] screws.
    pub fn new(costs: &'a Costs) -> Option<Self> {
        let n = costs.len();
        if n > EXACT_MAX {
            return None;
        }
        let stride = n.next_multiple_of(LANES).max(LANES);
        let mut arrive = vec![f32::INFINITY; n * stride];
        for (to, from) in (0..n).flat_map(|to| (0..n).map(move |from| (to, from))) {
            arrive[to * stride + from] = (costs.between_s[from][to] + costs.drive_s) as f32;
        }
        let mut to_s = vec![f32::INFINITY; stride << n];
        let mut closed_s = vec![0.0; 1 << n];
        for set in 1usize..1 << n {
            let mut closed = f32::INFINITY;
            for last in (0..n).filter(|last| set >> last & 1 == 1) {
                let rest = set & !(1 << last);
                let time = if rest == 0 {
                    (costs.out_s[last] + costs.drive_s) as f32
                } else {
                    let before = &to_s[rest * stride..(rest + 1) * stride];
                    let way = &arrive[last * stride..(last + 1) * stride];
                    let mut least = [f32::INFINITY; LANES];
                    for (b, w) in before.chunks_exact(LANES).zip(way.chunks_exact(LANES)) {
                        for lane in 0..LANES {
                            let time = b[lane] + w[lane];
                            least[lane] = if time < least[lane] { time } else { least[lane] };
                        }
                    }
                    least.into_iter().fold(f32::INFINITY, f32::min)
                };
                to_s[set * stride + last] = time;
                closed = closed.min(time + costs.back_s[last] as f32);
            }
            closed_s[set] = closed;
        }
        Some(Self {
            costs,
            to_s,
            closed_s,
            stride,
        })
    }

    /// The best order of a set of screws.
    pub fn order(&self, set: usize) -> Vec<usize> {
        let n = self.costs.len();
        let mut left = set;
        let mut order = Vec::new();
        while left != 0 {
            // the screw after which the rest of the way is shortest
            let onward = |last: usize| {
                let way = order.last().map_or(self.costs.back_s[last], |&next: &usize| {
                    self.costs.between_s[last][next]
                });
                f64::from(self.to_s[left * self.stride + last]) + way
            };
            let last = (0..n)
                .filter(|k| left >> k & 1 == 1)
                .min_by(|&a, &b| onward(a).total_cmp(&onward(b)));
            let Some(last) = last else { break };
            left &= !(1 << last);
            order.push(last);
        }
        order.reverse();
        order
    }
}

/// A short order of these screws by 2-opt and Or-opt, for faces too large for an exact one.
pub fn improved(costs: &Costs, screws: &[usize]) -> Vec<usize> {
    let mut left = screws.to_vec();
    let mut order: Vec<usize> = Vec::with_capacity(screws.len());
    while !left.is_empty() {
        let way = |k: usize| order.last().map_or(costs.out_s[k], |&at| costs.between_s[at][k]);
        let next = (0..left.len()).min_by(|&a, &b| way(left[a]).total_cmp(&way(left[b])));
        order.push(left.swap_remove(next.unwrap_or(0)));
    }
    let mut time_s = costs.time_s(&order);
    loop {
        let before_s = time_s;
        let n = order.len();
        for (i, j) in (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))) {
            let mut turned = order.clone();
            turned[i..=j].reverse();
            // one to three screws elsewhere
            let mut moved = order.clone();
            let part: Vec<usize> = moved.splice(i..(i + 3).min(j), []).collect();
            let at = (j - part.len()).min(moved.len());
            moved.splice(at..at, part);
            for tried in [turned, moved] {
                let tried_s = costs.time_s(&tried);
                if tried_s + 1e-9 < time_s {
                    (order, time_s) = (tried, tried_s);
                }
            }
        }
        if time_s + 1e-9 >= before_s {
            return order;
        }
    }
}

/// Single precision of the recursion, s.
const ROUNDING_S: f64 = 1e-4;

/// Classes of divisions of a face between two arms.
const CLASSES: usize = 6;

/// Less than an arm needs alone for all screws, s.
pub fn least_alone_s(costs: &Costs, tours: Option<&Tours>) -> f64 {
    match tours {
        Some(tours) => f64::from(tours.closed_s[tours.closed_s.len() - 1]) - ROUNDING_S,
        None => costs.least_s(0..costs.len()),
    }
}

/// Less than both arms need when each takes at least one screw, s: for every division there is an entry of which neither number is above
/// what that division takes the arm on the right and the one on the left.
pub fn least_shared_s(arms: [(&Costs, Option<&Tours>); 2]) -> Vec<[f64; 2]> {
    let [(a, Some(right)), (b, Some(left))] = arms else {
        // every screw is entered at least by its shortest way, and each arm goes back: half of it, or more, falls to one of them
        let [a, b] = [arms[0].0, arms[1].0];
        let back_s = a.least_s(std::iter::empty()).min(b.least_s(std::iter::empty()));
        let one = |k: usize| {
            let of = |costs: &Costs| costs.least_s(std::iter::once(k)) - costs.least_s(std::iter::empty());
            of(a).min(of(b))
        };
        let each_s: Vec<f64> = (0..a.len()).map(one).collect();
        let sum_s: f64 = each_s.iter().sum();
        // by the share of the arm on the right: at least so much, and the other the rest
        let share_s = |k: usize| sum_s * k as f64 / CLASSES as f64;
        return (0..CLASSES)
            .map(|k| [share_s(k) + back_s, sum_s - share_s(k + 1) + back_s])
            .collect();
    };
    let whole = right.closed_s.len() - 1;
    let proper = |set: &usize| *set != 0 && *set != whole;
    let all_s = f64::from(right.closed_s[whole]).max(f64::from(left.closed_s[whole])) + a.drive_s + b.drive_s;
    let mut classes = vec![[f64::INFINITY; 2]; CLASSES];
    for set in (0..=whole).filter(proper) {
        let times_s = [right.closed_s[set], left.closed_s[whole & !set]].map(|t| f64::from(t) - ROUNDING_S);
        let class = ((times_s[0] / all_s * CLASSES as f64) as usize).min(CLASSES - 1);
        for side in 0..2 {
            classes[class][side] = classes[class][side].min(times_s[side]);
        }
    }
    classes.retain(|times| times[0].is_finite());
    classes
}

/// Two arms at one face at the same time.
#[derive(Clone, Debug, PartialEq)]
pub struct Shared {
    /// Order of the arm on the right, and of the one on the left.
    pub orders: [Vec<usize>; 2],
    /// How long each waits at rest before it begins, s: one of them is 0.
    pub wait_s: [f64; 2],
    /// From the begin to the return of the later one, s.
    pub span_s: f64,
}

/// A part of an arm's way: from which screw to which, the same twice while it is driven; `None`: its rest.
pub type Stretch = [Option<usize>; 2];

/// When an arm is on a stretch of its way.
#[derive(Clone, Copy)]
struct Sweep {
    from_s: f64,
    to_s: f64,
    stretch: Stretch,
}

/// The best division of a face between the arm on the right and the one on the left: each takes what lies on its side of a line across,
/// every line is tried, with exact orders and sweeps along the face, in both directions; who would come too near waits at rest.
///
/// # Arguments
/// * `y_mm` – places of the screws across.
/// * `is_clear` – whether the arm on the right may be on a stretch of its way while the one on the left is on one of its own.
///
/// # Returns
/// `None` with fewer than two screws, or where no division is possible: a screw that an arm cannot do takes it infinitely long.
pub fn share(
    arms: [(&Costs, Option<&Tours>); 2],
    y_mm: &[f64],
    is_clear: &dyn Fn(Stretch, Stretch) -> bool,
) -> Option<Shared> {
    let mut by_y: Vec<usize> = (0..y_mm.len()).collect();
    by_y.sort_by(|&a, &b| y_mm[a].total_cmp(&y_mm[b]));
    let mut best: Option<Shared> = None;
    for cut in 1..by_y.len() {
        let sides = [&by_y[..cut], &by_y[cut..]];
        let ways = [0, 1].map(|side| ways(arms[side], sides[side]));
        for (right, left) in ways[0].iter().flat_map(|r| ways[1].iter().map(move |l| (r, l))) {
            let times_s = [arms[0].0.time_s(right), arms[1].0.time_s(left)];
            let least_s = times_s[0].max(times_s[1]);
            if !least_s.is_finite() || best.as_ref().is_some_and(|best| least_s >= best.span_s) {
                continue;
            }
            let sweeps = [sweeps(arms[0].0, right), sweeps(arms[1].0, left)];
            for wait_s in waits(&sweeps, is_clear) {
                let span_s = (times_s[0] + wait_s[0]).max(times_s[1] + wait_s[1]);
                if best.as_ref().is_none_or(|best| span_s < best.span_s) {
                    best = Some(Shared {
                        orders: [right.clone(), left.clone()],
                        wait_s,
                        span_s,
                    });
                }
            }
        }
    }
    best
}

/// Orders worth trying for one side: the shortest, and the way across, both in both directions.
fn ways((costs, tours): (&Costs, Option<&Tours>), side: &[usize]) -> Vec<Vec<usize>> {
    let shortest = match tours {
        Some(tours) => tours.order(side.iter().fold(0, |set, k| set | 1 << k)),
        None => improved(costs, side),
    };
    let both = |order: Vec<usize>| {
        let back = order.iter().rev().copied().collect();
        [order, back]
    };
    both(shortest).into_iter().chain(both(side.to_vec())).collect()
}

/// Strips across that two arms sweep may not come nearer than this: the rule of [`share`] where nothing but places across is known.
///
/// # Arguments
/// * `rest_y_mm` – where the arms rest.
pub fn strips_apart(y_mm: &[f64], rest_y_mm: [f64; 2], clearance_mm: f64) -> impl Fn(Stretch, Stretch) -> bool {
    move |right, left| {
        let strip = |stretch: Stretch, rest_mm: f64| Strip::over(stretch.map(|at| at.map_or(rest_mm, |k| y_mm[k])));
        strip(right, rest_y_mm[0]).is_clear_of(&strip(left, rest_y_mm[1]), clearance_mm)
    }
}

fn sweeps(costs: &Costs, order: &[usize]) -> Vec<Sweep> {
    let mut sweeps = Vec::with_capacity(2 * order.len() + 1);
    let mut now_s = 0.0;
    let mut sweep = |time_s: f64, stretch: Stretch| {
        sweeps.push(Sweep {
            from_s: now_s,
            to_s: now_s + time_s,
            stretch,
        });
        now_s += time_s;
    };
    let mut last: Option<usize> = None;
    for &screw in order {
        let way_s = last.map_or(costs.out_s[screw], |before| costs.between_s[before][screw]);
        sweep(way_s, [last, Some(screw)]);
        sweep(costs.drive_s, [Some(screw); 2]);
        last = Some(screw);
    }
    if let Some(screw) = last {
        sweep(costs.back_s[screw], [last, None]);
    }
    sweeps
}

/// The shortest waits of the one or the other arm that keep them apart all the time.
fn waits([right, left]: &[Vec<Sweep>; 2], is_clear: &dyn Fn(Stretch, Stretch) -> bool) -> [[f64; 2]; 2] {
    // how much later the left arm may not begin than the right one: open intervals
    let mut barred: Vec<(f64, f64)> = Vec::new();
    for (r, l) in right.iter().flat_map(|r| left.iter().map(move |l| (r, l))) {
        if !is_clear(r.stretch, l.stretch) {
            barred.push((r.from_s - l.to_s, r.to_s - l.from_s));
        }
    }
    barred.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut later = 0.0;
    for &(low, high) in &barred {
        if low < later - 1e-9 && later < high - 1e-9 {
            later = high;
        }
    }
    barred.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut earlier = 0.0;
    for &(low, high) in &barred {
        if low < earlier - 1e-9 && earlier < high - 1e-9 {
            earlier = low;
        }
    }
    [[0.0, later], [-earlier, 0.0]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    fn drawn(n: usize, seed: u64) -> (Costs, Vec<f64>) {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let at: Vec<[f64; 2]> = (0..n)
            .map(|_| [rng.random_range(-400.0..400.0), rng.random_range(0.0..700.0)])
            .collect();
        let way = |a: [f64; 2], b: [f64; 2]| 0.1 + (a[0] - b[0]).hypot(a[1] - b[1]) / 800.0;
        let rest = [-300.0, 300.0];
        let costs = Costs {
            between_s: at.iter().map(|&a| at.iter().map(|&b| way(a, b)).collect()).collect(),
            out_s: at.iter().map(|&a| way(rest, a) + 0.3).collect(),
            back_s: at.iter().map(|&a| way(a, rest) + 0.3).collect(),
            drive_s: 1.5,
        };
        (costs, at.iter().map(|a| a[0]).collect())
    }

    fn permutations(items: &[usize]) -> Vec<Vec<usize>> {
        if items.is_empty() {
            return vec![Vec::new()];
        }
        let mut all = Vec::new();
        for (k, &first) in items.iter().enumerate() {
            let rest: Vec<usize> = items
                .iter()
                .enumerate()
                .filter(|(i, _)| *i != k)
                .map(|(_, &v)| v)
                .collect();
            for mut tail in permutations(&rest) {
                tail.insert(0, first);
                all.push(tail);
            }
        }
        all
    }

    #[test]
    fn exact_tours_are_the_best_permutations() {
        for seed in 0..20 {
            let (costs, _) = drawn(6, seed);
            let tours = Tours::new(&costs).expect("small");
            let best = permutations(&[0, 1, 2, 3, 4, 5]);
            let best = best.iter().map(|o| costs.time_s(o)).fold(f64::INFINITY, f64::min);
            assert!((costs.time_s(&tours.order(0b11_1111)) - best).abs() < 1e-4);
            assert_eq!(tours.order(0b10_0101).len(), 3);
        }
    }

    #[test]
    fn the_heuristic_is_near_the_exact_tour() {
        for seed in 0..10 {
            let (costs, _) = drawn(12, seed);
            let all: Vec<usize> = (0..12).collect();
            let exact = costs.time_s(&Tours::new(&costs).expect("small").order(0xfff));
            let found = costs.time_s(&improved(&costs, &all));
            assert!(found >= exact - 1e-4 && found < 1.05 * exact, "{found} {exact}");
        }
    }

    /// Brute force over every division, both orders and every wait: nothing is below the bound, and what is found is not below the best.
    #[test]
    fn the_least_is_below_every_division_of_the_face() {
        for seed in 0..12 {
            let (a, y_mm) = drawn(5, seed);
            let (mut b, _) = drawn(5, seed);
            b.out_s.reverse();
            let tours = [Tours::new(&a).expect("small"), Tours::new(&b).expect("small")];
            let arms = [(&a, Some(&tours[0])), (&b, Some(&tours[1]))];
            let (shared, rest) = (least_shared_s(arms), [-300.0, 1000.0]);
            let rough = least_shared_s([(&a, None), (&b, None)]);
            let apart = strips_apart(&y_mm, rest, 250.0);
            let mut best_s = f64::INFINITY;
            for set in 0usize..32 {
                let part = |bit: usize| (0..5).filter(|k| set >> k & 1 == bit).collect::<Vec<usize>>();
                for (right, left) in permutations(&part(1))
                    .iter()
                    .flat_map(|r| permutations(&part(0)).into_iter().map(move |l| (r.clone(), l)))
                {
                    let times = [a.time_s(&right), b.time_s(&left)];
                    let both = [sweeps(&a, &right), sweeps(&b, &left)];
                    for wait in waits(&both, &apart) {
                        best_s = best_s.min((times[0] + wait[0]).max(times[1] + wait[1]));
                    }
                    if set == 31 {
                        assert!(least_alone_s(&a, arms[0].1) <= times[0] && least_alone_s(&a, None) <= times[0]);
                    } else if set != 0 {
                        let is_below = |least: &[f64; 2]| least[0] <= times[0] && least[1] <= times[1];
                        assert!(shared.iter().any(is_below) && rough.iter().any(is_below));
                    }
                }
            }
            let found = share(arms, &y_mm, &apart).expect("shared");
            assert!(found.span_s >= best_s - 1e-9);
        }
    }

    #[test]
    fn arms_that_share_a_face_never_come_near() {
        for seed in 0..20 {
            let (a, y_mm) = drawn(9, seed);
            let tours = Tours::new(&a).expect("small");
            let arm = (&a, Some(&tours));
            let rest = [-300.0, 1000.0];
            let apart = strips_apart(&y_mm, rest, 300.0);
            let Some(found) = share([arm, arm], &y_mm, &apart) else {
                continue;
            };
            let [right, left] = [0, 1].map(|side| sweeps(&a, &found.orders[side]));
            for (r, l) in right.iter().flat_map(|r| left.iter().map(move |l| (r, l))) {
                let together = r.from_s + found.wait_s[0] < l.to_s + found.wait_s[1] - 1e-6
                    && l.from_s + found.wait_s[1] < r.to_s + found.wait_s[0] - 1e-6;
                assert!(!together || apart(r.stretch, l.stretch));
            }
        }
    }
}
