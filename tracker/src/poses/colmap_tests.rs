use super::*;
use crate::testing;
use image::RgbImage;
use risorius_formats::Hint;
use risorius_formats::Track;
use risorius_formats::report::Collected;
use std::os::unix::fs::PermissionsExt;

/// A take of ten small pictures in a folder, and a `colmap` that is a shell script.
struct Stage {
    dir: tempfile::TempDir,
    take: Take,
}

impl Stage {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let path = testing::take(dir.path(), 32, 24, 10);
        let pictures = path.join("pictures");
        fs::create_dir(&pictures).unwrap();
        for i in 0..10 {
            RgbImage::from_pixel(32, 24, image::Rgb([i * 20, 7, 9]))
                .save(pictures.join(format!("{i:03}.png")))
                .unwrap();
        }
        let mut manifest = Take::open(&path).unwrap().manifest;
        manifest.source = risorius_formats::take::SourceKind::Images;
        manifest.media = "pictures".into();
        manifest.write(path.join("take.toml")).unwrap();
        Self { take: Take::open(&path).unwrap(), dir }
    }

    /// Runs with a script whose `case "$1"` arms are given.
    fn run(&self, arms: &str, limit: Option<Duration>, reporter: &dyn Reporter) -> (Result<Run>, String) {
        let program = self.dir.path().join("colmap");
        let text = format!("#!/bin/sh\ncase \"$1\" in\nhelp) echo 'COLMAP 3.8 -- fake';;\n{arms}\nesac\n");
        fs::write(&program, text).unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        self.run_program(program, limit, reporter)
    }

    fn run_program(&self, program: PathBuf, limit: Option<Duration>, reporter: &dyn Reporter) -> (Result<Run>, String) {
        self.run_options(&Self::options(program, limit), reporter)
    }

    fn options(program: PathBuf, time_limit: Option<Duration>) -> ColmapOptions {
        ColmapOptions { program, time_limit, mask_face: MaskFace::On, ..ColmapOptions::default() }
    }

    fn run_options(&self, options: &ColmapOptions, reporter: &dyn Reporter) -> (Result<Run>, String) {
        let work = self.dir.path().join("work");
        let log = self.dir.path().join("colmap.log");
        let _ = fs::remove_file(&log);
        let result = keys::read(&self.take, &Track::default(), options, reporter)
            .and_then(|keys| run(&self.take, options, keys, &work, &log, Path::new("final.log"), reporter));
        (result, fs::read_to_string(log).unwrap_or_default())
    }
}

/// Hears progress; asks to stop after some steps.
#[derive(Default)]
struct Listener {
    steps: std::sync::Mutex<Vec<(String, u64)>>,
    stop_in: Option<&'static str>,
}

impl Reporter for Listener {
    fn stage(&self, name: &str, _: Option<u64>) {
        self.steps.lock().unwrap().push((name.to_owned(), 0));
    }
    fn advance(&self, steps: u64) {
        self.steps.lock().unwrap().last_mut().unwrap().1 += steps;
    }
    fn note(&self, _: &str) {}
    fn warn(&self, _: Warning) {}
    fn cancelled(&self) -> bool {
        self.stop_in.is_some_and(|s| self.steps.lock().unwrap().last().is_some_and(|l| l.0 == s))
    }
}

/// The arms of a mapper that places `count` images.
fn mapper(count: usize) -> String {
    let lines: Vec<String> = (0..count).map(|i| format!("{} 1 0 0 0 {i} 0 5 1 {i:06}.png\\n\\n", i + 1)).collect();
    let images = lines.concat();
    format!(
        "feature_extractor) for i in 1 2 3 10; do echo \"Processed file [$i/10]\"; done;;\nmatches_importer) ;;\nmapper) shift; while [ \"$1\" != --output_path ]; do shift; done; mkdir \"$2/0\"; cd \"$2/0\"
echo 'Registering image #4 (3)'; echo 'Registering image #9 (10)'
echo '1 SIMPLE_RADIAL 32 24 30 16 12 0' > cameras.txt; printf '{images}' > images.txt; : > points3D.txt;;"
    )
}

#[test]
fn a_whole_run_reads_progress_from_the_log_and_tells_the_flags() {
    let stage = Stage::new();
    let listener = Listener::default();
    let (result, log) = stage.run(&mapper(10), None, &listener);
    let run = result.unwrap();
    assert_eq!((run.keyframes.len(), run.found.model.frames.len()), (10, 10));
    let steps = listener.steps.into_inner().unwrap();
    let of = |name: &str| steps.iter().find(|s| s.0 == name).unwrap().1;
    assert_eq!((of("key frames"), of("features"), of("compare pictures"), of("map")), (10, 10, 45, 10));
    assert!(log.contains("--SiftExtraction.use_gpu 0") && log.contains("--SiftMatching.use_gpu 0"), "{log}");
    assert!(stage.dir.path().join("work/masks/000003.png.png").is_file());
    assert!(stage.dir.path().join("work/images/000009.png").is_file());
}

#[test]
fn the_mapper_s_progress_is_read_in_old_and_new_words() {
    let old = "Registering image #12 (34)";
    let new = "I20260314 12:00:00.5 77 incremental_pipeline.cc:524] Registering image #12 (num_reg_frames=34)";
    assert_eq!((images_placed(old), images_placed(new)), (Some(34), Some(34)));
    assert_eq!(images_placed("I20260314 x.cc:7] Registering initial image pair #1 and #2"), None);
    assert_eq!(images_placed("Bundle adjustment (3)"), None);
}

#[test]
fn a_python_with_pycolmap_does_the_steps_and_one_without_is_told() {
    let stage = Stage::new();
    let python = stage.dir.path().join("python3.12");
    // Gets `-c TEXT step …`; `colmap` of the other tests stands in for what the text does.
    let text = "#!/bin/sh\n[ \"$1\" = -c ] && shift 2\nexec \"$(dirname \"$0\")/colmap\" \"$@\"\n";
    fs::write(&python, text).unwrap();
    fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
    // Writes `colmap`.
    assert!(stage.run(&mapper(10), None, &Collected::default()).0.is_ok());
    let (result, log) = stage.run_program(python.clone(), None, &Collected::default());
    let run = result.unwrap();
    assert!(run.notes[0].contains("COLMAP 3.8 by pycolmap"), "{:?}", run.notes);
    assert!(log.contains("mapper --database_path") && !log.contains("import pycolmap"), "{log}");
    fs::write(&python, "#!/bin/sh\necho \"No module named 'pycolmap'\" >&2; exit 1\n").unwrap();
    let error = stage.run_program(python, None, &Collected::default()).0.unwrap_err();
    assert!(matches!(&error, TrackerError::ColmapMissing { reason, .. } if reason.contains("pycolmap")), "{error}");
    assert!(error.hint().unwrap().contains("pip install pycolmap"));
}

#[test]
fn too_few_placed_frames_are_refused_with_advice() {
    let stage = Stage::new();
    let (result, _) = stage.run(&mapper(3), None, &Collected::default());
    let error = result.unwrap_err();
    assert!(matches!(error, TrackerError::FewRegistered { registered: 3, tried: 10 }), "{error}");
    assert!(error.hint().unwrap().contains("--accept-poor"));
}

#[test]
fn a_run_that_was_killed_goes_on_where_it_was_and_another_job_starts_afresh() {
    let stage = Stage::new();
    let killed = "feature_extractor|matches_importer) ;;\nmapper) shift; while [ \"$1\" != --output_path ]; do shift; done; mkdir \"$2/0\"; : > \"$2/0/images.txt\"; : > \"$2/0/cameras.txt\"; kill -9 $$;;";
    let (result, log) = stage.run(killed, None, &Collected::default());
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapFailed { .. }));
    assert!(log.contains("feature_extractor") && log.contains("matches_importer"));
    // The half model is gone; features and comparisons are not made again.
    let (result, log) = stage.run(&mapper(10), None, &Collected::default());
    let run = result.unwrap();
    assert_eq!(run.found.model.frames.len(), 10);
    assert!(!log.contains("feature_extractor") && !log.contains("matches_importer") && log.contains("mapper"), "{log}");
    assert!(run.notes.iter().any(|n| n.contains("went on")), "{:?}", run.notes);
    // All done: COLMAP is only asked for its version.
    let (result, log) = stage.run("*) exit 7;;", None, &Collected::default());
    assert!(result.is_ok() && !log.contains("mapper"), "{log}");
    // Another job.
    let options = ColmapOptions { max_features: 700, ..Stage::options(stage.dir.path().join("colmap"), None) };
    let (result, log) = stage.run_options(&options, &Collected::default());
    assert!(result.is_err() && log.contains("feature_extractor"), "{log}");
}

#[test]
fn features_of_a_run_that_was_killed_among_them_are_made_afresh() {
    let stage = Stage::new();
    // With features of the first run COLMAP takes a second camera for the rest.
    let killed = "feature_extractor) : > \"$3\"; : > \"$3-journal\"; kill -9 $$;;";
    let (result, _) = stage.run(killed, None, &Collected::default());
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapFailed { .. }));
    let database = stage.dir.path().join("work/database.db");
    assert!(database.is_file());
    let afresh = "feature_extractor) if [ -e \"$3\" ] || [ -e \"$3-journal\" ]; then exit 5; fi;;\n";
    let (result, log) = stage.run(
        &mapper(10).replacen("feature_extractor)", &format!("{afresh}other)"), 1),
        None,
        &Collected::default(),
    );
    assert!(result.is_ok(), "{log}");
}

#[test]
fn a_take_of_a_few_frames_is_refused() {
    let stage = Stage::new();
    let options = ColmapOptions { keyframes: Some(5), ..Stage::options("colmap".into(), None) };
    let error = stage.run_options(&options, &Collected::default()).0.unwrap_err();
    assert!(matches!(error, TrackerError::FewFrames { frames: 5 }) && error.hint().is_some(), "{error}");
}

#[test]
fn a_failing_step_is_named_with_its_last_words() {
    let stage = Stage::new();
    let (result, log) =
        stage.run("feature_extractor) echo begun; echo 'no memory left' >&2; exit 3;;", None, &Collected::default());
    let error = result.unwrap_err();
    assert!(
        matches!(&error, TrackerError::ColmapFailed { step, last_line, .. } if step == "feature_extractor" && last_line == "no memory left"),
        "{error}"
    );
    assert!(error.hint().unwrap().contains("final.log") && log.contains("begun"));
}

#[test]
fn a_step_that_hangs_is_ended_at_the_time_limit_or_on_request() {
    let stage = Stage::new();
    let arms = "feature_extractor) sleep 60;;";
    let begun = Instant::now();
    let (result, _) = stage.run(arms, Some(Duration::from_millis(1500)), &Collected::default());
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapTimeout { .. }));
    let listener = Listener { stop_in: Some("features"), ..Listener::default() };
    let (result, _) = stage.run(arms, None, &listener);
    assert!(matches!(result.unwrap_err(), TrackerError::Cancelled { .. }));
    assert!(begun.elapsed() < Duration::from_secs(40), "{:?}", begun.elapsed());
}

#[test]
fn no_model_is_told_apart_from_a_crash() {
    let stage = Stage::new();
    let start = "feature_extractor|matches_importer) ;;\n";
    let afresh = || work::remove(&stage.dir.path().join("work")).unwrap();
    let (result, _) = stage.run(
        &format!("{start}mapper) echo 'ERROR: failed to create sparse model'; exit 1;;"),
        None,
        &Collected::default(),
    );
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapNoModel { tried: 10, .. }));
    // 4.0 says it in other words.
    afresh();
    let (result, _) = stage.run(
        &format!("{start}mapper) echo 'E0101 sfm.cc:288] Failed to create any sparse model' >&2; exit 1;;"),
        None,
        &Collected::default(),
    );
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapNoModel { tried: 10, .. }));
    afresh();
    let (result, _) = stage.run(&format!("{start}mapper) exit 0;;"), None, &Collected::default());
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapNoModel { .. }));
    afresh();
    let (result, _) = stage.run(&format!("{start}mapper) kill -9 $$;;"), None, &Collected::default());
    assert!(matches!(result.unwrap_err(), TrackerError::ColmapFailed { .. }));
}

#[test]
fn a_missing_program_is_found_out_before_any_work() {
    let stage = Stage::new();
    let (result, _) = stage.run_program("no-such-colmap-here".into(), None, &Collected::default());
    let error = result.unwrap_err();
    assert!(matches!(error, TrackerError::ColmapMissing { .. }), "{error}");
    assert!(error.hint().unwrap().contains("apt-get install colmap"));
    assert!(!stage.dir.path().join("work/images").exists());
    // A file that is no program.
    let text = stage.dir.path().join("text");
    fs::write(&text, "x").unwrap();
    assert!(matches!(
        stage.run_program(text, None, &Collected::default()).0.unwrap_err(),
        TrackerError::ColmapMissing { .. }
    ));
}
