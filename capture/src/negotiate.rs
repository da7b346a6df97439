//! Which of a camera's modes does what is asked, and what to say when none does.

use std::fmt;

use crate::source::{Mode, PixelFormat, Rate, Rates};

/// Sizes that people ask for.
pub const COMMON_SIZES: [(u32, u32); 10] = [
    (320, 240),
    (640, 360),
    (640, 480),
    (800, 600),
    (960, 540),
    (1280, 720),
    (1440, 1080),
    (1920, 1080),
    (2560, 1440),
    (3840, 2160),
];
/// Rates this close are the same: 119.88 is 120, 29.97 is 30.
const SAME_RATE: f64 = 0.002;
/// The size when none is asked for and the camera has it.
const USUAL_SIZE: (u32, u32) = (1280, 720);
/// The rate that is asked of drivers which do not tell theirs.
const UNKNOWN_RATE: f64 = 30.0;

/// What is asked of a camera; what is `None` is free.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Request {
    /// Width and height, pixels.
    pub size: Option<(u32, u32)>,
    /// Frames per second.
    pub fps: Option<f64>,
    /// What the frames are made of.
    pub format: Option<PixelFormat>,
}

/// A mode at one rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// What the frames are made of.
    pub format: PixelFormat,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The rate.
    pub rate: Rate,
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}×{} at {} {}", self.width, self.height, number(self.rate.fps()), self.format)
    }
}

/// Why no mode does.
#[derive(Clone, Debug, PartialEq)]
pub enum Refusal {
    /// The camera has no mode that can be recorded.
    NoModes,
    /// Not in this format; these are there.
    Format {
        /// What was asked for.
        asked: PixelFormat,
        /// What the camera has.
        offered: Vec<PixelFormat>,
    },
    /// Not in this size; this is the nearest.
    Size {
        /// What was asked for, pixels.
        asked: (u32, u32),
        /// The nearest that the camera has, pixels.
        nearest: (u32, u32),
    },
    /// Not at this rate.
    Rate {
        /// What was asked for, frames per second.
        asked: f64,
        /// The size that it was asked for, pixels.
        size: (u32, u32),
        /// The nearest rate at this size, frames per second.
        nearest: f64,
        /// The largest size that has the rate, pixels.
        at_another_size: Option<(u32, u32)>,
    },
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoModes => write!(f, "has no mode that can be recorded"),
            Self::Format { asked, .. } => write!(f, "does not give {asked}"),
            Self::Size { asked, .. } => write!(f, "has no size of {}×{}", asked.0, asked.1),
            Self::Rate { asked, size, nearest, .. } => write!(
                f,
                "does not reach {} frames/s at {}×{}; the nearest is {}",
                number(*asked),
                size.0,
                size.1,
                number(*nearest)
            ),
        }
    }
}

impl Refusal {
    /// What to ask for instead.
    pub fn advice(&self) -> String {
        match self {
            Self::NoModes => "`capture devices` lists the modes of all cameras".to_owned(),
            Self::Format { offered, .. } => {
                let names: Vec<_> = offered.iter().map(|f| format!("`{f}`")).collect();
                format!("it gives {}", names.join(", "))
            }
            Self::Size { nearest, .. } => format!("the nearest is `--size {}x{}`", nearest.0, nearest.1),
            Self::Rate { nearest, at_another_size, .. } => {
                let other = at_another_size.map(|(w, h)| format!(", or `--size {w}x{h}`, which has the rate"));
                format!("take `--fps {}`{}", number(*nearest), other.unwrap_or_default())
            }
        }
    }
}

/// A rate without needless digits, but with so many that it is still the same when it is asked for.
pub(crate) fn number(fps: f64) -> String {
    let rounded = |decimals: usize| format!("{fps:.decimals$}");
    let is_same = |text: &String| text.parse().is_ok_and(|read| same_rate(read, fps));
    let text = (2..8).map(rounded).find(is_same).unwrap_or_else(|| rounded(2));
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Whether two rates are the same for a recording.
pub fn same_rate(a: f64, b: f64) -> bool {
    (a - b).abs() <= SAME_RATE * a.max(b)
}

/// The rate of `rates` that is nearest to `fps`, in the ratio.
fn nearest_rate(rates: &Rates, fps: f64) -> Option<Rate> {
    match rates {
        Rates::Exactly(list) => {
            let off = |r: &Rate| (r.fps() / fps).ln().abs();
            list.iter().filter(|r| r.fps() > 0.0).min_by(|a, b| off(a).total_cmp(&off(b))).copied()
        }
        Rates::Between { lowest, highest } => (*highest > 0.0).then(|| {
            let inside = fps.clamp(lowest.min(*highest), *highest);
            Rate::from_fps(inside)
        }),
        Rates::Unknown => Some(Rate::from_fps(fps)),
    }
}

fn highest_rate(rates: &Rates) -> Option<Rate> {
    match rates {
        Rates::Exactly(list) => list.iter().max_by(|a, b| a.fps().total_cmp(&b.fps())).copied(),
        Rates::Between { highest, .. } => Some(Rate::from_fps(*highest)),
        Rates::Unknown => Some(Rate::from_fps(UNKNOWN_RATE)),
    }
}

/// Raw before compressed; 4:2:0 before 4:2:2 before RGB, as it asks less of bus and disk.
fn preference(format: PixelFormat) -> usize {
    PixelFormat::ALL.iter().position(|f| *f == format).unwrap_or(usize::MAX)
}

/// The mode that does what is asked: raw where that reaches the rate, else compressed.
pub fn negotiate(modes: &[Mode], request: &Request) -> Result<Choice, Refusal> {
    let recordable: Vec<&Mode> = modes
        .iter()
        .filter(|m| m.format.raw().is_none_or(|raw| raw.fits(m.width, m.height)) && highest_rate(&m.rates).is_some())
        .collect();
    if recordable.is_empty() {
        return Err(Refusal::NoModes);
    }
    let of_format: Vec<&Mode> =
        recordable.iter().copied().filter(|m| request.format.is_none_or(|f| m.format == f)).collect();
    if let (Some(asked), true) = (request.format, of_format.is_empty()) {
        let mut offered: Vec<PixelFormat> = recordable.iter().map(|m| m.format).collect();
        offered.sort_by_key(|f| preference(*f));
        offered.dedup();
        return Err(Refusal::Format { asked, offered });
    }
    let size = choose_size(&of_format, request)?;
    let of_size: Vec<&Mode> = of_format.iter().copied().filter(|m| (m.width, m.height) == size).collect();
    let reaches = |m: &&Mode, fps: f64| nearest_rate(&m.rates, fps).is_some_and(|r| same_rate(r.fps(), fps));
    let fps = match request.fps {
        Some(fps) => fps,
        None => of_size.iter().filter_map(|m| highest_rate(&m.rates)).map(Rate::fps).fold(0.0, f64::max),
    };
    if let Some(mode) = of_size.iter().filter(|m| reaches(m, fps)).min_by_key(|m| preference(m.format)) {
        let rate = nearest_rate(&mode.rates, fps).unwrap_or(Rate::from_fps(fps));
        return Ok(Choice { format: mode.format, width: size.0, height: size.1, rate });
    }
    let nearest = of_size
        .iter()
        .filter_map(|m| nearest_rate(&m.rates, fps))
        .map(Rate::fps)
        .min_by(|a, b| (a / fps).ln().abs().total_cmp(&(b / fps).ln().abs()))
        .unwrap_or(0.0);
    let at_another_size = of_format
        .iter()
        .filter(|m| reaches(m, fps))
        .map(|m| (m.width, m.height))
        .max_by_key(|(w, h)| u64::from(*w) * u64::from(*h));
    Err(Refusal::Rate { asked: fps, size, nearest, at_another_size })
}

fn choose_size(modes: &[&Mode], request: &Request) -> Result<(u32, u32), Refusal> {
    let sizes = || modes.iter().map(|m| (m.width, m.height));
    let area = |(w, h): (u32, u32)| u64::from(w) * u64::from(h);
    if let Some(asked) = request.size {
        if sizes().any(|s| s == asked) {
            return Ok(asked);
        }
        let off = |(w, h): (u32, u32)| w.abs_diff(asked.0) + h.abs_diff(asked.1);
        let nearest = sizes().min_by_key(|s| off(*s)).unwrap_or(asked);
        return Err(Refusal::Size { asked, nearest });
    }
    // The usual size, else the largest, of those that reach the rate; of all where none does.
    let reaching: Vec<(u32, u32)> = modes
        .iter()
        .filter(|m| request.fps.is_none_or(|f| nearest_rate(&m.rates, f).is_some_and(|r| same_rate(r.fps(), f))))
        .map(|m| (m.width, m.height))
        .collect();
    let pool: Vec<(u32, u32)> = if reaching.is_empty() { sizes().collect() } else { reaching };
    if pool.contains(&USUAL_SIZE) {
        return Ok(USUAL_SIZE);
    }
    pool.into_iter().max_by_key(|s| area(*s)).ok_or(Refusal::NoModes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn mode(format: PixelFormat, width: u32, height: u32, fps: &[f64]) -> Mode {
        let rates = Rates::Exactly(fps.iter().map(|f| Rate::from_fps(*f)).collect());
        Mode { format, width, height, rates }
    }

    fn webcam() -> Vec<Mode> {
        vec![
            mode(PixelFormat::Yuyv, 1280, 720, &[10.0, 5.0]),
            mode(PixelFormat::Yuyv, 640, 480, &[30.0, 15.0]),
            mode(PixelFormat::Mjpeg, 1280, 720, &[119.88, 60.0, 30.0]),
            mode(PixelFormat::Mjpeg, 1920, 1080, &[60.0, 30.0]),
            mode(PixelFormat::Mjpeg, 640, 480, &[120.0, 30.0]),
        ]
    }

    fn ask(size: Option<(u32, u32)>, fps: Option<f64>) -> Result<Choice, Refusal> {
        negotiate(&webcam(), &Request { size, fps, format: None })
    }

    #[test]
    fn raw_is_taken_where_it_reaches_the_rate_and_mjpeg_where_it_does_not() {
        assert_eq!(ask(Some((640, 480)), Some(30.0)).unwrap().format, PixelFormat::Yuyv);
        let fast = ask(Some((1280, 720)), Some(120.0)).unwrap();
        assert_eq!((fast.format, fast.rate), (PixelFormat::Mjpeg, Rate { frames: 119_880, secs: 1000 }));
        // Nothing asked: the usual size at its best rate.
        let free = ask(None, None).unwrap();
        assert_eq!((free.width, free.height, free.rate.fps()), (1280, 720, 119.88));
    }

    #[test]
    fn a_rate_that_is_not_there_is_refused_with_the_nearest() {
        let refusal = ask(Some((1920, 1080)), Some(120.0)).unwrap_err();
        assert_eq!(refusal.to_string(), "does not reach 120 frames/s at 1920×1080; the nearest is 60");
        assert_eq!(refusal.advice(), "take `--fps 60`, or `--size 1280x720`, which has the rate");
        assert_eq!(
            ask(Some((1300, 700)), None).unwrap_err(),
            Refusal::Size { asked: (1300, 700), nearest: (1280, 720) }
        );
        let format = Request { format: Some(PixelFormat::H264), ..Request::default() };
        assert_eq!(negotiate(&webcam(), &format).unwrap_err().advice(), "it gives `yuyv`, `mjpeg`");
        assert_eq!(negotiate(&[], &Request::default()), Err(Refusal::NoModes));
    }

    #[test]
    fn ranges_and_silent_drivers_are_understood() {
        let range = |lowest, highest| {
            let rates = Rates::Between { lowest, highest };
            vec![Mode { format: PixelFormat::Nv12, width: 1280, height: 720, rates }]
        };
        let ask = |modes: &[Mode], fps| negotiate(modes, &Request { fps: Some(fps), ..Request::default() });
        assert_eq!(ask(&range(1.0, 120.0), 99.5).unwrap().rate, Rate { frames: 99_500, secs: 1000 });
        assert!(matches!(ask(&range(1.0, 60.0), 120.0), Err(Refusal::Rate { nearest: 60.0, .. })));
        let silent = vec![Mode { rates: Rates::Unknown, ..range(0.0, 0.0)[0].clone() }];
        assert_eq!(ask(&silent, 50.0).unwrap().rate.fps(), 50.0);
    }

    fn any_mode() -> impl Strategy<Value = Mode> {
        let format = prop::sample::select(PixelFormat::ALL.to_vec());
        let size = prop::sample::select(COMMON_SIZES.to_vec());
        let rates = prop_oneof![
            prop::collection::vec((1u32..250, 1u32..3), 1..5)
                .prop_map(|l| Rates::Exactly(l.into_iter().map(|(frames, secs)| Rate { frames, secs }).collect())),
            (1.0f64..30.0, 30.0f64..240.0).prop_map(|(lowest, highest)| Rates::Between { lowest, highest }),
        ];
        (format, size, rates).prop_map(|(format, (width, height), rates)| Mode { format, width, height, rates })
    }

    #[test]
    fn rates_are_written_so_that_they_are_still_the_same() {
        let cases = [(120.0, "120"), (29.97, "29.97"), (119.88, "119.88"), (1.2345, "1.234"), (1.0 / 15.0, "0.0667")];
        for (fps, text) in cases {
            assert_eq!(number(fps), text);
            assert!(same_rate(text.parse().unwrap(), fps));
        }
    }

    proptest! {
        /// What is agreed to is a mode that the camera has and that was asked for; a refused rate really is not there, and
        /// asking for what is named instead, in the digits in which it is named, is agreed to.
        #[test]
        fn what_is_agreed_is_there_and_what_is_refused_is_not(
            modes in prop::collection::vec(any_mode(), 1..12),
            size in prop::option::of(prop::sample::select(COMMON_SIZES.to_vec())),
            fps in prop::option::of(1.0f64..250.0),
        ) {
            let has = |m: &Mode, f: f64| match &m.rates {
                Rates::Exactly(l) => l.iter().any(|r| same_rate(r.fps(), f)),
                // Thousandths of a frame per second are what drivers are asked for.
                Rates::Between { lowest, highest } => (lowest - 0.001..=highest + 0.001).contains(&f),
                Rates::Unknown => true,
            };
            let is_there = |choice: &Choice, asked: Option<f64>| {
                let rate = choice.rate.fps();
                let of = |m: &&Mode| (m.format, m.width, m.height) == (choice.format, choice.width, choice.height);
                modes.iter().filter(of).any(|m| has(m, rate)) && asked.is_none_or(|f| same_rate(f, rate))
            };
            match negotiate(&modes, &Request { size, fps, format: None }) {
                Ok(choice) => {
                    prop_assert!(is_there(&choice, fps), "asked for {fps:?}, got {choice}");
                    prop_assert!(size.is_none_or(|s| s == (choice.width, choice.height)));
                }
                Err(Refusal::Rate { asked, size: here, nearest, at_another_size }) => {
                    prop_assert_eq!(fps, Some(asked));
                    prop_assert!(!modes.iter().any(|m| (m.width, m.height) == here && has(m, asked)));
                    let as_told = number(nearest).parse().unwrap();
                    let instead = [Some((here, as_told)), at_another_size.map(|other| (other, asked))];
                    for (size, fps) in instead.into_iter().flatten() {
                        let again = negotiate(&modes, &Request { size: Some(size), fps: Some(fps), format: None });
                        let agreed = again.as_ref().is_ok_and(|choice| is_there(choice, Some(fps)));
                        prop_assert!(agreed, "{size:?} at {fps} instead of {here:?} at {asked}: {again:?}");
                    }
                }
                Err(Refusal::Size { asked, nearest }) => {
                    prop_assert!(modes.iter().all(|m| (m.width, m.height) != asked));
                    prop_assert!(modes.iter().any(|m| (m.width, m.height) == nearest));
                }
                Err(other) => prop_assert!(false, "{other:?}"),
            }
        }
    }
}
