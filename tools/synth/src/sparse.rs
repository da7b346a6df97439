//! The exact cameras as a COLMAP model, with points on what does not move.

use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::colmap::{Model, ModelCamera, ModelImage, Point2d, Point3d};
use risorius_formats::{Camera, FrameIndex};

use crate::mesh::Material;
use crate::render::RenderedView;
use crate::scene::Scene;

/// Collects which points each frame sees.
pub(crate) struct SparseModel {
    points: Vec<(DVec3, [u8; 3])>,
    model: Model,
}

/// How much nearer than a point the picture may be before the point counts as hidden, metres.
const HIDDEN_BY: f64 = 0.008;

impl SparseModel {
    /// About `count` points: a third on parts of the head that never move, the others on the room.
    pub(crate) fn new(scene: &Scene, camera: &Camera, count: usize, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xe4);
        let mut points = Vec::with_capacity(count);
        let head: Vec<DVec3> = scene.resting_points();
        for _ in 0..count / 3 {
            points.push((head[rng.random_range(0..head.len())], [200, 160, 140]));
        }
        // The room is seen through rays from the middle camera, spread wider than its picture.
        let from = camera.center();
        while points.len() < count {
            let (x, y) = (rng.random_range(-1.1f64..1.1), rng.random_range(-0.75f64..0.75));
            let direction = DVec3::new(x, y, -1.0).normalize();
            let (t, colour) = scene.room.look(from.as_vec3(), direction.as_vec3());
            points.push((from + direction * f64::from(t), crate::shade::encode(colour)));
        }
        let mut model = Model::default();
        model.cameras.insert(1, ModelCamera::from_intrinsics(&camera.intrinsics));
        Self { points, model }
    }

    /// Adds a frame and what it sees.
    pub(crate) fn add(&mut self, frame: u32, camera: &Camera, view: &RenderedView) {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let id = frame + 1;
        let mut seen = Vec::new();
        for (index, (point, rgb)) in self.points.iter().enumerate() {
            let in_camera = camera.camera_from_world.transform_point(*point);
            let pixel = camera.intrinsics.project(in_camera);
            let inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < f64::from(width) && pixel.y < f64::from(height);
            if in_camera.z <= 0.05 || !inside {
                continue;
            }
            let there = view.depth[pixel.y as usize * width as usize + pixel.x as usize];
            if f64::from(there) < in_camera.z - HIDDEN_BY {
                continue;
            }
            let point3d = index as u64 + 1;
            let entry = self.model.points.entry(point3d).or_insert_with(|| Point3d {
                position: *point,
                rgb: *rgb,
                error_px: 0.0,
                track: Vec::new(),
            });
            entry.track.push((id, seen.len() as u32));
            seen.push(Point2d { position_px: [pixel.x, pixel.y], point3d: Some(point3d) });
        }
        self.model.images.insert(
            id,
            ModelImage {
                camera_from_world: camera.camera_from_world,
                camera_id: 1,
                name: FrameIndex(frame).image_name(),
                points: seen,
            },
        );
    }

    /// The model.
    pub(crate) fn finish(self) -> Model {
        self.model
    }
}

impl Scene {
    /// Points of the head that no expression moves, in the world (the head at rest).
    fn resting_points(&self) -> Vec<DVec3> {
        let still = |part: &&crate::scene::Part| matches!(part.mesh.material, Material::Head | Material::Ear);
        let stretch = self.person.proportions;
        let of_part = |part: &crate::scene::Part| {
            let mesh = &part.mesh;
            let keep = |&i: &usize| mesh.label[i] == 0 && mesh.position[i].y > -0.05 && mesh.position[i].z > -0.06;
            (0..mesh.position.len()).filter(keep).map(|i| (mesh.position[i] * stretch).as_dvec3()).collect::<Vec<_>>()
        };
        self.meshes.iter().filter(still).flat_map(of_part).collect()
    }
}
