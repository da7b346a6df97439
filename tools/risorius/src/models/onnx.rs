//! Writes ONNX files: a minimal encoder of the format (protocol buffers).
//!
//! Byte for byte what `tools/model-fetch/onnx.py` writes, so that the hashes of the networks hold for both.

const OPSET: i64 = 13;
const IR_VERSION: i64 = 7;
const KIND_FLOAT: i64 = 1;
const KIND_INT64: i64 = 7;
/// `AttributeProto.type`.
const ATTRIBUTE_INT: i64 = 2;
const ATTRIBUTE_INTS: i64 = 7;

/// A size of a tensor.
#[derive(Clone, Debug)]
pub(super) enum Dimension {
    Fixed(i64),
    /// May be anything; a word stands for it.
    Named(String),
}

impl From<i64> for Dimension {
    fn from(size: i64) -> Self {
        Self::Fixed(size)
    }
}

impl From<&str> for Dimension {
    fn from(name: &str) -> Self {
        Self::Named(name.to_owned())
    }
}

/// An attribute of a node.
#[derive(Clone, Debug)]
pub(super) enum AttributeValue {
    Int(i64),
    Ints(Vec<i64>),
}

fn put_varint(out: &mut Vec<u8>, value: i64) {
    let mut value = value as u64;
    while value > 127 {
        out.push((value & 127) as u8 | 128);
        value >>= 7;
    }
    out.push(value as u8);
}

fn put_number(out: &mut Vec<u8>, field: i64, value: i64) {
    put_varint(out, field << 3);
    put_varint(out, value);
}

fn put_bytes(out: &mut Vec<u8>, field: i64, bytes: &[u8]) {
    put_varint(out, field << 3 | 2);
    put_varint(out, bytes.len() as i64);
    out.extend_from_slice(bytes);
}

fn attribute(name: &str, value: &AttributeValue) -> Vec<u8> {
    let mut out = Vec::new();
    put_bytes(&mut out, 1, name.as_bytes());
    match value {
        AttributeValue::Int(value) => {
            put_number(&mut out, 3, *value);
            put_number(&mut out, 20, ATTRIBUTE_INT);
        }
        AttributeValue::Ints(values) => {
            for &v in values {
                put_number(&mut out, 8, v);
            }
            put_number(&mut out, 20, ATTRIBUTE_INTS);
        }
    }
    out
}

fn value_info(name: &str, shape: &[Dimension]) -> Vec<u8> {
    let mut dims = Vec::new();
    for size in shape {
        let mut dim = Vec::new();
        match size {
            Dimension::Fixed(n) => put_number(&mut dim, 1, *n),
            Dimension::Named(word) => put_bytes(&mut dim, 2, word.as_bytes()),
        }
        put_bytes(&mut dims, 1, &dim);
    }
    let (mut tensor, mut kind, mut out) = (Vec::new(), Vec::new(), Vec::new());
    put_number(&mut tensor, 1, KIND_FLOAT);
    put_bytes(&mut tensor, 2, &dims);
    put_bytes(&mut kind, 1, &tensor);
    put_bytes(&mut out, 1, name.as_bytes());
    put_bytes(&mut out, 2, &kind);
    out
}

/// A graph under construction.
#[derive(Debug, Default)]
pub(super) struct OnnxGraph {
    nodes: Vec<Vec<u8>>,
    constants: Vec<Vec<u8>>,
}

impl OnnxGraph {
    fn tensor(&mut self, shape: &[i64], kind: i64, raw: &[u8]) -> String {
        let name = format!("c{}", self.constants.len());
        let mut out = Vec::with_capacity(raw.len() + 64);
        for &d in shape {
            put_number(&mut out, 1, d);
        }
        put_number(&mut out, 2, kind);
        put_bytes(&mut out, 8, name.as_bytes());
        put_bytes(&mut out, 9, raw);
        self.constants.push(out);
        name
    }

    /// A constant of 32-bit floats; gives its name.
    pub(super) fn floats(&mut self, shape: &[i64], values: &[f32]) -> String {
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(shape, KIND_FLOAT, &raw)
    }

    /// The same of floats as the bytes they are stored in.
    pub(super) fn raw_floats(&mut self, shape: &[i64], raw: &[u8]) -> String {
        self.tensor(shape, KIND_FLOAT, raw)
    }

    /// A list of integers, such as a shape.
    pub(super) fn integers(&mut self, values: &[i64]) -> String {
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(&[values.len() as i64], KIND_INT64, &raw)
    }

    /// A node with one output, whose name it gives. Attributes stand in the order of their names.
    pub(super) fn node(&mut self, kind: &str, inputs: &[&str], attributes: &[(&str, AttributeValue)]) -> String {
        let output = format!("v{}", self.nodes.len());
        self.named_node(kind, inputs, &output, attributes);
        output
    }

    /// A node whose output has this name.
    pub(super) fn named_node(
        &mut self,
        kind: &str,
        inputs: &[&str],
        output: &str,
        attributes: &[(&str, AttributeValue)],
    ) {
        let mut body = Vec::new();
        for input in inputs {
            put_bytes(&mut body, 1, input.as_bytes());
        }
        put_bytes(&mut body, 2, output.as_bytes());
        put_bytes(&mut body, 3, format!("n{}", self.nodes.len()).as_bytes());
        put_bytes(&mut body, 4, kind.as_bytes());
        for (name, value) in attributes {
            put_bytes(&mut body, 5, &attribute(name, value));
        }
        self.nodes.push(body);
    }

    /// The file, with names and shapes of its inputs and outputs.
    pub(super) fn to_bytes(
        &self,
        name: &str,
        inputs: &[(String, Vec<Dimension>)],
        outputs: &[(String, Vec<Dimension>)],
    ) -> Vec<u8> {
        let mut graph = Vec::new();
        self.nodes.iter().for_each(|node| put_bytes(&mut graph, 1, node));
        put_bytes(&mut graph, 2, name.as_bytes());
        self.constants.iter().for_each(|constant| put_bytes(&mut graph, 5, constant));
        for (name, shape) in inputs {
            put_bytes(&mut graph, 11, &value_info(name, shape));
        }
        for (name, shape) in outputs {
            put_bytes(&mut graph, 12, &value_info(name, shape));
        }
        let (mut opset, mut out) = (Vec::new(), Vec::new());
        put_bytes(&mut opset, 1, b"");
        put_number(&mut opset, 2, OPSET);
        put_number(&mut out, 1, IR_VERSION);
        put_bytes(&mut out, 2, b"risorius");
        put_bytes(&mut out, 7, &graph);
        put_bytes(&mut out, 8, &opset);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_encoded_as_protocol_buffers_do() {
        let of = |value| {
            let mut out = Vec::new();
            put_varint(&mut out, value);
            out
        };
        assert_eq!(of(300), [0xac, 0x02]);
        assert_eq!(of(-1), [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x01]);
    }
}
