//! Members of wheels (ZIP) and of source packages (tar, gzip): as much of the formats as PyPI's files use.

use std::io::Read as _;

use flate2::read::{DeflateDecoder, GzDecoder};

/// No member is larger.
const MOST_BYTES: u64 = 1 << 30;
const END_OF_DIRECTORY: &[u8] = b"PK\x05\x06";
const DIRECTORY_ENTRY: &[u8] = b"PK\x01\x02";
const STORED: u16 = 0;
const DEFLATED: u16 = 8;
const TAR_BLOCK: usize = 512;

fn u16_at(data: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(data.get(at..at + 2)?.try_into().ok()?))
}

fn u32_at(data: &[u8], at: usize) -> Option<usize> {
    Some(u32::from_le_bytes(data.get(at..at + 4)?.try_into().ok()?) as usize)
}

/// The bytes of the first member of a ZIP file whose name `wanted` takes.
pub(super) fn member_of_zip(zip: &[u8], wanted: impl Fn(&str) -> bool) -> Option<Vec<u8>> {
    let end = zip.windows(4).rposition(|w| w == END_OF_DIRECTORY)?;
    let (count, mut at) = (u16_at(zip, end + 10)?, u32_at(zip, end + 16)?);
    for _ in 0..count {
        if zip.get(at..at + 4)? != DIRECTORY_ENTRY {
            return None;
        }
        let (method, packed, place) = (u16_at(zip, at + 10)?, u32_at(zip, at + 20)?, u32_at(zip, at + 42)?);
        let lengths = [28, 30, 32].map(|field| u16_at(zip, at + field).map(usize::from));
        let [Some(name), Some(extra), Some(comment)] = lengths else { return None };
        let path = std::str::from_utf8(zip.get(at + 46..at + 46 + name)?).ok()?;
        if wanted(path) {
            // The local header has lengths of its own.
            let begin = place + 30 + usize::from(u16_at(zip, place + 26)?) + usize::from(u16_at(zip, place + 28)?);
            let data = zip.get(begin..begin.checked_add(packed)?)?;
            return match method {
                STORED => Some(data.to_vec()),
                DEFLATED => {
                    let mut out = Vec::new();
                    DeflateDecoder::new(data).take(MOST_BYTES).read_to_end(&mut out).ok()?;
                    Some(out)
                }
                _ => None,
            };
        }
        at += 46 + name + extra + comment;
    }
    None
}

/// The bytes of the first member of a gzipped tar file whose name ends like this.
pub(super) fn member_of_tar_gz(archive: &[u8], ending: &str) -> Option<Vec<u8>> {
    let mut tar = GzDecoder::new(archive).take(MOST_BYTES);
    loop {
        let mut header = [0; TAR_BLOCK];
        tar.read_exact(&mut header).ok()?;
        let text = |range: std::ops::Range<usize>| {
            let field = &header[range];
            let end = field.iter().position(|&b| b == 0).unwrap_or(field.len());
            std::str::from_utf8(&field[..end]).map(str::trim).ok()
        };
        let (name, size) = (text(0..100)?, text(124..136)?);
        if name.is_empty() {
            return None;
        }
        let size = usize::from_str_radix(size, 8).ok()?;
        let mut data = vec![0; size.next_multiple_of(TAR_BLOCK)];
        tar.read_exact(&mut data).ok()?;
        if name.ends_with(ending) {
            data.truncate(size);
            return Some(data);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    #[test]
    fn what_is_cut_or_foreign_has_no_members() {
        assert!(member_of_zip(b"", |_| true).is_none());
        assert!(member_of_zip(b"PK\x05\x06 and no more", |_| true).is_none());
        assert!(member_of_tar_gz(b"no gzip", "x").is_none());
    }

    #[test]
    fn a_member_of_a_tar_is_found_by_its_ending() {
        let mut header = [0u8; TAR_BLOCK];
        header[..7].copy_from_slice(b"a/b.txt");
        header[124..135].copy_from_slice(b"00000000005");
        let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gz.write_all(&header).unwrap();
        let mut block = [0u8; TAR_BLOCK];
        block[..5].copy_from_slice(b"hello");
        gz.write_all(&block).unwrap();
        gz.write_all(&[0; 2 * TAR_BLOCK]).unwrap();
        let archive = gz.finish().unwrap();
        assert_eq!(member_of_tar_gz(&archive, "/b.txt").unwrap(), b"hello");
        assert!(member_of_tar_gz(&archive, "/c.txt").is_none());
    }
}
