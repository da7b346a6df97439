//! A corpus of small clips, made with the `ffmpeg` program: codec × depth × range × matrix × container × aspect × rate.
//! Pictures are compared with FFmpeg's own conversion (its `zscale` filter, which interpolates chroma from where it lies),
//! times with those of `ffprobe`. Skipped where the programs are absent.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "helpers of tests")]

mod common;

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::{ffmpeg, ffmpeg_has, has_ffmpeg, mean_difference, true_times, try_ffmpeg};
use risorius_video::Reader;

/// Mean difference that is allowed, levels.
const LEVELS: f64 = 1.0;
/// Difference of times that is allowed, seconds.
const SECS: f64 = 1e-3;

struct Clip {
    name: String,
    /// Options of the encoder and the muxer.
    encoding: String,
    /// What FFmpeg's filters call it.
    matrix: &'static str,
    range: &'static str,
    rate: &'static str,
    /// Sample aspect ratio.
    aspect: Option<(u32, u32)>,
}

fn clip(name: &str, encoding: &str, (matrix, range): (&'static str, &'static str)) -> Clip {
    Clip { name: name.to_owned(), encoding: encoding.to_owned(), matrix, range, rate: "30", aspect: None }
}

/// Encoder, its options and pixel format, and the containers that take it.
const CODECS: [(&str, &str, &[&str]); 8] = [
    ("libx264", "-crf 8 -pix_fmt yuv420p", &["mp4", "mov", "mkv", "ts", "avi"]),
    ("libx264", "-crf 8 -pix_fmt yuv420p10le", &["mp4", "mkv", "ts"]),
    ("libx265", "-crf 8 -x265-params log-level=none -pix_fmt yuv420p", &["mp4", "mkv", "ts"]),
    ("libx265", "-crf 8 -x265-params log-level=none -pix_fmt yuv422p10le", &["mp4", "mkv"]),
    ("libvpx-vp9", "-crf 10 -b:v 0 -cpu-used 8 -deadline realtime -pix_fmt yuv420p", &["webm", "mp4", "mkv"]),
    ("libvpx-vp9", "-crf 10 -b:v 0 -cpu-used 8 -deadline realtime -pix_fmt yuv420p10le", &["mkv", "webm"]),
    ("libaom-av1", "-crf 10 -cpu-used 8 -usage realtime -pix_fmt yuv420p", &["mp4", "mkv", "webm"]),
    ("libaom-av1", "-crf 10 -cpu-used 8 -usage realtime -pix_fmt yuv420p10le", &["mkv", "mp4"]),
];

const COLOURS: [(&str, &str); 5] =
    [("170m", "limited"), ("709", "limited"), ("2020_ncl", "limited"), ("709", "full"), ("470bg", "full")];

fn corpus() -> Vec<Clip> {
    let mut clips = Vec::new();
    for (encoder, options, containers) in CODECS {
        for (i, colours) in COLOURS.into_iter().enumerate() {
            let depth = if options.contains("10le") { 10 } else { 8 };
            let (matrix, range) = colours;
            let name = format!("{encoder}-{depth}-{matrix}-{range}.{}", containers[i % containers.len()]);
            clips.push(clip(&name, &format!("-c:v {encoder} {options}"), colours));
        }
    }
    for colours in &COLOURS[..3] {
        let encoding = "-c:v prores_ks -profile:v 3 -pix_fmt yuv422p10le -vendor apl0";
        clips.push(clip(&format!("prores-{}.mov", colours.0), encoding, *colours));
    }
    for container in ["avi", "mov"] {
        let encoding = "-c:v mjpeg -q:v 2 -pix_fmt yuvj422p -strict unofficial";
        clips.push(clip(&format!("mjpeg.{container}"), encoding, ("470bg", "full")));
    }
    for (name, format) in [("444", "yuv444p"), ("422", "yuv422p"), ("444-10", "yuv444p10le"), ("j420", "yuvj420p")] {
        let range = if name == "j420" { "full" } else { "limited" };
        clips.push(clip(
            &format!("h264-{name}.mp4"),
            &format!("-c:v libx264 -crf 8 -pix_fmt {format}"),
            ("709", range),
        ));
    }
    clips.push(clip("mpeg2.mpg", "-c:v mpeg2video -q:v 2 -pix_fmt yuv420p", ("170m", "limited")));
    clips.push(clip("dv411.mkv", "-c:v ffv1 -pix_fmt yuv411p", ("170m", "limited")));
    for (i, aspect) in [(4, 3), (8, 9), (540, 404)].into_iter().enumerate() {
        let name = format!("aspect-{}-{}.{}", aspect.0, aspect.1, ["mp4", "mkv", "mov"][i]);
        let aspect = Some(aspect);
        clips.push(Clip { aspect, ..clip(&name, "-c:v libx264 -crf 8 -pix_fmt yuv420p", ("709", "limited")) });
    }
    let rates = ["24", "25", "30000/1001", "50", "60", "120", "240"];
    for (i, rate) in rates.into_iter().enumerate() {
        let container = ["mp4", "mkv", "mov", "ts", "avi", "webm", "flv"][i];
        let encoder = if container == "webm" { CODECS[4] } else { CODECS[0] };
        let encoding = format!("-c:v {} {}", encoder.0, encoder.1);
        let name = format!("rate-{}.{container}", rate.replace('/', "-"));
        clips.push(Clip { rate, ..clip(&name, &encoding, ("709", "limited")) });
    }
    clips.push(clip("asf.wmv", "-c:v wmv2 -q:v 2 -pix_fmt yuv420p", ("170m", "limited")));
    for container in ["mp4", "mov", "mkv", "ts", "webm"] {
        let encoder = if container == "webm" { CODECS[4] } else { CODECS[0] };
        // Frames are left out, and reordered ones moved.
        let encoding = format!("-vsync vfr -c:v {} {}", encoder.0, encoder.1);
        clips.push(clip(&format!("uneven.{container}"), &encoding, ("709", "limited")));
    }
    clips
}

/// Makes a clip, reads it, and gives what is wrong with it.
fn examine(clip: &Clip, dir: &Path) -> Result<f64, String> {
    let path = dir.join(&clip.name);
    let tag = match clip.matrix {
        "709" => "bt709",
        "2020_ncl" => "bt2020nc",
        "470bg" => "bt470bg",
        _ => "smpte170m",
    };
    let range = if clip.range == "full" { "pc" } else { "tv" };
    let uneven = if clip.name.starts_with("uneven") { ",select=not(eq(mod(n\\,7)\\,3))" } else { "" };
    let aspect = clip.aspect.map_or_else(String::new, |(n, d)| format!(",setsar={n}/{d}"));
    let frames = if uneven.is_empty() { 5 } else { 25 };
    // AVI has no times for reordered frames, and ffprobe none either.
    let order =
        if path.extension().is_some_and(|e| e == "avi") && clip.encoding.contains("libx264") { "-bf 0" } else { "" };
    let made = try_ffmpeg(
        &format!(
            "-f lavfi -i testsrc2=size=128x96:rate={} -vf format=gbrp,zscale=matrixin=gbr:rangein=full:matrix={}:range={},\
             setparams=color_primaries=bt709:color_trc=bt709{uneven}{aspect} -frames:v {frames} -colorspace {tag} \
             -color_range {range} -color_primaries bt709 -color_trc bt709 {} {order}",
            clip.rate, clip.matrix, clip.range, clip.encoding
        ),
        &path,
    );
    made.map_err(|message| format!("cannot be made: {message}"))?;
    let mut reader = Reader::open(&path).map_err(|e| e.to_string())?;
    let (mut pictures, mut times) = (Vec::new(), Vec::new());
    while let Some(frame) = reader.next_frame().map_err(|e| e.to_string())? {
        pictures.extend_from_slice(frame.image.as_raw());
        times.push(frame.timestamp_nanos as f64 * 1e-9);
    }
    if let Some(missing) = reader.truncation() {
        return Err(format!("frames are missed: {missing:?}"));
    }
    let truth = true_times(&path);
    if truth.len() != times.len() {
        return Err(format!("{} frames, not {}", times.len(), truth.len()));
    }
    if let Some(i) = (0..times.len()).find(|&i| (times[i] - truth[i]).abs() > SECS) {
        return Err(format!("frame {i} is at {} s, not {} s", truth[i], times[i]));
    }
    let raw = dir.join(format!("{}.rgb", clip.name));
    let widened = clip.aspect.map_or_else(String::new, |(n, d)| {
        let width = (128.0 * f64::from(n) / f64::from(d)).round();
        format!(",scale={width}:96:flags=bicubic+accurate_rnd+full_chroma_int+full_chroma_inp")
    });
    let reference = format!(
        "-i {} -vsync passthrough -vf zscale=matrixin={}:rangein={}:matrix=gbr:range=full:filter=bilinear,format=gbrp{widened} \
         -f rawvideo -pix_fmt rgb24",
        path.display(),
        clip.matrix,
        clip.range
    );
    try_ffmpeg(&reference, &raw).map_err(|message| format!("no reference: {message}"))?;
    let expected = std::fs::read(&raw).unwrap();
    if expected.len() != pictures.len() {
        return Err(format!("{} bytes of pictures, not {}", pictures.len(), expected.len()));
    }
    let difference = mean_difference(&pictures, &expected);
    if difference > LEVELS {
        return Err(format!("pictures differ by {difference:.2} levels; {}", reader.info().coding));
    }
    Ok(difference)
}

#[test]
fn every_coding_has_the_pictures_and_times_of_ffmpeg() {
    if !has_ffmpeg() {
        return;
    }
    if !ffmpeg_has("-filters", "zscale") {
        eprintln!("SKIPPED: this FFmpeg has no filter `zscale`");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let clips = corpus();
    assert!(clips.len() >= 60, "{} clips", clips.len());
    let (next, outcomes) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while let Some(clip) = clips.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let encoder = clip.encoding.split_whitespace().skip_while(|w| *w != "-c:v").nth(1).unwrap();
                    if ffmpeg_has("-encoders", encoder) {
                        outcomes.lock().unwrap().push((&clip.name, examine(clip, dir.path())));
                    } else {
                        eprintln!("SKIPPED: this FFmpeg has no encoder `{encoder}`");
                    }
                }
            });
        }
    });
    let outcomes = outcomes.into_inner().unwrap();
    let wrong: Vec<String> =
        outcomes.iter().filter_map(|(name, o)| o.as_ref().err().map(|e| format!("{name}: {e}"))).collect();
    let worst = outcomes.iter().filter_map(|(_, o)| o.as_ref().ok()).fold(0.0f64, |a, &b| a.max(b));
    eprintln!("{} clips, the worst differs by {worst:.3} levels", outcomes.len());
    assert!(wrong.is_empty(), "{} of {} clips are wrong:\n{}", wrong.len(), outcomes.len(), wrong.join("\n"));
}

#[test]
fn hdr_has_the_colours_of_sdr() {
    if !has_ffmpeg() || !ffmpeg_has("-filters", "zscale") || !ffmpeg_has("-encoders", "libx265") {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for (curve, name) in [("arib-std-b67", "hlg.mp4"), ("smpte2084", "pq.mp4")] {
        for colour in [[200u8, 60, 40], [224, 172, 140], [90, 60, 50], [128, 128, 128]] {
            let path = dir.path().join(name);
            let hex = format!("{:02x}{:02x}{:02x}", colour[0], colour[1], colour[2]);
            ffmpeg(
                &format!(
                    "-f lavfi -i color=c=#{hex}:size=128x96:rate=30,format=gbrp -frames:v 2 -vf \
                     zscale=pin=bt709:tin=iec61966-2-1:min=gbr:rin=full:p=bt2020:t={curve}:m=bt2020nc:r=limited:npl=203,\
                     format=yuv420p10le -c:v libx265 -x265-params \
                     log-level=none:crf=4:colorprim=bt2020:transfer={curve}:colormatrix=bt2020nc -color_primaries bt2020 \
                     -color_trc {curve} -colorspace bt2020nc"
                ),
                &path,
            );
            let mut reader = Reader::open(&path).unwrap();
            assert!(reader.info().remarks.iter().any(|r| r.code == "hdr-video"), "{:?}", reader.info());
            let found = reader.next_frame().unwrap().unwrap().image.get_pixel(64, 48).0;
            assert!(found.iter().zip(colour).all(|(a, b)| a.abs_diff(b) <= 3), "{name}: {found:?}, not {colour:?}");
        }
    }
}
