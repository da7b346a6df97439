//! The plain COLMAP recipe: pictures evenly spread in time, then the three programs as they are.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use risorius_console::Failure;
use risorius_formats::{FormatError, FrameIndex, Take};
use risorius_video::VideoError;
use wait4::Wait4 as _;

/// What the recipe used, and its model.
pub(crate) struct Used {
    pub(crate) wall_secs: f64,
    pub(crate) cpu_secs: f64,
    pub(crate) peak_mib: f64,
    pub(crate) model: PathBuf,
}

/// Runs it on `pictures` frames in a fresh `folder`.
pub(crate) fn run(program: &Path, take: &Take, pictures: usize, folder: &Path) -> Result<Used, Failure> {
    if folder.exists() {
        std::fs::remove_dir_all(folder).map_err(|e| FormatError::io(folder, "remove", &e))?;
    }
    let (images, sparse, database) = (folder.join("images"), folder.join("sparse"), folder.join("database.db"));
    for dir in [&images, &sparse] {
        std::fs::create_dir_all(dir).map_err(|e| FormatError::io(dir, "create", &e))?;
    }
    let last = take.frames.len().saturating_sub(1);
    let steps = pictures.max(2) - 1;
    let wanted: Vec<u32> = (0..=steps).map(|i| (i * last / steps) as u32).collect();
    let started = Instant::now();
    risorius_video::read_take_frames(take, &wanted, |frame, picture| -> Result<(), VideoError> {
        let path = images.join(FrameIndex(frame).image_name());
        picture.save(&path).map_err(|e| FormatError::syntax(e.to_string()).in_file(&path))?;
        Ok(())
    })
    .map_err(|e| Failure::input(e.to_string()))?;
    let mut used = Used { wall_secs: 0.0, cpu_secs: 0.0, peak_mib: 0.0, model: sparse.clone() };
    let os = |p: &Path| p.as_os_str().to_owned();
    let flag = |s: &str| OsString::from(s);
    let steps: [(&str, Vec<OsString>); 3] = [
        (
            "feature_extractor",
            vec![
                flag("--database_path"),
                os(&database),
                flag("--image_path"),
                os(&images),
                flag("--ImageReader.single_camera"),
                flag("1"),
                flag("--SiftExtraction.use_gpu"),
                flag("0"),
            ],
        ),
        ("exhaustive_matcher", vec![flag("--database_path"), os(&database), flag("--SiftMatching.use_gpu"), flag("0")]),
        (
            "mapper",
            vec![
                flag("--database_path"),
                os(&database),
                flag("--image_path"),
                os(&images),
                flag("--output_path"),
                os(&sparse),
            ],
        ),
    ];
    let log = folder.join("colmap.log");
    for (step, args) in steps {
        let out = std::fs::OpenOptions::new()
            .create(true)
            .append(true)
            .open(&log)
            .map_err(|e| FormatError::io(&log, "write", &e))?;
        let err = out.try_clone().map_err(|e| FormatError::io(&log, "write", &e))?;
        let mut child = Command::new(program)
            .arg(step)
            .args(args)
            .env("QT_QPA_PLATFORM", "offscreen")
            .stdin(Stdio::null())
            .stdout(out)
            .stderr(err)
            .spawn()
            .map_err(|e| FormatError::io(program, "start", &e))?;
        let result = child.wait4().map_err(|e| FormatError::io(program, "wait for", &e))?;
        if !result.status.success() {
            return Err(Failure::input(format!("`colmap {step}` failed"))
                .with_hint(format!("its output is in {}", log.display())));
        }
        used.cpu_secs += result.rusage.utime.as_secs_f64() + result.rusage.stime.as_secs_f64();
        used.peak_mib = used.peak_mib.max(result.rusage.maxrss as f64 / (1024.0 * 1024.0));
    }
    used.wall_secs = started.elapsed().as_secs_f64();
    Ok(used)
}
