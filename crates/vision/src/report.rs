//! The JSON line of one picture: the contract of `unscrew detect --json`. Fields may be added, never renamed or dropped.

use geometry::{Base, Camera, Point};
use serde::{Deserialize, Serialize};

use crate::{Cue, Detections, Doubt, Drive, Screw, Timing, Verdict};

/// Where a find lies against the calibrated volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Hull {
    /// In it.
    Inside,
    /// At its border.
    Edge,
    /// Outside: no robot goes there.
    Outside,
}

/// A find in a robot's base frame: what a calibration map adds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mapped {
    /// Where.
    pub base: Point<Base>,
    /// Standard error across the camera's axis, along each axis, mm.
    pub sigma_lateral_mm: f64,
    /// Standard error along it, mm.
    pub sigma_depth_mm: f64,
    /// Whether the map may be trusted there.
    pub hull: Hull,
}

/// One picture's line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageReport {
    /// The picture's file.
    pub image: String,
    /// Columns, px.
    pub width_px: u32,
    /// Rows, px.
    pub height_px: u32,
    /// The model: `sha256:` and its hash.
    pub model: String,
    /// The finds.
    pub screws: Vec<ScrewReport>,
    /// Why nothing in the picture is to be acted on; empty where it can be trusted.
    #[serde(default)]
    pub doubts: Vec<Doubt>,
    /// Time spent, ms.
    pub timing_ms: Timing,
}

/// One find.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScrewReport {
    /// Column of the recess centre, px.
    pub u_px: f64,
    /// Row of the recess centre, px.
    pub v_px: f64,
    /// Standard error of the centre along each axis, px.
    pub sigma_px: f64,
    /// Diameter of the head, px.
    pub diameter_px: f64,
    /// Probability of the verdict.
    pub score: f64,
    /// What turns it.
    pub drive: Drive,
    /// What may be done with it.
    pub verdict: Verdict,
    /// In the camera's frame, mm; null without depth.
    pub camera_mm: Option<Point<Camera>>,
    /// In the robot's base frame, mm; null without a map.
    pub base_mm: Option<Point<Base>>,
    /// Standard error across the camera's axis, along each axis, mm.
    pub sigma_lateral_mm: Option<f64>,
    /// Standard error along the camera's axis, mm.
    pub sigma_depth_mm: Option<f64>,
    /// Where it lies against the calibrated volume; null without a map.
    pub hull: Option<Hull>,
    /// What the centre rests on.
    pub cues: Vec<Cue>,
    /// Direction of one wing of the cross, rad; null where it was not found.
    pub angle_rad: Option<f64>,
}

impl Detections {
    /// The picture's line; `map` takes a find to the robot's base frame, where there is a calibration map.
    pub fn report(&self, image: &str, map: impl Fn(&Screw) -> Option<Mapped>) -> ImageReport {
        let t = self.timing_ms;
        ImageReport {
            image: image.to_owned(),
            width_px: self.size_px.0,
            height_px: self.size_px.1,
            model: self.model.clone(),
            screws: self
                .screws
                .iter()
                .map(|screw| {
                    let mapped = map(screw);
                    ScrewReport {
                        u_px: rounded(screw.pixel.u_px, 3),
                        v_px: rounded(screw.pixel.v_px, 3),
                        sigma_px: rounded(screw.sigma_px, 3),
                        diameter_px: rounded(screw.diameter_px, 2),
                        score: rounded(screw.score, 5),
                        drive: screw.drive,
                        verdict: screw.verdict,
                        camera_mm: screw.camera.map(|p| {
                            let [x, y, z] = p.to_array().map(|c| rounded(c, 3));
                            Point::new(x, y, z)
                        }),
                        base_mm: mapped.map(|m| {
                            let [x, y, z] = m.base.to_array().map(|c| rounded(c, 3));
                            Point::new(x, y, z)
                        }),
                        sigma_lateral_mm: mapped
                            .map(|m| m.sigma_lateral_mm)
                            .or(screw.sigma_lateral_mm)
                            .map(|s| rounded(s, 3)),
                        sigma_depth_mm: mapped
                            .map(|m| m.sigma_depth_mm)
                            .or(screw.sigma_depth_mm)
                            .map(|s| rounded(s, 3)),
                        hull: mapped.map(|m| m.hull),
                        cues: screw.cues.clone(),
                        angle_rad: screw.angle_rad.map(|a| rounded(a, 4)),
                    }
                })
                .collect(),
            doubts: self.doubts.clone(),
            timing_ms: Timing {
                decode: rounded(t.decode, 1),
                coarse: rounded(t.coarse, 1),
                fine: rounded(t.fine, 1),
                centre: rounded(t.centre, 1),
                locate: rounded(t.locate, 1),
                total: rounded(t.total, 1),
            },
        }
    }
}

/// Digits beyond what was measured would only make the lines longer.
fn rounded(value: f64, digits: i32) -> f64 {
    let scale = 10f64.powi(digits);
    (value * scale).round() / scale
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Pixel;

    #[test]
    fn the_line_is_as_the_contract_says() -> Result<(), serde_json::Error> {
        let screw = Screw {
            pixel: Pixel::new(1323.90012, 897.5),
            sigma_px: 0.2,
            diameter_px: 37.4,
            score: 0.998,
            fits: 0.998,
            drive: Drive::Cross,
            verdict: Verdict::Screw,
            cues: vec![Cue::Learned, Cue::Cross],
            angle_rad: None,
            camera: Some(Point::new(-233.1, -198.7, 1480.1)),
            normal: None,
            top_normal: None,
            sigma_lateral_mm: Some(0.07),
            sigma_depth_mm: Some(0.11),
        };
        let flat = Screw {
            camera: None,
            sigma_lateral_mm: None,
            sigma_depth_mm: None,
            drive: Drive::HexSocket,
            verdict: Verdict::Other,
            ..screw.clone()
        };
        let detections = Detections {
            screws: vec![screw, flat],
            doubts: Vec::new(),
            timing_ms: Timing::default(),
            model: "sha256:00".into(),
            size_px: (4104, 3006),
        };
        let report = detections.report("a.jpg", |s| {
            s.camera.map(|_| Mapped {
                base: Point::new(1102.4, 233.0, 610.2),
                sigma_lateral_mm: 0.08,
                sigma_depth_mm: 0.12,
                hull: Hull::Inside,
            })
        });
        let golden = concat!(
            r#"{"image":"a.jpg","width_px":4104,"height_px":3006,"model":"sha256:00","screws":["#,
            r#"{"u_px":1323.9,"v_px":897.5,"sigma_px":0.2,"diameter_px":37.4,"score":0.998,"drive":"cross","verdict":"screw","#,
            r#""camera_mm":[-233.1,-198.7,1480.1],"base_mm":[1102.4,233.0,610.2],"sigma_lateral_mm":0.08,"sigma_depth_mm":0.12,"#,
            r#""hull":"inside","cues":["learned","cross"],"angle_rad":null},"#,
            r#"{"u_px":1323.9,"v_px":897.5,"sigma_px":0.2,"diameter_px":37.4,"score":0.998,"drive":"hex_socket","verdict":"other","#,
            r#""camera_mm":null,"base_mm":null,"sigma_lateral_mm":null,"sigma_depth_mm":null,"#,
            r#""hull":null,"cues":["learned","cross"],"angle_rad":null}],"doubts":[],"#,
            r#""timing_ms":{"decode":0.0,"coarse":0.0,"fine":0.0,"centre":0.0,"locate":0.0,"total":0.0}}"#
        );
        let line = serde_json::to_string(&report)?;
        assert_eq!(line, golden);
        assert_eq!(serde_json::from_str::<ImageReport>(&line)?, report);
        Ok(())
    }
}
