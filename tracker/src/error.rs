//! What can go wrong while tracking and posing, with advice.

use std::borrow::Cow;
use std::path::PathBuf;

use risorius_formats::{FormatError, Hint};
use risorius_video::VideoError;
use thiserror::Error;

use crate::models::FETCH;
use crate::models::runtime::LIBRARY_VARIABLE;

/// An error of this crate.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrackerError {
    /// A file of a take, table or model is bad.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The video cannot be read.
    #[error(transparent)]
    Video(#[from] VideoError),
    /// The user asked to stop.
    #[error("stopped on request while {doing}")]
    Cancelled {
        /// What was going on.
        doing: String,
    },
    /// The table and the take have no frame in common.
    #[error("{path}: none of its {rows} rows belongs to one of the take's {frames} frames", path = path.display())]
    NoCommonFrame {
        /// The table.
        path: PathBuf,
        /// Its rows.
        rows: usize,
        /// The take's frames.
        frames: usize,
    },
    /// No row passes the gate.
    #[error("{path}: no frame has `success` = 1 and a confidence of at least {min_confidence}", path = path.display())]
    NoValidFrame {
        /// The table.
        path: PathBuf,
        /// The gate.
        min_confidence: f32,
    },
    /// A table cannot be encoded.
    #[error("{path}: cannot encode the table: {message}", path = path.display())]
    Encode {
        /// The file to be.
        path: PathBuf,
        /// What the encoder said.
        message: String,
    },
    /// The take has no track yet.
    #[error("{path}: does not exist, and the poses need its landmarks", path = path.display())]
    NoTrack {
        /// The missing table.
        path: PathBuf,
    },
    /// The track lacks something a method needs.
    #[error("{path}: {missing}", path = path.display())]
    TrackLacks {
        /// The table.
        path: PathBuf,
        /// What it lacks.
        missing: String,
        /// What to do about it.
        hint: &'static str,
    },
    /// There is no model where one should be.
    #[error("{dir}: is not a COLMAP model: found neither `cameras.txt` and `images.txt` nor `cameras.bin` and `images.bin` in it, in `sparse` or in numbered folders", dir = dir.display())]
    NoModel {
        /// The folder that was searched.
        dir: PathBuf,
    },
    /// A model that holds no image of the take.
    #[error("{dir}: none of its {images} images belongs to one of the take's {frames} frames", dir = dir.display())]
    NoModelFrame {
        /// The model.
        dir: PathBuf,
        /// Images in the model.
        images: usize,
        /// Frames of the take.
        frames: usize,
    },
    /// A folder that the model does not have.
    #[error("{dir}: none of its images lies in the folder `{folder}`", dir = dir.display())]
    NoModelFolder {
        /// The model.
        dir: PathBuf,
        /// What was asked for.
        folder: String,
        /// The folders that there are.
        folders: String,
    },
    /// A lens that datasets cannot hold.
    #[error("{dir}: its camera {camera} has the lens model {model} with k4 to k6, which datasets cannot hold", dir = dir.display())]
    LensModel {
        /// The model.
        dir: PathBuf,
        /// Id of the camera.
        camera: u32,
        /// COLMAP's name of the lens model.
        model: String,
    },
    /// A model of pictures of another shape.
    #[error("{dir}: its camera {camera} is {width}×{height} pixels, but the take is {take_width}×{take_height}", dir = dir.display())]
    CameraSize {
        /// The model.
        dir: PathBuf,
        /// Id of the camera.
        camera: u32,
        /// Its width.
        width: u64,
        /// Its height.
        height: u64,
        /// The take's upright width.
        take_width: u32,
        /// The take's upright height.
        take_height: u32,
    },
    /// The program cannot be started.
    #[error("cannot start `{program}`: {reason}", program = program.display())]
    ColmapMissing {
        /// The program.
        program: PathBuf,
        /// Why.
        reason: String,
    },
    /// A step of COLMAP failed.
    #[error("`colmap {step}` failed ({status}): {last_line}")]
    ColmapFailed {
        /// The sub-command.
        step: String,
        /// Exit status in words.
        status: String,
        /// The last line it wrote.
        last_line: String,
        /// The whole output.
        log: PathBuf,
    },
    /// COLMAP took longer than it was allowed to.
    #[error("COLMAP was stopped after {secs} s, during `{step}`")]
    ColmapTimeout {
        /// The sub-command.
        step: String,
        /// The limit.
        secs: u64,
        /// The whole output.
        log: PathBuf,
    },
    /// COLMAP ended without a model.
    #[error("COLMAP found no camera poses in {tried} key frames")]
    ColmapNoModel {
        /// Key frames.
        tried: usize,
        /// The whole output.
        log: PathBuf,
    },
    /// A take of a few frames.
    #[error("the take has only {frames} frames, too few to find cameras from")]
    FewFrames {
        /// Its frames.
        frames: usize,
    },
    /// COLMAP placed too few frames.
    #[error("COLMAP placed only {registered} of {tried} key frames")]
    FewRegistered {
        /// Placed.
        registered: usize,
        /// Handed over.
        tried: usize,
    },
    /// Cameras that should not be trusted.
    #[error("the cameras are of low quality: {problems}")]
    PoorPoses {
        /// What is wrong.
        problems: String,
        /// What to do about it.
        advice: String,
    },
    /// Poses that are worse than those the take has.
    #[error("{path}: the take has better poses: {difference}", path = path.display())]
    WorsePoses {
        /// The report of the poses that are there.
        path: PathBuf,
        /// In what they are better.
        difference: String,
    },
    /// The landmarks' rays are nearly parallel: no depth.
    #[error("the cameras hardly move around the face: only {good} of 68 landmarks can be triangulated")]
    TooLittleParallax {
        /// Landmarks with a depth.
        good: usize,
    },
    /// ONNX Runtime is nowhere.
    #[error("ONNX Runtime is not there: looked for {places}", places = listed(places))]
    NoRuntime {
        /// Where it was looked for.
        places: Vec<PathBuf>,
    },
    /// ONNX Runtime cannot be loaded.
    #[error("{path}: cannot be loaded as ONNX Runtime: {message}", path = path.display())]
    Runtime {
        /// The library.
        path: PathBuf,
        /// What the loader said.
        message: String,
    },
    /// A network failed while it ran.
    #[error("{path}: the network failed: {message}", path = path.display())]
    Inference {
        /// The network's file.
        path: PathBuf,
        /// What ONNX Runtime said.
        message: String,
    },
    /// A network gave something else than its manifest promises.
    #[error("{path}: the network's output `{output}` {problem}", path = path.display())]
    NetworkOutput {
        /// The network's file.
        path: PathBuf,
        /// The output.
        output: String,
        /// What is wrong with it.
        problem: String,
    },
    /// There are no AU models of OpenFace where they should be.
    #[error("{dir}: has no AU models of OpenFace: looked for {places}", dir = dir.display(), places = listed(looked_for))]
    NoOpenFaceModels {
        /// The folder that was named.
        dir: PathBuf,
        /// The files of which one should be there.
        looked_for: Vec<PathBuf>,
    },
    /// A camera does not do what it should.
    #[error("camera {number} {what}")]
    Camera {
        /// Its number.
        number: i32,
        /// What is wrong.
        what: String,
    },
    /// The machine gives no threads.
    #[error("cannot start the threads: {message}")]
    Threads {
        /// Why.
        message: String,
    },
    /// There is nothing to compare.
    #[error("{dir}: has only {common} frames in common with the take's poses, at least 3 are needed", dir = dir.display())]
    NothingInCommon {
        /// The reference model.
        dir: PathBuf,
        /// Common frames.
        common: usize,
    },
}

impl Hint for TrackerError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        let text: Cow<'_, str> = match self {
            Self::Format(e) => return e.hint(),
            Self::Video(e) => return e.hint(),
            Self::Cancelled { .. } | Self::Encode { .. } | Self::Threads { .. } => return None,
            Self::NoCommonFrame { .. } => {
                "is it the table of another video? `--first-frame N` says which number the first frame has in it".into()
            }
            Self::NoValidFrame { .. } => "look at the `confidence` column; `--min-confidence` lowers the gate".into(),
            Self::NoTrack { .. } => "track the video with `tracker run TAKE`, or import a table with `tracker import TAKE --openface FILE.csv`".into(),
            Self::TrackLacks { hint, .. } => (*hint).into(),
            Self::NoModel { .. } => "give the folder with cameras, images and points3D as .txt or .bin".into(),
            Self::NoModelFrame { .. } => {
                "is it the model of another video? `--colmap-first N` states the number of the take's first frame, `--colmap-step N` the frames from one number to the next".into()
            }
            Self::NoModelFolder { folders, .. } => format!("its folders are {folders}").into(),
            Self::LensModel { .. } => {
                "run COLMAP with `--ImageReader.camera_model OPENCV`, which holds k1, k2, p1 and p2".into()
            }
            Self::CameraSize { width, height, take_width, take_height, .. } => {
                let turned = (*width > *height) != (*take_width > *take_height);
                if turned {
                    "the model was made from pictures whose rotation was not applied; make it from upright pictures".into()
                } else {
                    "cropped pictures cannot be used; make the model from whole frames of this take".into()
                }
            }
            Self::ColmapMissing { .. } => {
                "install it (`apt-get update && apt-get install colmap`), or its Python package (`apt-get install python3-venv`, `python3 -m venv venv`, `venv/bin/pip install pycolmap`, then `--colmap venv/bin/python`), name it with `--colmap PATH`, or give a finished model with `--colmap-model DIR`"
                    .into()
            }
            Self::ColmapFailed { log, .. } => format!("the whole output is in {}", log.display()).into(),
            Self::ColmapTimeout { log, .. } => format!(
                "the same command goes on where it stopped; allow more with `--time-limit SECS` or ask for fewer `--keyframes`; the output is in {}",
                log.display()
            )
            .into(),
            Self::ColmapNoModel { log, .. } => format!(
                "it needs a camera that moves around (turning on the spot is not enough) before a still, textured background; for a still camera use `--method head`; the output is in {}",
                log.display()
            )
            .into(),
            Self::FewFrames { .. } => "record some seconds while the camera moves around the head".into(),
            Self::FewRegistered { .. } => {
                "move the camera around the head (turning on the spot is not enough), slowly, in good light, before a background with texture; for a still camera use `--method head`; `--accept-poor` takes what there is"
                    .into()
            }
            Self::PoorPoses { advice, .. } => format!("{advice}; `--accept-poor` takes them as they are").into(),
            Self::WorsePoses { .. } => {
                "nothing was changed; `--accept-poor` replaces them".into()
            }
            Self::TooLittleParallax { .. } => "for a still camera and a moving head use `--method head`".into(),
            Self::NoRuntime { .. } | Self::Runtime { .. } => format!(
                "{FETCH}; `{LIBRARY_VARIABLE}` names a library of your own, version 1.24 or later"
            )
            .into(),
            Self::Inference { .. } | Self::NetworkOutput { .. } => {
                "`models.toml` has to describe the network beside it; `tools/models` fetches networks that fit".into()
            }
            Self::NoOpenFaceModels { .. } => {
                "name the folder of an OpenFace 2.x install, or its `AU_predictors` or `model` folder; this project has no copy of them".into()
            }
            Self::Camera { .. } => "`capture devices` lists cameras; another program may use this one".into(),
            Self::NothingInCommon { .. } => {
                "frames are matched by the digits of image names; see `--reference-first`".into()
            }
        };
        Some(text)
    }
}

/// The result of everything in this crate.
pub type Result<T, E = TrackerError> = std::result::Result<T, E>;

fn listed(paths: &[PathBuf]) -> String {
    paths.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ")
}
