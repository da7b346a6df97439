//! The paper's interpolation test (fact sheet §4.2): a held-out frame is rendered with the code between those of its two
//! neighbours among the training frames, and the attributes that this code gives.

use std::collections::BTreeMap;
use std::path::Path;

use risorius_formats::nerfies::Dataset;

use crate::avatar::Avatar;
use crate::data::split;
use crate::error::{Result, TrainerError};
use crate::field::Between;
use crate::saved::SavedField;

/// `interval` of a run's `settings.toml`; 0 where there is none.
pub fn interval_of(run: &Path) -> usize {
    let text = std::fs::read_to_string(run.join("settings.toml")).unwrap_or_default();
    let table: toml::Table = toml::from_str(&text).unwrap_or_default();
    table.get("interval").and_then(toml::Value::as_integer).and_then(|v| usize::try_from(v).ok()).unwrap_or(0)
}

/// Where each held-out frame of `dataset` lies between the frames that the run was fitted to.
pub fn places(avatar: &Avatar, run: &Path, dataset: &Dataset) -> Result<BTreeMap<String, Between>> {
    let fail = |message: String, hint: &str| TrainerError::Run { path: run.to_owned(), message, hint: hint.to_owned() };
    let SavedField::Confies(saved) = &avatar.saved.field else {
        let hint = "leave out `--interpolate`: its attributes come from the frames' annotations";
        return Err(fail("a field of Gaussians has no codes to interpolate".to_owned(), hint));
    };
    let (train, held) = split(dataset, interval_of(run));
    if train.len() != saved.frames {
        let message = format!("was fitted to {} frames, but its dataset has {} now", saved.frames, train.len());
        return Err(fail(message, "fit again, or give views with `--views`"));
    }
    Ok(held
        .into_iter()
        .map(|id| {
            let place = between(&train, dataset, &id);
            (id, place)
        })
        .collect())
}

fn between(train: &[String], dataset: &Dataset, id: &str) -> Between {
    let time = |id: &str| dataset.source_frame(id).map_or(0, i64::from);
    let at = time(id);
    let mut order: Vec<(i64, usize)> = train.iter().enumerate().map(|(i, id)| (time(id), i)).collect();
    order.sort_unstable();
    let after = order.partition_point(|(t, _)| *t <= at);
    let (left, right) = match (after.checked_sub(1).map(|i| order[i]), order.get(after).copied()) {
        (Some(left), Some(right)) => (left, right),
        (Some(only), None) | (None, Some(only)) => (only, only),
        (None, None) => ((0, 0), (0, 0)),
    };
    // Two frames of one time have no middle.
    let t = if right.0 > left.0 { (at - left.0) as f32 / (right.0 - left.0) as f32 } else { 0.0 };
    Between { left: left.1, right: right.1, t }
}

#[cfg(test)]
mod tests {
    use risorius_formats::SceneBounds;
    use risorius_formats::nerfies::FrameMetadata;

    use super::*;

    #[test]
    fn every_other_frame_is_held_out_and_lies_between_its_neighbours() {
        let times = [0, 10, 16, 30, 34, 50];
        let ids: Vec<String> = (0..times.len()).map(|i| format!("{i:06}")).collect();
        let metadata =
            |i: usize| FrameMetadata { warp_id: i as u32, appearance_id: 0, camera_id: 0, time_id: Some(times[i]) };
        let dataset = Dataset {
            metadata: ids.iter().enumerate().map(|(i, id)| (id.clone(), metadata(i))).collect(),
            train_ids: ids[1..].to_vec(),
            val_ids: ids[..1].to_vec(),
            ids: ids.clone(),
            scene: SceneBounds { center_in_world: glam::DVec3::ZERO, scale: 1.0, near: 1.0, far: 2.0 },
            cameras: BTreeMap::new(),
            mapping: Vec::new(),
            annotations: Vec::new(),
            extras: None,
        };
        let (train, held) = split(&dataset, 2);
        assert_eq!(train, [&*ids[0], &*ids[2], &*ids[4]]);
        // The last frame has no neighbour on its right.
        assert_eq!(held, [&*ids[1], &*ids[3]]);
        assert_eq!(between(&train, &dataset, &ids[1]), Between { left: 0, right: 1, t: 0.625 });
        assert_eq!(between(&train, &dataset, &ids[5]), Between { left: 2, right: 2, t: 0.0 });
        assert_eq!(split(&dataset, 0), (ids[1..].to_vec(), ids[..1].to_vec()));
        assert_eq!(split(&dataset, 4).0, [&*ids[0], &*ids[4]]);
        assert_eq!(split(&dataset, 4).1, [&*ids[2]]);
    }
}
