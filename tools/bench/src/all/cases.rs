//! The commands that are measured, and the captures they are given.

use std::path::{Path, PathBuf};

use risorius_bench::child::{self, Run};
use risorius_brick::floor::Floor;
use risorius_console::{Console, Failure};
use risorius_formats::{FormatError, atomic};
use serde_json::Value;

use crate::score::{self, number};
use crate::{Cli, Row, counted};

/// What a capture is like, and how much is asked of it.
struct Sizes {
    /// Pictures, `WxH`.
    size: &'static str,
    /// Frames of the shorter and the longer capture.
    frames: [u32; 2],
    /// Frames of the smaller and the larger dataset.
    chosen: [u32; 2],
    /// Lengths of fits.
    steps: &'static [u64],
    /// Steps of the fits whose other settings are varied.
    varied_steps: u64,
    /// Samples per step that are tried.
    samples: &'static [u32],
    /// Steps of fits of the paper's networks.
    confies: &'static [u64],
    /// Pictures of an orbit.
    orbit: u32,
}

const QUICK: Sizes = Sizes {
    size: "96x160",
    frames: [40, 200],
    chosen: [30, 60],
    steps: &[50, 100, 200, 400],
    varied_steps: 100,
    samples: &[4_000, 16_000],
    confies: &[20, 40],
    orbit: 12,
};

const WHOLE: Sizes = Sizes {
    size: "270x480",
    frames: [120, 360],
    chosen: [100, 200],
    steps: &[125, 250, 500, 1000, 2000, 4000],
    varied_steps: 500,
    samples: &[8_000, 16_000, 32_000],
    confies: &[100, 200, 400],
    orbit: 60,
};

/// AUs that are kept where their number is varied, most first seen.
const FEWER_AUS: [usize; 2] = [4, 8];

/// Measures one case after the other.
pub(crate) struct Bench<'a> {
    pub(crate) rows: Vec<Row>,
    cli: &'a Cli,
    work: &'a Path,
    unit_cpu_secs: f64,
    fit_floor: f64,
    sizes: Sizes,
    console: &'a Console,
}

/// A capture with its take.
struct World {
    capture: PathBuf,
    take: String,
    frames: u32,
}

impl<'a> Bench<'a> {
    pub(crate) fn new(
        cli: &'a Cli,
        work: &'a Path,
        unit_cpu_secs: f64,
        floor: &Floor,
        console: &'a Console,
    ) -> Result<Self, Failure> {
        for entry in std::fs::read_dir(work).into_iter().flatten().flatten() {
            // Only what this program made: a mistyped path must cost nobody anything.
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with("made-") {
                std::fs::remove_dir_all(entry.path()).map_err(|e| FormatError::io(entry.path(), "remove", &e))?;
            }
        }
        let sizes = if cli.quick { QUICK } else { WHOLE };
        Ok(Self { rows: Vec::new(), cli, work, unit_cpu_secs, fit_floor: floor.fit_samples_per_sec(), sizes, console })
    }

    pub(crate) fn run_all(&mut self) -> Result<(), Failure> {
        let [few, many] = self.sizes.frames;
        let small = self.world("short", few)?;
        let world = match &self.cli.capture {
            Some(capture) => self.take("long", capture.clone(), None)?,
            None => self.world("long", many)?,
        };
        self.track(&small, &world)?;
        self.poses(&world)?;
        let dataset = self.datasets(&world)?;
        let views = text(&world.capture.join("test/views.json"));
        let run = self.fits(&world, &dataset, &views)?;
        self.renders(&run, &views)?;
        if self.cli.instructions {
            self.count(&small)?;
        }
        Ok(())
    }

    fn made(&self, name: &str) -> PathBuf {
        self.work.join(format!("made-{name}"))
    }

    /// Runs a command and keeps its row if its stage is asked for.
    fn measure(&mut self, name: &str, program: &str, args: &[&str], grows: &[(&str, f64)]) -> Result<Run, Failure> {
        let line = format!("{program} {}", args.join(" ")).replace(&format!("{}/", text(self.work)), "");
        self.console.say(&line);
        let run = child::run(program, args, self.work)?;
        self.rows.push(Row {
            name: name.to_owned(),
            command: line,
            grows_with: grows.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect(),
            wall_secs: run.wall_secs,
            cpu_secs: run.cpu_secs,
            cost: run.cpu_secs / self.unit_cpu_secs,
            peak_mib: run.peak_mib,
            ..Row::default()
        });
        Ok(run)
    }

    /// Tells how far the last row's result is from the truth.
    fn error(&mut self, what: &str, value: Option<f64>) {
        if let (Some(row), Some(value)) = (self.rows.last_mut(), value) {
            row.error = Some((what.to_owned(), value));
        }
    }

    fn asked_for(&self, stage: &str) -> bool {
        self.cli.only.as_ref().is_none_or(|word| stage.contains(word.as_str()))
    }

    /// Makes a capture and its take.
    fn world(&mut self, name: &str, frames: u32) -> Result<World, Failure> {
        let capture = self.made(&format!("capture-{name}"));
        let out = text(&capture);
        let frames_text = frames.to_string();
        let args =
            ["--out", &out, "--frames", &frames_text, "--fps", "30", "--size", self.sizes.size, "--noise", "off"];
        self.console.say(&format!("a capture of {frames} frames"));
        child::run("synth", &args, self.work)?;
        self.take(name, capture, Some(frames))
    }

    fn take(&mut self, name: &str, capture: PathBuf, frames: Option<u32>) -> Result<World, Failure> {
        let take = text(&self.made(&format!("take-{name}")));
        let video = text(&capture.join("video.mp4"));
        let args = ["record", "--input", &video, "--out", &take];
        let grows: Vec<(&str, f64)> = frames.iter().map(|&n| ("frames", f64::from(n))).collect();
        let run = self.measure(&format!("take/{name}"), "capture", &args, &grows)?;
        let counted = ["frame_count", "frames"].iter().find_map(|key| number(&run.document, &[key]));
        let frames = frames.or_else(|| counted.map(|n| n as u32)).unwrap_or(0);
        let table = text(&capture.join("openface.csv"));
        self.measure(
            &format!("import/{name}"),
            "tracker",
            &["import", &take, "--openface", &table],
            &[("frames", f64::from(frames))],
        )?;
        let model = text(&capture.join("truth_colmap"));
        let args = ["poses", &take, "--colmap-model", &model];
        self.measure(&format!("poses/model-{name}"), "tracker", &args, &[("frames", f64::from(frames))])?;
        Ok(World { capture, take, frames })
    }

    fn track(&mut self, small: &World, world: &World) -> Result<(), Failure> {
        if !self.asked_for("track") {
            return Ok(());
        }
        if !models().join("models.toml").is_file() {
            self.console.say("SKIPPED: `tracker run`, whose networks are not there; `tools/models` fetches them");
            return Ok(());
        }
        for (world, name) in [(small, "short"), (world, "long")] {
            for every in ["1", "4"] {
                // A take of its own: the poses of the other one rest on its table.
                let take = text(&self.made(&format!("tracked-{name}-{every}")));
                let video = text(&world.capture.join("video.mp4"));
                child::run("capture", &["record", "--input", &video, "--out", &take], self.work)?;
                let args = ["run", &take, "--every", every, "--threads", "2"];
                self.measure(
                    &format!("track/{name}-every-{every}"),
                    "tracker",
                    &args,
                    &[("frames", f64::from(world.frames))],
                )?;
                let found = Path::new(&take).join("track/openface.csv");
                let percent = score::landmarks_percent(&found, &world.capture.join("openface.csv"))?;
                self.error("landmarks, % of the eyes' distance", percent);
            }
        }
        Ok(())
    }

    fn poses(&mut self, world: &World) -> Result<(), Failure> {
        if !self.cli.colmap || !self.asked_for("poses") {
            return Ok(());
        }
        let take = text(&self.made("take-colmap"));
        let [video, table, truth] = ["video.mp4", "openface.csv", "truth_colmap"].map(|n| text(&world.capture.join(n)));
        child::run("capture", &["record", "--input", &video, "--out", &take], self.work)?;
        child::run("tracker", &["import", &take, "--openface", &table], self.work)?;
        let counts: &[&str] = if self.cli.quick { &["24"] } else { &["20", "40", "80"] };
        for keyframes in counts {
            let args = ["poses", &take, "--method", "colmap", "--keyframes", keyframes];
            self.measure(
                &format!("poses/colmap-{keyframes}"),
                "tracker",
                &args,
                &[("key frames", keyframes.parse().unwrap_or(0.0))],
            )?;
            let check = child::run("tracker", &["check", &take, "--reference", &truth], self.work)?;
            self.error("rotation, degrees", find(&check.document, "rotation"));
        }
        Ok(())
    }

    fn datasets(&mut self, world: &World) -> Result<String, Failure> {
        let [few, many] = self.sizes.chosen;
        let pixels = pixels(self.sizes.size);
        let mut last = String::new();
        for (frames, scale) in [(few, 2), (many, 4), (many, 1), (many, 2)] {
            last = text(&self.made(&format!("dataset-{frames}-{scale}")));
            let (frames_text, scale_text) = (frames.to_string(), scale.to_string());
            let args = ["build", &world.take, "--frames", &frames_text, "--scale", &scale_text, "--out", &last];
            let grows = [
                ("frames", if scale == 2 { f64::from(frames) } else { f64::NAN }),
                ("pixels", if frames == many { pixels / f64::from(scale * scale) } else { f64::NAN }),
            ];
            let grows: Vec<(&str, f64)> = grows.into_iter().filter(|(_, v)| v.is_finite()).collect();
            self.measure(&format!("dataset/frames-{frames}-scale-{scale}"), "dataset", &args, &grows)?;
        }
        Ok(last)
    }

    fn fit(
        &mut self,
        name: &str,
        dataset: &str,
        more: &[&str],
        views: &str,
        grows: &[(&str, f64)],
    ) -> Result<String, Failure> {
        let out = text(&self.made(&name.replace('/', "-")));
        let args = [&["fit", dataset, "--out", &out][..], more].concat();
        let run = self.measure(name, "trainer", &args, grows)?;
        let rate = number(&run.document, &["samples_per_sec"]);
        let brick = name.starts_with("fit/");
        if let (Some(row), Some(rate)) = (self.rows.last_mut(), rate) {
            row.floor_share = brick.then_some(rate / self.fit_floor);
            let samples = rate * number(&run.document, &["seconds"]).unwrap_or(0.0);
            row.grows_with.push(("samples".to_owned(), samples.round()));
        }
        let judged = format!("{out}-judged");
        let args = ["eval", &out, "--views", views, "--lpips", "none", "--out", &judged];
        let eval = child::run("trainer", &args, self.work)?;
        self.error("PSNR, dB", number(&eval.document, &["mean_psnr_db"]));
        Ok(out)
    }

    fn fits(&mut self, world: &World, dataset: &str, views: &str) -> Result<String, Failure> {
        let pixels = pixels(self.sizes.size);
        let [few, many] = self.sizes.chosen;
        let mut last = String::new();
        for steps in self.sizes.steps {
            let text = steps.to_string();
            last = self.fit(&format!("fit/steps-{steps}"), dataset, &["--steps", &text], views, &[])?;
        }
        if !self.asked_for("fit") {
            return Ok(last);
        }
        let steps = self.sizes.varied_steps.to_string();
        let length = ["--steps", &steps];
        let all = 17.0;
        for scale in [1, 4] {
            let dataset = text(&self.made(&format!("dataset-{many}-{scale}")));
            let grows = [("pixels", pixels / f64::from(scale * scale))];
            self.fit(&format!("fit/scale-{scale}"), &dataset, &length, views, &grows)?;
        }
        let smaller = text(&self.made(&format!("dataset-{few}-2")));
        self.fit(&format!("fit/frames-{few}"), &smaller, &length, views, &[("frames", f64::from(few))])?;
        for samples in self.sizes.samples {
            let set = format!("step.samples={samples}");
            let more = ["--steps", &steps, "--set", &set];
            let grows = [("samples a step", f64::from(*samples))];
            self.fit(&format!("fit/samples-{samples}"), dataset, &more, views, &grows)?;
        }
        for count in FEWER_AUS {
            let dataset = self.with_fewer_aus(world, count)?;
            self.fit(&format!("fit/aus-{count}"), &dataset, &length, views, &[("AUs", count as f64)])?;
        }
        // The middle of all these lines.
        let grows = [("pixels", pixels / 4.0), ("frames", f64::from(many)), ("samples a step", 64_000.0), ("AUs", all)];
        self.fit("fit/middle", dataset, &length, views, &grows)?;
        let small = text(&self.made(&format!("dataset-{many}-4")));
        for steps in self.sizes.confies {
            let text = steps.to_string();
            let preset = if self.cli.quick { "tiny" } else { "cpu" };
            let more = ["--field", "confies", "--preset", preset, "--steps", &text];
            self.fit(&format!("confies/steps-{steps}"), &small, &more, views, &[])?;
        }
        Ok(last)
    }

    /// A dataset of a take whose table knows fewer AUs.
    fn with_fewer_aus(&mut self, world: &World, count: usize) -> Result<String, Failure> {
        let take = text(&self.made(&format!("take-aus-{count}")));
        let [video, model] = ["video.mp4", "truth_colmap"].map(|n| text(&world.capture.join(n)));
        child::run("capture", &["record", "--input", &video, "--out", &take], self.work)?;
        let table = self.work.join("fewer.csv");
        let source = world.capture.join("openface.csv");
        let all = std::fs::read_to_string(&source).map_err(|e| FormatError::io(&source, "read", &e))?;
        atomic::write_file(&table, fewer_aus(&all, count).as_bytes())?;
        child::run("tracker", &["import", &take, "--openface", &text(&table)], self.work)?;
        child::run("tracker", &["poses", &take, "--colmap-model", &model], self.work)?;
        let out = text(&self.made(&format!("dataset-aus-{count}")));
        let frames = self.sizes.chosen[1].to_string();
        child::run("dataset", &["build", &take, "--frames", &frames, "--scale", "2", "--out", &out], self.work)?;
        Ok(out)
    }

    fn renders(&mut self, run: &str, views: &str) -> Result<(), Failure> {
        if !self.asked_for("render") {
            return Ok(());
        }
        for (name, more) in [("direct", &[][..]), ("baked", &["--baked"][..])] {
            for count in [self.sizes.orbit, 4 * self.sizes.orbit] {
                let out = text(&self.made(&format!("render-{name}-{count}")));
                let count_text = count.to_string();
                let args = [&["render", run, "--orbit", &count_text, "--out", &out][..], more].concat();
                let grows = [("pictures", f64::from(count))];
                self.measure(&format!("render/{name}-{count}"), "trainer", &args, &grows)?;
            }
            let judged = text(&self.made(&format!("render-{name}-judged")));
            let args = [&["eval", run, "--views", views, "--lpips", "none", "--out", &judged][..], more].concat();
            let eval = child::run("trainer", &args, self.work)?;
            self.error("PSNR, dB", number(&eval.document, &["mean_psnr_db"]));
        }
        Ok(())
    }

    /// Instructions of short commands, one of each stage.
    fn count(&mut self, small: &World) -> Result<(), Failure> {
        let [table, model] = ["openface.csv", "truth_colmap"].map(|n| text(&small.capture.join(n)));
        let (dataset, run, picture) =
            (text(&self.made("counted-dataset")), text(&self.made("counted-run")), text(&self.made("counted-picture")));
        let commands: [(&str, &str, Vec<&str>); 5] = [
            ("import", "tracker", vec!["import", &small.take, "--openface", &table]),
            ("poses", "tracker", vec!["poses", &small.take, "--colmap-model", &model]),
            ("dataset", "dataset", vec!["build", &small.take, "--frames", "20", "--scale", "4", "--out", &dataset]),
            (
                "fit",
                "trainer",
                vec!["fit", &dataset, "--out", &run, "--steps", "6", "--set", "step.samples=4000", "--threads", "1"],
            ),
            ("render", "trainer", vec!["render", &run, "--out", &picture, "--threads", "1"]),
        ];
        for (stage, program, args) in commands {
            let counts = counted::instructions(program, &args, self.work)?;
            if counts.is_none() {
                self.console.say("SKIPPED: instructions, since there is no valgrind here");
                return Ok(());
            }
            self.measure(&format!("counted/{stage}"), program, &again(&args), &[])?;
            if let Some(row) = self.rows.last_mut() {
                row.instructions = counts;
            }
        }
        Ok(())
    }
}

/// The command once more, where its result is there already.
fn again<'a>(args: &[&'a str]) -> Vec<&'a str> {
    let force: &[&str] = if args[0] == "fit" { &["--force"] } else { &[] };
    [args, force].concat()
}

/// The table with its first `count` AUs only.
fn fewer_aus(table: &str, count: usize) -> String {
    let header: Vec<&str> = table.lines().next().unwrap_or_default().split(',').collect();
    let intensities: Vec<&str> =
        header.iter().map(|c| c.trim()).filter(|c| c.starts_with("AU") && c.ends_with("_r")).collect();
    // Evenly over them, so that every region keeps some.
    let kept: Vec<&str> =
        (0..count).filter_map(|i| Some(&intensities.get(i * intensities.len() / count)?[..4])).collect();
    let keeps = |name: &str| !name.starts_with("AU") || kept.iter().any(|au| name.starts_with(au));
    let columns: Vec<usize> = (0..header.len()).filter(|&i| keeps(header[i].trim())).collect();
    let line = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        columns.iter().filter_map(|&i| cells.get(i).copied()).collect::<Vec<_>>().join(",") + "\n"
    };
    table.lines().map(line).collect()
}

/// A number somewhere in a document whose name holds `word`.
fn find(document: &Value, word: &str) -> Option<f64> {
    let map = document.as_object()?;
    map.iter().find_map(|(key, value)| match value.as_f64() {
        Some(number) if key.contains(word) => Some(number),
        _ => find(value, word),
    })
}

fn pixels(size: &str) -> f64 {
    size.split('x').filter_map(|n| n.parse::<f64>().ok()).product()
}

/// Where the networks of `tracker run` are looked for.
fn models() -> PathBuf {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let cache = || set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|home| home.join(".cache")));
    set("RISORIUS_MODELS").unwrap_or_else(|| cache().unwrap_or_default().join("risorius/models"))
}

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_aus_leave_all_other_columns() {
        let table = "frame, AU01_r, AU02_r, AU04_r, AU12_r, AU01_c, AU04_c, AU45_c\n1, 0.1, 0.2, 0.4, 1.2, 1, 0, 1\n";
        assert_eq!(fewer_aus(table, 2), "frame, AU01_r, AU04_r, AU01_c, AU04_c\n1, 0.1, 0.4, 1, 0\n");
        assert_eq!(fewer_aus(table, 4).lines().count(), 2);
    }

    #[test]
    fn numbers_are_found_by_a_part_of_their_name() {
        let document = serde_json::json!({"a": {"b": 1, "rotation_deg": 0.25}});
        assert_eq!(find(&document, "rotation"), Some(0.25));
        assert_eq!(find(&document, "focal"), None);
    }
}
