//! Whether scores are probabilities, and what other thresholds would buy.

use geometry::Rate;
use serde::{Deserialize, Serialize};

/// Bins of the reliability table.
const BINS: usize = 10;

/// Finds whose probability of being a cross screw was said to be in a range, and how many are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReliabilityBin {
    /// From this probability on.
    pub low: f64,
    /// Below this one.
    pub high: f64,
    /// Mean of what was said.
    pub said_mean: f64,
    /// What is so.
    pub cross: Rate,
}

/// What a threshold on the probability of a cross screw gives.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Finds of this probability and more are acted on.
    pub threshold: f64,
    /// Detectable screws among them.
    pub recall: f64,
    /// Share of them that are cross screws.
    pub precision: f64,
    /// False ones a picture.
    pub false_a_picture: f64,
}

/// What a detector says of everything that it reports, beside what it is.
#[derive(Clone, Debug, Default)]
pub(super) struct Scores {
    /// Probability of a cross screw that each find was given, and whether it is one.
    finds: Vec<(f64, bool)>,
    /// The highest on each detectable screw; 0 where nothing was found.
    screws: Vec<f64>,
}

impl Scores {
    pub(super) fn find(&mut self, said: f64, is_cross: bool) {
        self.finds.push((said, is_cross));
    }

    pub(super) fn screw(&mut self, highest: f64) {
        self.screws.push(highest);
    }

    /// The bins that hold a find.
    pub(super) fn reliability(&self) -> Vec<ReliabilityBin> {
        let bin = |said: f64| ((said * BINS as f64) as usize).min(BINS - 1);
        (0..BINS)
            .filter_map(|k| {
                let inside: Vec<_> = self.finds.iter().filter(|f| bin(f.0) == k).collect();
                let n = inside.len();
                (n > 0).then(|| ReliabilityBin {
                    low: k as f64 / BINS as f64,
                    high: (k + 1) as f64 / BINS as f64,
                    said_mean: inside.iter().map(|f| f.0).sum::<f64>() / n as f64,
                    cross: Rate::of(inside.iter().filter(|f| f.1).count(), n),
                })
            })
            .collect()
    }

    /// Recall, precision and false finds at thresholds from 0.05 to 0.99.
    pub(super) fn curve(&self, pictures: usize) -> Vec<CurvePoint> {
        let thresholds = (1..19)
            .map(|k| f64::from(k) * 0.05)
            .chain([0.92, 0.95, 0.97, 0.98, 0.99]);
        let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
        thresholds
            .map(|threshold| {
                let found = self.screws.iter().filter(|s| **s >= threshold).count();
                let wrong = self.finds.iter().filter(|f| f.0 >= threshold && !f.1).count();
                CurvePoint {
                    threshold,
                    recall: share(found, self.screws.len()),
                    precision: if found + wrong == 0 {
                        1.0
                    } else {
                        share(found, found + wrong)
                    },
                    false_a_picture: share(wrong, pictures),
                }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_and_curve_count_what_is_there() {
        let mut scores = Scores::default();
        for (said, is_cross) in [(0.95, true), (0.97, true), (0.91, false), (0.3, true), (0.35, false)] {
            scores.find(said, is_cross);
        }
        [0.95, 0.97, 0.3, 0.0].into_iter().for_each(|s| scores.screw(s));
        let bins = scores.reliability();
        assert_eq!(bins.len(), 2);
        assert_eq!((bins[1].cross.hits, bins[1].cross.of), (2, 3));
        assert!((bins[0].said_mean - 0.325).abs() < 1e-12);
        let curve = scores.curve(2);
        let at = |t: f64| {
            curve
                .iter()
                .find(|p| (p.threshold - t).abs() < 1e-9)
                .copied()
                .expect("a point")
        };
        assert_eq!(
            (at(0.5).recall, at(0.5).precision, at(0.5).false_a_picture),
            (0.5, 2.0 / 3.0, 0.5)
        );
        assert_eq!((at(0.25).recall, at(0.98).recall), (0.75, 0.0));
    }
}
