//! Fast CPU kernels: fused multilayer perceptrons, positional encoding and volume rendering.
//!
//! Burn runs a network layer by layer: each layer writes a whole `[n, width]` matrix to memory and reads it back.
//! For the small networks of a radiance field that traffic, and the fresh buffers it needs, cost more than the
//! arithmetic. The operations here walk over the batch in tiles of rows instead and take each tile through all layers
//! while it is in the cache. Backward passes recompute the tile's forward pass (activation checkpointing), so nothing
//! but the inputs is kept between the two.
//!
//! Each operation is one differentiable node on Burn's CPU backend (Flex) for `f32` and `f64` tensors. On any other
//! device or element type the same function runs its plain twin from [`mod@reference`], so callers need not care.
//!
//! # Determinism and threads
//!
//! Rows are split into chunks by the batch size alone; parameter gradients of the chunks are added in chunk order.
//! Results are therefore bit-identical for any number of threads. Work runs on rayon's current pool, see
//! [`set_threads`].

mod composite;
mod encoding;
mod extension;
mod matmul;
mod mlp;
pub mod reference;
pub(crate) mod scalar;
mod sincos;
mod wide;

pub use composite::composite;
pub use encoding::{EncodingSpec, positional_encoding};
pub use mlp::{MlpSpec, Products, grouped_mlp_forward, mlp_forward, mlp_forward_with_ray, per_sample};

use burn::backend::DispatchDevice;
use burn::tensor::{DType, Tensor};

/// Rows that go through all layers together. Big enough to amortise reading the weights, small enough that the
/// activations of all layers stay in the second-level cache.
const TILE_ROWS: usize = 256;

/// Most chunks a batch is split into: enough for any desktop's cores, few enough that summing the chunks' parameter
/// gradients costs nothing.
const MAX_CHUNKS: usize = 32;

/// Rows of a chunk for a batch of `rows` rows: a multiple of `unit` that depends on nothing else.
fn chunk_rows(rows: usize, unit: usize) -> usize {
    rows.div_ceil(MAX_CHUNKS).next_multiple_of(unit).max(unit)
}

/// Limits the kernels (and Burn's own CPU operations) to `threads` worker threads; 0 means one per core.
///
/// Sets up rayon's process-wide pool, so call it once, before the first tensor operation. Returns `false` and changes
/// nothing when that pool already exists. To bound one computation only, run it inside
/// `rayon::ThreadPool::install`. The thread count never changes a result.
pub fn set_threads(threads: usize) -> bool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().is_ok()
}

/// Whether the fused operation can run where `tensor` lives.
fn is_fused<const D: usize>(tensor: &Tensor<D>) -> bool {
    is_on_flex(tensor) && matches!(tensor.dtype(), DType::F32 | DType::F64)
}

/// Whether `tensor` lives on Burn's CPU backend, recorded for autodiff or not.
pub(crate) fn is_on_flex<const D: usize>(tensor: &Tensor<D>) -> bool {
    let device = tensor.device();
    let device = device.as_dispatch();
    let device = if let DispatchDevice::Autodiff(inner) = device { inner } else { device };
    matches!(device, DispatchDevice::Flex(_))
}
