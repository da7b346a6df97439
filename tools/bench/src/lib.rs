//! Measurements that link the libraries they measure. Each prints time and error, and the ratio to a floor that was
//! calibrated on the same machine in the same run.

pub mod child;
pub mod confies;
pub mod panels;
pub mod splat;
