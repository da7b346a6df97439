//! A dataset becomes an avatar: a field fitted, rendered, evaluated and driven. There are two fields behind one seam
//! ([`field`]): Gaussians ([`splat`]), and the networks of the paper ([`confies`]).
//!
//! ```text
//! data ─▶ splat ────────────────────────────────────────────────────▶ fit     RUN/
//!      └▶ batch ─▶ sampling ─▶ model (fields) ─▶ volume ─▶ loss ────▶┘ │ saved ─▶ avatar ─▶ jobs (render, eval, transfer)
//!                                 ▲ kernel
//! ```
//!
//! Names are the paper's: attribute α, region mask m, ambient slices w, deformation x', template F, uncertainty β,
//! latent code ω. Tensors state their shapes: r rays, s samples, n = r · s, K attributes, N regions.

pub mod avatar;
pub mod batch;
mod bounds;
pub mod cli;
pub mod confies;
pub mod config;
pub mod cost;
pub mod cutout;
pub mod data;
pub mod devices;
pub mod encoding;
pub mod error;
pub mod eval;
pub mod expression;
pub mod field;
pub mod fields;
pub mod fit;
pub mod hull;
pub mod jobs;
pub mod kernel;
pub mod loss;
pub mod mlp;
pub mod model;
pub mod path;
pub mod presets;
pub mod sampling;
pub mod saved;
pub mod schedule;
pub mod se3;
pub mod space;
pub mod splat;
pub mod studio;
pub mod view;
pub mod volume;

pub use avatar::Avatar;
pub use config::FitSettings;
pub use error::{Result, TrainerError};
