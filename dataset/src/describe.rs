//! The dataset without its pixels: ids, splits, cameras, annotations.

use std::collections::BTreeMap;

use risorius_formats::AttributeTable;
use risorius_formats::Similarity;
use risorius_formats::nerfies::{Annotation, Dataset, Extras, FrameMetadata};
use risorius_formats::pose_report::PoseMethod;

use crate::align::TakeInput;
use crate::build::{Candidate, TAKE_OFFSET, VAL_FIRST, VAL_INTERVAL};
use crate::options::BuildOptions;
use crate::scene;

/// Corners of the head's hull in the common world; only where the head route found the cameras.
pub(crate) fn head_hull(input: &TakeInput, world: &Similarity) -> Option<Vec<glam::DVec3>> {
    let hull = input.report.head_hull_in_world.as_ref().filter(|_| input.report.method == PoseMethod::Head)?;
    Some(hull.iter().map(|&p| world.transform_point(p)).collect())
}

/// Everything about the chosen candidates; `size` is the trimmed full size.
pub(crate) fn describe(
    inputs: &[TakeInput],
    worlds: &[Similarity],
    candidates: &[Candidate],
    chosen: &[usize],
    table: &AttributeTable,
    options: &BuildOptions,
    size: (u32, u32),
) -> Dataset {
    let number = |c: &Candidate| c.take as u32 * TAKE_OFFSET + c.frame;
    let widest = chosen.iter().map(|&c| number(&candidates[c])).max().unwrap_or(0);
    let digits = widest.to_string().len().max(6);
    let ids: Vec<String> = chosen.iter().map(|&c| format!("{:0digits$}", number(&candidates[c]))).collect();
    let is_val = |place: usize| !options.no_val && place % VAL_INTERVAL == VAL_FIRST;
    let mut dataset = Dataset {
        train_ids: Vec::new(),
        val_ids: Vec::new(),
        metadata: BTreeMap::new(),
        cameras: BTreeMap::new(),
        scene: risorius_formats::SceneBounds { center_in_world: glam::DVec3::ZERO, scale: 1.0, near: 0.1, far: 1.0 },
        mapping: table.attributes.iter().map(|a| a.unit.to_string()).collect(),
        annotations: Vec::new(),
        extras: None,
        ids,
    };
    for (place, &index) in chosen.iter().enumerate() {
        let (candidate, id) = (&candidates[index], &dataset.ids[place]);
        // A held-out frame gets the place that it would have among the frames for fitting.
        let warp_id = dataset.train_ids.len() as u32;
        let list = if is_val(place) { &mut dataset.val_ids } else { &mut dataset.train_ids };
        list.push(id.clone());
        let time_id = Some(number(candidate));
        dataset.metadata.insert(
            id.clone(),
            FrameMetadata { warp_id, appearance_id: warp_id, camera_id: candidate.take as u32, time_id },
        );
        let mut camera = candidate.camera;
        (camera.intrinsics.width, camera.intrinsics.height) = size;
        dataset.cameras.insert(id.clone(), camera);
        for (class, (spec, &intensity)) in table.attributes.iter().zip(&candidate.intensities).enumerate() {
            dataset.annotations.push(Annotation {
                class,
                frame: number(candidate),
                value: spec.attribute_from_intensity(intensity),
            });
        }
    }
    dataset.scene = scene::bounds(inputs, worlds, dataset.cameras.values());
    let first = &inputs[0].report;
    let rejected = chosen.iter().zip(&dataset.ids).filter(|(c, _)| candidates[**c].polygons.is_err());
    dataset.extras = Some(Extras {
        version: 1,
        default_scale: options.scale,
        method: first.method,
        head_center: first.head_center,
        head_radius: first.head_radius,
        head_hull_in_world: head_hull(&inputs[0], &worlds[0]),
        units_per_metre: first.units_per_metre,
        takes: inputs.iter().map(|i| i.name.clone()).collect(),
        neutral_id: neutral_id(&dataset, candidates, chosen, table),
        ids_without_masks: rejected.map(|(_, id)| id.clone()).collect(),
        written_by: concat!("risorius-dataset ", env!("CARGO_PKG_VERSION")).to_owned(),
    });
    dataset
}

/// The frame for fitting whose face rests most: the distance of its AUs from neutral (root mean square, as a share of
/// their ranges) and its asymmetry, which AUs do not tell.
fn neutral_id(dataset: &Dataset, candidates: &[Candidate], chosen: &[usize], table: &AttributeTable) -> Option<String> {
    let active = table.attributes.iter().filter(|a| a.active).count().max(1) as f32;
    let unrest = |c: &Candidate| {
        let squares: f32 = table
            .attributes
            .iter()
            .zip(&c.intensities)
            .filter(|(a, _)| a.active)
            .map(|(a, &v)| (0.5 * (a.attribute_from_intensity(v) - a.neutral_attribute())).powi(2))
            .sum();
        (squares / active).sqrt() + ASYMMETRY_WEIGHT * c.asymmetry
    };
    let for_fitting: std::collections::BTreeSet<&String> = dataset.train_ids.iter().collect();
    chosen
        .iter()
        .zip(&dataset.ids)
        .filter(|(_, id)| for_fitting.contains(id))
        .map(|(&c, id)| (unrest(&candidates[c]), id))
        .filter(|(unrest, _)| unrest.is_finite())
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, id)| id.clone())
}

/// A crooked face (asymmetry 0.06 above rest) weighs as much as AUs that are off by 0.3 of their ranges.
const ASYMMETRY_WEIGHT: f32 = 5.0;
