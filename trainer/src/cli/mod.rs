//! Glue between the command line and the library: what was typed becomes settings, results become text or JSON.

mod curves;
mod devices;
mod eval;
mod export;
mod fit;
mod fit_splat;
mod render;
mod transfer;
mod view;

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::{Parser, Subcommand};
use risorius_console::{Common, CommonArgs, Console, Failure, Inputs};
use risorius_splat::Skips;

use crate::error::TrainerError;

/// A dataset becomes an avatar that renders any expression from any view
#[derive(Debug, Parser)]
#[command(name = "trainer", version, about, max_term_width = 110)]
pub struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    command: Command,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Fit an avatar to a dataset
    Fit(fit::FitArgs),
    /// Render views, an edited expression, an orbit
    Render(render::RenderArgs),
    /// Score renders against true images
    Eval(eval::EvalArgs),
    /// Let a second video's expressions drive the avatar
    Transfer(transfer::TransferArgs),
    /// Write the avatar to send: a page, Gaussians, or glTF with a morph target per AU
    Export(export::ExportArgs),
    /// Turn and steer the avatar in a page on this machine
    View(view::ViewArgs),
    /// List the devices of this build, and which are here
    Devices,
}

/// Runs what was typed.
pub fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    match &cli.command {
        Command::Fit(args) => fit::run(args, console),
        Command::Render(args) => render::run(args, console),
        Command::Eval(args) => eval::run(args, console),
        Command::Transfer(args) => transfer::run(args, console),
        Command::Export(args) => export::run(args, console),
        Command::View(args) => view::run(args, console),
        Command::Devices => {
            devices::run(console);
            Ok(())
        }
    }
}

/// The device and its threads.
#[derive(Clone, Debug, clap::Args)]
struct DeviceArgs {
    /// Where to compute: cpu, or cuda and wgpu where they are built in (see `trainer devices`)
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Worker threads [default: one per core]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
}

impl DeviceArgs {
    /// The device; one that this build lacks is no input's fault.
    fn device(&self) -> Result<Device, Failure> {
        self.find().map_err(|e| Failure::from(e).of_installation())
    }

    fn find(&self) -> Result<Device, TrainerError> {
        if let Some(threads) = self.threads {
            crate::kernel::set_threads(threads);
        }
        crate::devices::open(self.device.as_deref().unwrap_or("cpu"))
    }
}

/// Says so where AUs cannot change anything.
fn warn_if_unsteered(avatar: &crate::Avatar, console: &Console) {
    use risorius_formats::Reporter as _;
    if !avatar.field.is_steered() {
        let message = "this model has no attributes: every picture shows the resting frame's face, whatever the AUs";
        console.warn(risorius_formats::Warning::new("unsteered", message));
    }
}

/// What is to be skipped.
#[derive(Clone, Debug, Default, clap::Args)]
struct SkipArgs {
    /// Do without a skip of the Gaussian field, to measure it; may be repeated
    #[arg(long, value_name = "WHAT", value_parser = clap::builder::PossibleValuesParser::new(Skips::NAMES))]
    no_skip: Vec<String>,
}

impl SkipArgs {
    fn skips(&self) -> Result<Skips, Failure> {
        let mut skips = Skips::default();
        for name in &self.no_skip {
            if !skips.switch_off(name) {
                return Err(Failure::usage(format!("there is no skip `{name}`")));
            }
        }
        Ok(skips)
    }
}

/// Reads `AU12=3.5`.
fn parse_au(text: &str) -> Result<(risorius_formats::ActionUnit, f32), String> {
    let (unit, value) = text.split_once('=').ok_or("write it like `AU12=3.5`")?;
    let unit = unit.trim().parse().map_err(|e: risorius_formats::FormatError| e.to_string())?;
    let value: f32 = value.trim().parse().map_err(|_| format!("`{value}` is not a number"))?;
    if !(0.0..=5.0).contains(&value) {
        return Err(format!("an intensity lies between 0 and 5, found {value}"));
    }
    Ok((unit, value))
}

/// Reads a duration like `90s`, `10m`, `1.5h` or plain seconds.
fn parse_duration(text: &str) -> Result<f64, String> {
    let (number, unit) = text.find(|c: char| c.is_ascii_alphabetic()).map_or((text, "s"), |i| text.split_at(i));
    let factor = match unit {
        "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err(format!("`{unit}` is not a unit of time; write `90s`, `10m` or `1h`")),
    };
    match number.trim().parse::<f64>() {
        Ok(n) if n.is_finite() && n > 0.0 => Ok(n * factor),
        _ => Err(format!("`{text}` is not a duration; write `90s`, `10m` or `1h`")),
    }
}

/// What an avatar is read from.
fn run_inputs(inputs: Inputs, role: &str, run: &Path) -> Inputs {
    let name = |file: &str| if role.is_empty() { file.to_owned() } else { format!("{role}/{file}") };
    ["model.json", "model.safetensors"].iter().fold(inputs, |all, file| all.file(name(file), run.join(file)))
}

/// Reads a size like `2GiB`, `800MiB`, `4GB` or plain bytes.
fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, unit) = text.find(|c: char| c.is_ascii_alphabetic()).map_or((text, "B"), |i| text.split_at(i));
    let factor = match unit.trim() {
        "B" => 1.0,
        "kB" | "KB" => 1e3,
        "MB" => 1e6,
        "GB" => 1e9,
        "KiB" | "K" => 1024.0,
        "MiB" | "M" => 1024.0 * 1024.0,
        "GiB" | "G" => 1024.0 * 1024.0 * 1024.0,
        _ => return Err(format!("`{unit}` is not a unit of memory; write `800MiB` or `2GiB`")),
    };
    match number.trim().parse::<f64>() {
        Ok(n) if n.is_finite() && n > 0.0 => Ok((n * factor) as u64),
        _ => Err(format!("`{text}` is not a size; write `800MiB` or `2GiB`")),
    }
}

fn need(path: &PathBuf, what: &str) -> Result<(), TrainerError> {
    if path.exists() {
        return Ok(());
    }
    Err(risorius_formats::FormatError::new(risorius_formats::ErrorKind::Missing, "does not exist")
        .in_file(path)
        .with_hint(format!("this should be {what}"))
        .into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_and_intensities_read() {
        assert_eq!(parse_duration("90s"), Ok(90.0));
        assert_eq!(parse_duration("1.5m"), Ok(90.0));
        assert_eq!(parse_duration("60"), Ok(60.0));
        for bad in ["", "s", "-1s", "5 days", "nan"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_bytes("2GiB"), Ok(2 << 30));
        assert_eq!(parse_bytes("1.5MB"), Ok(1_500_000));
        for bad in ["", "GiB", "-1GiB", "2 weeks", "nan"] {
            assert!(parse_bytes(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_au("AU12=3.5").unwrap(), (risorius_formats::ActionUnit(12), 3.5));
        for bad in ["AU12", "AU12=6", "AU12=x", "=1", "12=-1"] {
            assert!(parse_au(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }
}
