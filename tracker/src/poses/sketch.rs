//! `poses/report.svg`: the cameras from above and from the side, and one frame with what projects into it.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use glam::{DVec2, DVec3};
use image::codecs::jpeg::JpegEncoder;
use image::{RgbImage, imageops};
use risorius_formats::pose_report::PoseReport;

use super::model::TakeModel;

/// Side of a view, drawing units.
const VIEW: f64 = 420.0;
/// Frusta drawn.
const FRUSTA: usize = 14;
/// Background points drawn.
const POINTS: usize = 700;
/// Residuals are drawn this many times their length.
const STRETCH: f64 = 10.0;

/// A frame to draw what projects into it.
pub(crate) struct Shown<'a> {
    pub(crate) frame: u32,
    /// Full size.
    pub(crate) picture: &'a RgbImage,
    /// Tracked landmarks, pixels.
    pub(crate) landmarks: Option<&'a [[f32; 2]; 68]>,
}

/// Axes of the face: to the picture's right, up, and out of the face.
fn face_axes(landmarks: &[DVec3], cameras: DVec3) -> Option<[DVec3; 3]> {
    let [right_eye, left_eye, nose, chin] = [36, 45, 27, 8].map(|i| landmarks.get(i).copied());
    let right = (left_eye? - right_eye?).normalize_or_zero();
    let up = nose? - chin?;
    let up = (up - right * up.dot(right)).normalize_or_zero();
    let mut out = right.cross(up);
    if out.dot(cameras - nose?) < 0.0 {
        out = -out;
    }
    (out.length() > 0.9).then_some([right, up, out])
}

/// The drawing; `None` without a face to turn it by.
pub(crate) fn draw(report: &PoseReport, model: &TakeModel, shown: Option<&Shown<'_>>) -> Option<String> {
    let centres: Vec<DVec3> = model.frames.values().map(|f| f.camera_from_world.camera_center()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let [right, up, out] = face_axes(&report.landmarks_in_world, mean)?;
    let width = 2.0 * VIEW + 60.0 + if shown.is_some() { VIEW + 20.0 } else { 0.0 };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {:.0}\" font-family=\"sans-serif\" font-size=\"13\">\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n",
        VIEW + 110.0
    );
    let views = [("from above", right, -out), ("from the side", -out, -up)];
    for (i, (name, across, down)) in views.into_iter().enumerate() {
        let left = 20.0 + i as f64 * (VIEW + 20.0);
        view(&mut svg, left, name, report, model, &centres, [across, down]);
    }
    if let Some(shown) = shown {
        overlay(&mut svg, 2.0 * VIEW + 60.0, report, model, shown);
    }
    let posed = report.frames_registered + report.frames_followed + report.frames_interpolated;
    let error = report.reprojection_error_px.map_or(String::new(), |e| format!(", points miss by {e:.2} px"));
    let _ = writeln!(
        svg,
        "<text x=\"20\" y=\"{:.0}\">{posed} of {} frames posed ({} registered, {} by patches, {} interpolated){error}.</text>\n<text x=\"20\" y=\"{:.0}\">Dark to light: the camera's path in time; blue: frusta of some frames; dots: the face and the points. On the frame: features green, how far points miss red, landmarks blue, mean face orange.</text>\n</svg>",
        VIEW + 75.0,
        report.frames,
        report.frames_registered,
        report.frames_followed,
        report.frames_interpolated,
        VIEW + 95.0
    );
    Some(svg)
}

fn view(
    svg: &mut String,
    left: f64,
    name: &str,
    report: &PoseReport,
    model: &TakeModel,
    centres: &[DVec3],
    axes: [DVec3; 2],
) {
    let flat = |p: DVec3| DVec2::new((p - report.head_center).dot(axes[0]), (p - report.head_center).dot(axes[1]));
    // Path and head fill the view; points beyond it are left out.
    let (mut lo, mut hi) = (DVec2::splat(-1.5 * report.head_radius), DVec2::splat(1.5 * report.head_radius));
    for c in centres {
        lo = lo.min(flat(*c));
        hi = hi.max(flat(*c));
    }
    let scale = 0.86 * VIEW / (hi - lo).max_element().max(1e-9);
    let middle = (lo + hi) * 0.5;
    let place = |p: DVec3| (flat(p) - middle) * scale + DVec2::new(left + VIEW / 2.0, 40.0 + VIEW / 2.0);
    let inside = |p: DVec2| p.x > left && p.x < left + VIEW && p.y > 40.0 && p.y < 40.0 + VIEW;
    let _ = writeln!(
        svg,
        "<text x=\"{left}\" y=\"28\">{name}</text><rect x=\"{left}\" y=\"40\" width=\"{VIEW}\" height=\"{VIEW}\" fill=\"none\" stroke=\"#ccc\"/>"
    );
    let step = model.points.len().div_ceil(POINTS).max(1);
    for p in model.points.values().step_by(step).map(|p| place(p.position)).filter(|p| inside(*p)) {
        let _ = writeln!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1\" fill=\"#bbb\"/>", p.x, p.y);
    }
    for p in report.landmarks_in_world.iter().map(|p| place(*p)) {
        let _ = writeln!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.6\" fill=\"#c40\"/>", p.x, p.y);
    }
    let length = 26.0 / scale;
    let step = model.frames.len().div_ceil(FRUSTA).max(1);
    for (frame, placed) in model.frames.iter().step_by(step) {
        let Some(lens) = model.lenses.get(&placed.lens) else { continue };
        let world_from_camera = placed.camera_from_world.inverse();
        let (w, h) = (f64::from(lens.width), f64::from(lens.height));
        let corner = |x: f64, y: f64| {
            let ray = lens.unproject(DVec2::new(x, y)).unwrap_or_default();
            place(world_from_camera.transform_point(ray.extend(1.0) * length))
        };
        let c = place(world_from_camera.translation);
        let corners = [corner(0.0, 0.0), corner(w, 0.0), corner(w, h), corner(0.0, h)];
        let mut path = String::new();
        for (i, p) in corners.iter().enumerate() {
            let q = corners[(i + 1) % 4];
            let _ = write!(path, "M{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}", c.x, c.y, p.x, p.y, q.x, q.y);
        }
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"#36c\" stroke-width=\"0.7\"><title>frame {frame}</title></path>"
        );
    }
    for (i, pair) in centres.windows(2).enumerate() {
        let shade = 30 + 170 * i / centres.len().max(1);
        let [a, b] = [place(pair[0]), place(pair[1])];
        let _ = writeln!(
            svg,
            "<path d=\"M{:.1} {:.1}L{:.1} {:.1}\" stroke=\"rgb({shade},{shade},{})\" stroke-width=\"1.5\"/>",
            a.x,
            a.y,
            b.x,
            b.y,
            shade / 2
        );
    }
}

fn overlay(svg: &mut String, left: f64, report: &PoseReport, model: &TakeModel, shown: &Shown<'_>) {
    let (w, h) = (f64::from(shown.picture.width()), f64::from(shown.picture.height()));
    let scale = VIEW / w.max(h);
    let Some(camera) = model.camera(shown.frame) else { return };
    let small = imageops::resize(
        shown.picture,
        ((w * scale * 1.6) as u32).max(1),
        ((h * scale * 1.6) as u32).max(1),
        imageops::FilterType::Triangle,
    );
    let mut jpeg = Vec::new();
    if JpegEncoder::new_with_quality(&mut jpeg, 80).encode_image(&small).is_err() {
        return;
    }
    let _ = writeln!(
        svg,
        "<text x=\"{left}\" y=\"28\">frame {}: features, misses × {STRETCH:.0}; landmarks and mean face</text>\n<image x=\"{left}\" y=\"40\" width=\"{:.1}\" height=\"{:.1}\" href=\"data:image/jpeg;base64,{}\"/>",
        shown.frame,
        w * scale,
        h * scale,
        STANDARD.encode(&jpeg)
    );
    let place = |p: DVec2| p * scale + DVec2::new(left, 40.0);
    let inside = |p: DVec2| p.x >= 0.0 && p.y >= 0.0 && p.x < w && p.y < h;
    let mut dot = |p: DVec2, r: f64, colour: &str| {
        if inside(p) {
            let p = place(p);
            let _ = writeln!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{r}\" fill=\"{colour}\"/>", p.x, p.y);
        }
    };
    for p in shown.landmarks.into_iter().flatten() {
        dot(DVec2::new(f64::from(p[0]), f64::from(p[1])), 1.2, "#06f");
    }
    for p in &report.landmarks_in_world {
        dot(camera.project(*p), 1.2, "#f80");
    }
    let points = model.frames.get(&shown.frame).map(|f| f.points.as_slice()).unwrap_or_default();
    for p in points {
        dot(DVec2::from(p.position_px), 1.2, "#0d3");
    }
    for p in points {
        let Some(solid) = p.point3d.and_then(|id| model.points.get(&id)) else { continue };
        let at = DVec2::from(p.position_px);
        let (a, b) = (place(at), place(at + (camera.project(solid.position) - at) * STRETCH));
        if b.is_finite() {
            let _ = writeln!(
                svg,
                "<path d=\"M{:.1} {:.1}L{:.1} {:.1}\" stroke=\"#f22\" stroke-width=\"0.9\"/>",
                a.x, a.y, b.x, b.y
            );
        }
    }
}
