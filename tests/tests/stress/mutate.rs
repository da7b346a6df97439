//! Deterministic mutations of files: what a bad disk, a careless editor or somebody with intent would make of them.

use rand::Rng as _;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;

/// What stands in the place of numbers in text.
const WORDS: [&str; 26] = [
    "nan",
    "NaN",
    "inf",
    "-inf",
    "1e999",
    "-1e999",
    "1e308",
    "1e-320",
    "-0",
    "0",
    "-1",
    "1",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "18446744073709551616",
    "9223372036854775807",
    "-9223372036854775808",
    "",
    "null",
    "true",
    "\"x\"",
    "[]",
    "{}",
    "../../x",
    "\u{0}",
];
/// What stands in the place of numbers in bytes.
const WHOLES: [u64; 9] = [0, 1, 0x7f, 0xff, 0x7fff_ffff, 0xffff_ffff, 0x1_0000_0000, 0x7fff_ffff_ffff_ffff, u64::MAX];

/// The mutation number `n` of one of the seeds: always the same for the same number.
pub(crate) fn mutation(seeds: &[Vec<u8>], n: u64) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(n);
    let mut bytes = seeds[rng.random_range(0..seeds.len())].clone();
    let count = 1 + rng.random_range(0u32..4).pow(2) / 2;
    for _ in 0..count {
        once(&mut bytes, seeds, &mut rng);
    }
    bytes
}

fn once(bytes: &mut Vec<u8>, seeds: &[Vec<u8>], rng: &mut ChaCha8Rng) {
    if bytes.is_empty() {
        bytes.push(rng.random());
        return;
    }
    let at = rng.random_range(0..bytes.len());
    let length = rng.random_range(1..=64usize).min(bytes.len() - at);
    match rng.random_range(0..12u32) {
        0 => bytes[at] ^= 1 << rng.random_range(0..8u32),
        1 => bytes[at] = rng.random(),
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..at + length)),
        4 => {
            let piece = bytes[at..at + length].to_vec();
            let to = rng.random_range(0..=bytes.len());
            bytes.splice(to..to, piece);
        }
        5 => {
            let other = &seeds[rng.random_range(0..seeds.len())];
            if !other.is_empty() {
                let from = rng.random_range(0..other.len());
                let piece = other[from..(from + length).min(other.len())].to_vec();
                bytes.splice(at..at, piece);
            }
        }
        6 | 7 => number(bytes, at, rng),
        8 => {
            let whole = WHOLES[rng.random_range(0..WHOLES.len())].to_le_bytes();
            let width = [1, 2, 4, 8][rng.random_range(0..4usize)].min(bytes.len() - at);
            bytes[at..at + width].copy_from_slice(&whole[..width]);
        }
        9 => {
            // A line moves, or stands there twice.
            let start = bytes[..at].iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
            let end = bytes[at..].iter().position(|&b| b == b'\n').map_or(bytes.len(), |i| at + i + 1);
            let line = bytes[start..end].to_vec();
            if rng.random() {
                bytes.drain(start..end);
            }
            let to = rng.random_range(0..=bytes.len());
            bytes.splice(to..to, line);
        }
        10 => {
            let filler = [b' ', b',', b'\n', b'"', b'{', b'[', 0, 0xff][rng.random_range(0..8usize)];
            bytes.splice(at..at, std::iter::repeat_n(filler, length * 8));
        }
        _ => bytes.splice(at..at, rng.random::<[u8; 4]>()).for_each(drop),
    }
}

/// Puts a word in the place of the next number.
fn number(bytes: &mut Vec<u8>, at: usize, rng: &mut ChaCha8Rng) {
    let digit = |b: &u8| b.is_ascii_digit() || matches!(b, b'-' | b'.' | b'e' | b'E' | b'+');
    let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit).map(|i| at + i) else { return };
    let end = bytes[start..].iter().position(|b| !digit(b)).map_or(bytes.len(), |i| start + i);
    bytes.splice(start..end, WORDS[rng.random_range(0..WORDS.len())].bytes());
}
