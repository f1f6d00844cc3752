//! The model that a command runs; and `unscrew model`: its networks as ONNX files, and a model from such files.

use crate::{Ended, output};
use anyhow::{Context, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vision::{Detector, Networks, Settings, decode_model, encode_model};

/// Which model finds, and what runs its networks.
#[derive(clap::Args)]
pub(crate) struct ModelArgs {
    /// Model file; left out, the built-in one
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Run its networks by ONNX Runtime, the library that ORT_DYLIB_PATH names, instead of by the built-in kernels
    #[cfg(feature = "ort")]
    #[arg(long, value_enum, value_name = "PROVIDER")]
    onnx_runtime: Option<Provider>,
}

/// What computes in ONNX Runtime.
#[cfg(feature = "ort")]
#[derive(Clone, Copy, clap::ValueEnum)]
enum Provider {
    /// The processor
    Cpu,
    /// The first NVIDIA GPU
    Cuda,
}

impl ModelArgs {
    /// The bytes of the model file that they name.
    pub(crate) fn bytes(&self) -> Result<Vec<u8>> {
        match &self.model {
            Some(path) => std::fs::read(path).with_context(|| format!("reading {}", path.display())),
            None => Ok(vision::EMBEDDED_MODEL.to_vec()),
        }
    }

    /// The detector that they ask for.
    pub(crate) fn detector(&self) -> Result<Detector> {
        let detector = match &self.model {
            Some(path) => Detector::load(path)?,
            None => Detector::embedded()?,
        };
        #[cfg(feature = "ort")]
        if let Some(provider) = self.onnx_runtime {
            let provider = match provider {
                Provider::Cpu => nn::onnx_runtime::Provider::Cpu,
                Provider::Cuda => nn::onnx_runtime::Provider::Cuda,
            };
            let model = detector.model().clone().through_onnx_runtime(provider)?;
            return Ok(Detector::new(model));
        }
        Ok(detector)
    }
}

/// What to do with a model.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Write each network as an ONNX file, for other programs to run.
    Export(Export),
    /// Make a model from ONNX files: one chain of convolutions each, with the inputs and outputs of `vision::layout` (any graph, where
    /// built with the feature `ort`).
    Import(Import),
}

/// The networks of a model as `coarse.onnx`, `fine0.onnx`, ..., `close.onnx`: N, C, H, W floats in, logits out.
///
/// Colours come as -1 (black) to 1 (white); the fine networks and the one that looks closer see clips of 64 x 64 pixels, gamma corrected, with local
/// contrast as a fourth channel.
#[derive(clap::Args)]
#[command(after_help = "Example: unscrew model export --out onnx")]
pub struct Export {
    /// Model file; left out, the built-in one
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Folder for the files
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// A model with networks from ONNX files, and thresholds and sigma factors of another model.
#[derive(clap::Args)]
#[command(
    after_help = "Example: unscrew model import --fine mine.onnx --out mine.unscrew\nThen:    unscrew train --from mine.unscrew --coarse-steps 0 --fine-steps 0 --units 1 --out tuned.unscrew   # its own thresholds"
)]
pub struct Import {
    /// Network of stage 1; left out, that of the other model
    #[arg(long, value_name = "FILE")]
    coarse: Option<PathBuf>,
    /// Networks of stage 2; left out, those of the other model
    #[arg(long, value_name = "FILE", num_args = 1..)]
    fine: Vec<PathBuf>,
    /// Network of stage 2's closer look; left out, that of the other model, or none with --fine
    #[arg(long, value_name = "FILE")]
    close: Option<PathBuf>,
    /// The other model; left out, the built-in one
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Model file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// A model's networks and settings.
fn networks(model: Option<&Path>) -> Result<(Networks, Settings)> {
    let (bytes, name) = match model {
        Some(path) => {
            let name = path.display().to_string();
            (std::fs::read(path).with_context(|| format!("reading {name}"))?, name)
        }
        None => (vision::EMBEDDED_MODEL.to_vec(), "the built-in model".into()),
    };
    Ok(decode_model(&bytes, &name)?)
}

pub fn run(command: &Command) -> Result<Ended> {
    match command {
        Command::Export(args) => export(args),
        Command::Import(args) => import(args),
    }
}

fn export(args: &Export) -> Result<Ended> {
    output::prepare_folder(&args.out)?;
    let (networks, _) = networks(args.model.as_deref())?;
    for (name, bytes) in networks.named() {
        let path = args.out.join(format!("{name}.onnx"));
        geometry::write_aside(&path, &nn::onnx::export(&nn::Network::from_bytes(bytes)?))?;
        println!("{}", path.display());
    }
    Ok(Ended::Good)
}

fn import(args: &Import) -> Result<Ended> {
    let read = |path: &PathBuf| -> Result<Vec<u8>> {
        let name = path.display();
        let bytes = std::fs::read(path).with_context(|| format!("reading {name}"))?;
        let chain = nn::onnx::import(&bytes);
        // what the own kernels cannot run goes into the model as it is
        if cfg!(feature = "ort") && matches!(chain, Err(nn::NnError::Onnx(_))) {
            return Ok(bytes);
        }
        chain.with_context(|| format!("reading {name}"))
    };
    let (mut networks, mut settings) = networks(args.model.as_deref())?;
    if let Some(path) = &args.coarse {
        networks.coarse = read(path)?;
    }
    if !args.fine.is_empty() {
        networks.fine = args.fine.iter().map(read).collect::<Result<_>>()?;
        networks.close = None; // it would have most of the say
    }
    if let Some(path) = &args.close {
        networks.close = Some(read(path)?);
    }
    let files: Vec<&PathBuf> = args.coarse.iter().chain(&args.fine).chain(&args.close).collect();
    settings.facts = BTreeMap::from([("imported".into(), serde_json::json!(files))]);
    let bytes = encode_model(&networks, &settings)?;
    Detector::from_bytes(&bytes)?; // inputs and outputs are what detection expects
    geometry::write_aside(&args.out, &bytes)?;
    println!("{} ({})", args.out.display(), vision::model_id(&bytes));
    Ok(Ended::Good)
}
