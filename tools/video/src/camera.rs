//! A camera: pictures as they come, and nothing about when they were taken. Recordings do not go through here.

use image::RgbImage;

#[cfg(all(feature = "v4l", target_os = "linux"))]
use self::kernel as backend;
#[cfg(all(feature = "opencv", not(all(feature = "v4l", target_os = "linux"))))]
use self::library as backend;
#[cfg(not(any(feature = "opencv", all(feature = "v4l", target_os = "linux"))))]
use self::none as backend;

/// A camera by its number: 0 is `/dev/video0` on Linux.
pub struct Camera(backend::Camera);

impl std::fmt::Debug for Camera {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Camera").finish_non_exhaustive()
    }
}

impl Camera {
    /// Opens a camera; `None` if there is none of this number, or this program has no way to cameras.
    pub fn open(number: i32) -> Option<Self> {
        backend::Camera::open(number).map(Self)
    }

    /// Asks for a size and a rate; the camera gives what it has nearest to them.
    pub fn start(&mut self, width: u32, height: u32, fps: f64) {
        self.0.start(width, height, fps);
    }

    /// Waits for the next picture; `None` when none comes any more.
    pub fn grab(&mut self) -> Option<RgbImage> {
        self.0.grab()
    }
}

#[cfg(all(feature = "v4l", target_os = "linux"))]
mod kernel {
    use image::{ImageFormat, RgbImage};
    use v4l::buffer::Type;
    use v4l::io::mmap::Stream;
    use v4l::io::traits::CaptureStream;
    use v4l::video::Capture;
    use v4l::video::capture::Parameters;
    use v4l::{Device, Format, FourCC, Fraction};

    /// Buffers that the driver fills in turn.
    const BUFFERS: u32 = 4;
    /// Broken pictures in a row after which the camera is given up.
    const PATIENCE: usize = 30;
    /// JPEG first: most cameras have their higher rates in it alone.
    const FORMATS: [[u8; 4]; 2] = [*b"MJPG", *b"YUYV"];

    pub(super) struct Camera {
        device: Device,
        format: Option<Format>,
        stream: Option<Stream<'static>>,
    }

    impl Camera {
        pub(super) fn open(number: i32) -> Option<Self> {
            let device = Device::new(usize::try_from(number).ok()?).ok()?;
            Some(Self { device, format: None, stream: None })
        }

        pub(super) fn start(&mut self, width: u32, height: u32, fps: f64) {
            self.format = FORMATS.into_iter().find_map(|fourcc| {
                let wanted = Format::new(width, height, FourCC::new(&fourcc));
                self.device.set_format(&wanted).ok().filter(|given| given.fourcc.repr == fourcc)
            });
            let interval = Fraction::new(1000, (fps * 1000.0).clamp(1.0, 1e9) as u32);
            // A camera with one rate has nothing to set.
            let _ = self.device.set_params(&Parameters::new(interval));
            self.stream = Stream::with_buffers(&self.device, Type::VideoCapture, BUFFERS).ok();
        }

        pub(super) fn grab(&mut self) -> Option<RgbImage> {
            let (format, stream) = (self.format.as_ref()?, self.stream.as_mut()?);
            for _ in 0..PATIENCE {
                let (bytes, meta) = stream.next().ok()?;
                let bytes = bytes.get(..meta.bytesused as usize).unwrap_or(bytes);
                let picture = if format.fourcc.repr == FORMATS[0] {
                    image::load_from_memory_with_format(bytes, ImageFormat::Jpeg)
                        .ok()
                        .map(image::DynamicImage::into_rgb8)
                } else {
                    from_yuyv(format, bytes)
                };
                if picture.is_some() {
                    return picture;
                }
            }
            None
        }
    }

    /// BT.601, limited range, as cameras send it.
    fn from_yuyv(format: &Format, bytes: &[u8]) -> Option<RgbImage> {
        let stride = (format.stride as usize).max(2 * format.width as usize);
        let needed = stride * (format.height as usize).checked_sub(1)? + 2 * format.width as usize;
        if bytes.len() < needed {
            return None;
        }
        Some(RgbImage::from_fn(format.width, format.height, |x, y| {
            let pair = &bytes[y as usize * stride + 4 * (x as usize / 2)..];
            let luma = 1.164 * (f32::from(pair[2 * (x as usize % 2)]) - 16.0);
            let (u, v) = (f32::from(pair[1]) - 128.0, f32::from(pair.get(3).copied().unwrap_or(128)) - 128.0);
            image::Rgb([luma + 1.596 * v, luma - 0.392 * u - 0.813 * v, luma + 2.017 * u].map(|c| c.round() as u8))
        }))
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn packed_pictures_have_their_colours() {
            let mut format = Format::new(2, 2, FourCC::new(b"YUYV"));
            format.stride = 6;
            // White beside black, then orange; two bytes of padding a row.
            let bytes = [235, 128, 16, 128, 0, 0, 150, 60, 150, 190];
            let picture = from_yuyv(&format, &bytes).unwrap();
            assert_eq!((picture.get_pixel(0, 0).0, picture.get_pixel(1, 0).0), ([255; 3], [0; 3]));
            assert_eq!(picture.get_pixel(1, 1).0, [255, 132, 19]);
            assert!(from_yuyv(&format, &bytes[..9]).is_none());
        }
    }
}

#[cfg(all(feature = "opencv", not(all(feature = "v4l", target_os = "linux"))))]
mod library {
    use image::RgbImage;

    use crate::OpenCvCamera;

    pub(super) struct Camera {
        camera: OpenCvCamera,
        size: (u32, u32),
    }

    impl Camera {
        pub(super) fn open(number: i32) -> Option<Self> {
            Some(Self { camera: OpenCvCamera::open(number)?, size: (0, 0) })
        }

        pub(super) fn start(&mut self, width: u32, height: u32, fps: f64) {
            let (width, height, _) = self.camera.start(width, height, fps);
            self.size = (width, height);
        }

        pub(super) fn grab(&mut self) -> Option<RgbImage> {
            let mut bytes = Vec::new();
            if !self.camera.grab(&mut bytes) {
                return None;
            }
            bytes.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
            RgbImage::from_raw(self.size.0, self.size.1, bytes)
        }
    }
}

#[cfg(not(any(feature = "opencv", all(feature = "v4l", target_os = "linux"))))]
mod none {
    use image::RgbImage;

    pub(super) struct Camera;

    impl Camera {
        pub(super) fn open(_: i32) -> Option<Self> {
            None
        }

        #[expect(clippy::unused_self, reason = "the same as where there are cameras")]
        pub(super) fn start(&mut self, _: u32, _: u32, _: f64) {}

        #[expect(clippy::unused_self, reason = "the same as where there are cameras")]
        pub(super) fn grab(&mut self) -> Option<RgbImage> {
            None
        }
    }
}
