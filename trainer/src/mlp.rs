//! The one network builder: dense layers with ReLU and a skip, single or in groups of equal shape (fact sheet §1.1).

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng;

use crate::config::{BranchedSize, NetSize, SKIP_LAYER};
use crate::kernel::{self, MlpSpec, Products};

/// How a kernel starts.
#[derive(Clone, Copy, Debug)]
pub enum Init {
    /// U(−l, l) with l = √(6 / (fan_in + fan_out)).
    Glorot,
    /// Glorot for two heads side by side: the first column as a net of one output, the others as a net of the rest.
    GlorotHeads,
    /// One-sided U[0, s), as the JAX initialiser of that name.
    Uniform(f32),
    /// N(0, s).
    Normal(f32),
}

impl Init {
    fn draw(self, rng: &mut impl Rng, fan_in: usize, fan_out: usize, n: usize) -> Vec<f32> {
        let limit = |outputs: usize| (6.0 / (fan_in + outputs) as f32).sqrt();
        (0..n)
            .map(|i| match self {
                Self::Glorot => rng.random_range(-limit(fan_out)..limit(fan_out)),
                Self::GlorotHeads => {
                    let l = limit(if i % fan_out == 0 { 1 } else { fan_out - 1 });
                    rng.random_range(-l..l)
                }
                Self::Uniform(s) => rng.random::<f32>() * s,
                // Box–Muller; 1 − u keeps the logarithm finite.
                Self::Normal(s) => {
                    let (u, v): (f64, f64) = (1.0 - rng.random::<f64>(), rng.random());
                    ((-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()) as f32 * s
                }
            })
            .collect()
    }
}

/// A trainable tensor of these values.
pub fn parameter<const D: usize>(values: Vec<f32>, shape: [usize; D], device: &Device) -> Param<Tensor<D>> {
    Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), device))
}

/// The shape of a net of `size`, with the family's skip.
pub fn spec(size: NetSize, output: Option<usize>, products: Products) -> MlpSpec {
    let skip = (size.depth > SKIP_LAYER).then_some(SKIP_LAYER);
    MlpSpec { depth: size.depth, width: size.width, skip, output, products }
}

/// Dense layers with ReLU; the last one is linear when the spec has an output.
#[derive(Module, Debug)]
pub struct Mlp {
    /// `[fan_in, fan_out]` per layer.
    weights: Vec<Param<Tensor<2>>>,
    /// `[fan_out]` per layer.
    biases: Vec<Param<Tensor<1>>>,
    #[module(skip)]
    spec: MlpSpec,
}

impl Mlp {
    /// A net whose hidden layers start with Glorot and whose output starts with `output_init`.
    pub fn new(d_in: usize, spec: MlpSpec, output_init: Init, rng: &mut impl Rng, device: &Device) -> Self {
        let shapes: Vec<_> = spec.layers(d_in).collect();
        let init = |i: usize| if i == spec.depth { output_init } else { Init::Glorot };
        let weights = shapes
            .iter()
            .enumerate()
            .map(|(i, &(a, b))| parameter(init(i).draw(rng, a, b, a * b), [a, b], device))
            .collect();
        let biases = shapes.iter().map(|&(_, b)| parameter(vec![0.0; b], [b], device)).collect();
        Self { weights, biases, spec }
    }

    /// The net's value of every row.
    ///
    /// # Shapes
    /// `x`: `[n, d_in]`, result: `[n, d_out or width]`
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let flat = self.weights.iter().zip(&self.biases).flat_map(|(w, b)| [w.val().flatten::<1>(0, 1), b.val()]);
        kernel::mlp_forward(x, Tensor::cat(flat.collect(), 0), &self.spec)
    }

    /// The net's value of every row `[x, ray]`, where `ray` is the same for all rows of a ray.
    ///
    /// Off the CPU the ray's share of the layers that take it is one product per ray (fact sheet §5.4, items 4 and 5);
    /// the fused CPU kernel takes it row by row.
    ///
    /// # Shapes
    /// `x`: `[r · s, a]`, ray after ray; `ray`: `[r, b]` with a + b = d_in; result: `[r · s, d_out or width]`
    pub fn forward_with_ray(&self, x: Tensor<2>, ray: &Tensor<2>) -> Tensor<2> {
        let flat = self.weights.iter().zip(&self.biases).flat_map(|(w, b)| [w.val().flatten::<1>(0, 1), b.val()]);
        kernel::mlp_forward_with_ray(x, ray, Tensor::cat(flat.collect(), 0), &self.spec)
    }

    /// Columns of the result.
    pub fn d_out(&self) -> usize {
        self.spec.output_size()
    }

    /// Where it lives.
    pub fn device(&self) -> Device {
        self.biases[0].val().device()
    }
}

/// `G` nets of equal shape; net g sees `[shared, own_g]`.
#[derive(Module, Debug)]
pub struct GroupedMlp {
    /// `[G, fan_in, fan_out]` per layer.
    weights: Vec<Param<Tensor<3>>>,
    /// `[G, fan_out]` per layer.
    biases: Vec<Param<Tensor<2>>>,
    #[module(skip)]
    spec: MlpSpec,
}

impl GroupedMlp {
    /// `groups` nets with separate weights.
    pub fn new(
        groups: usize,
        d_in: usize,
        spec: MlpSpec,
        output_init: Init,
        rng: &mut impl Rng,
        device: &Device,
    ) -> Self {
        let shapes: Vec<_> = spec.layers(d_in).collect();
        let init = |i: usize| if i == spec.depth { output_init } else { Init::Glorot };
        let weights = shapes
            .iter()
            .enumerate()
            .map(|(i, &(a, b))| {
                let values = (0..groups).flat_map(|_| init(i).draw(rng, a, b, a * b)).collect();
                parameter(values, [groups, a, b], device)
            })
            .collect();
        let biases = shapes.iter().map(|&(_, b)| parameter(vec![0.0; groups * b], [groups, b], device)).collect();
        Self { weights, biases, spec }
    }

    /// The value of every net for every row, net after net.
    ///
    /// # Shapes
    /// `shared`: `[n, s]`, `own`: `[n, G · o]` with s + o = d_in, result: `[n, G · (d_out or width)]`
    pub fn forward(&self, shared: Tensor<2>, own: Tensor<2>) -> Tensor<2> {
        let flat = self.weights.iter().zip(&self.biases).flat_map(|(w, b)| [w.val().flatten::<2>(1, 2), b.val()]);
        kernel::grouped_mlp_forward(shared, own, Tensor::cat(flat.collect(), 1), &self.spec)
    }
}

/// `G` nets of a trunk and, in the paper's form, one narrower layer that sees the input again.
#[derive(Module, Debug)]
pub struct BranchedNets {
    trunk: GroupedMlp,
    branch: Option<GroupedMlp>,
    #[module(skip)]
    groups: usize,
    #[module(skip)]
    size: BranchedSize,
}

/// The shapes of trunk and branch of a net with `d_in` inputs and `outputs` outputs, with the branch's inputs.
pub(crate) fn branched_specs(
    d_in: usize,
    size: BranchedSize,
    outputs: usize,
    products: Products,
) -> (MlpSpec, Option<(usize, MlpSpec)>) {
    let BranchedSize { trunk, branch, branch_skip } = size;
    if branch == 0 {
        return (spec(trunk, Some(outputs), products), None);
    }
    let seen = trunk.width + if branch_skip { d_in } else { 0 };
    let branch = MlpSpec { depth: 1, width: branch, skip: None, output: Some(outputs), products };
    (spec(trunk, None, products), Some((seen, branch)))
}

impl BranchedNets {
    /// `groups` nets on `[shared, own_g]`, of which `own` columns are each net's own.
    pub fn new(
        groups: usize,
        d_in: usize,
        (size, products): (BranchedSize, Products),
        outputs: usize,
        rng: &mut impl Rng,
        device: &Device,
    ) -> Self {
        let (trunk, branch) = branched_specs(d_in, size, outputs, products);
        Self {
            trunk: GroupedMlp::new(groups, d_in, trunk, Init::Glorot, rng, device),
            branch: branch.map(|(seen, branch)| GroupedMlp::new(groups, seen, branch, Init::Glorot, rng, device)),
            groups,
            size,
        }
    }

    /// The outputs of every net and row, net after net.
    ///
    /// # Shapes
    /// `shared`: `[n, s]`, `own`: `[n, G · o]`, result: `[n, G · outputs]`
    pub fn forward(&self, shared: Tensor<2>, own: Tensor<2>) -> Tensor<2> {
        let hidden = self.trunk.forward(shared.clone(), own.clone());
        let Some(branch) = &self.branch else { return hidden };
        let [n, own_width] = own.dims();
        let (g, o, width) = (self.groups, own_width / self.groups, self.size.trunk.width);
        if !self.size.branch_skip {
            return branch.forward(Tensor::zeros([n, 0], (&hidden.device(), hidden.dtype())), hidden);
        }
        // Per net [h, own]; the shared part comes in again on its own side. The order of inputs only permutes rows
        // of the branch's first kernel.
        let own = Tensor::cat(vec![hidden.reshape([n, g, width]), own.reshape([n, g, o])], 2);
        branch.forward(shared, own.reshape([n, g * (width + o)]))
    }
}
