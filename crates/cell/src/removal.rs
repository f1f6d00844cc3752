//! One screw: approach, drive, retreat; and the moves of the arms, none of which is ever sent twice.

use crate::config::{Approach, CellConfig, Timeouts};
use crate::device::{
    Arm, ArmState, Bit, CellIo, Clock, DeviceError, Devices, DriveEnd, DriveProgram, DriverTool, Motion, RobotArm,
    TagValue, Ticket, jobs, tags,
};
use crate::motion::{ArmMotion, Leg, Refusal, Way};
use crate::plan::{Room, SafeTarget, tool_pose};
use crate::record::Burst;
use geometry::{Base, Direction, Point, Tool, Transform};
use std::sync::Arc;

/// Position and angle within which an arm counts as arrived, when only its state can tell.
const ARRIVED_MM: f64 = 0.5;
const ARRIVED_RAD: f64 = 0.005;
/// Time between two looks at the state of an arm that is under way, s.
const POLL_S: f64 = 0.05;

/// An arm with the limits of its moves.
pub struct Mover<'a> {
    /// The arm.
    pub arm: &'a Arm,
    /// How it comes to a screw.
    pub approach: Approach,
    /// How long anything may take.
    pub timeouts: Timeouts,
    /// The cell's clock.
    pub clock: &'a Arc<dyn Clock>,
    /// The cell's I/O: which bit a driver carries.
    pub io: &'a Arc<dyn CellIo>,
    /// What is around it; without, it is sent to no screw.
    pub motion: Option<&'a ArmMotion>,
    /// Ways that it may take while the other arm is at work; `None` while that one rests.
    pub room: Option<&'a Room>,
}

impl std::fmt::Debug for Mover<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Mover")
            .field("arm", &self.robot().name())
            .finish_non_exhaustive()
    }
}

impl<'a> Mover<'a> {
    /// That of an arm of a cell; `None` if there is no such arm. `motions` has an entry for each arm whose ways are checked.
    pub fn of(
        devices: &'a Devices,
        config: &CellConfig,
        motions: &'a [Option<ArmMotion>],
        arm: usize,
        room: Option<&'a Room>,
    ) -> Option<Self> {
        Some(Self {
            arm: devices.arms.get(arm)?,
            approach: config.approach,
            timeouts: config.timeouts,
            clock: &devices.clock,
            io: &devices.io,
            motion: motions.get(arm).and_then(Option::as_ref),
            room,
        })
    }

    fn robot(&self) -> &dyn RobotArm {
        self.arm.robot.as_ref()
    }

    /// The state, if it is fresh and the arm may be moved.
    ///
    /// # Errors
    /// [`DeviceError::Stale`] or [`DeviceError::NotReady`].
    pub async fn ready(&self) -> Result<ArmState, DeviceError> {
        let state = self.robot().state().await?;
        let device = || self.robot().name().to_owned();
        if state.age_s > self.timeouts.state_age_s {
            return Err(DeviceError::Stale {
                device: device(),
                age_s: state.age_s,
            });
        }
        match trouble(&state) {
            Some(state) => Err(DeviceError::NotReady {
                device: device(),
                state,
            }),
            None => Ok(state),
        }
    }

    /// One burst at a target: in front of it, straight in, drive, straight back. The bit comes back whatever the driver says; an
    /// error of arm or driver is in the burst.
    pub async fn burst(&self, target: &SafeTarget, program: DriveProgram) -> Burst {
        let begin_s = self.clock.now_s();
        let mut burst = Burst {
            program: None,
            end: None,
            error: None,
            aim: target.tip(),
            second_look: None,
            places_left: None,
            time_s: 0.0,
        };
        if let Err(error) = self.burst_into(target, program, &mut burst).await {
            burst.error.get_or_insert(error.to_string());
        }
        burst.time_s = self.clock.now_s() - begin_s;
        burst
    }

    async fn burst_into(
        &self,
        target: &SafeTarget,
        program: DriveProgram,
        burst: &mut Burst,
    ) -> Result<(), DeviceError> {
        let Some(driver) = &self.arm.driver else {
            return Err(DeviceError::Refused {
                device: self.robot().name().into(),
                reason: "it carries no driver".into(),
            });
        };
        self.ready().await?;
        self.mount(program.bit).await?;
        let state = self.ready().await?;
        for pose in self.way(state.joints_rad, target).await? {
            self.go(pose, Motion::Joint).await?;
        }
        let worked = self.work(driver, target, program, burst).await;
        let back = Motion::Linear {
            speed_mm_s: self.approach.retract_mm_s,
        };
        worked.and(self.to_standoff(target, back).await)
    }

    /// Sees to it that the driver carries a bit. Whether it does is read, before and after.
    async fn mount(&self, bit: Bit) -> Result<(), DeviceError> {
        let tag = tags::bit(self.robot().name());
        let wanted = TagValue::Text(bit.name().into());
        if self.io.read(&tag).await? == wanted {
            return Ok(());
        }
        // the job leads straight to the magazine: from the rest that is free
        self.home().await?;
        self.job(&jobs::mount(bit)).await?;
        match self.io.read(&tag).await? {
            now if now == wanted => Ok(()),
            now => Err(DeviceError::NotReady {
                device: self.robot().name().into(),
                state: format!("the driver carries {now:?}, not the {} bit", bit.name()),
            }),
        }
    }

    /// Poses on the way to in front of a target, itself the last. Where no way is free from where the arm stands, or only
    /// one that was not planned beside the other arm's, it goes home first: from there the target was planned.
    async fn way(&self, joints_rad: [f64; 6], target: &SafeTarget) -> Result<Vec<Transform<Base, Tool>>, DeviceError> {
        let refused = |reason: String| DeviceError::Refused {
            device: self.robot().name().into(),
            reason,
        };
        let motion = self
            .motion
            .ok_or_else(|| refused("what is around it is not drawn".into()))?;
        let planned = |way: &Way| self.room.is_none_or(|room| room.holds(way));
        let way = match target.check(motion, joints_rad, &self.approach) {
            Ok(way) if planned(&way) => Ok(way),
            Ok(_) | Err(Refusal::Collision { leg: Leg::Joint, .. }) => {
                self.home().await?;
                target.check(motion, self.ready().await?.joints_rad, &self.approach)
            }
            Err(refusal) => Err(refusal),
        };
        let way = way.map_err(|why| refused(why.to_string()))?;
        if !planned(&way) {
            return Err(refused(
                "the way there is not the one that leaves the other arm its room".into(),
            ));
        }
        Ok(way.joint.iter().map(|leg| leg.to).collect())
    }

    /// From in front of the screw: in, and drive.
    async fn work(
        &self,
        driver: &Arc<dyn DriverTool>,
        target: &SafeTarget,
        program: DriveProgram,
        burst: &mut Burst,
    ) -> Result<(), DeviceError> {
        let speed_mm_s = self.approach.approach_mm_s;
        self.to_contact(target, Motion::Linear { speed_mm_s }).await?;
        burst.program = Some(program);
        let driven = driver.drive(program).await;
        burst.end = match &driven {
            Ok(result) => Some(result.end),
            // it may have worked: a picture will tell, the programme is not started again
            Err(DeviceError::Timeout { .. }) => Some(DriveEnd::TimeOut),
            Err(_) => None,
        };
        driven.map(|_| ())
    }

    async fn to_standoff(&self, target: &SafeTarget, motion: Motion) -> Result<(), DeviceError> {
        self.go(target.standoff_pose(), motion).await
    }

    async fn to_contact(&self, target: &SafeTarget, motion: Motion) -> Result<(), DeviceError> {
        self.go(target.contact_pose(), motion).await
    }

    /// Shows the marker at a place of a calibration plan: the only moves that are not to a [`SafeTarget`], made on an empty table
    /// with a jig in place of the bit, since there is no calibrated volume yet.
    pub(crate) async fn visit(&self, tip: Point<Base>, approach: Direction<Base>) -> Result<(), DeviceError> {
        self.go(tool_pose(tip, approach), Motion::Joint).await
    }

    /// The only place that sends a move. Private: poses come from [`SafeTarget`]s, from ways to them and from calibration plans alone.
    async fn go(&self, pose: Transform<Base, Tool>, motion: Motion) -> Result<(), DeviceError> {
        match self.robot().move_to(pose, motion).await {
            Ok(ticket) => self.arrive(ticket, Some(pose)).await,
            // it may be under way: what follows reads, it does not send again
            Err(lost @ DeviceError::Timeout { .. }) => self.settle(lost, Some(pose)).await,
            Err(error) => Err(error),
        }
    }

    /// Runs a job of the controller to its end.
    ///
    /// # Errors
    /// What the arm says; after a time-out, only if the arm does not come to rest in order.
    pub async fn job(&self, job: &str) -> Result<(), DeviceError> {
        let started = self.start(job).await?;
        self.finish(started, job).await
    }

    /// Sends the arm out of the way of table and camera, by way of a place farther back where straight home is not free. One that rests there
    /// already is left alone.
    ///
    /// # Errors
    /// As for [`job`](Self::job).
    pub async fn home(&self) -> Result<(), DeviceError> {
        if let Some(motion) = self.motion {
            let state = self.robot().state().await?;
            if motion.is_home(state.joints_rad) && !state.running && trouble(&state).is_none() {
                return Ok(());
            }
            if let Some(via) = motion.via_home(state.joints_rad) {
                self.go(via, Motion::Joint).await?;
            }
        }
        self.job(jobs::HOME).await
    }

    /// Starts a job of the controller without waiting for its end, see [`finish`](Self::finish).
    ///
    /// # Returns
    /// `None` if the answer was lost: the job may be running, its end is found out by reading.
    ///
    /// # Errors
    /// What the arm says.
    pub async fn start(&self, job: &str) -> Result<Option<Ticket>, DeviceError> {
        match self.robot().run_job(job).await {
            Ok(ticket) => Ok(Some(ticket)),
            Err(DeviceError::Timeout { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Waits for the end of a job that was started.
    ///
    /// # Errors
    /// As for [`job`](Self::job).
    pub async fn finish(&self, ticket: Option<Ticket>, job: &str) -> Result<(), DeviceError> {
        match ticket {
            Some(ticket) => self.arrive(ticket, None).await,
            None => {
                let lost = DeviceError::Timeout {
                    device: self.robot().name().into(),
                    action: job.into(),
                    timeout_s: self.timeouts.job_s,
                };
                self.settle(lost, None).await
            }
        }
    }

    async fn arrive(&self, ticket: Ticket, pose: Option<Transform<Base, Tool>>) -> Result<(), DeviceError> {
        let timeout_s = if pose.is_some() {
            self.timeouts.move_s
        } else {
            self.timeouts.job_s
        };
        match self.robot().wait(ticket, timeout_s).await {
            Ok(_) => Ok(()),
            Err(late @ DeviceError::Timeout { .. }) => self.settle(late, pose).await,
            Err(error) => Err(error),
        }
    }

    /// After a time-out: reads the state until the arm rests, then says whether it is where it was to go. Sends nothing.
    async fn settle(&self, lost: DeviceError, pose: Option<Transform<Base, Tool>>) -> Result<(), DeviceError> {
        let limit_s = if pose.is_some() {
            self.timeouts.move_s
        } else {
            self.timeouts.job_s
        };
        let polls = (limit_s / POLL_S).ceil() as usize;
        for _ in 0..polls {
            let state = self.robot().state().await?;
            if let Some(state) = trouble(&state) {
                return Err(DeviceError::NotReady {
                    device: self.robot().name().into(),
                    state,
                });
            }
            if !state.running {
                return if pose.is_none_or(|pose| is_at(&state, &pose)) {
                    Ok(())
                } else {
                    Err(lost)
                };
            }
            self.clock.pass(POLL_S);
            tokio::task::yield_now().await;
        }
        Err(lost)
    }

    /// Clears an alarm once, and believes it only if the state agrees. Moves nothing, and leaves alone what a person has
    /// done: a hold, an emergency stop, another mode.
    ///
    /// # Errors
    /// [`DeviceError::NotReady`] if the arm may not be moved: a person has to look.
    pub async fn recover(&self) -> Result<(), DeviceError> {
        let state = self.robot().state().await?;
        if state.alarm.is_some() && !state.hold && !state.emergency_stop {
            self.robot().reset().await?;
        }
        self.ready().await.map(|_| ())
    }

    /// Draws the bit straight back from where it stands to the front of a target, after a move that did not end.
    ///
    /// # Errors
    /// What the arm says.
    pub async fn withdraw(&self, target: &SafeTarget) -> Result<(), DeviceError> {
        let speed_mm_s = self.approach.approach_mm_s;
        self.to_standoff(target, Motion::Linear { speed_mm_s }).await
    }
}

/// Why an arm may not be moved, if so.
fn trouble(state: &ArmState) -> Option<String> {
    if state.emergency_stop {
        return Some("emergency stop".into());
    }
    if let Some((code, text)) = &state.alarm {
        return Some(format!("alarm {code}: {text}"));
    }
    if state.hold {
        return Some("held".into());
    }
    if state.mode != crate::device::ArmMode::Remote {
        return Some(format!("mode {:?}, not remote", state.mode));
    }
    (!state.servo_on).then(|| "servo off".into())
}

fn is_at(state: &ArmState, pose: &Transform<Base, Tool>) -> bool {
    let off = state.base_from_tool.isometry().inv_mul(pose.isometry());
    off.translation.vector.norm() <= ARRIVED_MM && off.rotation.angle() <= ARRIVED_RAD
}
