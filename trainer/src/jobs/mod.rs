//! What is done with a fitted avatar: pictures of views, their scores, what its AUs do, expression transfer.

pub mod control;
pub mod evaluate;
pub mod export;
pub mod interpolate;
pub mod render;
pub mod transfer;
