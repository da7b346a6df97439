//! Where the AU models lie in an OpenFace install.
//!
//! `AU_predictors/main_dynamic_svms.txt` names the list of predictors, the point model and the triangles, one `MODULE FILE` a
//! line, relative to itself; the list (`AU_all_best.txt`) names `FILE AU` a line. Builds have `AU_predictors` and `model` beside
//! the programs, the sources under `lib/local`, `make install` under `etc/OpenFace`.

use std::path::{Path, PathBuf};

use risorius_formats::{ActionUnit, FormatError};

use crate::error::{Result, TrackerError};

/// The file that names the others.
const MAIN: &str = "main_dynamic_svms.txt";
/// The list of predictors, where nothing else is named.
const LIST: &str = "AU_all_best.txt";
const POINT_MODEL: &str = "In-the-wild_aligned_PDM_68.txt";
const TRIANGLES: &str = "tris_68_full.txt";
/// Where the folder may lie, seen from the folder that the user names.
const PLACES: [&str; 7] = [
    "AU_predictors",
    "",
    "../AU_predictors",
    "build/bin/AU_predictors",
    "bin/AU_predictors",
    "lib/local/FaceAnalyser/AU_predictors",
    "etc/OpenFace/AU_predictors",
];
/// Where the point model may lie, seen from `AU_predictors`.
const POINT_MODEL_PLACES: [&str; 4] = ["", "../model/pdms", "../../LandmarkDetector/model/pdms", "../pdms"];
/// Where the triangles may lie, seen from `AU_predictors`.
const TRIANGLE_PLACES: [&str; 3] = ["", "../model", "../../LandmarkDetector/model"];

/// The files of an install.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelFiles {
    /// `AU_all_best.txt` or what takes its place.
    pub list: PathBuf,
    /// Each predictor's file with the AUs that it gives.
    pub predictors: Vec<(PathBuf, Vec<ActionUnit>)>,
    /// The point model.
    pub point_model: PathBuf,
    /// The triangles over the 68 points.
    pub triangles: PathBuf,
}

impl ModelFiles {
    /// Finds the files from the install's root, its `AU_predictors` or its `model` folder.
    pub fn find(dir: &Path) -> Result<Self> {
        let places: Vec<PathBuf> =
            PLACES.iter().map(|p| if p.is_empty() { dir.to_owned() } else { dir.join(p) }).collect();
        let is_folder = |p: &&PathBuf| p.join(MAIN).is_file() || p.join(LIST).is_file();
        let Some(folder) = places.iter().find(is_folder) else {
            let looked_for = places.iter().map(|p| p.join(LIST)).collect();
            return Err(TrackerError::NoOpenFaceModels { dir: dir.to_owned(), looked_for });
        };
        let named = modules(&folder.join(MAIN))?;
        let file = |module: &str, name: &str, places: &[&str]| {
            let named = named.iter().find(|(m, _)| m == module).map(|(_, file)| folder.join(file));
            let usual = places.iter().map(|p| folder.join(p).join(name));
            let tried: Vec<PathBuf> = named.into_iter().chain(usual).collect();
            tried
                .iter()
                .find(|p| p.is_file())
                .cloned()
                .ok_or_else(|| TrackerError::NoOpenFaceModels { dir: dir.to_owned(), looked_for: tried })
        };
        let list = file("AUPredictor", LIST, &[""])?;
        Ok(Self {
            predictors: read_list(&list)?,
            point_model: file("PDM", POINT_MODEL, &POINT_MODEL_PLACES)?,
            triangles: file("Triangulation", TRIANGLES, &TRIANGLE_PLACES)?,
            list,
        })
    }
}

/// What Windows writes as `a\b` lies in `a/b`.
fn portable(name: &str) -> String {
    name.replace('\\', "/")
}

fn modules(path: &Path) -> Result<Vec<(String, String)>> {
    if !path.is_file() {
        return Ok(Vec::new());
    }
    let text = text(path)?;
    let pair = |line: &str| {
        let mut words = line.split_whitespace();
        Some((words.next()?.to_owned(), portable(words.next()?)))
    };
    Ok(text.lines().filter_map(pair).collect())
}

fn text(path: &Path) -> Result<String> {
    let bytes = super::matrix::read(path)?;
    Ok(String::from_utf8(bytes).map_err(|_| super::matrix::damaged(path, "is not text"))?)
}

/// The predictors of a list; lines that name no AU of the table (`AU28`) are kept, blank ones passed over.
fn read_list(path: &Path) -> Result<Vec<(PathBuf, Vec<ActionUnit>)>> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut predictors = Vec::new();
    for (number, line) in text(path)?.lines().enumerate() {
        let mut words = line.split([' ', '\t', ',']).map(str::trim).filter(|w| !w.is_empty());
        let Some(file) = words.next() else { continue };
        let units = words.map(str::parse).collect::<Result<Vec<ActionUnit>, FormatError>>();
        let units = units.map_err(|e| e.at_line(number as u64 + 1).in_file(path))?;
        if units.is_empty() {
            let error = super::matrix::damaged(path, format!("`{file}` names no AU")).at_line(number as u64 + 1);
            return Err(error.into());
        }
        predictors.push((folder.join(portable(file)), units));
    }
    if predictors.is_empty() {
        return Err(super::matrix::damaged(path, "names no predictor").into());
    }
    Ok(predictors)
}
