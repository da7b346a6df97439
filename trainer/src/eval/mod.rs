//! How good renders are: distances between pictures, agreement of what was asked with what is seen, and their reports.

pub mod control;
pub mod depth;
pub mod icc;
pub mod lpips;
pub mod report;
pub mod scores;
pub mod ssim;

pub use icc::Icc;
pub use lpips::{Lpips, LpipsNetwork, LpipsScore};
pub use scores::{Evaluation, MAX_PSNR_DB, ViewScore, mse, psnr_from_mse, score, score_parts};
pub use ssim::{MsSsim, SsimMap, ms_ssim, ssim_map};
