//! What the names of a model's images say: their folder, and the numbers in them.
//!
//! Tools name pictures in many ways: `frame_00001.png`, `DSC_0451.JPG`, `left/000012 (1).jpg`, `20240131_120501.345.png`. A
//! number that is the same in all names (a date, a copy's "(1)") says nothing about the order; one that differs does.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};

/// Longest run of digits that is taken for a number.
const MOST_DIGITS: usize = 19;

/// An image of a model, by name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Named {
    /// Its id in the model.
    pub(crate) id: u32,
    /// The name without folders.
    pub(crate) file: String,
}

/// Images with numbers, in the order of the numbers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Numbered {
    /// (number, image id), rising; numbers may repeat.
    pub(crate) images: Vec<(u64, u32)>,
    /// Whether the numbers are places in the order of names, from 0, and not numbers in the names.
    pub(crate) by_order: bool,
}

impl Numbered {
    /// The smallest number.
    pub(crate) fn first(&self) -> u64 {
        self.images.first().map_or(0, |i| i.0)
    }

    /// The largest number.
    pub(crate) fn last(&self) -> u64 {
        self.images.last().map_or(0, |i| i.0)
    }

    /// How many numbers there are between the first and the last, both counted.
    pub(crate) fn distinct(&self) -> usize {
        self.images.iter().map(|i| i.0).collect::<BTreeSet<_>>().len()
    }
}

/// The folder and the file of an image's name; COLMAP writes `/`, tools on Windows `\`.
pub(crate) fn split(name: &str) -> (&str, &str) {
    match name.rfind(['/', '\\']) {
        Some(at) => (&name[..at], &name[at + 1..]),
        None => ("", name),
    }
}

/// A file's name without its ending, in lower case: the same picture as JPEG and PNG is one picture.
pub(crate) fn stem(file: &str) -> String {
    let ending = file.rfind('.').filter(|&at| at > 0 && file[at + 1..].bytes().any(|b| b.is_ascii_alphabetic()));
    file[..ending.unwrap_or(file.len())].to_lowercase()
}

/// The images of a model by folder, each in the natural order of names.
pub(crate) fn by_folder<'a>(images: impl Iterator<Item = (u32, &'a str)>) -> BTreeMap<String, Vec<Named>> {
    let mut folders: BTreeMap<String, Vec<Named>> = BTreeMap::new();
    for (id, name) in images {
        let (folder, file) = split(name);
        folders.entry(folder.to_owned()).or_default().push(Named { id, file: file.to_owned() });
    }
    for images in folders.values_mut() {
        images.sort_by(|a, b| natural_order(&a.file, &b.file).then(a.id.cmp(&b.id)));
    }
    folders
}

/// The ways to number `images`: by each run of digits that tells them apart, the last run first, then by their order.
///
/// Where no run tells all apart, the one that comes nearest counts, so that copies (`12 (1).png`) do not hide the numbers.
pub(crate) fn numberings(images: &[Named]) -> Vec<Numbered> {
    let runs: Vec<Vec<Option<u64>>> = images.iter().map(|i| digit_runs(&stem(&i.file))).collect();
    // Names without any digits (a face among frames) take no part.
    let places = runs.iter().map(Vec::len).filter(|n| *n > 0).min().unwrap_or(0);
    let numbered = |from_end: bool, place: usize| {
        let mut numbers: Vec<(u64, u32)> = Vec::new();
        for (run, image) in runs.iter().zip(images) {
            let at = if from_end { run.len().checked_sub(place + 1) } else { Some(place) };
            if let Some(number) = at.and_then(|at| run.get(at)).copied().flatten() {
                numbers.push((number, image.id));
            }
        }
        numbers.sort_unstable();
        Numbered { images: numbers, by_order: false }
    };
    let mut found: Vec<Numbered> = Vec::new();
    for way in (0..places).map(|k| numbered(true, k)).chain((0..places).map(|k| numbered(false, k))) {
        if !way.images.is_empty() && !found.contains(&way) {
            found.push(way);
        }
    }
    let most = found.iter().map(Numbered::distinct).max().unwrap_or(0);
    // A single image has nothing to be told apart from.
    found.retain(|way| way.distinct() == most && (most > 1 || way.images.len() == 1));
    let order = images.iter().zip(0..).map(|(image, place)| (place, image.id)).collect();
    found.push(Numbered { images: order, by_order: true });
    found
}

/// The runs of digits of a name; `None` for one that is too long to be a number.
fn digit_runs(stem: &str) -> Vec<Option<u64>> {
    let runs = stem.split(|c: char| !c.is_ascii_digit()).filter(|run| !run.is_empty());
    runs.map(|run| if run.len() <= MOST_DIGITS { run.parse().ok() } else { None }).collect()
}

/// Orders names as people do: runs of digits by their value.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    while let (Some(p), Some(q)) = (x.first(), y.first()) {
        let order = if p.is_ascii_digit() && q.is_ascii_digit() {
            let (m, n) = (take_digits(&mut x), take_digits(&mut y));
            m.len().cmp(&n.len()).then_with(|| m.cmp(n))
        } else {
            (x, y) = (&x[1..], &y[1..]);
            p.cmp(q)
        };
        if order.is_ne() {
            return order;
        }
    }
    x.len().cmp(&y.len()).then_with(|| a.cmp(b))
}

/// Takes a run of digits off the front, without its leading zeros.
fn take_digits<'a>(bytes: &mut &'a [u8]) -> &'a [u8] {
    let end = bytes.iter().position(|b| !b.is_ascii_digit()).unwrap_or(bytes.len());
    let (run, rest) = bytes.split_at(end);
    *bytes = rest;
    &run[run.iter().take_while(|&&b| b == b'0').count()..]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn first_way(names: &[&str]) -> Vec<u64> {
        let images: Vec<Named> =
            names.iter().zip(0..).map(|(name, id)| Named { id, file: (*name).to_owned() }).collect();
        numberings(&images)[0].images.iter().map(|i| i.0).collect()
    }

    #[test]
    fn the_number_that_differs_counts() {
        assert_eq!(first_way(&["frame_00001.png", "frame_00002.png"]), [1, 2]);
        assert_eq!(first_way(&["take2_0005_left.png", "take2_0006_left.png"]), [5, 6]);
        assert_eq!(first_way(&["0003_20240131.png", "0004_20240131.png"]), [3, 4]);
        assert_eq!(first_way(&["DSC_0451 (1).JPG", "DSC_0452 (1).JPG"]), [451, 452]);
        assert_eq!(first_way(&["IMG_0001.jpg", "IMG_0002 (1).jpg", "IMG_0003.jpg"]), [1, 2, 3]);
        assert_eq!(first_way(&["face.png", "12.png", "13.png"]), [12, 13]);
        // Nothing but the order is left.
        assert_eq!(first_way(&["a.png", "b.png"]), [0, 1]);
        assert_eq!(first_way(&["99999999999999999999999999.png", "99999999999999999999999998.png"]), [0, 1]);
    }

    #[test]
    fn folders_and_endings_are_no_part_of_a_picture_s_name() {
        let folders = by_folder([(1, "a/x10.JPG"), (2, "a/x9.JPG"), (3, r"b\c\x1.png"), (4, "x2.png")].into_iter());
        assert_eq!(folders.keys().collect::<Vec<_>>(), ["", "a", r"b\c"]);
        assert_eq!(folders["a"].iter().map(|i| i.id).collect::<Vec<_>>(), [2, 1]);
        assert_eq!([stem("X10.JPG"), stem("12.345"), stem(".png")], ["x10", "12.345", ".png"]);
    }
}
