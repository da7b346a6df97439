//! Tables that went wrong in the hands of users, with the right values: scales, separators, rates.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::PathBuf;

use risorius_formats::curves::{CurveOptions, Curves};
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::report::Collected;
use risorius_formats::{ActionUnit, Hint, Silent, TableScale};

fn field(path: &str) -> Option<PathBuf> {
    risorius_tests::shared(&format!("data/field/{path}"))
}

fn kinds(heard: &Collected) -> Vec<&'static str> {
    heard.warnings().iter().map(|w| w.kind).collect()
}

#[test]
fn a_table_whose_decimal_points_a_spreadsheet_lost_is_refused() {
    let Some(path) = field("excel/excel100.csv") else { return };
    let error = openface::read(path, &ReadOptions::foreign(), &Silent).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("intensities up to 500, confidence 98"), "{text}");
    assert!(text.contains("decimal points were lost") && error.line().is_some() && error.column().is_some(), "{text}");
    assert!(error.hint().unwrap().contains("the file that OpenFace wrote"));
}

#[test]
fn decimal_commas_are_named_as_the_cause() {
    let Some(path) = field("excel/commas.csv") else { return };
    let error = openface::read(path, &ReadOptions::foreign(), &Silent).unwrap_err();
    assert!(error.to_string().contains("decimal commas") && error.line() == Some(2), "{error}");
    assert!(error.hint().unwrap().contains("LC_ALL=C"));
}

#[test]
fn scales_and_separators_of_a_true_table_are_converted() {
    let Some(path) = field("colmap-names/openface.csv") else { return };
    let text = std::fs::read_to_string(path).unwrap();
    let read = |text: &str, options: &ReadOptions| {
        let heard = Collected::default();
        let track = openface::parse(text.as_bytes(), options, &heard).unwrap();
        (track, kinds(&heard))
    };
    let (truth, said) = read(&text, &ReadOptions::foreign());
    assert_eq!(said, Vec::<&str>::new());
    // Semicolons with decimal commas, as a European spreadsheet exports; and tabs.
    let semicolons = text.replace(',', ";").replace('.', ",");
    for other in [semicolons, text.replace(',', "\t")] {
        let (track, said) = read(&other, &ReadOptions::foreign());
        assert_eq!((track == truth, said), (true, vec!["other-separators"]));
    }
    // The same intensities as percent and as shares, with the columns that other tools write.
    let header: Vec<&str> = text.lines().next().unwrap().split(',').map(str::trim).collect();
    let scaled = |factor: f64| {
        let row = |line: &str| -> String {
            let cell = |(name, cell): (&&str, &str)| {
                if name.starts_with("AU") && name.ends_with("_r") {
                    format!("{:.4}", cell.trim().parse::<f64>().unwrap() * factor)
                } else {
                    cell.to_owned()
                }
            };
            header.iter().zip(line.split(',')).map(cell).collect::<Vec<_>>().join(",")
        };
        let rows: Vec<String> = text.lines().skip(1).map(row).collect();
        format!("{}\n{}\n", header.join(","), rows.join("\n"))
    };
    for (factor, scale) in [(20.0, TableScale::Hundred), (0.2, TableScale::One)] {
        for stated in [None, Some(scale)] {
            let (track, said) = read(&scaled(factor), &ReadOptions { scale: stated, ..ReadOptions::foreign() });
            let expected = if stated.is_none() { vec!["other-scale"] } else { vec![] };
            assert_eq!(said, expected, "{scale:?}");
            for (a, b) in track.rows.iter().zip(&truth.rows) {
                for (x, y) in a.intensities.iter().zip(&b.intensities) {
                    assert!((x.unwrap_or(-1.0) - y.unwrap_or(-1.0)).abs() < 2e-3, "{x:?} {y:?}");
                }
            }
        }
    }
}

#[test]
fn timecodes_at_24_and_25_frames_a_second_give_the_true_times() {
    for (name, fps) in [("llf24.csv", 24.0), ("llf25.csv", 25.0)] {
        let Some(path) = field(&format!("curves-rate/{name}")) else { return };
        let heard = Collected::default();
        let curves = Curves::read(path, &heard).unwrap();
        for (k, time) in curves.times_secs.iter().enumerate() {
            assert!((time - k as f64 / fps).abs() < 1e-9, "{name} row {k}: {time}");
        }
        assert!(kinds(&heard).is_empty());
    }
    let (Some(recorded), Some(truth)) = (field("curves-rate/llf24.csv"), field("curves-rate/true24.csv")) else {
        return;
    };
    let (recorded, truth) = (Curves::read(recorded, &Silent).unwrap(), Curves::read(truth, &Silent).unwrap());
    let jaw = |c: &Curves| c.column(ActionUnit(26)).unwrap();
    assert!(jaw(&recorded).iter().zip(jaw(&truth)).all(|(a, b)| (a.unwrap() - b.unwrap()).abs() < 1e-3));
}

#[test]
fn py_feat_s_probabilities_and_clock_are_read() {
    let Some(path) = field("pyfeat/pyfeat.csv") else { return };
    let heard = Collected::default();
    let curves = Curves::read(&path, &heard).unwrap();
    assert_eq!(kinds(&heard), ["other-scale"]);
    let most = curves.column(ActionUnit(12)).unwrap().into_iter().flatten().fold(0.0, f32::max);
    assert!((most - 4.5).abs() < 0.02, "{most}");
    assert!((curves.times_secs[49] - 49.0 / 25.0).abs() < 1e-9, "{:?}", curves.times_secs.last());
    let options = CurveOptions { fps: Some(50.0), scale: Some(TableScale::Five) };
    let stated = Curves::read_with(&path, &options, &Silent).unwrap();
    assert!((stated.times_secs[49] - 0.98).abs() < 1e-9 && stated.rows[0][8] == curves.rows[0][8].map(|v| v / 5.0));
}

#[test]
fn libreface_s_intensities_and_thousandths_are_read() {
    let Some(path) = field("pyfeat/libreface.csv") else { return };
    let heard = Collected::default();
    let curves = Curves::read(path, &heard).unwrap();
    assert!(kinds(&heard).is_empty());
    assert_eq!(curves.units, [ActionUnit(1), ActionUnit(12), ActionUnit(26)]);
    assert!((curves.times_secs[1] - 0.033_333).abs() < 1e-9 && curves.rows[1][1] == Some(2.2));
}
