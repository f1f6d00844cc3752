//! A simulated GP25 behind the arm trait: it accepts or refuses, takes its time, and never says where its tool really is.

use crate::draw::mix;
use crate::faults::Fault;
use crate::mechanics::{ArmErrors, Body};
use crate::world::{ArmJob, Shared, World, lock, until};
use async_trait::async_trait;
use cell::device::{ArmMode, ArmState, Bit, DeviceError, Motion, RobotArm, Ticket, jobs};
use cell::motion::{Gp25, Trajectory};
use geometry::{Base, Camera, Flange, Tool, Transform};

/// Round trip to the controller, s.
const ROUND_TRIP_S: f64 = 0.004;
/// Time until the controller reports "in position" after the last motion, s.
const SETTLE_S: f64 = 0.08;
/// Time of gripping, loosening and pulling a cover, s.
const PULL_S: f64 = 10.5;
/// Time of laying a cover aside, s.
const DROP_S: f64 = 4.5;
/// What the controller of a GP25 reports after a collision.
const COLLISION: (i64, &str) = (4315, "COLLISION DETECT");

/// One arm of the simulated world.
pub(crate) struct SimArm {
    pub(crate) name: String,
    pub(crate) model: Gp25,
    body: Body,
    /// Where the camera really is in this arm's base.
    pub(crate) base_from_camera: Transform<Base, Camera>,
    pub(crate) gripper: bool,
    /// Where its job HOME ends.
    home_rad: [f64; 6],
    pub(crate) jig: bool,
    /// What the driver carries.
    pub(crate) bit: Bit,
    joints_rad: [f64; 6],
    came_from: [f64; 6],
    visits: u64,
    motion: Option<Moving>,
    hold: bool,
    alarm: Option<(i64, String)>,
    tickets: u64,
    /// Last ticket that ended, and why if it did not arrive.
    ended: Option<(u64, Option<String>)>,
}

/// A motion under way.
#[derive(Clone, Debug)]
struct Moving {
    ticket: u64,
    to_rad: [f64; 6],
    from_s: f64,
    until_s: f64,
    alarm_at_s: Option<f64>,
    job: Option<ArmJob>,
}

impl SimArm {
    pub(crate) fn new(
        name: &str,
        seed: u64,
        errors: &ArmErrors,
        tool: Transform<Flange, Tool>,
        base_from_camera: Transform<Base, Camera>,
        gripper: bool,
        home_rad: [f64; 6],
    ) -> Self {
        Self {
            name: name.into(),
            model: Gp25::new(tool),
            body: Body::sample(mix(seed, &[name.len() as u64]), errors, tool),
            base_from_camera,
            gripper,
            home_rad,
            jig: false,
            bit: Bit::Cross,
            joints_rad: home_rad,
            came_from: [1.0; 6],
            visits: 0,
            motion: None,
            hold: false,
            alarm: None,
            tickets: 0,
            ended: None,
        }
    }

    /// Encoder angles at a time.
    pub(crate) fn joints_at(&self, now_s: f64) -> [f64; 6] {
        match &self.motion {
            None => self.joints_rad,
            Some(m) => {
                let t = ((now_s - m.from_s) / (m.until_s - m.from_s).max(1e-9)).clamp(0.0, 1.0);
                let s = t * t * (3.0 - 2.0 * t);
                std::array::from_fn(|j| self.joints_rad[j] + s * (m.to_rad[j] - self.joints_rad[j]))
            }
        }
    }

    /// Where the bit's tip, or the marker's middle, really is.
    pub(crate) fn camera_from_true_tool(&self, now_s: f64) -> Transform<Camera, Tool> {
        let tool = self
            .body
            .tool(self.joints_at(now_s), self.came_from, self.visits, self.jig);
        self.base_from_camera.inverse() * tool
    }

    /// When the motion under way ends by itself, if there is one.
    pub(crate) fn next_event_s(&self) -> Option<f64> {
        self.motion.as_ref().map(|m| m.alarm_at_s.unwrap_or(m.until_s))
    }

    /// Ends a motion whose time is over; returns the job that it completed.
    pub(crate) fn settle(&mut self, now_s: f64) -> Option<ArmJob> {
        let m = self.motion.clone()?;
        if let Some(at_s) = m.alarm_at_s {
            if at_s <= now_s {
                self.collide(at_s);
            }
            return None;
        }
        if m.until_s > now_s {
            return None;
        }
        for j in 0..6 {
            let way = m.to_rad[j] - self.joints_rad[j];
            if way.abs() > 1e-6 {
                self.came_from[j] = way.signum();
            }
        }
        self.joints_rad = m.to_rad;
        self.visits += 1;
        self.motion = None;
        self.ended = Some((m.ticket, None));
        m.job
    }

    pub(crate) fn is_moving(&self) -> bool {
        self.motion.is_some()
    }

    /// It has run into the other arm.
    pub(crate) fn collide(&mut self, now_s: f64) {
        self.stop(now_s, format!("alarm {} ({})", COLLISION.0, COLLISION.1));
        self.alarm = Some((COLLISION.0, COLLISION.1.into()));
    }

    fn stop(&mut self, now_s: f64, why: String) {
        self.joints_rad = self.joints_at(now_s);
        if let Some(m) = self.motion.take() {
            self.ended = Some((m.ticket, Some(why)));
        }
    }

    fn state(&self, now_s: f64) -> ArmState {
        let joints_rad = self.joints_at(now_s);
        ArmState {
            mode: ArmMode::Remote,
            servo_on: self.alarm.is_none(),
            running: self.motion.is_some(),
            hold: self.hold,
            alarm: self.alarm.clone(),
            emergency_stop: false,
            base_from_tool: self.model.forward(joints_rad),
            joints_rad,
            age_s: ROUND_TRIP_S,
        }
    }

    fn ready(&self) -> Result<(), DeviceError> {
        let state = match (&self.alarm, self.hold, &self.motion) {
            (Some((code, text)), ..) => format!("alarm {code}: {text}"),
            (_, true, _) => "held".into(),
            (.., Some(_)) => "moving; wait for the motion under way first".into(),
            _ => return Ok(()),
        };
        Err(DeviceError::NotReady {
            device: self.name.clone(),
            state,
        })
    }

    fn begin(&mut self, now_s: f64, to_rad: [f64; 6], takes_s: f64, alarm: bool, job: Option<ArmJob>) -> Ticket {
        self.tickets += 1;
        self.motion = Some(Moving {
            ticket: self.tickets,
            to_rad,
            from_s: now_s,
            until_s: now_s + takes_s,
            alarm_at_s: alarm.then_some(now_s + 0.5 * takes_s),
            job,
        });
        Ticket(self.tickets)
    }
}

/// One arm's handle for the program.
pub(crate) struct ArmHandle {
    pub(crate) world: Shared,
    pub(crate) index: usize,
    pub(crate) name: String,
}

impl ArmHandle {
    fn refuse(&self, reason: String) -> DeviceError {
        DeviceError::Refused {
            device: self.name.clone(),
            reason,
        }
    }

    fn timeout(&self, action: &str, timeout_s: f64) -> DeviceError {
        DeviceError::Timeout {
            device: self.name.clone(),
            action: action.into(),
            timeout_s,
        }
    }

    /// Begins a motion; the answer may be lost on its way back although the arm moves.
    fn start(
        &self,
        world: &mut World,
        to_rad: [f64; 6],
        takes_s: f64,
        job: Option<ArmJob>,
        action: &str,
    ) -> Result<Ticket, DeviceError> {
        let alarm = world.faults.happens(Fault::ArmAlarm);
        let now_s = world.now_s();
        let ticket = world.arms[self.index].begin(now_s, to_rad, takes_s, alarm, job);
        if world.faults.happens(Fault::ArmTimeoutAfterMove) {
            world.pass(1.0);
            return Err(self.timeout(action, 1.0));
        }
        Ok(ticket)
    }
}

#[async_trait]
impl RobotArm for ArmHandle {
    fn name(&self) -> &str {
        &self.name
    }

    async fn state(&self) -> Result<ArmState, DeviceError> {
        let mut world = lock(&self.world);
        world.pass(ROUND_TRIP_S);
        let now_s = world.now_s();
        Ok(world.arms[self.index].state(now_s))
    }

    async fn move_to(&self, base_from_tool: Transform<Base, Tool>, motion: Motion) -> Result<Ticket, DeviceError> {
        let mut world = lock(&self.world);
        world.pass(ROUND_TRIP_S);
        let arm = &world.arms[self.index];
        arm.ready()?;
        let to_rad = arm
            .model
            .inverse(base_from_tool)
            .map_err(|e| self.refuse(e.to_string()))?;
        let from_rad = arm.joints_at(world.now_s());
        let moving_s = match motion {
            Motion::Joint => Gp25::travel_s(from_rad, to_rad),
            Motion::Linear { speed_mm_s } => {
                if !(speed_mm_s.is_finite() && speed_mm_s > 0.0) {
                    return Err(self.refuse(format!("a speed of {speed_mm_s} mm/s is none")));
                }
                let from = arm.model.forward(from_rad);
                Trajectory::straight(&arm.model, from, base_from_tool, speed_mm_s)
                    .map_err(|e| self.refuse(format!("on the straight line: {e}")))?
                    .duration_s()
            }
        };
        let takes_s = moving_s + SETTLE_S;
        if let Some(reason) = world.keep_out(self.index, base_from_tool) {
            return Err(self.refuse(reason));
        }
        self.start(&mut world, to_rad, takes_s, None, "move")
    }

    async fn wait(&self, ticket: Ticket, timeout_s: f64) -> Result<ArmState, DeviceError> {
        let deadline_s = lock(&self.world).now_s() + timeout_s.max(0.0);
        loop {
            let end_s =
                {
                    let world = lock(&self.world);
                    let arm = &world.arms[self.index];
                    match arm.motion.as_ref().filter(|m| m.ticket == ticket.0) {
                        Some(m) => m.alarm_at_s.unwrap_or(m.until_s),
                        None => {
                            return match &arm.ended {
                                Some((ended, None)) if *ended == ticket.0 => Ok(arm.state(world.now_s())),
                                Some((ended, Some(why))) if *ended == ticket.0 => Err(DeviceError::NotReady {
                                    device: self.name.clone(),
                                    state: why.clone(),
                                }),
                                _ => Err(self
                                    .refuse(format!("ticket {} is not the last motion's; read the state", ticket.0))),
                            };
                        }
                    }
                };
            until(&self.world, end_s.min(deadline_s)).await;
            if end_s > deadline_s {
                return Err(self.timeout("wait", timeout_s));
            }
        }
    }

    async fn run_job(&self, job: &str) -> Result<Ticket, DeviceError> {
        let mut world = lock(&self.world);
        world.pass(ROUND_TRIP_S);
        let now_s = world.now_s();
        let arm = &world.arms[self.index];
        arm.ready()?;
        let home_rad = arm.home_rad;
        let home_s = Gp25::travel_s(arm.joints_at(now_s), home_rad) + SETTLE_S;
        let (takes_s, work) = if job == jobs::HOME {
            (home_s, None)
        } else if arm.gripper && job == jobs::DROP {
            (DROP_S, Some(ArmJob::Drop))
        } else if let Some(cover) = ArmJob::pulls().find(|c| jobs::pull(c.name()) == job && arm.gripper) {
            (PULL_S, Some(ArmJob::Pull(cover)))
        } else if let Some(bit) = [Bit::Cross, Bit::Extractor, Bit::Mill]
            .into_iter()
            .find(|bit| jobs::mount(*bit) == job)
        {
            (home_s + world.assumed().bit_change_s, Some(ArmJob::Mount(bit)))
        } else {
            return Err(DeviceError::Fault {
                device: self.name.clone(),
                action: format!("start of job {job}"),
                code: 0x4040,
                text: "specified JOB not found".into(),
            });
        };
        self.start(&mut world, home_rad, takes_s, work, job)
    }

    async fn hold(&self) -> Result<(), DeviceError> {
        let mut world = lock(&self.world);
        let now_s = world.now_s();
        let arm = &mut world.arms[self.index];
        arm.hold = true;
        arm.stop(now_s, "held".into());
        Ok(())
    }

    async fn reset(&self) -> Result<(), DeviceError> {
        let mut world = lock(&self.world);
        world.pass(ROUND_TRIP_S);
        // A real controller acknowledges a reset also when its cause is still there.
        if !world.faults.happens(Fault::ResetLies) {
            let arm = &mut world.arms[self.index];
            arm.alarm = None;
            arm.hold = false;
        }
        Ok(())
    }
}
