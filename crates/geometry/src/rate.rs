//! Shares with their bounds, as every figure of the project is given.

use serde::{Deserialize, Serialize};
use std::fmt::{self, Display, Formatter};

/// A share with its 95 % bounds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// How many were.
    pub hits: usize,
    /// Of how many.
    pub of: usize,
    /// hits / of; `None` of nothing.
    pub rate: Option<f64>,
    /// Lower 95 % bound.
    pub low: f64,
    /// Upper 95 % bound.
    pub high: f64,
}

impl Rate {
    /// A share with its Wilson score bounds.
    pub fn of(hits: usize, of: usize) -> Self {
        let (low, high) = wilson(hits, of);
        Self {
            hits,
            of,
            rate: (of > 0).then(|| hits as f64 / of as f64),
            low,
            high,
        }
    }
}

impl Display for Rate {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.rate {
            Some(rate) => write!(
                f,
                "{:6.2} %  ({} of {}; 95 %: {:.2} to {:.2} %)",
                100.0 * rate,
                self.hits,
                self.of,
                100.0 * self.low,
                100.0 * self.high
            ),
            None => write!(f, "     -    (of none)"),
        }
    }
}

/// 95 % bounds of a binomial share: the score interval (Wilson 1927, J. Am. Stat. Assoc. 22, 209-212); (0, 1) of nothing.
pub fn wilson(hits: usize, of: usize) -> (f64, f64) {
    wilson_share(hits as f64 / of.max(1) as f64, of)
}

/// [`wilson`] of a share that need not be a whole number of hits, such as a mean of shares.
pub fn wilson_share(share: f64, of: usize) -> (f64, f64) {
    if of == 0 {
        return (0.0, 1.0);
    }
    const Z: f64 = 1.959_963_984_540_054;
    let (p, n) = (share, of as f64);
    let center = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + Z * Z / n;
    (((center - half) / scale).max(0.0), ((center + half) / scale).min(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_bounds_of_the_paper_s_figures() {
        let percent = |(low, high): (f64, f64)| [(low * 1e4).round() / 100.0, (high * 1e4).round() / 100.0];
        assert_eq!(percent(wilson(3064, 3070)), [99.57, 99.91]);
        assert_eq!(percent(wilson(72, 92)), [68.79, 85.46]);
        assert_eq!(wilson(0, 0), (0.0, 1.0));
        let (low, high) = wilson(12, 12);
        assert!(low > 0.7 && high == 1.0);
        assert!(wilson(5, 5).1 > 0.999_999 && wilson(5, 5).0 < 0.6 && wilson(0, 5).0 < 1e-12);
    }

    #[test]
    fn names_in_files() {
        let json = serde_json::to_string(&Rate::of(0, 0)).expect("plain data");
        assert_eq!(json, r#"{"hits":0,"of":0,"rate":null,"low":0.0,"high":1.0}"#);
    }
}
