//! The 68 landmarks as points of the model's skin.

use glam::{DMat3, DVec3, Vec3};
use risorius_formats::{Isometry, landmarks as names};

use crate::expression::{Expression, FaceState, Lids};
use crate::face;
use crate::person::Person;
use crate::scene::Scene;
use crate::shape::{self, HEAD_CENTRE};

/// Where the skin at rest is in front of x, y of the face's plane.
fn in_front(x: f32, y: f32, person: &Person) -> Vec3 {
    shape::leave(|p| shape::head(p, person), Vec3::new(x, y, 0.0), Vec3::Z, 0.15)
}

/// The jaw line at `a`, −1 (image-left ear) to 1 (image-right ear) over the chin at 0.
fn jaw(a: f32, person: &Person) -> Vec3 {
    let turn = a * std::f32::consts::FRAC_PI_2 * 0.96;
    let height = -0.100 + 0.112 * a.abs().powf(1.9);
    let target = Vec3::new(0.078 * turn.sin(), height, 0.006 + 0.082 * turn.cos());
    shape::leave(|p| shape::head(p, person), HEAD_CENTRE, (target - HEAD_CENTRE).normalize(), 0.17)
}

fn rest_points(person: &Person, state: &FaceState) -> [Vec3; 68] {
    let mut points = [Vec3::ZERO; 68];
    let front = |x: f32, y: f32| in_front(x, y, person);
    for i in 0..17 {
        points[names::JAW.start + i] = jaw((i as f32 - 8.0) / 8.0, person);
    }
    let [inner, outer] = state.brow.ends();
    for i in 0..5 {
        let s = i as f32 / 4.0;
        let (x, y) = (inner + (outer - inner) * s, state.brow.height(s));
        points[21 - i] = front(-x, y);
        points[22 + i] = front(x, y);
    }
    for (i, y) in [0.0200f32, 0.0070, -0.0060, -0.0190].into_iter().enumerate() {
        points[27 + i] = front(0.0, y);
    }
    for (i, x) in [-0.0140f32, -0.0075, 0.0, 0.0075, 0.0140].into_iter().enumerate() {
        let y = if i == 2 { -0.0290 } else { -0.0275 };
        points[31 + i] = front(x * person.nose_size, y);
    }
    let lid = |u: f32, side: f32, upper: bool| {
        let [above, below] = state.lids.edges(u);
        let y = if u.abs() >= 1.0 {
            0.5 * (above + below)
        } else if upper {
            above
        } else {
            below
        };
        front(side * (Lids::CENTRE[0] + u * Lids::HALF_WIDTH), y)
    };
    let third = 0.36;
    for (i, (u, upper)) in [(1.0, true), (third, true), (-third, true), (-1.0, true), (-third, false), (third, false)]
        .into_iter()
        .enumerate()
    {
        points[36 + i] = lid(u, -1.0, upper);
    }
    for (i, (u, upper)) in [(-1.0, true), (-third, true), (third, true), (1.0, true), (third, false), (-third, false)]
        .into_iter()
        .enumerate()
    {
        points[42 + i] = lid(u, 1.0, upper);
    }
    let lip = |t: f32, line: usize| front(t * state.mouth.corner[0], state.mouth.lines(t)[line]);
    for (i, t) in [-1.0f32, -0.66, -0.30, 0.0, 0.30, 0.66, 1.0].into_iter().enumerate() {
        points[48 + i] = lip(t, 0);
    }
    for (i, t) in [0.66f32, 0.32, 0.0, -0.32, -0.66].into_iter().enumerate() {
        points[55 + i] = lip(t, 3);
    }
    for (i, t) in [-0.84f32, -0.40, 0.0, 0.40, 0.84].into_iter().enumerate() {
        points[60 + i] = lip(t, 1);
    }
    for (i, t) in [0.40f32, 0.0, -0.40].into_iter().enumerate() {
        points[65 + i] = lip(t, 2);
    }
    points
}

/// OpenFace's head axes (x to the image's right, y down, z into the head) from the model's.
fn head_from_openface() -> DMat3 {
    DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))
}

/// The head pose as OpenFace states it, millimetres: identity for a face that looks straight into the camera.
pub fn openface_pose(camera_from_world: &Isometry, world_from_head: &Isometry) -> Isometry {
    let camera_from_head = camera_from_world.compose(world_from_head);
    Isometry::new(camera_from_head.rotation * head_from_openface(), camera_from_head.translation * 1000.0)
}

impl Scene {
    /// The 68 landmarks in the head frame (+x the subject's left, +y up, +z out of the face), metres.
    pub fn landmarks(&self, expression: &Expression) -> [DVec3; 68] {
        let state = FaceState::of(expression);
        rest_points(&self.person, &state).map(|p| {
            let moved = p + face::displacement(p, face::region(p), &state);
            (moved * self.person.proportions).as_dvec3()
        })
    }
}
