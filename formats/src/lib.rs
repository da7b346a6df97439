//! The shared vocabulary of Risorius: plain types and codecs for takes, tracks, cameras, datasets and runs.
//!
//! Data flows one way and stages meet in folders on disk, whose files are read and written here:
//!
//! ```text
//! video ──capture──▶ TAKE/            take.toml, frames.csv, video
//!       ──tracker──▶ TAKE/track/      openface.csv, track.parquet
//!                    TAKE/poses/      sparse/ (COLMAP text), report.json
//!       ──dataset──▶ DATASET/         the Nerfies family's folder + attributes.toml, regions/, report/
//!       ──trainer──▶ RUN/             settings.toml, metrics.jsonl, checkpoints/, model.*, eval/
//! ```
//!
//! # Conventions
//!
//! * **Transforms** are `a_from_b`. Cameras are `camera_from_world`, f64, OpenCV axes (x right, y down, z forward).
//! * **Pixels**: the centre of the first pixel is (0.5, 0.5), everywhere but inside an OpenFace table, where it is
//!   (0, 0); the codec converts.
//! * **Frames** count from 0 (`FrameIndex`), OpenFace's `frame` column from 1; the codec converts.
//! * **AU intensities** are 0–5, **attributes** −1..1 (eq. 1 of the CoNFies paper), **activations** 0 to about 1.25; only
//!   [`AuScale`] converts. Missing is `None`, never 0.
//! * **Units** are in names: `_px`, `_mm`, `_secs`, `_nanos`; angles are radians.
//!
//! Parsers take bytes and say where they stumbled; a thin `read_*` wrapper adds the file's name. Nothing here prints.

pub mod atomic;
pub mod attribute;
pub mod au;
pub mod au_scale;
pub mod camera;
pub mod colmap;
pub mod curves;
mod dialect;
pub mod error;
pub mod frame;
pub mod hash;
pub mod head_hull;
pub mod html;
pub mod intensities;
pub mod landmark_table;
pub mod landmarks;
pub mod mask;
pub mod nerfies;
pub mod openface;
pub mod package;
pub mod polygon;
pub mod pose_report;
pub mod region;
pub mod report;
pub mod run;
pub mod scene;
pub mod similarity;
pub mod smooth;
pub mod staging;
pub mod table_scale;
pub mod take;
pub mod track;
pub mod views;

pub use attribute::{AttributeSpec, AttributeTable};
pub use au::ActionUnit;
pub use au_scale::{Activation, Attribute, AuScale, Intensity};
pub use camera::{Camera, Intrinsics, Isometry};
pub use curves::Curves;
pub use error::{ErrorKind, FormatError, Hint};
pub use frame::{FrameIndex, FrameRecord};
pub use landmarks::Landmarks68;
pub use region::RegionTable;
pub use report::{Reporter, Silent, Warning};
pub use scene::SceneBounds;
pub use similarity::Similarity;
pub use table_scale::TableScale;
pub use take::{Take, TakeManifest};
pub use track::{Track, TrackRow};

/// The result of everything that reads or writes a format.
pub type Result<T, E = FormatError> = std::result::Result<T, E>;
