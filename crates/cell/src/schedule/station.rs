//! Where arms and tables stand, how long an arm takes from place to place, and the room it sweeps.

use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI};

/// A station that cannot be planned for.
#[derive(Debug, thiserror::Error)]
pub enum StationError {
    /// Other numbers than one or two.
    #[error("{arms} arm(s) at {tables} table(s): this plans for one or two of each")]
    Size {
        /// Arms asked for.
        arms: usize,
        /// Tables asked for.
        tables: usize,
    },
}

/// An arm: where it stands and what it can do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Arm {
    /// Its name, as in a cell file.
    pub name: String,
    /// Its base to the left of the first arm's, mm (base y).
    pub base_y_mm: f64,
    /// Where it rests, out of the camera's view: withdrawn, to the left of the first arm's base, mm.
    pub rest_y_mm: f64,
    /// It takes screws out.
    pub driver: bool,
    /// It pulls covers.
    pub gripper: bool,
}

/// Arms in the order in which they stand, from right to left, and tables before them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Station {
    /// From right to left.
    pub arms: Vec<Arm>,
    /// Middle of each table to the left of the first arm's base, mm. Each table has a camera of its own.
    pub tables_y_mm: Vec<f64>,
    /// Room between the middles of two arms that work side by side, mm: the widest part of a GP25's forearm with its tool, twice half of
    /// it, and 50 mm for deflection and cables (assumed).
    pub clearance_mm: f64,
}

impl Station {
    /// The simulated cell's arms, 700 mm apart, and its table; a second table stands 1.2 m beside it, in reach of both arms. A lone arm
    /// carries driver and gripper; of two at one table both drive and the second also pulls; at two tables both do both.
    ///
    /// # Errors
    /// [`StationError::Size`] for other numbers than one or two.
    pub fn new(arms: usize, tables: usize) -> Result<Self, StationError> {
        if !(1..=2).contains(&arms) || !(1..=2).contains(&tables) {
            return Err(StationError::Size { arms, tables });
        }
        let arm = |name: &str, base_y_mm: f64, rest_y_mm: f64, gripper: bool| Arm {
            name: name.into(),
            base_y_mm,
            rest_y_mm,
            driver: true,
            gripper,
        };
        let mut both = vec![arm("arm_a", 0.0, -300.0, arms == 1 || tables == 2), arm("arm_b", 700.0, 1000.0, true)];
        both.truncate(arms);
        Ok(Self {
            arms: both,
            tables_y_mm: if tables == 1 { vec![0.0] } else { vec![-250.0, 950.0] },
            clearance_mm: 300.0,
        })
    }

    /// Time for arm `arm` from one place of its bit to another, square to the face (`None`: its rest), s; `None` out of its reach.
    /// Places are x, y, z in the first arm's base, mm.
    pub fn travel_s(&self, arm: usize, from: Option<[f64; 3]>, to: Option<[f64; 3]>) -> Option<f64> {
        let arm = &self.arms[arm];
        let joints = |at: Option<[f64; 3]>| match at {
            Some([x, y, z]) => joints_rad([x, y - arm.base_y_mm, z]),
            None => {
                let aside_rad = (arm.rest_y_mm - arm.base_y_mm).atan2(REST_X_MM);
                Some([aside_rad, -0.6, -0.2, 0.0, 0.9, 0.0])
            }
        };
        Some(joint_time_s(joints(from)?, joints(to)?))
    }
}

/// What an arm sweeps of the room before the table, as the stretch of base y between the middles of its positions.
///
/// Exclusion is conservative and simple: the arms stand side by side and reach straight forward, so an arm's body stays within its tool's
/// stretch, from where it rests to where it works, widened by half the clearance. Two arms may work at the same time if everything that the
/// right one sweeps lies to the right of everything that the left one sweeps, clearance between; height and depth are not looked at.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Strip {
    /// Rightmost, mm.
    pub low_mm: f64,
    /// Leftmost, mm.
    pub high_mm: f64,
}

impl Strip {
    /// The stretch over some places across.
    pub fn over(y_mm: impl IntoIterator<Item = f64>) -> Self {
        let none = Self {
            low_mm: f64::INFINITY,
            high_mm: f64::NEG_INFINITY,
        };
        y_mm.into_iter().fold(none, |strip, y| Self {
            low_mm: strip.low_mm.min(y),
            high_mm: strip.high_mm.max(y),
        })
    }

    /// True if the arm on the right may sweep this while the one on its left sweeps `left`.
    pub fn is_clear_of(&self, left: &Strip, clearance_mm: f64) -> bool {
        self.high_mm + clearance_mm <= left.low_mm
    }
}

/// How far before its base an arm at rest holds its wrist, mm.
const REST_X_MM: f64 = 650.0;
/// Bit and flange before the wrist centre, mm.
const WRIST_TO_BIT_MM: f64 = 400.0;
/// From J1's axis to J2's, mm.
const A1_MM: f64 = 150.0;
/// Height of J2 above the foot, mm.
const C1_MM: f64 = 505.0;
/// Upper arm, mm.
const C2_MM: f64 = 760.0;
/// Forearm along and across, mm.
const FOREARM_MM: [f64; 2] = [795.0, 200.0];
/// Limits of J2, J3 and J5 (the others turn by far enough), degrees.
const LIMITS_DEG: [(usize, f64, f64); 3] = [(1, -105.0, 155.0), (2, -86.0, 160.0), (4, -155.0, 150.0)];
/// Joint speeds, degrees a second.
const SPEEDS_DEG_S: [f64; 6] = [210.0, 210.0, 265.0, 420.0, 420.0, 885.0];
/// From standstill to full speed under the jerk limit, s.
const RISE_S: f64 = 0.3;
/// Until the controller reports "in position", s.
const SETTLE_S: f64 = 0.08;

/// Joint angles of a GP25 with the bit square to the face (along base x), elbow up; `None` out of reach. The bit's 40 mm aside are left out.
fn joints_rad([x_mm, y_mm, z_mm]: [f64; 3]) -> Option<[f64; 6]> {
    let wrist_x_mm = x_mm - WRIST_TO_BIT_MM;
    let j1 = y_mm.atan2(wrist_x_mm);
    // the plane of upper arm and forearm: away from J2 and up
    let (out_mm, up_mm) = (wrist_x_mm.hypot(y_mm) - A1_MM, z_mm - C1_MM);
    let (reach_mm, forearm_mm) = (out_mm.hypot(up_mm), FOREARM_MM[0].hypot(FOREARM_MM[1]));
    let cos = (C2_MM.powi(2) + reach_mm.powi(2) - forearm_mm.powi(2)) / (2.0 * C2_MM * reach_mm);
    if wrist_x_mm <= 0.0 || !(-1.0..=1.0).contains(&cos) {
        return None;
    }
    let upper = up_mm.atan2(out_mm) + cos.acos();
    let line = (up_mm - C2_MM * upper.sin()).atan2(out_mm - C2_MM * upper.cos());
    let forearm = line - FOREARM_MM[1].atan2(FOREARM_MM[0]);
    let j2 = FRAC_PI_2 - upper;
    // the bit as the forearm sees it: ahead, aside, above
    let ahead = forearm.cos() * j1.cos();
    let (aside, above) = (-j1.sin(), -forearm.sin() * j1.cos());
    let j5 = ahead.clamp(-1.0, 1.0).acos();
    let j4 = aside.atan2(above);
    let joints = [j1, j2, forearm + j2, j4, j5, -j4];
    let is_within = |&(j, low, high): &(usize, f64, f64)| (low..=high).contains(&joints[j].to_degrees());
    LIMITS_DEG.iter().all(is_within).then_some(joints)
}

/// Shortest time for a motion of all joints together, s: the slowest joint decides; each rises to its limit with a limited jerk.
fn joint_time_s(from_rad: [f64; 6], to_rad: [f64; 6]) -> f64 {
    let time_s = |j: usize| {
        let speed = SPEEDS_DEG_S[j].to_radians();
        let mut way = (to_rad[j] - from_rad[j]).abs();
        if matches!(j, 3 | 5) && way > PI {
            way = 2.0 * PI - way;
        }
        if way >= speed * RISE_S {
            way / speed + RISE_S
        } else {
            2.0 * (way * RISE_S / speed).sqrt()
        }
    };
    (0..6).map(time_s).fold(0.0, f64::max) + SETTLE_S
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_arms_reach_their_tables() {
        for tables in 1..=2 {
            let station = Station::new(2, tables).expect("station");
            for (arm, table) in (0..2).flat_map(|a| (0..tables).map(move |t| (a, t))) {
                for (y, z) in [(-430.0, 160.0), (-430.0, 890.0), (430.0, 160.0), (430.0, 890.0)] {
                    let at = [1070.0, station.tables_y_mm[table] + y, z];
                    let time_s = station.travel_s(arm, None, Some(at));
                    assert!(time_s.is_some_and(|t| (0.3..1.5).contains(&t)), "{arm} {at:?} {time_s:?}");
                }
            }
        }
        let station = Station::new(1, 1).expect("station");
        assert_eq!(station.travel_s(0, None, Some([1070.0, 1900.0, 500.0])), None);
    }

    #[test]
    fn longer_ways_take_longer() {
        let station = Station::new(1, 1).expect("station");
        let time_s = |y: f64| {
            let to = Some([1070.0, y, 500.0]);
            station.travel_s(0, Some([1070.0, 0.0, 500.0]), to).expect("in reach")
        };
        assert!(time_s(100.0) < time_s(200.0) && time_s(200.0) < time_s(400.0));
        assert_eq!(time_s(0.0), SETTLE_S);
    }

    #[test]
    fn sides_of_the_arms() {
        let (right, left) = (Strip::over([-300.0, 0.0]), Strip::over([300.0, 500.0]));
        assert!(right.is_clear_of(&left, 300.0) && !right.is_clear_of(&left, 301.0));
        assert!(!left.is_clear_of(&right, 0.0)); // crossed arms
    }
}
