//! A capture with known answers that the project makes itself: an analytic head in a room.
//!
//! [`Scene`] renders a stylised person with any camera and [`Expression`]; [`generate`] writes a whole capture: video,
//! OpenFace table, exact cameras as a COLMAP model, label images, held-out stills with their truth, and a second person
//! whose expressions are transferred.
//!
//! The head is a signed distance (smooth-blended ellipsoids) sampled once into a grid; the action units move its skin
//! by bumps of compact support and slide brows, lids and lips along it. World and head frame are the same: metres, +x the
//! subject's left, +y up, +z out of the face. Everything random comes from the seed, and the pictures do not depend on the
//! number of threads.
//!
//! ```
//! use risorius_formats::ActionUnit;
//! use risorius_synth::{Expression, Person, Scene, camera_at, lens};
//!
//! let scene = Scene::new(Person::subject(1), 1);
//! let camera = camera_at(lens(54, 96), 0.2, 0.1, 0.55, glam::DVec3::ZERO, 0.0);
//! let smile = Expression::NEUTRAL.with(ActionUnit(12), 4.0);
//! let view = scene.render(&camera, &smile);
//! assert_eq!(view.rgb.dimensions(), (54, 96));
//! ```

pub mod cli;
mod error;
mod expression;
mod face;
mod generate;
mod landmarks;
mod mesh;
mod noise;
mod person;
mod render;
mod room;
mod scene;
mod script;
mod settings;
mod shade;
mod shape;
mod sparse;
mod table;

pub use error::SynthError;
pub use expression::Expression;
pub use face::{BROW_LABEL, EYE_LABEL, MOUTH_LABEL};
pub use generate::{Summary, capture_shots, generate};
pub use landmarks::openface_pose;
pub use person::Person;
pub use render::RenderedView;
pub use scene::Scene;
pub use script::{Script, Segment, camera_at, capture_camera, driver_camera, driver_head, lens};
pub use settings::Settings;
pub use table::{Noise, Shot, landmarks_in_camera, track};
