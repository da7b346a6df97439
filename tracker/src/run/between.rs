//! Observations of the frames between tracked ones, and scores as means of three frames.

use super::observations::Observation;
use crate::error::Result;

/// Gives every frame its observation: that of its own, or one between its tracked neighbours.
pub struct Interpolator<I> {
    source: I,
    every: usize,
    frames: usize,
    next: usize,
    /// Tracked frames around the current one: number and observation, two before and two after.
    around: [Option<(usize, Option<Observation>)>; 4],
}

impl<I: Iterator<Item = Result<Option<Observation>>>> Interpolator<I> {
    /// Observations of `frames` frames from those of every `every`-th.
    pub fn new(source: I, every: u32, frames: usize) -> Self {
        Self { source, every: every.max(1) as usize, frames, next: 0, around: [None, None, None, None] }
    }

    /// The observation of the next frame, and whether it was made from others.
    pub fn next_frame(&mut self) -> Result<(Option<Observation>, bool)> {
        let frame = self.next;
        self.next += 1;
        if self.every == 1 {
            return Ok((self.source.next().transpose()?.flatten(), false));
        }
        if frame == 0 {
            for slot in 1..4 {
                self.around[slot] = self.pull(slot - 1)?;
            }
        }
        while self.around[2].as_ref().is_some_and(|(at, _)| *at <= frame) {
            self.around.rotate_left(1);
            let after = self.around[2].as_ref().map_or(self.frames, |(at, _)| at / self.every + 1);
            self.around[3] = self.pull(after)?;
        }
        let Some((at, here)) = &self.around[1] else { return Ok((None, true)) };
        if *at == frame {
            return Ok((here.clone(), false));
        }
        let known = |slot: usize| {
            let (at, observation) = self.around[slot].as_ref()?;
            Some((*at as f32, observation.as_ref()?))
        };
        // A face that was seen on one side only may have gone anywhere.
        let (Some(left), Some(right)) = (known(1), known(2)) else { return Ok((None, true)) };
        Ok((Some(between(known(0), left, right, known(3), frame as f32)), true))
    }

    /// The tracked frame with the number `order` among the tracked ones.
    fn pull(&mut self, order: usize) -> Result<Option<(usize, Option<Observation>)>> {
        let at = (order * self.every).min(self.frames.saturating_sub(1));
        Ok(match self.source.next() {
            Some(observation) => Some((at, observation?)),
            None => None,
        })
    }
}

type At<'a> = (f32, &'a Observation);

/// A cubic through two tracked frames with the slopes that their neighbours suggest (Catmull–Rom for uneven spacing);
/// where a neighbour is missing the slope is that of the chord.
fn between(before: Option<At>, left: At, right: At, after: Option<At>, frame: f32) -> Observation {
    let length = right.0 - left.0;
    let u = (frame - left.0) / length;
    let value = |get: &dyn Fn(&Observation) -> f32| {
        let (a, b) = (get(left.1), get(right.1));
        let slope_a = before.map_or(b - a, |(at, o)| (b - get(o)) / (right.0 - at) * length);
        let slope_b = after.map_or(b - a, |(at, o)| (get(o) - a) / (at - left.0) * length);
        let (u2, u3) = (u * u, u * u * u);
        (2.0 * u3 - 3.0 * u2 + 1.0) * a
            + (u3 - 2.0 * u2 + u) * slope_a
            + (3.0 * u2 - 2.0 * u3) * b
            + (u3 - u2) * slope_b
    };
    let features = left.1.features.len().min(right.1.features.len());
    let eyes = left
        .1
        .eyes
        .as_ref()
        .zip(right.1.eyes.as_ref())
        .map(|(ours, _)| Box::new(std::array::from_fn(|k| value(&|o| o.eyes.as_ref().map_or(ours[k], |e| e[k])))));
    Observation {
        points_px: std::array::from_fn(|i| [0, 1].map(|axis| value(&|o| o.points_px[i][axis]))),
        presence: left.1.presence.min(right.1.presence),
        features: (0..features).map(|k| value(&|o| o.features.get(k).copied().unwrap_or(left.1.features[k]))).collect(),
        eyes,
    }
}

/// Gives every frame's scores as the mean with those of the frames before and after, as OpenFace does.
pub struct Smoothed<I> {
    source: Interpolator<I>,
    /// How many of an observation's features are scores; 0 leaves all as they are.
    scores: usize,
    before: Option<Observation>,
    here: Option<(Option<Observation>, bool)>,
}

impl<I: Iterator<Item = Result<Option<Observation>>>> Smoothed<I> {
    /// The observations of `source`.
    pub fn new(source: Interpolator<I>, scores: usize) -> Self {
        Self { source, scores, before: None, here: None }
    }

    /// The observation of the next frame, and whether it was made from others.
    pub fn next_frame(&mut self) -> Result<(Option<Observation>, bool)> {
        if self.scores == 0 {
            return self.source.next_frame();
        }
        let (here, is_between) = match self.here.take() {
            Some(here) => here,
            None => self.source.next_frame()?,
        };
        let after = self.source.next_frame()?;
        let mut smoothed = here.clone();
        if let Some(out) = &mut smoothed {
            let neighbours = [self.before.as_ref(), after.0.as_ref()];
            let known: Vec<&Observation> =
                neighbours.into_iter().flatten().filter(|o| o.features.len() == out.features.len()).collect();
            for (k, value) in out.features.iter_mut().take(self.scores).enumerate() {
                *value = (*value + known.iter().map(|o| o.features[k]).sum::<f32>()) / (1 + known.len()) as f32;
            }
        }
        self.before = here;
        self.here = Some(after);
        Ok((smoothed, is_between))
    }
}

#[cfg(test)]
#[path = "between_tests.rs"]
mod tests;
