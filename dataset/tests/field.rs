//! Folders and names that went wrong in the hands of users, with the right answers.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

#[expect(dead_code, reason = "other tests use all of it")]
mod common;

use std::path::PathBuf;

use polars::prelude::{ParquetReader, SerReader};
use risorius_dataset::export::{ExportOptions, Target, export_with};
use risorius_dataset::import::{ImportOptions, import};
use risorius_dataset::verify::verify;
use risorius_dataset::{BuildOptions, build, tables};
use risorius_formats::{Hint, Silent};

fn field(path: &str) -> Option<PathBuf> {
    risorius_tests::shared(&format!("data/field/{path}"))
}

fn options() -> BuildOptions {
    BuildOptions { frames: 30, scale: 2, scales: vec![2, 4], ..BuildOptions::default() }
}

#[test]
fn what_nerfstudio_and_instant_ngp_write_has_no_problems() {
    for name in ["nerfstudio", "ngp", "floats"] {
        let Some(dir) = field(&format!("transforms/{name}")) else { return };
        let verdict = verify(&dir, &Silent);
        assert_eq!((verdict.frames, verdict.pictures, &verdict.problems[..]), (12, 12, &[][..]), "{name}");
        // The same with a lens that would be misread.
        let copy = tempfile::tempdir().unwrap();
        let text = std::fs::read_to_string(dir.join("transforms.json")).unwrap();
        let fisheye = text.replacen('{', "{\"camera_model\": \"OPENCV_FISHEYE\",", 1);
        let fisheye = if name == "ngp" { fisheye } else { text.replace("\"OPENCV\"", "\"OPENCV_FISHEYE\"") };
        std::fs::write(copy.path().join("transforms.json"), fisheye).unwrap();
        let problems = verify(copy.path(), &Silent).problems;
        assert!(problems.len() == 1 && problems[0].message.contains("OPENCV_FISHEYE"), "{name}: {problems:?}");
    }
}

#[test]
fn an_import_that_no_fit_could_open_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    common::take().write(&dir.path().join("take"));
    let (data, folder, back) = (dir.path().join("data"), dir.path().join("conerf"), dir.path().join("back"));
    build(&[dir.path().join("take")], &data, &options(), &Silent).unwrap();
    export_with(&data, Target::Nerfies, &folder, ExportOptions { plain: true }, &Silent).unwrap();
    import(&folder, &back, &ImportOptions::default(), &Silent).unwrap();
    std::fs::remove_dir_all(&back).unwrap();
    // As in released data: pictures were cropped before they were reduced, the cameras were not told.
    let picture = std::fs::read_dir(folder.join("rgb/4x")).unwrap().next().unwrap().unwrap().path();
    let whole = image::open(&picture).unwrap();
    whole.crop_imm(0, 0, whole.width() - 1, whole.height()).save(&picture).unwrap();
    let error = import(&folder, &back, &ImportOptions::default(), &Silent).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("1 problems") && text.contains("rgb/4x") && text.contains("its camera says"), "{text}");
    assert!(error.hint().unwrap().contains("dataset verify") && !back.exists());
    let found = verify(&folder, &Silent).problems;
    assert_eq!(found.len(), 1, "what the hint names finds it: {found:?}");
}

#[test]
fn names_of_takes_stay_texts() {
    let dir = tempfile::tempdir().unwrap();
    let takes: Vec<PathBuf> =
        ["001", "1", "2024-01-31"].iter().map(|name| dir.path().join("takes").join(name)).collect();
    for take in &takes {
        common::take().write(take);
    }
    let data = dir.path().join("data");
    build(&takes, &data, &BuildOptions { same_subject: true, ..options() }, &Silent).unwrap();
    for table in tables::TABLES {
        for name in ["001", "1", "2024-01-31"] {
            let path = tables::table_path(&data, table, name);
            let frame = ParquetReader::new(std::fs::File::open(&path).unwrap()).finish().unwrap();
            let names = frame.column("take").unwrap().str().unwrap().clone();
            assert!(names.iter().all(|n| n == Some(name)) && !names.is_empty(), "{}", path.display());
            // No part of the path is a value that a reader could take for a number or a date under the name `take`.
            assert!(!path.display().to_string().contains("take="), "{}", path.display());
        }
    }
}
