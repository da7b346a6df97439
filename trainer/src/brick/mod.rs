//! The brick field's side of the trainer: from a dataset to what `risorius-brick` fits, and from its avatars to pictures.

pub mod fit;
pub mod hull;
pub mod layout;
pub mod plate;
pub mod store;
pub mod tensors;
pub mod views;
