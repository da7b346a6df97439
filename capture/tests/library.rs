//! `record` and `check` as a library: what a take holds, and how it is judged.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod common;

use common::{ffmpeg, has_ffmpeg, names, picture, write_video};
use risorius_capture::check::{Level, check};
use risorius_capture::record::{RecordOptions, record};
use risorius_capture::{CaptureError, sheet};
use risorius_formats::report::Collected;
use risorius_formats::take::SourceKind;
use risorius_formats::{Reporter, Silent, Take, Warning, hash};
use std::fs;
use std::path::Path;

fn options(input: impl AsRef<Path>, out: impl AsRef<Path>) -> RecordOptions {
    RecordOptions { input: input.as_ref().into(), out: out.as_ref().into(), ..RecordOptions::default() }
}

#[test]
fn a_take_opens_with_true_times_and_its_own_copy() {
    let dir = tempfile::tempdir().unwrap();
    let (video, out) = (dir.path().join("Face.MP4"), dir.path().join("takes/a"));
    write_video(&video, 40, 120.0);
    let mut wanted = options(&video, &out);
    (wanted.subject, wanted.consent) = ("Ada".into(), "research only".into());
    let summary = record(&wanted, &Silent).unwrap();
    let take = Take::open(&out).unwrap();
    let m = &take.manifest;
    assert_eq!((m.frame_count, m.width, m.height, m.source), (40, 96, 64, SourceKind::Video));
    assert_eq!(
        (m.dropped_frames, m.repeated_frames, m.subject.as_str(), m.consent.as_str()),
        (0, 0, "Ada", "research only")
    );
    assert!((m.fps_measured - 120.0).abs() < 0.01 && (m.fps_asked.unwrap() - 120.0).abs() < 0.01);
    assert_eq!((m.media.to_str(), m.original_name.as_str()), (Some("video.mp4"), "Face.MP4"));
    assert_eq!(hash::sha256_of_file(take.media_path()).unwrap(), m.media_sha256);
    assert_eq!(m.media_sha256, hash::sha256_of_file(&video).unwrap());
    assert_eq!((&summary.manifest, summary.truncated_from), (m, None));
    assert!((take.frames[39].timestamp_nanos - 325_000_000).abs() < 1000);
    assert!(take.frames.iter().all(|f| f.sharpness.unwrap() > 10.0 && (60.0..160.0).contains(&f.luma_mean.unwrap())));
    assert_eq!(names(&out), ["frames.csv", "take.toml", "video.mp4"]);
}

#[test]
fn the_tables_are_the_same_each_time() {
    let dir = tempfile::tempdir().unwrap();
    let video = dir.path().join("v.mp4");
    write_video(&video, 60, 60.0);
    let read = |name: &str| {
        record(&options(&video, dir.path().join(name)), &Silent).unwrap();
        ["take.toml", "frames.csv"].map(|f| fs::read(dir.path().join(name).join(f)).unwrap())
    };
    assert_eq!(read("one"), read("two"));
}

#[test]
fn dropped_and_repeated_frames_are_found_where_they_are() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (frames, video) = (dir.path().join("frames"), dir.path().join("vfr.mp4"));
    fs::create_dir(&frames).unwrap();
    // Frames 30 and 31 repeat frame 29; 50 and 70–72 are left out of the video.
    for i in 0..100u32 {
        let shown = if (30..=31).contains(&i) { 29 } else { i };
        picture(96, 64, shown).save(frames.join(format!("{i:03}.png"))).unwrap();
    }
    let select = "-vf select='not(eq(n\\,50))*not(between(n\\,70\\,72))' -vsync vfr";
    ffmpeg(&format!("-framerate 120 -i {}/%03d.png {select} -c:v libx264 -pix_fmt yuv420p", frames.display()), &video);
    let summary = record(&options(&video, dir.path().join("take")), &Silent).unwrap();
    assert_eq!(
        (summary.manifest.frame_count, summary.manifest.dropped_frames, summary.manifest.repeated_frames),
        (96, 4, 2)
    );
    let take = Take::open(dir.path().join("take")).unwrap();
    let dropped: Vec<_> =
        take.frames.iter().filter(|f| f.dropped_before > 0).map(|f| (f.index.0, f.dropped_before)).collect();
    let repeated: Vec<_> = take.frames.iter().filter(|f| f.repeated).map(|f| f.index.0).collect();
    assert_eq!((dropped, repeated), (vec![(50, 1), (69, 3)], vec![30, 31]));
    let report = check(&take, &Silent).unwrap();
    assert_eq!((report.dropped_frames, report.longest_drop, report.repeated_frames), (4, 3, 2));
    assert!(
        report
            .verdicts
            .iter()
            .any(|v| v.topic == "dropped" && v.level == Level::Poor && v.message.contains("before frame 69"))
    );
}

#[test]
fn a_folder_of_images_is_a_take_too() {
    let dir = tempfile::tempdir().unwrap();
    let frames = dir.path().join("frames");
    fs::create_dir(&frames).unwrap();
    for i in 0..12u32 {
        picture(50, 40, i).save(frames.join(format!("f{i}.png"))).unwrap();
    }
    let mut wanted = options(&frames, dir.path().join("take"));
    wanted.image_fps = Some(10.0);
    let summary = record(&wanted, &Silent).unwrap();
    assert_eq!(
        (summary.manifest.source, summary.manifest.fps_measured, summary.duration_secs),
        (SourceKind::Images, 10.0, 1.1)
    );
    let take = Take::open(dir.path().join("take")).unwrap();
    assert_eq!(names(&take.media_path()).len(), 12);
    assert!(check(&take, &Silent).unwrap().media_intact);
    // The same folder by reference has the same hash, and notices a change.
    (wanted.link, wanted.out) = (true, dir.path().join("linked"));
    assert_eq!(record(&wanted, &Silent).unwrap().manifest.media_sha256, summary.manifest.media_sha256);
    let linked = Take::open(dir.path().join("linked")).unwrap();
    assert!(linked.manifest.media.is_absolute() && names(&linked.dir) == ["frames.csv", "take.toml"]);
    picture(50, 40, 99).save(frames.join("f3.png")).unwrap();
    assert!(check(&take, &Silent).unwrap().media_intact && !check(&linked, &Silent).unwrap().media_intact);
}

#[test]
fn a_cut_video_gives_a_warning_and_a_usable_take() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let video = dir.path().join("cut.mp4");
    ffmpeg("-f lavfi -i testsrc2=size=160x120:rate=30:duration=6 -c:v libx264 -g 30 -movflags +faststart", &video);
    let bytes = fs::read(&video).unwrap();
    fs::write(&video, &bytes[..bytes.len() / 2]).unwrap();
    let heard = Collected::default();
    let summary = record(&options(&video, dir.path().join("take")), &heard).unwrap();
    assert_eq!((heard.count("truncated-video"), summary.truncated_from), (1, Some(180)));
    let warning = &heard.warnings()[0].message;
    assert!(warning.contains("cut.mp4: is truncated") && warning.contains("of 180 frames"), "{warning}");
    let take = Take::open(dir.path().join("take")).unwrap();
    assert!((40..150).contains(&take.frames.len()));
    sheet::write_sheet(&take, dir.path().join("sheet.png")).unwrap();
    assert_eq!(image::open(dir.path().join("sheet.png")).unwrap().width(), 6 * 248);
}

#[test]
fn blur_darkness_and_a_missing_video_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let frames = dir.path().join("frames");
    fs::create_dir(&frames).unwrap();
    for i in 0..40u32 {
        let mut image = picture(80, 60, i);
        if i == 17 {
            image = image::imageops::blur(&image, 3.0);
        }
        image.pixels_mut().for_each(|p| p.0 = p.0.map(|v| v / 4));
        image.save(frames.join(format!("{i:02}.png"))).unwrap();
    }
    let mut wanted = options(&frames, dir.path().join("take"));
    wanted.link = true;
    record(&wanted, &Silent).unwrap();
    let take = Take::open(dir.path().join("take")).unwrap();
    let report = check(&take, &Silent).unwrap();
    assert_eq!(report.blurred_frames, 1);
    let has = |topic: &str, words: &str| {
        report.verdicts.iter().any(|v| v.topic == topic && v.level == Level::Fair && v.message.contains(words))
    };
    assert!(has("sharpness", "such as 17") && has("exposure", "dark"), "{:?}", report.verdicts);
    fs::remove_dir_all(&frames).unwrap();
    let report = check(&take, &Silent).unwrap();
    assert!(!report.media_intact && report.overall == Level::Poor);
    // A track that cannot be read is told of, and no more.
    fs::create_dir(take.dir.join("track")).unwrap();
    fs::write(take.openface_path(), "no table").unwrap();
    let heard = Collected::default();
    assert!(check(&take, &heard).unwrap().orbit.is_none() && heard.count("unreadable-track") == 1);
}

#[test]
fn what_is_there_is_not_replaced_unasked() {
    let dir = tempfile::tempdir().unwrap();
    let (video, out) = (dir.path().join("v.mp4"), dir.path().join("take"));
    write_video(&video, 5, 30.0);
    record(&options(&video, &out), &Silent).unwrap();
    fs::write(out.join("mark"), "").unwrap();
    assert!(matches!(record(&options(&video, &out), &Silent), Err(CaptureError::Exists { .. })));
    let forced = |input: &Path, out: &Path| RecordOptions { force: true, ..options(input, out) };
    // Not with the take's own video, which would be gone before it is read again.
    assert!(matches!(
        record(&forced(&out.join("video.mp4"), &out), &Silent),
        Err(CaptureError::InputInsideOutput { .. })
    ));
    assert!(out.join("mark").exists());
    record(&forced(&video, &out), &Silent).unwrap();
    assert!(!out.join("mark").exists());
    // Not a folder that is no take.
    let precious = dir.path().join("precious");
    fs::create_dir(&precious).unwrap();
    fs::write(precious.join("thesis.txt"), "").unwrap();
    let error = record(&forced(&video, &precious), &Silent).unwrap_err();
    assert!(error.to_string().ends_with("is not a take, so it is not replaced"), "{error}");
    assert_eq!(names(dir.path()), ["precious", "take", "v.mp4"]);
}

/// Asks to stop after some frames.
struct Impatient(std::sync::atomic::AtomicU64);

impl Reporter for Impatient {
    fn stage(&self, _: &str, _: Option<u64>) {}
    fn advance(&self, steps: u64) {
        self.0.fetch_add(steps, std::sync::atomic::Ordering::Relaxed);
    }
    fn note(&self, _: &str) {}
    fn warn(&self, _: Warning) {}
    fn cancelled(&self) -> bool {
        self.0.load(std::sync::atomic::Ordering::Relaxed) >= 3
    }
}

#[test]
fn stopped_work_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    write_video(&dir.path().join("v.mp4"), 60, 30.0);
    let stopped = record(&options(dir.path().join("v.mp4"), dir.path().join("take")), &Impatient(0.into()));
    assert!(matches!(stopped, Err(CaptureError::Interrupted)));
    assert_eq!(names(dir.path()), ["v.mp4"]);
}

/// Adds the metadata of an Android phone to an MP4 file whose index comes last: how fast it was filmed.
fn add_capture_fps(video: &Path, fps: f32) {
    let boxed = |name: &[u8; 4], parts: &[&[u8]]| {
        let body = parts.concat();
        [&(body.len() as u32 + 8).to_be_bytes()[..], name, &body].concat()
    };
    let name = b"com.android.capture.fps";
    let key = boxed(b"mdta", &[name]);
    let keys = boxed(b"keys", &[&[0, 0, 0, 0, 0, 0, 0, 1], &key]);
    let data = boxed(b"data", &[&[0, 0, 0, 23, 0, 0, 0, 0], &fps.to_be_bytes()]);
    let ilst = boxed(b"ilst", &[&boxed(&[0, 0, 0, 1], &[&data])]);
    let handler = boxed(b"hdlr", &[&[0; 8], b"mdta", &[0; 13]]);
    let meta = boxed(b"meta", &[&handler, &keys, &ilst]);
    let mut bytes = fs::read(video).unwrap();
    let at = bytes.windows(4).rposition(|w| w == b"moov").unwrap() - 4;
    let size = u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
    assert_eq!(at + size as usize, bytes.len(), "the index comes last");
    bytes[at..at + 4].copy_from_slice(&(size + meta.len() as u32).to_be_bytes());
    bytes.extend(meta);
    fs::write(video, bytes).unwrap();
}

#[test]
fn slow_motion_has_the_times_of_filming() {
    let dir = tempfile::tempdir().unwrap();
    let video = dir.path().join("slow.mp4");
    write_video(&video, 48, 30.0);
    let made = |name: &str, true_fps: Option<f64>| {
        let wanted = RecordOptions { true_fps, ..options(&video, dir.path().join(name)) };
        record(&wanted, &Silent).unwrap()
    };
    let plain = made("plain", None);
    assert_eq!((plain.slow_motion, plain.manifest.fps_measured.round()), (None, 30.0));
    let told = made("told", Some(120.0));
    assert!((told.manifest.fps_measured - 120.0).abs() < 0.01 && (told.slow_motion.unwrap() - 4.0).abs() < 1e-6);
    add_capture_fps(&video, 240.0);
    let found = made("found", None);
    assert!((found.manifest.fps_measured - 240.0).abs() < 0.1, "{}", found.manifest.fps_measured);
    let take = Take::open(dir.path().join("found")).unwrap();
    assert!((take.frames[47].timestamp_nanos - 47_000_000_000 / 240).abs() < 1000);
    assert_eq!((take.manifest.frame_count, take.manifest.dropped_frames), (48, 0));
    assert_eq!(found.manifest.media_sha256, hash::sha256_of_file(&video).unwrap(), "the clip itself is kept as it is");
    // Filmed and played at 240: nothing to do.
    let fast = dir.path().join("fast.mp4");
    write_video(&fast, 48, 240.0);
    add_capture_fps(&fast, 240.0);
    let plain = record(&options(&fast, dir.path().join("fast")), &Silent).unwrap();
    assert_eq!((plain.slow_motion, plain.manifest.fps_measured.round()), (None, 240.0));
}

#[test]
fn a_phones_turned_hevc_clip_of_uneven_rate_is_kept_and_read() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (flat, video) = (dir.path().join("flat.mov"), dir.path().join("phone.mov"));
    // Every third frame of the second half is left out, as phones do in dim light.
    let select = "-vf select='lt(n\\,60)+not(eq(mod(n\\,3)\\,1))' -vsync vfr";
    let source = "-f lavfi -i testsrc2=size=160x96:rate=120:duration=1";
    ffmpeg(&format!("{source} {select} -c:v libx265 -tag:v hvc1 -x265-params log-level=none -pix_fmt yuv420p"), &flat);
    ffmpeg(&format!("-i {} -c copy -metadata:s:v:0 rotate=90", flat.display()), &video);
    let summary = record(&options(&video, dir.path().join("take")), &Silent).unwrap();
    let m = &summary.manifest;
    assert_eq!((m.frame_count, m.width, m.height, m.rotation_degrees % 180), (100, 96, 160, 90));
    let take = Take::open(dir.path().join("take")).unwrap();
    let steps: Vec<i64> =
        take.frames.windows(2).map(|w| (w[1].timestamp_nanos - w[0].timestamp_nanos) / 1_000_000).collect();
    assert!(steps[..59].iter().all(|s| *s == 8) && steps[62..].contains(&16), "{steps:?}");
    assert_eq!(hash::sha256_of_file(take.media_path()).unwrap(), hash::sha256_of_file(&video).unwrap());
}

#[test]
fn flicker_and_motion_blur_are_told_and_the_report_is_one_page() {
    let dir = tempfile::tempdir().unwrap();
    let frames = dir.path().join("frames");
    fs::create_dir(&frames).unwrap();
    for i in 0..256u32 {
        // Lamps on 50 Hz, filmed at 120: a beat of 20 Hz. The picture runs and is blurred for a part of each second.
        let pulse = 1.0 + 0.06 * (std::f64::consts::TAU * 20.0 * f64::from(i) / 120.0).sin();
        let runs = i % 64 >= 32;
        let mut image = picture(96, 64, if runs { 5 * i } else { i / 8 });
        if runs {
            image = image::imageops::blur(&image, 0.9);
        }
        image.pixels_mut().for_each(|p| p.0 = p.0.map(|v| (f64::from(v) * pulse) as u8));
        image.save(frames.join(format!("{i:03}.png"))).unwrap();
    }
    let mut wanted = options(&frames, dir.path().join("take"));
    wanted.image_fps = Some(120.0);
    record(&wanted, &Silent).unwrap();
    let take = Take::open(dir.path().join("take")).unwrap();
    let report = check(&take, &Silent).unwrap();
    let flicker = report.flicker.unwrap();
    assert!((flicker.frequency_hz - 20.0).abs() < 0.5 && flicker.mains_hz == Some(50), "{flicker:?}");
    assert!(report.motion_blur.unwrap() > 0.4, "{report:?}");
    for (topic, words) in [("flicker", "50 Hz"), ("motion-blur", "move more slowly")] {
        assert!(
            report.verdicts.iter().any(|v| v.topic == topic && v.level > Level::Good && v.message.contains(words)),
            "{:?}",
            report.verdicts
        );
    }
    let page = dir.path().join("report.html");
    risorius_capture::check::write_page(&take, &report, &page).unwrap();
    let page = fs::read_to_string(page).unwrap();
    assert!(page.matches("<svg").count() == 5 && page.contains("data:image/png;base64,") && page.contains("50 Hz"));
}
