//! Cameras on Linux: Video4Linux2 with memory-mapped buffers.

use std::io;
use std::time::Duration;

use ::v4l::buffer::{Flags, Type};
use ::v4l::capability::Flags as Caps;
use ::v4l::frameinterval::FrameIntervalEnum;
use ::v4l::framesize::FrameSizeEnum;
use ::v4l::io::mmap::Stream;
use ::v4l::io::traits::{CaptureStream, Stream as _};
use ::v4l::v4l_sys::{v4l2_control, v4l2_queryctrl};
use ::v4l::video::Capture;
use ::v4l::video::capture::Parameters;
use ::v4l::{Device, Format, FourCC, Fraction, v4l2};

use super::{Control, FrameSource, Grab, Grabbed, Mode, PixelFormat, Rate, Rates, Role, Started};
use crate::negotiate::{COMMON_SIZES, Choice};
use crate::{CaptureError, Result};

/// `POLLIN`.
const READABLE: i16 = 1;
/// `ENODEV`: the camera has gone.
const GONE: i32 = 19;
const BUSY: i32 = 16;
/// `EIO` and `EAGAIN`: this one failed, the next may come.
const PASSING: [i32; 2] = [5, 11];
/// Controls after the last one.
const NEXT: u32 = 0x8000_0000;
/// Disabled, read-only, inactive, write-only.
const NOT_SETTABLE: u32 = 0x1 | 0x4 | 0x10 | 0x40;
/// Integer, boolean, menu.
const SIMPLE: [u32; 3] = [1, 2, 3];

/// A camera under `/dev`.
pub(super) struct Camera {
    path: String,
    device: Device,
    stream: Option<Stream<'static>>,
    /// The last attempt gave its buffer back and got none.
    holds_none: bool,
}

impl Camera {
    /// Opens `/dev/video0`, or `0` for the same.
    pub(super) fn open(name: &str) -> Result<Self> {
        let path = if name.bytes().all(|b| b.is_ascii_digit()) && !name.is_empty() {
            format!("/dev/video{name}")
        } else {
            name.to_owned()
        };
        let device = Device::with_path(&path).map_err(|e| CaptureError::open(&path, &e))?;
        let streams = device
            .query_caps()
            .map(|c| c.capabilities)
            .map_err(|_| CaptureError::NotACamera { device: path.clone() })?;
        if !streams.contains(Caps::VIDEO_CAPTURE) || !streams.contains(Caps::STREAMING) {
            return Err(CaptureError::NotACamera { device: path });
        }
        Ok(Self { path, device, stream: None, holds_none: false })
    }

    fn fail(&self, action: &'static str, error: &io::Error) -> CaptureError {
        match error.raw_os_error() {
            Some(GONE) => CaptureError::Unplugged { device: self.path.clone() },
            Some(BUSY) => CaptureError::Busy { device: self.path.clone() },
            _ => CaptureError::Camera { device: self.path.clone(), action, message: error.to_string() },
        }
    }

    fn rates(&self, fourcc: FourCC, width: u32, height: u32) -> Rates {
        let Ok(found) = self.device.enum_frameintervals(fourcc, width, height) else { return Rates::Unknown };
        let mut exactly = Vec::new();
        for interval in found {
            match interval.interval {
                FrameIntervalEnum::Discrete(f) => exactly.push(rate(f)),
                FrameIntervalEnum::Stepwise(s) => {
                    // The shortest interval is the highest rate.
                    return Rates::Between { lowest: rate(s.max).fps(), highest: rate(s.min).fps() };
                }
            }
        }
        if exactly.is_empty() { Rates::Unknown } else { Rates::Exactly(exactly) }
    }
}

fn rate(interval: Fraction) -> Rate {
    Rate { frames: interval.denominator, secs: interval.numerator }
}

impl FrameSource for Camera {
    fn name(&self) -> String {
        self.device.query_caps().map_or_else(|_| self.path.clone(), |c| c.card)
    }

    fn modes(&mut self, wanted: Option<(u32, u32)>) -> Result<Vec<Mode>> {
        let formats = self.device.enum_formats().map_err(|e| self.fail("list the formats", &e))?;
        let mut modes = Vec::new();
        for description in formats {
            let Some(format) = PixelFormat::from_fourcc(description.fourcc.repr) else { continue };
            for found in self.device.enum_framesizes(description.fourcc).unwrap_or_default() {
                let sizes: Vec<(u32, u32)> = match found.size {
                    FrameSizeEnum::Discrete(d) => vec![(d.width, d.height)],
                    FrameSizeEnum::Stepwise(s) => {
                        let fits = |&(w, h): &(u32, u32)| {
                            let on = |v: u32, min: u32, max: u32, step: u32| {
                                (min..=max).contains(&v) && (v - min).is_multiple_of(step.max(1))
                            };
                            on(w, s.min_width, s.max_width, s.step_width)
                                && on(h, s.min_height, s.max_height, s.step_height)
                        };
                        let mut sizes: Vec<_> = COMMON_SIZES.into_iter().chain(wanted).filter(fits).collect();
                        sizes.push((s.max_width, s.max_height));
                        sizes.sort_unstable();
                        sizes.dedup();
                        sizes
                    }
                };
                for (width, height) in sizes {
                    let rates = self.rates(description.fourcc, width, height);
                    modes.push(Mode { format, width, height, rates });
                }
            }
        }
        Ok(modes)
    }

    fn controls(&mut self) -> Result<Vec<Control>> {
        let mut out = Vec::new();
        let mut id = NEXT;
        // Compound controls, which no recording needs, are passed over.
        while let Some(found) = query_control(&self.device, id) {
            id = found.id | NEXT;
            if !SIMPLE.contains(&found.type_) || found.flags & 1 != 0 {
                continue;
            }
            let Some(value) = control_value(&self.device, found.id) else { continue };
            let name = found.name.iter().take_while(|&&b| b != 0).copied().collect::<Vec<u8>>();
            out.push(Control {
                id: found.id,
                name: String::from_utf8_lossy(&name).into_owned(),
                role: role(found.id),
                lowest: found.minimum.into(),
                highest: found.maximum.into(),
                step: i64::from(found.step).max(1),
                default: found.default_value.into(),
                value: value.into(),
                settable: found.flags & NOT_SETTABLE == 0,
            });
        }
        Ok(out)
    }

    fn set_control(&mut self, control: &Control, value: i64) -> Result<()> {
        let mut wanted = v4l2_control { id: control.id, value: value as i32 };
        ioctl(&self.device, v4l2::vidioc::VIDIOC_S_CTRL, &mut wanted).map_err(|e| match e.raw_os_error() {
            Some(GONE) => CaptureError::Unplugged { device: self.path.clone() },
            _ => {
                CaptureError::Control { name: control.name.clone(), message: format!("cannot set it to {value}: {e}") }
            }
        })
    }

    fn start(&mut self, choice: &Choice, buffers: u32) -> Result<Started> {
        let wanted = Format::new(choice.width, choice.height, FourCC::new(&choice.format.fourcc()));
        let format = self.device.set_format(&wanted).map_err(|e| self.fail("set the format", &e))?;
        let given = PixelFormat::from_fourcc(format.fourcc.repr);
        if (given, format.width, format.height) != (Some(choice.format), choice.width, choice.height) {
            return Err(CaptureError::Camera {
                device: self.path.clone(),
                action: "set the format",
                message: format!(
                    "asked for {choice}, the driver gives {}×{} {}",
                    format.width, format.height, format.fourcc
                ),
            });
        }
        let interval = Fraction::new(choice.rate.secs, choice.rate.frames);
        let rate =
            self.device.set_params(&Parameters::new(interval)).ok().map(|p| rate(p.interval)).filter(|r| r.fps() > 0.0);
        let mut stream = Stream::with_buffers(&self.device, Type::VideoCapture, buffers)
            .map_err(|e| self.fail("get buffers", &e))?;
        let given = count_buffers(&mut stream, buffers);
        stream.start().map_err(|e| self.fail("start", &e))?;
        self.stream = Some(stream);
        Ok(Started {
            format: choice.format,
            width: choice.width,
            height: choice.height,
            stride: format.stride as usize,
            rate,
            buffers: given,
        })
    }

    fn grab(&mut self, timeout: Duration, frame: &mut Grabbed) -> Result<Grab> {
        let Some(stream) = &mut self.stream else { return Ok(Grab::Timeout) };
        match stream.handle().poll(READABLE, timeout.as_millis() as i32) {
            Ok(0) => return Ok(Grab::Timeout),
            Ok(_) => {}
            Err(e) if e.kind() == io::ErrorKind::Interrupted => return Ok(Grab::Timeout),
            Err(e) => return Err(self.fail("wait for a frame", &e)),
        }
        if self.holds_none {
            // There is no buffer to give back; this one's frame is let go, and its number tells of it.
            match CaptureStream::dequeue(stream) {
                Ok(_) => self.holds_none = false,
                Err(e) if PASSING.contains(&e.raw_os_error().unwrap_or(0)) => {}
                Err(e) => return Err(self.fail("take a frame", &e)),
            }
            return Ok(Grab::Timeout);
        }
        // This gives back the buffer of the frame before, which has been copied, and takes the next.
        match stream.next() {
            Ok((bytes, meta)) => {
                let used = (meta.bytesused as usize).min(bytes.len());
                frame.data.clear();
                frame.data.extend_from_slice(&bytes[..used]);
                frame.sequence = Some(meta.sequence);
                let nanos = meta.timestamp.sec * 1_000_000_000 + meta.timestamp.usec * 1000;
                frame.driver_nanos = (nanos != 0).then_some(nanos);
                frame.is_corrupt = meta.flags.contains(Flags::ERROR) || used == 0;
                Ok(Grab::Frame)
            }
            Err(e) if PASSING.contains(&e.raw_os_error().unwrap_or(0)) => {
                self.holds_none = true;
                Ok(Grab::Timeout)
            }
            Err(e) => Err(self.fail("take a frame", &e)),
        }
    }

    fn stop(&mut self) {
        self.stream = None;
    }
}

/// Queues all buffers but the first, which the first `next` queues; gives how many there are.
fn count_buffers(stream: &mut Stream<'static>, asked: u32) -> u32 {
    let mut queued = 0;
    // Drivers may give more than asked for.
    while queued < 4 * asked && CaptureStream::queue(stream, queued as usize + 1).is_ok() {
        queued += 1;
    }
    queued + 1
}

fn role(id: u32) -> Option<Role> {
    Some(match id {
        0x009a_0901 => Role::ExposureAuto,
        0x009a_0902 => Role::ExposureTime,
        0x009a_0903 => Role::ExposureMayLowerRate,
        0x0098_0913 => Role::Gain,
        0x009a_090c => Role::FocusAuto,
        0x009a_090a => Role::Focus,
        0x0098_090c => Role::WhiteBalanceAuto,
        0x0098_091a => Role::WhiteBalance,
        _ => return None,
    })
}

fn query_control(device: &Device, id: u32) -> Option<v4l2_queryctrl> {
    #[expect(unsafe_code, reason = "the crate's own list of controls panics on kinds it does not know")]
    // SAFETY: a plain C structure of numbers, for which zeros are valid.
    let mut query: v4l2_queryctrl = unsafe { std::mem::zeroed() };
    query.id = id;
    ioctl(device, v4l2::vidioc::VIDIOC_QUERYCTRL, &mut query).ok().map(|()| query)
}

fn control_value(device: &Device, id: u32) -> Option<i32> {
    let mut control = v4l2_control { id, value: 0 };
    ioctl(device, v4l2::vidioc::VIDIOC_G_CTRL, &mut control).ok().map(|()| control.value)
}

fn ioctl<T>(device: &Device, request: v4l2::vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
    #[expect(unsafe_code, reason = "the crate has no safe way to single controls")]
    // SAFETY: callers pair each request with the structure that the kernel's interface gives for it.
    unsafe {
        v4l2::ioctl(device.handle().fd(), request, std::ptr::from_mut(argument).cast())
    }
}
