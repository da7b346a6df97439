//! A dataset as rows: what is known of every frame of every take, chosen or not. Tables, statistics and report are made
//! from these rows, whether they come from a build or from the tables of a dataset.

use risorius_formats::{AttributeTable, Camera};

use crate::balance::{self, Bins};

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FrameState {
    /// Trusted, posed and no repetition: it may be chosen.
    Usable,
    /// The tracker had no face.
    Lost,
    /// Tracked below the confidence limit.
    Unsure,
    /// A value is missing or not a number.
    Incomplete,
    /// Without a camera.
    Unposed,
    /// The same picture as the frame before.
    Repeated,
}

impl FrameState {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Usable, Self::Lost, Self::Unsure, Self::Incomplete, Self::Unposed, Self::Repeated];

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Usable => "usable",
            Self::Lost => "lost",
            Self::Unsure => "unsure",
            Self::Incomplete => "incomplete",
            Self::Unposed => "unposed",
            Self::Repeated => "repeated",
        }
    }

    /// The state of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.name() == name)
    }
}

/// One frame of a take.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameRow {
    /// Its number in the take, from 0.
    pub frame: u32,
    /// When, since the take's first frame.
    pub timestamp_nanos: i64,
    /// What became of it.
    pub state: FrameState,
    /// The tracker's confidence, 0–1.
    pub confidence: Option<f32>,
    /// Variance of the Laplacian; the higher, the sharper.
    pub sharpness: Option<f32>,
    /// Mean luma, 0–255.
    pub luma_mean: Option<f32>,
    /// Share of clipped pixels, 0–1.
    pub clipped_share: Option<f32>,
    /// Its id in the dataset, where it was chosen.
    pub id: Option<String>,
    /// `train`, `val` or `none`, where it was chosen.
    pub split: Option<&'static str>,
    /// `ok`, or why it has no region masks; `None` where nobody looked.
    pub masks: Option<String>,
    /// Smoothed intensities 0–5, attribute after attribute, where they can be trusted.
    pub intensities: Option<Vec<f32>>,
    /// Its camera in the dataset's world, for the full-size picture.
    pub camera: Option<Camera>,
    /// Yaw and pitch of the camera as seen from the head, degrees.
    pub view: Option<[f64; 2]>,
    /// Whether the camera lies between found ones instead of being found.
    pub interpolated: bool,
}

/// The frames of one take.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TakeRows {
    /// The take's name.
    pub name: String,
    /// All its frames, in order.
    pub frames: Vec<FrameRow>,
}

/// All takes of a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct Rows {
    /// The attributes.
    pub table: AttributeTable,
    /// The takes, in order.
    pub takes: Vec<TakeRows>,
}

/// A frame that may be chosen, with what a choice looks at.
#[derive(Clone, Copy, Debug)]
pub struct UsableRow<'a> {
    /// Index of its take.
    pub take: usize,
    /// Its row.
    pub row: &'a FrameRow,
    /// Its intensities.
    pub intensities: &'a [f32],
    /// Yaw and pitch of its camera, degrees.
    pub view: [f64; 2],
}

impl Rows {
    /// The usable frames, take after take.
    pub fn usable(&self) -> Vec<UsableRow<'_>> {
        let of = |(take, rows): (usize, &'_ TakeRows)| -> Vec<(usize, usize)> {
            let usable = rows.frames.iter().enumerate().filter(|(_, f)| f.state == FrameState::Usable);
            usable.map(|(i, _)| (take, i)).collect()
        };
        let places: Vec<(usize, usize)> = self.takes.iter().enumerate().flat_map(of).collect();
        let row = |(take, i): (usize, usize)| {
            let row = &self.takes[take].frames[i];
            let intensities = row.intensities.as_deref()?;
            Some(UsableRow { take, row, intensities, view: row.view.unwrap_or_default() })
        };
        places.into_iter().filter_map(row).collect()
    }

    /// Which attributes are active.
    pub fn active(&self) -> Vec<bool> {
        self.table.attributes.iter().map(|a| a.active).collect()
    }

    /// The levels of usable frames.
    pub fn levels(&self, usable: &[UsableRow<'_>], levels: usize, bins: Bins) -> Vec<Vec<usize>> {
        let of = |u: &UsableRow<'_>| balance::levels_of_frame(u.intensities, &self.table.attributes, levels, bins);
        usable.iter().map(of).collect()
    }
}
