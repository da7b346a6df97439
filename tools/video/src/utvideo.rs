//! Lossless coding of raw frames: the Ut Video codec, which FFmpeg (and with it players and editors) decodes.
//!
//! Each plane is predicted from its left neighbour, and the differences get a Huffman code of their own in each frame. One
//! slice a plane; the planes are coded side by side. About 2:1 on camera pictures, at several hundred 720p frames a second.

/// The planes of a Ut Video stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UtLayout {
    /// Y, U, V with halved chroma width (4:2:2).
    Yuv422,
    /// Y, U, V with halved chroma width and height (4:2:0).
    Yuv420,
    /// G, B − G, R − G.
    Rgb,
}

/// A raw picture as cameras give it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RawLayout {
    /// Y U Y V, 2 bytes a pixel.
    Yuyv,
    /// U Y V Y, 2 bytes a pixel.
    Uyvy,
    /// A plane of Y, then one of U V pairs; 1.5 bytes a pixel.
    Nv12,
    /// Planes of Y, U and V; 1.5 bytes a pixel.
    I420,
    /// One byte a pixel, full range.
    Grey,
    /// R G B.
    Rgb24,
    /// B G R.
    Bgr24,
}

impl RawLayout {
    /// Bytes of a picture without padding.
    pub fn bytes(self, width: u32, height: u32) -> usize {
        let (w, h) = (width as usize, height as usize);
        match self {
            Self::Yuyv | Self::Uyvy => 2 * w * h,
            Self::Nv12 | Self::I420 => w * h + 2 * (w / 2) * (h / 2),
            Self::Grey => w * h,
            Self::Rgb24 | Self::Bgr24 => 3 * w * h,
        }
    }

    /// Bytes of the first row without padding.
    pub fn row_bytes(self, width: u32) -> usize {
        let w = width as usize;
        match self {
            Self::Yuyv | Self::Uyvy => 2 * w,
            Self::Nv12 | Self::I420 | Self::Grey => w,
            Self::Rgb24 | Self::Bgr24 => 3 * w,
        }
    }

    /// How the picture is stored.
    pub fn stored_as(self) -> UtLayout {
        match self {
            Self::Yuyv | Self::Uyvy => UtLayout::Yuv422,
            Self::Nv12 | Self::I420 => UtLayout::Yuv420,
            // Grey as three equal channels: in Y alone its full range would be taken for a limited one.
            Self::Grey | Self::Rgb24 | Self::Bgr24 => UtLayout::Rgb,
        }
    }

    /// Whether sides of this length can be stored.
    pub fn fits(self, width: u32, height: u32) -> bool {
        let even = |side: u32| side.is_multiple_of(2);
        width > 0
            && height > 0
            && match self.stored_as() {
                UtLayout::Yuv422 => even(width),
                UtLayout::Yuv420 => even(width) && even(height),
                UtLayout::Rgb => true,
            }
    }
}

impl UtLayout {
    /// The codec's name in a container.
    pub fn fourcc(self) -> [u8; 4] {
        match self {
            Self::Yuv422 => *b"ULY2",
            Self::Yuv420 => *b"ULY0",
            Self::Rgb => *b"ULRG",
        }
    }

    /// The decoder's set-up: encoder version, source format, size of the frame info, flags (Huffman, one slice).
    pub fn extradata(self) -> [u8; 16] {
        let source = match self {
            Self::Yuv422 => *b"YUY2",
            Self::Yuv420 => *b"YV12",
            Self::Rgb => [0, 0, 1, 0x18],
        };
        let mut out = [0; 16];
        out[..4].copy_from_slice(&[1, 0, 0, 0xf0]);
        out[4..8].copy_from_slice(&source);
        out[8..12].copy_from_slice(&4u32.to_le_bytes());
        out[12..].copy_from_slice(&1u32.to_le_bytes());
        out
    }
}

/// Symbols that do not occur.
const UNUSED: u8 = 255;
/// Left prediction, in the bits of the frame info.
const FRAME_INFO: u32 = 1 << 8;
/// What stands left of the first pixel.
const BEFORE_FIRST: u8 = 0x80;

/// Encodes pictures of one size.
#[derive(Debug)]
pub struct UtEncoder {
    raw: RawLayout,
    width: usize,
    height: usize,
    planes: [Plane; 3],
}

#[derive(Debug, Default)]
struct Plane {
    residuals: Vec<u8>,
    coded: Vec<u8>,
}

impl UtEncoder {
    /// An encoder for pictures of `width`×`height` pixels; `None` for odd sides of a subsampled layout.
    pub fn new(raw: RawLayout, width: u32, height: u32) -> Option<Self> {
        let planes = Default::default();
        raw.fits(width, height).then_some(Self { raw, width: width as usize, height: height as usize, planes })
    }

    /// Appends the coded picture to `out`; false, with nothing appended, when `picture` is too short.
    pub fn encode(&mut self, picture: &[u8], out: &mut Vec<u8>) -> bool {
        let needed = self.raw.bytes(self.width as u32, self.height as u32);
        let Some(picture) = picture.get(..needed) else { return false };
        let raw = self.raw;
        let (w, h) = (self.width, self.height);
        let [a, b, c] = &mut self.planes;
        rayon::join(
            || a.encode(|residuals| first_plane(raw, picture, w, h, residuals)),
            || {
                b.encode(|residuals| other_plane(raw, picture, w, h, 0, residuals));
                c.encode(|residuals| other_plane(raw, picture, w, h, 1, residuals));
            },
        );
        out.reserve_exact(self.planes.iter().map(|p| p.coded.len()).sum::<usize>() + 4);
        for plane in &self.planes {
            out.extend_from_slice(&plane.coded);
        }
        out.extend_from_slice(&FRAME_INFO.to_le_bytes());
        true
    }
}

/// Differences from the value before, through the whole plane.
fn predict(values: impl Iterator<Item = u8>, residuals: &mut Vec<u8>) {
    let mut before = BEFORE_FIRST;
    residuals.extend(values.map(|v| {
        let difference = v.wrapping_sub(before);
        before = v;
        difference
    }));
}

fn first_plane(raw: RawLayout, picture: &[u8], w: usize, h: usize, out: &mut Vec<u8>) {
    match raw {
        RawLayout::Yuyv => predict(picture.as_chunks::<2>().0.iter().map(|p| p[0]), out),
        RawLayout::Uyvy => predict(picture.as_chunks::<2>().0.iter().map(|p| p[1]), out),
        RawLayout::Nv12 | RawLayout::I420 | RawLayout::Grey => predict(picture[..w * h].iter().copied(), out),
        RawLayout::Rgb24 | RawLayout::Bgr24 => predict(picture.as_chunks::<3>().0.iter().map(|p| p[1]), out),
    }
}

/// The second (`which` = 0: U or B − G) and third (1: V or R − G) plane.
fn other_plane(raw: RawLayout, picture: &[u8], w: usize, h: usize, which: usize, out: &mut Vec<u8>) {
    let chroma = (w / 2) * (h / 2);
    let minus_green = |p: &[u8; 3], channel: usize| p[channel].wrapping_sub(p[1]).wrapping_add(0x80);
    match raw {
        RawLayout::Yuyv => predict(picture.as_chunks::<4>().0.iter().map(|p| p[1 + 2 * which]), out),
        RawLayout::Uyvy => predict(picture.as_chunks::<4>().0.iter().map(|p| p[2 * which]), out),
        RawLayout::Nv12 => predict(picture[w * h..].as_chunks::<2>().0.iter().map(|p| p[which]), out),
        RawLayout::I420 => predict(picture[w * h + which * chroma..][..chroma].iter().copied(), out),
        RawLayout::Grey => predict(std::iter::repeat_n(0x80, w * h), out),
        RawLayout::Rgb24 => predict(picture.as_chunks::<3>().0.iter().map(|p| minus_green(p, 2 - 2 * which)), out),
        RawLayout::Bgr24 => predict(picture.as_chunks::<3>().0.iter().map(|p| minus_green(p, 2 * which)), out),
    }
}

impl Plane {
    fn encode(&mut self, fill: impl FnOnce(&mut Vec<u8>)) {
        self.residuals.clear();
        self.coded.clear();
        fill(&mut self.residuals);
        let lengths = code_lengths(&histogram(&self.residuals));
        self.coded.extend_from_slice(&lengths);
        let size_at = self.coded.len();
        self.coded.extend_from_slice(&[0; 4]);
        // A plane of one symbol needs no bits at all.
        if !lengths.contains(&0) {
            pack(&self.residuals, &codes(&lengths), &mut self.coded);
        }
        let size = (self.coded.len() - size_at - 4) as u32;
        self.coded[size_at..size_at + 4].copy_from_slice(&size.to_le_bytes());
    }
}

fn histogram(symbols: &[u8]) -> [u32; 256] {
    // Four tables: neighbours are often equal, and a counter that is written cannot be read at once.
    let mut tables = [[0u32; 256]; 4];
    let (fours, rest) = symbols.as_chunks::<4>();
    for four in fours {
        for (table, symbol) in tables.iter_mut().zip(four) {
            table[usize::from(*symbol)] += 1;
        }
    }
    for symbol in rest {
        tables[0][usize::from(*symbol)] += 1;
    }
    std::array::from_fn(|i| tables.iter().map(|t| t[i]).sum())
}

/// Lengths of a Huffman code: 0 for the only symbol, [`UNUSED`] for those that do not occur.
fn code_lengths(counts: &[u32; 256]) -> [u8; 256] {
    use std::cmp::Reverse;
    use std::collections::BinaryHeap;
    let mut lengths = [UNUSED; 256];
    // Nodes 0–255 are the symbols; `parents` leads from each node to the one that joined it.
    let mut heap: BinaryHeap<Reverse<(u64, usize)>> =
        (0..256).filter(|&s| counts[s] > 0).map(|s| Reverse((u64::from(counts[s]), s))).collect();
    if let (1, Some(Reverse((_, only)))) = (heap.len(), heap.peek()) {
        lengths[*only] = 0;
        return lengths;
    }
    let mut parents = [0usize; 512];
    let mut next = 256;
    while let (Some(Reverse((a, left))), Some(Reverse((b, right)))) = (heap.pop(), heap.pop()) {
        (parents[left], parents[right]) = (next, next);
        heap.push(Reverse((a + b, next)));
        next += 1;
        if heap.len() == 1 {
            break;
        }
    }
    let root = next - 1;
    for symbol in (0..256).filter(|&s| counts[s] > 0) {
        let (mut node, mut length) = (symbol, 0);
        while node != root {
            node = parents[node];
            length += 1;
        }
        lengths[symbol] = length;
    }
    lengths
}

/// (code, length) of each symbol: the longest codes count from 0, equal lengths from the highest symbol down.
fn codes(lengths: &[u8; 256]) -> [(u32, u32); 256] {
    let mut order: Vec<usize> = (0..256).filter(|&s| lengths[s] != UNUSED && lengths[s] > 0).collect();
    order.sort_by_key(|&s| std::cmp::Reverse((lengths[s], s)));
    let mut out = [(0, 0); 256];
    let mut next = 0u64;
    for symbol in order {
        let length = u32::from(lengths[symbol]);
        out[symbol] = ((next >> (32 - length)) as u32, length);
        next += 1 << (32 - length);
    }
    out
}

/// Bits from the most significant down, in little-endian words of 32.
fn pack(symbols: &[u8], codes: &[(u32, u32); 256], out: &mut Vec<u8>) {
    out.reserve(symbols.len());
    let (mut bits, mut count) = (0u64, 0u32);
    for &symbol in symbols {
        let (code, length) = codes[usize::from(symbol)];
        bits = (bits << length) | u64::from(code);
        count += length;
        if count >= 32 {
            count -= 32;
            out.extend_from_slice(&((bits >> count) as u32).to_le_bytes());
        }
    }
    if count > 0 {
        out.extend_from_slice(&((bits << (32 - count)) as u32).to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The slow way back, from the codec's description: planes of one coded frame.
    fn decode(coded: &[u8], sizes: [usize; 3]) -> Vec<Vec<u8>> {
        let mut at = 0;
        let planes = sizes
            .iter()
            .map(|&size| {
                let lengths: [u8; 256] = coded[at..at + 256].try_into().unwrap();
                let bytes = u32::from_le_bytes(coded[at + 256..at + 260].try_into().unwrap()) as usize;
                let words = &coded[at + 260..at + 260 + bytes];
                at += 260 + bytes;
                let bits: Vec<bool> = words
                    .chunks(4)
                    .flat_map(|w| {
                        let word = u32::from_le_bytes(w.try_into().unwrap());
                        (0..32).map(move |i| word >> (31 - i) & 1 == 1)
                    })
                    .collect();
                let only = lengths.iter().position(|&l| l == 0);
                let (mut position, mut before) = (0, BEFORE_FIRST);
                (0..size)
                    .map(|_| {
                        let symbol = only.unwrap_or_else(|| {
                            let table = codes(&lengths);
                            let (mut code, mut length) = (0u32, 0u32);
                            loop {
                                code = code << 1 | u32::from(bits[position]);
                                (position, length) = (position + 1, length + 1);
                                if let Some(s) = table.iter().position(|&(c, l)| l == length && c == code) {
                                    return s;
                                }
                            }
                        });
                        before = before.wrapping_add(symbol as u8);
                        before
                    })
                    .collect()
            })
            .collect();
        assert_eq!(&coded[at..], &FRAME_INFO.to_le_bytes());
        planes
    }

    fn noise(n: usize) -> Vec<u8> {
        (0..n as u32).map(|i| ((i.wrapping_mul(2_654_435_761) >> 20) % 40 + i % 7) as u8).collect()
    }

    #[test]
    fn every_layout_comes_back_to_the_bit() {
        let (w, h) = (8u32, 6u32);
        for raw in [
            RawLayout::Yuyv,
            RawLayout::Uyvy,
            RawLayout::Nv12,
            RawLayout::I420,
            RawLayout::Grey,
            RawLayout::Rgb24,
            RawLayout::Bgr24,
        ] {
            let picture = noise(raw.bytes(w, h));
            let mut coded = Vec::new();
            assert!(UtEncoder::new(raw, w, h).unwrap().encode(&picture, &mut coded));
            let n = (w * h) as usize;
            let chroma = match raw.stored_as() {
                UtLayout::Yuv422 => n / 2,
                UtLayout::Yuv420 => n / 4,
                UtLayout::Rgb => n,
            };
            let planes = decode(&coded, [n, chroma, chroma]);
            let plus_green = |plane: usize, i: usize| planes[plane][i].wrapping_add(planes[0][i]).wrapping_sub(0x80);
            let back: Vec<u8> = match raw {
                RawLayout::Yuyv => (0..n).flat_map(|i| [planes[0][i], planes[1 + i % 2][i / 2]]).collect(),
                RawLayout::Uyvy => (0..n).flat_map(|i| [planes[1 + i % 2][i / 2], planes[0][i]]).collect(),
                RawLayout::I420 => planes.concat(),
                RawLayout::Nv12 => {
                    let pairs = (0..n / 4).flat_map(|i| [planes[1][i], planes[2][i]]);
                    planes[0].iter().copied().chain(pairs).collect()
                }
                RawLayout::Grey => {
                    assert!((0..n).all(|i| plus_green(1, i) == planes[0][i] && plus_green(2, i) == planes[0][i]));
                    planes[0].clone()
                }
                RawLayout::Rgb24 => (0..n).flat_map(|i| [plus_green(2, i), planes[0][i], plus_green(1, i)]).collect(),
                RawLayout::Bgr24 => (0..n).flat_map(|i| [plus_green(1, i), planes[0][i], plus_green(2, i)]).collect(),
            };
            assert_eq!(back, picture, "{raw:?}");
        }
    }

    #[test]
    fn code_lengths_fill_the_code_space_even_for_wild_counts() {
        let mut counts = [0u32; 256];
        let (mut a, mut b) = (1u32, 1u32);
        for count in counts.iter_mut().take(29) {
            *count = a;
            (a, b) = (b, a + b);
        }
        let lengths = code_lengths(&counts);
        let space: f64 = lengths.iter().filter(|&&l| l != UNUSED).map(|&l| 0.5f64.powi(l.into())).sum();
        assert_eq!(space, 1.0);
        assert!(lengths.iter().all(|&l| l == UNUSED || l <= 28));
    }

    #[test]
    fn what_cannot_be_stored_is_refused() {
        assert!(UtEncoder::new(RawLayout::Yuyv, 5, 4).is_none() && UtEncoder::new(RawLayout::Nv12, 4, 5).is_none());
        let mut out = Vec::new();
        assert!(!UtEncoder::new(RawLayout::Grey, 4, 4).unwrap().encode(&[0; 15], &mut out) && out.is_empty());
    }
}
