//! From tracked and posed takes to a balanced, packaged dataset.
//!
//! [`build`] smooths the AU signals of a take ([`smooth`]), normalises them, chooses frames so that every AU appears at
//! every intensity about equally often ([`balance`]), outlines the face regions ([`regions`]), and packages pictures,
//! cameras and annotations as the Nerfies family of loaders expects them, with a report of what was done ([`stats`]).
//! [`verify`] reads a dataset as a stranger would and lists every problem; [`export`] writes other layouts.
//!
//! Which scales are written: the one that fitting uses (`--scale`, 4) and everything coarser, up to 8. A loader of the
//! family reads `rgb/<s>x` for the one scale it is set to; 1x is large and rarely wanted, so it is written on request.

pub mod align;
pub mod balance;
pub mod choose;
pub mod cli;
pub mod compare;
pub mod corpus;
pub mod entropy;
pub mod error;
pub mod export;
pub mod import;
pub mod neutral;
pub mod plot;
pub mod provenance;
pub mod raster;
pub mod redact;
pub mod regions;
pub mod rows;
pub mod scale;
pub mod scene;
pub mod sheet;
pub mod signals;
pub mod smooth;
pub mod split;
pub mod stats;
pub mod survey;
pub mod tables;
pub mod verify;
pub mod views;

mod build;
mod candidates;
mod describe;
mod flags;
mod options;
mod package;
mod page;
mod report;
mod split_report;
mod table_file;
mod takes;
mod verify_layouts;

pub use build::{Built, TAKE_OFFSET, build, build_timed};
pub use error::{DatasetError, Result};
pub use options::{BuildOptions, SCALES, Sampling};
pub use stats::Report;
