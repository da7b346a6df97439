//! The brick field: the fast equivalent of the CoNFies networks for the CPU.
//!
//! ```text
//! lattice, table ─▶ field, expression ─▶ evaluate ─▶ rays ─▶ fit   (cull: what is skipped)
//!        ▲ simd, matmul, math                          ├───▶ render
//!                                                      └───▶ batch  (for losses of one's own)
//! ```
//!
//! Grids of features in bricks and two tiny networks stand in for the paper's template F; residual grids per AU,
//! blended once per image and gated by region masks, for the ambient slices; a warp in the same grids and a small latent
//! one for the deformation field; numbers per image and AU for α and β. Everything here works on plain slices: no
//! files, no tensors, no printing.
//!
//! Lengths are world units outside and the head box's [−1, 1]³ inside; colours are 0–1; attributes −1..1.

#![allow(clippy::inline_always, reason = "kernels are compiled once per instruction set, with all they call inside")]
#![allow(clippy::needless_range_loop, reason = "loops over axes, channels and parts index several arrays at once")]

mod bake;
pub mod batch;
pub mod cull;
pub mod evaluate;
pub mod expression;
pub mod field;
pub mod fit;
pub mod floor;
pub mod heal;
pub mod lattice;
pub mod march;
pub mod math;
mod matmul;
pub mod model;
pub mod occupancy;
mod pages;
mod rays;
pub mod reference;
pub mod render;
pub mod simd;
mod sixteen;
pub mod skips;
pub mod table;

pub use fit::{Fitter, Pixel, Progress, Settings, StepNumbers, Views};
pub use model::{BackgroundFrame, Brick, HeadBox, Layout};
pub use skips::Skips;
