//! The dataset without its pixels: ids, splits, cameras, annotations.

use std::collections::BTreeMap;
use std::sync::Arc;

use risorius_formats::nerfies::{Annotation, Dataset, Extras, FrameMetadata};
use risorius_formats::pose_report::PoseMethod;
use risorius_formats::{AttributeTable, Intensity, Similarity};

use crate::TAKE_OFFSET;
use crate::align::TakeInput;
use crate::candidates::Sight;
use crate::choose::Chosen;
use crate::options::BuildOptions;
use crate::rows::{Rows, UsableRow};
use crate::scene;
use crate::split::Role;

/// Everything about the chosen candidates; `size` is the trimmed full size.
#[expect(clippy::too_many_arguments, reason = "the whole of a build comes together here")]
pub(crate) fn describe(
    inputs: &[TakeInput],
    worlds: &[Similarity],
    rows: &Rows,
    sights: &[Sight],
    chosen: &[Chosen],
    options: &BuildOptions,
    size: (u32, u32),
    hulls: &[Option<Arc<Vec<glam::DVec3>>>],
) -> Dataset {
    let (table, usable) = (&rows.table, rows.usable());
    let number = |u: &UsableRow<'_>| u.take as u32 * TAKE_OFFSET + u.row.frame;
    let widest = chosen.iter().map(|&(c, _)| number(&usable[c])).max().unwrap_or(0);
    let digits = widest.to_string().len().max(6);
    let ids: Vec<String> = chosen.iter().map(|&(c, _)| format!("{:0digits$}", number(&usable[c]))).collect();
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
    for (place, &(index, role)) in chosen.iter().enumerate() {
        let (candidate, id) = (&usable[index], &dataset.ids[place]);
        let Some(mut camera) = candidate.row.camera else { continue };
        // A held-out frame gets the place that it would have among the frames for fitting.
        let warp_id = dataset.train_ids.len() as u32;
        match role {
            Role::Train => dataset.train_ids.push(id.clone()),
            Role::Val => dataset.val_ids.push(id.clone()),
            Role::Neither => {}
        }
        let time_id = Some(number(candidate));
        dataset.metadata.insert(
            id.clone(),
            FrameMetadata { warp_id, appearance_id: warp_id, camera_id: candidate.take as u32, time_id },
        );
        (camera.intrinsics.width, camera.intrinsics.height) = size;
        dataset.cameras.insert(id.clone(), camera);
        for (class, (spec, &intensity)) in table.attributes.iter().zip(candidate.intensities).enumerate() {
            dataset.annotations.push(Annotation {
                class,
                frame: number(candidate),
                value: spec.scale().attribute(Intensity(intensity)).0,
            });
        }
    }
    dataset.scene = scene::bounds(inputs, worlds, dataset.cameras.values());
    let first = &inputs[0].report;
    let rejected = chosen.iter().zip(&dataset.ids).filter(|(c, _)| sights[c.0].polygons.is_err());
    dataset.extras = Some(Extras {
        version: 1,
        default_scale: options.scale,
        method: first.method,
        head_center: first.head_center,
        head_radius: first.head_radius,
        // Only where the head route found the cameras: elsewhere all pixels are rigid with the head.
        head_hull_in_world: hulls[0].as_ref().filter(|_| first.method == PoseMethod::Head).map(|h| h.to_vec()),
        units_per_metre: first.units_per_metre,
        takes: inputs.iter().map(|i| i.name.clone()).collect(),
        neutral_id: neutral_id(&dataset, &usable, sights, chosen, table),
        ids_without_masks: rejected.map(|(_, id)| id.clone()).collect(),
        written_by: concat!("risorius-dataset ", env!("CARGO_PKG_VERSION")).to_owned(),
    });
    dataset
}

/// The frame for fitting whose face rests most: the distance of its AUs from neutral (root mean square, as a share of
/// their ranges) and its asymmetry, which AUs do not tell.
fn neutral_id(
    dataset: &Dataset,
    usable: &[UsableRow<'_>],
    sights: &[Sight],
    chosen: &[Chosen],
    table: &AttributeTable,
) -> Option<String> {
    let active = table.attributes.iter().filter(|a| a.active).count().max(1) as f32;
    let unrest = |c: usize| {
        let squares: f32 = table
            .attributes
            .iter()
            .zip(usable[c].intensities)
            .filter(|(a, _)| a.active)
            .map(|(a, &v)| (0.5 * (a.scale().attribute(Intensity(v)).0 - a.neutral_attribute().0)).powi(2))
            .sum();
        (squares / active).sqrt() + ASYMMETRY_WEIGHT * sights[c].asymmetry
    };
    let for_fitting: std::collections::BTreeSet<&String> = dataset.train_ids.iter().collect();
    chosen
        .iter()
        .zip(&dataset.ids)
        .filter(|(_, id)| for_fitting.contains(id))
        .map(|(&(c, _), id)| (unrest(c), id))
        .filter(|(unrest, _)| unrest.is_finite())
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, id)| id.clone())
}

/// A crooked face (asymmetry 0.06 above rest) weighs as much as AUs that are off by 0.3 of their ranges.
const ASYMMETRY_WEIGHT: f32 = 5.0;
