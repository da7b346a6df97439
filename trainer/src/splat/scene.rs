//! A dataset as the Gaussian field sees it: metres, activations, masks.

use rayon::prelude::*;
use risorius_formats::attribute::AttributeTable;
use risorius_formats::{AuScale, Isometry};
use risorius_splat::model::REGIONS;
use risorius_splat::{Frame, MOST_SIDE, Plate as PlateOfScene, Scene};

use super::plate::Plate;
use super::space::MetricSpace;
use crate::data::{TrainData, TrainFrame};
use crate::error::{Result, TrainerError};

/// What is derived from a dataset once, and the scene's pictures point into.
#[derive(Debug)]
pub struct SceneData<'a> {
    data: &'a TrainData,
    /// The Gaussians' space.
    pub space: MetricSpace,
    /// What is behind the head, if the camera stands still.
    pub plate: Option<Plate>,
    /// What each frame shows of the person, where there is a plate.
    persons: Vec<Option<Vec<u8>>>,
}

impl<'a> SceneData<'a> {
    /// Refuses what the field cannot hold.
    pub fn new(data: &'a TrainData) -> Result<Self> {
        if data.table.regions.len() > REGIONS {
            return Err(TrainerError::Dataset {
                path: data.dir.clone(),
                message: format!("has {} regions, the Gaussian field holds {REGIONS}", data.table.regions.len()),
                hint: "use `--field confies`".to_owned(),
            });
        }
        let side = |f: &TrainFrame| f.camera.intrinsics.width.max(f.camera.intrinsics.height) as usize;
        if let Some(frame) = data.frames.iter().find(|f| side(f) > MOST_SIDE) {
            return Err(TrainerError::Dataset {
                path: data.dir.clone(),
                message: format!(
                    "has pictures of {} pixels along a side, the Gaussian field holds {MOST_SIDE}",
                    side(frame)
                ),
                hint: "build it smaller, such as with `dataset build --scale 2`".to_owned(),
            });
        }
        let plate = Plate::of(data);
        let person = |p: &Plate| data.frames.par_iter().map(|f| p.person(f)).collect();
        let persons = plate.as_ref().map(person).unwrap_or_default();
        Ok(Self { data, space: MetricSpace::of(data), plate, persons })
    }

    /// The scene to fit.
    pub fn scene(&self) -> Scene<'_> {
        let Self { data, space, plate, persons } = self;
        let person = |i: usize| persons.get(i).and_then(Option::as_deref);
        let scales: Vec<AuScale> = data.table.attributes.iter().map(AuScale::new).collect();
        let known = data.has_intensities();
        let hull = data.extras().and_then(|e| e.head_hull_in_world.as_ref());
        Scene {
            frames: data
                .frames
                .iter()
                .enumerate()
                .map(|(i, f)| frame_of(f, person(i), space, &scales, known))
                .collect(),
            region_of: data.table.attributes.iter().map(|a| a.region).collect(),
            also_in: also_in(&data.table),
            regions: data.table.regions.len(),
            face_radius_m: space.face_radius_m(data) as f32,
            head_hull: hull.map(|corners| corners.iter().map(|c| space.point(*c)).collect()),
            plate: plate.as_ref().map(|p| PlateOfScene {
                width: p.width as usize,
                height: p.height as usize,
                rgb: &p.rgb,
            }),
            neutral_frame: data.neutral_frame(),
        }
    }
}

/// The regions that each AU acts in beside its own, a bit each.
fn also_in(table: &AttributeTable) -> Vec<u8> {
    table.attributes.iter().map(|a| table.others_of(a).fold(0, |bits, region| bits | 1 << region)).collect()
}

fn frame_of<'a>(
    frame: &'a TrainFrame,
    person: Option<&'a [u8]>,
    space: &MetricSpace,
    scales: &[AuScale],
    known: bool,
) -> Frame<'a> {
    let activations = match (&frame.intensities, &frame.attributes) {
        (Some(intensities), Some(_)) if known => {
            Some(scales.iter().zip(intensities).map(|(s, i)| s.activation(*i).0).collect())
        }
        (_, attributes) => attributes
            .as_ref()
            .map(|all| scales.iter().zip(all).map(|(s, a)| s.activation_from_attribute(*a).0).collect()),
    };
    Frame {
        camera: space.camera(&frame.camera),
        room_from_head: Isometry::IDENTITY,
        rgb: &frame.pixels,
        valid: person.or(frame.valid.as_deref()),
        labels: frame.labels.as_deref(),
        activations,
        landmarks_px: frame.landmarks_px,
    }
}
