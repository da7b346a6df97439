//! The text layout.

use super::*;

#[test]
fn text_tolerates_what_real_files_show() {
    let cameras = "# c\r\n\r\n3 SIMPLE_RADIAL 640 480 500 320 240 -0.1\r\n4 TOMORROWS_MODEL 640 480 1 2 3\r\n";
    let cameras = parse_cameras_text(cameras.as_bytes()).unwrap();
    assert_eq!(cameras[&3].params, [500.0, 320.0, 240.0, -0.1]);
    assert_eq!(cameras[&4].intrinsics().unwrap_err().kind(), ErrorKind::Unsupported);
    let images = "\n# two lines each\r\n1 1 0 0 0 1 2 3 3 my face 01.png\r\n\r\n2 2 0 0 0 0 0 0 3 b.png\r\n1 2 -1 3.5 4 18446744073709551615 5 6 8\r\n\r\n# end\r\n7 1 0 0 0 0 0 0 3 last.png";
    let images = parse_images_text(images.as_bytes()).unwrap();
    assert_eq!(images.keys().copied().collect::<Vec<_>>(), [1, 2, 7]);
    assert_eq!(images[&1].name, "my face 01.png");
    assert_eq!(images[&2].camera_from_world.rotation, glam::DMat3::IDENTITY);
    assert_eq!(images[&2].points.iter().map(|p| p.point3d).collect::<Vec<_>>(), [None, None, Some(8)]);
    assert!(images[&1].points.is_empty() && images[&7].points.is_empty());
    let points = parse_points_text(b"5 1 2 3 4 5 6 nan\n6 1e-3 -2 3 255 0 0 0.5 1 2 3 4 5 6").unwrap();
    assert!(points[&5].error_px.is_nan() && points[&5].track.is_empty());
    assert_eq!(points[&6].track, [(1, 2), (3, 4), (5, 6)]);
}

#[test]
fn text_errors_say_where() {
    let cases: [(Result<()>, u64, &str); 9] = [
        (
            parse_cameras_text(b"#\n1 PINHOLE 640 x 1 2 3 4").map(drop),
            2,
            "column `HEIGHT`: expected a whole number, found `x`",
        ),
        (
            parse_cameras_text(b"1 PINHOLE 640 480 1 2 3").map(drop),
            1,
            "camera model `PINHOLE` has 4 parameters, found 3",
        ),
        (
            parse_cameras_text(b"1 PINHOLE 6 4 1 2 3 4\n1 PINHOLE 6 4 1 2 3 4").map(drop),
            2,
            "camera `1` stands there twice",
        ),
        (
            parse_cameras_text(b"1 PINHOLE 6 4 1 2 inf 4").map(drop),
            1,
            "column `PARAMS`: expected a finite number, found `inf`",
        ),
        (
            parse_images_text(b"1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1").map(drop),
            3,
            "the line ends where NAME should stand",
        ),
        (parse_images_text(b"1 0 0 0 0 0 0 0 1 a.png").map(drop), 1, "rotation `[0.0, 0.0, 0.0, 0.0]`"),
        (
            parse_images_text(b"1 1 0 0 0 0 0 0 1 a.png\n2 1 0 0 0 0 0 0 1 b.png").map(drop),
            2,
            "column `X`: expected a number, found `b.png`",
        ),
        (parse_points_text(b"\n\n1 1 2 3 4 5 256 1").map(drop), 3, "column `B`: expected a whole number, found `256`"),
        (parse_points_text(b"1 1 2 3 4 5 6 1 7").map(drop), 1, "the line ends where POINT2D_IDX should stand"),
    ];
    for (result, line, message) in cases {
        let error = result.unwrap_err();
        assert_eq!(error.line(), Some(line), "{error}");
        assert!(error.to_string().contains(message), "{error}");
    }
}
