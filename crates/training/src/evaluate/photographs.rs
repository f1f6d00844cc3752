//! Photographs with boxes drawn by people.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};
use std::path::Path;

use geometry::{Pixel, Rate, read_color, wilson_share};
use serde::{Deserialize, Serialize};
use vision::{Detections, Detector, Options, Screw, Verdict};

use super::{EvaluateError, FalseFind, Miss, Share, cut, list, percent, speaker, write_lists};
use crate::boxes::{BoxKind, DrawnBox, boxed_pictures};

/// A find and a person's box are the same thing from this overlap on (intersection over union).
const SAME_BOX: f64 = 0.3;

/// The photographs of one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SceneRow {
    /// Photographs of it.
    pub photos: usize,
    /// Distinct cross screws: the most that one photograph shows.
    pub distinct: usize,
    /// Share of the cross screws found, mean over its photographs; `None` without cross screws.
    pub found: Option<f64>,
    /// False finds a photograph.
    pub false_finds_mean: f64,
}

/// What a detector is worth on photographs with boxes drawn by people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoEvaluation {
    /// What it was measured on.
    pub source: String,
    /// The model: `sha256:` and its hash.
    pub model: String,
    /// Head diameters that were looked for, px.
    pub head_px: [f64; 2],
    /// Number of photographs.
    pub photos: usize,
    /// Distinct cross screws: over all scenes, the most that one photograph shows.
    pub distinct: usize,
    /// Recall per distinct cross screw: the mean over the photographs of a scene, weighted with its distinct screws.
    pub recall_distinct: Option<f64>,
    /// Its 95 % bounds (Wilson, of that many distinct screws).
    pub recall_distinct_bounds: [f64; 2],
    /// Labelled cross screws found, copies counted as often as they occur.
    pub recall: Rate,
    /// Labelled cross screws found or left to a person.
    pub recall_or_review: Rate,
    /// Labelled cross screws reported with any verdict.
    pub recall_any: Rate,
    /// Finds of verdict `screw` on no labelled cross screw.
    pub false_finds: usize,
    /// The same a photograph.
    pub false_finds_mean: f64,
    /// Of these, on another labelled fastener.
    pub other_called_screw: usize,
    /// Other labelled fasteners.
    pub others: usize,
    /// Drive that reported labels were given: by label (`cross`, `other`), then by drive.
    pub drives: BTreeMap<String, BTreeMap<String, usize>>,
    /// By scene.
    pub scenes: BTreeMap<String, SceneRow>,
    /// Labelled cross screws not found, at most 200.
    pub misses: Vec<Miss>,
    /// False finds, at most 200.
    pub false_list: Vec<FalseFind>,
    /// Mean time a photograph, ms.
    pub total_ms: f64,
}

impl DrawnBox {
    fn center(&self) -> Pixel {
        Pixel::new(0.5 * (self.low[0] + self.high[0]), 0.5 * (self.low[1] + self.high[1]))
    }

    /// True if the find's centre lies in the box, or its own box is much the same.
    fn holds(&self, find: &Screw) -> bool {
        let at = [find.pixel.u_px, find.pixel.v_px];
        if (0..2).all(|k| at[k] >= self.low[k] && at[k] <= self.high[k]) {
            return true;
        }
        let (mut both, mut own) = (1.0, 1.0);
        for ((at, low), high) in at.into_iter().zip(self.low).zip(self.high) {
            let half = 0.5 * find.diameter_px;
            both *= (high.min(at + half) - low.max(at - half)).max(0.0);
            own *= high - low;
        }
        both > SAME_BOX * (find.diameter_px * find.diameter_px + own - both)
    }
}

/// Measures a detector on a folder of photographs with boxes drawn by people: COCO, YOLO or Pascal VOC (see `boxes.rs`).
///
/// Many photographs may be photometric copies of one another: figures are per scene first.
///
/// # Arguments
/// * `scenes` – only these; `None`: all.
/// * `progress` – told the number of photographs done, and of all.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_photographs(
    detector: &Detector,
    options: &Options,
    folder: &Path,
    scenes: Option<&[String]>,
    progress: &(dyn Fn(u64, u64) + Sync),
) -> Result<PhotoEvaluation, EvaluateError> {
    let mut photographs = boxed_pictures(folder)?;
    if let Some(wanted) = scenes {
        let known: BTreeSet<&str> = photographs.iter().map(|p| p.scene.as_str()).collect();
        if let Some(unknown) = wanted.iter().find(|w| !known.contains(w.as_str())) {
            let known: Vec<&str> = known.into_iter().collect();
            return Err(EvaluateError::Format {
                path: folder.into(),
                reason: format!("no scene {unknown}; there are {}", known.join(", ")),
            });
        }
        photographs.retain(|p| wanted.contains(&p.scene));
    }
    let mut tally = PhotoTally::default();
    for (photograph, done) in photographs.iter().zip(1..) {
        let picture = read_color(&photograph.path)?;
        let found = detector.detect_image(&picture, options);
        tally.add(
            &photograph.name,
            &photograph.scene,
            &photograph.boxes(picture.dimensions()),
            &found,
        );
        progress(done, photographs.len() as u64);
    }
    let head_px = [*options.head_px.start(), *options.head_px.end()];
    let source = format!("photographs of {}", folder.display());
    Ok(tally.finish(source, detector.model().id(), head_px))
}

#[derive(Default)]
struct PhotoTally {
    photos: usize,
    recall: Share,
    review: usize,
    any: usize,
    others: usize,
    false_finds: usize,
    other_called_screw: usize,
    drives: BTreeMap<String, BTreeMap<String, usize>>,
    /// By scene: found and labelled cross screws, and false finds, of each photograph.
    scenes: BTreeMap<String, Vec<(Share, usize)>>,
    misses: Vec<Miss>,
    false_list: Vec<FalseFind>,
    total_ms: f64,
}

impl PhotoTally {
    fn add(&mut self, file: &str, scene: &str, labels: &[DrawnBox], found: &Detections) {
        self.photos += 1;
        self.total_ms += found.timing_ms.total;
        // a find belongs to the nearest box that holds it, so that one find cannot stand for two screws
        let owner = |find: &Screw| {
            let far = |l: &DrawnBox| l.center().distance_px(&find.pixel);
            let held = labels.iter().enumerate().filter(|(_, l)| l.holds(find));
            held.min_by(|a, b| far(a.1).total_cmp(&far(b.1))).map(|(k, _)| k)
        };
        let owners: Vec<Option<usize>> = found.screws.iter().map(owner).collect();
        let (mut share, mut false_finds) = (Share::default(), 0);
        for (k, label) in labels.iter().enumerate() {
            let finds = found.screws.iter().zip(&owners);
            let own = finds.filter(|(_, o)| **o == Some(k)).map(|(find, _)| find);
            let find = speaker(own, label.center());
            let cross = match label.kind {
                BoxKind::Cross => true,
                BoxKind::Other => false,
                BoxKind::Hidden => continue,
            };
            if let Some(find) = find {
                let name = if cross { "cross" } else { "other" };
                let drives = self.drives.entry(name.into()).or_default();
                *drives.entry(find.drive.name().into()).or_default() += 1;
            }
            if !cross {
                self.others += 1;
                continue;
            }
            let hit = find.is_some_and(|f| f.verdict == Verdict::Screw);
            share.add(hit);
            self.recall.add(hit);
            self.any += usize::from(find.is_some());
            self.review += usize::from(find.is_some_and(|f| f.verdict == Verdict::Review));
            if !hit {
                let side_px = (label.high[0] - label.low[0]).max(label.high[1] - label.low[1]);
                list(&mut self.misses, || {
                    Miss::new(file, label.center(), side_px, vec![scene.into()], find)
                });
            }
        }
        for find in found.screws.iter().filter(|f| f.verdict == Verdict::Screw) {
            if labels.iter().any(|l| l.kind != BoxKind::Other && l.holds(find)) {
                continue;
            }
            let other = labels.iter().any(|l| l.holds(find));
            false_finds += 1;
            self.other_called_screw += usize::from(other);
            let kind = if other { "other" } else { "background" };
            list(&mut self.false_list, || FalseFind::new(file, find, kind));
        }
        self.false_finds += false_finds;
        self.scenes.entry(scene.into()).or_default().push((share, false_finds));
    }

    fn finish(self, source: String, model: &str, head_px: [f64; 2]) -> PhotoEvaluation {
        let row = |photos: &Vec<(Share, usize)>| {
            let shares: Vec<f64> = photos.iter().filter_map(|(s, _)| s.rate().rate).collect();
            SceneRow {
                photos: photos.len(),
                distinct: photos.iter().map(|(s, _)| s.of).max().unwrap_or(0),
                found: (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64),
                false_finds_mean: photos.iter().map(|(_, f)| *f as f64).sum::<f64>() / photos.len().max(1) as f64,
            }
        };
        let scenes: BTreeMap<String, SceneRow> = self.scenes.iter().map(|(name, p)| (name.clone(), row(p))).collect();
        let distinct: usize = scenes.values().map(|s| s.distinct).sum();
        let found: f64 = scenes.values().filter_map(|s| Some(s.found? * s.distinct as f64)).sum();
        let share = (distinct > 0).then(|| found / distinct as f64);
        let bounds = wilson_share(share.unwrap_or(0.0), distinct);
        let n = self.photos.max(1) as f64;
        PhotoEvaluation {
            source,
            model: model.to_owned(),
            head_px,
            photos: self.photos,
            distinct,
            recall_distinct: share,
            recall_distinct_bounds: bounds.into(),
            recall: self.recall.rate(),
            recall_or_review: Rate::of(self.recall.hits + self.review, self.recall.of),
            recall_any: Rate::of(self.any, self.recall.of),
            false_finds: self.false_finds,
            false_finds_mean: self.false_finds as f64 / n,
            other_called_screw: self.other_called_screw,
            others: self.others,
            drives: self.drives,
            scenes,
            misses: self.misses,
            false_list: self.false_list,
            total_ms: self.total_ms / n,
        }
    }
}

impl Display for PhotoEvaluation {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "model        {}", self.model)?;
        writeln!(f, "measured on  {} {}", self.photos, self.source)?;
        writeln!(f, "heads        {} to {} px", self.head_px[0], self.head_px[1])?;
        match self.recall_distinct {
            Some(recall) => writeln!(
                f,
                "recall     {:6.2} %  (of {} distinct cross screws; 95 %: {:.1} to {:.1} %)",
                100.0 * recall,
                self.distinct,
                100.0 * self.recall_distinct_bounds[0],
                100.0 * self.recall_distinct_bounds[1]
            )?,
            None => writeln!(f, "recall          -    (no cross screws)")?,
        }
        writeln!(f, "of labels  {}", self.recall)?;
        writeln!(f, "  + review {}", self.recall_or_review)?;
        writeln!(f, "  any      {}", self.recall_any)?;
        writeln!(
            f,
            "false        {} finds, {:.2} a photograph; {} of them on one of {} other fasteners",
            self.false_finds, self.false_finds_mean, self.other_called_screw, self.others
        )?;
        if !self.drives.is_empty() {
            writeln!(f, "\nlabel    drive it was given")?;
        }
        for (label, drives) in &self.drives {
            let drives: Vec<String> = drives.iter().map(|(drive, n)| format!("{drive} {n}")).collect();
            writeln!(f, "  {label:<6} {}", drives.join(", "))?;
        }
        let [photos, distinct, found, false_finds] = ["photos", "distinct", "found %", "false a photo"];
        writeln!(
            f,
            "\n{:<22} {photos:>6} {distinct:>9} {found:>9} {false_finds:>14}",
            "scene"
        )?;
        for (name, s) in &self.scenes {
            let (name, found) = (cut(name, 20), percent(s.found, 1));
            writeln!(
                f,
                "  {name:<20} {:>6} {:>9} {found:>9} {:>14.2}",
                s.photos, s.distinct, s.false_finds_mean
            )?;
        }
        write_lists(f, &self.misses, &self.false_list)?;
        writeln!(f, "\nmean time    {:.0} ms a photograph", self.total_ms)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::tests::{detections, find};
    use vision::Drive;

    #[test]
    fn photographs_are_counted_by_scene() {
        let drawn = |kind, low: f64, high: f64| DrawnBox {
            kind,
            low: [low; 2],
            high: [high; 2],
        };
        let labels = [
            drawn(BoxKind::Cross, 74.5, 124.5),
            drawn(BoxKind::Other, 499.5, 599.5),
            drawn(BoxKind::Hidden, 895.0, 925.0),
        ];

        let acted = |at: f64| find(at, at, Verdict::Screw, Drive::Cross);
        let mut tally = PhotoTally::default();
        tally.add(
            "a",
            "one",
            &labels,
            &detections(vec![acted(100.0), acted(550.0), acted(910.0)]),
        );
        let bolt = find(550.0, 550.0, Verdict::Other, Drive::HexHead);
        tally.add("b", "one", &labels, &detections(vec![bolt]));
        let second = drawn(BoxKind::Cross, 200.0, 230.0);
        let finds = vec![acted(100.0), acted(216.0), acted(800.0)];
        tally.add("c", "two", &[labels[0], second], &detections(finds));
        let e = tally.finish("x".into(), "sha256:00", [15.0, 80.0]);
        assert_eq!((e.distinct, e.photos, e.others), (3, 3, 2));
        // scene one: half of one screw; scene two: both of two
        assert!((e.recall_distinct.expect("screws") - 2.5 / 3.0).abs() < 1e-12, "{e:?}");
        assert_eq!((e.recall.hits, e.recall.of), (3, 4));
        assert_eq!(
            (e.false_finds, e.other_called_screw, e.false_finds_mean),
            (2, 1, 2.0 / 3.0)
        );
        assert_eq!((e.drives["other"]["cross"], e.drives["other"]["hex_head"]), (1, 1));
        assert_eq!(e.drives["cross"]["cross"], 3);
        assert!(e.to_string().lines().all(|l| l.chars().count() <= 100), "{e}");

        // a centre outside the box: a good overlap serves, too little of one does not
        let at = |u_px: f64| find(u_px, 215.0, Verdict::Screw, Drive::Cross);
        assert!(second.holds(&at(199.0)) && !second.holds(&at(192.0)));
    }
}
