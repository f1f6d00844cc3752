//! Networks as safetensors files: parameters by name, the architecture as JSON in the metadata.

use std::collections::BTreeMap;
use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use serde::Serialize;

use crate::{NnError, Spec};

/// The metadata key of the architecture.
const SPEC: &str = "spec";

/// A named tensor of floats.
pub(crate) struct Entry {
    pub name: String,
    pub shape: Vec<usize>,
    pub data: Vec<f32>,
}

/// The metadata of a network file: what its maker said about it, and `spec`.
///
/// # Errors
/// [`NnError::Format`] where the bytes are no safetensors file.
pub fn metadata(bytes: &[u8]) -> Result<BTreeMap<String, String>, NnError> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(not_safetensors)?;
    let map = header.metadata().iter().flatten();
    Ok(map.map(|(k, v)| (k.clone(), v.clone())).collect())
}

pub(crate) fn read(path: &Path) -> Result<Vec<u8>, NnError> {
    std::fs::read(path).map_err(|source| NnError::Io {
        action: "read",
        path: path.to_path_buf(),
        source,
    })
}

/// Writes beside the file and renames, so that a crash never leaves half a file.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), NnError> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    std::fs::write(&part, bytes)
        .and_then(|()| std::fs::rename(&part, path))
        .map_err(|source| NnError::Io {
            action: "write",
            path: path.to_path_buf(),
            source,
        })
}

/// The bytes of a file; the same input always gives the same bytes (the `safetensors` writer orders metadata at random).
pub(crate) fn serialize(
    spec: &Spec,
    metadata: &BTreeMap<String, String>,
    entries: &[Entry],
) -> Result<Vec<u8>, NnError> {
    #[derive(Serialize)]
    #[serde(untagged)]
    enum Value<'a> {
        Metadata(BTreeMap<String, String>),
        Tensor {
            dtype: &'static str,
            shape: &'a [usize],
            data_offsets: [usize; 2],
        },
    }
    let json = |e: serde_json::Error| NnError::Format(e.to_string());
    let mut metadata = metadata.clone();
    metadata.insert(SPEC.into(), serde_json::to_string(spec).map_err(json)?);
    let mut header = BTreeMap::from([("__metadata__", Value::Metadata(metadata))]);
    let mut end = 0;
    for entry in entries {
        let begin = end;
        end += entry.data.len() * 4;
        let value = Value::Tensor {
            dtype: "F32",
            shape: &entry.shape,
            data_offsets: [begin, end],
        };
        header.insert(&entry.name, value);
    }
    let mut header = serde_json::to_vec(&header).map_err(json)?;
    header.resize(header.len().next_multiple_of(8), b' ');
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header);
    for entry in entries {
        bytes.extend(entry.data.iter().flat_map(|value| value.to_le_bytes()));
    }
    Ok(bytes)
}

/// A parsed file.
pub(crate) struct Reader<'a> {
    tensors: SafeTensors<'a>,
    pub metadata: BTreeMap<String, String>,
    pub spec: Spec,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Result<Self, NnError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(not_safetensors)?;
        let mut metadata = metadata(bytes)?;
        let spec = metadata.remove(SPEC).ok_or(NnError::NoSpec)?;
        let spec: Spec = serde_json::from_str(&spec).map_err(|e| NnError::Format(format!("its spec: {e}")))?;
        spec.check()?;
        Ok(Self {
            tensors,
            metadata,
            spec,
        })
    }

    /// The tensor of that name, which must have that shape.
    pub(crate) fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NnError> {
        let tensor = self
            .tensors
            .tensor(name)
            .map_err(|_| NnError::MissingTensor(name.into()))?;
        if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
            return Err(NnError::Shape {
                name: name.into(),
                found: format!("{:?} {:?}", tensor.dtype(), tensor.shape()),
                expected: format!("F32 {shape:?}"),
            });
        }
        let values = tensor.data().as_chunks::<4>().0.iter();
        let values: Vec<f32> = values.map(|&bytes| f32::from_le_bytes(bytes)).collect();
        if values.iter().any(|value| !value.is_finite()) {
            return Err(NnError::NotFinite(name.into()));
        }
        Ok(values)
    }
}

fn not_safetensors(error: safetensors::SafeTensorError) -> NnError {
    NnError::Format(error.to_string())
}
