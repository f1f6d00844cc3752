//! Crops of real fasteners, holes and other things, which training left out.

use std::fmt::{self, Display, Formatter};
use std::path::Path;

use geometry::{Pixel, Rate, RgbImage};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};
use vision::layout::CLOSE_HEAD_PX;
use vision::{Detector, Evidence, look};

use super::{EvaluateError, Share};
use crate::real;
use crate::samples::{PATCH_PX, any_fastener};

/// Stage 2 on real crops of held-out groups: a fastener of any drive, against holes and everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CropEvaluation {
    /// Screws of any drive that were called a fastener.
    pub fasteners: Rate,
    /// Holes and other things that were not.
    pub others: Rate,
    /// Mean of the two.
    pub balanced_accuracy: f64,
}

/// Measures stage 2 on the held-out crops of the training data's folder.
///
/// # Errors
/// An [`EvaluateError`] that names the file.
pub fn evaluate_crops(detector: &Detector, data: &Path) -> Result<CropEvaluation, EvaluateError> {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let (mut fasteners, mut others) = (Share::default(), Share::default());
    let settings = &detector.model().settings;
    // as large as a picture's heads are made that is searched at several scales
    for patch in real::crops(data, true, CLOSE_HEAD_PX..=CLOSE_HEAD_PX, &mut rng)? {
        let side = PATCH_PX as u32;
        let (Some(label), Some(picture)) = (patch.labels.first(), RgbImage::from_raw(side, side, patch.rgb.clone()))
        else {
            continue;
        };
        let place = Pixel::new(f64::from(label.u_px), f64::from(label.v_px));
        let evidence = look(
            &detector.model().fine,
            detector.model().close.as_ref(),
            &picture,
            &[place],
        )?;
        let probability = |e: &Evidence| settings.corrections.probability(f64::from(e.fastener()), None);
        let called = evidence
            .iter()
            .any(|e| probability(e) >= f64::from(settings.thresholds.other));
        if label.classes == any_fastener() {
            fasteners.add(called);
        } else {
            others.add(!called);
        }
    }
    let (fasteners, others) = (fasteners.rate(), others.rate());
    Ok(CropEvaluation {
        fasteners,
        others,
        balanced_accuracy: 0.5 * (fasteners.rate.unwrap_or(0.0) + others.rate.unwrap_or(0.0)),
    })
}

impl Display for CropEvaluation {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "fasteners of any drive  {}", self.fasteners)?;
        writeln!(f, "holes and others        {}", self.others)?;
        writeln!(f, "balanced accuracy       {:6.2} %", 100.0 * self.balanced_accuracy)
    }
}
