//! The slow, readable twin of everything in `rays` and `evaluate`, in f64: what a ray shows, by the book.
//!
//! Tests compare the kernels with it, and their gradients with its finite differences: [`Twin::nudge`] moves one number
//! of the model. Nothing is skipped here but what the definition skips: samples in empty cells and behind the point
//! where a ray counts as opaque.

use crate::expression::{CHANNELS, HARD, MASKS, REACH, REST};
use crate::field::{COLOR_INPUT, EXPRESSION_AT, FEATURES, Field, HIDDEN, INPUT, LAYER, MIDDLE, ONE_AT, OUTPUT};
use crate::lattice::{BRICK, EDGE, Lattice};
use crate::math::{DENSITY_CLAMP, DENSITY_SHIFT};
use crate::model::{Brick, LATENT};

/// A table of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which {
    /// Features of a level of the head.
    HeadLevel(usize),
    /// The head's network.
    HeadNet,
    /// Features of a level of the background.
    BackgroundLevel(usize),
    /// The background's network.
    BackgroundNet,
    /// Residuals of an AU, or of a latent number after the AUs.
    Residual(usize),
    /// A latent displacement.
    LatentBasis(usize),
    /// The activations, then the latent code.
    Activation,
    /// The camera's turn and shift.
    Motion,
}

/// The model as the twin sees it.
#[derive(Clone, Debug)]
pub struct Twin<'a> {
    /// The avatar.
    pub model: &'a Brick,
    /// Activations of the AUs, then the latent code.
    pub activations: Vec<f64>,
    /// The camera's turn and shift, box units.
    pub motion: [f64; 6],
    /// A number to move, and by how much.
    pub nudge: Option<(Which, usize, f64)>,
    /// Samples along the head box's edge.
    pub divisions: usize,
    /// Planes of the background.
    pub planes: usize,
    /// Transmittance below which a ray is over.
    pub opaque: f64,
}

type V3 = [f64; 3];

/// One sample: where along the ray, density, colour, masks.
struct Seen {
    along: f64,
    step: f64,
    density: f64,
    color: V3,
    masks: [f64; MASKS],
}

/// What a ray shows.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Colour without what is behind everything.
    pub color: V3,
    /// Transmittance behind everything.
    pub left: f64,
    /// Masks.
    pub masks: [f64; MASKS],
    /// Σ w_i w_j |t_i − t_j| + ⅓ Σ w_i² step of head and background.
    pub spread: [f64; 2],
}

impl Twin<'_> {
    fn nudged(&self, which: Which, index: usize, value: f64) -> f64 {
        match self.nudge {
            Some((w, i, d)) if w == which && i == index => value + d,
            _ => value,
        }
    }

    fn activation(&self, k: usize) -> f64 {
        self.nudged(Which::Activation, k, self.activations[k])
    }

    /// Σ weight · value(vertex in memory) over the corners of `p`.
    fn interpolate<const C: usize>(lattice: &Lattice, p: V3, value: impl Fn(usize) -> [f64; C]) -> [f64; C] {
        let mut base = [0usize; 3];
        let mut t = [0.0; 3];
        for a in 0..3 {
            let last = (lattice.vertices[a] - 1) as f64;
            let q = ((p[a] + 1.0) * last * 0.5).clamp(0.0, last - 1e-3);
            base[a] = q as usize;
            t[a] = q - base[a] as f64;
        }
        let [nx, ny, _] = lattice.bricks();
        let mut sum = [0.0; C];
        for corner in 0..8 {
            let side = [corner & 1, corner >> 1 & 1, corner >> 2];
            let v: [usize; 3] = std::array::from_fn(|a| base[a] + side[a]);
            let weight: f64 = (0..3).map(|a| if side[a] == 1 { t[a] } else { 1.0 - t[a] }).product();
            let brick = (v[2] / EDGE * ny + v[1] / EDGE) * nx + v[0] / EDGE;
            let vertex = lattice.slot[brick] as usize * BRICK + (v[2] % EDGE * EDGE + v[1] % EDGE) * EDGE + v[0] % EDGE;
            for (s, x) in sum.iter_mut().zip(value(vertex)) {
                *s += weight * x;
            }
        }
        sum
    }

    /// m_n at a vertex.
    fn gate(&self, vertex: usize, n: usize) -> f64 {
        let e = &self.model.expression;
        if e.allowed[vertex] >> n & 1 == 0 {
            return 0.0;
        }
        if n == REST {
            return 1.0;
        }
        let m = 1.0 / (1.0 + (-f64::from(e.masks.values[vertex * MASKS + n])).exp());
        if m < f64::from(HARD) { 0.0 } else { m }
    }

    /// B at a vertex.
    fn blend(&self, vertex: usize) -> [f64; CHANNELS] {
        let e = &self.model.expression;
        let (slot, inside) = (vertex / BRICK, vertex % BRICK);
        let mut sum = [0.0; CHANNELS];
        for (k, &n) in e.region_of.iter().enumerate() {
            let Some(block) = e.slots_of[n].iter().position(|&s| s as usize == slot) else { continue };
            let weight =
                self.activation(k) * ((self.gate(vertex, n) - f64::from(REACH)) / f64::from(1.0 - REACH)).max(0.0);
            for (c, sum) in sum.iter_mut().enumerate() {
                let i = (block * BRICK + inside) * CHANNELS + c;
                *sum += weight * self.nudged(Which::Residual(k), i, f64::from(e.residuals[k].values[i]));
            }
        }
        sum
    }

    fn layer(&self, which: Which, field: &Field, layer: usize, input: &[f64], outputs: usize, relu: bool) -> Vec<f64> {
        (0..outputs)
            .map(|o| {
                let sum: f64 = input
                    .iter()
                    .enumerate()
                    .map(|(i, x)| {
                        let at = LAYER[layer] + i * outputs + o;
                        x * self.nudged(which, at, f64::from(field.net.values[at]))
                    })
                    .sum();
                if relu { sum.max(0.0) } else { sum }
            })
            .collect()
    }

    /// Density and colour of a field at a point whose expression features are given.
    fn evaluate(&self, head: bool, field: &Field, p: V3, features: [f64; 5], direction: V3) -> (f64, V3) {
        let mut input = vec![0.0; INPUT];
        for l in 0..field.live {
            let which = if head { Which::HeadLevel(l) } else { Which::BackgroundLevel(l) };
            let found: [f64; FEATURES] = Self::interpolate(&field.levels[l], p, |vertex| {
                std::array::from_fn(|c| {
                    let i = vertex * FEATURES + c;
                    self.nudged(which, i, f64::from(field.features[l].values[i]))
                })
            });
            input[l * FEATURES..(l + 1) * FEATURES].copy_from_slice(&found);
        }
        input[EXPRESSION_AT..EXPRESSION_AT + 5].copy_from_slice(&features);
        input[ONE_AT] = 1.0;
        let net = if head { Which::HeadNet } else { Which::BackgroundNet };
        let hidden = self.layer(net, field, 0, &input, HIDDEN, true);
        let middle = self.layer(net, field, 1, &hidden, MIDDLE, false);
        let mut colors = middle.clone();
        colors[0] = 1.0;
        let [x, y, z] = direction;
        colors.extend([x, y, z, x * y, y * z, x * z, x * x, y * y]);
        debug_assert_eq!(colors.len(), COLOR_INPUT, "inputs of the colour part");
        let hidden = self.layer(net, field, 2, &colors, HIDDEN, true);
        let out = self.layer(net, field, 3, &hidden, OUTPUT, false);
        let density = (middle[0] - f64::from(DENSITY_SHIFT)).min(f64::from(DENSITY_CLAMP)).exp();
        (density, std::array::from_fn(|c| 1.0 / (1.0 + (-out[c]).exp())))
    }

    fn head_sample(&self, p: V3, direction: V3) -> (f64, V3, [f64; MASKS]) {
        let e = &self.model.expression;
        let b: [f64; CHANNELS] = Self::interpolate(&e.lattice, p, |v| self.blend(v));
        let masks = Self::interpolate(&e.lattice, p, |v| std::array::from_fn(|n| self.gate(v, n)));
        let own: [f64; 4] = Self::interpolate(&self.model.latent_lattice, p, |v| {
            std::array::from_fn(|c| {
                (0..LATENT)
                    .map(|j| {
                        let value = f64::from(self.model.latent_bases[j].values[v * 4 + c]);
                        let code = self.activation(self.activations.len() - LATENT + j);
                        code * self.nudged(Which::LatentBasis(j), v * 4 + c, value)
                    })
                    .sum()
            })
        });
        let warped = std::array::from_fn(|a| p[a] + b[4 + a] + own[a]);
        let (density, color) =
            self.evaluate(true, &self.model.head.field, warped, [b[0], b[1], b[2], b[3], b[7]], direction);
        (density, color, masks)
    }

    /// What a world ray shows; samples stand in the middle of their steps.
    pub fn ray(&self, origin: [f32; 3], direction: [f32; 3]) -> Ray {
        let world = direction.map(f64::from);
        let head = self.head_samples(origin, world);
        let mut ray = Ray { color: [0.0; 3], left: 1.0, masks: [0.0; MASKS], spread: [0.0; 2] };
        ray.spread[0] = composite(&head, &mut ray, self.opaque);
        if ray.left > 1.0 / 640.0 {
            let background = self.background_samples(origin, direction);
            ray.spread[1] = composite(&background, &mut ray, self.opaque);
        }
        ray
    }

    fn head_samples(&self, origin: [f32; 3], world: V3) -> Vec<Seen> {
        let layout = &self.model.layout.head_box;
        let motion: [f64; 6] = std::array::from_fn(|i| self.nudged(Which::Motion, i, self.motion[i]));
        let turn = |p: V3| rotate([motion[0], motion[1], motion[2]], p);
        let start: V3 = std::array::from_fn(|a| f64::from((origin[a] - layout.center[a]) / layout.half));
        let start = turn(start);
        let start: V3 = std::array::from_fn(|a| start[a] + motion[3 + a]);
        let direction = turn(world);
        let (mut enter, mut exit) = (0.0f64, f64::MAX);
        for a in 0..3 {
            let (t0, t1) = ((-1.0 - start[a]) / direction[a], (1.0 - start[a]) / direction[a]);
            enter = enter.max(t0.min(t1));
            exit = exit.min(t0.max(t1));
        }
        let step = 2.0 / self.divisions as f64;
        let mut out = Vec::new();
        let mut t = enter + 0.5 * step;
        while t < exit {
            let p: V3 = std::array::from_fn(|a| start[a] + t * direction[a]);
            if self.model.head.occupancy.holds(p.map(|v| v as f32)) {
                let (density, color, masks) = self.head_sample(p, world);
                out.push(Seen { along: t, step, density, color, masks });
            }
            t += step;
        }
        out
    }

    fn background_samples(&self, origin: [f32; 3], direction: [f32; 3]) -> Vec<Seen> {
        let (Some(part), Some(frame)) = (&self.model.background, &self.model.layout.background) else {
            return Vec::new();
        };
        let (from, turned) = (frame.camera_from_world(origin), frame.turn(direction));
        if turned[2] <= 0.05 {
            return Vec::new();
        }
        let (from, turned) = (from.map(f64::from), turned.map(f64::from));
        let (near, far) = (1.0 / f64::from(frame.near), 1.0 / f64::from(frame.far));
        let step = 2.0 / self.planes as f64;
        (0..self.planes)
            .filter_map(|plane| {
                // Where the ray meets the plane of this nearness, by the book.
                let s = 1.0 - (plane as f64 + 0.5) * step;
                let depth = 2.0 / ((near + far) + s * (near - far));
                let t = (depth - from[2]) / turned[2];
                let inside = |a: usize| {
                    let slope = (from[a] + t * turned[a]) / depth;
                    (slope - f64::from(frame.middle[a])) / f64::from(frame.extent[a])
                };
                let p = [inside(0), inside(1), s];
                part.occupancy.holds(p.map(|v| v as f32)).then(|| {
                    let (density, color) = self.evaluate(false, &part.field, p, [0.0; 5], direction.map(f64::from));
                    Seen { along: -s, step, density, color, masks: [0.0; MASKS] }
                })
            })
            .collect()
    }
}

/// Adds samples to a ray, front to back; gives the spread of their weights.
fn composite(samples: &[Seen], ray: &mut Ray, opaque: f64) -> f64 {
    let mut weights = Vec::new();
    for s in samples {
        if ray.left < opaque {
            break;
        }
        let alpha = 1.0 - (-s.density * s.step).exp();
        let w = ray.left * alpha;
        for c in 0..3 {
            ray.color[c] += w * s.color[c];
        }
        for (m, v) in ray.masks.iter_mut().zip(s.masks) {
            *m += w * v;
        }
        ray.left *= 1.0 - alpha;
        weights.push((w, s.along, s.step));
    }
    let pairs: f64 = weights.iter().map(|a| weights.iter().map(|b| a.0 * b.0 * (a.1 - b.1).abs()).sum::<f64>()).sum();
    pairs + weights.iter().map(|w| w.0 * w.0 * w.2).sum::<f64>() / 3.0
}

/// Rodrigues' rotation.
fn rotate(w: V3, p: V3) -> V3 {
    let angle = (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]).sqrt();
    if angle == 0.0 {
        return p;
    }
    let k = w.map(|v| v / angle);
    let cross = [k[1] * p[2] - k[2] * p[1], k[2] * p[0] - k[0] * p[2], k[0] * p[1] - k[1] * p[0]];
    let dot = k[0] * p[0] + k[1] * p[1] + k[2] * p[2];
    let (sin, cos) = angle.sin_cos();
    std::array::from_fn(|a| p[a] * cos + cross[a] * sin + k[a] * dot * (1.0 - cos))
}
