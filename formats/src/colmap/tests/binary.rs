//! The binary layout.

use super::*;

pub(super) fn binary_parts(model: &Model) -> [Vec<u8>; 3] {
    [
        cameras_to_binary(&model.cameras).unwrap(),
        images_to_binary(&model.images).unwrap(),
        points_to_binary(&model.points),
    ]
}

pub(super) fn parse_part(part: usize, bytes: &[u8]) -> Result<()> {
    match part {
        0 => parse_cameras_binary(bytes).map(drop),
        1 => parse_images_binary(bytes).map(drop),
        _ => parse_points_binary(bytes).map(drop),
    }
}

#[test]
fn binary_files_cut_off_anywhere_are_errors() {
    for (part, bytes) in binary_parts(&small_model()).iter().enumerate() {
        parse_part(part, bytes).unwrap();
        for length in 0..bytes.len() {
            let error = parse_part(part, &bytes[..length]).unwrap_err();
            assert!(error.to_string().starts_with("byte "), "{error}");
        }
        let mut long = bytes.clone();
        long.push(0);
        assert!(parse_part(part, &long).unwrap_err().to_string().contains("1 bytes follow the last record"));
    }
}

#[test]
fn hostile_counts_are_refused_before_they_cost_memory() {
    for (part, bytes) in binary_parts(&small_model()).into_iter().enumerate() {
        for count in [u64::MAX, u64::MAX / 24, 1 << 40, 1 << 32, 1000] {
            let mut hostile = bytes.clone();
            hostile[..8].copy_from_slice(&count.to_le_bytes());
            let error = parse_part(part, &hostile).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::Limits, "{error}");
            assert!(error.to_string().starts_with(&format!("byte 0: `{count}` ")), "{error}");
        }
    }
    // The same for the counts within a record: the last eight bytes of an image and of a point without any.
    let mut model = small_model();
    model.images.get_mut(&12).unwrap().points.clear();
    let [_, images, points] = binary_parts(&model);
    for (part, mut bytes) in [(1, images), (2, points)] {
        let end = bytes.len();
        bytes[end - 8..].copy_from_slice(&u64::MAX.to_le_bytes());
        let error = parse_part(part, &bytes).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Limits);
        assert!(error.to_string().starts_with(&format!("byte {}: ", end - 8)), "{error}");
    }
}

#[test]
fn binary_errors_say_where() {
    let [mut cameras, mut images, _] = binary_parts(&small_model());
    cameras[12..16].copy_from_slice(&99i32.to_le_bytes());
    let error = parse_cameras_binary(&cameras).unwrap_err();
    assert_eq!(
        (error.kind(), error.to_string()),
        (ErrorKind::Unsupported, "byte 12: `99` is no known camera model".to_owned())
    );
    images[12..20].copy_from_slice(&f64::NAN.to_le_bytes());
    assert!(parse_images_binary(&images).unwrap_err().to_string().starts_with("byte 12: expected a finite number"));
    images[12..44].fill(0);
    assert!(parse_images_binary(&images).unwrap_err().to_string().starts_with("byte 12: rotation"));
}
