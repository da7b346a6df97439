//! Networks, ONNX Runtime, COLMAP, FFmpeg's decoders.

use std::path::Path;
use std::process::{Command, Stdio};

use ffmpeg::codec::{Id, decoder};
use risorius_tracker::models::ModelFolder;
use risorius_tracker::models::runtime::{Runtime, library_places};
use risorius_trainer::eval::{Lpips, LpipsNetwork};

use super::{Finding, State};

pub(super) fn look() -> Vec<Finding> {
    let dir = risorius_tracker::models::default_dir();
    let mut findings = vec![networks(&dir), runtime(&dir), lpips(&dir), colmap(), ffmpeg_libraries()];
    findings.extend(decoders());
    findings
}

fn networks(dir: &Path) -> Finding {
    const WHAT: &str = "finding the face in a video (`tracker run`); a table of OpenFace does without";
    match ModelFolder::open(dir) {
        Ok(_) => Finding::ok("networks", "face networks", dir.display().to_string()),
        Err(e) => {
            Finding::ok("networks", "face networks", e.to_string()).lacking(State::Missing, WHAT, "`risorius models`")
        }
    }
}

fn runtime(dir: &Path) -> Finding {
    const WHAT: &str = "running the networks";
    let places = library_places(&[dir]);
    let found = places.iter().find(|p| p.is_file()).map(|p| p.display().to_string());
    let finding = |text: String| Finding::ok("onnx-runtime", "ONNX Runtime", text);
    match Runtime::load(&places) {
        Ok(_) => finding(found.unwrap_or_default()),
        Err(e) => finding(e.to_string()).lacking(State::Missing, WHAT, "`risorius models`"),
    }
}

fn lpips(dir: &Path) -> Finding {
    let all = [LpipsNetwork::Alex, LpipsNetwork::Vgg];
    let there: Vec<&str> = all.into_iter().filter(|n| Lpips::is_in(dir, *n)).map(LpipsNetwork::name).collect();
    let finding = |text: String| Finding::ok("lpips", "LPIPS networks", text);
    if there.len() == all.len() {
        return finding(there.join(", "));
    }
    let found = if there.is_empty() { "not found".to_owned() } else { format!("only {}", there.join(", ")) };
    finding(found).lacking(State::Optional, "LPIPS in `trainer eval`", "`risorius models --metrics`")
}

fn colmap() -> Finding {
    const WHAT: &str = "videos from a camera that moves; a camera that stands still needs none";
    let finding = |text: String| Finding::ok("colmap", "COLMAP", text);
    if let Some(line) = first_line("colmap", &["help"]).filter(|line| line.contains("COLMAP")) {
        return finding(line.trim_end_matches(" -- Structure-from-Motion and Multi-View Stereo").to_owned());
    }
    if let Some(line) = first_line("python3", &["-c", "import pycolmap; print(pycolmap.__version__)"]) {
        return finding(format!("pycolmap {line} in python3"));
    }
    finding("not found, neither `colmap` nor pycolmap in python3".to_owned()).lacking(
        State::Optional,
        WHAT,
        "`apt-get update && apt-get install colmap`",
    )
}

/// The first line that is not empty of what a program writes to standard output, if it runs.
fn first_line(program: &str, args: &[&str]) -> Option<String> {
    let output = Command::new(program).args(args).stdin(Stdio::null()).stderr(Stdio::null()).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.lines().map(str::trim).find(|line| !line.is_empty()).map(str::to_owned)
}

fn ffmpeg_libraries() -> Finding {
    let version = |n: u32| format!("{}.{}.{}", n >> 16, n >> 8 & 0xff, n & 0xff);
    let (codec, format) = (ffmpeg::codec::version(), ffmpeg::format::version());
    let text = format!("libavcodec {}, libavformat {}", version(codec), version(format));
    Finding::ok("ffmpeg", "FFmpeg libraries", text)
}

fn decoders() -> Vec<Finding> {
    let all = [
        ("h264", "H.264 decoder", Id::H264),
        ("hevc", "HEVC decoder", Id::HEVC),
        ("vp9", "VP9 decoder", Id::VP9),
        ("av1", "AV1 decoder", Id::AV1),
        ("mjpeg", "MJPEG decoder", Id::MJPEG),
    ];
    let of = |(name, title, id): (&'static str, &'static str, Id)| {
        // FFmpeg's own `av1` only hands over to graphics cards.
        let found = decoder::find(id).map(|codec| codec.name().to_owned()).filter(|n| n != "av1");
        match found {
            Some(found) => Finding::ok(name, title, found),
            None => Finding::ok(name, title, "not in this FFmpeg").lacking(
                State::Optional,
                "videos of this kind; others can be converted",
                "`ffmpeg -i FILE -c:v libx264 out.mp4` on a machine that decodes it",
            ),
        }
    };
    all.into_iter().map(of).collect()
}
