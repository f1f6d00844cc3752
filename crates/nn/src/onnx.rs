//! Export to ONNX, so that any other runtime can run or check a network.
//!
//! The few protobuf messages are written by hand; field numbers are those of `onnx.proto` (ONNX 1.12, operator set 13).

use crate::conv::unpack;
use crate::network::Layer;
use crate::{LayerSpec, Network};

/// The network as an ONNX model: `picture` (N, C, H, W floats, any N, H and W) to `output`, before any softmax.
///
/// Batch norm is folded into the convolutions. The model's metadata has the `spec` as JSON.
pub fn export(network: &Network) -> Vec<u8> {
    let spec = network.spec();
    let channels = spec.channels();
    let last = spec.layers.len() - 1;
    let mut graph = Message::default();
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
                },
                LayerSpec::Conv { out, .. },
            ) => {
                let (weight, bias_name) = (format!("layer{index}.weight"), format!("layer{index}.bias"));
                let (inputs, kernel) = (channels[index], geometry.kernel as i64);
                let shape = [*out as i64, inputs as i64, kernel, kernel];
                let values = unpack(geometry, inputs, *out, weights);
                graph.message(5, tensor(&weight, &shape, &values));
                graph.message(5, tensor(&bias_name, &shape[..1], &bias[..*out]));
                let convolved = if *relu {
                    format!("layer{index}.conv")
                } else {
                    output.clone()
                };
                let (pad, step) = (geometry.padding() as i64, geometry.stride as i64);
                let attributes = [
                    ints("kernel_shape", &[kernel; 2]),
                    ints("strides", &[step; 2]),
                    ints("dilations", &[geometry.dilation as i64; 2]),
                    ints("pads", &[pad; 4]),
                ];
                let conv = node("Conv", &[&current, &weight, &bias_name], &convolved, attributes);
                graph.message(1, conv);
                if *relu {
                    graph.message(1, node("Relu", &[&convolved], &output, []));
                }
            }
            (Layer::Upsample2, _) => {
                let scales = format!("layer{index}.scales");
                graph.message(5, tensor(&scales, &[4], &[1.0, 1.0, 2.0, 2.0]));
                let attributes = [
                    string("mode", "linear"),
                    string("coordinate_transformation_mode", "half_pixel"),
                ];
                graph.message(1, node("Resize", &[&current, "", &scales], &output, attributes));
            }
            // At an odd border the window that reaches over it takes the pixels there are.
            _ => {
                let attributes = [
                    ints("kernel_shape", &[2; 2]),
                    ints("strides", &[2; 2]),
                    int("ceil_mode", 1),
                ];
                graph.message(1, node("MaxPool", &[&current], &output, attributes));
            }
        }
        current = output;
    }
    graph.text(2, "network");
    graph.message(11, value("picture", channels[0], ["height", "width"]));
    graph.message(
        12,
        value("output", channels[last + 1], ["output_height", "output_width"]),
    );

    let mut operators = Message::default();
    operators.text(1, "");
    operators.int(2, 13);
    let mut model = Message::default();
    model.int(1, 8);
    model.text(2, "unscrew");
    model.message(7, graph);
    model.message(8, operators);
    if let Ok(json) = serde_json::to_string(spec) {
        let mut entry = Message::default();
        entry.text(1, "spec");
        entry.text(2, &json);
        model.message(14, entry);
    }
    model.0
}

/// A protobuf message under construction.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn int(&mut self, field: u64, value: i64) {
        self.varint(field << 3);
        self.varint(value as u64);
    }

    fn bytes(&mut self, field: u64, bytes: &[u8]) {
        self.varint(field << 3 | 2);
        self.varint(bytes.len() as u64);
        self.0.extend_from_slice(bytes);
    }

    fn text(&mut self, field: u64, text: &str) {
        self.bytes(field, text.as_bytes());
    }

    fn message(&mut self, field: u64, message: Message) {
        self.bytes(field, &message.0);
    }
}

/// `NodeProto`, named after its output.
fn node(operator: &str, inputs: &[&str], output: &str, attributes: impl IntoIterator<Item = Message>) -> Message {
    let mut node = Message::default();
    for input in inputs {
        node.text(1, input);
    }
    node.text(2, output);
    node.text(3, output);
    node.text(4, operator);
    for attribute in attributes {
        node.message(5, attribute);
    }
    node
}

/// `AttributeProto` of that type; its value is still to come.
fn attribute(name: &str, kind: i64) -> Message {
    let mut attribute = Message::default();
    attribute.text(1, name);
    attribute.int(20, kind);
    attribute
}

fn int(name: &str, value: i64) -> Message {
    let mut attribute = attribute(name, 2);
    attribute.int(3, value);
    attribute
}

fn string(name: &str, value: &str) -> Message {
    let mut attribute = attribute(name, 3);
    attribute.text(4, value);
    attribute
}

fn ints(name: &str, values: &[i64]) -> Message {
    let mut attribute = attribute(name, 7);
    for &value in values {
        attribute.int(8, value);
    }
    attribute
}

/// `TensorProto` of floats.
fn tensor(name: &str, shape: &[i64], values: &[f32]) -> Message {
    let mut tensor = Message::default();
    for &size in shape {
        tensor.int(1, size);
    }
    tensor.int(2, 1);
    tensor.text(8, name);
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    tensor.bytes(9, &bytes);
    tensor
}

/// `ValueInfoProto` of an N, C, H, W float tensor of which only the channels are fixed.
fn value(name: &str, channels: usize, size: [&str; 2]) -> Message {
    let mut shape = Message::default();
    let named = |name: &str| {
        let mut dimension = Message::default();
        dimension.text(2, name);
        dimension
    };
    shape.message(1, named("batch"));
    let mut dimension = Message::default();
    dimension.int(1, channels as i64);
    shape.message(1, dimension);
    for name in size {
        shape.message(1, named(name));
    }
    let mut tensor = Message::default();
    tensor.int(1, 1);
    tensor.message(2, shape);
    let mut kind = Message::default();
    kind.message(1, tensor);
    let mut value = Message::default();
    value.text(1, name);
    value.message(2, kind);
    value
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Spec, Trainer};

    /// The fields of a message: number and bytes (of an integer: none).
    fn fields(mut bytes: &[u8]) -> Vec<(u64, &[u8])> {
        fn varint(bytes: &mut &[u8]) -> u64 {
            let (mut value, mut shift) = (0, 0);
            loop {
                let byte = bytes[0];
                *bytes = &bytes[1..];
                value |= u64::from(byte & 0x7f) << shift;
                shift += 7;
                if byte < 0x80 {
                    return value;
                }
            }
        }
        let mut found = Vec::new();
        while !bytes.is_empty() {
            let key = varint(&mut bytes);
            let number = varint(&mut bytes);
            let length = if key & 7 == 2 { number as usize } else { 0 };
            let (field, rest) = bytes.split_at(length);
            found.push((key >> 3, field));
            bytes = rest;
        }
        found
    }

    #[test]
    fn an_export_has_the_layers_as_nodes_with_their_weights() {
        let conv = |relu| LayerSpec::Conv {
            kernel: 3,
            stride: 1,
            dilation: 2,
            out: 5,
            batch_norm: true,
            relu,
        };
        let spec = Spec {
            input_channels: 3,
            layers: vec![conv(true), LayerSpec::MaxPool2, LayerSpec::Upsample2, conv(false)],
        };
        let model = export(&Trainer::new(spec, 1).network());
        let model = fields(&model);
        let graph = fields(model.iter().find(|f| f.0 == 7).unwrap().1);
        let texts = |parent: u64, child: u64| -> Vec<&str> {
            let parents = graph.iter().filter(|f| f.0 == parent);
            parents
                .flat_map(|f| fields(f.1))
                .filter(|f| f.0 == child)
                .map(|f| std::str::from_utf8(f.1).unwrap())
                .collect()
        };
        assert_eq!(texts(1, 4), ["Conv", "Relu", "MaxPool", "Resize", "Conv"]);
        // Each node reads what the one before it wrote.
        assert_eq!(texts(1, 2), ["layer0.conv", "layer0", "layer1", "layer2", "output"]);
        let floats: Vec<usize> = graph
            .iter()
            .filter(|f| f.0 == 5)
            .flat_map(|f| fields(f.1))
            .filter(|f| f.0 == 9)
            .map(|f| f.1.len() / 4)
            .collect();
        assert_eq!(floats, [3 * 9 * 5, 5, 4, 5 * 9 * 5, 5]);
    }
}
