//! Networks to ONNX and back: any other runtime can run or check one, and one that was trained elsewhere can be used.
//!
//! What comes in must be one chain of the layers that [`Spec`] has: convolutions (square, of one group, padded so that the size
//! stays or is halved), batch normalisation and rectification after them, 2 x 2 maxima, bilinear doubling.

use std::collections::BTreeMap;

use prost::Message as _;

use crate::conv::unpack;
use crate::file::{Entry, serialize};
use crate::network::Layer;
use crate::spec::NORM_EPSILON;
use crate::{LayerSpec, Network, NnError, Spec};

/// The messages of `onnx.proto` (ONNX 1.12), as far as they are needed; tags are its field numbers.
mod proto {
    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Model {
        #[prost(int64, tag = "1")]
        pub ir_version: i64,
        #[prost(string, tag = "2")]
        pub producer_name: String,
        #[prost(message, optional, tag = "7")]
        pub graph: Option<Graph>,
        #[prost(message, repeated, tag = "8")]
        pub opset_import: Vec<OperatorSet>,
        #[prost(message, repeated, tag = "14")]
        pub metadata_props: Vec<StringEntry>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct OperatorSet {
        #[prost(string, tag = "1")]
        pub domain: String,
        #[prost(int64, tag = "2")]
        pub version: i64,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct StringEntry {
        #[prost(string, tag = "1")]
        pub key: String,
        #[prost(string, tag = "2")]
        pub value: String,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Graph {
        #[prost(message, repeated, tag = "1")]
        pub node: Vec<Node>,
        #[prost(string, tag = "2")]
        pub name: String,
        #[prost(message, repeated, tag = "5")]
        pub initializer: Vec<Tensor>,
        #[prost(message, repeated, tag = "11")]
        pub input: Vec<ValueInfo>,
        #[prost(message, repeated, tag = "12")]
        pub output: Vec<ValueInfo>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Node {
        #[prost(string, repeated, tag = "1")]
        pub input: Vec<String>,
        #[prost(string, repeated, tag = "2")]
        pub output: Vec<String>,
        #[prost(string, tag = "3")]
        pub name: String,
        #[prost(string, tag = "4")]
        pub op_type: String,
        #[prost(message, repeated, tag = "5")]
        pub attribute: Vec<Attribute>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Attribute {
        #[prost(string, tag = "1")]
        pub name: String,
        #[prost(float, tag = "2")]
        pub f: f32,
        #[prost(int64, tag = "3")]
        pub i: i64,
        #[prost(bytes = "vec", tag = "4")]
        pub s: Vec<u8>,
        #[prost(message, optional, tag = "5")]
        pub t: Option<Tensor>,
        #[prost(int64, repeated, packed = "false", tag = "8")]
        pub ints: Vec<i64>,
        #[prost(int32, tag = "20")]
        pub r#type: i32,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Tensor {
        #[prost(int64, repeated, packed = "false", tag = "1")]
        pub dims: Vec<i64>,
        #[prost(int32, tag = "2")]
        pub data_type: i32,
        #[prost(float, repeated, tag = "4")]
        pub float_data: Vec<f32>,
        #[prost(string, tag = "8")]
        pub name: String,
        #[prost(bytes = "vec", tag = "9")]
        pub raw_data: Vec<u8>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct ValueInfo {
        #[prost(string, tag = "1")]
        pub name: String,
        #[prost(message, optional, tag = "2")]
        pub r#type: Option<Type>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Type {
        #[prost(message, optional, tag = "1")]
        pub tensor_type: Option<TensorType>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct TensorType {
        #[prost(int32, tag = "1")]
        pub elem_type: i32,
        #[prost(message, optional, tag = "2")]
        pub shape: Option<Shape>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Shape {
        #[prost(message, repeated, tag = "1")]
        pub dim: Vec<Dimension>,
    }

    #[derive(Clone, PartialEq, prost::Message)]
    pub struct Dimension {
        #[prost(int64, optional, tag = "1")]
        pub dim_value: Option<i64>,
        #[prost(string, optional, tag = "2")]
        pub dim_param: Option<String>,
    }
}

use proto::{Attribute, Dimension, Graph, Model, Node, OperatorSet, Shape, StringEntry, TensorType, Type, ValueInfo};

/// ONNX's number for 32-bit floats.
const FLOAT: i32 = 1;

/// The network as an ONNX model: `picture` (N, C, H, W floats, any N, H and W) to `output`, before any softmax.
///
/// Batch norm is folded into the convolutions. The model's metadata has the `spec` as JSON.
pub fn export(network: &Network) -> Vec<u8> {
    let spec = network.spec();
    let channels = spec.channels();
    let last = spec.layers.len() - 1;
    let mut graph = Graph {
        name: "network".into(),
        ..Graph::default()
    };
    let mut current = "picture".to_owned();
    for (index, (described, layer)) in spec.layers.iter().zip(network.layers()).enumerate() {
        let output = if index == last {
            "output".to_owned()
        } else {
            format!("layer{index}")
        };
        match (layer, described) {
            (
                Layer::Conv {
                    geometry,
                    weights,
                    bias,
                    relu,
                    ..
                },
                LayerSpec::Conv { out, .. },
            ) => {
                let (weight, bias_name) = (format!("layer{index}.weight"), format!("layer{index}.bias"));
                let (inputs, kernel) = (channels[index], geometry.kernel as i64);
                let shape = [*out as i64, inputs as i64, kernel, kernel];
                let values = unpack(geometry, inputs, *out, weights);
                graph.initializer.push(tensor(&weight, &shape, &values));
                graph.initializer.push(tensor(&bias_name, &shape[..1], &bias[..*out]));
                let convolved = if *relu {
                    format!("layer{index}.conv")
                } else {
                    output.clone()
                };
                let (pad, step) = (geometry.padding() as i64, geometry.stride as i64);
                let attributes = vec![
                    ints("kernel_shape", &[kernel; 2]),
                    ints("strides", &[step; 2]),
                    ints("dilations", &[geometry.dilation as i64; 2]),
                    ints("pads", &[pad; 4]),
                ];
                let conv = node("Conv", &[&current, &weight, &bias_name], &convolved, attributes);
                graph.node.push(conv);
                if *relu {
                    graph.node.push(node("Relu", &[&convolved], &output, vec![]));
                }
            }
            (Layer::Upsample2, _) => {
                let scales = format!("layer{index}.scales");
                graph.initializer.push(tensor(&scales, &[4], &[1.0, 1.0, 2.0, 2.0]));
                let attributes = vec![
                    string("mode", "linear"),
                    string("coordinate_transformation_mode", "half_pixel"),
                ];
                graph
                    .node
                    .push(node("Resize", &[&current, "", &scales], &output, attributes));
            }
            // At an odd border the window that reaches over it takes the pixels there are.
            _ => {
                let attributes = vec![
                    ints("kernel_shape", &[2; 2]),
                    ints("strides", &[2; 2]),
                    int("ceil_mode", 1),
                ];
                graph.node.push(node("MaxPool", &[&current], &output, attributes));
            }
        }
        current = output;
    }
    graph.input.push(value("picture", channels[0], ["height", "width"]));
    graph
        .output
        .push(value("output", channels[last + 1], ["output_height", "output_width"]));
    let described = serde_json::to_string(spec).map(|value| StringEntry {
        key: "spec".into(),
        value,
    });
    let model = Model {
        ir_version: 8,
        producer_name: "unscrew".into(),
        graph: Some(graph),
        opset_import: vec![OperatorSet {
            domain: String::new(),
            version: 13,
        }],
        metadata_props: described.into_iter().collect(),
    };
    model.encode_to_vec()
}

/// A network file from an ONNX model that is one chain of layers.
///
/// # Errors
/// [`NnError::Onnx`] names the node that cannot be run; [`NnError::Spec`] the layer.
pub fn import(bytes: &[u8]) -> Result<Vec<u8>, NnError> {
    let model = Model::decode(bytes).map_err(|e| NnError::Onnx(format!("it is no ONNX file: {e}")))?;
    let graph = model.graph.ok_or_else(|| NnError::Onnx("it has no graph".into()))?;
    let mut chain = Chain::default();
    for initializer in &graph.initializer {
        chain.constants.insert(initializer.name.clone(), floats(initializer));
    }
    let inputs: Vec<&ValueInfo> = graph
        .input
        .iter()
        .filter(|i| !chain.constants.contains_key(&i.name))
        .collect();
    let [input] = inputs.as_slice() else {
        return Err(NnError::Onnx(format!(
            "it has {} inputs; expected one picture",
            inputs.len()
        )));
    };
    chain.current.clone_from(&input.name);
    for node in &graph.node {
        chain.add(node).map_err(|reason| {
            let name = node.output.first().map_or("", String::as_str);
            NnError::Onnx(format!("node {} of `{name}` {reason}", node.op_type))
        })?;
    }
    if graph.output.len() != 1 || graph.output[0].name != chain.current {
        return Err(NnError::Onnx("its output is not what the last layer gives".into()));
    }
    chain.finish()
}

/// A constant's shape and values; other types than floats have none.
fn floats(tensor: &proto::Tensor) -> (Vec<usize>, Vec<f32>) {
    let shape = tensor.dims.iter().map(|&d| d.max(0) as usize).collect();
    if tensor.data_type != FLOAT {
        return (shape, Vec::new());
    }
    let raw = tensor.raw_data.as_chunks::<4>().0.iter();
    let values = if tensor.float_data.is_empty() {
        raw.map(|&bytes| f32::from_le_bytes(bytes)).collect()
    } else {
        tensor.float_data.clone()
    };
    (shape, values)
}

/// The layers read so far.
#[derive(Default)]
struct Chain {
    constants: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    current: String,
    input_channels: Option<usize>,
    layers: Vec<LayerSpec>,
    /// Weight and bias of each convolution, by its layer.
    parameters: BTreeMap<usize, (Vec<f32>, Vec<f32>)>,
}

impl Chain {
    /// Takes the next node in, or says what is wrong with it.
    fn add(&mut self, node: &Node) -> Result<(), String> {
        let attribute = |name: &str| node.attribute.iter().find(|a| a.name == name);
        let output = node.output.first().ok_or("has no output")?;
        if node.op_type == "Constant" {
            let value = attribute("value").and_then(|a| a.t.as_ref()).ok_or("has no tensor")?;
            self.constants.insert(output.clone(), floats(value));
            return Ok(());
        }
        if node.input.first() != Some(&self.current) {
            return Err(format!(
                "does not read `{}`: only one chain of layers can be run",
                self.current
            ));
        }
        let all = |name: &str, expected: i64| attribute(name).is_none_or(|a| a.ints.iter().all(|&v| v == expected));
        let text = |name: &str| attribute(name).map_or("", |a| std::str::from_utf8(&a.s).unwrap_or("?"));
        match node.op_type.as_str() {
            "Conv" => {
                let one = |name: &str| attribute(name).and_then(|a| a.ints.first()).map_or(1, |&v| v);
                let (shape, weight) = self.constant(node, 1)?;
                let &[out, inputs, kernel, across] = shape.as_slice() else {
                    return Err(format!("has weights of shape {shape:?}; expected [out, in, k, k]"));
                };
                let (stride, dilation) = (one("strides"), one("dilations"));
                let pad = dilation * (kernel as i64 - 1) / 2;
                if kernel != across || attribute("group").is_some_and(|a| a.i != 1) {
                    return Err("is not square, or has groups".into());
                }
                if !all("strides", stride) || !all("dilations", dilation) {
                    return Err("has other steps down than across".into());
                }
                let padded = attribute("pads").map_or(pad == 0, |a| a.ints.iter().all(|&p| p == pad));
                if !padded || !matches!(text("auto_pad"), "" | "NOTSET") {
                    return Err(format!("is not padded by {pad} on each side"));
                }
                let bias = match node.input.get(2).filter(|name| !name.is_empty()) {
                    Some(_) => self.constant(node, 2)?.1,
                    None => vec![0.0; out],
                };
                self.input_channels.get_or_insert(inputs);
                self.parameters.insert(self.layers.len(), (weight, bias));
                self.layers.push(LayerSpec::Conv {
                    kernel,
                    stride: stride.max(0) as usize,
                    dilation: dilation.max(0) as usize,
                    out,
                    batch_norm: false,
                    relu: false,
                });
            }
            "BatchNormalization" => {
                let epsilon = attribute("epsilon").map_or(NORM_EPSILON, |a| a.f);
                let norm = [1, 2, 3, 4].map(|k| self.constant(node, k).map(|c| c.1));
                let [scale, shift, mean, variance] = norm;
                let (scale, shift, mean, variance) = (scale?, shift?, mean?, variance?);
                let (weight, bias) = self.last_conv()?;
                let each = weight.len() / bias.len().max(1);
                for (o, bias) in bias.iter_mut().enumerate() {
                    let value = |v: &[f32]| v.get(o).copied().ok_or("has too few channels");
                    let factor = value(&scale)? / (value(&variance)? + epsilon).sqrt();
                    weight[o * each..(o + 1) * each].iter_mut().for_each(|w| *w *= factor);
                    *bias = (*bias - value(&mean)?) * factor + value(&shift)?;
                }
            }
            "Relu" => {
                self.last_conv()?;
                if let Some(LayerSpec::Conv { relu, .. }) = self.layers.last_mut() {
                    *relu = true;
                }
            }
            "MaxPool" => {
                if attribute("kernel_shape").is_none()
                    || !all("kernel_shape", 2)
                    || !all("strides", 2)
                    || !all("pads", 0)
                {
                    return Err("is not over 2 x 2 pixels".into());
                }
                self.layers.push(LayerSpec::MaxPool2);
            }
            "Resize" => {
                let (_, scales) = self.constant(node, 2)?;
                let aligned = matches!(
                    text("coordinate_transformation_mode"),
                    "" | "half_pixel" | "pytorch_half_pixel"
                );
                if scales != [1.0, 1.0, 2.0, 2.0] || text("mode") != "linear" || !aligned {
                    return Err("is not bilinear doubling".into());
                }
                self.layers.push(LayerSpec::Upsample2);
            }
            "Identity" | "Dropout" => {}
            _ => return Err("is a layer that cannot be run".into()),
        }
        self.current.clone_from(output);
        Ok(())
    }

    fn constant(&self, node: &Node, k: usize) -> Result<(Vec<usize>, Vec<f32>), String> {
        let found = node.input.get(k).and_then(|name| self.constants.get(name));
        let (shape, values) = found.ok_or_else(|| format!("has no constant input {k}"))?;
        if values.len() != shape.iter().product::<usize>() {
            return Err(format!("has an input {k} that is not of 32-bit floats"));
        }
        Ok((shape.clone(), values.clone()))
    }

    /// The convolution that was just read, not yet rectified.
    fn last_conv(&mut self) -> Result<&mut (Vec<f32>, Vec<f32>), String> {
        match self.layers.last() {
            Some(LayerSpec::Conv { relu: false, .. }) => {}
            _ => return Err("does not follow a convolution".into()),
        }
        self.parameters
            .get_mut(&(self.layers.len() - 1))
            .ok_or_else(|| "does not follow a convolution".into())
    }

    fn finish(self) -> Result<Vec<u8>, NnError> {
        let input_channels = self.input_channels;
        let spec = Spec {
            input_channels: input_channels.ok_or_else(|| NnError::Onnx("it has no convolution".into()))?,
            layers: self.layers,
        };
        spec.check()?;
        let channels = spec.channels();
        let mut entries = Vec::new();
        for (index, (weight, bias)) in self.parameters {
            let LayerSpec::Conv { kernel, out, .. } = spec.layers[index] else {
                continue;
            };
            let shape = vec![out, channels[index], kernel, kernel];
            if weight.len() != shape.iter().product::<usize>() || bias.len() != out {
                return Err(NnError::Onnx(format!(
                    "convolution {index} has {} weights and {} biases; the layer before it gives {} channels",
                    weight.len(),
                    bias.len(),
                    channels[index]
                )));
            }
            for (name, shape, data) in [("weight", shape, weight), ("bias", vec![out], bias)] {
                entries.push(Entry {
                    name: format!("layers.{index}.{name}"),
                    shape,
                    data,
                });
            }
        }
        let file = serialize(&spec, &BTreeMap::new(), &entries)?;
        Network::from_bytes(&file)?; // finite, and as the spec says
        Ok(file)
    }
}

/// A node, named after its output.
fn node(operator: &str, inputs: &[&str], output: &str, attribute: Vec<Attribute>) -> Node {
    Node {
        input: inputs.iter().map(|&i| i.into()).collect(),
        output: vec![output.into()],
        name: output.into(),
        op_type: operator.into(),
        attribute,
    }
}

fn int(name: &str, i: i64) -> Attribute {
    Attribute {
        name: name.into(),
        r#type: 2,
        i,
        ..Attribute::default()
    }
}

fn string(name: &str, value: &str) -> Attribute {
    Attribute {
        name: name.into(),
        r#type: 3,
        s: value.into(),
        ..Attribute::default()
    }
}

fn ints(name: &str, values: &[i64]) -> Attribute {
    Attribute {
        name: name.into(),
        r#type: 7,
        ints: values.into(),
        ..Attribute::default()
    }
}

fn tensor(name: &str, shape: &[i64], values: &[f32]) -> proto::Tensor {
    proto::Tensor {
        dims: shape.into(),
        data_type: FLOAT,
        name: name.into(),
        raw_data: values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        ..proto::Tensor::default()
    }
}

/// An N, C, H, W float tensor of which only the channels are fixed.
fn value(name: &str, channels: usize, size: [&str; 2]) -> ValueInfo {
    let named = |name: &str| Dimension {
        dim_param: Some(name.into()),
        dim_value: None,
    };
    let fixed = Dimension {
        dim_value: Some(channels as i64),
        dim_param: None,
    };
    let shape = Shape {
        dim: vec![named("batch"), fixed, named(size[0]), named(size[1])],
    };
    ValueInfo {
        name: name.into(),
        r#type: Some(Type {
            tensor_type: Some(TensorType {
                elem_type: FLOAT,
                shape: Some(shape),
            }),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Tensor, Trainer};

    fn conv(kernel: usize, stride: usize, out: usize, relu: bool) -> LayerSpec {
        LayerSpec::Conv {
            kernel,
            stride,
            dilation: 1,
            out,
            batch_norm: true,
            relu,
        }
    }

    fn network() -> Network {
        let spec = Spec {
            input_channels: 3,
            layers: vec![
                conv(5, 2, 6, true),
                LayerSpec::MaxPool2,
                conv(3, 1, 5, true),
                LayerSpec::Upsample2,
                conv(1, 1, 4, false),
            ],
        };
        Trainer::new(spec, 1).network()
    }

    #[test]
    fn an_export_has_the_layers_as_nodes_with_their_weights() {
        let graph = Model::decode(export(&network()).as_slice()).unwrap().graph.unwrap();
        let operators: Vec<&str> = graph.node.iter().map(|n| n.op_type.as_str()).collect();
        assert_eq!(operators, ["Conv", "Relu", "MaxPool", "Conv", "Relu", "Resize", "Conv"]);
        for pair in graph.node.windows(2) {
            assert_eq!(pair[1].input[0], pair[0].output[0]); // each reads what the one before it wrote
        }
        let weights: Vec<usize> = graph.initializer.iter().map(|t| t.raw_data.len() / 4).collect();
        assert_eq!(weights, [6 * 3 * 25, 6, 5 * 6 * 9, 5, 4, 4 * 5, 4]);
    }

    #[test]
    fn what_was_exported_comes_back_and_gives_the_same() {
        let network = network();
        let back = Network::from_bytes(&import(&export(&network)).expect("its own export")).expect("a network file");
        let mut picture = Tensor::zeros(1, 21, 18, 3);
        for (k, value) in picture.data.iter_mut().enumerate() {
            *value = ((k * 37) % 101) as f32 / 50.0 - 1.0;
        }
        assert_eq!(back.forward_batch(&picture).data, network.forward_batch(&picture).data);
    }

    #[test]
    fn batch_norm_of_its_own_node_is_folded() {
        let mut model = Model::decode(export(&network()).as_slice()).unwrap();
        let graph = model.graph.as_mut().unwrap();
        let last = graph.node.last_mut().unwrap();
        last.output[0] = "raw".into();
        graph.node.push(node(
            "BatchNormalization",
            &["raw", "g", "b", "m", "v"],
            "output",
            vec![],
        ));
        for (name, value) in [("g", 2.0), ("b", 0.5), ("m", 1.0), ("v", 4.0)] {
            graph.initializer.push(tensor(name, &[4], &[value; 4]));
        }
        let folded = Network::from_bytes(&import(&model.encode_to_vec()).unwrap()).unwrap();
        let picture = Tensor::zeros(1, 8, 8, 3);
        let (with, without) = (folded.forward_batch(&picture), network().forward_batch(&picture));
        for (a, b) in with.data.iter().zip(&without.data) {
            assert!((a - ((b - 1.0) + 0.5)).abs() < 1e-4, "{a} {b}");
        }
    }

    #[test]
    fn what_cannot_be_run_is_named() {
        assert!(import(b"no protobuf at all").is_err_and(|e| e.to_string().contains("ONNX")));
        let mut model = Model::decode(export(&network()).as_slice()).unwrap();
        model.graph.as_mut().unwrap().node[1].op_type = "Sigmoid".into();
        assert!(import(&model.encode_to_vec()).is_err_and(|e| e.to_string().contains("Sigmoid")));
        let mut model = Model::decode(export(&network()).as_slice()).unwrap();
        model.graph.as_mut().unwrap().node[3].attribute[3] = ints("pads", &[0; 4]);
        assert!(import(&model.encode_to_vec()).is_err_and(|e| e.to_string().contains("padded by 1")));
    }
}
