//! What happens when the bit turns: decided by where its tip really is and by what it meets there.

use crate::Assumed;
use crate::draw::draw;
use crate::faults::Fault;
use crate::score::{ActionKind, Aim};
use crate::world::{Shared, World, lock, until};
use async_trait::async_trait;
use cell::device::{Bit, DeviceError, DriveEnd, DriveProgram, DriveResult, DriverTool};
use geometry::{Direction, Point};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use scene::ScrewId;

/// A screw further away than this is not what the bit was meant for, mm.
const NEAREST_MM: f64 = 12.0;
/// The spring takes up this much along the axis, mm.
const SPRING_MM: f64 = 3.0;
/// Force at which the figures below hold, N.
const USUAL_FORCE_N: f64 = 150.0;
/// How fast an impact driver turns a loose screw out, mm/s.
const UNSCREW_MM_S: f64 = 9.0;

/// What the bit met.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Met {
    /// How the bit stands to it.
    pub aim: Aim,
    /// Share of the recess that is filled, 0 to 1.
    pub slot_fill: f64,
    /// How far the recess is rounded, 0 to 1.
    pub worn_slot: f64,
    /// Torque that loosens it, N m.
    pub torque_nm: f64,
    /// How long impacts of at least that torque have to go on until it turns, s: 0 unless it is rusted solid.
    pub holds_out_s: f64,
}

/// Smooth step from 0 at `low` to 1 at `high`.
fn rise(low: f64, high: f64, x: f64) -> f64 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Probability that spring and cone lead the bit into the recess: sure below 0.6 mm, the paper's ±0.75 mm usually, none beyond 1.1 mm.
pub(crate) fn finds_recess(aim: &Aim) -> f64 {
    if aim.depth_mm.abs() > SPRING_MM {
        return 0.0;
    }
    1.0 - rise(0.58, 1.12, aim.lateral_mm)
}

/// Probability that the bit slips out: fill, wear and tilt, pressed against by the axial force.
pub(crate) fn cams_out(met: &Met, axial_force_n: f64, bit: Bit, assumed: &Assumed) -> f64 {
    let [fill, wear] = match bit {
        Bit::Extractor => [assumed.extractor_fill, assumed.extractor_wear],
        Bit::Cross | Bit::Mill => [1.0, 1.0],
    };
    let slips = 1.0
        - (1.0 - rise(0.35, 0.95, fill * met.slot_fill))
            * (1.0 - 0.7 * rise(0.45, 1.0, wear * met.worn_slot))
            * (1.0 - rise(8f64.to_radians(), 15f64.to_radians(), met.aim.tilt_rad));
    slips.powf((axial_force_n.max(1.0) / USUAL_FORCE_N).clamp(0.3, 3.0))
}

/// Torque that a programme brings to bear, N m: impacts that go on work a tight screw loose.
fn capacity_nm(program: &DriveProgram) -> f64 {
    program.max_torque_nm * (1.0 + 0.08 * (program.max_time_s / 2.5).max(0.1).ln())
}

/// Runs a programme on what the bit met.
pub(crate) fn outcome(met: &Met, program: &DriveProgram, assumed: &Assumed, rng: &mut Pcg64Mcg) -> DriveResult {
    let scatter = rng.random_range(0.95..1.05);
    let result = |end, time_s: f64, peak_torque_nm: f64, stroke_mm: f64| DriveResult {
        end,
        time_s: time_s.min(program.max_time_s),
        peak_torque_nm: peak_torque_nm.min(program.max_torque_nm),
        stroke_mm,
    };
    if program.bit == Bit::Mill {
        return mill(met, program, assumed);
    }
    if !rng.random_bool(finds_recess(&met.aim)) {
        return result(DriveEnd::MissedHead, 0.6 * scatter, 0.4 * scatter, 0.0);
    }
    if rng.random_bool(cams_out(met, program.axial_force_n, program.bit, assumed)) {
        return result(
            DriveEnd::CamOut,
            0.9 * scatter,
            0.5 * met.torque_nm * scatter,
            0.3 * scatter,
        );
    }
    if met.torque_nm > capacity_nm(program) || met.holds_out_s > program.max_time_s {
        return result(DriveEnd::Seized, program.max_time_s, program.max_torque_nm, 0.0);
    }
    let loosening_s = met.holds_out_s + 0.35 + 0.6 * met.torque_nm / capacity_nm(program).max(0.1);
    let time_s = (loosening_s + program.stroke_mm / UNSCREW_MM_S) * scatter;
    if time_s > program.max_time_s {
        let stroke_mm = (program.max_time_s - loosening_s).max(0.0) * UNSCREW_MM_S;
        return result(
            DriveEnd::TimeOut,
            program.max_time_s,
            met.torque_nm * scatter,
            stroke_mm,
        );
    }
    result(DriveEnd::Removed, time_s, met.torque_nm * scatter, program.stroke_mm)
}

/// A cutter does not care for the recess: it takes the head off if it stands over it and has the time.
fn mill(met: &Met, program: &DriveProgram, assumed: &Assumed) -> DriveResult {
    let over_it = met.aim.lateral_mm <= assumed.mill_reach_mm && met.aim.depth_mm.abs() <= SPRING_MM;
    let in_time = program.max_time_s >= assumed.mill_s;
    DriveResult {
        end: match (over_it, in_time) {
            (false, _) => DriveEnd::MissedHead,
            (true, false) => DriveEnd::TimeOut,
            (true, true) => DriveEnd::Removed,
        },
        time_s: if over_it {
            assumed.mill_s.min(program.max_time_s)
        } else {
            1.0_f64.min(program.max_time_s)
        },
        peak_torque_nm: 2.0_f64.min(program.max_torque_nm),
        stroke_mm: if over_it && in_time { program.stroke_mm } else { 0.0 },
    }
}

/// How long a screw that is rusted solid still holds out, s.
fn holds_out_s(unit: u64, screw: u32, hammered_s: f64, assumed: &Assumed) -> f64 {
    // halves with every half-life: an exponential distribution
    let share: f64 = draw(unit, &[71, u64::from(screw)]).random_range(1e-6..1.0);
    (-share.log2() * assumed.seized_half_life_s - hammered_s).max(0.0)
}

/// The driver on one arm.
pub(crate) struct DriverHandle {
    pub(crate) world: Shared,
    pub(crate) arm: usize,
    pub(crate) name: String,
}

#[async_trait]
impl DriverTool for DriverHandle {
    async fn drive(&self, program: DriveProgram) -> Result<DriveResult, DeviceError> {
        let (result, met, end_s) = {
            let mut world = lock(&self.world);
            let (result, met) = self.meet(&mut world, &program)?;
            (result, met, world.now_s() + result.time_s)
        };
        until(&self.world, end_s).await;
        let mut world = lock(&self.world);
        let mut impacts_s = 0.0;
        if let Some((id, met)) = &met {
            let turns = result.end == DriveEnd::Seized && met.torque_nm <= capacity_nm(&program);
            impacts_s = if turns { result.time_s } else { 0.0 };
            world.driven(*id, result.end, impacts_s);
        }
        let arm = world.arms[self.arm].name.clone();
        world.record(ActionKind::Drive {
            arm,
            screw: met.as_ref().map(|m| m.0),
            aim: met.as_ref().map(|m| m.1.aim),
            end: result.end,
            impacts_s,
        });
        if world.faults.happens(Fault::DriverNoAnswer) {
            world.pass(1.0);
            return Err(DeviceError::Timeout {
                device: self.name.clone(),
                action: "drive".into(),
                timeout_s: 1.0,
            });
        }
        Ok(result)
    }
}

impl DriverHandle {
    /// What a programme comes to that is begun now, and at which screw.
    fn meet(
        &self,
        world: &mut World,
        program: &DriveProgram,
    ) -> Result<(DriveResult, Option<(ScrewId, Met)>), DeviceError> {
        let numbers = [
            program.axial_force_n,
            program.max_time_s,
            program.max_torque_nm,
            program.stroke_mm,
        ];
        if !numbers.iter().all(|v| v.is_finite() && *v > 0.0) {
            return Err(DeviceError::Refused {
                device: self.name.clone(),
                reason: format!("{program:?} is not bounded: every limit must be a positive number"),
            });
        }
        if world.arms[self.arm].jig {
            return Err(DeviceError::Refused {
                device: self.name.clone(),
                reason: "the marker jig is mounted in place of the bit; take it off first".into(),
            });
        }
        let bit = world.arms[self.arm].bit;
        if bit != program.bit {
            return Err(DeviceError::Refused {
                device: self.name.clone(),
                reason: format!(
                    "the {} bit is mounted, the programme is for the {}",
                    bit.name(),
                    program.bit.name()
                ),
            });
        }
        if bit == Bit::Mill && !world.assumed().mill_permitted {
            return Err(DeviceError::Refused {
                device: self.name.clone(),
                reason: "the plant's controller does not permit milling".into(),
            });
        }
        let assumed = world.assumed();
        let now_s = world.now_s();
        let tool = world.arms[self.arm].camera_from_true_tool(now_s);
        let tip = tool * Point::new(0.0, 0.0, 0.0);
        let truth = world.truth();
        let standing = truth
            .iter()
            .flat_map(|t| t.screws.iter())
            .filter(|s| world.unit.as_ref().is_some_and(|u| !u.removed.contains(&s.id)));
        let met = standing
            .filter_map(|screw| {
                let off = tip.vector() - screw.point.vector();
                let axis = screw.axis.vector();
                let depth_mm = off.dot(&axis);
                let lateral_mm = (off - axis * depth_mm).norm();
                let design = world.unit.as_ref()?.unit.screws().find(|(_, s)| s.id == screw.id)?.1;
                let attempts = world.unit.as_ref()?.attempts.get(&screw.id).copied().unwrap_or(0);
                let bit = tool * Direction::new(0.0, 0.0, -1.0)?;
                let met = Met {
                    aim: Aim {
                        lateral_mm,
                        depth_mm,
                        tilt_rad: bit.angle_rad(screw.axis),
                    },
                    slot_fill: screw.slot_fill,
                    // Every attempt that slips rounds the recess a little more.
                    worn_slot: (f64::from(design.placed.item.wear.worn_slot) + 0.06 * f64::from(attempts)).min(1.0),
                    torque_nm: design.torque_nm,
                    holds_out_s: if design.seized {
                        let loaded = world.unit.as_ref()?;
                        let hammered_s = loaded.impacts_s.get(&screw.id).copied().unwrap_or(0.0);
                        holds_out_s(loaded.unit.seed, u32::from(screw.id.0), hammered_s, &assumed)
                    } else {
                        0.0
                    },
                };
                (off.norm() < NEAREST_MM).then_some((screw.id, met, attempts))
            })
            .min_by(|a, b| a.1.aim.lateral_mm.total_cmp(&b.1.aim.lateral_mm));
        let result = match &met {
            Some((id, met, attempt)) => {
                let unit = world.unit.as_ref().map_or(0, |u| u.unit.seed);
                outcome(
                    met,
                    program,
                    &assumed,
                    &mut draw(unit, &[70, u64::from(id.0), u64::from(*attempt)]),
                )
            }
            // Sheet, bolt or air: the bit presses and finds nothing to turn.
            None => DriveResult {
                end: DriveEnd::MissedHead,
                time_s: 0.6_f64.min(program.max_time_s),
                peak_torque_nm: 0.3_f64.min(program.max_torque_nm),
                stroke_mm: 0.0,
            },
        };
        Ok((result, met.map(|(id, met, _)| (id, met))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PROGRAM: DriveProgram = DriveProgram {
        axial_force_n: 150.0,
        max_time_s: 2.5,
        max_torque_nm: 12.0,
        stroke_mm: 10.0,
        bit: Bit::Cross,
    };
    const AIM: Aim = Aim {
        lateral_mm: 0.2,
        depth_mm: 0.5,
        tilt_rad: 0.03,
    };
    const CLEAN: Met = Met {
        aim: AIM,
        slot_fill: 0.1,
        worn_slot: 0.1,
        torque_nm: 4.0,
        holds_out_s: 0.0,
    };

    fn share(met: Met, program: DriveProgram, end: DriveEnd) -> f64 {
        let runs = 2000;
        let hits = (0..runs)
            .filter(|k| outcome(&met, &program, &Assumed::default(), &mut draw(5, &[*k])).end == end)
            .count();
        hits as f64 / runs as f64
    }

    #[test]
    fn success_falls_with_the_distance_from_the_recess() {
        let removed = |lateral_mm| {
            share(
                Met {
                    aim: Aim { lateral_mm, ..AIM },
                    ..CLEAN
                },
                PROGRAM,
                DriveEnd::Removed,
            )
        };
        assert!(removed(0.3) > 0.99 && removed(0.55) > 0.99);
        assert!((0.6..0.9).contains(&removed(0.75)), "{}", removed(0.75));
        assert!(removed(1.15) < 0.01);
        assert_eq!(
            share(
                Met {
                    aim: Aim { depth_mm: 3.5, ..AIM },
                    ..CLEAN
                },
                PROGRAM,
                DriveEnd::MissedHead
            ),
            1.0
        );
    }

    #[test]
    fn wear_tilt_and_rust_end_as_they_should() {
        let filled = Met {
            slot_fill: 0.8,
            ..CLEAN
        };
        let slips = share(filled, PROGRAM, DriveEnd::CamOut);
        let harder = DriveProgram {
            axial_force_n: 250.0,
            ..PROGRAM
        };
        assert!(slips > 0.7 && share(filled, harder, DriveEnd::CamOut) < slips);
        let leaning = |deg: f64| Met {
            aim: Aim {
                tilt_rad: deg.to_radians(),
                ..AIM
            },
            ..CLEAN
        };
        assert!(share(leaning(14.0), PROGRAM, DriveEnd::CamOut) > 0.8);
        assert_eq!(share(leaning(7.0), PROGRAM, DriveEnd::CamOut), 0.0);
        let solid = Met {
            holds_out_s: 4.0,
            ..CLEAN
        };
        assert_eq!(share(solid, PROGRAM, DriveEnd::Seized), 1.0);
        let tight = Met {
            torque_nm: 15.0,
            ..CLEAN
        };
        let longer = DriveProgram {
            max_torque_nm: 18.0,
            max_time_s: 6.0,
            ..PROGRAM
        };
        assert_eq!(share(tight, PROGRAM, DriveEnd::Seized), 1.0);
        assert!(share(tight, longer, DriveEnd::Removed) > 0.99);
    }

    #[test]
    fn an_extractor_holds_in_a_filled_recess_and_a_mill_needs_none() {
        let filled = Met {
            slot_fill: 0.8,
            worn_slot: 0.8,
            ..CLEAN
        };
        let with = |bit, max_time_s| DriveProgram {
            bit,
            max_time_s,
            ..PROGRAM
        };
        let cross = share(filled, with(Bit::Cross, 2.5), DriveEnd::Removed);
        let extractor = share(filled, with(Bit::Extractor, 2.5), DriveEnd::Removed);
        assert!(cross < 0.3 && extractor > 0.6, "{cross} {extractor}");
        let solid = Met {
            holds_out_s: 100.0,
            ..filled
        };
        assert_eq!(share(solid, with(Bit::Mill, 15.0), DriveEnd::Removed), 1.0);
        assert_eq!(share(solid, with(Bit::Mill, 5.0), DriveEnd::TimeOut), 1.0);
        let beside = Met {
            aim: Aim { lateral_mm: 2.5, ..AIM },
            ..CLEAN
        };
        assert_eq!(share(beside, with(Bit::Mill, 15.0), DriveEnd::MissedHead), 1.0);
    }

    #[test]
    fn half_of_the_screws_that_are_rusted_solid_turn_within_the_half_life() {
        let assumed = Assumed::default();
        let screws = 4000;
        let loose = (0..screws).filter(|k| holds_out_s(7, *k, assumed.seized_half_life_s, &assumed) == 0.0);
        let share = loose.count() as f64 / f64::from(screws);
        assert!((share - 0.5).abs() < 0.03, "{share}");
    }

    #[test]
    fn limits_hold_and_times_are_those_of_an_impact_driver() {
        for k in 0..500 {
            let met = Met {
                torque_nm: 1.0 + 0.02 * k as f64,
                ..CLEAN
            };
            let result = outcome(&met, &PROGRAM, &Assumed::default(), &mut draw(9, &[k]));
            assert!(result.time_s <= PROGRAM.max_time_s && result.peak_torque_nm <= PROGRAM.max_torque_nm);
            if result.end == DriveEnd::Removed {
                assert!((1.0..=3.0).contains(&result.time_s), "{} s", result.time_s);
            }
        }
    }
}
