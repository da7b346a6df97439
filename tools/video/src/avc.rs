//! H.264 as cameras send it (Annex B, start codes) to H.264 as MP4 files hold it (lengths, parameter sets aside).

/// One access unit, taken apart.
#[derive(Debug, Default)]
pub struct AccessUnit {
    /// NAL units, each behind its length of four bytes; parameter sets and delimiters are left out.
    pub payload: Vec<u8>,
    /// Whether decoding can begin here.
    pub is_keyframe: bool,
    /// `avcC`, when the unit carries both parameter sets.
    pub config: Option<Vec<u8>>,
}

/// The NAL units between start codes of three or four bytes.
fn nal_units(bytes: &[u8]) -> Vec<&[u8]> {
    let mut starts = Vec::new();
    let mut i = 0;
    while i + 3 <= bytes.len() {
        if bytes[i..i + 3] == [0, 0, 1] {
            starts.push(i + 3);
            i += 3;
        } else {
            i += 1;
        }
    }
    let ends = starts.iter().skip(1).map(|s| s - 3).chain([bytes.len()]);
    let trim = |unit: &'_ [u8]| unit.iter().rposition(|&b| b != 0).map_or(0, |last| last + 1);
    starts
        .iter()
        .zip(ends)
        .map(|(&from, to)| &bytes[from..to])
        .map(|u| &u[..trim(u)])
        .filter(|u| !u.is_empty())
        .collect()
}

/// Takes a unit apart; bytes without a start code give an empty payload.
pub fn access_unit(bytes: &[u8]) -> AccessUnit {
    let mut out = AccessUnit::default();
    let (mut sps, mut pps) = (None, None);
    for unit in nal_units(bytes) {
        match unit[0] & 0x1f {
            7 => sps = Some(unit),
            8 => pps = Some(unit),
            9 => {}
            kind => {
                out.is_keyframe |= kind == 5;
                out.payload.extend_from_slice(&(unit.len() as u32).to_be_bytes());
                out.payload.extend_from_slice(unit);
            }
        }
    }
    out.config = sps.zip(pps).and_then(|(sps, pps)| config(sps, pps));
    out
}

/// `AVCDecoderConfigurationRecord` with one parameter set of each kind.
fn config(sps: &[u8], pps: &[u8]) -> Option<Vec<u8>> {
    let profile = sps.get(1..4)?;
    let mut out = vec![1, profile[0], profile[1], profile[2], 0xff, 0xe1];
    out.extend_from_slice(&u16::try_from(sps.len()).ok()?.to_be_bytes());
    out.extend_from_slice(sps);
    out.push(1);
    out.extend_from_slice(&u16::try_from(pps.len()).ok()?.to_be_bytes());
    out.extend_from_slice(pps);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_keyframe_gives_its_parameter_sets_and_a_length_before_each_slice() {
        let bytes = [
            &[0, 0, 0, 1, 0x09, 0x10][..],
            &[0, 0, 0, 1, 0x67, 0x42, 0xc0, 0x1f, 0x99],
            &[0, 0, 1, 0x68, 0xce],
            &[0, 0, 1, 0x65, 1, 2, 0, 0, 3],
            &[0, 0, 0, 1, 0x65, 9],
        ]
        .concat();
        let unit = access_unit(&bytes);
        assert!(unit.is_keyframe);
        assert_eq!(unit.payload, [0, 0, 0, 6, 0x65, 1, 2, 0, 0, 3, 0, 0, 0, 2, 0x65, 9]);
        let expected = [1, 0x42, 0xc0, 0x1f, 0xff, 0xe1, 0, 5, 0x67, 0x42, 0xc0, 0x1f, 0x99, 1, 0, 2, 0x68, 0xce];
        assert_eq!(unit.config.as_deref(), Some(&expected[..]));
        let later = access_unit(&[0, 0, 1, 0x41, 7]);
        assert_eq!((later.is_keyframe, later.config, later.payload), (false, None, vec![0, 0, 0, 2, 0x41, 7]));
        assert!(access_unit(&[0xff, 0xd8, 1]).payload.is_empty());
    }
}
