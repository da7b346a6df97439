//! The planes of a decoded picture, whatever its pixel format.
//!
//! Planar YUV, grey and planar RGB in 8 to 16 bits (little-endian) are read where they lie; other formats are first
//! rearranged by libswscale into the nearest of these, which changes no colours.

use ffmpeg::format::Pixel;
use ffmpeg::frame;
use ffmpeg::software::scaling;

/// What the planes hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Family {
    /// Luma and two chroma planes; `always_full`: one of JPEG's formats, which are of full range by definition.
    Yuv { always_full: bool },
    /// Luma alone.
    Grey,
    /// Green, blue, red.
    Rgb,
}

/// A planar pixel format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layout {
    pub(crate) family: Family,
    /// Bits of a sample; above 8 they are stored in 2 bytes.
    pub(crate) depth: u32,
    /// Luma samples that share a chroma sample are 2^this wide …
    pub(crate) log2_across: u32,
    /// … and high.
    pub(crate) log2_down: u32,
}

impl Layout {
    /// The layout of a planar format; `None` for others.
    pub(crate) fn of(format: Pixel) -> Option<Self> {
        let descriptor = format.descriptor()?;
        let name = descriptor.name();
        let (family, rest) = if let Some(rest) = name.strip_prefix("yuv") {
            let always_full = rest.starts_with('j');
            (Family::Yuv { always_full }, rest.trim_start_matches(['j', 'a']))
        } else if let Some(rest) = name.strip_prefix("gray") {
            (Family::Grey, rest)
        } else {
            (Family::Rgb, name.strip_prefix("gbr")?.trim_start_matches('a'))
        };
        // `420p10le`, `10le`, `p10le`: the depth follows the `p`, which packed formats (`yuyv422`) do not have.
        let bits = match family {
            Family::Yuv { .. } => rest.get(3..)?.strip_prefix('p')?,
            Family::Grey => rest,
            Family::Rgb => rest.strip_prefix('p')?,
        };
        let depth = match bits {
            "" => 8,
            bits => bits.strip_suffix("le")?.parse().ok().filter(|d| (8..=16).contains(d))?,
        };
        let across = descriptor.log2_chroma_w();
        let down = descriptor.log2_chroma_h();
        Some(Self { family, depth, log2_across: across.into(), log2_down: down.into() })
    }
}

/// Whether a format has an alpha channel.
pub(crate) fn has_alpha(format: Pixel) -> bool {
    format.descriptor().is_some_and(|d| {
        let name = d.name();
        ["yuva", "gbrap", "rgba", "bgra", "argb", "abgr", "ya8", "ya16", "ayuv", "vuya"]
            .iter()
            .any(|p| name.starts_with(p))
    })
}

/// The planar format that a packed one is rearranged into.
fn planar_twin(format: Pixel) -> Pixel {
    let name = format.descriptor().map_or("", |d| d.name());
    match name {
        "yuyv422" | "uyvy422" | "yvyu422" | "nv16" => Pixel::YUV422P,
        "nv12" | "nv21" => Pixel::YUV420P,
        "uyyvyy411" => Pixel::YUV411P,
        "nv24" | "nv42" => Pixel::YUV444P,
        "y210le" | "p210le" | "nv20le" | "yuv422p10be" => Pixel::YUV422P10LE,
        "p010le" | "p010be" | "yuv420p10be" => Pixel::YUV420P10LE,
        "ya8" | "monow" | "monob" => Pixel::GRAY8,
        "ya16le" | "ya16be" | "gray16be" | "gray10be" | "gray12be" | "gray14be" => Pixel::GRAY16LE,
        _ if name.starts_with("yuv") || name.contains("yuv") => Pixel::YUV444P16LE,
        _ => Pixel::GBRP,
    }
}

/// One plane: rows of samples.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plane<'a> {
    pub(crate) data: &'a [u8],
    pub(crate) stride: usize,
}

/// The planes of a picture: luma, Cb and Cr, or red, green and blue, or luma alone.
#[derive(Debug)]
#[expect(clippy::struct_field_names, reason = "a picture's planes are called so")]
pub(crate) struct Planes<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) layout: Layout,
    pub(crate) planes: Vec<Plane<'a>>,
}

/// Why a picture cannot be used.
pub(crate) type Reason = String;

/// Gives the planes of a picture to `use_them`.
pub(crate) fn with_planes<T>(
    frame: &frame::Video,
    use_them: impl FnOnce(&Planes<'_>) -> Result<T, Reason>,
) -> Result<T, Reason> {
    // Some raw videos are stored from the bottom up, as negative strides; the binding's slices do not hold for these.
    let upright = (0..frame.planes()).all(|i| i32::try_from(frame.stride(i)).is_ok());
    if let (Some(layout), true) = (Layout::of(frame.format()), upright) {
        return use_them(&planes(frame, layout)?);
    }
    let format = Layout::of(frame.format()).map_or_else(|| planar_twin(frame.format()), |_| frame.format());
    let (width, height) = (frame.width(), frame.height());
    let flags = scaling::Flags::POINT | scaling::Flags::ACCURATE_RND;
    let words = |e: ffmpeg::Error| format!("its pixel format cannot be read: {e}");
    let mut planar = frame::Video::empty();
    scaling::Context::get(frame.format(), width, height, format, width, height, flags)
        .and_then(|mut context| context.run(frame, &mut planar))
        .map_err(words)?;
    let layout = Layout::of(format).ok_or("its pixel format is not known")?;
    use_them(&planes(&planar, layout)?)
}

/// The family of a format, after rearranging.
pub(crate) fn family(format: Pixel) -> Family {
    let planar = Layout::of(format).or_else(|| Layout::of(planar_twin(format)));
    planar.map_or(Family::Rgb, |l| l.family)
}

fn planes(frame: &frame::Video, layout: Layout) -> Result<Planes<'_>, Reason> {
    let (width, height) = (frame.width() as usize, frame.height() as usize);
    let bytes = if layout.depth > 8 { 2 } else { 1 };
    // FFmpeg's planar RGB is green, blue, red.
    let order: &[usize] = match layout.family {
        Family::Yuv { .. } => &[0, 1, 2],
        Family::Grey => &[0],
        Family::Rgb => &[2, 0, 1],
    };
    let mut planes = Vec::with_capacity(3);
    for &index in order {
        let (mut columns, mut rows) = (width, height);
        if index > 0 && matches!(layout.family, Family::Yuv { .. }) {
            columns = width.div_ceil(1 << layout.log2_across);
            rows = height.div_ceil(1 << layout.log2_down);
        }
        if index >= frame.planes() {
            return Err("the decoder's picture lacks a plane".to_owned());
        }
        let (data, stride) = (frame.data(index), frame.stride(index));
        if rows == 0 || stride < columns * bytes || data.len() < stride * (rows - 1) + columns * bytes {
            return Err("the decoder's picture is smaller than it says".to_owned());
        }
        planes.push(Plane { data, stride });
    }
    Ok(Planes { width, height, layout, planes })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_told_apart() {
        let of = |format| Layout::of(format).map(|l| (l.family, l.depth, l.log2_across, l.log2_down));
        let yuv = Family::Yuv { always_full: false };
        assert_eq!(of(Pixel::YUV420P), Some((yuv, 8, 1, 1)));
        assert_eq!(of(Pixel::YUVJ422P), Some((Family::Yuv { always_full: true }, 8, 1, 0)));
        assert_eq!(of(Pixel::YUVA444P12LE), Some((yuv, 12, 0, 0)));
        assert_eq!(of(Pixel::GBRP10LE), Some((Family::Rgb, 10, 0, 0)));
        assert_eq!(of(Pixel::GRAY8), Some((Family::Grey, 8, 0, 0)));
        for packed in [Pixel::YUYV422, Pixel::NV12, Pixel::RGB24, Pixel::PAL8, Pixel::YUV420P10BE, Pixel::P010LE] {
            assert_eq!(of(packed), None, "{packed:?}");
            assert!(Layout::of(planar_twin(packed)).is_some(), "{packed:?}");
        }
        assert!(has_alpha(Pixel::YUVA420P) && has_alpha(Pixel::GBRAP12LE) && !has_alpha(Pixel::YUV420P));
    }
}
