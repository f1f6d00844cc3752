//! The model file: the coarse network, the fine ones, the one that looks closer, and the figures that training measured, in one file.
//!
//! `UNSCREW1` (`UNSCREW2` where one looks closer), the length of the header (u32, little endian), the header (JSON), then the networks' bytes one after the other, as
//! the header lists them. Each network is a safetensors file with its own architecture, or
//! an ONNX graph for whoever has ONNX Runtime.

use std::collections::BTreeMap;
use std::path::Path;

use nn::{Engine, NnError, Step};
use serde::{Deserialize, Serialize};

use crate::center::Cue;
use crate::layout::{COARSE_CHANNELS, COARSE_INPUT, FINE_CHANNELS, FINE_INPUT, STRIDE};
use crate::locate::{RIM_TERMS, USUAL_RIM};

const MAGIC: &[u8; 7] = b"UNSCREW";
/// Version of the container, the eighth byte of the file; and that of one with a network that looks closer, which programs of before would take for
/// one of the fine ones.
const VERSION: u8 = b'1';
const VERSION_CLOSE: u8 = b'2';
/// Bytes before the header.
const PREAMBLE: usize = 12;
/// Names of the networks in the file; any other is one of the fine ones.
const COARSE: &str = "coarse";
const CLOSE: &str = "close";

/// The model that ships with the program.
pub static EMBEDDED_MODEL: &[u8] = include_bytes!("../models/default.unscrew");

/// Below one half another drive may be likelier than the bit's: no model file makes the detector act on that.
const LEAST_ACCEPT: f32 = 0.5;

/// Limits between the verdicts; training sets them from the cost of a miss, a false find and a person's look.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Thresholds {
    /// Coarse probability above which a cell belongs to a candidate: low, so that nothing is missed.
    pub coarse: f32,
    /// Fewest coarse cells (16 px² each) of a candidate.
    pub coarse_min_cells: usize,
    /// Probability of the mounted bit's drive from which the verdict is `screw`; a file's is raised to one half.
    pub accept: f32,
    /// From this up to `accept` the verdict is `review`; below, the candidate is dropped.
    pub review: f32,
    /// Probability of another drive from which the verdict is `other`.
    pub other: f32,
}

impl Default for Thresholds {
    fn default() -> Self {
        Self {
            coarse: 0.15,
            coarse_min_cells: 2,
            accept: 0.7,
            review: 0.3,
            other: 0.5,
        }
    }
}

/// Corrections measured on held-out data that make sigmas and scores mean what they say.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Corrections {
    /// True error over stated sigma of the outer circle's centre, beyond the eccentricity.
    pub circle_sigma: f64,
    /// How far a head's outline may be off its recess, standard deviation along each axis in head diameters: eccentric recesses and
    /// washers. The circle is never surer than this.
    pub eccentricity: f64,
    /// How far below the recess rim that lies which the learned centre, the circle and the cross rest on, in head diameters: seen
    /// from aside they are off by the parallax. Taken out where depth says from which side.
    pub below_rim: [f64; 3],
    /// True error over stated sigma of the cross's centre.
    pub cross_sigma: f64,
    /// True error over stated sigma of the learned centre.
    pub learned_sigma: f64,
    /// How far below the rim that lies which the relief's centre rests on, in head diameters; see [`below_rim`](Self::below_rim).
    pub relief_below_rim: f64,
    /// True error over stated sigma of the relief's centre, beyond the floor.
    pub relief_sigma: f64,
    /// What the relief is never surer than, in head diameters; see [`eccentricity`](Self::eccentricity).
    pub relief_floor: f64,
    /// Sigma of a centre by that of the fused cues and by how doubtful the find is: its logarithm is `a + b ln sigma + c ln(1 - fits)`;
    /// `[a, b, c]`. Worn and covered heads are off by more than their cues say.
    pub center_sigma: [f64; 3],
    /// Height of the rim above the sheet from what stereo measures there: weights of the heights in rings around the recess, from the
    /// inside out, and of the head's diameter. Its window sees slot, flank and sheet with the rim.
    pub rim_height: [f64; RIM_TERMS],
    /// Spread of the rim's true height around that, in head diameters.
    pub rim_spread: f64,
    /// The rim's usual height above the sheet and its spread, in head diameters: where the head itself has no depth.
    pub usual_height: [f64; 2],
    /// True error over stated sigma of the depth at the rim.
    pub depth_sigma: f64,
    /// What makes a probability `p` of the networks true: its log odds are `a ln p - b ln(1 - p) + c` (beta calibration, Kull, Silva
    /// Filho and Flach 2017); `[a, b, c]`.
    pub score: [f64; 3],
    /// The same where depth says how far a find rises above the sheet, `h` ([`RimProfile::rise_mm`](crate::RimProfile::rise_mm)): its log odds are
    /// `a ln p - b ln(1 - p) + c + d h + e h²`. Marks, dents and holes do not rise, heads do.
    pub raised_score: [f64; 5],
}

/// What [`Corrections`] say about one cue of a centre.
pub(crate) struct CueFactors {
    /// How far below the recess rim that lies which it rests on, in head diameters.
    pub below_rim: f64,
    /// True error over stated sigma.
    pub sigma: f64,
    /// What is added to that sigma, in head diameters.
    pub floor: f64,
}

impl Corrections {
    /// Those of a cue.
    pub(crate) fn of(&self, cue: Cue) -> CueFactors {
        let [learned, circle, cross] = self.below_rim;
        let (below_rim, sigma, floor) = match cue {
            Cue::Learned => (learned, self.learned_sigma, 0.0),
            Cue::Circle => (circle, self.circle_sigma, self.eccentricity),
            Cue::Cross => (cross, self.cross_sigma, 0.0),
            Cue::Relief => (self.relief_below_rim, self.relief_sigma, self.relief_floor),
        };
        CueFactors {
            below_rim,
            sigma,
            floor,
        }
    }

    /// The networks' probability, corrected; with how far what it is of rises above the sheet, mm, where that was measured.
    pub fn probability(&self, p: f64, rise_mm: Option<f64>) -> f64 {
        let dot = |weights: &[f64], terms: &[f64]| weights.iter().zip(terms).map(|(w, t)| w * t).sum::<f64>();
        let log_odds = match rise_mm {
            Some(rise_mm) => dot(&self.raised_score, &Self::score_terms(p, rise_mm)),
            None => dot(&self.score, &Self::score_terms(p, 0.0)),
        };
        1.0 / (1.0 + (-log_odds).exp())
    }

    /// What a score depends on, in the order of [`raised_score`](Self::raised_score); [`score`](Self::score) has the first of it.
    pub fn score_terms(p: f64, rise_mm: f64) -> [f64; 5] {
        let p = p.clamp(1e-7, 1.0 - 1e-7);
        [p.ln(), -(1.0 - p).ln(), 1.0, rise_mm, rise_mm.powi(2)]
    }

    /// Sigma of a centre, px, from that of the fused cues and the probability that the find is what it is taken for.
    pub fn centre_px(&self, sigma_px: f64, score: f64) -> f64 {
        let terms = Self::centre_terms(sigma_px, score);
        terms
            .iter()
            .zip(self.center_sigma)
            .map(|(term, weight)| term * weight)
            .sum::<f64>()
            .exp()
    }

    /// What a centre's sigma depends on, in the order of [`center_sigma`](Self::center_sigma).
    pub fn centre_terms(sigma_px: f64, score: f64) -> [f64; 3] {
        [1.0, sigma_px.max(1e-3).ln(), (1.0 - score).max(1e-3).ln()]
    }
}

impl Default for Corrections {
    fn default() -> Self {
        Self {
            circle_sigma: 1.0,
            eccentricity: 0.04,
            below_rim: [0.0; 3],
            cross_sigma: 1.0,
            learned_sigma: 1.0,
            relief_below_rim: 0.16,
            relief_sigma: 2.0,
            relief_floor: 0.02,
            center_sigma: [0.0, 1.0, 0.0],
            rim_height: USUAL_RIM,
            rim_spread: 0.03,
            usual_height: [0.27, 0.09], // pan, truss, binding, washer and flange heads
            depth_sigma: 1.0,
            score: [1.0, 1.0, 0.0],
            raised_score: [1.0, 1.0, 0.0, 0.0, 0.0],
        }
    }
}

/// Everything in a model file that is not a network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Limits between the verdicts.
    #[serde(default)]
    pub thresholds: Thresholds,
    /// What makes sigmas and scores honest.
    #[serde(default)]
    pub corrections: Corrections,
    /// What made the model: data, hashes, seed, date, version, figures on held-out data.
    #[serde(default)]
    pub facts: BTreeMap<String, serde_json::Value>,
}

#[derive(Serialize, Deserialize)]
struct Header {
    networks: Vec<Entry>,
    #[serde(flatten)]
    settings: Settings,
}

#[derive(Serialize, Deserialize)]
struct Entry {
    name: String,
    bytes: usize,
}

/// Why a model cannot be used. Each message names the file and what to do.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// It cannot be read.
    #[error("cannot read the model {file}: {source}; check the path, or leave it out to use the built-in model")]
    Read {
        /// The file.
        file: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// It is something else.
    #[error("{file} is not an unscrew model; give a file that `unscrew train` wrote")]
    NotAModel {
        /// The file.
        file: String,
    },
    /// It was made by another version.
    #[error(
        "{file} has model format {found:?}, this program reads '1' and '2'; update the program, or train the model again"
    )]
    Version {
        /// The file.
        file: String,
        /// The format's version in the file.
        found: char,
    },
    /// It ends too early or has a wrong length.
    #[error("{file} is damaged: {found} bytes where its header says {expected}; copy it again from its source")]
    Length {
        /// The file.
        file: String,
        /// Bytes there.
        found: usize,
        /// Bytes that the header asks for.
        expected: usize,
    },
    /// Its header cannot be understood.
    #[error("the header of the model {file} is damaged ({reason}); copy it again from its source")]
    Header {
        /// The file.
        file: String,
        /// What is wrong.
        reason: String,
    },
    /// A network in it cannot be used.
    #[error("network {network} of the model {file}: {source}")]
    Network {
        /// The file.
        file: String,
        /// The network's name.
        network: String,
        /// What is wrong.
        source: NnError,
    },
    /// A network in it has another shape than the program expects.
    #[error("network {network} of the model {file} {reason}; train the model again with this version")]
    Shape {
        /// The file.
        file: String,
        /// The network's name.
        network: String,
        /// How it differs.
        reason: String,
    },
}

/// A detector's networks and settings, ready to run.
#[derive(Clone, Debug)]
pub struct Model {
    /// Stage 1: whole picture to candidates.
    pub coarse: Engine,
    /// Stage 2: one network, or several whose mean decides (three in the paper).
    pub fine: Vec<Engine>,
    /// Stage 2's closer look at what may be a fastener, every head made as large as the others; models of before have none.
    pub close: Option<Engine>,
    /// Thresholds, corrections, facts.
    pub settings: Settings,
    id: String,
}

impl Model {
    /// Reads a model file.
    ///
    /// # Errors
    /// A [`ModelError`] that names the file.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let file = path.display().to_string();
        match std::fs::read(path) {
            Ok(bytes) => Self::named(&bytes, &file),
            Err(source) => Err(ModelError::Read { file, source }),
        }
    }

    /// The model that ships with the program.
    ///
    /// # Errors
    /// A [`ModelError`] where the program was built with a damaged file.
    pub fn embedded() -> Result<Self, ModelError> {
        Self::named(EMBEDDED_MODEL, "the built-in model")
    }

    /// Reads a model from the bytes of its file.
    ///
    /// # Errors
    /// A [`ModelError`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ModelError> {
        Self::named(bytes, "given as bytes")
    }

    fn named(bytes: &[u8], file: &str) -> Result<Self, ModelError> {
        let (networks, settings) = decode_model(bytes, file)?;
        let engine = |name: &str, blob: &[u8], input: &[Step], outputs: usize| {
            let network = Engine::from_bytes(blob).map_err(|source| ModelError::Network {
                file: file.into(),
                network: name.into(),
                source,
            })?;
            check_shape(&network, input.len(), outputs).map_err(|reason| ModelError::Shape {
                file: file.into(),
                network: name.into(),
                reason,
            })?;
            Ok(network.in_eight_bits(input))
        };
        let fine = networks.fine.iter().enumerate();
        let close = networks.close.as_ref();
        Ok(Self {
            coarse: engine(COARSE, &networks.coarse, &COARSE_INPUT, COARSE_CHANNELS)?,
            fine: fine
                .map(|(k, blob)| engine(&format!("fine{k}"), blob, &FINE_INPUT, FINE_CHANNELS))
                .collect::<Result<_, ModelError>>()?,
            close: close
                .map(|blob| engine(CLOSE, blob, &FINE_INPUT, FINE_CHANNELS))
                .transpose()?,
            settings,
            id: model_id(bytes),
        })
    }

    /// The same model with its networks run by ONNX Runtime.
    ///
    /// # Errors
    /// [`ModelError::Network`] where the library or the provider is not there.
    #[cfg(feature = "ort")]
    pub fn through_onnx_runtime(self, provider: nn::onnx_runtime::Provider) -> Result<Self, ModelError> {
        let moved = |network: String, engine: Engine| match engine {
            Engine::Own(own) => own
                .through_onnx_runtime(provider)
                .map(Engine::OnnxRuntime)
                .map_err(|source| ModelError::Network {
                    file: self.id.clone(),
                    network,
                    source,
                }),
            there => Ok(there),
        };
        let coarse = moved(COARSE.into(), self.coarse)?;
        let fine = self.fine.into_iter().enumerate();
        let fine = fine
            .map(|(k, engine)| moved(format!("fine{k}"), engine))
            .collect::<Result<_, _>>()?;
        let close = self.close.map(|engine| moved(CLOSE.into(), engine)).transpose()?;
        Ok(Self {
            coarse,
            fine,
            close,
            ..self
        })
    }

    /// `sha256:` and the hash of the file: names the model in every result.
    pub fn id(&self) -> &str {
        &self.id
    }
}

/// A model's networks as [`nn`] saves them: for tools that make model files or take them apart.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Networks {
    /// Stage 1.
    pub coarse: Vec<u8>,
    /// Stage 2: one network or several.
    pub fine: Vec<Vec<u8>>,
    /// Stage 2's closer look.
    pub close: Option<Vec<u8>>,
}

impl Networks {
    /// Each by its name in the file, in the file's order.
    pub fn named(&self) -> Vec<(String, &[u8])> {
        let fine = self.fine.iter().enumerate();
        let mut named = vec![(COARSE.to_owned(), self.coarse.as_slice())];
        named.extend(fine.map(|(k, blob)| (format!("fine{k}"), blob.as_slice())));
        named.extend(self.close.iter().map(|blob| (CLOSE.to_owned(), blob.as_slice())));
        named
    }
}

/// The bytes of a model file.
///
/// # Errors
/// [`ModelError::Header`] where the header would not fit (4 GiB).
pub fn encode_model(networks: &Networks, settings: &Settings) -> Result<Vec<u8>, ModelError> {
    let unfit = |reason: String| ModelError::Header {
        file: "to be written".into(),
        reason,
    };
    let named = networks.named();
    let entries = named.iter().map(|(name, blob)| Entry {
        name: name.clone(),
        bytes: blob.len(),
    });
    let header = Header {
        networks: entries.collect(),
        settings: settings.clone(),
    };
    let header = serde_json::to_vec(&header).map_err(|e| unfit(e.to_string()))?;
    let length = u32::try_from(header.len()).map_err(|e| unfit(e.to_string()))?;
    let mut bytes = MAGIC.to_vec();
    bytes.push(match networks.close {
        Some(_) => VERSION_CLOSE,
        None => VERSION,
    });
    bytes.extend(length.to_le_bytes());
    bytes.extend(header);
    bytes.extend(named.iter().flat_map(|(_, blob)| *blob));
    Ok(bytes)
}

/// The networks and the settings of a model file.
///
/// # Errors
/// A [`ModelError`] that names `file`.
pub fn decode_model(bytes: &[u8], file: &str) -> Result<(Networks, Settings), ModelError> {
    let (mut header, mut rest) = split(bytes, file)?;
    let thresholds = &mut header.settings.thresholds;
    thresholds.accept = thresholds.accept.max(LEAST_ACCEPT);
    let mut networks = Networks::default();
    for entry in header.networks {
        let (blob, tail) = rest.split_at(entry.bytes);
        rest = tail;
        match entry.name.as_str() {
            COARSE => networks.coarse = blob.to_vec(),
            CLOSE => networks.close = Some(blob.to_vec()),
            _ => networks.fine.push(blob.to_vec()),
        }
    }
    if networks.coarse.is_empty() || networks.fine.is_empty() {
        return Err(ModelError::Header {
            file: file.into(),
            reason: "it lists no coarse network or no fine one".into(),
        });
    }
    Ok((networks, header.settings))
}

/// `sha256:` and the hash of a model file's bytes.
pub fn model_id(bytes: &[u8]) -> String {
    format!("sha256:{}", geometry::sha256_hex(bytes))
}

/// The header, and the networks' bytes, exactly as many as the header lists.
fn split<'a>(bytes: &'a [u8], file: &str) -> Result<(Header, &'a [u8]), ModelError> {
    let file = || file.to_owned();
    if bytes.len() < PREAMBLE || &bytes[..7] != MAGIC {
        return Err(ModelError::NotAModel { file: file() });
    }
    if ![VERSION, VERSION_CLOSE].contains(&bytes[7]) {
        let found = char::from(bytes[7]);
        return Err(ModelError::Version { file: file(), found });
    }
    let length = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize;
    let wrong_length = |expected| ModelError::Length {
        file: file(),
        found: bytes.len(),
        expected,
    };
    let end = PREAMBLE.saturating_add(length);
    let header = bytes.get(PREAMBLE..end).ok_or_else(|| wrong_length(end))?;
    let header: Header = serde_json::from_slice(header).map_err(|e| ModelError::Header {
        file: file(),
        reason: e.to_string(),
    })?;
    let expected = header.networks.iter().fold(end, |sum, e| sum.saturating_add(e.bytes));
    if expected != bytes.len() {
        return Err(wrong_length(expected));
    }
    Ok((header, &bytes[end..]))
}

fn check_shape(network: &Engine, inputs: usize, outputs: usize) -> Result<(), String> {
    if network.inputs() != inputs || network.outputs() != outputs {
        return Err(format!(
            "has {} input and {} output channels, expected are {inputs} and {outputs}",
            network.inputs(),
            network.outputs()
        ));
    }
    if network.stride() != Some(STRIDE) {
        return Err(format!("does not have one output on every {STRIDE}th pixel"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(bytes: &[u8]) -> String {
        Model::named(bytes, "m.unscrew").expect_err("must not load").to_string()
    }

    #[test]
    fn the_built_in_model_loads_and_survives_a_round_trip() -> Result<(), ModelError> {
        let model = Model::embedded()?;
        assert!(model.id().starts_with("sha256:") && model.id().len() == 71);
        let (networks, settings) = decode_model(EMBEDDED_MODEL, "m.unscrew")?;
        let again = encode_model(&networks, &settings)?;
        assert_eq!(decode_model(&again, "again")?.0, networks);
        assert_eq!(Model::from_bytes(&again)?.settings, model.settings);
        assert_eq!(model_id(&again).len(), 71);
        Ok(())
    }

    #[test]
    fn no_file_makes_the_detector_act_on_what_another_drive_may_be() -> Result<(), ModelError> {
        let (networks, mut settings) = decode_model(EMBEDDED_MODEL, "m.unscrew")?;
        settings.thresholds.accept = 0.4;
        let bold = Model::from_bytes(&encode_model(&networks, &settings)?)?;
        assert_eq!(bold.settings.thresholds.accept.to_bits(), LEAST_ACCEPT.to_bits());
        Ok(())
    }

    #[test]
    fn what_is_no_model_says_so_and_names_the_file() {
        assert!(message(b"").contains("m.unscrew is not an unscrew model"));
        assert!(message(b"PNG, or some text that is long enough").contains("not an unscrew model"));
        let mut other = EMBEDDED_MODEL.to_vec();
        other[7] = b'9';
        assert!(message(&other).contains("format '9'"));
        assert!(message(&EMBEDDED_MODEL[..EMBEDDED_MODEL.len() - 1]).contains("m.unscrew is damaged"));
        assert!(message(&EMBEDDED_MODEL[..20]).contains("m.unscrew is damaged"));
        let mut scrambled = EMBEDDED_MODEL.to_vec();
        scrambled[PREAMBLE] = b'?';
        assert!(message(&scrambled).contains("header of the model m.unscrew"));
        let (networks, settings) = decode_model(EMBEDDED_MODEL, "m").expect("the built-in model");
        let swapped = Networks {
            fine: vec![networks.coarse.clone()],
            ..networks.clone()
        };
        let swapped = encode_model(&swapped, &settings).expect("fits");
        assert!(message(&swapped).contains("network fine0 of the model m.unscrew has 3 input and 2 output channels"));
        let none = Networks {
            fine: Vec::new(),
            ..networks
        };
        let none = encode_model(&none, &settings).expect("fits");
        assert!(message(&none).contains("no coarse network or no fine one"));
        let missing = Model::load(Path::new("/nowhere/m.unscrew")).expect_err("is not there");
        assert!(missing.to_string().contains("/nowhere/m.unscrew"));
    }
}
