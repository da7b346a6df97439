//! One face through a video: detected once, then followed by its own points.
//!
//! Pictures come in blocks of [`BLOCK`]. Those of one block are independent of each other, so that threads can share them:
//! each starts from the crops at the end of the block before, moved on with the motion seen there. Where the face turns
//! out to be somewhere else, the network runs again on the better crop. The outcome depends on the pictures only, not on
//! the number of threads.

use std::sync::Arc;

use image::RgbImage;
use rayon::ThreadPool;
use rayon::prelude::*;

use super::crop::Crop;
use super::detect::{Detector, Face, LEVELS};
use super::landmarks::{Found, Landmarker};
use crate::aus::openface::OpenFaceModels;
use crate::aus::readout::Readout;
use crate::error::{Result, TrackerError};
use crate::models::ModelFolder;
use crate::models::manifest::AuModel;
use crate::models::runtime::Runtime;

/// Pictures that are worked on at once.
pub const BLOCK: usize = 4;
/// A crop that is off by more than this is made anew: shares of its side, radians.
const CROP_TOLERANCE: f32 = 0.12;
/// How often at most.
const CROP_ATTEMPTS: usize = 3;
/// A lost face that comes back within this many pictures is looked for where it was, before the largest one is taken.
const MEMORY: usize = 60;
/// A face that was just detected is believed from this probability on; one that is followed, from the manifest's.
const FRESH_PRESENCE: f32 = 0.98;
/// How many detected faces are tried.
const CANDIDATES: usize = 5;
/// Weight of a new crop in the smoothed one where the face hardly moves; it rises to 1 with the motion.
const STEADY: f32 = 0.4;

/// Which face is followed where there are several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FirstFace {
    /// The largest one.
    #[default]
    Largest,
    /// The one that the detector is surest of.
    First,
}

/// The networks of one thread.
#[derive(Debug)]
struct Networks {
    detector: Detector,
    landmarker: Landmarker,
}

/// Follows one face.
#[derive(Debug)]
pub struct Follower {
    networks: Vec<std::sync::Mutex<Networks>>,
    pool: ThreadPool,
    choice: FirstFace,
    margin: f32,
    /// Crops of the two pictures before, the newer last.
    recent: [Option<Crop>; 2],
    /// Where the face was last seen, and how many pictures ago.
    last_seen: Option<(Crop, usize)>,
    detections: usize,
    landmark_runs: usize,
}

/// How much work there was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Effort {
    /// Pictures that the detector saw.
    pub detections: usize,
    /// Runs of the landmark network.
    pub landmark_runs: usize,
}

impl Follower {
    /// Loads the networks once for each of `threads` threads; AUs come from `openface` where it is given.
    pub fn new(
        runtime: &Runtime,
        models: &ModelFolder,
        threads: usize,
        choice: FirstFace,
        openface: Option<&Arc<OpenFaceModels>>,
    ) -> Result<Self> {
        let threads = threads.clamp(1, BLOCK);
        let load = || {
            let detector = Detector::open(runtime, models)?;
            let landmarker = Landmarker::open(runtime, models, openface.cloned())?;
            Ok(std::sync::Mutex::new(Networks { detector, landmarker }))
        };
        let networks = (0..threads).map(|_| load()).collect::<Result<Vec<_>>>()?;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("track-{i}"))
            .build()
            .map_err(|e| TrackerError::Threads { message: e.to_string() })?;
        Ok(Self {
            networks,
            pool,
            choice,
            margin: models.manifest.landmarks.margin,
            recent: [None; 2],
            last_seen: None,
            detections: 0,
            landmark_runs: 0,
        })
    }

    /// The AU readout that fits these networks.
    pub fn readout(&self) -> Option<&'static Readout> {
        let networks = self.networks.first()?;
        networks.lock().unwrap_or_else(std::sync::PoisonError::into_inner).landmarker.readout()
    }

    /// The AU network of the manifest, in the place of a readout.
    pub fn au_model(&self) -> Option<AuModel> {
        let networks = self.networks.first()?;
        networks.lock().unwrap_or_else(std::sync::PoisonError::into_inner).landmarker.au_model().cloned()
    }

    /// What was done so far.
    pub fn effort(&self) -> Effort {
        Effort { detections: self.detections, landmark_runs: self.landmark_runs }
    }

    /// The face in each of up to [`BLOCK`] pictures that follow those of the call before.
    pub fn block(&mut self, pictures: &[RgbImage]) -> Result<Vec<Option<Found>>> {
        let start = self.recent;
        let mut found: Vec<Option<Found>> = if let [before, Some(now)] = start {
            let look = |(ahead, picture): (usize, &RgbImage)| {
                // Twice as far ahead the motion is trusted half as much.
                let share = 0.5 * (ahead + 1) as f32;
                let crop = before.map_or(now, |before| now.extrapolated(&before, share));
                self.with_networks(|n| settle(&mut n.landmarker, picture, crop))
            };
            let results: Vec<(Option<Found>, usize)> =
                self.pool.install(|| pictures.par_iter().enumerate().map(look).collect::<Result<_>>())?;
            self.landmark_runs += results.iter().map(|r| r.1).sum::<usize>();
            results.into_iter().map(|r| r.0).collect()
        } else {
            vec![None; pictures.len()]
        };
        let mut faces: Vec<Option<Vec<Face>>> = vec![None; pictures.len()];
        if start[1].is_none() {
            let detect = |picture: &RgbImage| self.with_networks(|n| n.detector.detect(picture, 0));
            let all = self.pool.install(|| pictures.par_iter().map(detect).collect::<Result<Vec<_>>>())?;
            self.detections += pictures.len();
            faces = all.into_iter().map(Some).collect();
        }
        for (i, picture) in pictures.iter().enumerate() {
            if found[i].is_none() {
                found[i] = self.find_again(picture, faces[i].take())?;
            }
            self.remember(found[i].as_ref());
        }
        let express = |(f, picture): (&mut Option<Found>, &RgbImage)| match f {
            Some(f) => self.with_networks(|n| n.landmarker.express(picture, f)),
            None => Ok(()),
        };
        self.pool.install(|| found.par_iter_mut().zip(pictures).try_for_each(express))?;
        Ok(found)
    }

    /// The networks of the calling thread.
    fn with_networks<T>(&self, work: impl FnOnce(&mut Networks) -> Result<T>) -> Result<T> {
        let at = rayon::current_thread_index().unwrap_or(0) % self.networks.len();
        // A thread that panicked took the whole run with it: nobody sees its networks again.
        work(&mut self.networks[at].lock().unwrap_or_else(std::sync::PoisonError::into_inner))
    }

    /// From the picture just before, else by the detector.
    fn find_again(&mut self, picture: &RgbImage, faces: Option<Vec<Face>>) -> Result<Option<Found>> {
        let mut runs = 0;
        let mut detections = 0;
        let result = self.with_networks(|n| {
            if let [_, Some(crop)] = self.recent {
                let (found, count) = settle(&mut n.landmarker, picture, crop)?;
                runs += count;
                if found.is_some() {
                    return Ok(found);
                }
            }
            let mut faces = faces;
            for level in 0..LEVELS {
                let seen = if let Some(seen) = faces.take() {
                    seen
                } else {
                    detections += 1;
                    n.detector.detect(picture, level)?
                };
                for crop in self.candidates(&seen) {
                    let (found, count) = settle(&mut n.landmarker, picture, crop)?;
                    runs += count;
                    // What a detector takes for a face has to look like one to the landmark network too, and again in
                    // the crop that follows from it: what is no face falls apart when it is looked at twice.
                    let Some(first) = found.filter(|f| f.presence >= FRESH_PRESENCE) else { continue };
                    runs += 1;
                    let second = n.landmarker.find(picture, &first.crop)?;
                    if let Some(second) = second.filter(|f| f.presence >= FRESH_PRESENCE) {
                        return Ok(Some(second));
                    }
                }
            }
            Ok(None)
        })?;
        self.landmark_runs += runs;
        self.detections += detections;
        Ok(result)
    }

    /// Where to look for the face, best first: the face that was lost a moment ago, else those that were asked for.
    fn candidates(&self, faces: &[Face]) -> Vec<Crop> {
        let mut crops: Vec<(&Face, Crop)> = faces.iter().filter_map(|f| Some((f, f.crop(self.margin)?))).collect();
        if let Some((last, _)) = self.last_seen.filter(|(_, ago)| *ago <= MEMORY) {
            let away = |c: &Crop| (c.center[0] - last.center[0]).hypot(c.center[1] - last.center[1]);
            crops.retain(|(_, c)| away(c) < last.side);
            crops.sort_by(|a, b| away(&a.1).total_cmp(&away(&b.1)));
        } else {
            match self.choice {
                FirstFace::Largest => crops.sort_by(|a, b| b.0.area().total_cmp(&a.0.area())),
                FirstFace::First => crops.sort_by(|a, b| b.0.score.total_cmp(&a.0.score)),
            }
        }
        crops.truncate(CANDIDATES);
        crops.into_iter().map(|(_, crop)| crop).collect()
    }

    fn remember(&mut self, found: Option<&Found>) {
        let crop = found.map(|f| self.recent[1].map_or(f.crop, |before| steadied(&before, &f.crop)));
        self.recent = [self.recent[1], crop];
        match (crop, &mut self.last_seen) {
            (Some(crop), _) => self.last_seen = Some((crop, 0)),
            (None, Some((_, ago))) => *ago += 1,
            (None, None) => {}
        }
    }
}

/// The crop between the one before and the new one: near the former where the difference is noise, at the latter where
/// the face moves (the idea of the one-euro filter).
fn steadied(before: &Crop, new: &Crop) -> Crop {
    let weight = (STEADY + before.distance(new) / 0.03).min(1.0);
    before.blended(new, weight)
}

/// Runs the landmark network until its crop is where the face is; also says how often it ran.
fn settle(landmarker: &mut Landmarker, picture: &RgbImage, crop: Crop) -> Result<(Option<Found>, usize)> {
    let mut crop = crop;
    for attempt in 1.. {
        let found = landmarker.find(picture, &crop)?;
        let Some(f) = &found else { return Ok((None, attempt)) };
        if attempt == CROP_ATTEMPTS || crop.distance(&f.crop) < CROP_TOLERANCE {
            return Ok((found, attempt));
        }
        crop = f.crop;
    }
    Ok((None, 0))
}
