//! What each fuzz target does with its bytes. The first byte chooses the parser, so that one corpus serves a family.

use std::collections::BTreeMap;

use risorius_formats::attribute::AttributeTable;
use risorius_formats::colmap::{ModelCamera, ModelImage, Point3d};
use risorius_formats::curves::Curves;
use risorius_formats::intensities::Intensities;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Polygons};
use risorius_formats::views::ViewList;
use risorius_formats::{Intensity, Silent, TakeManifest, colmap, frame, openface};

/// OpenFace tables, curves, frames, intensities.
pub fn tables(choice: u8, bytes: &[u8]) {
    match choice % 4 {
        0 => {
            if let Ok(track) = openface::parse(bytes, &openface::ReadOptions::default(), &Silent) {
                assert!(track.rows.iter().flat_map(|r| &r.intensities).flatten().all(|v| (0.0..=5.0).contains(v)));
                let _ = Curves::from_track(&track, 0.5);
                let _ = openface::to_bytes(&track);
            }
        }
        1 => {
            if let Ok(curves) = Curves::parse(bytes, &Silent) {
                assert!(curves.fps().is_finite());
                assert!(curves.rows.iter().flatten().flatten().all(|v| (0.0..=5.0).contains(v)));
            }
        }
        2 => drop(frame::parse_frames(bytes)),
        _ => {
            if let Ok(table) = Intensities::parse(bytes) {
                assert!(table.rows.values().flatten().all(|v| v.is_finite()));
            }
        }
    }
}

/// COLMAP models, text and binary; what was read is the same once more when it is written as text.
pub fn colmap(choice: u8, bytes: &[u8]) {
    match choice % 6 {
        0 => drop(colmap::parse_cameras_text(bytes).map(|c| cameras(&c))),
        1 => drop(colmap::parse_images_text(bytes).map(|i| images(&i))),
        2 => drop(colmap::parse_points_text(bytes).map(|p| points(&p))),
        3 => drop(colmap::parse_cameras_binary(bytes).map(|c| cameras(&c))),
        4 => drop(colmap::parse_images_binary(bytes).map(|i| images(&i))),
        _ => drop(colmap::parse_points_binary(bytes).map(|p| points(&p))),
    }
}

fn cameras(cameras: &BTreeMap<u32, ModelCamera>) {
    for camera in cameras.values() {
        let _ = camera.intrinsics();
    }
    assert_eq!(colmap::parse_cameras_text(&colmap::cameras_to_text(cameras)).ok().as_ref(), Some(cameras));
}

fn images(images: &BTreeMap<u32, ModelImage>) {
    assert!(images.values().all(|i| i.camera_from_world.orthonormality_error() < 1e-6));
    // Some names cannot stand in a text.
    let Ok(text) = colmap::images_to_text(images) else { return };
    let again = colmap::parse_images_text(&text).unwrap();
    assert!(again.keys().eq(images.keys()));
    for (a, b) in again.values().zip(images.values()) {
        let (turned, meant) = (a.camera_from_world.rotation, b.camera_from_world.rotation);
        assert!(turned.abs_diff_eq(meant, 1e-9), "{turned} instead of {meant}");
        assert_eq!(a.camera_from_world.translation, b.camera_from_world.translation);
        assert_eq!((&a.name, a.camera_id, &a.points), (&b.name, b.camera_id, &b.points));
    }
}

fn points(points: &BTreeMap<u64, Point3d>) {
    let again = colmap::parse_points_text(&colmap::points_to_text(points)).unwrap();
    assert!(again.keys().eq(points.keys()));
    for (a, b) in again.values().zip(points.values()) {
        assert_eq!((a.position, a.rgb, &a.track), (b.position, b.rgb, &b.track));
    }
}

/// Cameras, views, outlines.
pub fn json(choice: u8, bytes: &[u8]) {
    match choice % 3 {
        0 => {
            if let Ok(camera) = nerfies::parse_camera(bytes) {
                let direction = camera.ray_direction(glam_vec(10.5, 20.5));
                assert!(direction.is_none_or(|d| (d.length() - 1.0).abs() < 1e-9));
            }
        }
        1 => drop(ViewList::parse(bytes)),
        _ => {
            if let Ok(outlines) = Polygons::parse(bytes) {
                let image = outlines.label_image(&[("AU01", 1), ("AU12", 2)], 1, 64, 48);
                assert!(image.labels.iter().all(|&l| l < 3));
            }
        }
    }
}

fn glam_vec<T: From<[f64; 2]>>(x: f64, y: f64) -> T {
    T::from([x, y])
}

/// TOML, YAML, label images.
pub fn text(choice: u8, bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    match choice % 5 {
        0 => drop(TakeManifest::parse(&text)),
        1 => {
            if let Ok(table) = AttributeTable::parse(&text) {
                assert!(table.attributes.iter().all(|a| a.scale().attribute(Intensity(2.0)).0.is_finite()));
            }
        }
        2 => drop(nerfies::parse_annotations(bytes, 17)),
        3 => drop(nerfies::parse_mapping(bytes)),
        _ => drop(LabelImage::parse_png(bytes)),
    }
}
