//! The mesh of MediaPipe's landmark network: which point is which, its alignment, and the 68 points on it.

use glam::DVec3;
use risorius_formats::Similarity;
use risorius_formats::similarity::umeyama;

use crate::weights::Weights;

/// Points of the mesh, irises included.
pub const MESH_POINTS: usize = 478;

/// x right, y down, z away from the camera: pixels of the picture.
pub type Mesh = [[f32; 3]; MESH_POINTS];

/// Outer corner of the image-left eye.
pub const LEFT_EYE: usize = 33;
/// Outer corner of the image-right eye.
pub const RIGHT_EYE: usize = 263;

/// The point of the mesh nearest to each of the 68 points in iBUG order.
pub const POINT_OF_LANDMARK: [u16; 68] = [
    127, 234, 93, 132, 58, 136, 150, 176, 152, 400, 379, 365, 288, 361, 323, 454, 356, 70, 63, 105, 66, 107, 336, 296,
    334, 293, 300, 168, 197, 5, 4, 98, 97, 2, 326, 327, 33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380, 61,
    39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181, 78, 81, 13, 311, 308, 402, 14, 178,
];

/// The points that the blendshape network reads, in its order.
pub const BLENDSHAPE_POINTS: [u16; 146] = [
    0, 1, 4, 5, 6, 7, 8, 10, 13, 14, 17, 21, 33, 37, 39, 40, 46, 52, 53, 54, 55, 58, 61, 63, 65, 66, 67, 70, 78, 80,
    81, 82, 84, 87, 88, 91, 93, 95, 103, 105, 107, 109, 127, 132, 133, 136, 144, 145, 146, 148, 149, 150, 152, 153,
    154, 155, 157, 158, 159, 160, 161, 162, 163, 168, 172, 173, 176, 178, 181, 185, 191, 195, 197, 234, 246, 249, 251,
    263, 267, 269, 270, 276, 282, 283, 284, 285, 288, 291, 293, 295, 296, 297, 300, 308, 310, 311, 312, 314, 317, 318,
    321, 323, 324, 332, 334, 336, 338, 356, 361, 362, 365, 373, 374, 375, 377, 378, 379, 380, 381, 382, 384, 385, 386,
    387, 388, 389, 390, 397, 398, 400, 402, 405, 409, 415, 454, 466, 468, 469, 470, 471, 472, 473, 474, 475, 476, 477,
];

/// Points that move with the skull rather than with the expression: what the mesh is aligned by.
pub const STABLE: [u16; 27] = [
    33, 133, 263, 362, 168, 6, 197, 195, 5, 4, 1, 98, 327, 10, 151, 9, 8, 67, 297, 109, 338, 127, 356, 234, 454, 103,
    332,
];

/// A point in the picture.
pub fn flat(mesh: &Mesh, point: usize) -> [f32; 2] {
    [mesh[point][0], mesh[point][1]]
}

fn solid(point: [f32; 3]) -> DVec3 {
    DVec3::from(point.map(f64::from))
}

/// `canonical_from_picture`: turns, scales and moves a mesh onto the canonical one, whose outer eye corners are 1 apart.
///
/// `None` where the stable points coincide, or the eyes are no more than a pixel apart.
pub fn alignment(mesh: &Mesh, weights: &Weights) -> Option<Similarity> {
    let eyes = solid(mesh[LEFT_EYE]).distance(solid(mesh[RIGHT_EYE]));
    if !eyes.is_finite() || eyes <= 1.0 {
        return None;
    }
    let pair = |i: &u16| (solid(weights.canonical[usize::from(*i)]), solid(mesh[usize::from(*i)]));
    let pairs: Vec<(DVec3, DVec3)> = STABLE.iter().map(pair).collect();
    umeyama(&pairs, true).map(|fit| fit.a_from_b).filter(|s| s.scale > 0.0 && s.scale.is_finite())
}

/// The 68 points in the picture: those of the mesh, each moved by its own offset, which stands fixed on the aligned face.
///
/// The mesh's points are near the 68 but not the same: the offsets come from rendered faces whose 68 points are known.
pub fn landmarks68(mesh: &Mesh) -> [[f32; 2]; 68] {
    let weights = Weights::get();
    let Some(canonical_from_picture) = alignment(mesh, weights) else {
        return POINT_OF_LANDMARK.map(|i| flat(mesh, usize::from(i)));
    };
    let picture_from_canonical = canonical_from_picture.rotation.transpose() * (1.0 / canonical_from_picture.scale);
    std::array::from_fn(|i| {
        let offset = picture_from_canonical * solid(weights.point_offsets[i]);
        let [x, y] = flat(mesh, usize::from(POINT_OF_LANDMARK[i]));
        [x + offset.x as f32, y + offset.y as f32]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3::rotation_exp;

    /// The canonical mesh, turned and placed in a picture.
    fn turned(turn: DVec3, size_px: f64) -> Mesh {
        let rotation = rotation_exp(turn);
        std::array::from_fn(|i| {
            let p = rotation * solid(Weights::get().canonical[i]) * size_px + DVec3::new(300.0, 200.0, 5.0);
            [p.x as f32, p.y as f32, p.z as f32]
        })
    }

    #[test]
    fn a_turned_mesh_is_aligned_again() {
        let mesh = turned(DVec3::new(0.2, -0.7, 0.3), 150.0);
        let alignment = alignment(&mesh, Weights::get()).unwrap();
        assert!((alignment.scale * 150.0 - 1.0).abs() < 1e-5);
        let back = alignment.transform_point(solid(mesh[13]));
        assert!((back - solid(Weights::get().canonical[13])).length() < 1e-5);
    }

    #[test]
    fn offsets_turn_with_the_face_and_mirror() {
        let upright = landmarks68(&turned(DVec3::ZERO, 100.0));
        // A quarter turn in the picture: (x, y) about the middle becomes (−y, x).
        let rolled = landmarks68(&turned(DVec3::Z * std::f64::consts::FRAC_PI_2, 100.0));
        for (a, b) in upright.iter().zip(&rolled) {
            assert!((300.0 - (a[1] - 200.0) - b[0]).abs() < 1e-2 && (200.0 + (a[0] - 300.0) - b[1]).abs() < 1e-2);
        }
        let offsets = &Weights::get().point_offsets;
        for i in 0..68 {
            let mirrored = offsets[risorius_formats::landmarks::mirror_of(i)];
            assert!((offsets[i][0] + mirrored[0]).abs() < 1e-6 && (offsets[i][1] - mirrored[1]).abs() < 1e-6);
        }
    }

    #[test]
    fn a_collapsed_mesh_has_no_alignment_but_points() {
        let mesh = [[7.0; 3]; MESH_POINTS];
        assert!(alignment(&mesh, Weights::get()).is_none());
        assert_eq!(landmarks68(&mesh), [[7.0; 2]; 68]);
    }
}
