//! Where arms and tables stand, how long an arm takes from place to place, and the room it sweeps.

use crate::motion::{Gp25, HOME_RAD};
use crate::plan::tool_pose;
use geometry::{Direction, Point, Transform};
use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};

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
        let mut both = vec![
            arm("arm_a", 0.0, -300.0, arms == 1 || tables == 2),
            arm("arm_b", 700.0, 1000.0, true),
        ];
        both.truncate(arms);
        Ok(Self {
            arms: both,
            tables_y_mm: if tables == 1 { vec![0.0] } else { vec![-250.0, 950.0] },
            clearance_mm: 300.0,
        })
    }

    /// Time of the jerk-limited joint move of arm `arm` from one place of its bit to another, square to the face (`None`: its rest), s; `None` out of its reach.
    /// Places are x, y, z in the first arm's base, mm.
    pub fn travel_s(&self, arm: usize, from: Option<[f64; 3]>, to: Option<[f64; 3]>) -> Option<f64> {
        let arm = &self.arms[arm];
        let joints = |at: Option<[f64; 3]>| match at {
            Some([x, y, z]) => joints_rad([x, y - arm.base_y_mm, z]),
            None => {
                let aside_rad = (arm.rest_y_mm - arm.base_y_mm).atan2(REST_X_MM);
                let mut rest_rad = HOME_RAD;
                rest_rad[0] = aside_rad;
                Some(rest_rad)
            }
        };
        Some(Gp25::travel_s(joints(from)?, joints(to)?))
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
/// The bit's tip from the flange, mm: straight ahead and 40 mm aside, as the simulated cell is drawn.
const TOOL_MM: [f64; 3] = [0.0, -40.0, 300.0];

/// Joint angles with the bit square to the face at a place in the arm's own base; `None` out of reach.
fn joints_rad([x_mm, y_mm, z_mm]: [f64; 3]) -> Option<[f64; 6]> {
    let arm = Gp25::new(Transform::from_parts(TOOL_MM, UnitQuaternion::identity()));
    let ahead = Direction::new(1.0, 0.0, 0.0)?;
    arm.inverse(tool_pose(Point::new(x_mm, y_mm, z_mm), ahead)).ok()
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
                    assert!(
                        time_s.is_some_and(|t| (0.3..1.5).contains(&t)),
                        "{arm} {at:?} {time_s:?}"
                    );
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
        assert!(time_s(0.0) < 0.2);
    }

    #[test]
    fn sides_of_the_arms() {
        let (right, left) = (Strip::over([-300.0, 0.0]), Strip::over([300.0, 500.0]));
        assert!(right.is_clear_of(&left, 300.0) && !right.is_clear_of(&left, 301.0));
        assert!(!left.is_clear_of(&right, 0.0)); // crossed arms
    }
}
