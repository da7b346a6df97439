//! Gaussians that carry their AU deltas: the fast field of the avatar, on the CPU.
//!
//! ```text
//! scene ─▶ init ─▶ model ─▶ blend ─▶ project ─▶ bin ─▶ raster ─▶ fit (loss, backward pass, Adam, densification)
//!                                                      └──────▶ render
//! ```
//!
//! No files, no printing. Each kernel has a readable f64 twin in `reference`. Sources: `docs/decisions` and 3D Gaussian
//! splatting (Kerbl et al. 2023), antialiased as in Mip-Splatting (Yu et al. 2024), without a 3DMM.

pub mod fit;
pub mod init;
pub mod model;
pub mod render;
pub mod scene;
pub mod skips;

pub use fit::{Fitter, Settings, StepNumbers};
pub use model::{Gaussians, Layout};
pub use render::{Outputs, Picture, Renderer};
pub use scene::{Frame, Plate, Scene};
pub use skips::Skips;
