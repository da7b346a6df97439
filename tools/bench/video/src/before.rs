//! The reader through OpenCV that was there before: for comparison alone.

use std::path::Path;

use image::RgbImage;
use opencv::core::{Mat, MatTraitConst, Vec3b};
use opencv::prelude::VideoCaptureTrait;
use opencv::videoio::{self, VideoCapture};

pub(crate) fn read(path: &Path, each: &mut dyn FnMut(&RgbImage) -> bool) -> Result<(), String> {
    let words = |e: opencv::Error| e.message;
    let mut capture = VideoCapture::from_file(path, videoio::CAP_FFMPEG).map_err(words)?;
    let _ = capture.set(videoio::CAP_PROP_ORIENTATION_AUTO, 0.0);
    let mut bgr = Mat::default();
    while capture.grab().map_err(words)? && capture.retrieve_def(&mut bgr).map_err(words)? {
        if !each(&rgb(&bgr).map_err(words)?) {
            break;
        }
    }
    Ok(())
}

fn rgb(bgr: &Mat) -> opencv::Result<RgbImage> {
    let mut bytes = vec![0u8; bgr.total() * 3];
    let mut out = Mat::new_rows_cols_with_bytes_mut::<Vec3b>(bgr.rows(), bgr.cols(), &mut bytes)?;
    opencv::imgproc::cvt_color_def(bgr, &mut out, opencv::imgproc::COLOR_BGR2RGB)?;
    drop(out);
    RgbImage::from_raw(bgr.cols() as u32, bgr.rows() as u32, bytes)
        .ok_or_else(|| opencv::Error::new(opencv::core::StsUnmatchedSizes, "the picture has a wrong size"))
}
