//! LPIPS (Zhang et al. 2018, version 0.1): weighted distances of deep features, through ONNX networks that
//! `tools/models --metrics` fetches. A network gives a map per layer; LPIPS is the sum of their means.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use image::RgbImage;
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::TensorRef;
use risorius_formats::{ErrorKind, FormatError};
use serde::Serialize;

use crate::error::Result;

/// What fetches networks and runtime.
const FETCH: &str =
    "`tools/models --metrics` fetches the LPIPS networks and the ONNX Runtime; `--lpips none` does without";
/// The names of a network's outputs.
const LAYERS: [&str; 5] = ["layer1", "layer2", "layer3", "layer4", "layer5"];
/// Smallest side that all layers of both networks can see.
const MIN_SIDE: u32 = 64;

/// Which features are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum LpipsNetwork {
    /// AlexNet: fast, and nearest to people's judgements in its authors' study.
    Alex,
    /// VGG-16: what avatar papers report; about thirty times the work.
    Vgg,
}

impl LpipsNetwork {
    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Alex => "alex",
            Self::Vgg => "vgg",
        }
    }

    fn file(self) -> &'static str {
        match self {
            Self::Alex => "lpips_alexnet.onnx",
            Self::Vgg => "lpips_vgg16.onnx",
        }
    }
}

/// A network that is ready to compare.
#[derive(Debug)]
pub struct Lpips {
    path: PathBuf,
    session: Session,
}

/// The distance of two pictures, and where it comes from.
#[derive(Clone, Debug)]
pub struct LpipsScore {
    /// LPIPS: 0 for equal pictures.
    pub value: f64,
    maps: Vec<(usize, usize, Vec<f32>)>,
}

impl LpipsScore {
    /// LPIPS of the part of the picture for which `inside(x, y)` holds, 0–1 across the picture: the sum of each layer's
    /// mean over its cells there. `None` where a layer has no cell in it.
    pub fn inside(&self, inside: impl Fn(f64, f64) -> bool) -> Option<f64> {
        let mut total = 0.0;
        for (width, height, values) in &self.maps {
            let (mut sum, mut count) = (0.0, 0usize);
            for (i, v) in values.iter().enumerate() {
                if inside(((i % width) as f64 + 0.5) / *width as f64, ((i / width) as f64 + 0.5) / *height as f64) {
                    sum += f64::from(*v);
                    count += 1;
                }
            }
            if count == 0 {
                return None;
            }
            total += sum / count as f64;
        }
        Some(total)
    }
}

/// The folder of networks: `$RISORIUS_MODELS`, else `risorius/models` in the user's cache.
pub fn default_dir() -> PathBuf {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let cache = || set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|home| home.join(".cache")));
    set("RISORIUS_MODELS").unwrap_or_else(|| cache().unwrap_or_default().join("risorius/models"))
}

impl Lpips {
    /// Whether a folder has the network.
    pub fn is_in(dir: &Path, network: LpipsNetwork) -> bool {
        dir.join(network.file()).is_file()
    }

    /// Loads a network of `dir`.
    pub fn open(dir: &Path, network: LpipsNetwork) -> Result<Self> {
        let path = dir.join(network.file());
        if !path.is_file() {
            return Err(FormatError::new(ErrorKind::Missing, "the network is missing")
                .in_file(&path)
                .with_hint(FETCH)
                .into());
        }
        let fail = |e: ort::Error| {
            FormatError::new(ErrorKind::Unsupported, format!("cannot be loaded as a network: {}", first_line(&e)))
                .in_file(&path)
                .with_hint(FETCH)
        };
        let environment = runtime(dir)?;
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let session = Session::builder(&environment)
            .and_then(|b| Ok(b.with_intra_threads(threads)?))
            .and_then(|b| Ok(b.with_log_level(LogLevel::Fatal)?))
            .and_then(|b| Ok(b.with_optimization_level(GraphOptimizationLevel::All)?))
            .and_then(|mut b| b.commit_from_file(&path))
            .map_err(fail)?;
        Ok(Self { path, session })
    }

    /// LPIPS of two pictures of one size, each at least 64 pixels on every side; `None` for others.
    pub fn compare(&mut self, a: &RgbImage, b: &RgbImage) -> Result<Option<LpipsScore>> {
        let (width, height) = a.dimensions();
        if b.dimensions() != (width, height) || width.min(height) < MIN_SIDE {
            return Ok(None);
        }
        let path = &self.path;
        let fail = |e: ort::Error| FormatError::new(ErrorKind::Unsupported, first_line(&e)).in_file(path);
        let shape = vec![1, 3, height as usize, width as usize];
        let (a, b) = (planes(a), planes(b));
        let a = TensorRef::from_array_view((shape.clone(), a.as_slice())).map_err(fail)?;
        let b = TensorRef::from_array_view((shape, b.as_slice())).map_err(fail)?;
        let values = self.session.run(ort::inputs!["a" => a, "b" => b]).map_err(fail)?;
        let mut maps = Vec::with_capacity(LAYERS.len());
        let mut value = 0.0;
        for layer in LAYERS {
            let Some(output) = values.get(layer) else {
                let message = format!("has no output `{layer}`: it is another network");
                return Err(FormatError::new(ErrorKind::Unsupported, message).in_file(path).with_hint(FETCH).into());
            };
            let (shape, map) = output.try_extract_tensor::<f32>().map_err(fail)?;
            let (h, w) = match shape[..] {
                [1, 1, h, w] if h > 0 && w > 0 => (h as usize, w as usize),
                _ => return Ok(None),
            };
            value += map.iter().map(|v| f64::from(*v)).sum::<f64>() / map.len() as f64;
            maps.push((w, h, map.to_vec()));
        }
        Ok(Some(LpipsScore { value, maps }))
    }
}

/// Red, green and blue planes, −1..1.
fn planes(image: &RgbImage) -> Vec<f32> {
    (0..3).flat_map(|c| image.as_raw().iter().skip(c).step_by(3).map(|&v| f32::from(v) / 127.5 - 1.0)).collect()
}

/// ONNX Runtime, loaded once per process: `$ORT_DYLIB_PATH`, else the library beside the networks.
fn runtime(dir: &Path) -> Result<Environment> {
    static LOADED: Mutex<Option<Environment>> = Mutex::new(None);
    let mut loaded = LOADED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    if let Some(environment) = &*loaded {
        return Ok(environment.clone());
    }
    let library = std::env::var_os("ORT_DYLIB_PATH")
        .filter(|v| !v.is_empty())
        .map_or_else(|| dir.join("libonnxruntime.so"), PathBuf::from);
    let fail = |message: String| FormatError::new(ErrorKind::Missing, message).in_file(&library).with_hint(FETCH);
    if !library.is_file() {
        return Err(fail("the ONNX Runtime is missing".to_owned()).into());
    }
    let absolute = std::path::absolute(&library).map_err(|e| fail(e.to_string()))?;
    let builder = ort::init_from(&absolute).map_err(|e| fail(first_line(&e)))?;
    let environment = builder.with_telemetry(false).build().map_err(|e| fail(first_line(&e)))?;
    environment.set_log_level(LogLevel::Fatal);
    *loaded = Some(environment.clone());
    Ok(environment)
}

fn first_line(error: &impl std::fmt::Display) -> String {
    error.to_string().lines().next().unwrap_or_default().trim().to_owned()
}
