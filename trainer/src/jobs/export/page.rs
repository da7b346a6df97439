//! The avatar as one HTML file that draws it with every AU, from disk, without a network.
//!
//! The file holds the page, its script (`page/*.js` and the player and sliders of `trainer view`, joined), what is known of the
//! avatar as JSON, and its numbers as base64 of a gzip stream of a safetensors file (see [`numbers`]). AU deltas
//! have their gates multiplied in; those of the latent code, which renders leave at 0, are not written.

mod numbers;

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use flate2::Compression;
use flate2::write::GzEncoder;
use risorius_formats::curves::{ARKIT, CurveOptions};
use risorius_formats::{ActionUnit, AttributeSpec, Camera, Curves, FormatError, Reporter, atomic};
use serde::Serialize;

use super::cloud;
use crate::avatar::Avatar;
use crate::error::Result;
use crate::presets::{PRESETS, Preset};
use crate::saved::{SavedModel, damaged};
use crate::splat::SplatField;
use crate::view::{AuInfo, CurvesDocument, shown_name};

const PAGE: &str = include_str!("page/page.html");
const STYLE: [&str; 2] = [include_str!("../../view/page/style.css"), include_str!("page/page.css")];
/// The modules, each after those that it imports.
const MODULES: [&str; 10] = [
    include_str!("../../view/page/panel.js"),
    include_str!("../../view/page/player.js"),
    include_str!("page/data.js"),
    include_str!("page/camera.js"),
    include_str!("page/blend.js"),
    include_str!("page/shaders.js"),
    include_str!("page/gpu.js"),
    include_str!("page/table.js"),
    include_str!("page/gestures.js"),
    include_str!("page/main.js"),
];

/// What the page begins with.
#[derive(Clone, Debug)]
pub struct PageSettings {
    name: String,
    aus: BTreeMap<ActionUnit, f32>,
    curves: Option<CurvesDocument>,
}

impl PageSettings {
    /// A page named after `run` that begins with the intensities `aus` (those left out neutral) and offers `curves` to play.
    pub fn new(
        run: &Path,
        aus: BTreeMap<ActionUnit, f32>,
        curves: Option<&Path>,
        options: &CurveOptions,
        reporter: &dyn Reporter,
    ) -> Result<Self> {
        let curves = match curves {
            Some(path) => Some(CurvesDocument::new(shown_name(path), &Curves::read_with(path, options, reporter)?)),
            None => None,
        };
        Ok(Self { name: shown_name(run), aus, curves })
    }
}

/// What was written.
#[derive(Clone, Debug, Serialize)]
pub struct PageSummary {
    /// The file.
    pub file: PathBuf,
    /// Gaussians.
    pub gaussians: usize,
    /// Of these, those that carry deltas.
    pub deformable: usize,
    /// The AUs that move the avatar.
    pub aus: Vec<String>,
    /// Bytes of the file.
    pub bytes: usize,
    /// Bytes of the avatar's numbers, compressed.
    pub numbers_bytes: usize,
    /// The greatest error that deltas have by quantisation with one AU at its strongest, millimetres.
    pub most_mm: f64,
    /// The same of colours, levels of 255.
    pub most_levels: f64,
}

/// What the page knows of the avatar besides its numbers.
#[derive(Serialize)]
struct Info<'a> {
    name: &'a str,
    width: u32,
    height: u32,
    regions: &'a [String],
    aus: Vec<AuInfo>,
    presets: &'static [Preset],
    seen_deg: [f64; 2],
    curves: Option<&'a CurvesDocument>,
    /// ARKit's coefficients of each AU, for tables of Live Link Face.
    arkit: BTreeMap<String, &'static [&'static str]>,
    /// Intensities to begin with.
    begin: &'a BTreeMap<ActionUnit, f32>,
    /// Per AU of the table: what turns intensities into activations.
    scales: Vec<Scale>,
    /// Whether activations go on beyond 80 % of the strongest.
    intensities: bool,
    camera: PageCamera,
    gaussians: usize,
    deformable: usize,
    /// Indices of the AUs that have deltas, in their order.
    moving: Vec<usize>,
    /// The picture behind everything, as a data URL.
    plate: Option<String>,
    written_by: &'static str,
}

/// `activation = (clamp(intensity, least, most) − least) / width` (see `risorius_formats::AuScale`).
#[derive(Serialize)]
struct Scale {
    least: f32,
    most: f32,
    width: f32,
}

impl From<&AttributeSpec> for Scale {
    fn from(spec: &AttributeSpec) -> Self {
        Self { least: spec.au_min, most: spec.au_max, width: spec.au_max_scale * spec.au_max - spec.au_min }
    }
}

/// The avatar's own camera in the Gaussians' space: pixels and metres.
#[derive(Serialize)]
struct PageCamera {
    width: u32,
    height: u32,
    focal: [f64; 2],
    middle: [f64; 2],
    skew: f64,
    /// OpenCV's k1 k2 k3 k4 k5 k6 p1 p2, if the lens bends.
    distortion: Option<[f64; 8]>,
    /// Rows.
    rotation: [f64; 9],
    translation: [f64; 3],
    /// The head's middle.
    center: [f64; 3],
}

impl PageCamera {
    fn new(saved: &SavedModel, field: &SplatField) -> Self {
        let camera = field.space().camera(&Camera::from(&saved.default_camera));
        let (i, pose) = (&camera.intrinsics, &camera.camera_from_world);
        let d = &i.distortion;
        let ([k1, k2, k3], [k4, k5, k6], [p1, p2]) = (d.radial, d.radial_denominator, d.tangential);
        Self {
            width: i.width,
            height: i.height,
            focal: [i.fx, i.fy],
            middle: [i.cx, i.cy],
            skew: i.skew,
            distortion: (!d.is_none()).then_some([k1, k2, k3, k4, k5, k6, p1, p2]),
            rotation: pose.rotation.transpose().to_cols_array(),
            translation: pose.translation.to_array(),
            center: field.space().point(saved.center_in_world).to_array(),
        }
    }
}

/// Writes the page.
pub fn export_page(avatar: &Avatar, settings: &PageSettings, file: &Path) -> Result<PageSummary> {
    let field = cloud::gaussians_of(avatar)?;
    let saved = &avatar.saved;
    let table = &saved.table.attributes;
    let numbers = numbers::Numbers::new(avatar, field);
    let raw = numbers.to_safetensors().map_err(|e| damaged(file, &e))?;
    let io = |e: std::io::Error| FormatError::io(file, "compress", &e);
    let mut packed = GzEncoder::new(Vec::new(), Compression::best());
    packed.write_all(&raw).map_err(io)?;
    let packed = packed.finish().map_err(io)?;
    let info = Info {
        name: &settings.name,
        width: saved.default_camera.width,
        height: saved.default_camera.height,
        regions: &saved.table.regions,
        aus: table.iter().map(AuInfo::from).collect(),
        presets: &PRESETS,
        // `orbit_rad` is three quarters of what is covered.
        seen_deg: saved.orbit_rad.map(|a| (a / 0.75).to_degrees()),
        curves: settings.curves.as_ref(),
        arkit: ARKIT.iter().map(|(unit, names)| (ActionUnit(*unit).to_string(), *names)).collect(),
        begin: &settings.aus,
        scales: table.iter().map(Scale::from).collect(),
        intensities: field.knows_intensities(),
        camera: PageCamera::new(saved, field),
        gaussians: numbers.gaussians,
        deformable: numbers.deformable,
        moving: numbers.moving.clone(),
        plate: field.plate().map(|plate| data_url(plate, file)).transpose()?,
        written_by: concat!("risorius ", env!("CARGO_PKG_VERSION")),
    };
    let info = serde_json::to_string(&info).map_err(|e| damaged(file, &e))?;
    let page = page(&settings.name, &info, &STANDARD.encode(&packed));
    atomic::write_file(file, page.as_bytes())?;
    Ok(PageSummary {
        file: file.to_owned(),
        gaussians: numbers.gaussians,
        deformable: numbers.deformable,
        aus: numbers.moving.iter().map(|&k| table[k].unit.to_string()).collect(),
        bytes: page.len(),
        numbers_bytes: packed.len(),
        most_mm: numbers.most_mm,
        most_levels: numbers.most_levels,
    })
}

fn data_url(plate: &crate::splat::plate::Plate, file: &Path) -> Result<String> {
    use image::ImageEncoder as _;
    let mut png = Vec::new();
    image::codecs::png::PngEncoder::new(&mut png)
        .write_image(&plate.rgb, plate.width, plate.height, image::ExtendedColorType::Rgb8)
        .map_err(|e| damaged(file, &e))?;
    Ok(format!("data:image/png;base64,{}", STANDARD.encode(&png)))
}

/// Puts the page together. Its marks are HTML comments: in JSON `<` is escaped, and base64 has none.
fn page(name: &str, info: &str, numbers: &str) -> String {
    let title = name.replace('&', "&amp;").replace('<', "&lt;");
    let parts = [
        ("<!--title-->", title.as_str()),
        ("/*style*/", &STYLE.concat()),
        ("<!--info-->", &info.replace('<', "\\u003c")),
        ("<!--numbers-->", numbers),
        ("/*script*/", &joined(&MODULES)),
    ];
    let mut rest = PAGE;
    let mut out = String::with_capacity(numbers.len() + 100_000);
    for (mark, with) in parts {
        let Some((before, after)) = rest.split_once(mark) else { continue };
        out.push_str(before);
        out.push_str(with);
        rest = after;
    }
    out.push_str(rest);
    out
}

/// One module of several that share their top level: browsers load no modules from `file://`.
fn joined(modules: &[&str]) -> String {
    let lines = modules.iter().flat_map(|m| m.lines());
    lines
        .filter(|line| !line.starts_with("import "))
        .flat_map(|line| [line.strip_prefix("export ").unwrap_or(line), "\n"])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_are_joined_without_imports_and_exports() {
        let script = joined(&["import { a } from \"./a.js\";\nexport function b() {}", "const c = b();"]);
        assert_eq!(script, "function b() {}\nconst c = b();\n");
        let whole = joined(&MODULES);
        assert!(!whole.contains("</script") && !whole.lines().any(|l| l.starts_with("export")));
        // A shared top level: every name once.
        let names: Vec<&str> = whole
            .lines()
            .filter_map(|l| {
                ["const ", "let ", "function ", "class ", "async function "].iter().find_map(|k| l.strip_prefix(k))
            })
            .filter_map(|l| l.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == '$')).find(|w| !w.is_empty()))
            .collect();
        let mut once = names.clone();
        once.sort_unstable();
        once.dedup();
        assert_eq!(once.len(), names.len(), "{names:?}");
    }

    #[test]
    fn a_page_asks_for_nothing_and_escapes_what_it_is_given() {
        let page = page("a<b>&c", r#"{"name":"</script><!--numbers-->"}"#, "QUJD");
        assert!(page.contains("a&lt;b>&amp;c") && page.contains("\\u003c/script>") && page.contains(">QUJD<"));
        assert!(!page.contains("http://") && !page.contains("https://") && !page.contains("src="));
        assert!(page.contains("default-src 'none'") && page.ends_with("</html>\n"));
    }
}
