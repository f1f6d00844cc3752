//! Table, infeed, outfeed and reader behind the I/O tags.

use crate::draw::draw;
use crate::faults::Fault;
use crate::world::{Shared, World, lock};
use async_trait::async_trait;
use cell::device::{CellIo, Clock, DeviceError, ModelNumber, ModelReader, PlantLink, TagValue, tags};
use rand::RngExt;
use scene::FaceId;

/// Scan time of the cell's PLC, s.
const SCAN_S: f64 = 0.01;
/// Share of plates that cannot be read: dirt, scratches, no plate.
const UNREADABLE: f64 = 0.08;

/// The PLC of the cell.
pub(crate) struct IoHandle(pub(crate) Shared);

fn fault(action: String, code: i64, text: impl Into<String>) -> DeviceError {
    DeviceError::Fault {
        device: "plc".into(),
        action,
        code,
        text: text.into(),
    }
}

fn value_of(world: &World, tag: &str) -> Result<TagValue, DeviceError> {
    Ok(match tag {
        tags::LOADED => TagValue::Bool(world.unit.is_some()),
        tags::MAGNET => TagValue::Bool(world.magnet),
        tags::PRESENTED => {
            let face = world.unit.as_ref().and_then(|u| u.presented);
            TagValue::Text(face.map_or_else(String::new, |f| f.name().to_owned()))
        }
        tags::GRIPPER_HOLDING => TagValue::Bool(world.held_cover.is_some()),
        tags::SAFETY_OK => TagValue::Bool(true),
        tags::MILL_PERMITTED => TagValue::Bool(world.assumed().mill_permitted),
        // Outputs read back as pulses: the PLC takes the request and clears it.
        tags::FEED | tags::DISCHARGE => TagValue::Bool(false),
        tags::PRESENT => TagValue::Text(String::new()),
        _ => match world.arms.iter().find(|arm| tags::bit(&arm.name) == tag) {
            Some(arm) => TagValue::Text(arm.bit.name().into()),
            None => return Err(unknown(tag)),
        },
    })
}

fn unknown(tag: &str) -> DeviceError {
    fault(format!("tag '{tag}'"), 2, "no such tag in the simulated cell")
}

#[async_trait]
impl CellIo for IoHandle {
    async fn read(&self, tag: &str) -> Result<TagValue, DeviceError> {
        let mut world = lock(&self.0);
        world.pass(SCAN_S);
        value_of(&world, tag)
    }

    async fn write(&self, tag: &str, value: TagValue) -> Result<(), DeviceError> {
        let mut world = lock(&self.0);
        world.pass(SCAN_S);
        let action = || format!("writing {value:?} to '{tag}'");
        let refuse = |text: &str| Err(fault(action(), 10, format!("interlock: {text}")));
        match (tag, &value) {
            (tags::FEED | tags::DISCHARGE, TagValue::Bool(false)) => Ok(()),
            (tags::MAGNET, TagValue::Bool(on)) => {
                world.magnet = *on;
                Ok(())
            }
            (tags::FEED, TagValue::Bool(true)) => {
                if world.unit.is_some() {
                    return refuse("a unit stands on the table; discharge it first");
                }
                if world.table_busy() {
                    return refuse("the table is busy");
                }
                world.feed();
                Ok(())
            }
            (tags::DISCHARGE, TagValue::Bool(true)) => {
                if world.unit.is_none() {
                    return refuse("no unit stands on the table");
                }
                if world.table_busy() {
                    return refuse("the table is busy");
                }
                if let Some(arm) = world.arm_in_view() {
                    return refuse(&format!("{} stands at the unit; send it home first", arm.name));
                }
                world.discharge();
                Ok(())
            }
            (tags::PRESENT, TagValue::Text(name)) => {
                let Some(loaded) = &world.unit else {
                    return refuse("no unit stands on the table");
                };
                let face = FaceId::ALL.into_iter().find(|f| f.name() == name);
                let Some(face) = face.filter(|f| loaded.unit.face(*f).is_some()) else {
                    return Err(fault(action(), 3, "the unit has no face of that name"));
                };
                if face == FaceId::FrontInner && !loaded.covers_off.contains(&scene::CoverId::Top) {
                    return refuse("the inner front is closed: the top cover is still on");
                }
                if world.table_busy() {
                    return refuse("the table is busy");
                }
                if let Some(arm) = world.arm_in_view() {
                    return refuse(&format!("{} stands at the unit; send it home first", arm.name));
                }
                world.turn(face);
                Ok(())
            }
            (tags::LOADED | tags::PRESENTED | tags::GRIPPER_HOLDING | tags::SAFETY_OK | tags::MILL_PERMITTED, _) => {
                Err(fault(action(), 4, "an input cannot be written"))
            }
            (tags::FEED | tags::DISCHARGE | tags::MAGNET | tags::PRESENT, _) => {
                Err(fault(action(), 5, "wrong type for this tag"))
            }
            _ => Err(unknown(tag)),
        }
    }

    async fn wait_for(&self, tag: &str, value: TagValue, timeout_s: f64) -> Result<(), DeviceError> {
        let mut world = lock(&self.0);
        let deadline_s = world.now_s() + timeout_s.max(0.0);
        while value_of(&world, tag)? != value {
            match world.next_event_s().filter(|at_s| *at_s <= deadline_s) {
                Some(at_s) => world.advance_to(at_s),
                None => {
                    world.advance_to(deadline_s);
                    return Err(DeviceError::Timeout {
                        device: "plc".into(),
                        action: format!("waiting for '{tag}' to become {value:?}"),
                        timeout_s,
                    });
                }
            }
        }
        Ok(())
    }
}

/// The model-number reader.
pub(crate) struct ReaderHandle(pub(crate) Shared);

#[async_trait]
impl ModelReader for ReaderHandle {
    async fn read(&self) -> Result<Option<ModelNumber>, DeviceError> {
        let mut world = lock(&self.0);
        world.pass(0.8);
        if world.faults.happens(Fault::ReaderFails) {
            world.pass(2.0);
            return Err(DeviceError::Timeout {
                device: "reader".into(),
                action: "reading the model number".into(),
                timeout_s: 2.0,
            });
        }
        Ok(world.unit.as_ref().and_then(|loaded| {
            let readable = !draw(loaded.unit.seed, &[80]).random_bool(UNREADABLE);
            readable.then(|| ModelNumber(loaded.unit.model.clone()))
        }))
    }
}

/// The plant's end of the line: keeps what it is told.
pub(crate) struct PlantHandle(pub(crate) Shared);

#[async_trait]
impl PlantLink for PlantHandle {
    async fn report(&self, record_json: &str) -> Result<(), DeviceError> {
        lock(&self.0).reports.push(record_json.to_owned());
        Ok(())
    }
}

/// The cell's clock.
pub(crate) struct ClockHandle(pub(crate) Shared);

impl Clock for ClockHandle {
    fn now_s(&self) -> f64 {
        lock(&self.0).now_s()
    }
    fn pass(&self, budget_s: f64) {
        lock(&self.0).pass(budget_s);
    }
}
