//! A person at a screen: sees what a careful look at the picture shows, takes a while, and does not click to the pixel.

use crate::draw::{draw, normal};
use crate::score::ActionKind;
use crate::world::{Shared, lock};
use async_trait::async_trait;
use cell::device::{DeviceError, Operator, Question};
use rand::RngExt;

/// Standard deviation of a click, px.
const CLICK_PX: f64 = 1.2;
/// A head of which less shows is not seen at all.
const LEAST_VISIBLE: f64 = 0.2;

/// The person of the simulated cell.
pub(crate) struct OperatorHandle(pub(crate) Shared);

#[async_trait]
impl Operator for OperatorHandle {
    async fn point_at_screws(&self, question: &Question, timeout_s: f64) -> Result<Vec<[f64; 2]>, DeviceError> {
        let mut world = lock(&self.0);
        let assumed = world.assumed();
        let truth = world.truth();
        let unit = world.unit.as_ref().map_or(0, |u| u.unit.seed);
        let region = question.region;
        let mut clicks = Vec::new();
        for screw in truth.iter().flat_map(|t| &t.screws).filter(|s| !world.is_out(s.id)) {
            let inside = (0.0..f64::from(region.width_px)).contains(&(screw.pixel.u_px - f64::from(region.x_px)))
                && (0.0..f64::from(region.height_px)).contains(&(screw.pixel.v_px - f64::from(region.y_px)));
            let sees = if screw.detectable {
                assumed.person_sees
            } else {
                assumed.person_sees_hidden
            };
            // the same person sees the same in the same screw, however often it is shown
            let mut rng = draw(unit, &[72, u64::from(screw.id.0)]);
            if inside && screw.visible_fraction >= LEAST_VISIBLE && rng.random_bool(sees) {
                let off = [normal(&mut rng), normal(&mut rng)].map(|n| CLICK_PX * n);
                clicks.push([screw.pixel.u_px + off[0], screw.pixel.v_px + off[1]]);
            }
        }
        let takes_s = assumed.person_look_s + assumed.person_click_s * clicks.len() as f64;
        if takes_s > timeout_s {
            world.pass(timeout_s);
            return Err(DeviceError::Timeout {
                device: "operator".into(),
                action: "clicking on screws".into(),
                timeout_s,
            });
        }
        world.pass(takes_s);
        world.record(ActionKind::Asked { clicks: clicks.len() });
        Ok(clicks)
    }
}
