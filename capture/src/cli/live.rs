//! `capture record --device`.

use std::time::Duration;

use clap::Args;
use risorius_console::{Console, Failure};
use risorius_formats::Reporter as _;
use serde::Serialize;

use super::record::{RecordArgs, Settings};
use crate::controls::{Exposure, Wishes};
use crate::live::{LiveOptions, LiveSummary, Meter, Monitor, Undisturbed, measure_take, record_live, rehearse};
use crate::negotiate::{Request, number};
use crate::preview::Preview;
use crate::script::{Prompt, Script};
use crate::source::{self, PixelFormat};

/// Options of `capture record` for cameras.
#[derive(Args, Debug)]
pub(super) struct LiveArgs {
    /// Picture size; the usual one is 1280x720.
    #[arg(long, value_name = "WxH", conflicts_with = "input", value_parser = parse_size, help_heading = "Camera")]
    size: Option<(u32, u32)>,
    /// What the frames are made of: mjpeg, h264, yuyv, uyvy, nv12, i420, grey, rgb24, bgr24. Without it raw where that
    /// reaches the rate, else compressed.
    #[arg(long, value_name = "NAME", conflicts_with = "input", help_heading = "Camera")]
    format: Option<PixelFormat>,
    /// How long to record, such as 120s or 2min; without it until Ctrl-C, or as long as the script.
    #[arg(long, value_name = "TIME", conflicts_with = "input", value_parser = parse_time, help_heading = "Camera")]
    duration: Option<Duration>,
    /// Prompts for the person in front of the camera: `au` (each action unit, combinations, a slow orbit; 2 min), or a TOML
    /// file of [[step]] tables.
    #[arg(long, value_name = "NAME|FILE", conflicts_with = "input", help_heading = "Camera")]
    script: Option<String>,
    /// `fit` (the camera's choice, but not longer than a frame, then fixed), `auto`, or a time such as 4ms.
    #[arg(long, value_name = "fit|auto|TIME", conflicts_with = "input", default_value = "fit", value_parser = parse_exposure, help_heading = "Camera")]
    exposure: Exposure,
    /// Keep the focus where it is.
    #[arg(long, conflicts_with = "input", help_heading = "Camera")]
    lock_focus: bool,
    /// Keep the white balance as it is.
    #[arg(long, conflicts_with = "input", help_heading = "Camera")]
    lock_white_balance: bool,
    /// Set a control for the recording; can be given several times.
    #[arg(long, value_name = "CONTROL=VALUE", conflicts_with = "input", value_parser = parse_control, help_heading = "Camera")]
    set: Vec<(String, i64)>,
    /// Show the picture, the figures and the prompts on a page of this machine.
    #[arg(long, conflicts_with = "input", help_heading = "Camera")]
    preview: bool,
    /// The page's port [default: a free one].
    #[arg(long, value_name = "PORT", requires = "preview", help_heading = "Camera")]
    preview_port: Option<u16>,
    /// Frames of this time at the start are not recorded.
    #[arg(long, value_name = "TIME", conflicts_with = "input", default_value = "500ms", value_parser = parse_time, help_heading = "Camera")]
    warm_up: Duration,
    /// The driver's buffers, 8 to 64 [default: 32, or 16 for raw frames].
    #[arg(long, value_name = "N", conflicts_with = "input", value_parser = clap::value_parser!(u32).range(8..=64), help_heading = "Camera")]
    buffers: Option<u32>,
    /// What may wait for a slow disk; then frames are dropped, and counted.
    #[arg(long, value_name = "MB", conflicts_with = "input", default_value_t = 48, value_parser = clap::value_parser!(u32).range(1..=65_536), help_heading = "Camera")]
    memory_mb: u32,
    /// Leave sharpness and exposure of the frames out, which are measured after the recording.
    #[arg(long, conflicts_with = "input", help_heading = "Camera")]
    no_measure: bool,
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sides.filter(|&(w, h)| w > 0 && h > 0).ok_or_else(|| "expected WIDTHxHEIGHT, such as 1280x720".to_owned())
}

/// A time of `min`, `s` (which may be left out) or `ms`.
fn parse_time(text: &str) -> Result<Duration, String> {
    let (digits, unit) = match text {
        t if t.ends_with("ms") => (&t[..t.len() - 2], 1e-3),
        t if t.ends_with("min") => (&t[..t.len() - 3], 60.0),
        t if t.ends_with('s') => (&t[..t.len() - 1], 1.0),
        t => (t, 1.0),
    };
    match digits.parse::<f64>() {
        Ok(n) if n.is_finite() && (0.0..=86_400.0).contains(&(n * unit)) => Ok(Duration::from_secs_f64(n * unit)),
        _ => Err("expected a time, such as 120s, 2min or 500ms".to_owned()),
    }
}

fn parse_exposure(text: &str) -> Result<Exposure, String> {
    match text {
        "fit" => Ok(Exposure::Fit),
        "auto" => Ok(Exposure::Auto),
        time => match parse_time(time) {
            Ok(time) if !time.is_zero() => Ok(Exposure::Time(time)),
            _ => Err("expected `fit`, `auto` or a time, such as 4ms".to_owned()),
        },
    }
}

fn parse_control(text: &str) -> Result<(String, i64), String> {
    let parts =
        text.split_once('=').and_then(|(name, value)| Some((name.trim().to_owned(), value.trim().parse().ok()?)));
    parts.filter(|(name, _)| !name.is_empty()).ok_or_else(|| "expected CONTROL=NUMBER, such as gain=40".to_owned())
}

impl Monitor for Console {
    fn meter(&self, m: &Meter) {
        let mut parts = vec![format!("{:.1} frames/s", m.fps), format!("dropped {}", m.lost + m.discarded + m.corrupt)];
        parts.extend(m.sharpness.map(|s| format!("sharpness {s:.0}")));
        parts.extend(m.luma.map(|l| format!("luma {l:.0}")));
        parts.extend(m.clipped.filter(|c| *c > 0.01).map(|c| format!("{:.0} % clipped", 100.0 * c)));
        parts.extend((m.waiting_bytes > 8 << 20).then(|| format!("{} MB wait for the disk", m.waiting_bytes >> 20)));
        parts.extend(m.free_bytes.map(|b| format!("{:.1} GB free", b as f64 / 1e9)));
        self.note(&parts.join(", "));
    }

    fn prompt(&self, prompt: Option<&Prompt>) {
        match prompt {
            Some(p) => self.say(&format!(">> {} ({:.1} s)", p.text, p.secs_left)),
            None => self.say(">> done"),
        }
    }
}

pub(super) fn run(device: &str, args: &RecordArgs, settings: Settings, console: &Console) -> Result<(), Failure> {
    let live = &args.live;
    let script = live.script.as_deref().map(Script::load).transpose()?;
    let by_script = script.as_ref().map(|s| Duration::from_secs_f64(s.secs()));
    let options = LiveOptions {
        request: Request { size: live.size, fps: args.fps, format: live.format },
        duration: live.duration.or(by_script),
        force: args.force,
        subject: args.subject.clone().or(settings.subject).unwrap_or_default(),
        consent: args.consent.clone().or(settings.consent).unwrap_or_default(),
        buffers: live.buffers,
        memory_bytes: (live.memory_mb as usize) << 20,
        warm_up: live.warm_up,
        wishes: Wishes {
            exposure: live.exposure,
            lock_focus: live.lock_focus,
            lock_white_balance: live.lock_white_balance,
            set: live.set.clone(),
        },
        script,
        ..LiveOptions::new(device, &args.out)
    };
    if args.dry_run {
        let choice = rehearse(source::open(device)?.as_mut(), &options)?;
        let document = Rehearsal {
            device,
            format: choice.format.name(),
            width: choice.width,
            height: choice.height,
            fps: choice.rate.fps(),
            duration_secs: options.duration.map(|d| d.as_secs_f64()),
        };
        let length = document.duration_secs.map_or_else(|| "until Ctrl-C".to_owned(), |s| format!("for {s:.1} s"));
        console.finish(&document, &format!("would record {device}: {choice}, {length}, into {}", args.out.display()));
        return Ok(());
    }
    let preview = live.preview.then(|| Preview::serve(live.preview_port.unwrap_or(0))).transpose()?;
    if let Some(preview) = &preview {
        console.say(&format!("preview: {}", preview.url()));
    }
    let source = source::open(device)?;
    let mut summary = record_live(source, &options, preview.as_ref(), console)?;
    if !live.no_measure {
        summary.manifest = measure_take(&summary.take, &Undisturbed(console))?.manifest;
    }
    console.finish(&summary, &text(&summary));
    match summary.failure.take() {
        None => Ok(()),
        Some(e) => {
            let left = format!("{} holds the {:.1} s before", summary.take.display(), summary.duration_secs);
            let failure = Failure::from(e);
            let hint = failure.hint().map_or_else(|| left.clone(), |hint| format!("{left}; {hint}"));
            Err(failure.with_hint(hint))
        }
    }
}

/// What `--dry-run` says.
#[derive(Serialize)]
struct Rehearsal<'a> {
    device: &'a str,
    format: &'a str,
    width: u32,
    height: u32,
    fps: f64,
    duration_secs: Option<f64>,
}

fn text(s: &LiveSummary) -> String {
    let m = &s.manifest;
    let mut lines = vec![format!(
        "{}: {} frames, {}×{} {}, {} frames/s, {:.1} s",
        s.take.display(),
        m.frame_count,
        m.width,
        m.height,
        s.format,
        number(m.fps_measured),
        s.duration_secs
    )];
    lines.push(format!(
        "dropped {} (by the driver {}, for the disk {}, broken {})",
        s.lost_by_driver + s.discarded + s.corrupt,
        s.lost_by_driver,
        s.discarded,
        s.corrupt
    ));
    if let Some(jitter) = s.jitter_ms {
        lines.push(format!(
            "jitter {jitter:.2} ms, at most {:.1} MB waited for the disk",
            s.waiting_peak_bytes as f64 / 1e6
        ));
    }
    if s.marks > 0 {
        lines.push(format!("{} marks of the script in marks.csv", s.marks));
    }
    lines.push(format!("next: capture check {}", s.take.display()));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_sizes_exposures_and_controls_are_read() {
        assert_eq!(parse_time("2min").unwrap().as_secs(), 120);
        assert_eq!((parse_time("1.5").unwrap().as_millis(), parse_time("500ms").unwrap().as_millis()), (1500, 500));
        for wrong in ["", "s", "-1s", "1h", "inf", "1e9s"] {
            assert!(parse_time(wrong).is_err(), "{wrong}");
        }
        assert_eq!(parse_exposure("4ms").unwrap(), Exposure::Time(Duration::from_millis(4)));
        assert!(parse_exposure("0ms").is_err() && parse_exposure("short").is_err());
        assert_eq!(parse_control("white balance = 4600").unwrap(), ("white balance".to_owned(), 4600));
        assert!(parse_control("gain").is_err() && parse_control("=3").is_err() && parse_size("0x3").is_err());
    }
}
