//! Gaussians that carry their AU deltas: the fast field of the avatar, on the CPU.
//!
//! ```text
//! scene ─▶ init ─▶ model ─▶ project (blend) ─▶ bin ─▶ raster ─▶ backward, update ─▶ fit
//!                                                      └──────▶ render
//! ```
//!
//! No files, no printing. [`mod@reference`] is the readable f64 twin of the kernels. Sources: 3D Gaussian splatting (Kerbl et
//! al. 2023), antialiased as in Mip-Splatting (Yu et al. 2024), AU deltas as linear bases, without a 3DMM.

#![allow(clippy::inline_always, reason = "kernels are compiled once per instruction set, with all they call inside")]
#![allow(clippy::needless_range_loop, reason = "loops over axes, channels and blocks index several arrays at once")]

mod backward;
mod bin;
pub mod fit;
pub mod floor;
pub mod init;
#[cfg(test)]
mod kernel_tests;
pub mod model;
mod project;
mod raster;
pub mod reference;
pub mod render;
pub mod scene;
pub mod simd;
pub mod skips;
mod update;
mod view;

pub use fit::{Fitter, Settings, StepNumbers};
pub use model::{Gaussians, Layout};
pub use render::{Outputs, Picture, Renderer};
pub use scene::{Frame, Plate, Scene};
pub use skips::Skips;
pub use view::MOST_SIDE;

/// Edge of a tile, pixels.
pub const TILE: usize = 16;
