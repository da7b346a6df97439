//! A camera that is not there, with real time: frames are due when a camera's would be, and lost when nobody fetches them.
//!
//! Like a driver, a thread of its own fills a few buffers at the stated rate and counts every frame; when all buffers
//! are full the frame is lost and the count goes on. So a recording from it has a gap exactly where the recorder was
//! late. Pictures move; MJPEG frames carry their number in a comment, raw ones in their first eight bytes.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use image::codecs::jpeg::JpegEncoder;
use image::{Rgb, RgbImage};

use super::{Control, FrameSource, Grab, Grabbed, Mode, PixelFormat, Rate, Rates, Role, Started};
use crate::negotiate::Choice;
use crate::{CaptureError, Result};

/// Different pictures, shown in turn.
const PICTURES: u32 = 24;
/// Raw pictures are larger.
const RAW_PICTURES: u32 = 5;
const QUALITY: u8 = 80;

/// What goes wrong, for tests.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Faults {
    /// Sequence numbers that the driver loses.
    pub lost: Vec<u32>,
    /// Sequence numbers whose pictures are broken.
    pub corrupt: Vec<u32>,
    /// The camera goes away after so many frames.
    pub unplugged_after: Option<u32>,
    /// The first sequence number; close to 2³² it wraps.
    pub first_sequence: u32,
    /// Frames per second that it gives, whatever it promises.
    pub fps_given: Option<f64>,
    /// Times are given with this much of noise, microseconds.
    pub jitter_micros: u32,
}

/// The camera that is not there.
pub struct Synthetic {
    width: u32,
    height: u32,
    fps: f64,
    format: PixelFormat,
    faults: Faults,
    controls: Vec<Control>,
    running: Option<Running>,
}

struct Running {
    shared: Arc<Shared>,
    driver: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    full: VecDeque<Grabbed>,
    empty: Vec<Vec<u8>>,
    stop: bool,
    gone: bool,
}

impl Synthetic {
    /// A camera of one size and rate.
    pub fn new(width: u32, height: u32, fps: f64, format: PixelFormat, faults: Faults) -> Self {
        Self { width, height, fps, format, faults, controls: controls(), running: None }
    }

    /// `1280x720@120`, `640x480@30,yuyv,lose=7+8,corrupt=9,unplug=100,jitter=500`; everything can be left out.
    pub fn parse(text: &str) -> Result<Self> {
        let wrong = |what: &str| CaptureError::Synthetic { text: text.to_owned(), what: what.to_owned() };
        let mut this = Self::new(1280, 720, 120.0, PixelFormat::Mjpeg, Faults::default());
        for part in text.split(',').filter(|p| !p.is_empty()) {
            let numbers = |list: &str| -> Result<Vec<u32>> {
                list.split('+').map(|n| n.parse().map_err(|_| wrong(part))).collect()
            };
            match part.split_once('=') {
                Some(("lose", list)) => this.faults.lost = numbers(list)?,
                Some(("corrupt", list)) => this.faults.corrupt = numbers(list)?,
                Some(("unplug", n)) => this.faults.unplugged_after = Some(n.parse().map_err(|_| wrong(part))?),
                Some(("first", n)) => this.faults.first_sequence = n.parse().map_err(|_| wrong(part))?,
                Some(("gives", n)) => this.faults.fps_given = Some(n.parse().map_err(|_| wrong(part))?),
                Some(("jitter", n)) => this.faults.jitter_micros = n.parse().map_err(|_| wrong(part))?,
                Some(_) => return Err(wrong(part)),
                None => match part.split_once('@') {
                    Some((size, fps)) => {
                        let (w, h) = size.split_once('x').ok_or_else(|| wrong(part))?;
                        let side =
                            |s: &str| s.parse().ok().filter(|n| (16..=8192).contains(n)).ok_or_else(|| wrong(part));
                        (this.width, this.height) = (side(w)?, side(h)?);
                        this.fps =
                            fps.parse().ok().filter(|f| (0.5..=2000.0).contains(f)).ok_or_else(|| wrong(part))?;
                    }
                    None => this.format = part.parse().map_err(|_| wrong(part))?,
                },
            }
        }
        if this.format == PixelFormat::H264 || this.format.raw().is_some_and(|raw| !raw.fits(this.width, this.height)) {
            return Err(wrong("this format"));
        }
        Ok(this)
    }
}

/// Like a usual webcam's: automatic exposure that is longer than a frame, until it is told otherwise.
fn controls() -> Vec<Control> {
    let control = |id, name: &str, role, lowest, highest, value| Control {
        id,
        name: name.to_owned(),
        role: Some(role),
        lowest,
        highest,
        step: 1,
        default: value,
        value,
        settable: true,
    };
    vec![
        control(1, "Auto Exposure", Role::ExposureAuto, 0, 3, 3),
        control(2, "Exposure Time, Absolute", Role::ExposureTime, 1, 5000, 166),
        control(3, "Exposure, Dynamic Framerate", Role::ExposureMayLowerRate, 0, 1, 1),
        control(4, "Gain", Role::Gain, 0, 255, 64),
        control(5, "Focus, Automatic Continuous", Role::FocusAuto, 0, 1, 1),
        control(6, "White Balance, Automatic", Role::WhiteBalanceAuto, 0, 1, 1),
    ]
}

impl FrameSource for Synthetic {
    fn name(&self) -> String {
        "synthetic camera".to_owned()
    }

    fn modes(&mut self, _wanted: Option<(u32, u32)>) -> Result<Vec<Mode>> {
        let rates = Rates::Exactly(vec![Rate::from_fps(self.fps)]);
        Ok(vec![Mode { format: self.format, width: self.width, height: self.height, rates }])
    }

    fn controls(&mut self) -> Result<Vec<Control>> {
        // As in real drivers, a manual value cannot be set while the automatic one works.
        let manual = self.controls[0].value == 1;
        self.controls[1].settable = manual;
        Ok(self.controls.clone())
    }

    fn set_control(&mut self, control: &Control, value: i64) -> Result<()> {
        let manual = self.controls[0].value == 1;
        let fail =
            |message: &str| Err(CaptureError::Control { name: control.name.clone(), message: message.to_owned() });
        let Some(found) = self.controls.iter_mut().find(|c| c.id == control.id) else { return fail("there is none") };
        if found.role == Some(Role::ExposureTime) && !manual {
            return fail("the automatic exposure is on");
        }
        if !(found.lowest..=found.highest).contains(&value) {
            return fail("out of range");
        }
        found.value = value;
        Ok(())
    }

    fn start(&mut self, choice: &Choice, buffers: u32) -> Result<Started> {
        let pictures = pictures(self.format, self.width, self.height);
        let shared = Arc::new(Shared::default());
        lock(&shared.state).empty = vec![Vec::new(); buffers as usize];
        let fps = self.faults.fps_given.filter(|f| *f > 0.0).unwrap_or(self.fps);
        let (faults, theirs, format) = (self.faults.clone(), Arc::clone(&shared), self.format);
        let driver = std::thread::spawn(move || drive(&theirs, &pictures, format, fps, &faults));
        self.running = Some(Running { shared, driver: Some(driver) });
        let stride = self.format.raw().map_or(0, |raw| raw.row_bytes(self.width));
        Ok(Started {
            format: self.format,
            width: self.width,
            height: self.height,
            stride,
            rate: Some(choice.rate),
            buffers,
        })
    }

    fn grab(&mut self, timeout: Duration, frame: &mut Grabbed) -> Result<Grab> {
        let Some(running) = &self.running else { return Ok(Grab::Timeout) };
        let mut state = lock(&running.shared.state);
        if state.full.is_empty() && !state.gone {
            state = running.shared.changed.wait_timeout(state, timeout).unwrap_or_else(PoisonError::into_inner).0;
        }
        let Some(next) = state.full.pop_front() else {
            let device = "synthetic".to_owned();
            return if state.gone { Err(CaptureError::Unplugged { device }) } else { Ok(Grab::Timeout) };
        };
        // As with a mapped buffer: it is copied, and the driver has it again.
        drop(state);
        frame.data.clear();
        frame.data.extend_from_slice(&next.data);
        (frame.sequence, frame.driver_nanos, frame.is_corrupt) = (next.sequence, next.driver_nanos, next.is_corrupt);
        lock(&running.shared.state).empty.push(next.data);
        Ok(Grab::Frame)
    }

    fn stop(&mut self) {
        if let Some(mut running) = self.running.take() {
            lock(&running.shared.state).stop = true;
            running.shared.changed.notify_all();
            if let Some(driver) = running.driver.take() {
                let _ = driver.join();
            }
        }
    }
}

impl Drop for Synthetic {
    fn drop(&mut self) {
        self.stop();
    }
}

fn lock(state: &Mutex<State>) -> std::sync::MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The driver: a frame every 1 / `fps` seconds, whether somebody wants it or not.
fn drive(shared: &Shared, pictures: &[Vec<u8>], format: PixelFormat, fps: f64, faults: &Faults) {
    let begun = Instant::now();
    for number in 0u32.. {
        let due = Duration::from_secs_f64(f64::from(number) / fps);
        if let Some(wait) = due.checked_sub(begun.elapsed()) {
            std::thread::sleep(wait);
        }
        let mut state = lock(&shared.state);
        if state.stop {
            return;
        }
        if faults.unplugged_after.is_some_and(|n| number >= n) {
            state.gone = true;
            shared.changed.notify_all();
            return;
        }
        let sequence = faults.first_sequence.wrapping_add(number);
        if faults.lost.contains(&number) {
            continue;
        }
        let Some(mut data) = state.empty.pop() else { continue };
        drop(state);
        fill(&mut data, &pictures[number as usize % pictures.len()], format, number);
        let noise = if faults.jitter_micros == 0 {
            0
        } else {
            i64::from(number.wrapping_mul(2_654_435_761) >> 8) % i64::from(faults.jitter_micros)
        };
        let frame = Grabbed {
            data,
            sequence: Some(sequence),
            driver_nanos: Some(1_000_000_000 + due.as_nanos() as i64 + 1000 * noise),
            is_corrupt: faults.corrupt.contains(&number),
        };
        lock(&shared.state).full.push_back(frame);
        shared.changed.notify_all();
    }
}

fn fill(data: &mut Vec<u8>, picture: &[u8], format: PixelFormat, number: u32) {
    data.clear();
    if format == PixelFormat::Mjpeg {
        // Start of image, a comment of eight digits, the rest.
        data.extend_from_slice(&[0xff, 0xd8, 0xff, 0xfe, 0, 10]);
        data.extend_from_slice(format!("{number:08}").as_bytes());
        data.extend_from_slice(picture.get(2..).unwrap_or_default());
    } else {
        data.extend_from_slice(picture);
        if let Some(mark) = data.get_mut(..8) {
            mark.copy_from_slice(&u64::from(number).to_le_bytes());
        }
    }
}

/// Coarse squares and a fine texture that drift, with a bright disc that circles.
fn scene(width: u32, height: u32, phase: f64) -> RgbImage {
    let turn = std::f64::consts::TAU * phase;
    let side = f64::from(width.min(height));
    let centre =
        (f64::from(width) * 0.5 + 0.25 * side * turn.cos(), f64::from(height) * 0.5 + 0.25 * side * turn.sin());
    let shift = (phase * 64.0) as u32;
    RgbImage::from_fn(width, height, |x, y| {
        let squares = ((x + shift) / 32 + y / 32) % 2 * 60 + 60;
        let texture = (x.wrapping_mul(7) ^ y.wrapping_mul(13)) % 23;
        let disc = (f64::from(x) - centre.0).hypot(f64::from(y) - centre.1) < 0.1 * side;
        let level = if disc { 210 } else { squares + texture } as u8;
        Rgb([level, level.saturating_add(12), level / 2 + 40])
    })
}

fn pictures(format: PixelFormat, width: u32, height: u32) -> Vec<Vec<u8>> {
    let count = if format == PixelFormat::Mjpeg { PICTURES } else { RAW_PICTURES };
    let one = |i: u32| {
        let image = scene(width, height, f64::from(i) / f64::from(count));
        match format {
            PixelFormat::Mjpeg => {
                let mut bytes = Vec::new();
                // Into memory this cannot fail, and an empty picture would show.
                let _ = JpegEncoder::new_with_quality(&mut bytes, QUALITY).encode_image(&image);
                bytes
            }
            _ => raw_from_rgb(format, &image),
        }
    };
    (0..count).map(one).collect()
}

/// BT.601 in its limited range; chroma of every second pixel.
fn raw_from_rgb(format: PixelFormat, image: &RgbImage) -> Vec<u8> {
    let yuv = |p: &Rgb<u8>| {
        let [r, g, b] = p.0.map(f64::from);
        let y = 16.0 + 0.257 * r + 0.504 * g + 0.098 * b;
        let u = 128.0 - 0.148 * r - 0.291 * g + 0.439 * b;
        let v = 128.0 + 0.439 * r - 0.368 * g - 0.071 * b;
        [y, u, v].map(|c| c.round().clamp(0.0, 255.0) as u8)
    };
    let (w, h) = image.dimensions();
    let chroma = |which: usize, x: u32, y: u32| yuv(image.get_pixel(x & !1, y & !1))[which];
    let luma = || image.pixels().map(|p| yuv(p)[0]);
    let quarter = || (0..h / 2).flat_map(move |y| (0..w / 2).map(move |x| (2 * x, 2 * y)));
    match format {
        PixelFormat::Yuyv => {
            image.enumerate_pixels().flat_map(|(x, y, p)| [yuv(p)[0], chroma(1 + (x % 2) as usize, x, y)]).collect()
        }
        PixelFormat::Uyvy => {
            image.enumerate_pixels().flat_map(|(x, y, p)| [chroma(1 + (x % 2) as usize, x, y), yuv(p)[0]]).collect()
        }
        PixelFormat::Nv12 => luma().chain(quarter().flat_map(|(x, y)| [chroma(1, x, y), chroma(2, x, y)])).collect(),
        PixelFormat::I420 => luma()
            .chain(quarter().map(|(x, y)| chroma(1, x, y)))
            .chain(quarter().map(|(x, y)| chroma(2, x, y)))
            .collect(),
        PixelFormat::Grey => luma().collect(),
        PixelFormat::Bgr24 => image.pixels().flat_map(|p| [p[2], p[1], p[0]]).collect(),
        PixelFormat::Rgb24 | PixelFormat::Mjpeg | PixelFormat::H264 => image.as_raw().clone(),
    }
}
