//! The commands that are measured.

use std::path::{Path, PathBuf};

use risorius_bench::child::{self, Run};
use risorius_console::{Console, Failure};
use risorius_formats::FormatError;
use risorius_trainer::eval::lpips::default_dir;
use serde_json::Value;

use crate::captures::World;
use crate::score::{self, number};
use crate::{Cli, Row, counted};

/// What a capture is like, and how much is asked of it.
pub(crate) struct Sizes {
    /// Pictures, `WxH`.
    pub(crate) size: &'static str,
    /// Frames of the shorter and the longer capture.
    pub(crate) frames: [u32; 2],
    /// Frames of the smaller and the larger dataset.
    pub(crate) chosen: [u32; 2],
    /// Lengths of fits.
    steps: &'static [u64],
    /// Steps of the fits whose other settings are varied.
    varied_steps: u64,
    /// Numbers of Gaussians that are tried, besides the default.
    gaussians: &'static [u32],
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
    gaussians: &[2_000, 8_000],
    confies: &[20, 40],
    orbit: 12,
};

const WHOLE: Sizes = Sizes {
    size: "270x480",
    frames: [120, 360],
    chosen: [100, 200],
    steps: &[125, 250, 500, 1000, 2000, 4000],
    varied_steps: 500,
    gaussians: &[20_000, 50_000, 110_000],
    confies: &[100, 200, 400],
    orbit: 60,
};

/// AUs that are kept where their number is varied, most first seen.
const FEWER_AUS: [usize; 2] = [4, 8];

/// Measures one case after the other.
pub(crate) struct Bench<'a> {
    pub(crate) rows: Vec<Row>,
    cli: &'a Cli,
    pub(crate) work: &'a Path,
    unit_cpu_secs: f64,
    pub(crate) sizes: Sizes,
    pub(crate) console: &'a Console,
}

impl<'a> Bench<'a> {
    pub(crate) fn new(cli: &'a Cli, work: &'a Path, unit_cpu_secs: f64, console: &'a Console) -> Result<Self, Failure> {
        for entry in std::fs::read_dir(work).into_iter().flatten().flatten() {
            // Only what this program made: a mistyped path must cost nobody anything.
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with("made-") {
                std::fs::remove_dir_all(entry.path()).map_err(|e| FormatError::io(entry.path(), "remove", &e))?;
            }
        }
        let sizes = if cli.quick { QUICK } else { WHOLE };
        Ok(Self { rows: Vec::new(), cli, work, unit_cpu_secs, sizes, console })
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

    pub(crate) fn made(&self, name: &str) -> PathBuf {
        self.work.join(format!("made-{name}"))
    }

    /// Runs a command and keeps its row if its stage is asked for.
    pub(crate) fn measure(
        &mut self,
        name: &str,
        program: &str,
        args: &[&str],
        grows: &[(&str, f64)],
    ) -> Result<Run, Failure> {
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

    fn track(&mut self, small: &World, world: &World) -> Result<(), Failure> {
        if !self.asked_for("track") {
            return Ok(());
        }
        if !default_dir().join("models.toml").is_file() {
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
        if let (Some(row), Some(steps)) = (self.rows.last_mut(), number(&run.document, &["steps"])) {
            row.grows_with.push(("steps".to_owned(), steps));
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
        for gaussians in self.sizes.gaussians {
            let set = format!("splat.gaussians={gaussians}");
            let more = ["--steps", &steps, "--set", &set];
            let grows = [("Gaussians", f64::from(*gaussians))];
            self.fit(&format!("fit/gaussians-{gaussians}"), dataset, &more, views, &grows)?;
        }
        for count in FEWER_AUS {
            let dataset = self.with_fewer_aus(world, count)?;
            self.fit(&format!("fit/aus-{count}"), &dataset, &length, views, &[("AUs", count as f64)])?;
        }
        // The middle of all these lines.
        let grows = [("pixels", pixels / 4.0), ("frames", f64::from(many)), ("Gaussians", 80_000.0), ("AUs", all)];
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

    fn renders(&mut self, run: &str, views: &str) -> Result<(), Failure> {
        if !self.asked_for("render") {
            return Ok(());
        }
        for count in [self.sizes.orbit, 4 * self.sizes.orbit] {
            let out = text(&self.made(&format!("render-{count}")));
            let count_text = count.to_string();
            let grows = [("pictures", f64::from(count))];
            let args = ["render", run, "--orbit", &count_text, "--out", &out];
            self.measure(&format!("render/orbit-{count}"), "trainer", &args, &grows)?;
        }
        let judged = text(&self.made("render-judged"));
        let args = ["eval", run, "--views", views, "--lpips", "none", "--out", &judged];
        let eval = child::run("trainer", &args, self.work)?;
        self.error("PSNR, dB", number(&eval.document, &["mean_psnr_db"]));
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
                // Checkpoints by steps: those by time come more often where instructions are counted.
                vec![
                    "fit",
                    &dataset,
                    "--out",
                    &run,
                    "--steps",
                    "6",
                    "--set",
                    "splat.gaussians=2000",
                    "--checkpoint-every",
                    "100",
                    "--threads",
                    "1",
                ],
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

pub(crate) fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_found_by_a_part_of_their_name() {
        let document = serde_json::json!({"a": {"b": 1, "rotation_deg": 0.25}});
        assert_eq!(find(&document, "rotation"), Some(0.25));
        assert_eq!(find(&document, "focal"), None);
    }
}
