//! What was seen in each frame, kept on disk between the two passes so that memory does not grow with the video.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use risorius_formats::FormatError;

use super::landmarks::Found;
use crate::error::Result;
use crate::gaze::EYE_NUMBERS;

/// What was seen of the face in one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// The 68 points, pixels of the picture.
    pub points_px: [[f32; 2]; 68],
    /// Probability that this is a face, 0–1.
    pub presence: f32,
    /// Features of the AU regressor; empty where the landmark network has no mesh.
    pub features: Vec<f32>,
    /// Numbers of the eyes, where the landmark network has a mesh.
    pub eyes: Option<Box<[f32; EYE_NUMBERS]>>,
}

impl From<Found> for Observation {
    fn from(found: Found) -> Self {
        Self { points_px: found.points_px, presence: found.presence, features: found.features, eyes: found.eyes }
    }
}

/// Numbers of an observation before its features: what there is, presence, points.
const HEAD: usize = 2 + 136;
/// In the first number: there is a face, it has features, it has eyes.
const FACE: f32 = 1.0;
const WITH_FEATURES: f32 = 1.0;
const WITH_EYES: f32 = 2.0;

/// A file of observations, one after the other, that is removed with its last handle.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    file: BufWriter<File>,
    features: usize,
    count: u32,
}

impl Recorder {
    /// Begins a file at `path` for observations with `features` features.
    pub fn create(path: &Path, features: usize) -> Result<Self> {
        let file = File::create(path).map_err(|e| FormatError::io(path, "create", &e))?;
        Ok(Self { path: path.to_owned(), file: BufWriter::with_capacity(1 << 18, file), features, count: 0 })
    }

    /// Appends the next frame's observation; `None` where there is no face. Features of another number count as none.
    pub fn push(&mut self, observation: Option<&Observation>) -> Result<()> {
        let mut numbers: Vec<f32> = Vec::with_capacity(HEAD + self.features + EYE_NUMBERS);
        if let Some(o) = observation {
            let features = o.features.len() == self.features;
            let kind = FACE + f32::from(features) * WITH_FEATURES + f32::from(o.eyes.is_some()) * WITH_EYES;
            numbers.extend([kind, o.presence]);
            numbers.extend(o.points_px.iter().flatten());
            numbers.extend(o.features.iter().filter(|_| features));
            numbers.resize(HEAD + self.features, 0.0);
            numbers.extend(o.eyes.iter().flat_map(|e| e.iter()));
        }
        numbers.resize(HEAD + self.features + EYE_NUMBERS, 0.0);
        let bytes: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.file.write_all(&bytes).map_err(|e| FormatError::io(&self.path, "write", &e))?;
        self.count += 1;
        Ok(())
    }

    /// Ends the file; it can now be read as often as needed.
    pub fn finish(mut self) -> Result<Recording> {
        self.file.flush().map_err(|e| FormatError::io(&self.path, "write", &e))?;
        Ok(Recording { path: self.path, features: self.features, count: self.count })
    }
}

/// A finished file of observations.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    features: usize,
    count: u32,
}

impl Recording {
    /// How many there are, faces or not.
    pub fn len(&self) -> usize {
        self.count as usize
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// All observations in their order.
    pub fn read(&self) -> Result<impl Iterator<Item = Result<Option<Observation>>>> {
        let file = File::open(&self.path).map_err(|e| FormatError::io(&self.path, "open", &e))?;
        let mut file = BufReader::with_capacity(1 << 18, file);
        let mut bytes = vec![0u8; 4 * (HEAD + self.features + EYE_NUMBERS)];
        let (path, count) = (self.path.clone(), self.features);
        Ok((0..self.count).map(move |_| {
            file.read_exact(&mut bytes).map_err(|e| FormatError::io(&path, "read", &e))?;
            let mut numbers = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            let mut next = || numbers.next().unwrap_or(0.0);
            let kind = next();
            if kind == 0.0 {
                return Ok(None);
            }
            let presence = next();
            let points_px = std::array::from_fn(|_| [next(), next()]);
            let mut features: Vec<f32> = (0..count).map(|_| next()).collect();
            let eyes: [f32; EYE_NUMBERS] = std::array::from_fn(|_| next());
            if kind != FACE + WITH_FEATURES && kind < FACE + WITH_FEATURES + WITH_EYES {
                features.clear();
            }
            let eyes = (kind >= FACE + WITH_EYES).then(|| Box::new(eyes));
            Ok(Some(Observation { points_px, presence, features, eyes }))
        }))
    }

    /// Up to `count` observations of faces, spread evenly over the video.
    pub fn sample(&self, count: usize) -> Result<Vec<Observation>> {
        let step = self.len().div_ceil(count.max(1)).max(1);
        let mut sample = Vec::new();
        let mut due = 0;
        for (i, observation) in self.read()?.enumerate() {
            // A frame without a face passes its turn on to the next.
            if i >= due
                && let Some(observation) = observation?
            {
                sample.push(observation);
                due = i + step;
            }
        }
        Ok(sample)
    }

    /// Removes the file.
    pub fn remove(self) -> Result<()> {
        Ok(std::fs::remove_file(&self.path).map_err(|e| FormatError::io(&self.path, "remove", &e))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn observations_come_back_as_they_were() {
        let dir = tempfile::tempdir().unwrap();
        let observation = |k: f32, features: usize| Observation {
            points_px: std::array::from_fn(|i| [k + i as f32, 2.0 * k]),
            presence: 0.9,
            features: (0..features).map(|i| k * i as f32).collect(),
            eyes: (k > 1.0).then(|| Box::new([k; EYE_NUMBERS])),
        };
        let all = [Some(observation(1.0, 5)), None, Some(observation(2.0, 0)), Some(observation(3.0, 5)), None];
        let mut recorder = Recorder::create(&dir.path().join("o"), 5).unwrap();
        for o in &all {
            recorder.push(o.as_ref()).unwrap();
        }
        let recording = recorder.finish().unwrap();
        assert_eq!(recording.read().unwrap().collect::<Result<Vec<_>>>().unwrap(), all);
        assert_eq!(recording.sample(2).unwrap().len(), 2);
        assert_eq!(recording.sample(100).unwrap().len(), 3);
        recording.remove().unwrap();
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
