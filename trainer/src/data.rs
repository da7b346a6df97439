//! A dataset in memory: images as bytes, one camera per frame, region labels, AUs. Rays are made on the fly
//! (fact sheet §2.4: materialised rays would take 100 times the memory).

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use image::RgbImage;
use rayon::prelude::*;
use risorius_formats::intensities::Intensities;
use risorius_formats::landmark_table::LandmarkTable;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Dataset, Extras};
use risorius_formats::{Attribute, AttributeSpec, AttributeTable, AuScale, Camera, Intensity, Reporter, hash, package};

use crate::error::{Result, TrainerError};

/// One training frame.
#[derive(Clone, Debug)]
pub struct TrainFrame {
    /// Its id in the dataset.
    pub id: String,
    /// The camera, for the image at the scale in memory.
    pub camera: Camera,
    /// RGB bytes, row by row.
    pub pixels: Vec<u8>,
    /// Region labels, where the frame has masks.
    pub labels: Option<Vec<u8>>,
    /// Which pixels may be fitted (non-zero), row by row; `None` means all.
    pub valid: Option<Vec<u8>>,
    /// The attributes; `None` when the frame has no annotation.
    pub attributes: Option<Vec<Attribute>>,
    /// The intensities behind them, where the dataset tells them; those of AUs that never moved are the neutral ones.
    pub intensities: Option<Vec<Intensity>>,
    /// The 68 facial landmarks in pixels of the image in memory, where the dataset has them.
    pub landmarks_px: Option<[[f32; 2]; 68]>,
    /// Pixels by index, for fits that draw single ones.
    pub lists: PixelLists,
}

/// Pixels of a frame by index, listed when they are first asked for: they take four times the memory of the masks.
#[derive(Clone, Debug, Default)]
pub struct PixelLists {
    valid: OnceLock<Vec<u32>>,
    region: OnceLock<Vec<u32>>,
}

impl TrainFrame {
    /// Pixels that may be fitted, by index; `None` means all.
    pub fn valid_pixels(&self) -> Option<&[u32]> {
        let mask = self.valid.as_ref()?;
        Some(self.lists.valid.get_or_init(|| listed(mask, |_| true)))
    }

    /// Pixels inside a region (and valid), by index.
    pub fn region_pixels(&self) -> &[u32] {
        let is_valid = |i: usize| self.valid.as_ref().is_none_or(|v| v[i] > 0);
        self.lists.region.get_or_init(|| self.labels.as_ref().map(|l| listed(l, is_valid)).unwrap_or_default())
    }
}

/// Where a mask is set, and `also` holds.
fn listed(mask: &[u8], also: impl Fn(usize) -> bool) -> Vec<u32> {
    (0..mask.len()).filter(|&i| mask[i] > 0 && also(i)).map(|i| i as u32).collect()
}

/// A dataset ready for fitting.
#[derive(Clone, Debug)]
pub struct TrainData {
    /// The dataset's folder.
    pub dir: PathBuf,
    /// SHA-256 over its manifest files.
    pub sha256: String,
    /// The frames to fit.
    pub frames: Vec<TrainFrame>,
    /// The attributes and regions.
    pub table: AttributeTable,
    /// Bounds of the scene.
    pub dataset: Dataset,
    /// Image scale in memory.
    pub scale: u32,
}

impl TrainData {
    /// Loads the training frames at `scale` (0 for the dataset's default).
    pub fn load(dir: impl AsRef<Path>, scale: u32, reporter: &dyn Reporter) -> Result<Self> {
        Self::load_every(dir, scale, 0, reporter)
    }

    /// The same with the frames split anew: see [`split`].
    pub fn load_every(dir: impl AsRef<Path>, scale: u32, interval: usize, reporter: &dyn Reporter) -> Result<Self> {
        let dir = dir.as_ref();
        let mut dataset = Dataset::read(dir)?;
        (dataset.train_ids, dataset.val_ids) = split(&dataset, interval);
        let table = AttributeTable::read(dir.join("attributes.toml"))?;
        let fail = |message: String, hint: &str| TrainerError::Dataset {
            path: dir.to_owned(),
            message,
            hint: hint.to_owned(),
        };
        if !dataset.scene.is_valid() {
            return Err(fail(
                "scene.json states bounds that make no sense".to_owned(),
                "build the dataset again; near must lie below far",
            ));
        }
        if dataset.train_ids.is_empty() {
            return Err(fail("holds no training frames".to_owned(), "see `dataset verify`"));
        }
        let scale = if scale > 0 { scale } else { dataset.extras.as_ref().map_or(4, |e| e.default_scale) };
        let intensities = Intensities::read(dir)?;
        let landmarks = LandmarkTable::read(dir)?;
        reporter.stage("load", Some(dataset.train_ids.len() as u64));
        let frames = dataset
            .train_ids
            .par_iter()
            .map(|id| {
                let mut frame = load_frame(dir, &dataset, &table, id, scale)?;
                frame.intensities = intensities.as_ref().and_then(|i| intensities_of(i, &table, id));
                frame.landmarks_px = landmarks.as_ref().and_then(|l| landmarks_at(l, id, scale));
                reporter.advance(1);
                Ok(frame)
            })
            .collect::<Result<Vec<_>>>()?;
        let manifests = [
            "dataset.json",
            "metadata.json",
            "scene.json",
            "attributes.toml",
            "annotations.yml",
            "intensities.csv",
            "landmarks.csv",
        ];
        let hashes: Vec<String> =
            manifests.iter().filter_map(|name| hash::sha256_of_file(dir.join(name)).ok()).collect();
        Ok(Self {
            dir: dir.to_owned(),
            sha256: hash::sha256_of_bytes(hashes.join(" ").as_bytes()),
            frames,
            table,
            dataset,
            scale,
        })
    }

    /// Bytes of memory that the frames take, with lists of pixels.
    pub fn bytes(&self) -> u64 {
        let of = |f: &TrainFrame| {
            let lists = f.valid_pixels().map_or(0, <[u32]>::len) + f.region_pixels().len();
            let masks = [&f.labels, &f.valid].into_iter().flatten().map(Vec::len).sum::<usize>();
            f.pixels.len() + masks + 4 * lists
        };
        self.frames.iter().map(|f| of(f) as u64).sum()
    }

    /// Our additions to the dataset, where it is ours.
    pub fn extras(&self) -> Option<&Extras> {
        self.dataset.extras.as_ref()
    }

    /// Whether the intensities of every annotated frame are known, and not only the attributes, which eq. 1 caps.
    pub fn has_intensities(&self) -> bool {
        self.frames.iter().all(|f| f.attributes.is_none() || f.intensities.is_some())
    }

    /// Index of the most neutral frame: the one that the dataset names, else the smallest distance of its attributes
    /// from the capture's neutral face.
    pub fn neutral_frame(&self) -> usize {
        let named = self.extras().and_then(|e| e.neutral_id.as_ref());
        if let Some(index) = named.and_then(|id| self.frames.iter().position(|f| f.id == *id)) {
            return index;
        }
        let neutral: Vec<Attribute> = self.table.attributes.iter().map(AttributeSpec::neutral_attribute).collect();
        let distance = |f: &TrainFrame| match &f.attributes {
            Some(a) => a.iter().zip(&neutral).map(|(a, n)| (a.0 - n.0).powi(2)).sum(),
            None => f32::INFINITY,
        };
        (0..self.frames.len())
            .min_by(|&a, &b| distance(&self.frames[a]).total_cmp(&distance(&self.frames[b])))
            .unwrap_or(0)
    }
}

/// Frames for fitting and held-out ones. With an `interval` (even), as the released loader does it, whatever the
/// dataset's lists say: every so many frames is fitted, the one in the middle between two is held out, the rest is not
/// used. With 0, the dataset's own lists.
pub fn split(dataset: &Dataset, interval: usize) -> (Vec<String>, Vec<String>) {
    if interval < 2 {
        return (dataset.train_ids.clone(), dataset.val_ids.clone());
    }
    let mut ids = dataset.ids.clone();
    ids.sort_by_cached_key(|id| (dataset.source_frame(id), id.clone()));
    let train: Vec<usize> = (0..ids.len()).step_by(interval).collect();
    let held = train.windows(2).map(|w| ids[usize::midpoint(w[0], w[1])].clone()).collect();
    (train.into_iter().map(|i| ids[i].clone()).collect(), held)
}

fn load_frame(dir: &Path, dataset: &Dataset, table: &AttributeTable, id: &str, scale: u32) -> Result<TrainFrame> {
    let path = nerfies::rgb_path(dir, scale, id);
    package::check_file(dir, &path)?;
    let image = read_rgb(&path)?;
    let fail = |message: String| TrainerError::Dataset {
        path: path.clone(),
        message,
        hint: "see `dataset verify`; another image scale is chosen with `--image-scale`".to_owned(),
    };
    let full = dataset.cameras.get(id).ok_or_else(|| fail(format!("frame `{id}` has no camera")))?;
    let camera = full.reduced(scale);
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    if image.dimensions() != (width, height) {
        return Err(fail(format!("is {}×{}, but its camera says {width}×{height}", image.width(), image.height())));
    }
    let pixel_count = width as usize * height as usize;
    let read_labels = |path: PathBuf| -> Result<Option<Vec<u8>>> {
        if !path.is_file() {
            return Ok(None);
        }
        package::check_file(dir, &path)?;
        let labels = LabelImage::read_png(&path)?;
        if labels.labels.len() != pixel_count {
            return Err(fail(format!("its label image {} has another size", path.display())));
        }
        Ok(Some(labels.labels))
    };
    let labels = read_labels(nerfies::region_path(dir, scale, id))?;
    if let Some(bad) = labels.iter().flatten().find(|&&l| usize::from(l) > table.regions.len()) {
        return Err(fail(format!("its label image holds region {bad} of {}", table.regions.len())));
    }
    let valid = read_labels(nerfies::valid_path(dir, scale, id))?;
    if valid.as_ref().is_some_and(|v| v.iter().all(|&v| v == 0)) {
        return Err(fail("no pixel of it may be fitted".to_owned()));
    }
    Ok(TrainFrame {
        id: id.to_owned(),
        camera,
        pixels: image.into_raw(),
        labels,
        valid,
        attributes: attributes_of(dataset, table, id),
        intensities: None,
        landmarks_px: None,
        lists: PixelLists::default(),
    })
}

/// The annotated attributes of a frame: classes that are not listed are 0 when another one is (fact sheet §3.7).
fn attributes_of(dataset: &Dataset, table: &AttributeTable, id: &str) -> Option<Vec<Attribute>> {
    let frame: u32 = id.parse().ok()?;
    let range = annotation_range(dataset, frame);
    if range.is_empty() {
        return None;
    }
    let mut attributes = vec![Attribute(0.0); table.attributes.len()];
    for a in &dataset.annotations[range] {
        if let Some(slot) = attributes.get_mut(a.class) {
            *slot = Attribute(a.value.clamp(-1.0, 1.0));
        }
    }
    Some(attributes)
}

/// The intensities of a frame as they were fitted; `None` where that of an active AU is not told.
pub fn intensities_of(intensities: &Intensities, table: &AttributeTable, id: &str) -> Option<Vec<Intensity>> {
    let row = intensities.rows.get(id)?;
    let of = |scale: AuScale, unit| {
        let column = intensities.units.iter().position(|&u| u == unit);
        match column.and_then(|c| row.get(c)) {
            Some(&v) => Some(Intensity(v)),
            None => (!scale.is_active()).then(|| scale.neutral()),
        }
    };
    table.attributes.iter().map(|spec| of(spec.scale(), spec.unit)).collect()
}

/// The landmarks of a frame in pixels of its image at `scale`.
fn landmarks_at(landmarks: &LandmarkTable, id: &str, scale: u32) -> Option<[[f32; 2]; 68]> {
    let points = &landmarks.rows.get(id)?.points_px;
    Some(points.map(|p| p.map(|v| v / scale as f32)))
}

/// Annotations are sorted by frame by the reader of the folder.
fn annotation_range(dataset: &Dataset, frame: u32) -> std::ops::Range<usize> {
    let list = &dataset.annotations;
    list.partition_point(|a| a.frame < frame)..list.partition_point(|a| a.frame <= frame)
}

/// Reads an image file as RGB.
pub fn read_rgb(path: &Path) -> Result<RgbImage> {
    if !path.is_file() {
        return Err(risorius_formats::FormatError::new(risorius_formats::ErrorKind::Missing, "does not exist")
            .in_file(path)
            .with_hint("something removed it: make the folder anew, or see `dataset verify` for what else is missing")
            .into());
    }
    let image = image::open(path).map_err(|e| TrainerError::Image { path: path.to_owned(), message: e.to_string() })?;
    Ok(image.into_rgb8())
}
