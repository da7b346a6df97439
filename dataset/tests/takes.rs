//! Takes that do not belong together, rows that cannot be used, and the order of everything.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::path::{Path, PathBuf};

use glam::DVec3;
use risorius_dataset::split::SplitKind;
use risorius_dataset::verify::verify;
use risorius_dataset::{BuildOptions, DatasetError, Report, Sampling, build};
use risorius_formats::nerfies::Dataset;
use risorius_formats::report::Collected;
use risorius_formats::{ActionUnit, AttributeTable, FrameIndex, Hint, Silent};

fn options() -> BuildOptions {
    BuildOptions { frames: 60, scale: 4, scales: vec![4], ..BuildOptions::default() }
}

struct Bench {
    dir: tempfile::TempDir,
    takes: Vec<PathBuf>,
}

impl Bench {
    fn new(changes: &[&dyn Fn(&mut common::Take)]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let takes: Vec<PathBuf> = (0..changes.len()).map(|k| dir.path().join(format!("take{k}"))).collect();
        for (change, path) in changes.iter().zip(&takes) {
            let mut take = common::take();
            change(&mut take);
            take.write(path);
        }
        Self { dir, takes }
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    fn build(&self, options: &BuildOptions) -> (Result<Report, DatasetError>, Collected) {
        let collected = Collected::default();
        (build(&self.takes, &self.out(), options, &collected), collected)
    }

    /// The refusal, which leaves nothing behind and gives advice.
    fn refusal(&self, options: &BuildOptions) -> String {
        let error = self.build(options).0.unwrap_err();
        assert!(error.hint().is_some(), "{error}");
        let names: Vec<_> = std::fs::read_dir(self.dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(names.iter().all(|n| n.to_string_lossy().starts_with("take")), "{names:?}");
        error.to_string()
    }
}

fn named(subject: &'static str) -> impl Fn(&mut common::Take) {
    move |take| take.manifest.subject = subject.into()
}

fn with_face(change: impl Fn(usize, DVec3) -> DVec3) -> impl Fn(&mut common::Take) {
    move |take| {
        for (i, p) in take.report.landmarks_in_world.iter_mut().enumerate() {
            *p = change(i, *p);
        }
    }
}

#[test]
fn two_persons_are_refused_unless_they_are_one() {
    let bench = Bench::new(&[&named("S01"), &named("S02")]);
    let text = bench.refusal(&options());
    assert!(text.contains("take.toml") && text.contains("`S02`") && text.contains("`S01`"), "{text}");
    let (report, warnings) = bench.build(&BuildOptions { same_subject: true, ..options() });
    assert_eq!((report.unwrap().takes.len(), warnings.count("two-subjects")), (2, 1));
    // Case and spaces are no other person; one that says nothing is taken for the same, with a word.
    assert!(Bench::new(&[&named("S01"), &named(" s01 ")]).build(&options()).0.is_ok());
    let (report, warnings) = Bench::new(&[&named("S01"), &|_| {}]).build(&options());
    assert!(report.is_ok());
    assert_eq!(warnings.count("unknown-subject"), 1);
}

#[test]
fn another_face_is_refused_unless_the_subject_is_stated_to_be_the_same() {
    let long = with_face(|i, p| if i < 17 { p * 1.6 } else { p * 0.8 });
    let text = Bench::new(&[&|_| {}, &long]).refusal(&options());
    assert!(text.contains("differs from that of take `take0`") && text.contains("report.json"), "{text}");
    let both = |take: &mut common::Take| {
        long(take);
        take.manifest.subject = "S01".into();
    };
    let (report, warnings) = Bench::new(&[&named("S01"), &both]).build(&options());
    assert!(report.is_ok() && warnings.count("world-misfit") == 1);
    let nan = with_face(|_, p| p * f64::NAN);
    assert!(Bench::new(&[&|_| {}, &nan]).build(&options()).0.is_err());
}

#[test]
fn another_number_of_aus_is_refused_unless_the_common_ones_will_do() {
    let fewer = |take: &mut common::Take| {
        take.track.units.truncate(10);
        take.track.rows.iter_mut().for_each(|r| r.intensities.truncate(10));
    };
    let bench = Bench::new(&[&|_| {}, &fewer]);
    let text = bench.refusal(&options());
    assert!(text.contains("take1") && text.contains("(10 AUs here, up to 17 there)"), "{text}");
    let (report, warnings) = bench.build(&BuildOptions { common_aus: true, ..options() });
    assert_eq!((report.unwrap().attributes.len(), warnings.count("missing-au")), (10, 7));
}

#[test]
fn another_au_scale_is_refused() {
    let unit = |take: &mut common::Take| {
        take.track.rows.iter_mut().for_each(|r| r.intensities.iter_mut().flatten().for_each(|v| *v /= 5.0));
    };
    let text = Bench::new(&[&|_| {}, &unit]).refusal(&options());
    assert!(text.contains("take1") && text.contains("two scales"), "{text}");
    // One take alone could be a still face: a word, no refusal.
    let (report, warnings) = Bench::new(&[&unit]).build(&options());
    assert!(report.is_ok() && warnings.count("small-intensities") == 1);
}

#[test]
fn a_take_named_twice_is_refused_and_namesakes_get_a_number() {
    let bench = Bench::new(&[&|_| {}]);
    let twice = [bench.takes[0].clone(), bench.takes[0].join("../take0")];
    let error = build(&twice, &bench.out(), &options(), &Silent).unwrap_err();
    assert!(error.to_string().ends_with("the take is named twice"), "{error}");
    let other = bench.dir.path().join("take-other/take0");
    common::take().write(&other);
    let report = build(&[bench.takes[0].clone(), other], &bench.out(), &options(), &Silent).unwrap();
    assert_eq!([&report.takes[0].name, &report.takes[1].name], ["take0", "take0-2"]);
    assert!(bench.out().join("tables/aus/take_dir=take-take0-2/aus.parquet").is_file());
}

#[test]
fn rows_that_cannot_be_used_are_counted() {
    let spoil = |take: &mut common::Take| {
        take.track.rows[30].intensities[3] = Some(f32::NAN);
        take.track.rows[31].landmarks.as_mut().unwrap().points_px[9][1] = f32::NAN;
        let mut beyond = take.track.rows[5].clone();
        beyond.frame = FrameIndex(500);
        take.track.rows.push(beyond);
    };
    let bench = Bench::new(&[&spoil]);
    let (report, warnings) = bench.build(&options());
    let report = report.unwrap();
    let counts = report.takes[0].counts;
    assert_eq!((counts.incomplete, counts.surplus_rows), (1, 1));
    // Without a landmark there are no outlines, but the AUs are good.
    assert_eq!(report.rejected_masks["no-landmarks"], 1);
    assert_eq!((warnings.count("untrusted-frames"), warnings.count("surplus-rows")), (1, 1));
    let ids = Dataset::read(bench.out()).unwrap().ids;
    assert!(!ids.contains(&"000030".to_owned()) && !ids.contains(&"000031".to_owned()));
    assert!(report.attributes.iter().all(|a| a.au_min.is_finite() && a.au_max.is_finite()));
}

#[test]
fn landmarks_that_are_elsewhere_make_no_masks() {
    let jump = |take: &mut common::Take| {
        for row in &mut take.track.rows[20..25] {
            for p in &mut row.landmarks.as_mut().unwrap().points_px {
                p[0] += 30.0;
            }
        }
    };
    let (report, _) = Bench::new(&[&jump]).build(&options());
    assert_eq!(report.unwrap().rejected_masks["off-face"], 5);
}

#[test]
fn pictures_that_vanished_are_named() {
    let bench = Bench::new(&[&|_| {}]);
    std::fs::remove_file(bench.takes[0].join("images/000089.png")).unwrap();
    let all = BuildOptions { frames: 90, ..options() };
    let text = bench.refusal(&all);
    assert!(text.contains("images"), "{text}");
}

#[test]
fn splits_that_come_first_do_not_leak() {
    for kind in [SplitKind::TimeBlocks, SplitKind::Views, SplitKind::AuCombinations] {
        let bench = Bench::new(&[&|_| {}]);
        let how = BuildOptions { split: kind, val_share: 0.2, guard_secs: 0.1, frames: 50, ..options() };
        let (report, warnings) = bench.build(&how);
        let report = report.unwrap();
        let dataset = Dataset::read(bench.out()).unwrap();
        if warnings.count("empty-split") > 0 {
            // The little capture may have no combination that can be spared; it says so.
            assert!(dataset.val_ids.is_empty());
            continue;
        }
        assert_eq!(dataset.train_ids.len() + dataset.val_ids.len(), dataset.ids.len());
        assert!(!dataset.val_ids.is_empty(), "{kind:?}");
        let [_, least_ms] = report.split.nearest_ms.unwrap();
        match kind {
            SplitKind::TimeBlocks => assert!(least_ms > 100.0, "{least_ms}"),
            SplitKind::Views => assert!(report.split.nearest_view_deg.unwrap()[1] >= 1.0),
            _ => assert_eq!(report.split.known_combinations, Some(0.0)),
        }
        assert!(verify(&bench.out(), &Silent).problems.is_empty());
    }
}

#[test]
fn every_objective_gives_the_asked_number_and_the_same_bytes_again() {
    for sampling in [Sampling::Balanced, Sampling::Entropy, Sampling::Uniform] {
        let how = BuildOptions { sampling, frames: 25, ..options() };
        let reverse = |take: &mut common::Take| take.track.rows.reverse();
        let (a, b) = (Bench::new(&[&|_| {}]), Bench::new(&[&reverse]));
        assert_eq!(a.build(&how).0.unwrap().chosen, 25);
        b.build(&how).0.unwrap();
        same_files(&a.out(), &b.out());
    }
}

fn same_files(a: &Path, b: &Path) {
    let (a, b) = (common::files(a), common::files(b));
    assert_eq!(a.len(), b.len());
    for (x, y) in a.iter().zip(&b) {
        assert_eq!(x.0, y.0);
        assert!(x.1 == y.1, "{} differs", x.0.display());
    }
}

#[test]
fn entropy_is_higher_than_that_of_the_paper_and_of_the_baseline() {
    let entropy = |sampling| {
        let bench = Bench::new(&[&|_| {}]);
        bench.build(&BuildOptions { sampling, frames: 20, ..options() }).0.unwrap().evenness_after.entropy
    };
    let [best, paper, uniform] = [Sampling::Entropy, Sampling::Balanced, Sampling::Uniform].map(entropy);
    assert!(best > paper.max(uniform), "{best} {paper} {uniform}");
}

#[test]
fn the_page_holds_everything_itself() {
    let bench = Bench::new(&[&named("<b>S&amp;</b>")]);
    bench.build(&options()).0.unwrap();
    let page = std::fs::read_to_string(bench.out().join("report/index.html")).unwrap();
    for word in ["http://", "https://", "<script", "src=\"/", "href="] {
        let outside = page.replace("http://www.w3.org/2000/svg", "");
        assert!(!outside.contains(word), "{word}");
    }
    assert!(page.contains("data:image/png;base64,iVBOR") && page.matches("<svg").count() == 4);
    for name in ["distribution", "together", "coverage", "timeline"] {
        for ending in ["svg", "png"] {
            assert!(bench.out().join(format!("report/{name}.{ending}")).metadata().unwrap().len() > 1000);
        }
        image::open(bench.out().join(format!("report/{name}.png"))).unwrap();
    }
    let table = AttributeTable::read(bench.out().join("attributes.toml")).unwrap();
    assert!(!table.attributes[table.index_of(ActionUnit(6)).unwrap()].active);
}
