//! Running ONNX networks: the shared library is loaded at run time, one session per thread, one thread per session.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::TensorRef;
use risorius_formats::{ErrorKind, FormatError};

use super::FETCH;
use crate::error::{Result, TrackerError};

/// The name of the library in a folder of models.
pub const LIBRARY: &str = "libonnxruntime.so";
/// Names the library of ONNX Runtime wherever it lies.
pub const LIBRARY_VARIABLE: &str = "ORT_DYLIB_PATH";

/// ONNX Runtime, loaded. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Runtime {
    environment: Environment,
}

/// Places where the library may lie, best first: `$ORT_DYLIB_PATH` alone if it is set, else the given folders.
pub fn library_places(folders: &[&Path]) -> Vec<PathBuf> {
    match std::env::var_os(LIBRARY_VARIABLE).filter(|v| !v.is_empty()) {
        Some(path) => vec![path.into()],
        None => folders.iter().map(|dir| dir.join(LIBRARY)).collect(),
    }
}

impl Runtime {
    /// Loads the first library of `places` that is a file.
    ///
    /// A process loads one library only: later calls give the first one again.
    pub fn load(places: &[PathBuf]) -> Result<Self> {
        // The environment itself must not be made twice at once.
        static LOADED: Mutex<Option<Environment>> = Mutex::new(None);
        let mut loaded = LOADED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(environment) = &*loaded {
            return Ok(Self { environment: environment.clone() });
        }
        let Some(path) = places.iter().find(|p| p.is_file()) else {
            return Err(TrackerError::NoRuntime { places: places.to_vec() });
        };
        let fail = |message: String| TrackerError::Runtime { path: path.clone(), message: first_line(&message) };
        let path = std::path::absolute(path).map_err(|e| fail(e.to_string()))?;
        if is_cut(&path).map_err(|e| fail(e.to_string()))? {
            return Err(fail("it is not whole, as after a download that broke off".to_owned()));
        }
        let builder = ort::init_from(&path).map_err(|e| fail(e.to_string()))?;
        let environment = builder.with_telemetry(false).build().map_err(|e| fail(e.to_string()))?;
        // Its warnings about graphs are not for users; errors come back as such.
        environment.set_log_level(LogLevel::Fatal);
        *loaded = Some(environment.clone());
        Ok(Self { environment })
    }
}

/// Whether an ELF library lacks its end, where its section headers lie. The system's loader maps what is missing and
/// ends the whole process when it is touched.
fn is_cut(path: &Path) -> std::io::Result<bool> {
    use std::io::Read as _;
    let mut file = std::fs::File::open(path)?;
    let mut head = [0; 64];
    let is_elf64 = file.read_exact(&mut head).is_ok() && head.starts_with(b"\x7fELF\x02\x01");
    let number = |at: usize, bytes: usize| (0..bytes).rev().fold(0u64, |n, i| n << 8 | u64::from(head[at + i]));
    let end = number(40, 8).saturating_add(number(58, 2) * number(60, 2));
    Ok(is_elf64 && end > file.metadata()?.len())
}

/// A network that is ready to run, on the thread that calls it.
#[derive(Debug)]
pub struct Network {
    path: PathBuf,
    session: Session,
    input_shape: Vec<usize>,
    outputs: Vec<String>,
}

impl Network {
    /// Reads an ONNX file with one input whose shape, batch apart, is `input_shape` (the batch is 1), and takes the
    /// named outputs, or all where none are named.
    pub fn open(runtime: &Runtime, path: &Path, input_shape: &[usize], outputs: &[&str]) -> Result<Self> {
        let fail = |message: String| {
            FormatError::new(ErrorKind::Unsupported, first_line(&message)).in_file(path).with_hint(FETCH)
        };
        let session = Session::builder(&runtime.environment)
            .and_then(|b| Ok(b.with_intra_threads(1)?))
            .and_then(|b| Ok(b.with_inter_threads(1)?))
            .and_then(|b| Ok(b.with_log_level(LogLevel::Fatal)?))
            .and_then(|b| Ok(b.with_optimization_level(GraphOptimizationLevel::All)?))
            .and_then(|mut b| b.commit_from_file(path))
            .map_err(|e| fail(format!("cannot be loaded as a network: {e}")))?;
        let wrong = |message: String| {
            FormatError::new(ErrorKind::Inconsistent, message)
                .in_file(path)
                .with_hint("`models.toml` has to describe the network beside it")
        };
        let [input] = session.inputs() else {
            return Err(wrong(format!("has {} inputs, expected one", session.inputs().len())).into());
        };
        let found: Vec<i64> = input.dtype().tensor_shape().map(|s| s.to_vec()).unwrap_or_default();
        // −1 stands for any size.
        let fits =
            found.len() == input_shape.len() && found.iter().zip(input_shape).all(|(&f, &w)| f < 0 || f == w as i64);
        if !fits {
            return Err(wrong(format!("its input has the shape {found:?}, expected {input_shape:?}")).into());
        }
        let has: Vec<&str> = session.outputs().iter().map(ort::value::Outlet::name).collect();
        if let Some(missing) = outputs.iter().find(|name| !has.contains(name)) {
            return Err(wrong(format!("has no output `{missing}`; it has `{}`", has.join("`, `"))).into());
        }
        let outputs = if outputs.is_empty() { has } else { outputs.to_vec() };
        let outputs = outputs.into_iter().map(str::to_owned).collect();
        Ok(Self { path: path.to_owned(), session, input_shape: input_shape.to_vec(), outputs })
    }

    /// Runs the network on `input`, of the shape given at [`open`](Self::open), and hands its outputs to `read`, in the
    /// order given there, as plain numbers.
    pub fn run<T>(&mut self, input: &[f32], read: impl FnOnce(&[&[f32]]) -> T) -> Result<T> {
        let path = &self.path;
        let fail = |e: ort::Error| TrackerError::Inference { path: path.clone(), message: first_line(&e.to_string()) };
        let tensor = TensorRef::from_array_view((self.input_shape.clone(), input)).map_err(fail)?;
        let values = self.session.run(ort::inputs![tensor]).map_err(fail)?;
        let mut slices: Vec<&[f32]> = Vec::with_capacity(self.outputs.len());
        for name in &self.outputs {
            slices.push(values[name.as_str()].try_extract_tensor::<f32>().map_err(fail)?.1);
        }
        Ok(read(&slices))
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

fn first_line(message: &str) -> String {
    message.lines().next().unwrap_or_default().trim().to_owned()
}
