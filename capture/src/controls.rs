//! A camera's exposure, focus and white balance: fixed for a recording, and put back afterwards.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::source::{Control, FrameSource, Role};
use crate::{CaptureError, Result};

/// Of the time between frames the sensor needs a part to read out.
const EXPOSED_SHARE: f64 = 0.9;
/// The unit of an exposure time, seconds.
const EXPOSURE_UNIT_SECS: f64 = 1e-4;
/// `V4L2_EXPOSURE_MANUAL`.
const MANUAL: i64 = 1;

/// How the exposure is set.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Exposure {
    /// The camera's own choice, but not longer than a frame takes, and constant from then on.
    #[default]
    Fit,
    /// The camera goes on choosing; the rate is kept if it can be told to.
    Auto,
    /// This long.
    Time(Duration),
}

/// What is wanted of a camera's controls.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Wishes {
    /// How the exposure is set.
    pub exposure: Exposure,
    /// Keep the focus where it is.
    pub lock_focus: bool,
    /// Keep the white balance as it is.
    pub lock_white_balance: bool,
    /// Controls by their names, or a part of them that only one has.
    pub set: Vec<(String, i64)>,
}

/// A control that was changed, with its value before.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Changed {
    /// The backend's number of it.
    pub id: u32,
    /// The driver's name of it.
    pub name: String,
    /// Before the recording.
    pub before: i64,
    /// During the recording.
    pub during: i64,
}

/// Sets what is wished for, for frames `interval_secs` apart; gives what was changed, for [`restore`].
///
/// After an error what was changed so far has been put back.
pub fn apply(source: &mut dyn FrameSource, wishes: &Wishes, interval_secs: f64) -> Result<Vec<Changed>> {
    let mut changed = Vec::new();
    match set_all(source, wishes, interval_secs, &mut changed) {
        Ok(()) => Ok(changed),
        Err(e) => {
            restore(source, &changed);
            Err(e)
        }
    }
}

/// Puts back what was changed, the last change first; gives the names of those that could not be.
pub fn restore(source: &mut dyn FrameSource, changed: &[Changed]) -> Vec<String> {
    let controls = source.controls().unwrap_or_default();
    let mut failed = Vec::new();
    for change in changed.iter().rev() {
        let control = controls.iter().find(|c| c.id == change.id);
        if control.is_none_or(|c| source.set_control(c, change.before).is_err()) {
            failed.push(change.name.clone());
        }
    }
    failed
}

fn set_all(source: &mut dyn FrameSource, wishes: &Wishes, interval: f64, changed: &mut Vec<Changed>) -> Result<()> {
    let controls = source.controls()?;
    let of = |role: Role| controls.iter().find(|c| c.role == Some(role));
    let mut set = |control: &Control, value: i64| -> Result<()> {
        if control.value != value {
            source.set_control(control, value)?;
            let name = control.name.clone();
            changed.push(Changed { id: control.id, name, before: control.value, during: value });
        }
        Ok(())
    };
    if let Some(control) = of(Role::ExposureMayLowerRate) {
        set(control, 0)?;
    }
    let longest = EXPOSED_SHARE * interval;
    let wanted = match wishes.exposure {
        Exposure::Auto => None,
        Exposure::Fit => of(Role::ExposureTime).map(|c| (c.value as f64 * EXPOSURE_UNIT_SECS).min(longest)),
        Exposure::Time(time) if time.as_secs_f64() > interval => {
            return Err(CaptureError::ExposureTooLong { asked: time, interval_secs: interval });
        }
        Exposure::Time(time) if of(Role::ExposureTime).is_none() => {
            return Err(CaptureError::NoControl {
                name: format!("exposure (for `--exposure {time:?}`)"),
                known: names(&controls),
            });
        }
        Exposure::Time(time) => Some(time.as_secs_f64()),
    };
    if let (Some(secs), Some(time)) = (wanted, of(Role::ExposureTime)) {
        if let Some(auto) = of(Role::ExposureAuto) {
            set(auto, MANUAL)?;
        }
        let value = ((secs / EXPOSURE_UNIT_SECS).floor() as i64).clamp(time.lowest, time.highest);
        // A multiple of the step above the lowest; while the automatic worked, the driver may not have told the value.
        let value = time.lowest + (value - time.lowest) / time.step.max(1) * time.step.max(1);
        set(time, value)?;
    }
    for (wish, role, name) in [
        (wishes.lock_focus, Role::FocusAuto, "focus"),
        (wishes.lock_white_balance, Role::WhiteBalanceAuto, "white balance"),
    ] {
        if !wish {
            continue;
        }
        let Some(control) = of(role) else {
            return Err(CaptureError::NoControl { name: format!("automatic {name} to lock"), known: names(&controls) });
        };
        set(control, 0)?;
    }
    for (name, value) in &wishes.set {
        let lower = name.to_lowercase();
        let exact = controls.iter().filter(|c| c.name.to_lowercase() == lower);
        let part = controls.iter().filter(|c| c.name.to_lowercase().contains(&lower));
        let (exact, part): (Vec<_>, Vec<_>) = (exact.collect(), part.collect());
        let (([control], _) | (_, [control])) = (&exact[..], &part[..]) else {
            return Err(CaptureError::NoControl { name: name.clone(), known: names(&controls) });
        };
        set(control, *value)?;
    }
    Ok(())
}

fn names(controls: &[Control]) -> Vec<String> {
    controls.iter().map(|c| c.name.clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::{Faults, PixelFormat, Synthetic};

    fn camera() -> Synthetic {
        Synthetic::new(64, 48, 120.0, PixelFormat::Mjpeg, Faults::default())
    }

    fn values(source: &mut Synthetic) -> Vec<i64> {
        source.controls().unwrap().iter().map(|c| c.value).collect()
    }

    #[test]
    fn the_exposure_is_made_to_fit_the_frame_and_everything_is_put_back() {
        let mut source = camera();
        let before = values(&mut source);
        let wishes = Wishes {
            lock_focus: true,
            lock_white_balance: true,
            set: vec![("gain".to_owned(), 9)],
            ..Wishes::default()
        };
        let changed = apply(&mut source, &wishes, 1.0 / 120.0).unwrap();
        // 0.9 of 8.33 ms in steps of 100 µs; the camera's own choice was 16.6 ms.
        assert_eq!(values(&mut source), [1, 75, 0, 9, 0, 0]);
        assert_eq!(changed.len(), 6);
        assert!(restore(&mut source, &changed).is_empty());
        assert_eq!(values(&mut source), before);
    }

    #[test]
    fn an_exposure_that_is_short_enough_is_kept_and_auto_stays_auto() {
        let mut source = camera();
        apply(&mut source, &Wishes::default(), 0.1).unwrap();
        assert_eq!(values(&mut source)[..3], [1, 166, 0]);
        let mut source = camera();
        apply(&mut source, &Wishes { exposure: Exposure::Auto, ..Wishes::default() }, 0.001).unwrap();
        assert_eq!(values(&mut source)[..3], [3, 166, 0]);
        let mut source = camera();
        let time = Exposure::Time(Duration::from_millis(2));
        apply(&mut source, &Wishes { exposure: time, ..Wishes::default() }, 1.0 / 120.0).unwrap();
        assert_eq!(values(&mut source)[..3], [1, 20, 0]);
    }

    #[test]
    fn what_cannot_be_set_is_named_and_nothing_stays_changed() {
        let mut source = camera();
        let before = values(&mut source);
        let long = Wishes { exposure: Exposure::Time(Duration::from_millis(10)), ..Wishes::default() };
        assert!(matches!(apply(&mut source, &long, 1.0 / 120.0), Err(CaptureError::ExposureTooLong { .. })));
        for (name, value) in [("zoom", 1), ("o", 1), ("gain", 256)] {
            let wishes = Wishes { set: vec![(name.to_owned(), value)], ..Wishes::default() };
            assert!(apply(&mut source, &wishes, 1.0 / 120.0).is_err(), "{name}");
            assert_eq!(values(&mut source), before, "{name}");
        }
    }
}
