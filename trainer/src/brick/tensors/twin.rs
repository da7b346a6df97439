//! The operation as it reads, on Burn tensors: every sample of every ray looked up, passed through the networks and
//! composited, a matrix at a time. Slow, on any device and in any precision; its gradient is Burn's.
//!
//! What has no gradient is worked out on the host: where samples stand, which corners surround them.

use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use risorius_brick::Brick;
use risorius_brick::batch::RayBatch;
use risorius_brick::expression::{CHANNELS, HARD, MASKS, REACH, REST};
use risorius_brick::field::{COLOR_INPUT, FEATURES, Field, HIDDEN, INPUT, LEVELS, MIDDLE, OUTPUT};
use risorius_brick::lattice::{BRICK, EDGE, Lattice};
use risorius_brick::march::March;
use risorius_brick::math::{DENSITY_CLAMP, DENSITY_SHIFT};
use risorius_brick::model::LATENT;
use risorius_brick::occupancy::Occupancy;
use risorius_brick::table::Table;

use super::RayScene;

/// Behind a head that lets less than this through, the background is not looked at.
const BACKGROUND_FROM: f64 = 1.0 / 640.0;

/// Twin of the fused operation: `[rays, COLUMNS]`.
pub(super) fn render(
    scene: &RayScene,
    parameters: &Tensor<1>,
    activations: &Tensor<1>,
    motion: &Tensor<1>,
    batch: &RayBatch,
) -> Tensor<2> {
    scene.shape(|model| {
        Twin { model, batch, device: parameters.device(), dtype: parameters.dtype() }.render(
            parameters,
            activations,
            motion,
        )
    })
}

struct Twin<'a> {
    model: &'a Brick,
    batch: &'a RayBatch,
    device: Device,
    dtype: DType,
}

/// The samples of one part of the scene.
struct Walk {
    /// Box coordinates of each.
    points: Vec<f32>,
    /// Its ray.
    ray: Vec<usize>,
    /// How far along it.
    along: Vec<f32>,
    /// Samples of the longest ray.
    most: usize,
    /// Number of the sample at each place of a `[rays, most]` matrix, and one more than there are where there is none.
    places: Vec<i64>,
}

/// What one part shows along each ray.
struct Part {
    /// `[rays, most]`
    weights: Tensor<2>,
    /// `[rays, 3]`
    color: Tensor<2>,
    /// `[rays, 1]`
    left: Tensor<2>,
    /// `[rays, 1]`
    regular: Tensor<2>,
}

/// How the parts' regularisers weigh.
#[derive(Clone, Copy)]
struct Holds {
    step: f64,
    haze: f64,
    spread: f64,
}

/// A tensor's numbers.
fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.detach().into_data().iter::<f64>().collect()
}

/// A column of a matrix.
fn column(matrix: &Tensor<2>, i: usize) -> Tensor<2> {
    matrix.clone().narrow(1, i, 1)
}

/// A product that gives `value` and passes gradients to `of` times `slope`.
fn straight(value: Tensor<2>, of: Tensor<2>) -> Tensor<2> {
    value.detach() + of.clone() - of.detach()
}

impl Twin<'_> {
    fn matrix(&self, values: Vec<f32>, width: usize) -> Tensor<2> {
        let rows = values.len() / width;
        Tensor::from_data(TensorData::new(values, [rows, width]), (&self.device, self.dtype))
    }

    fn index(&self, values: Vec<i64>) -> Tensor<1, Int> {
        let count = values.len();
        Tensor::from_data(TensorData::new(values, [count]), &self.device)
    }

    fn render(&self, parameters: &Tensor<1>, activations: &Tensor<1>, motion: &Tensor<1>) -> Tensor<2> {
        let Self { model, batch, .. } = self;
        let rays = batch.directions.len();
        let mut numbers = Cut { flat: parameters, at: 0 };
        let head = numbers.field(&model.head.field);
        let background = model.background.as_ref().map(|part| numbers.field(&part.field));
        let residuals = numbers.matrices(&model.expression.residuals, CHANNELS);
        let masks = numbers.matrix(&model.expression.masks, MASKS);
        let bases = numbers.matrices(&model.latent_bases, 4);

        let gates = self.gates(&masks);
        let blend = self.blend(&gates, &residuals, activations);
        let code = activations.clone().narrow(0, activations.dims()[0] - LATENT, LATENT);
        let latent = bases.into_iter().enumerate().map(|(j, basis)| basis * one(&code, j)).reduce(|a, b| a + b);

        let own: Vec<f32> = host(motion.clone()).into_iter().map(|v| v as f32).collect();
        let walk = self.walk(&model.head.occupancy, |ray| {
            let jitter = batch.jitter.get(ray).copied().unwrap_or(0.5);
            Some(model.head_march(batch.origin, batch.directions[ray], Some(&own), batch.divisions, jitter))
        });
        let here = self.moved(&walk, motion);
        // What an expression does to a sample is looked up where it stands, whatever moves it.
        let fixed = here.clone().detach();
        let shift = look_up(self, &blend, &model.expression.lattice, &fixed);
        let mut warped = here.clone() + shift.clone().narrow(1, 4, 3);
        if let Some(latent) = &latent {
            warped = warped + look_up(self, latent, &model.latent_lattice, &fixed).narrow(1, 0, 3);
        }
        let features = Tensor::cat(vec![shift.clone().narrow(1, 0, 4), column(&shift, 7)], 1);
        let (sigma, color) = self.evaluate(&model.head.field, &head, &warped, Some(features), &walk);
        let holds = Holds {
            step: 2.0 / batch.divisions as f64,
            haze: f64::from(batch.haze[0]),
            spread: f64::from(batch.spread[0]),
        };
        let through = Tensor::<2>::ones([rays, 1], (&self.device, self.dtype));
        let shown = self.composite(&walk, &sigma, &color, holds, through);

        let found = self.padded(&look_up(self, &gates, &model.expression.lattice, &fixed), &walk);
        let weights = shown.weights.clone().detach().unsqueeze_dim::<3>(2);
        let masks = (weights * found).sum_dim(1).squeeze_dim::<2>(1);
        let along = self.padded(&self.matrix(walk.along.clone(), 1), &walk).squeeze_dim::<2>(2);
        let half = f64::from(model.layout.head_box.half);
        let depth =
            Tensor::cat(vec![(shown.weights.clone() * along).sum_dim(1) * half, shown.weights.clone().sum_dim(1)], 1);
        let (mut color, mut left, mut regular) = (shown.color, shown.left, shown.regular);
        if let (Some(part), Some(frame), Some(numbers)) = (&model.background, &model.layout.background, &background) {
            let seen = host(left.clone());
            let from = if batch.opaque > 0.0 { BACKGROUND_FROM } else { -1.0 };
            let eye = frame.camera_from_world(batch.origin);
            let walk = self.walk(&part.occupancy, |ray| {
                let jitter = batch.jitter.get(ray).copied().unwrap_or(0.5);
                let march = frame.march(eye, frame.turn(batch.directions[ray]), batch.planes, jitter);
                march.filter(|_| seen[ray] > from)
            });
            let here = self.matrix(walk.points.clone(), 3);
            let (sigma, own) = self.evaluate(&part.field, numbers, &here, None, &walk);
            let holds = Holds {
                step: 2.0 / batch.planes as f64,
                haze: f64::from(batch.haze[1]),
                spread: f64::from(batch.spread[1]),
            };
            let shown = self.composite(&walk, &sigma, &own, holds, left);
            (color, left, regular) = (color + shown.color, shown.left, regular + shown.regular);
        }
        Tensor::cat(vec![color, left, masks, depth, regular], 1)
    }

    /// Masks at the vertices: 0 below HARD, with the soft mask's slope all the same.
    fn gates(&self, logits: &Tensor<2>) -> Tensor<2> {
        let allowed = &self.model.expression.allowed;
        let bits = |from: usize, to: usize| -> Vec<f32> {
            let bit = |bits: u8, n: usize| if (from..to).contains(&n) { f32::from(bits >> n & 1) } else { 0.0 };
            allowed.iter().flat_map(|&bits| (0..MASKS).map(move |n| bit(bits, n))).collect()
        };
        let soft = sigmoid(logits.clone());
        let hard = soft.clone().mask_fill(soft.clone().lower_scalar(f64::from(HARD)), 0.0);
        let slope = (soft.clone() * (soft.neg() + 1.0)).clamp_min(1e-3).detach();
        let masks = straight(hard, slope * logits.clone());
        masks * self.matrix(bits(0, REST), MASKS) + self.matrix(bits(REST, MASKS), MASKS)
    }

    /// B: what activations and masks make of the residuals. Masks learn nothing from it.
    fn blend(&self, gates: &Tensor<2>, residuals: &[Tensor<2>], activations: &Tensor<1>) -> Tensor<2> {
        let expression = &self.model.expression;
        let vertices = expression.lattice.slots * BRICK;
        let reach = ((gates.clone().detach() - f64::from(REACH)) / f64::from(1.0 - REACH)).clamp_min(0.0);
        let mut sum = Tensor::<2>::zeros([vertices, CHANNELS], (&self.device, self.dtype));
        for (k, (residual, &region)) in residuals.iter().zip(&expression.region_of).enumerate() {
            // The row of each vertex in memory, and that of zeros where the region has none.
            let rows = residual.dims()[0];
            let mut row = vec![rows as i64; vertices];
            for (block, &slot) in expression.slots_of[region].iter().enumerate() {
                for i in 0..BRICK {
                    row[slot as usize * BRICK + i] = (block * BRICK + i) as i64;
                }
            }
            let none = Tensor::zeros([1, CHANNELS], (&self.device, self.dtype));
            let everywhere = Tensor::cat(vec![residual.clone(), none], 0).select(0, self.index(row));
            sum = sum + everywhere * column(&reach, region) * one(activations, k);
        }
        sum
    }

    /// Samples where something is, ray by ray.
    fn walk(&self, occupancy: &Occupancy, march: impl Fn(usize) -> Option<March>) -> Walk {
        let rays = self.batch.directions.len();
        let mut walk = Walk { points: Vec::new(), ray: Vec::new(), along: Vec::new(), most: 1, places: Vec::new() };
        let mut counts = vec![0; rays];
        for (ray, count) in counts.iter_mut().enumerate() {
            let mut march = march(ray);
            while let Some((p, t)) = march.as_mut().and_then(March::next_anywhere) {
                if occupancy.holds(p) {
                    walk.points.extend(p);
                    walk.ray.push(ray);
                    walk.along.push(t);
                    *count += 1;
                }
            }
        }
        walk.most = counts.iter().copied().max().unwrap_or(0).max(1);
        walk.places = vec![walk.ray.len() as i64; rays * walk.most];
        let mut first = 0;
        for (ray, count) in counts.into_iter().enumerate() {
            for i in 0..count {
                walk.places[ray * walk.most + i] = (first + i) as i64;
            }
            first += count;
        }
        walk
    }

    /// The head's samples, which a further turn w and shift v would take to p + w × p + v.
    fn moved(&self, walk: &Walk, motion: &Tensor<1>) -> Tensor<2> {
        let p = self.matrix(walk.points.clone(), 3);
        let motion = motion.clone() - motion.clone().detach();
        let [x, y, z] = [0, 1, 2].map(|a| column(&p, a));
        let [wx, wy, wz, vx, vy, vz] = [0, 1, 2, 3, 4, 5].map(|i| one(&motion, i));
        let turned = vec![
            wy.clone() * z.clone() - wz.clone() * y.clone() + vx,
            wz * x.clone() - wx.clone() * z + vy,
            wx * y - wy * x + vz,
        ];
        p + Tensor::cat(turned, 1)
    }

    /// `[samples, channels]` as `[rays, most, channels]`, 0 where there is no sample.
    fn padded(&self, values: &Tensor<2>, walk: &Walk) -> Tensor<3> {
        let channels = values.dims()[1];
        let none = Tensor::zeros([1, channels], (&self.device, self.dtype));
        let rays = self.batch.directions.len();
        Tensor::cat(vec![values.clone(), none], 0)
            .select(0, self.index(walk.places.clone()))
            .reshape([rays, walk.most, channels])
    }

    /// Density and colour of the samples at `points`.
    fn evaluate(
        &self,
        field: &Field,
        (levels, net): &(Vec<Tensor<2>>, Tensor<1>),
        points: &Tensor<2>,
        expression: Option<Tensor<2>>,
        walk: &Walk,
    ) -> (Tensor<2>, Tensor<2>) {
        let count = walk.ray.len();
        let zeros = |width: usize| Tensor::<2>::zeros([count, width], (&self.device, self.dtype));
        let mut input: Vec<Tensor<2>> = (0..LEVELS)
            .map(|l| if l < field.live { look_up(self, &levels[l], &field.levels[l], points) } else { zeros(FEATURES) })
            .collect();
        input.push(expression.unwrap_or_else(|| zeros(5)));
        input.push(Tensor::ones([count, 1], (&self.device, self.dtype)));
        input.push(zeros(INPUT - LEVELS * FEATURES - 6));
        let mut at = 0;
        let mut layer = |inputs: usize, outputs: usize| -> Tensor<2> {
            at += inputs * outputs;
            net.clone().narrow(0, at - inputs * outputs, inputs * outputs).reshape([inputs, outputs])
        };
        let hidden = relu(Tensor::cat(input, 1).matmul(layer(INPUT, HIDDEN)));
        let middle = hidden.matmul(layer(HIDDEN, MIDDLE));
        let raw = column(&middle, 0) - f64::from(DENSITY_SHIFT);
        let sigma = straight(raw.clone().clamp_max(f64::from(DENSITY_CLAMP)), raw).exp();
        let seen: Vec<f32> = walk
            .ray
            .iter()
            .flat_map(|&ray| {
                let [x, y, z] = self.batch.directions[ray];
                [x, y, z, x * y, y * z, x * z, x * x, y * y]
            })
            .collect();
        let input = vec![
            Tensor::ones([count, 1], (&self.device, self.dtype)),
            middle.narrow(1, 1, MIDDLE - 1),
            self.matrix(seen, COLOR_INPUT - MIDDLE),
        ];
        let hidden = relu(Tensor::cat(input, 1).matmul(layer(COLOR_INPUT, HIDDEN)));
        let color = sigmoid(hidden.matmul(layer(HIDDEN, OUTPUT)).narrow(1, 0, 3));
        (sigma, color)
    }

    /// Samples along rays that let `through` through, front to back.
    fn composite(&self, walk: &Walk, sigma: &Tensor<2>, color: &Tensor<2>, holds: Holds, through: Tensor<2>) -> Part {
        let sigma = self.padded(sigma, walk).squeeze_dim::<2>(2);
        let color = self.padded(color, walk);
        let depth = sigma.clone() * holds.step;
        let in_front = |depth: &Tensor<2>| depth.clone().cumsum(1) - depth.clone();
        let before = (through.clone() * in_front(&depth).neg().exp()).detach();
        let goes_on = before.greater_equal_scalar(f64::from(self.batch.opaque)).float().cast(self.dtype);
        let depth = depth * goes_on.clone();
        let weights = through.clone() * in_front(&depth).neg().exp() * (depth.clone().neg().exp().neg() + 1.0);
        let shown = (weights.clone().unsqueeze_dim::<3>(2) * color).sum_dim(1).squeeze_dim::<2>(1);
        let haze = ((sigma.clone() * sigma * 2.0).log1p() * goes_on).sum_dim(1) * holds.haze;
        let along = self.padded(&self.matrix(walk.along.clone(), 1), walk);
        let apart = (along.clone() - along.swap_dims(1, 2)).abs();
        let pairs = weights.clone().unsqueeze_dim::<3>(2) * weights.clone().unsqueeze_dim::<3>(1) * apart;
        let pairs = pairs.sum_dim(2).squeeze_dim::<2>(2).sum_dim(1);
        let own = (weights.clone() * weights.clone()).sum_dim(1) * (holds.step / 3.0);
        let left = through * depth.sum_dim(1).neg().exp();
        Part { weights, color: shown, left, regular: haze + (pairs + own) * holds.spread }
    }
}

/// A vector's number as a matrix.
fn one(vector: &Tensor<1>, i: usize) -> Tensor<2> {
    vector.clone().narrow(0, i, 1).reshape([1, 1])
}

/// Tables cut from one tensor, in the order of [`Brick::shown_by`].
struct Cut<'a> {
    flat: &'a Tensor<1>,
    at: usize,
}

impl Cut<'_> {
    fn vector(&mut self, table: &Table) -> Tensor<1> {
        let from = self.at;
        self.at += table.values.len();
        self.flat.clone().narrow(0, from, table.values.len())
    }

    fn matrix(&mut self, table: &Table, width: usize) -> Tensor<2> {
        self.vector(table).reshape([table.values.len() / width, width])
    }

    fn matrices(&mut self, tables: &[Table], width: usize) -> Vec<Tensor<2>> {
        tables.iter().map(|table| self.matrix(table, width)).collect()
    }

    /// Levels and network.
    fn field(&mut self, field: &Field) -> (Vec<Tensor<2>>, Tensor<1>) {
        (self.matrices(&field.features, FEATURES), self.vector(&field.net))
    }
}

/// Σ weight · row over the corners around each point.
fn look_up(twin: &Twin<'_>, table: &Tensor<2>, lattice: &Lattice, points: &Tensor<2>) -> Tensor<2> {
    let values = host(points.clone());
    let count = values.len() / 3;
    let last = lattice.vertices.map(|n| (n - 1) as f64);
    let [nx, ny, _] = lattice.bricks();
    let mut bases = vec![0.0f32; values.len()];
    let mut corners = vec![Vec::new(); 8];
    for (p, base) in values.as_chunks::<3>().0.iter().zip(bases.as_chunks_mut::<3>().0) {
        let at: [usize; 3] =
            std::array::from_fn(|a| ((p[a] + 1.0) * last[a] * 0.5).clamp(0.0, last[a] - 1e-3) as usize);
        *base = at.map(|v| v as f32);
        for (k, corner) in corners.iter_mut().enumerate() {
            let v = [at[0] + (k & 1), at[1] + (k >> 1 & 1), at[2] + (k >> 2)];
            let brick = (v[2] / EDGE * ny + v[1] / EDGE) * nx + v[0] / EDGE;
            let inside = (v[2] % EDGE * EDGE + v[1] % EDGE) * EDGE + v[0] % EDGE;
            corner.push((lattice.slot[brick] as usize * BRICK + inside) as i64);
        }
    }
    let base = twin.matrix(bases, 3);
    let t = [0, 1, 2].map(|a| {
        let place = ((column(points, a) + 1.0) * (last[a] * 0.5)).clamp(0.0, last[a] - 1e-3);
        place - column(&base, a)
    });
    let mut sum = Tensor::<2>::zeros([count, table.dims()[1]], (&twin.device, twin.dtype));
    for (k, corner) in corners.into_iter().enumerate() {
        let side = |a: usize| if k >> a & 1 == 1 { t[a].clone() } else { t[a].clone().neg() + 1.0 };
        sum = sum + table.clone().select(0, twin.index(corner)) * (side(0) * side(1) * side(2));
    }
    sum
}
