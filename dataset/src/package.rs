//! Pictures and masks on disk: one pass over each video, pictures reduced and encoded by all cores while it is decoded.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};

use glam::DVec3;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, RgbImage};
use risorius_formats::nerfies::{self, Polygons};
use risorius_formats::{Camera, FormatError, Intrinsics, Reporter};

use crate::align::TakeInput;
use crate::error::{DatasetError, Result};
use crate::regions::{self, RegionStyle};
use crate::sheet::{self, Thumbnail};
use crate::{raster, scale};

/// A frame to write.
#[derive(Clone, Debug)]
pub struct Job {
    /// Its id.
    pub id: String,
    /// Index of its take.
    pub take: usize,
    /// Its number in the take.
    pub frame: u32,
    /// Its camera, for the trimmed full-size picture.
    pub camera: Camera,
    /// Its regions, where it has any.
    pub polygons: Option<Polygons>,
    /// Corners of the head's hull, where only the head may be fitted.
    pub hull: Option<Arc<Vec<DVec3>>>,
    /// Corners of the head's hull, for the mask that tells head from background.
    pub head: Option<Arc<Vec<DVec3>>>,
    /// Whether it appears on the contact sheet.
    pub on_sheet: bool,
    /// Intensity 0–5 of each attribute, for the contact sheet.
    pub intensities: Vec<f32>,
}

/// Pictures that wait between decoder and encoders, per worker: bounds the memory.
const QUEUE_PER_WORKER: usize = 2;

/// Writes `rgb/`, `regions/`, `valid/`, `head/` and `annotations/` for `jobs`, which stand take after take in the order of
/// frames, and returns the contact sheet's pictures in that order.
pub(crate) fn write_pictures(
    dir: &Path,
    inputs: &[TakeInput],
    jobs: &[Job],
    styles: &[RegionStyle],
    scales: &[u32],
    reporter: &dyn Reporter,
) -> Result<Vec<Thumbnail>> {
    for &s in scales {
        create_parent(&nerfies::rgb_path(dir, s, "x"))?;
        create_parent(&nerfies::region_path(dir, s, "x"))?;
        if jobs.iter().any(|j| j.hull.is_some()) {
            create_parent(&nerfies::valid_path(dir, s, "x"))?;
        }
        if jobs.iter().any(|j| j.head.is_some()) {
            create_parent(&nerfies::head_path(dir, s, "x"))?;
        }
    }
    create_parent(&nerfies::polygons_path(dir, "x"))?;
    reporter.stage("write pictures", Some(jobs.len() as u64));
    let mut thumbnails = Vec::new();
    for (take, input) in inputs.iter().enumerate() {
        let jobs: Vec<&Job> = jobs.iter().filter(|j| j.take == take).collect();
        thumbnails.extend(write_take(dir, input, &jobs, styles, scales, reporter)?);
    }
    Ok(thumbnails)
}

fn create_parent(file: &Path) -> Result<()> {
    let Some(parent) = file.parent() else { return Ok(()) };
    std::fs::create_dir_all(parent).map_err(|e| FormatError::io(parent, "create the folder", &e).into())
}

fn write_take(
    dir: &Path,
    input: &TakeInput,
    jobs: &[&Job],
    styles: &[RegionStyle],
    scales: &[u32],
    reporter: &dyn Reporter,
) -> Result<Vec<Thumbnail>> {
    let media = input.take.media_path();
    let expected = (input.take.manifest.width, input.take.manifest.height);
    let wanted: Vec<u32> = jobs.iter().map(|j| j.frame).collect();
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let (sender, receiver) = mpsc::sync_channel::<(usize, RgbImage)>(QUEUE_PER_WORKER * workers);
    let receiver = Mutex::new(receiver);
    let failed = AtomicBool::new(false);
    let failure: Mutex<Option<DatasetError>> = Mutex::new(None);
    let thumbnails: Mutex<Vec<(usize, Thumbnail)>> = Mutex::new(Vec::new());
    let work = || {
        loop {
            let next = receiver.lock().unwrap_or_else(PoisonError::into_inner).recv();
            let Ok((place, image)) = next else { return };
            if failed.load(Ordering::Relaxed) {
                continue;
            }
            match write_frame(dir, jobs[place], &image, styles, scales) {
                Ok(thumbnail) => {
                    thumbnails.lock().unwrap_or_else(PoisonError::into_inner).extend(thumbnail.map(|t| (place, t)));
                    reporter.advance(1);
                }
                Err(error) => {
                    failed.store(true, Ordering::Relaxed);
                    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                }
            }
        }
    };
    let mut place = 0;
    let decoded = std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(work);
        }
        let outcome = risorius_video::read_take_frames(&input.take, &wanted, |index, image| {
            if reporter.cancelled() || failed.load(Ordering::Relaxed) {
                return Err(DatasetError::Cancelled);
            }
            let found = (image.width(), image.height());
            if found != expected {
                return Err(DatasetError::Size { path: media.clone(), what: "take.toml says", expected, found });
            }
            if wanted.get(place) != Some(&index) {
                return Err(DatasetError::MissingFrame {
                    path: media.clone(),
                    frame: wanted.get(place).copied().unwrap_or(index),
                });
            }
            place += 1;
            // The workers outlive this loop, so that somebody always receives.
            sender.send((place - 1, image)).map_err(|_| DatasetError::Cancelled)
        });
        drop(sender);
        outcome
    });
    if let Some(error) = failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
        return Err(error);
    }
    decoded?;
    if let Some(&frame) = wanted.get(place) {
        return Err(DatasetError::MissingFrame { path: media, frame });
    }
    let mut thumbnails = thumbnails.into_inner().unwrap_or_else(PoisonError::into_inner);
    thumbnails.sort_by_key(|t| t.0);
    Ok(thumbnails.into_iter().map(|t| t.1).collect())
}

fn write_frame(
    dir: &Path,
    job: &Job,
    image: &RgbImage,
    styles: &[RegionStyle],
    scales: &[u32],
) -> Result<Option<Thumbnail>> {
    let Intrinsics { width, height, .. } = job.camera.intrinsics;
    for &s in scales {
        let small = scale::reduced(image, s);
        write_png(
            &nerfies::rgb_path(dir, s, &job.id),
            small.as_raw(),
            small.width(),
            small.height(),
            ExtendedColorType::Rgb8,
        )?;
        let (w, h) = (width / s, height / s);
        if let Some(polygons) = &job.polygons {
            let labels = regions::label_image(polygons, styles, s, w, h);
            write_png(&nerfies::region_path(dir, s, &job.id), &labels.labels, w, h, ExtendedColorType::L8)?;
        }
        for (hull, path) in
            [(&job.hull, nerfies::valid_path(dir, s, &job.id)), (&job.head, nerfies::head_path(dir, s, &job.id))]
        {
            if let Some(hull) = hull {
                let mask = raster::hull_mask(hull, &job.camera.reduced(s));
                write_png(&path, &mask.labels, w, h, ExtendedColorType::L8)?;
            }
        }
    }
    if let Some(polygons) = &job.polygons {
        let file = Polygons {
            image_path: Some(format!("../rgb/1x/{}.png", job.id)),
            image_size: Some([width, height]),
            ..polygons.clone()
        };
        file.write(nerfies::polygons_path(dir, &job.id))?;
    }
    Ok(job.on_sheet.then(|| sheet::thumbnail(image, job, styles)))
}

/// Encodes 8-bit pixels fast rather than small and writes them.
pub(crate) fn write_png(path: &Path, pixels: &[u8], width: u32, height: u32, colour: ExtendedColorType) -> Result<()> {
    let fail = |message| DatasetError::Encode { path: path.to_owned(), message };
    let bytes = png_bytes(pixels, width, height, colour).map_err(fail)?;
    // The folder around it appears whole or not at all; the file needs no dance of its own.
    std::fs::write(path, bytes).map_err(|e| FormatError::io(path, "write", &e).into())
}

/// A PNG file of 8-bit pixels, made fast rather than small.
pub(crate) fn png_bytes(pixels: &[u8], width: u32, height: u32, colour: ExtendedColorType) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::with_capacity(pixels.len() / 2 + 1024);
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive);
    encoder.write_image(pixels, width, height, colour).map_err(|e| e.to_string())?;
    Ok(bytes)
}
