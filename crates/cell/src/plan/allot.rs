//! Which arm does which screw of a face, and in which order, by the time that joint moves take.

use super::{Candidate, Choice, Reach, Room, Target};
use crate::config::CellConfig;
use crate::motion::{ArmMotion, Gp25, Swept, Trajectory, Way};
use crate::schedule::tour::{Costs, Stretch, Tours, share};

/// What a move takes beyond its way until the controller says that it has ended, s; assumed.
const SETTLE_S: f64 = 0.08;
/// Straight in, driver, straight out: what a usual screw takes, s; assumed. Only how two arms share a face depends on it.
const DRIVE_S: f64 = 2.5;

/// How one arm does the screws of a face.
struct Hand<'a> {
    motion: &'a ArmMotion,
    choices: Vec<Option<&'a Choice>>,
    ways_home: Vec<Vec<Trajectory>>,
    costs: Costs,
}

/// The targets in the order in which each arm does its own.
///
/// With one arm at work another one only does what the first cannot reach. With two, the face is parted by a line across where that is
/// quicker; the arm whose targets come first begins first.
pub(super) fn allot(candidates: &[Candidate], arms: &[Reach<'_>], config: &CellConfig) -> Vec<Target> {
    let hands: Vec<Hand<'_>> = arms.iter().map(|reach| Hand::new(candidates, reach)).collect();
    // whoever comes first among the arms that can; one arm after the other
    let mut alone: Vec<Target> = Vec::new();
    let mut alone_s = 0.0;
    for (number, hand) in hands.iter().enumerate() {
        let first = |k: &usize| hands.iter().position(|h| h.choices[*k].is_some()) == Some(number);
        let own: Vec<usize> = (0..candidates.len()).filter(first).collect();
        let costs = hand.costs.of(&own);
        let order = costs.order();
        alone_s += costs.time_s(&order);
        alone.extend(order.iter().filter_map(|k| {
            Some(Target {
                found: candidates[own[*k]].found,
                place: hand.choices[own[*k]]?.place,
                room: None,
            })
        }));
    }
    let [a, b] = &hands[..] else { return alone };
    if config.work.arms < 2 {
        return alone;
    }
    let hands = match (a.motion.is_right(), b.motion.is_right()) {
        (Some(true), Some(false)) => [a, b],
        (Some(false), Some(true)) => [b, a],
        _ => return alone,
    };
    shared(candidates, hands, alone_s, config).unwrap_or(alone)
}

/// Both arms at the same time, each on its side of a line across; `None` unless that takes less than `alone_s`.
fn shared(candidates: &[Candidate], hands: [&Hand<'_>; 2], alone_s: f64, config: &CellConfig) -> Option<Vec<Target>> {
    let tours = hands.map(|hand| Tours::new(&hand.costs));
    // the camera looks along the arms: its x is to the right
    let across_mm: Vec<f64> = candidates.iter().map(|c| -c.point.x_mm()).collect();
    let margin_mm = config.motion.margin_mm;
    let near: [Vec<Option<Swept>>; 2] = hands.map(|hand| (0..candidates.len()).map(|k| hand.swept(k)).collect());
    let is_clear_at = |right: usize, left: usize| match (&near[0][right], &near[1][left]) {
        (Some(right), Some(left)) => right.is_clear_of(left, margin_mm),
        _ => false,
    };
    let clear: Vec<Vec<bool>> = (0..candidates.len())
        .map(|right| (0..candidates.len()).map(|left| is_clear_at(right, left)).collect())
        .collect();
    // the way from the rest and back belongs to the screw that it leads to
    let is_clear = |right: Stretch, left: Stretch| {
        let of = |stretch: Stretch| stretch.into_iter().flatten();
        of(right).all(|r| of(left).all(|l| clear[r][l]))
    };
    let arms = [
        (&hands[0].costs, tours[0].as_ref()),
        (&hands[1].costs, tours[1].as_ref()),
    ];
    let shared = share(arms, &across_mm, &is_clear)?;
    if shared.span_s >= alone_s {
        return None;
    }
    let ways: [Vec<Ways<'_>>; 2] = [0, 1].map(|side| hands[side].ways(&shared.orders[side], config));
    let room: [Vec<Swept>; 2] = [0, 1].map(|side| ways[side].iter().map(|w| w.swept(hands[side].motion)).collect());
    // places of the left arm from right to left; the right arm reaches as far as the leftmost of them where it would be in the way
    let mut left: Vec<usize> = (0..ways[1].len()).collect();
    left.sort_by(|x, y| across_mm[ways[1][*x].screw].total_cmp(&across_mm[ways[1][*y].screw]));
    let reach = |k: usize| {
        let in_the_way = |place: &usize| !room[0][k].is_clear_of(&room[1][left[*place]], margin_mm);
        (0..left.len()).rev().find(in_the_way).map_or(0, |place| place + 1)
    };
    let reaches = [
        (0..ways[0].len()).map(reach).collect::<Vec<usize>>(),
        (0..ways[1].len())
            .map(|k| left.iter().position(|l| *l == k).unwrap_or(0) + 1)
            .collect(),
    ];
    let mut sides = [0, 1];
    sides.sort_by(|x, y| shared.wait_s[*x].total_cmp(&shared.wait_s[*y]));
    let of = |side: usize| {
        ways[side]
            .iter()
            .zip(&reaches[side])
            .map(|(way, reach)| way.target(candidates, *reach))
    };
    Some(sides.into_iter().flat_map(of).collect())
}

/// Every way of an arm at one screw of its order.
struct Ways<'a> {
    screw: usize,
    choice: &'a Choice,
    from_last: Option<Way>,
    home: &'a [Trajectory],
}

impl Ways<'_> {
    fn swept(&self, motion: &ArmMotion) -> Swept {
        let legs = self
            .choice
            .way
            .joint
            .iter()
            .chain(self.from_last.iter().flat_map(|way| &way.joint));
        motion.swept(
            legs.map(|leg| &leg.trajectory)
                .chain([&self.choice.way.approach])
                .chain(self.home),
        )
    }

    fn target(&self, candidates: &[Candidate], reach: usize) -> Target {
        let at = |way: &Way| {
            let begin = way.joint.first().map(|leg| leg.trajectory.begin_rad());
            let ends = way.joint.iter().map(|leg| leg.trajectory.end_rad());
            begin.into_iter().chain(ends).collect()
        };
        Target {
            found: candidates[self.screw].found,
            place: self.choice.place,
            room: Some(Room {
                reach,
                from_rest_rad: at(&self.choice.way),
                from_last_rad: self.from_last.as_ref().map_or_else(Vec::new, at),
            }),
        }
    }
}

impl<'a> Hand<'a> {
    fn new(candidates: &'a [Candidate], reach: &Reach<'a>) -> Self {
        let choice = |c: &'a Candidate| c.choices.iter().find(|choice| choice.place.arm() == reach.arm);
        let choices: Vec<Option<&Choice>> = candidates.iter().map(choice).collect();
        let standoff_rad: Vec<Option<[f64; 6]>> =
            choices.iter().map(|c| c.map(|c| c.way.approach.begin_rad())).collect();
        let ways_home: Vec<Vec<Trajectory>> = standoff_rad
            .iter()
            .map(|q| q.map_or_else(Vec::new, |q| reach.motion.way_home(q)))
            .collect();
        let out_s = |choice: &Option<&Choice>| match choice {
            Some(choice) => choice
                .way
                .joint
                .iter()
                .map(|leg| leg.trajectory.duration_s() + SETTLE_S)
                .sum(),
            None => f64::INFINITY,
        };
        let back_s = |legs: &Vec<Trajectory>| match legs.is_empty() {
            true => f64::INFINITY,
            false => legs.iter().map(|leg| leg.duration_s() + SETTLE_S).sum(),
        };
        let between_s = |from: &Option<[f64; 6]>| {
            let to = standoff_rad.iter().map(|to| match (from, to) {
                (Some(from), Some(to)) => Gp25::travel_s(*from, *to) + SETTLE_S,
                _ => f64::INFINITY,
            });
            to.collect()
        };
        Self {
            motion: reach.motion,
            costs: Costs {
                between_s: standoff_rad.iter().map(between_s).collect(),
                out_s: choices.iter().map(out_s).collect(),
                back_s: ways_home.iter().map(back_s).collect(),
                drive_s: DRIVE_S,
            },
            ways_home,
            choices,
        }
    }

    /// The room that it takes for a screw from its rest and back; `None` for one that it does not reach.
    fn swept(&self, screw: usize) -> Option<Swept> {
        let way = &self.choices[screw]?.way;
        let legs = way.joint.iter().map(|leg| &leg.trajectory);
        Some(
            self.motion
                .swept(legs.chain([&way.approach]).chain(&self.ways_home[screw])),
        )
    }

    /// The ways of its order. From a screw where no way is free to the next it goes home first.
    fn ways(&self, order: &[usize], config: &CellConfig) -> Vec<Ways<'_>> {
        let mut last_rad = None;
        let one = |screw: &usize| {
            let choice = self.choices[*screw]?;
            let from: Option<[f64; 6]> = last_rad.replace(choice.way.approach.begin_rad());
            Some(Ways {
                screw: *screw,
                choice,
                from_last: from.and_then(|q| choice.place.check(self.motion, q, &config.approach).ok()),
                home: &self.ways_home[*screw],
            })
        };
        order.iter().filter_map(one).collect()
    }
}
