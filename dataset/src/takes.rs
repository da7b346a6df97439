//! Whether takes belong together: one person, one picture size, one AU scale, one set of AUs, one world.

use risorius_formats::similarity::umeyama;
use risorius_formats::{ActionUnit, ErrorKind, FormatError, Reporter, Similarity, Warning};

use crate::align::TakeInput;
use crate::error::{DatasetError, Result};
use crate::options::BuildOptions;
use crate::{scale, signals};

/// Above this remainder, in head radii, the faces of two takes do not agree.
const MAX_WORLD_MISFIT: f64 = 0.1;
/// A table whose intensities never exceed this is on a 0–1 scale, or of a face that never moves.
const UNIT_SCALE: f32 = 1.0;
/// A table whose intensities exceed this is on the 0–5 scale.
const FULL_SCALE: f32 = 2.0;

/// The trimmed size, which all takes must share.
pub(crate) fn common_size(inputs: &[TakeInput]) -> Result<(u32, u32)> {
    let size = |i: &TakeInput| (i.take.manifest.width, i.take.manifest.height);
    let expected = size(&inputs[0]);
    if let Some(other) = inputs.iter().find(|i| size(i) != expected) {
        return Err(DatasetError::Size {
            path: other.take.dir.clone(),
            what: "the first take has",
            expected,
            found: size(other),
        });
    }
    scale::trimmed_size(expected.0, expected.1).ok_or_else(|| DatasetError::Option {
        message: format!("{} × {} pixels are too few", expected.0, expected.1),
        hint: "both sides need at least 8 pixels".to_owned(),
    })
}

/// Fails when two takes state different subjects, and warns when only some state one.
pub(crate) fn one_subject(inputs: &[TakeInput], options: &BuildOptions, reporter: &dyn Reporter) -> Result<()> {
    let stated: Vec<&TakeInput> = inputs.iter().filter(|i| !i.take.manifest.subject.trim().is_empty()).collect();
    let subject = |i: &TakeInput| i.take.manifest.subject.trim().to_lowercase();
    let Some(first) = stated.first() else { return Ok(()) };
    if let Some(other) = stated.iter().find(|i| subject(i) != subject(first)) {
        let message = format!(
            "shows `{}`, but take `{}` shows `{}`",
            other.take.manifest.subject.trim(),
            first.name,
            first.take.manifest.subject.trim()
        );
        if !options.same_subject {
            return Err(FormatError::new(ErrorKind::Inconsistent, message)
                .in_file(other.take.dir.join("take.toml"))
                .with_hint("build a dataset per person; `--same-subject` if these are two names of one person")
                .into());
        }
        reporter.warn(Warning::new("two-subjects", format!("take `{}` {message}: taken for one person", other.name)));
    } else if stated.len() < inputs.len() {
        let without = inputs.len() - stated.len();
        let message = format!("{without} of {} takes do not say whom they show: taken for one person", inputs.len());
        reporter.warn(Warning::new("unknown-subject", message));
    }
    Ok(())
}

/// For each take the way into the first one's world, by the triangulated face.
pub(crate) fn common_world(
    inputs: &[TakeInput],
    options: &BuildOptions,
    reporter: &dyn Reporter,
) -> Result<Vec<Similarity>> {
    let mut worlds = vec![Similarity::IDENTITY];
    let first = &inputs[0];
    for input in &inputs[1..] {
        let (faces, own) = (&first.report.landmarks_in_world, &input.report.landmarks_in_world);
        let pairs: Vec<_> = faces.iter().copied().zip(own.iter().copied()).collect();
        let fit = umeyama(&pairs, true).filter(|fit| faces.len() == own.len() && !fit.on_a_line);
        let path = input.take.pose_report_path();
        let fit = fit.ok_or_else(|| DatasetError::Option {
            message: format!("{}: has no face in common with the first take", path.display()),
            hint: "find the poses of all takes anew with `tracker poses TAKE`".to_owned(),
        })?;
        let misfit = fit.rms / first.report.head_radius.max(f64::MIN_POSITIVE);
        if misfit.is_nan() || misfit > MAX_WORLD_MISFIT {
            let message = format!(
                "the face of take `{}` differs from that of take `{}` by {:.0} % of a head radius",
                input.name,
                first.name,
                100.0 * misfit
            );
            let named = |i: &TakeInput| i.take.manifest.subject.trim().to_lowercase();
            let same = !named(input).is_empty() && named(input) == named(first);
            if !same && !options.same_subject {
                return Err(FormatError::new(ErrorKind::Inconsistent, message)
                    .in_file(path)
                    .with_hint("another person, or bad poses; `--same-subject` if it is the same person")
                    .into());
            }
            reporter.warn(Warning::new("world-misfit", message));
        }
        worlds.push(fit.a_from_b);
    }
    Ok(worlds)
}

/// The units of the table that every track has. AUs that only some takes have are refused unless asked otherwise.
pub(crate) fn common_units(
    inputs: &[TakeInput],
    options: &BuildOptions,
    reporter: &dyn Reporter,
) -> Result<Vec<ActionUnit>> {
    let wanted = options.regions.units();
    let present: Vec<Vec<ActionUnit>> = inputs.iter().map(|i| signals::present_units(&i.track, &wanted)).collect();
    let units: Vec<ActionUnit> = wanted.iter().copied().filter(|u| present.iter().all(|own| own.contains(u))).collect();
    for missing in wanted.iter().filter(|u| !units.contains(u)) {
        let lacks = present.iter().position(|own| !own.contains(missing)).unwrap_or(0);
        let some_have = present.iter().any(|own| own.contains(missing));
        if some_have && !options.common_aus {
            let (own, other) = (present[lacks].len(), present.iter().map(Vec::len).max().unwrap_or(0));
            let message = format!("has no {missing}, which other takes have ({own} AUs here, up to {other} there)");
            return Err(FormatError::new(ErrorKind::Inconsistent, message)
                .in_file(inputs[lacks].take.openface_path())
                .with_hint("track all takes with one tool; `--common-aus` leaves out AUs that some takes lack")
                .into());
        }
        reporter.warn(Warning::new(
            "missing-au",
            format!("{missing} ({}) is not in every track and is left out", missing.facs_name()),
        ));
    }
    if units.is_empty() {
        return Err(DatasetError::Option {
            message: format!("{}: has none of the AUs of the regions", inputs[0].take.openface_path().display()),
            hint: "the table needs columns such as `AU12_r`".to_owned(),
        });
    }
    Ok(units)
}

/// Fails when one take's intensities look like 0–1 and another's like 0–5; warns when all look like 0–1.
pub(crate) fn common_scale(inputs: &[TakeInput], units: &[ActionUnit], reporter: &dyn Reporter) -> Result<()> {
    let largest = |input: &TakeInput| {
        let columns: Vec<usize> = units.iter().filter_map(|&u| input.track.unit_index(u)).collect();
        let rows = input.track.rows.iter().filter(|r| r.success);
        let values = rows.flat_map(|r| columns.iter().filter_map(|&c| r.intensities.get(c).copied().flatten()));
        values.filter(|v| v.is_finite()).fold(0.0f32, f32::max)
    };
    let largest: Vec<f32> = inputs.iter().map(largest).collect();
    let Some(small) = largest.iter().position(|&v| v > 0.0 && v <= UNIT_SCALE) else { return Ok(()) };
    let path = inputs[small].take.openface_path();
    if let Some(full) = largest.iter().position(|&v| v > FULL_SCALE) {
        let message = format!(
            "its AUs reach {:.2}, those of take `{}` {:.2}: two scales",
            largest[small], inputs[full].name, largest[full]
        );
        return Err(FormatError::new(ErrorKind::Inconsistent, message)
            .in_file(path)
            .with_hint("AU intensities are 0–5: import a 0–1 table with `tracker import TAKE --openface FILE.csv --au-scale 1`")
            .into());
    }
    let message = format!(
        "take `{}`: no AU exceeds {:.2} of 5; a 0–1 table is imported with `tracker import TAKE --openface FILE.csv --au-scale 1`",
        inputs[small].name, largest[small]
    );
    reporter.warn(Warning::new("small-intensities", message));
    Ok(())
}
