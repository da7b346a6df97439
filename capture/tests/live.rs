//! Recording from a live source: what is written, what is counted, and what is left after each kind of end.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod common;

use std::fs;
use std::io::{self, Write};
use std::path::Path;
use std::time::Duration;

use common::{ffmpeg, has_ffmpeg, names};
use risorius_capture::check::{Level, check};
use risorius_capture::live::journal::JournalRow;
use risorius_capture::live::pipeline::{Ended, Plan, run};
use risorius_capture::live::{LiveOptions, LiveSummary, measure_take, record_live, recover};
use risorius_capture::negotiate::Choice;
use risorius_capture::source::{FrameSource, Grab, Grabbed, Mode, PixelFormat, Rate, Rates, Started, Synthetic, open};
use risorius_capture::{CaptureError, Result};
use risorius_formats::report::Collected;
use risorius_formats::{Silent, Take};
use risorius_video::Reader;

fn options(device: &str, out: impl AsRef<Path>, secs: f64) -> LiveOptions {
    LiveOptions {
        duration: Some(Duration::from_secs_f64(secs)),
        warm_up: Duration::ZERO,
        // Patience with a machine that does other things too.
        buffers: Some(64),
        ..LiveOptions::new(device, out.as_ref())
    }
}

fn recorded(device: &str, out: impl AsRef<Path>, secs: f64) -> LiveSummary {
    record_live(open(device).unwrap(), &options(device, out, secs), None, &Silent).unwrap()
}

/// The numbers that the synthetic camera puts into its JPEG pictures, in the order of the file.
fn numbers(video: &Path) -> Vec<u32> {
    let bytes = fs::read(video).unwrap();
    let mark = [0xff, 0xd8, 0xff, 0xfe, 0, 10];
    bytes
        .windows(14)
        .filter(|w| w.starts_with(&mark))
        .map(|w| std::str::from_utf8(&w[6..]).unwrap().parse().unwrap())
        .collect()
}

#[test]
fn every_frame_of_the_camera_is_in_the_video_once() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("take");
    let summary = recorded("synthetic:320x240@120", &out, 1.5);
    assert_eq!(numbers(&out.join("video.mp4")), (0..180).collect::<Vec<_>>());
    assert_eq!((summary.ended, summary.grabbed, summary.lost_by_driver, summary.discarded), ("complete", 181, 0, 0));
    let take = measure_take(&out, &Silent).unwrap();
    assert_eq!((take.manifest.frame_count, take.manifest.dropped_frames, take.manifest.repeated_frames), (180, 0, 0));
    assert!((take.manifest.fps_measured - 120.0).abs() < 0.01);
    assert!(take.frames.iter().all(|f| f.sharpness.unwrap() > 10.0 && f.luma_mean.unwrap() > 50.0));
    assert_eq!(names(&out), ["frames.csv", "recording.csv", "recording.toml", "take.toml", "video.mp4"]);
    assert!(recover(&out, &Silent).unwrap().is_none(), "a whole take needs no repair");
}

#[test]
fn lost_and_broken_frames_are_counted_where_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("take");
    // The count wraps between frames 5 and 6.
    let device = "synthetic:160x120@100,lose=10+11+40,corrupt=20,first=4294967290,jitter=900";
    let summary = recorded(device, &out, 1.0);
    assert_eq!((summary.lost_by_driver, summary.corrupt, summary.discarded), (3, 1, 0));
    let expected: Vec<u32> = (0..100).filter(|i| ![10, 11, 20, 40].contains(i)).collect();
    assert_eq!(numbers(&out.join("video.mp4")), expected);
    let take = Take::open(&out).unwrap();
    let dropped: Vec<(u32, u32)> =
        take.frames.iter().filter(|f| f.dropped_before > 0).map(|f| (f.index.0, f.dropped_before)).collect();
    assert_eq!(dropped, [(10, 2), (18, 1), (37, 1)]);
    assert_eq!(take.manifest.dropped_frames, 4);
    let jitter = summary.jitter_ms.unwrap();
    assert!(jitter > 0.05 && jitter < 1.0, "{jitter}");
}

/// A disk that takes its time.
struct Slow {
    bytes: u64,
    pause: Duration,
}

impl Write for Slow {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        std::thread::sleep(self.pause);
        self.bytes += data.len() as u64;
        Ok(data.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_slow_disk_costs_counted_frames_and_never_the_drivers() {
    let mut camera = Synthetic::parse("320x240@100").unwrap();
    let rate = Rate { frames: 100, secs: 1 };
    let choice = Choice { format: PixelFormat::Mjpeg, width: 320, height: 240, rate };
    let started = camera.start(&choice, 64).unwrap();
    let plan = Plan { duration: Some(Duration::from_secs(3)), memory_bytes: 200_000 };
    let mut rows: Vec<JournalRow> = Vec::new();
    let mut keep = |row: JournalRow, _: bool| {
        rows.push(row);
        Ok(())
    };
    let sink = Slow { bytes: 0, pause: Duration::from_millis(450) };
    let outcome = run(&mut camera, &started, &plan, sink, &mut keep, &mut |_| true).unwrap();
    camera.stop();
    let t = outcome.totals;
    assert!(matches!(outcome.ended, Ended::Complete));
    assert!(t.discarded > 5, "{t:?}");
    // The grabbing thread kept up; the frame that ended the recording is in no other count.
    assert_eq!((t.lost, t.corrupt), (0, 0));
    assert_eq!(t.written + t.discarded, t.grabbed - 1, "{t:?}");
    assert!(t.waiting_peak_bytes <= 200_000, "{t:?}");
    // The rows tell of each of them but those after the last row; sequence numbers agree.
    let missing: u64 = rows.iter().map(|r| u64::from(r.missing_before())).sum();
    assert_eq!(rows.len() as u64, t.written);
    let last = rows.last().unwrap().sequence.unwrap();
    assert_eq!(u64::from(last) + 1, t.written + missing);
    assert!(rows.windows(2).all(|w| w[1].sequence.unwrap() - w[0].sequence.unwrap() == w[1].missing_before() + 1));
}

#[test]
fn a_disk_that_fails_ends_the_recording() {
    struct Full(usize);
    impl Write for Full {
        fn write(&mut self, data: &[u8]) -> io::Result<usize> {
            self.0 = self.0.checked_sub(data.len()).ok_or(io::ErrorKind::StorageFull)?;
            Ok(data.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let mut camera = Synthetic::parse("320x240@200").unwrap();
    let rate = Rate { frames: 200, secs: 1 };
    let started = camera.start(&Choice { format: PixelFormat::Mjpeg, width: 320, height: 240, rate }, 64).unwrap();
    let plan = Plan { duration: None, memory_bytes: 64 << 20 };
    let mut rows = 0;
    let mut keep = |_: JournalRow, _: bool| {
        rows += 1;
        Ok(())
    };
    let outcome = run(&mut camera, &started, &plan, Full(3_000_000), &mut keep, &mut |_| true).unwrap();
    assert!(matches!(&outcome.ended, Ended::Disk(e) if e.kind() == io::ErrorKind::StorageFull), "{outcome:?}");
    assert!(rows > 50 && outcome.totals.written == rows && outcome.whole_bytes <= 3_000_000, "{outcome:?}");
    assert_eq!(outcome.totals.written + outcome.totals.discarded, outcome.totals.grabbed);
}

#[test]
fn an_unplugged_camera_leaves_what_it_gave() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("take");
    let summary = recorded("synthetic:160x120@100,unplug=70", &out, 10.0);
    assert!(matches!(summary.failure, Some(CaptureError::Unplugged { .. })) && summary.ended == "camera");
    assert_eq!(numbers(&out.join("video.mp4")), (0..70).collect::<Vec<_>>());
    assert_eq!(Take::open(&out).unwrap().frames.len(), 70);
}

#[test]
fn raw_frames_are_stored_to_the_bit() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("take");
    recorded("synthetic:64x48@60,rgb24", &out, 0.5);
    let mut reader = Reader::open(out.join("video.mp4")).unwrap();
    for i in 0..30u32 {
        let image = reader.next_frame().unwrap().unwrap().image;
        // The camera writes its count into the first eight bytes.
        assert_eq!(image.as_raw()[..8], u64::from(i).to_le_bytes());
    }
    assert!(reader.next_frame().unwrap().is_none());
    for format in ["yuyv", "uyvy", "nv12", "i420", "grey", "bgr24"] {
        let out = dir.path().join(format);
        recorded(&format!("synthetic:64x48@60,{format}"), &out, 0.3);
        let take = measure_take(&out, &Silent).unwrap();
        assert!(take.frames.len() == 18 && take.frames.iter().all(|f| f.sharpness.is_some()), "{format}");
    }
}

#[test]
fn a_cut_recording_is_recovered_with_or_without_its_journal() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    recorded("synthetic:160x120@100,lose=30", &whole, 2.0);
    let expected = Take::open(&whole).unwrap();
    let video = fs::read(whole.join("video.mp4")).unwrap();
    let journal = fs::read(whole.join("recording.csv")).unwrap();
    for (name, video_share, journal_share) in [("both", 0.8, 0.6), ("journal", 1.0, 0.5), ("none", 0.7, 0.0)] {
        let cut = dir.path().join(name);
        fs::create_dir(&cut).unwrap();
        fs::copy(whole.join("recording.toml"), cut.join("recording.toml")).unwrap();
        let part = |bytes: &[u8], share: f64| bytes[..(bytes.len() as f64 * share) as usize].to_vec();
        fs::write(cut.join("video.mp4"), part(&video, video_share)).unwrap();
        fs::write(cut.join("recording.csv"), part(&journal, journal_share)).unwrap();
        let error = Take::open(&cut).unwrap_err().to_string();
        assert!(error.ends_with("is a recording that was not finished"), "{error}");
        let found = recover(&cut, &Silent).unwrap().unwrap();
        let n = found.frames.len();
        assert!(n as f64 > video_share * 199.0 - 52.0, "{name}: {n}");
        assert!(found.rows_restored > 0 && (found.cut_bytes > 0) == (video_share < 1.0), "{name}");
        let take = Take::open(&cut).unwrap();
        for (a, b) in take.frames.iter().zip(&expected.frames) {
            assert!((a.timestamp_nanos - b.timestamp_nanos).abs() <= 1000, "{name}");
            assert_eq!(a.dropped_before, b.dropped_before, "{name}, frame {}", a.index.0);
        }
        let mut reader = Reader::open(take.media_path()).unwrap();
        assert_eq!(std::iter::from_fn(|| reader.next_frame().unwrap()).count(), n);
        assert!(recover(&cut, &Silent).unwrap().is_none());
    }
    // Nothing but a beginning.
    let empty = dir.path().join("empty");
    fs::create_dir(&empty).unwrap();
    fs::copy(whole.join("recording.toml"), empty.join("recording.toml")).unwrap();
    fs::write(empty.join("video.mp4"), &video[..700]).unwrap();
    assert!(matches!(recover(&empty, &Silent), Err(CaptureError::NothingRecorded { .. })));
    fs::create_dir(dir.path().join("other")).unwrap();
    assert!(matches!(recover(&dir.path().join("other"), &Silent), Err(CaptureError::NotARecording { .. })));
}

#[test]
fn what_was_there_comes_back_when_the_camera_gives_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("take");
    recorded("synthetic:64x48@50", &out, 0.2);
    let before = fs::read(out.join("take.toml")).unwrap();
    let again = |device: &str, force: bool| {
        let options = LiveOptions { force, ..options(device, &out, 0.2) };
        record_live(open(device).unwrap(), &options, None, &Silent).err()
    };
    assert!(matches!(again("synthetic:64x48@60", false), Some(CaptureError::Exists { .. })));
    assert!(matches!(again("synthetic:64x48@60,unplug=0", true), Some(CaptureError::Unplugged { .. })));
    assert_eq!(fs::read(out.join("take.toml")).unwrap(), before);
    assert!(again("synthetic:64x48@60", true).is_none());
    assert_ne!(fs::read(out.join("take.toml")).unwrap(), before);
    assert_eq!(names(dir.path()), ["take"]);
}

#[test]
fn a_camera_that_does_not_keep_its_rate_is_told_of() {
    let dir = tempfile::tempdir().unwrap();
    let warnings = |device: &str, name: &str| {
        let heard = Collected::default();
        let out = dir.path().join(name);
        record_live(open(device).unwrap(), &options(device, &out, 2.0), None, &heard).unwrap();
        let report = check(&Take::open(&out).unwrap(), &Silent).unwrap();
        (heard.count("rate-not-kept"), report.verdicts.into_iter().find(|v| v.topic == "rate").unwrap())
    };
    let (count, verdict) = warnings("synthetic:64x48@120,gives=60", "slow");
    assert_eq!((count, verdict.level), (1, Level::Fair));
    assert!(verdict.message.contains("instead of 120"), "{}", verdict.message);
    // Frames that are lost on the way are not the camera's rate.
    let (count, verdict) = warnings("synthetic:64x48@120,lose=20+21+22+23+24+25+26+27+28+29+30", "lossy");
    assert_eq!((count, verdict.level), (0, Level::Good));
}

/// Plays access units as a camera would, some of them lost for want of memory.
struct Player {
    units: Vec<Vec<u8>>,
    next: usize,
}

impl FrameSource for Player {
    fn name(&self) -> String {
        "player".to_owned()
    }
    fn modes(&mut self, _: Option<(u32, u32)>) -> Result<Vec<Mode>> {
        let rates = Rates::Exactly(vec![Rate { frames: 100, secs: 1 }]);
        Ok(vec![Mode { format: PixelFormat::H264, width: 160, height: 120, rates }])
    }
    fn start(&mut self, choice: &Choice, buffers: u32) -> Result<Started> {
        Ok(Started { format: choice.format, width: 160, height: 120, stride: 0, rate: Some(choice.rate), buffers })
    }
    fn grab(&mut self, _: Duration, frame: &mut Grabbed) -> Result<Grab> {
        // Units 3 (before the first keyframe is due: the stream begins in its middle) on, without 55.
        self.next += 1 + usize::from(self.next + 1 == 55);
        let Some(unit) = self.units.get(self.next) else {
            return Err(CaptureError::Unplugged { device: "player".to_owned() });
        };
        frame.data.clone_from(unit);
        frame.sequence = Some(self.next as u32);
        frame.driver_nanos = Some(self.next as i64 * 10_000_000);
        frame.is_corrupt = false;
        Ok(Grab::Frame)
    }
    fn stop(&mut self) {}
}

#[test]
fn h264_is_kept_as_it_is_from_the_first_keyframe_and_around_gaps() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let raw = dir.path().join("v.h264");
    let source = "-f lavfi -i testsrc2=size=160x120:rate=100:duration=1.2 -c:v libx264 -pix_fmt yuv420p -bf 0";
    ffmpeg(&format!("{source} -x264-params aud=1:keyint=20:min-keyint=20:scenecut=0:repeat-headers=1 -f h264"), &raw);
    let bytes = fs::read(&raw).unwrap();
    // Every unit begins with a delimiter.
    let mut starts: Vec<usize> =
        bytes.windows(5).enumerate().filter(|(_, w)| *w == [0, 0, 0, 1, 9]).map(|(i, _)| i).collect();
    assert_eq!(starts.len(), 120);
    starts.push(bytes.len());
    let units = starts.windows(2).map(|w| bytes[w[0]..w[1]].to_vec()).collect();
    let out = dir.path().join("take");
    let summary =
        record_live(Box::new(Player { units, next: 2 }), &options("player", &out, 60.0), None, &Silent).unwrap();
    // From 20 on; 55 was lost, so 56 to 59 cannot be decoded.
    assert_eq!((summary.manifest.frame_count, summary.lost_by_driver, summary.discarded), (95, 1, 4));
    let take = measure_take(&out, &Silent).unwrap();
    assert!(take.frames.iter().all(|f| f.sharpness.is_some()), "all of it decodes");
    let dropped: Vec<_> =
        take.frames.iter().filter(|f| f.dropped_before > 0).map(|f| (f.index.0, f.dropped_before)).collect();
    assert_eq!(dropped, [(35, 5)]);
    assert_eq!(take.frames[94].timestamp_nanos, 990_000_000);
}
