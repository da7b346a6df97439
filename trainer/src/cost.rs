//! What a fit costs, counted from the sizes alone (fact sheet §5): parameters, multiply-accumulates, memory.

use std::ops::Range;

use serde::Serialize;

use crate::config::{BranchedSize, FitSettings, MaskKind, ModelConfig, SliceKind};
use crate::encoding;
use crate::kernel::{MlpSpec, Products};
use crate::mlp::{branched_specs, spec};
use crate::model::hyper_width;

/// The cost of some networks: weights, and per sample (or per ray) multiply-accumulates and neurons.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct NetCost {
    /// Trainable numbers.
    pub parameters: usize,
    /// Multiply-accumulates of the dense layers, forward.
    pub macs: usize,
    /// Outputs of all layers: what a backward pass without recomputation keeps.
    pub neurons: usize,
    /// Numbers that go in and come out: what one that recomputes the layers keeps.
    pub ends: usize,
}

impl NetCost {
    fn of(inputs: usize, spec: &MlpSpec) -> Self {
        Self {
            parameters: spec.parameter_count(inputs),
            macs: spec.layers(inputs).map(|(a, b)| a * b).sum(),
            neurons: spec.layers(inputs).map(|(_, b)| b).sum(),
            ends: inputs + spec.output_size(),
        }
    }

    /// `count` equal networks, of whose inputs `shared` are the same for all.
    fn grouped(count: usize, shared: usize, own: usize, spec: &MlpSpec) -> Self {
        let one = Self::of(shared + own, spec);
        Self {
            parameters: one.parameters * count,
            macs: one.macs * count,
            neurons: one.neurons * count,
            ends: shared + (own + spec.output_size()) * count,
        }
    }

    fn branched(count: usize, shared: usize, own: usize, size: BranchedSize, outputs: usize) -> Self {
        let (trunk, branch) = branched_specs(shared + own, size, outputs, Products::default());
        let trunk = Self::grouped(count, shared, own, &trunk);
        let Some((seen, branch)) = branch else { return trunk };
        // The shared input is kept once, for both.
        let branch_shared = if size.branch_skip { shared } else { 0 };
        let mut branch = Self::grouped(count, branch_shared, seen - branch_shared, &branch);
        branch.ends -= branch_shared;
        trunk + branch
    }
}

impl std::ops::Add for NetCost {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            parameters: self.parameters + other.parameters,
            macs: self.macs + other.macs,
            neurons: self.neurons + other.neurons,
            ends: self.ends + other.ends,
        }
    }
}

impl std::iter::Sum for NetCost {
    fn sum<I: Iterator<Item = Self>>(costs: I) -> Self {
        costs.fold(Self::default(), |a, b| a + b)
    }
}

/// The networks of one level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct LevelCost {
    /// F.
    pub template: NetCost,
    /// M.
    pub masks: NetCost,
    /// B.
    pub uncertainty: NetCost,
}

/// The networks of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ModelCost {
    /// Numbers of the latent table.
    pub latent: usize,
    /// A, per ray.
    pub attribute: NetCost,
    /// T, per sample.
    pub deformation: NetCost,
    /// H, per sample.
    pub slices: NetCost,
    /// Of the coarse level.
    pub coarse: LevelCost,
    /// Of the fine level.
    pub fine: LevelCost,
}

impl ModelCost {
    /// The cost of a model for `frames` frames and these regions.
    pub fn of(config: &ModelConfig, groups: &[Range<usize>], frames: usize) -> Self {
        let c = config;
        let spec = |size, output| spec(size, output, c.products);
        let k = groups.last().map_or(0, |g| g.end);
        let position = encoding::width(3, c.template_bands, true);
        let component = encoding::width(c.hyper_dims, c.hyper_bands, false);
        let sheet_position = encoding::width(3, c.sheet_bands, false);
        let sheet = |count, own| NetCost::grouped(count, sheet_position, own, &spec(c.sheet, Some(c.hyper_dims)));
        let only = |wanted: bool, cost: NetCost| if wanted { cost } else { NetCost::default() };
        let slices = match c.kind.slices() {
            SliceKind::PerAttribute => sheet(k, 1) + sheet(1, c.latent_dims),
            SliceKind::Rest => sheet(1, c.latent_dims),
            SliceKind::Code | SliceKind::None => NetCost::default(),
        };
        let masks = |size: BranchedSize| match c.kind.masks() {
            MaskKind::PerRegion => {
                groups.iter().map(|g| NetCost::branched(1, position, component * (g.len() + 1), size, 1)).sum()
            }
            MaskKind::Joint => NetCost::branched(1, position, component * (k + 1), size, k),
            MaskKind::None => NetCost::default(),
        };
        let uncertainty = NetCost::branched(k, position + component, component, c.uncertainty, 1);
        let template = |size: crate::config::NetSize| {
            let color = MlpSpec { depth: 1, width: c.color_width, skip: None, output: Some(3), products: c.products };
            let view = encoding::width(3, c.view_bands, true);
            NetCost::of(position + hyper_width(c, k), &spec(size, Some(1 + size.width)))
                + NetCost::of(size.width + view, &color)
        };
        let level = |size, mask| LevelCost {
            template: template(size),
            masks: masks(mask),
            uncertainty: only(c.kind.has_uncertainty(), uncertainty),
        };
        Self {
            latent: if c.kind.has_latent() { frames * c.latent_dims } else { 0 },
            attribute: only(c.kind.has_attributes(), NetCost::of(c.latent_dims, &spec(c.attribute, Some(k)))),
            deformation: only(
                c.kind.has_warp(),
                NetCost::of(encoding::width(3, c.warp_bands, true) + c.latent_dims, &spec(c.warp, Some(6))),
            ),
            slices,
            coarse: level(c.template_coarse, c.mask_coarse.unwrap_or(c.mask)),
            fine: level(c.template, c.mask),
        }
    }

    /// Trainable numbers.
    pub fn parameters(&self) -> usize {
        let level = |l: &LevelCost| (l.template + l.masks + l.uncertainty).parameters;
        self.latent
            + (self.attribute + self.deformation + self.slices).parameters
            + level(&self.coarse)
            + level(&self.fine)
    }

    /// All networks of a level and what both levels share, per sample.
    fn per_sample(&self, level: &LevelCost, with_uncertainty: bool) -> NetCost {
        let all = self.deformation + self.slices + level.template + level.masks;
        if with_uncertainty { all + level.uncertainty } else { all }
    }

    /// Multiply-accumulates per sample, forward: coarse and fine.
    pub fn macs_per_sample(&self, with_uncertainty: bool) -> [usize; 2] {
        [&self.coarse, &self.fine].map(|l| self.per_sample(l, with_uncertainty).macs)
    }

    /// Neurons per sample: coarse and fine.
    pub fn neurons_per_sample(&self, with_uncertainty: bool) -> [usize; 2] {
        [&self.coarse, &self.fine].map(|l| self.per_sample(l, with_uncertainty).neurons)
    }
}

/// What one step of a fit costs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StepCost {
    /// Trainable numbers.
    pub parameters: usize,
    /// Floating-point operations of a step as papers count them: dense layers only, a multiply-accumulate as two,
    /// training as three forward passes; while the uncertainty nets count.
    pub flops_per_iteration: f64,
    /// The same once the attribute loss's weight is under the cut, and the uncertainty nets are left out.
    pub flops_per_iteration_without_uncertainty: f64,
    /// Of the whole schedule.
    pub flops_total: f64,
    /// Steps in which the uncertainty nets count.
    pub steps_with_uncertainty: u64,
    /// Operations of one picture's pixel: forward, without uncertainty nets.
    pub flops_per_pixel: f64,
    /// What has to be held.
    pub memory: Memory,
}

/// Bytes that a fit holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Memory {
    /// The program itself.
    pub program_bytes: u64,
    /// Weights, gradients and Adam's two moments, and their copies while a step or a checkpoint is made.
    pub parameters_bytes: u64,
    /// Images, labels and lists of pixels.
    pub images_bytes: u64,
    /// What goes in and comes out of the networks, forward and backward, for the rays that go through together. Layers are
    /// recomputed in the backward pass.
    pub activations_bytes: u64,
    /// All of it.
    pub total_bytes: u64,
    /// Rays that go through the networks together.
    pub rays_together: usize,
    /// One stored number per neuron for all rays of a step, as a device without recomputation would hold.
    pub activations_without_recomputation_bytes: u64,
}

/// Weights, moments (2), gradients (2 while parts are summed), and what Adam, the kernels' sums and checkpoints need.
const COPIES_OF_PARAMETERS: u64 = 10;
/// The program itself and its allocator, as measured.
const PROGRAM_BYTES: u64 = 160 << 20;
/// Numbers per sample beside the networks' ends: points, the rigid motion, rendering and their gradients. With it,
/// fits of the `cpu` and the `paper` preset were measured to hold 83 % of what is stated per ray.
const OTHER_VALUES: u64 = 400;

impl StepCost {
    /// The cost of a step with these settings; `images_bytes` are held besides.
    pub fn of(settings: &FitSettings, groups: &[Range<usize>], frames: usize, images_bytes: u64) -> Self {
        let cost = ModelCost::of(&settings.model, groups, frames);
        let (coarse, fine) = (settings.coarse_samples, settings.coarse_samples + settings.fine_samples);
        let per_ray = |with: bool| {
            let [c, f] = cost.macs_per_sample(with);
            2.0 * (c as f64 * coarse as f64 + f as f64 * fine as f64)
        };
        let step = |with: bool| 3.0 * settings.rays as f64 * (per_ray(with) + 2.0 * cost.attribute.macs as f64);
        let counts = |step: u64| {
            settings.model.kind.has_uncertainty() && settings.attribute_weight.at(step) >= settings.attribute_cut
        };
        let steps_with_uncertainty = last_step(settings.steps, counts);
        let (with, without) = (step(true), step(false));
        let memory = Memory::of(settings, &cost, images_bytes);
        Self {
            parameters: cost.parameters(),
            flops_per_iteration: with,
            flops_per_iteration_without_uncertainty: without,
            flops_total: with * steps_with_uncertainty as f64
                + without * (settings.steps - steps_with_uncertainty) as f64,
            steps_with_uncertainty,
            flops_per_pixel: per_ray(false),
            memory,
        }
    }
}

/// The last of `steps` steps that still `counts`; once one does not, none after it does.
fn last_step(steps: u64, counts: impl Fn(u64) -> bool) -> u64 {
    let (mut low, mut high) = (0, steps);
    while low < high {
        let middle = low + (high - low).div_ceil(2);
        if counts(middle) { low = middle } else { high = middle - 1 }
    }
    low
}

impl Memory {
    fn of(settings: &FitSettings, cost: &ModelCost, images_bytes: u64) -> Self {
        let rays = settings.rays as u64;
        let together = if settings.micro_rays == 0 { settings.rays } else { settings.micro_rays.min(settings.rays) };
        let (coarse, fine) = (settings.coarse_samples as u64, (settings.coarse_samples + settings.fine_samples) as u64);
        let parameters_bytes = 4 * COPIES_OF_PARAMETERS * cost.parameters() as u64;
        let held = |level: &LevelCost| cost.per_sample(level, true).ends as u64 + OTHER_VALUES;
        let activations_bytes = 4 * together as u64 * (coarse * held(&cost.coarse) + fine * held(&cost.fine));
        let [c, f] = cost.neurons_per_sample(true);
        Self {
            parameters_bytes,
            images_bytes,
            activations_bytes,
            total_bytes: PROGRAM_BYTES + parameters_bytes + images_bytes + activations_bytes,
            program_bytes: PROGRAM_BYTES,
            rays_together: together,
            activations_without_recomputation_bytes: 4 * rays * (coarse * c as u64 + fine * f as u64),
        }
    }

    /// The most rays that may go through together so that the fit stays under `limit` bytes; `None` if not even one may.
    pub fn rays_within(&self, limit: u64) -> Option<usize> {
        let fixed = self.program_bytes + self.parameters_bytes + self.images_bytes;
        let per_ray = self.activations_bytes / self.rays_together.max(1) as u64;
        // What is stated is an estimate, and parts that follow each other leave holes in the allocator's pages.
        let rays = (limit.checked_sub(fixed)? / 20 * 17) / per_ray.max(1);
        (rays > 0).then_some(rays as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::ModelKind;

    /// Fact sheet §5.1: 3 brow, 5 eye and 9 mouth AUs.
    fn groups() -> Vec<Range<usize>> {
        vec![0..3, 3..8, 8..17]
    }

    #[test]
    fn the_papers_sizes_cost_what_the_fact_sheet_says() {
        let paper = ModelCost::of(&FitSettings::paper().model, &groups(), 375);
        let pair = |c: NetCost| (c.parameters, c.macs);
        assert_eq!(paper.latent, 48_000);
        assert_eq!(pair(paper.attribute), (14_065, 13_856));
        assert_eq!(pair(paper.deformation), (126_214, 125_440));
        assert_eq!(pair(paper.slices), (444_040 + 42_376, 437_376 + 41_984));
        for level in [paper.coarse, paper.fine] {
            assert_eq!(pair(level.masks), (264_771, 263_040));
            assert_eq!(pair(level.uncertainty), (1_256_657, 1_246_848));
            assert_eq!(pair(level.template), (737_156, 734_720));
        }
        assert_eq!(paper.parameters(), 5_191_863);
        assert_eq!(paper.macs_per_sample(true), [2_849_408; 2]);
        assert_eq!(paper.neurons_per_sample(true), [21_806; 2]);

        let code = ModelCost::of(&FitSettings::code().model, &groups(), 375);
        assert_eq!(pair(code.coarse.masks), (1_723_651, 1_717_120));
        assert_eq!(pair(code.fine.masks), (110_851, 110_080));
        assert_eq!(pair(code.fine.uncertainty), (2_045_457, 2_034_560));
        assert_eq!(code.parameters(), 8_074_423);
        assert_eq!(code.macs_per_sample(true), [5_091_200, 3_484_160]);
        assert_eq!(code.neurons_per_sample(true), [27_694, 21_934]);

        // CoNeRF's data: three attributes, one per region.
        let three = ModelCost::of(&FitSettings::paper().model, &[0..1, 1..2, 2..3], 375);
        assert_eq!((three.parameters(), three.macs_per_sample(true)[0]), (2_440_541, 1_304_704));

        let mut no_skip = FitSettings::paper().model;
        no_skip.mask.branch_skip = false;
        assert_eq!(ModelCost::of(&no_skip, &groups(), 375).fine.masks.parameters, 234_499);
    }

    #[test]
    fn the_schedules_cost_what_the_fact_sheet_says() {
        let close = |got: f64, want: f64| (got / want - 1.0).abs() < 5e-3;
        let paper = StepCost::of(&FitSettings::paper(), &groups(), 375, 0);
        assert!(close(paper.flops_per_iteration, 3.36e12), "{paper:?}");
        assert!(close(paper.flops_per_iteration_without_uncertainty, 1.89e12), "{paper:?}");
        assert!(close(paper.flops_per_pixel * 129_600.0, 160e12), "{paper:?}");
        // The weight is under 1e-6 from step 139,000 or so on.
        assert!((138_000..140_000).contains(&paper.steps_with_uncertainty), "{paper:?}");
        assert!(close(paper.memory.activations_without_recomputation_bytes as f64, 17.1e9), "{paper:?}");
        let code = StepCost::of(&FitSettings::code(), &groups(), 375, 0);
        assert!(close(code.flops_per_iteration, 4.74e12), "{code:?}");
        assert!(close(code.memory.activations_without_recomputation_bytes as f64, 18.8e9), "{code:?}");
    }

    #[test]
    fn a_limit_decides_how_many_rays_go_together() {
        let settings = FitSettings::paper();
        let memory = StepCost::of(&settings, &groups(), 375, 1_000_000).memory;
        for limit in [memory.total_bytes, memory.total_bytes / 2, 600_000_000] {
            let rays = memory.rays_within(limit).unwrap();
            let limited = FitSettings { micro_rays: rays, ..settings.clone() };
            let held = StepCost::of(&limited, &groups(), 375, 1_000_000).memory.total_bytes;
            assert!(rays > 0 && held <= limit, "{rays} rays hold {held} of {limit}");
        }
        assert_eq!(memory.rays_within(memory.parameters_bytes), None);
    }

    #[test]
    fn models_without_a_part_do_not_pay_for_it() {
        let of = |kind| ModelCost::of(&FitSettings::paper().with_model(kind).model, &groups(), 375);
        let nerf = of(ModelKind::Nerf);
        assert_eq!((nerf.latent, nerf.attribute.macs, nerf.deformation.macs, nerf.slices.macs), (0, 0, 0, 0));
        let confies = of(ModelKind::Confies).parameters();
        for kind in ModelKind::ALL {
            assert!(kind == ModelKind::Confies || of(kind).parameters() < confies, "{kind:?}");
        }
    }
}
