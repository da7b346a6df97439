//! Ways from the names of images to frames, and the rules that are usual among tools.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use super::Subject;
use super::names::{Named, Numbered, natural_order, numberings, stem};

/// Steps between frames that are tried one by one.
const MOST_STEP: u64 = 400;
/// Pictures per second that tools take from a video.
pub(super) const RATES: [f64; 19] =
    [0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0, 23.976, 24.0, 25.0, 29.97, 30.0, 50.0, 60.0];

/// What the user states about the names of a model's images; all `None` lets names and landmarks decide.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Numbering {
    /// The number of the take's first frame.
    pub first: Option<u32>,
    /// Frames of the take from one number to the next.
    pub step: Option<f64>,
    /// Only images of this folder of the model count.
    pub folder: Option<String>,
}

impl Numbering {
    /// Frame 0 has the number `first`, and numbers are frames.
    pub fn from_first(first: u32) -> Self {
        Self { first: Some(first), step: None, folder: None }
    }

    /// Whether the numbers are stated, not only the folder.
    pub(super) fn is_stated(&self) -> bool {
        self.first.is_some() || self.step.is_some()
    }
}

/// What frames are found by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Key {
    /// The file names of the take's pictures.
    FileName,
    /// The numbers in the file names of the take's pictures.
    PictureNumber,
    /// The number in the image's name.
    Number,
    /// The place of the image's name among all, from 0.
    Order,
}

/// How the frame of an image follows from its name: frame = `offset` + `step` · (number − `start`), rounded.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Rule {
    pub(crate) key: Key,
    /// The model's folder, where it has several.
    pub(crate) folder: Option<String>,
    pub(crate) start: u64,
    pub(crate) offset: f64,
    pub(crate) step: f64,
    /// Images that there are.
    pub(crate) images: usize,
}

impl Rule {
    pub(super) fn by_name(&self) -> bool {
        matches!(self.key, Key::FileName | Key::PictureNumber)
    }

    /// Whether it is what every reader would have expected: file names, or numbers counted from 0.
    pub(crate) fn is_plain(&self) -> bool {
        let from_0 = self.key == Key::Number && self.step == 1.0 && self.offset == self.start as f64;
        self.folder.is_none() && (from_0 || self.key == Key::FileName)
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { start, offset, step, .. } = self;
        match self.key {
            Key::FileName => write!(f, "by file name")?,
            Key::PictureNumber => write!(f, "by the numbers in the file names")?,
            Key::Number if *step == 1.0 => {
                let first = *start as f64 - offset;
                write!(f, "by number, counted from {first}")?;
            }
            Key::Number => {
                write!(
                    f,
                    "by number, {} frames from one to the next, number {start} being frame {offset}",
                    Tidy(*step)
                )?;
            }
            Key::Order if *step == 1.0 => write!(f, "by the order of their names, the first being frame {offset}")?,
            Key::Order => {
                write!(f, "by the order of their names, {} frames apart, the first being frame {offset}", Tidy(*step))?;
            }
        }
        match &self.folder {
            Some(folder) if folder.is_empty() => write!(f, ", only those in no folder"),
            Some(folder) => write!(f, ", only those in the folder `{folder}`"),
            None => Ok(()),
        }
    }
}

/// A number with three decimals at most.
struct Tidy(f64);

impl fmt::Display for Tidy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", (self.0 * 1e3).round() / 1e3)
    }
}

/// Images that may be frames of the take, and what they are found by.
#[derive(Clone, Debug)]
pub(crate) struct Way {
    pub(crate) key: Key,
    pub(crate) folder: Option<String>,
    pub(crate) images: usize,
    pub(super) numbered: Numbered,
    /// The frame of each number, where names tell it.
    named: Option<BTreeMap<u64, u32>>,
}

impl Way {
    /// Image by frame. Of several images for one frame the one that lies nearest counts, and of those the first.
    pub(super) fn frames(&self, rule: &Rule, subject: &Subject<'_>) -> BTreeMap<u32, u32> {
        let mut found: BTreeMap<u32, (f64, u32)> = BTreeMap::new();
        for &(number, image) in &self.numbered.images {
            let exact = match &self.named {
                Some(named) => named.get(&number).map(|&frame| f64::from(frame)),
                None => Some(rule.offset + rule.step * (number - rule.start.min(number)) as f64),
            };
            let Some(exact) = exact.filter(|e| (-0.5..f64::from(subject.frames) - 0.5).contains(e)) else { continue };
            let frame = exact.round().max(0.0);
            let off = (exact - frame).abs();
            let slot = found.entry(frame as u32).or_insert((off, image));
            if off < slot.0 {
                *slot = (off, image);
            }
        }
        found.into_iter().map(|(frame, (_, image))| (frame, image)).collect()
    }

    /// A rule for this way.
    pub(super) fn rule(&self, offset: f64, step: f64) -> Rule {
        let (key, folder, images) = (self.key, self.folder.clone(), self.images);
        Rule { key, folder, start: self.numbered.first(), offset, step, images }
    }

    /// Whether `rule` is one for this way.
    pub(super) fn is_of(&self, rule: &Rule) -> bool {
        self.named.is_none()
            && self.key == rule.key
            && self.folder == rule.folder
            && self.images == rule.images
            && self.numbered.first() == rule.start
    }

    /// From the first number to the last.
    pub(super) fn span(&self) -> u64 {
        self.numbered.last() - self.numbered.first()
    }

    pub(super) fn is_named(&self) -> bool {
        self.named.is_some()
    }
}

/// All ways from images to frames: names first, numbers next, the order of names last.
pub(super) fn ways(groups: &BTreeMap<String, Vec<Named>>, subject: &Subject<'_>) -> Vec<Way> {
    let mut sets: Vec<(Option<String>, Vec<Named>)> = Vec::new();
    let mut all: Vec<Named> = groups.values().flatten().cloned().collect();
    let distinct: BTreeSet<String> = all.iter().map(|i| stem(&i.file)).collect();
    // Parts of one capture in several folders have different names; captures of their own have the same.
    if groups.len() == 1 || distinct.len() == all.len() {
        all.sort_by(|a, b| natural_order(&a.file, &b.file));
        sets.push((None, all));
    }
    if groups.len() > 1 {
        let mut folders: Vec<(&String, &Vec<Named>)> = groups.iter().collect();
        folders.sort_by_key(|(_, images)| std::cmp::Reverse(images.len()));
        sets.extend(folders.into_iter().map(|(name, images)| (Some(name.clone()), images.clone())));
    }
    let mut found: Vec<Way> = Vec::new();
    for (folder, images) in &sets {
        found.extend(subject.pictures.and_then(|p| by_file_name(folder.as_ref(), images, p)));
    }
    for (folder, images) in &sets {
        found.extend(subject.pictures.and_then(|p| by_picture_number(folder.as_ref(), images, p)));
    }
    let mut plain: Vec<Way> = Vec::new();
    for (folder, images) in &sets {
        plain.extend(numberings(images).into_iter().map(|numbered| Way {
            key: if numbered.by_order { Key::Order } else { Key::Number },
            folder: folder.clone(),
            images: images.len(),
            numbered,
            named: None,
        }));
    }
    // Stable: folders stay in their order.
    plain.sort_by_key(|way| way.key == Key::Order);
    found.extend(plain);
    found
}

/// Names agree where half of what could agree does.
fn agrees(matched: usize, images: usize, pictures: usize) -> bool {
    matched > 0 && 2 * matched >= images.min(pictures)
}

fn by_file_name(folder: Option<&String>, images: &[Named], pictures: &[String]) -> Option<Way> {
    let frames: BTreeMap<String, u32> = pictures.iter().zip(0..).map(|(name, frame)| (stem(name), frame)).collect();
    // `a.jpg` and `a.png` side by side: the endings tell them apart.
    let whole: BTreeMap<String, u32> =
        pictures.iter().zip(0..).map(|(name, frame)| (name.to_lowercase(), frame)).collect();
    let frame_of = |file: &str| {
        if frames.len() == pictures.len() { frames.get(&stem(file)) } else { whole.get(&file.to_lowercase()) }
    };
    let matched: Vec<(u64, u32)> = images.iter().filter_map(|i| Some((u64::from(*frame_of(&i.file)?), i.id))).collect();
    named_way(Key::FileName, folder, images.len(), matched, pictures.len(), |frame| frame as u32)
}

fn by_picture_number(folder: Option<&String>, images: &[Named], pictures: &[String]) -> Option<Way> {
    let own: Vec<Named> = pictures.iter().zip(0..).map(|(name, id)| Named { id, file: name.clone() }).collect();
    let own = numberings(&own).into_iter().find(|n| !n.by_order)?;
    let frames: BTreeMap<u64, u32> = own.images.iter().copied().collect();
    let theirs = numberings(images).into_iter().find(|n| !n.by_order)?;
    let matched: Vec<(u64, u32)> = theirs.images.into_iter().filter(|(n, _)| frames.contains_key(n)).collect();
    named_way(Key::PictureNumber, folder, images.len(), matched, pictures.len(), |n| {
        frames.get(&n).copied().unwrap_or(0)
    })
}

fn named_way(
    key: Key,
    folder: Option<&String>,
    images: usize,
    mut matched: Vec<(u64, u32)>,
    pictures: usize,
    frame_of: impl Fn(u64) -> u32,
) -> Option<Way> {
    if !agrees(matched.len(), images, pictures) {
        return None;
    }
    matched.sort_unstable();
    let named = matched.iter().map(|&(number, _)| (number, frame_of(number))).collect();
    let numbered = Numbered { images: matched, by_order: false };
    Some(Way { key, folder: folder.cloned(), images, numbered, named: Some(named) })
}

/// The usual rules for a way, the most usual first.
pub(super) fn usual(way: &Way, subject: &Subject<'_>, numbering: &Numbering) -> Vec<Rule> {
    if way.is_named() {
        return if numbering.is_stated() { Vec::new() } else { vec![way.rule(0.0, 1.0)] };
    }
    let (start, end) = (way.numbered.first(), way.numbered.last());
    let from = |first: u64, step: f64| way.rule((start as f64 - first as f64) * step, step);
    if numbering.is_stated() {
        let step = numbering.step.unwrap_or(1.0);
        return match (way.key, numbering.first) {
            (Key::Order, _) => Vec::new(),
            (_, Some(first)) => vec![from(u64::from(first), step)],
            (_, None) => firsts(start, end, subject).into_iter().map(|first| from(first, step)).collect(),
        };
    }
    let last = f64::from(subject.frames.saturating_sub(1));
    let span = way.span() as f64;
    let mut rules: Vec<Rule> = firsts(start, end, subject).into_iter().map(|first| from(first, 1.0)).collect();
    if span < 1.0 {
        return rules;
    }
    let whole = ((last / span) as u64).min(MOST_STEP);
    let mut steps: Vec<f64> = (2..=whole).map(|s| s as f64).collect();
    let by_rate = RATES.iter().map(|rate| subject.fps / rate).filter(|s| s.fract() > 1e-3 && s * span < last + 1.0);
    steps.extend(by_rate);
    for step in steps {
        let mut offsets = vec![0.0, start as f64 * step, (start as f64 - 1.0) * step, (step / 2.0).floor()];
        offsets.retain(|o| *o >= 0.0 && o + step * span < last + 1.0);
        rules.extend(offsets.into_iter().map(|offset| way.rule(offset, step)));
    }
    rules
}

/// Numbers that the first frame may have, the most usual first.
fn firsts(start: u64, end: u64, subject: &Subject<'_>) -> Vec<u64> {
    let frames = u64::from(subject.frames);
    let mut firsts = match (start, end) {
        (0, _) => vec![0],
        // 1 … N for N frames.
        (_, end) if end == frames => vec![1, 0, start],
        // A camera's own counter, or one that goes on from another capture.
        (start, end) if end > frames => vec![start, 1, 0],
        (1, _) => vec![1, 0],
        _ => vec![0, 1, start],
    };
    firsts.dedup();
    firsts
}
