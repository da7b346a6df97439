#[path = "tests_damaged.rs"]
mod damaged;

use std::fmt::Write as _;

use glam::DVec3;
use proptest::prelude::*;
use risorius_tests::shared;

use super::*;
use crate::report::Collected;
use crate::track::HeadPose;
use crate::{ActionUnit, ErrorKind, FormatError, FrameIndex, Hint, Landmarks68, Silent, TrackRow};

fn read_shared(path: &str) -> Option<(Track, Collected)> {
    let file = shared(path)?;
    let heard = Collected::default();
    let track = read(&file, &ReadOptions::default(), &heard).unwrap();
    assert!(track.rows.windows(2).all(|w| w[0].frame < w[1].frame), "{path}");
    Some((track, heard))
}

fn parse_text(text: &str) -> Result<(Track, Collected)> {
    let heard = Collected::default();
    parse(text.as_bytes(), &ReadOptions::default(), &heard).map(|track| (track, heard))
}

fn kinds(heard: &Collected) -> Vec<&'static str> {
    heard.warnings().iter().map(|w| w.kind).collect()
}

/// Header and rows of a small table: two intensities and a presence.
fn small(rows: &[&str]) -> String {
    let mut text = "frame,face_id,timestamp,confidence,success,AU01_r,AU12_r,AU12_c\n".to_owned();
    for row in rows {
        writeln!(text, "{row}").unwrap();
    }
    text
}

fn failure(text: &str) -> FormatError {
    parse_text(text).unwrap_err()
}

/// A table with landmarks: (frame, face id, success, centre x, size) per row.
fn faces_table(rows: &[(u32, u32, bool, f64, f64)]) -> String {
    let mut text = "frame, face_id, timestamp, confidence, success".to_owned();
    for axis in ["x", "y"] {
        (0..68).for_each(|i| write!(text, ", {axis}_{i}").unwrap());
    }
    text.push_str(", AU12_r\n");
    for &(frame, id, success, center, size) in rows {
        write!(text, "{frame}, {id}, {}, 0.9, {}", f64::from(frame) / 30.0, u8::from(success)).unwrap();
        for axis in 0..2 {
            for i in 0..68 {
                let offset = if i % 2 == axis { size / 2.0 } else { -size / 2.0 };
                write!(text, ", {}", if success { center + offset } else { 0.0 }).unwrap();
            }
        }
        writeln!(text, ", {}", f64::from(id) / 10.0).unwrap();
    }
    text
}

#[test]
fn the_capture_reads_and_writes_back_its_own_digits() {
    let Some((track, heard)) = read_shared("data/captures/ada/openface.csv") else { return };
    assert_eq!(kinds(&heard), Vec::<&str>::new());
    assert_eq!((track.rows.len(), track.units.len(), track.presence_units.len()), (2400, 17, 18));
    assert_eq!(track.units, crate::au::OPENFACE_INTENSITIES);
    assert_eq!(track.rows.iter().filter(|r| !r.success).count(), 10);
    assert!(!track.rows[85].success && track.rows[85].landmarks.is_none() && track.rows[85].intensities[0].is_none());
    let row = &track.rows[1];
    assert_eq!(row.head_pose.unwrap().translation_mm, DVec3::new(-26.9, 1.8, 530.1));
    assert_eq!(row.head_pose.unwrap().rotation_rad, DVec3::new(0.015, 0.522, -0.009));
    assert_eq!(row.landmarks.as_ref().unwrap().points_px[1][0], 153.5);
    assert_eq!(row.landmarks_in_camera_mm.as_ref().unwrap()[1], [-61.1, -14.7, 610.1]);

    let bytes = to_bytes(&track).unwrap();
    assert_eq!(parse(&bytes, &ReadOptions::default(), &Silent).unwrap(), track);
    // Every column that the track holds comes back digit by digit, the others as zeros of the same width.
    let original = std::fs::read_to_string(shared("data/captures/ada/openface.csv").unwrap()).unwrap();
    let written = String::from_utf8(bytes).unwrap();
    assert_eq!(written.lines().next(), original.lines().next());
    let names: Vec<&str> = original.lines().next().unwrap().split(',').collect();
    assert_eq!(names.len(), 714);
    let kept = |name: &str| !name.starts_with("gaze") && !name.starts_with("eye_lmk") && !name.starts_with("p_");
    let decimals = |cell: &str| cell.split_once('.').map(|(_, d)| d.len());
    let same = |a: &str, b: &str| a == b || a.trim_start_matches('-') == b && b.parse() == Ok(0.0);
    for (line, (a, b)) in original.lines().zip(written.lines()).enumerate().skip(1) {
        let (a, b): (Vec<&str>, Vec<&str>) = (a.split(',').collect(), b.split(',').collect());
        assert_eq!(b.len(), 714);
        for ((name, a), b) in names.iter().zip(&a).zip(&b) {
            if kept(name) && (track.rows[line - 1].success || b.parse() != Ok(0.0)) {
                assert!(same(a, b), "row {line} {name}: {a} {b}");
            }
            assert_eq!(decimals(a), decimals(b), "row {line} {name}");
        }
    }
}

#[test]
fn the_driver_and_the_clips_read() {
    if let Some((track, heard)) = read_shared("data/captures/ada/driver_openface.csv") {
        assert_eq!((track.rows.len(), track.units.len(), kinds(&heard).len()), (720, 17, 0));
    }
    for (path, rows) in [
        ("data/video/liveportrait_driving_d3.openface.csv", 354),
        ("data/video/liveportrait_driving_d6.openface.csv", 1008),
    ] {
        let Some((track, _)) = read_shared(path) else { continue };
        assert_eq!((track.rows.len(), track.units.len(), track.presence_units.len()), (rows, 17, 0), "{path}");
        assert!(track.rows.iter().filter(|r| r.success).all(|r| r.landmarks.is_some() && r.head_pose.is_some()));
        assert!(track.rows.iter().all(|r| r.landmarks_in_camera_mm.is_none()));
        // What the table did not have comes back as not there.
        assert_eq!(parse(&to_bytes(&track).unwrap(), &ReadOptions::default(), &Silent).unwrap(), track);
    }
}

#[test]
fn tables_of_other_versions_read() {
    if let Some((track, heard)) = read_shared("data/openface_csv/of_1.x_headerspace_pyfeat_OpenFace_Test.csv") {
        assert_eq!(kinds(&heard), Vec::<&str>::new());
        assert_eq!((track.rows.len(), track.units.len(), track.presence_units.len()), (100, 17, 18));
        let row = &track.rows[0];
        assert_eq!(row.landmarks.as_ref().unwrap().points_px[0][0], 277.776);
        assert_eq!(row.head_pose.unwrap().translation_mm, DVec3::new(16.6573, 43.4571, 597.876));
    }
    if let Some((track, _)) = read_shared("data/openface_csv/of_1.x_doublespace_video2.csv") {
        assert_eq!((track.rows.len(), track.units.len()), (608, 17));
        assert_eq!(track.rows[0].landmarks.as_ref().unwrap().points_px[0][0], 478.239);
    }
    if let Some((track, _)) = read_shared("data/openface_csv/of_2.2_livetalking_au.csv") {
        assert_eq!((track.rows.len(), track.units.len(), track.presence_units.len()), (8000, 17, 18));
        assert!(track.rows[0].landmarks.is_none() && track.rows[0].head_pose.is_none());
        assert_eq!(track.rows[0].intensities[0], Some(0.05));
    }
}

#[test]
fn separators_line_ends_and_quotes_do_not_matter() {
    let plain = parse_text(&small(&["1,0,0.0,0.98,1,0.5,1.25,1", "2,0,0.033,0.97,1,0.25,2,0"])).unwrap().0;
    for text in [
        "frame, face_id, timestamp, confidence, success, AU01_r, AU12_r, AU12_c\r\n1,  0,  0.0,  0.98,  1, 0.5, 1.25,1\r\n2, 0,0.033, 0.97,  1,0.25, 2,0",
        "\u{feff}\"frame\",\"face_id\",\"timestamp\",\"confidence\",\"success\",\"AU01_r\",\"AU12_r\",\"AU12_c\"\n\n1.0,0,0.0,0.98,1.0,0.5,1.25,1\n\n2,0,0.033,0.97,1,\"0.25\",2,0\n\n",
        "frame,face_id,timestamp,confidence,success,AU01_r,AU12_r,AU12_c,,note\n2,0,0.033,0.97,1,0.25,2,0,,b\n1,0,0.0,0.98,1,0.5,1.25,1,7,a\n",
    ] {
        let (track, heard) = parse_text(text).unwrap();
        assert_eq!(track, plain, "{text}");
        assert!(kinds(&heard).is_empty());
    }
}

#[test]
fn rows_without_success_say_nothing() {
    let (track, heard) = parse_text(&small(&["3,0,0.1,0.02,0,0,0,0", "5,0,0.2,0.9,1,-0,0,1"])).unwrap();
    assert_eq!(track.rows[0].frame, FrameIndex(2));
    assert_eq!((track.rows[0].intensities.clone(), track.rows[0].presences.clone()), (vec![None; 2], vec![None]));
    assert_eq!(track.rows[1].intensities, [Some(0.0), Some(0.0)]);
    assert!(kinds(&heard).is_empty());
}

#[test]
fn old_tables_lack_face_and_time() {
    let (track, _) = parse_text("frame,confidence,success,AU45_r\n1,0.9,1,2.5\n").unwrap();
    assert_eq!((track.rows[0].face_id, track.rows[0].timestamp_secs), (0, None));
    assert_eq!(track.units, [ActionUnit(45)]);
}

#[test]
fn single_images_are_frame_zero() {
    let text = faces_table(&[(1, 0, true, 50.0, 10.0), (2, 1, true, 200.0, 40.0)])
        .replace("frame, face_id, timestamp, confidence, success", "face, a, b, confidence, c")
        .replace("\n2, ", "\n7, ");
    let (track, heard) = parse_text(&text).unwrap();
    assert_eq!(track.rows.len(), 1);
    assert_eq!((track.rows[0].frame, track.rows[0].face_id, track.rows[0].success), (FrameIndex(0), 7, true));
    assert_eq!(kinds(&heard), ["several-faces"]);
    let (track, heard) = parse_text("face, confidence, AU12_r\n0, 0.925, 1\n0, 0.875, 2\n").unwrap();
    assert_eq!((track.rows.len(), kinds(&heard)), (2, vec!["frames-by-row"]));
}

#[test]
fn the_largest_face_is_followed_by_its_place() {
    let rows = [
        (1, 0, true, 100.0, 20.0),
        (1, 1, true, 300.0, 60.0),
        // The ids change places, and the other face grows.
        (2, 0, true, 303.0, 60.0),
        (2, 1, true, 101.0, 90.0),
        // Only the other one is there.
        (3, 0, true, 102.0, 90.0),
        (4, 4, true, 102.0, 90.0),
        (4, 5, true, 310.0, 58.0),
        (5, 4, false, 0.0, 0.0),
        (5, 5, true, 312.0, 58.0),
    ];
    let (track, heard) = parse_text(&faces_table(&rows)).unwrap();
    let ids: Vec<_> = track.rows.iter().map(|r| r.success.then_some(r.face_id)).collect();
    assert_eq!(ids, [Some(1), Some(0), None, Some(5), Some(5)]);
    assert_eq!(track.rows[2].intensities, [None]);
    assert_eq!(kinds(&heard), ["several-faces"]);
    let options = ReadOptions { face: FaceChoice::First, ..ReadOptions::default() };
    let first = parse(faces_table(&rows).as_bytes(), &options, &Silent).unwrap();
    assert_eq!(first.rows.iter().map(|r| r.face_id).collect::<Vec<_>>(), [0, 0, 0, 4, 4]);
}

#[test]
fn faces_without_landmarks_are_followed_by_pose_or_id() {
    let header = "frame,face_id,confidence,success,AU12_r,pose_Tx,pose_Ty,pose_Tz,pose_Rx,pose_Ry,pose_Rz\n";
    let text = format!(
        "{header}1,0,1,1,1,-200,0,900,0,0,0\n1,1,1,1,2,100,0,500,0,0,0\n2,0,1,1,2,105,0,500,0,0,0\n2,1,1,1,1,-200,0,900,0,0,0\n"
    );
    let (track, _) = parse_text(&text).unwrap();
    assert_eq!(track.rows.iter().map(|r| r.intensities[0]).collect::<Vec<_>>(), [Some(2.0), Some(2.0)]);
    let rows = ["1,3,0,1,1,1,1,1", "1,4,0,1,1,2,2,1", "2,4,0,1,1,2,2,1", "2,3,0,1,1,1,1,1"];
    let (track, _) = parse_text(&small(&rows)).unwrap();
    assert_eq!(track.rows.iter().map(|r| r.face_id).collect::<Vec<_>>(), [3, 3]);
}

fn arbitrary_row(frame: u32, numbers: &[i32], success: bool, full: bool) -> TrackRow {
    // Values with the decimals of the table, so that the round trip is exact.
    let n = |i: usize| f64::from(numbers[i % numbers.len()]);
    let tenth = |i: usize| n(i) / 10.0;
    TrackRow {
        frame: FrameIndex(frame),
        face_id: frame % 3,
        timestamp_secs: full.then(|| f64::from(frame) / 8.0),
        confidence: (n(0).abs() % 101.0 / 100.0) as f32,
        success,
        intensities: (0..17).map(|i| success.then(|| (n(i).abs() % 501.0 / 100.0) as f32)).collect(),
        presences: (0..18).map(|i| success.then(|| n(i) > 0.0)).collect(),
        landmarks: (success && full).then(|| {
            let points_px = std::array::from_fn(|i| [(tenth(i) + 0.5) as f32, (tenth(i + 68) + 0.5) as f32]);
            Box::new(Landmarks68 { points_px })
        }),
        landmarks_in_camera_mm: (success && full)
            .then(|| Box::new(std::array::from_fn(|i| [tenth(i) as f32, tenth(i + 1) as f32, tenth(i + 2) as f32]))),
        head_pose: success.then(|| HeadPose {
            translation_mm: DVec3::new(tenth(0), tenth(1), tenth(2)),
            rotation_rad: DVec3::new(n(3) / 1000.0, n(4) / 1000.0, n(5) / 1000.0),
        }),
    }
}

#[test]
fn units_that_openface_lacks_follow_its_columns() {
    let mut row = arbitrary_row(0, &[1, 2, 3], true, true);
    row.intensities = vec![Some(1.5), Some(0.5)];
    row.presences = vec![Some(true)];
    let track =
        Track { units: vec![ActionUnit(12), ActionUnit(43)], presence_units: vec![ActionUnit(43)], rows: vec![row] };
    let bytes = to_bytes(&track).unwrap();
    assert!(String::from_utf8_lossy(&bytes).lines().next().unwrap().ends_with(",AU45_c,AU43_r,AU43_c"));
    assert_eq!(parse(&bytes, &ReadOptions::default(), &Silent).unwrap(), track);
}

#[test]
fn rows_that_do_not_fit_the_units_are_refused() {
    let track =
        Track { units: vec![ActionUnit(1)], presence_units: vec![], rows: vec![arbitrary_row(0, &[1], true, true)] };
    assert_eq!(to_bytes(&track).unwrap_err().kind(), ErrorKind::Inconsistent);
    let mut row = arbitrary_row(u32::MAX, &[1], false, true);
    (row.intensities, row.presences) = (vec![], vec![]);
    assert_eq!(to_bytes(&Track { rows: vec![row], ..Track::default() }).unwrap_err().kind(), ErrorKind::Limits);
}

proptest! {
    #[test]
    fn what_is_written_reads_back(
        rows in prop::collection::vec((prop::collection::vec(-9999i32..9999, 7..40), any::<bool>(), any::<bool>(), 1u32..9), 1..6),
    ) {
        let mut frame = 0;
        let mut track = Track { units: crate::au::OPENFACE_INTENSITIES.to_vec(), ..Track::default() };
        track.presence_units = track.units.clone();
        track.presence_units.insert(16, ActionUnit(28));
        for (numbers, success, full, step) in rows {
            track.rows.push(arbitrary_row(frame, &numbers, success, full));
            frame += step;
        }
        let heard = Collected::default();
        let back = parse(&to_bytes(&track).unwrap(), &ReadOptions::default(), &heard).unwrap();
        prop_assert_eq!(back, track);
        prop_assert!(heard.warnings().is_empty());
    }
}

#[test]
fn a_row_gets_its_gaze_and_keeps_all_else() {
    let row = |frame: u32| TrackRow {
        frame: FrameIndex(frame),
        face_id: 0,
        timestamp_secs: Some(f64::from(frame)),
        confidence: 0.5,
        success: true,
        intensities: vec![],
        presences: vec![],
        landmarks: Some(Box::new(Landmarks68 { points_px: [[7.5, 8.5]; 68] })),
        landmarks_in_camera_mm: None,
        head_pose: None,
    };
    let track = Track { rows: vec![row(0), row(1)], ..Track::default() };
    let landmarks_px = std::array::from_fn(|i| [i as f32 + 0.5, 2.5]);
    let eyes = Eyes {
        directions: [DVec3::new(0.1, -0.2, -0.97); 2],
        angles: [0.125, -0.25],
        landmarks_px: &landmarks_px,
        landmarks_mm: &[[1.0, 2.0, 3.0]; EYE_LANDMARKS],
    };
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let (plain, filled) =
        (text(to_bytes(&track).unwrap()), text(to_bytes_with_eyes(&track, &[None, Some(eyes)]).unwrap()));
    let lines: Vec<[&str; 2]> = plain.lines().zip(filled.lines()).map(|(a, b)| [a, b]).collect();
    assert_eq!(lines[0][0], lines[0][1], "the header");
    assert_eq!(lines[1][0], lines[1][1], "a frame without gaze");
    let [line, found] = lines[2].map(|l| l.split(',').collect::<Vec<_>>());
    assert_eq!(found.len(), 714);
    assert_eq!((found[5], found[10], found[11], found[12]), ("0.100000", "-0.970000", "0.125", "-0.250"));
    assert_eq!((found[13], found[14], found[69], found[125], found[292]), ("0.0", "1.0", "2.0", "1.0", "3.0"));
    assert_eq!([&line[..5], &line[293..]].concat(), [&found[..5], &found[293..]].concat());
}
