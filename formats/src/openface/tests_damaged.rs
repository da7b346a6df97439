//! Tables that are damaged, contradict themselves or are none: what is recovered is told, what is not is named by its place.

use super::*;

#[test]
fn a_cut_off_last_row_is_left_out() {
    let whole = small(&["1,0,0,0.9,1,1,1,1", "2,0,0,0.9,1,1,1,1"]);
    for text in [whole.clone() + "3,0,0,0.9,1,", whole.clone() + "3,0,0,0.9\r\n", whole.clone() + "3,0,0,0.9,1,1,1,-"] {
        let (track, heard) = parse_text(&text).unwrap();
        assert_eq!((track.rows.len(), kinds(&heard)), (2, vec!["truncated-row"]), "{text}");
        assert!(heard.warnings()[0].message.contains("line 4"));
    }
    let error = failure(&(small(&["1,0,0,0.9,1,1"]) + "2,0,0,0.9,1,1,1,1\n"));
    assert_eq!((error.kind(), error.line()), (ErrorKind::Syntax, Some(2)));
    assert!(error.to_string().contains("expected 8 columns, found 6"), "{error}");
}

#[test]
fn frames_are_numbered_by_row_only_when_the_column_says_nothing() {
    let rows = ["0,0,0,0.9,1,1,1,1", "0,0,0.1,0.9,1,2,2,1", "0,1,0.1,0.9,1,3,3,1"];
    let (track, heard) = parse_text(&small(&rows)).unwrap();
    assert_eq!(track.rows.iter().map(|r| r.frame.0).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(kinds(&heard), ["frames-by-row", "several-faces"]);
    let (track, heard) = parse_text("frame,confidence,success,AU45_r\n1,1,1,1\n2,1,1,2\n2,1,1,3\n").unwrap();
    assert_eq!((track.rows.len(), kinds(&heard)), (3, vec!["frames-by-row"]));
    assert_eq!(track.rows[2].intensities, [Some(3.0)]);
    // With face ids, a repeated frame is a contradiction.
    let error = failure(&small(&["4,0,0,1,1,1,1,1", "5,0,0,1,1,1,1,1", "4,0,0,1,1,1,1,1"]));
    assert_eq!((error.kind(), error.line(), error.column()), (ErrorKind::Inconsistent, Some(4), Some("frame")));
    // Gaps stay gaps.
    let (track, _) = parse_text(&small(&["9,0,0,1,1,1,1,1", "4,0,0,1,1,1,1,1"])).unwrap();
    assert_eq!(track.rows.iter().map(|r| r.frame.0).collect::<Vec<_>>(), [3, 8]);
}

#[test]
fn frames_before_the_first_are_an_error_with_advice() {
    let text = small(&["1,0,0,1,1,1,1,1", "0,0,0,1,1,1,1,1"]).replace('\n', "\r\n");
    let error = failure(&text);
    assert_eq!((error.kind(), error.line(), error.column()), (ErrorKind::Inconsistent, Some(3), Some("frame")));
    assert!(error.hint().unwrap().contains("--first-frame 0"));
    let options = ReadOptions { first_frame: Some(0), ..ReadOptions::default() };
    let track = parse(text.as_bytes(), &options, &Silent).unwrap();
    assert_eq!(track.rows.iter().map(|r| r.frame.0).collect::<Vec<_>>(), [0, 1]);
}

#[test]
fn intensities_off_the_scale_are_clamped_and_told() {
    let (track, heard) = parse_text(&small(&["1,0,0,1,1,-0.4,7,1", "2,0,0,1,1,-1,5,1"])).unwrap();
    assert_eq!(track.rows[0].intensities, [Some(0.0), Some(5.0)]);
    assert_eq!(kinds(&heard), ["negative-intensity", "intensity-above-5"]);
    assert!(heard.warnings()[0].message.starts_with("2 negative"), "{:?}", heard.warnings());
    assert!(heard.warnings()[0].message.ends_with("(first in line 2)"), "{:?}", heard.warnings());
}

#[test]
fn what_is_no_number_is_missing() {
    for cell in ["nan", "NaN", "-nan(ind)", "1.#QNAN", "-1.#IND", "", "NA", "inf", "-inf"] {
        let (track, heard) = parse_text(&small(&[&format!("1,0,0,1,1,{cell},1,1"), "2,0,0,1,1,2,1,1"])).unwrap();
        assert_eq!(track.rows[0].intensities, [None, Some(1.0)], "{cell}");
        assert_eq!(kinds(&heard), ["missing-value"], "{cell}");
    }
    // A unit without any value is not in the table.
    let (track, heard) = parse_text(&small(&["1,0,0,1,1,nan,1,1", "2,0,0,1,1,nan,2,1"])).unwrap();
    assert_eq!((track.units, track.rows[1].intensities.clone()), (vec![ActionUnit(12)], vec![Some(2.0)]));
    assert!(kinds(&heard).is_empty());
    // One missing coordinate makes the whole set untrustworthy.
    let text = faces_table(&[(1, 0, true, 50.0, 10.0)]).replacen(", 45,", ", nan,", 1);
    let (track, heard) = parse_text(&text).unwrap();
    assert_eq!((track.rows[0].landmarks.is_none(), kinds(&heard)), (true, vec!["missing-value"]));
}

#[test]
fn a_bad_cell_is_named_by_line_and_column() {
    let text = small(&["1,0,0,1,1,1,1,1", "", "2,0,0,1,1,1,0.2x,1", "3,0,0,1,1,1,1,1"]);
    for text in [text.clone(), text.replace('\n', "\r\n")] {
        let error = failure(&text);
        assert_eq!((error.kind(), error.line(), error.column()), (ErrorKind::Syntax, Some(4), Some("AU12_r")));
        assert!(error.to_string().contains("expected an intensity from 0 to 5, found `0.2x`"), "{error}");
    }
    for (row, column) in [
        ("x,0,0,1,1,1,1,1", "frame"),
        ("1,-1,0,1,1,1,1,1", "face_id"),
        ("1.5,0,0,1,1,1,1,1", "frame"),
        ("1,0,0,1,yes,1,1,1", "success"),
    ] {
        assert_eq!(failure(&small(&[row])).column(), Some(column));
    }
}

#[test]
fn headers_are_checked() {
    let error = failure("frame,confidence,success,AU01_r,AU01_r\n1,1,1,1,1\n");
    assert_eq!((error.kind(), error.line(), error.column()), (ErrorKind::Inconsistent, Some(1), Some("AU01_r")));
    let error = failure("frame,confidence,success,AU01_r,AU1_r\n1,1,1,1,1\n");
    assert_eq!(error.column(), Some("AU1_r"));
    let error = failure("Frame,confidence,success,AU01_r\n1,1,1,1\n");
    assert_eq!(error.kind(), ErrorKind::Missing);
    assert!(error.to_string().contains("`frame`") && error.hint().unwrap().contains("`Frame`"), "{error}");
    let error = failure("frame,confidence,success,AU01\n1,1,1,1\n");
    assert!(error.to_string().contains("`AU01_r`") && error.hint().unwrap().contains("`AU01`"), "{error}");
    let text = faces_table(&[(1, 0, true, 50.0, 10.0)]).replace(" x_7,", " X_7,");
    let error = failure(&text);
    assert!(error.to_string().contains("`x_7`") && error.hint().unwrap().contains("`X_7`"), "{error}");
    let (track, heard) = parse_text("frame;confidence;success;AU01_r\n1;0,9;1;2,5\n").unwrap();
    assert_eq!((track.rows[0].intensities.clone(), kinds(&heard)), (vec![Some(2.5)], vec!["other-separators"]));
    for text in ["", " \n\r\n", "frame,confidence,success,AU01_r\n", "frame,confidence,success,AU01_r"] {
        assert_eq!(failure(text).kind(), ErrorKind::Empty, "{text:?}");
    }
}

#[test]
fn what_is_no_table_is_called_so_in_clean_words() {
    let utf16: Vec<u8> = "\u{feff}frame,confidence".encode_utf16().flat_map(u16::to_le_bytes).collect();
    for bytes in [&b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"[..], b"\x7fELF\x02\x01\n1,2\n", &utf16, &[0; 9000]] {
        let error = parse(bytes, &ReadOptions::default(), &Silent).unwrap_err();
        assert!(error.to_string().contains("is not a text table"), "{error}");
    }
    let mut damaged = b"frame,confidence,success,AU01_r\n1,".to_vec();
    damaged.extend(b"\xff\x07\x80,1,1\n2,1,1,1\n");
    let error = parse(&damaged, &ReadOptions::default(), &Silent).unwrap_err();
    assert_eq!(
        error.to_string(),
        "line 2: column `confidence`: expected a number from 0 to 1, found bytes that are not text"
    );
    assert!(error.hint().is_some());
    // A name of another kind of file is not offered.
    let error = failure("ts,bid,ask\n1,1,1\n");
    assert!(!error.hint().unwrap().contains("nearest"), "{error}");
}

proptest! {
    #[test]
    fn no_bytes_make_it_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = parse(&bytes, &ReadOptions::default(), &Silent);
        let mut table = small(&["1,0,0,1,1,1,1,1"]).into_bytes();
        table.extend(bytes);
        let _ = parse(&table, &ReadOptions::default(), &Silent);
    }

    #[test]
    fn damaged_tables_parse_or_say_where(
        damage in prop::collection::vec((any::<prop::sample::Index>(), prop::sample::select(&b"0,\n\r \"-.enaxA\xff\0"[..])), 1..6),
        delete in any::<bool>(),
    ) {
        let mut bytes = small(&["1,0,0,0.98,1,0.50,1.20,1", "2,0,0.033,0.98,0,0,0,0", "3,1,0.066,0.5,1,1,2,0"]).into_bytes();
        for (at, byte) in damage {
            let at = at.index(bytes.len());
            if delete { bytes.remove(at); } else { bytes[at] = byte; }
        }
        if let Err(error) = parse(&bytes, &ReadOptions::default(), &Silent) {
            prop_assert!(error.line().is_some() || error.kind() == ErrorKind::Empty, "{}", error);
        }
    }
}
