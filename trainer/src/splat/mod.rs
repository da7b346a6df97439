//! The Gaussian field's side of the trainer: from a dataset to what `risorius-splat` fits, and from its avatars to pictures.

mod checkpoint;
pub mod field;
pub mod fit;
pub mod plate;
pub mod quantise;
pub mod scene;
pub mod space;
pub mod store;

pub use field::SplatField;
pub use fit::{SplatFit, SplatSettings};
pub use store::SavedSplat;
