//! A person in a room, ready to be rendered with any camera and expression.

use glam::Vec3;
use risorius_formats::{Camera, Isometry};

use crate::expression::{Expression, FaceState, Mouth};
use crate::face;
use crate::mesh::{self, Material, Mesh};
use crate::person::Person;
use crate::render::{self, RenderedView};
use crate::room::Room;

/// A mesh with its triangles.
pub(crate) struct Part {
    pub(crate) mesh: Mesh,
    pub(crate) triangles: Vec<[u32; 3]>,
    /// Per triangle, whether an eye or the mouth may open in it.
    pub(crate) may_open: Vec<bool>,
    /// Vertices whose position or normal an expression may change.
    movable: Vec<u32>,
}

impl Part {
    fn new(mesh: Mesh) -> Self {
        let mut triangles = Vec::with_capacity(mesh.rest.len() * 2);
        let last = if mesh.closed { mesh.columns } else { mesh.columns - 1 };
        for row in 0..mesh.rows - 1 {
            for column in 0..last {
                let corner = |c, r| mesh.index(column + c, row + r) as u32;
                let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        let opening = |&i: &u32| {
            let p = mesh.rest[i as usize];
            match mesh.label[i as usize] {
                face::EYE_LABEL => p.x.abs() < 0.050,
                face::MOUTH_LABEL => p.x.abs() < 0.046 && (p.y - Mouth::HEIGHT).abs() < 0.033 && p.z > 0.040,
                _ => false,
            }
        };
        let is_head = mesh.material == Material::Head;
        let may_open = triangles.iter().map(|t| is_head && t.iter().any(opening)).collect();
        let movable = if is_head {
            (0..mesh.rest.len() as u32).filter(|&i| mesh.label[i as usize] != 0).collect()
        } else {
            Vec::new()
        };
        Self { mesh, triangles, may_open, movable }
    }
}

/// A person in a room.
pub struct Scene {
    pub(crate) person: Person,
    pub(crate) meshes: Vec<Part>,
    pub(crate) room: Room,
}

impl Scene {
    /// Builds the head and its surroundings; takes a few tenths of a second.
    pub fn new(person: Person, room_seed: u32) -> Self {
        let mut meshes = vec![mesh::head(&person)];
        for side in [1.0, -1.0] {
            meshes.push(mesh::ear(&person, side));
            meshes.push(mesh::eyeball(side));
        }
        meshes.extend(mesh::mouth_parts());
        meshes.push(mesh::body(&person));
        Self { person, meshes: meshes.into_iter().map(Part::new).collect(), room: Room { seed: room_seed } }
    }

    /// The person.
    pub fn person(&self) -> &Person {
        &self.person
    }

    /// A picture by `camera` of the person with `expression`, the head at rest in the world.
    pub fn render(&self, camera: &Camera, expression: &Expression) -> RenderedView {
        self.render_posed(camera, expression, &Isometry::IDENTITY)
    }

    /// The same with the head turned and moved; neck and shirt stay where they are.
    pub fn render_posed(&self, camera: &Camera, expression: &Expression, world_from_head: &Isometry) -> RenderedView {
        render::render(self, camera, &FaceState::of(expression), world_from_head)
    }

    /// Positions (before the person's stretch) and normals of a part for an expression.
    pub(crate) fn deform(part: &Part, state: &FaceState) -> (Vec<Vec3>, Vec<Vec3>) {
        use rayon::prelude::*;
        let mesh = &part.mesh;
        let (mut position, mut normal) = (mesh.position.clone(), mesh.normal.clone());
        match mesh.material {
            Material::LowerTeeth | Material::Tongue => {
                let fall = Vec3::new(0.0, -0.0150, -0.0050) * (state.strength(26) * 0.85)
                    - Vec3::Y * (0.0018 * state.strength(25));
                for p in &mut position {
                    *p += fall;
                }
            }
            Material::Head => {
                let moved: Vec<Vec3> = part
                    .movable
                    .par_iter()
                    .map(|&i| face::displacement(mesh.rest[i as usize], mesh.label[i as usize], state))
                    .collect();
                for (&i, d) in part.movable.iter().zip(moved) {
                    position[i as usize] += d;
                }
                let turned: Vec<Vec3> =
                    part.movable.par_iter().map(|&i| mesh.grid_normal(&position, i as usize)).collect();
                for (&i, n) in part.movable.iter().zip(turned) {
                    normal[i as usize] = n;
                }
            }
            _ => {}
        }
        (position, normal)
    }
}
