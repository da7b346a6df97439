//! What is done with a fitted avatar: pictures of views, expression transfer.

pub mod render;
pub mod transfer;
