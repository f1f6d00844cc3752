//! Which arm does what, when: a schedule for a unit (or several) over one or two arms and one or two tables, and its execution.
//!
//! A [`Product`] says what there is to take off and what holds what; a [`Station`] where arms and tables stand. [`Problem::new`] turns
//! both into tasks: ways through the screws of a face are exact tours ([`tour`]), and tasks that need the same arm, the same side of the
//! table, a clear view or overlapping room exclude each other. [`solve`](solve()) finds a plan and a lower bound that is true for every
//! division of the screws between the arms, so that the gap says how much there is left to gain. [`dispatch::Dispatcher`] carries a plan
//! out event by event.
//!
//! ```
//! use cell::schedule::{Limits, Problem, Product, Station, solve};
//! let product = Product::outdoor_unit()?;
//! let problem = Problem::new(&product, &Station::new(2, 1)?, 1)?;
//! let limits = Limits { time_s: 20.0, rounds: 4, ..Limits::default() };
//! let plan = solve(&problem, &limits, |_| {});
//! assert!(problem.check(&plan.placed).is_ok());
//! assert!(plan.bound_s <= plan.makespan_s);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod dispatch;
mod product;
mod solve;
mod station;
mod task;
pub mod tour;

pub use product::{AnyOf, Cover, Face, Product, ProductError, TimesS};
pub use solve::{Limits, Plan, solve};
pub use station::{Arm, Station, StationError, Strip};
pub use task::{After, ArmUse, Kind, Mode, Placed, Problem, ProblemError, Stop, Task, Violation};
