//! TensorFlow Lite → ONNX for the few operators that face networks use.
//!
//! TensorFlow Lite keeps pictures as [batch, height, width, channels], ONNX convolutions want the channels second: a tensor
//! is turned where the two meet, and once only. Weights stored as 16-bit floats become 32-bit. Node for node what
//! `tools/model-fetch/convert.py` does: the hashes of the results are the same. `None`: the file is not such a network.

use std::collections::BTreeMap;

use super::onnx::{AttributeValue, Dimension, OnnxGraph};
use super::tflite::{FlatTable, TensorValues, TfliteNetwork, TfliteOperator};

const TO_NCHW: [usize; 4] = [0, 3, 1, 2];
const TO_NHWC: [usize; 4] = [0, 2, 3, 1];
/// `Padding.VALID` of the schema.
const PADDING_VALID: i8 = 1;
/// `ActivationFunctionType.RELU` of the schema.
const ACTIVATION_RELU: i8 = 1;
/// The end of a slice that goes on to the end.
const TO_THE_END: i64 = (1 << 31) - 1;

struct Converter<'a> {
    network: TfliteNetwork<'a>,
    graph: OnnxGraph,
    values: BTreeMap<usize, TensorValues>,
    /// Names of tensors in [n, h, w, c] order, and the same in [n, c, h, w].
    names: BTreeMap<usize, String>,
    names_nchw: BTreeMap<usize, String>,
}

fn index(number: i32) -> Option<usize> {
    usize::try_from(number).ok()
}

fn ints(values: &[i64]) -> AttributeValue {
    AttributeValue::Ints(values.to_vec())
}

fn axes(order: [usize; 4]) -> AttributeValue {
    AttributeValue::Ints(order.map(|o| o as i64).to_vec())
}

fn in_order(shape: &[i64], order: [usize; 4]) -> Option<Vec<i64>> {
    order.iter().map(|&o| shape.get(o).copied()).collect()
}

/// The values of a 4-D array with its axes in another order.
fn turned(values: &[f32], shape: &[i64], order: [usize; 4]) -> Option<Vec<f32>> {
    let sizes: [usize; 4] = shape.iter().map(|&s| s as usize).collect::<Vec<_>>().try_into().ok()?;
    let strides = [sizes[1] * sizes[2] * sizes[3], sizes[2] * sizes[3], sizes[3], 1];
    let (size, step) = (order.map(|o| sizes[o]), order.map(|o| strides[o]));
    let mut out = Vec::with_capacity(values.len());
    for a in 0..size[0] {
        for b in 0..size[1] {
            for c in 0..size[2] {
                for d in 0..size[3] {
                    out.push(*values.get(a * step[0] + b * step[1] + c * step[2] + d * step[3])?);
                }
            }
        }
    }
    Some(out)
}

impl Converter<'_> {
    fn shape(&self, i: usize) -> Option<Vec<i64>> {
        Some(self.network.tensors.get(i)?.shape.clone())
    }

    /// The name of a tensor in its own order of axes.
    fn plain(&mut self, i: usize) -> Option<String> {
        if let Some(name) = self.names.get(&i) {
            return Some(name.clone());
        }
        let name = if let Some(values) = self.values.get(&i) {
            self.graph.floats(&self.network.tensors.get(i)?.shape, &values.floats())
        } else {
            let turned = self.names_nchw.get(&i)?.clone();
            self.graph.node("Transpose", &[&turned], &[("perm", axes(TO_NHWC))])
        };
        self.names.insert(i, name.clone());
        Some(name)
    }

    fn nchw(&mut self, i: usize) -> Option<String> {
        if let Some(name) = self.names_nchw.get(&i) {
            return Some(name.clone());
        }
        let plain = self.plain(i)?;
        let name = self.graph.node("Transpose", &[&plain], &[("perm", axes(TO_NCHW))]);
        self.names_nchw.insert(i, name.clone());
        Some(name)
    }

    fn constant_ints(&self, i: i32) -> Option<Vec<i64>> {
        Some(self.values.get(&index(i)?)?.ints()?.to_vec())
    }

    /// Zeros on the top, left, bottom, right: `SAME` puts the odd one last.
    fn padding(&self, i: usize, options: &FlatTable<'_>, kernel: [i64; 2], strides: [i64; 2]) -> Option<Vec<i64>> {
        if options.byte(0)? == PADDING_VALID {
            return Some(vec![0; 4]);
        }
        let shape = self.shape(i)?;
        let total = |axis: usize| {
            let (size, stride) = (*shape.get(axis + 1)?, strides[axis]);
            let steps = (size + stride - 1).checked_div(stride)? - 1;
            Some((steps * stride + kernel[axis] - size).max(0))
        };
        let (y, x) = (total(0)?, total(1)?);
        Some(vec![y / 2, x / 2, y - y / 2, x - x / 2])
    }

    fn activation(&mut self, name: String, options: Option<&FlatTable<'_>>, field: usize) -> Option<String> {
        match options.map_or(Some(0), |o| o.byte(field))? {
            0 => Some(name),
            ACTIVATION_RELU => Some(self.graph.node("Relu", &[&name], &[])),
            _ => None,
        }
    }

    fn convolution(&mut self, op: &TfliteOperator<'_>, y: usize) -> Option<()> {
        let depthwise = op.kind == "DEPTHWISE_CONV_2D";
        let options = op.options?;
        let (x, w) = (index(*op.inputs.first()?)?, index(*op.inputs.get(1)?)?);
        let shape = self.shape(w)?;
        let strides = [i64::from(options.int(2)?), i64::from(options.int(1)?)];
        let kernel = [*shape.get(1)?, *shape.get(2)?];
        let order = if depthwise { [3, 0, 1, 2] } else { [0, 3, 1, 2] };
        let weights = turned(&self.values.get(&w)?.floats(), &shape, order)?;
        let weights = self.graph.floats(&in_order(&shape, order)?, &weights);
        let mut inputs = vec![self.nchw(x)?, weights];
        if let Some(bias) = op.inputs.get(2).and_then(|&b| index(b)) {
            inputs.push(self.plain(bias)?);
        }
        let pads = self.padding(x, &options, kernel, strides)?;
        let attributes = [
            ("group", AttributeValue::Int(if depthwise { *shape.get(3)? } else { 1 })),
            ("kernel_shape", ints(&kernel)),
            ("pads", ints(&pads)),
            ("strides", ints(&strides)),
        ];
        let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
        let name = self.graph.node("Conv", &inputs, &attributes);
        let name = self.activation(name, Some(&options), if depthwise { 4 } else { 3 })?;
        self.names_nchw.insert(y, name);
        Some(())
    }

    fn pooling(&mut self, op: &TfliteOperator<'_>, y: usize) -> Option<()> {
        let (x, options) = (index(*op.inputs.first()?)?, op.options?);
        let size = |field: usize| options.int(field).map(i64::from);
        let (strides, kernel) = ([size(2)?, size(1)?], [size(4)?, size(3)?]);
        let pads = self.padding(x, &options, kernel, strides)?;
        let input = self.nchw(x)?;
        let attributes = [("kernel_shape", ints(&kernel)), ("pads", ints(&pads)), ("strides", ints(&strides))];
        let name = self.graph.node("MaxPool", &[&input], &attributes);
        let name = self.activation(name, Some(&options), 5)?;
        self.names_nchw.insert(y, name);
        Some(())
    }

    fn elementwise(&mut self, kind: &str, op: &TfliteOperator<'_>, y: usize) -> Option<()> {
        let (a, b) = (index(*op.inputs.first()?)?, index(*op.inputs.get(1)?)?);
        let both = self.names_nchw.contains_key(&a) && self.names_nchw.contains_key(&b);
        let turned = both && self.shape(a)? == self.shape(b)?;
        let inputs = if turned { [self.nchw(a)?, self.nchw(b)?] } else { [self.plain(a)?, self.plain(b)?] };
        let name = self.graph.node(kind, &[&inputs[0], &inputs[1]], &[]);
        let name = self.activation(name, op.options.as_ref(), 0)?;
        if turned {
            self.names_nchw.insert(y, name)
        } else {
            self.names.insert(y, name)
        };
        Some(())
    }

    fn unary(&mut self, kind: &str, x: usize, y: usize) -> Option<()> {
        if self.names_nchw.contains_key(&x) {
            let input = self.nchw(x)?;
            let name = self.graph.node(kind, &[&input], &[]);
            self.names_nchw.insert(y, name);
        } else {
            let input = self.plain(x)?;
            let name = self.graph.node(kind, &[&input], &[]);
            self.names.insert(y, name);
        }
        Some(())
    }

    fn slice(&mut self, op: &TfliteOperator<'_>, x: usize, y: usize) -> Option<()> {
        let options = op.options?;
        let constant = |i: usize| self.constant_ints(*op.inputs.get(i)?);
        let (mut begin, mut end, step) = (constant(1)?, constant(2)?, constant(3)?);
        let (begin_mask, end_mask, shrink) = (options.int(0)?, options.int(1)?, options.int(4)?);
        for (i, (b, e)) in begin.iter_mut().zip(&mut end).enumerate() {
            if begin_mask >> i & 1 == 1 {
                *b = 0;
            }
            if shrink >> i & 1 == 1 {
                *e = *b + 1;
            } else if end_mask >> i & 1 == 1 {
                *e = TO_THE_END;
            }
        }
        let all: Vec<i64> = (0..begin.len() as i64).collect();
        let input = self.plain(x)?;
        let lists = [&begin, &end, &all, &step].map(|list| self.graph.integers(list));
        let name = self.graph.node("Slice", &[&input, &lists[0], &lists[1], &lists[2], &lists[3]], &[]);
        let gone: Vec<i64> = all.into_iter().filter(|i| shrink >> i & 1 == 1).collect();
        let name = if gone.is_empty() {
            name
        } else {
            let list = self.graph.integers(&gone);
            self.graph.node("Squeeze", &[&name, &list], &[])
        };
        self.names.insert(y, name);
        Some(())
    }

    fn operator(&mut self, op: &TfliteOperator<'_>) -> Option<()> {
        let (x, y) = (index(*op.inputs.first()?)?, index(*op.outputs.first()?)?);
        match op.kind {
            // 16-bit weights: the values are read already.
            "DEQUANTIZE" => {
                let values = self.values.get(&x)?.clone();
                self.values.insert(y, values);
            }
            "CONV_2D" | "DEPTHWISE_CONV_2D" => self.convolution(op, y)?,
            "MAX_POOL_2D" => self.pooling(op, y)?,
            "ADD" => self.elementwise("Add", op, y)?,
            "SUB" => self.elementwise("Sub", op, y)?,
            "MUL" => self.elementwise("Mul", op, y)?,
            "DIV" => self.elementwise("Div", op, y)?,
            "LOGISTIC" => self.unary("Sigmoid", x, y)?,
            "RELU" => self.unary("Relu", x, y)?,
            "NEG" => self.unary("Neg", x, y)?,
            "SQRT" => self.unary("Sqrt", x, y)?,
            "PRELU" => {
                let slope = self.values.get(&index(*op.inputs.get(1)?)?)?.floats();
                let input = self.nchw(x)?;
                let slope = self.graph.floats(&[slope.len() as i64, 1, 1], &slope);
                let name = self.graph.node("PRelu", &[&input, &slope], &[]);
                self.names_nchw.insert(y, name);
            }
            "PAD" => {
                let pads = self.constant_ints(*op.inputs.get(1)?)?;
                let side = |after: usize| TO_NCHW.map(|o| pads.get(2 * o + after).copied());
                let pads = [side(0), side(1)].concat().into_iter().collect::<Option<Vec<_>>>()?;
                let input = self.nchw(x)?;
                let pads = self.graph.integers(&pads);
                let name = self.graph.node("Pad", &[&input, &pads], &[]);
                self.names_nchw.insert(y, name);
            }
            "RESHAPE" => {
                let shape = self.shape(y)?;
                let input = self.plain(x)?;
                let shape = self.graph.integers(&shape);
                let name = self.graph.node("Reshape", &[&input, &shape], &[]);
                self.names.insert(y, name);
            }
            "TRANSPOSE" => {
                let perm = self.constant_ints(*op.inputs.get(1)?)?;
                let input = self.plain(x)?;
                let name = self.graph.node("Transpose", &[&input], &[("perm", ints(&perm))]);
                self.names.insert(y, name);
            }
            "CONCATENATION" => {
                let axis = i64::from(op.options?.int(0)?);
                let inputs = op.inputs.iter().map(|&i| self.plain(index(i)?)).collect::<Option<Vec<_>>>()?;
                let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
                let name = self.graph.node("Concat", &inputs, &[("axis", AttributeValue::Int(axis))]);
                self.names.insert(y, name);
            }
            "MEAN" | "SUM" => {
                let along = self.constant_ints(*op.inputs.get(1)?)?;
                let keep = ("keepdims", AttributeValue::Int(i64::from(op.options?.byte(0)?)));
                let input = self.plain(x)?;
                let name = if op.kind == "MEAN" {
                    self.graph.node("ReduceMean", &[&input], &[("axes", ints(&along)), keep])
                } else {
                    let along = self.graph.integers(&along);
                    self.graph.node("ReduceSum", &[&input, &along], &[keep])
                };
                self.names.insert(y, name);
            }
            "STRIDED_SLICE" => self.slice(op, x, y)?,
            "RSQRT" => {
                let input = self.plain(x)?;
                let root = self.graph.node("Sqrt", &[&input], &[]);
                let name = self.graph.node("Reciprocal", &[&root], &[]);
                self.names.insert(y, name);
            }
            "SQUARED_DIFFERENCE" => {
                let (a, b) = (self.plain(x)?, self.plain(index(*op.inputs.get(1)?)?)?);
                let gap = self.graph.node("Sub", &[&a, &b], &[]);
                let name = self.graph.node("Mul", &[&gap, &gap], &[]);
                self.names.insert(y, name);
            }
            _ => return None,
        }
        Some(())
    }

    fn named(&self, i: usize) -> Option<(String, Vec<Dimension>)> {
        let tensor = self.network.tensors.get(i)?;
        Some((tensor.name.clone(), tensor.shape.iter().map(|&s| s.into()).collect()))
    }
}

/// The bytes of an ONNX file with the inputs and outputs of a TensorFlow Lite file, names included.
///
/// `inner` names outputs to be added for tensors inside; these have the channels before height and width.
pub(super) fn onnx_from_tflite(data: &[u8], inner: &[(usize, &str)]) -> Option<Vec<u8>> {
    let network = TfliteNetwork::read(data)?;
    let values = network.tensors.iter().enumerate().filter_map(|(i, t)| Some((i, t.values.clone()?))).collect();
    let (inputs, outputs) = (network.inputs.clone(), network.outputs.clone());
    let operators = network.operators.clone();
    let graph = OnnxGraph::default();
    let mut all = Converter { network, graph, values, names: BTreeMap::new(), names_nchw: BTreeMap::new() };
    for &i in &inputs {
        let i = index(i)?;
        let name = all.network.tensors.get(i)?.name.clone();
        all.names.insert(i, name);
    }
    operators.iter().try_for_each(|op| all.operator(op))?;
    let mut shown = Vec::new();
    for &i in &outputs {
        let i = index(i)?;
        let (name, shape) = all.named(i)?;
        let value = all.plain(i)?;
        all.graph.named_node("Identity", &[&value], &name, &[]);
        shown.push((name, shape));
    }
    for &(i, name) in inner {
        let value = all.nchw(i)?;
        all.graph.named_node("Identity", &[&value], name, &[]);
        let shape = in_order(&all.shape(i)?, TO_NCHW)?;
        shown.push((name.to_owned(), shape.into_iter().map(Dimension::from).collect()));
    }
    let inputs = inputs.iter().map(|&i| all.named(index(i)?)).collect::<Option<Vec<_>>>()?;
    Some(all.graph.to_bytes("network", &inputs, &shown))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_turned() {
        let values: Vec<f32> = (0..24u8).map(f32::from).collect();
        let turned = turned(&values, &[1, 2, 3, 4], TO_NCHW).unwrap();
        // Channel 1 of the first row: 1, 5, 9.
        assert_eq!(turned[6..9], [1.0, 5.0, 9.0]);
        assert!(super::turned(&values, &[1, 2, 3, 5], TO_NCHW).is_none(), "too few values");
    }
}
