//! Frames placed once more where their patches were found, after key frames and points have moved.

use glam::{DVec2, DVec3};
use risorius_formats::{Intrinsics, Isometry};

use super::{Follow, Key, LEAST_MARKS, Mark, SIGMA_PX, Seen, Sight};
use crate::poses::model::TakeModel;
use crate::poses::sharpen::expected;
use crate::poses::triangulate::median;

/// Key frames and points after an adjustment.
pub(crate) struct Moved {
    lens: Intrinsics,
    /// The pose of each key frame, and its points.
    keys: Vec<(Isometry, Vec<Option<Place>>)>,
}

/// Where a point that is left is now, and where it projects in its key frame.
type Place = (DVec3, DVec2);

impl Follow<'_> {
    /// Where key frames and points are now.
    pub(crate) fn moved(&self, model: &TakeModel) -> Option<Moved> {
        let lens = *model.lenses.first_key_value()?.1;
        let of_key = |key: &Key| {
            let pose = model.frames.get(&key.frame)?.camera_from_world;
            let place = |mark: &Mark| {
                let point = model.points.get(&mark.id)?.position;
                Some((point, lens.project(pose.transform_point(point))))
            };
            Some((pose, key.marks.iter().map(place).collect()))
        };
        Some(Moved { lens, keys: self.keys.iter().map(of_key).collect::<Option<_>>()? })
    }

    /// The pose of a frame whose patches were found under `pose`, after key frames and points have moved, and the median
    /// error; `None` with too few patches.
    ///
    /// A patch was cut where its point projected then. Where it projects a little beside that now, it would have been found
    /// as much beside.
    pub(crate) fn again(&self, moved: &Moved, pose: &Isometry, sights: &[Sight]) -> Option<(Isometry, f64)> {
        let nearest = sights.iter().min_by(|a, b| {
            let distance = |s: &Sight| self.distance(&self.keys[usize::from(s.key)].pose, pose);
            distance(a).total_cmp(&distance(b))
        })?;
        let key = usize::from(nearest.key);
        let closest = self.distance(&self.keys[key].pose, pose) + 1e-3;
        // As it stands to the key frame.
        let guess = pose.compose(&self.keys[key].pose.inverse()).compose(&moved.keys[key].0);
        let found = sights.iter().filter_map(|sight| {
            let key = usize::from(sight.key);
            let (old, mark) = (&self.keys[key], &self.keys[key].marks[usize::from(sight.mark)]);
            let (key_pose, places) = &moved.keys[key];
            let (point, projected) = places[usize::from(sight.mark)]?;
            let (_, warp) = expected(&moved.lens, key_pose, &guess, projected, point)?;
            let pixel = DVec2::from(sight.pixel.map(f64::from)) + warp * (projected - mark.pixel);
            let weight = closest / (self.distance(&old.pose, pose) + 1e-3);
            Some((*sight, point, pixel, SIGMA_PX / weight.max(1e-3).sqrt()))
        });
        let (seen, _) = Seen::of(found);
        if seen.shape.len() < LEAST_MARKS {
            return None;
        }
        let pose = seen.pose(&moved.lens, guess, &self.loose(&guess));
        let error = median(&mut seen.errors_px(&moved.lens, &pose))?;
        Some((pose, error))
    }
}
