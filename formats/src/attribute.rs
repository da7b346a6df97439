//! Attributes: AU intensities normalised to −1..1 by the paper's eq. 1, with its guards (fact sheet §7.1, §8.7).
//!
//! ```text
//! AU' = min((AU − AU_min) / (s · AU_max − AU_min) · 2 − 1, 1)      s = 0.8   (`au_max_scale`)
//! ```

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{ActionUnit, Attribute, AuScale, ErrorKind, FormatError, Intensity, RegionTable, Result, atomic};

/// The paper's factor on `au_max` (its α).
pub const AU_MAX_SCALE: f32 = 0.8;
/// Below this width of eq. 1's range an AU carries nothing but noise and is inactive.
pub const MIN_RANGE: f32 = 0.1;

/// One attribute: an AU, its region and its range in the capture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AttributeSpec {
    /// The action unit.
    pub unit: ActionUnit,
    /// Index of its region (mask label − 1).
    pub region: usize,
    /// Smallest smoothed intensity over all valid frames, 0–5.
    pub au_min: f32,
    /// Largest smoothed intensity over all valid frames, 0–5.
    pub au_max: f32,
    /// The factor on `au_max` in eq. 1.
    pub au_max_scale: f32,
    /// The intensity of the capture's neutral face, 0–5.
    pub neutral: f32,
    /// Whether the AU moves enough to be learned; inactive ones are −1 everywhere and out of the loss.
    pub active: bool,
}

impl AttributeSpec {
    /// The attribute of `unit` with a range measured on the capture; decides whether it is active. One whose range is
    /// empty, turned round or no number is not.
    pub fn from_range(unit: ActionUnit, region: usize, au_min: f32, au_max: f32, neutral: f32) -> Self {
        let width = AU_MAX_SCALE * au_max - au_min;
        let active = width.is_finite() && width >= MIN_RANGE;
        Self { unit, region, au_min, au_max, au_max_scale: AU_MAX_SCALE, neutral, active }
    }

    fn width(&self) -> f32 {
        self.au_max_scale * self.au_max - self.au_min
    }

    /// What converts between this AU's intensities, attributes and activations.
    pub fn scale(&self) -> AuScale {
        AuScale::new(self)
    }

    /// The attribute of the capture's neutral face.
    pub fn neutral_attribute(&self) -> Attribute {
        self.scale().attribute(Intensity(self.neutral))
    }
}

/// `attributes.toml`: the regions and every attribute in model order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AttributeTable {
    /// Names of the regions; mask label = index + 1.
    pub regions: Vec<String>,
    /// The attributes, region after region.
    #[serde(rename = "attribute")]
    pub attributes: Vec<AttributeSpec>,
}

impl AttributeTable {
    /// Index of `unit`.
    pub fn index_of(&self, unit: ActionUnit) -> Option<usize> {
        self.attributes.iter().position(|a| a.unit == unit)
    }

    /// The regions that an AU acts in beside its own, where the table has regions of these names.
    ///
    /// AU09 belongs to the eyes, but its muscle (levator labii superioris alaeque nasi, FACS) lifts the lip and wrinkles the
    /// nose, and the brows come down with it: on a capture with exact truth the mouth's landmarks move five times as far as
    /// those of the eyes.
    pub fn others_of(&self, attribute: &AttributeSpec) -> impl Iterator<Item = usize> {
        const NOSE_WRINKLER: ActionUnit = ActionUnit(9);
        let (own, everywhere) = (attribute.region, attribute.unit == NOSE_WRINKLER);
        let known = |name: &str| ["brow", "eye", "mouth"].contains(&name);
        (0..self.regions.len()).filter(move |&r| everywhere && r != own && known(&self.regions[r]))
    }

    /// The AUs of each region as indices into `attributes`.
    pub fn groups(&self) -> Vec<Vec<usize>> {
        (0..self.regions.len())
            .map(|r| (0..self.attributes.len()).filter(|&k| self.attributes[k].region == r).collect())
            .collect()
    }

    /// The regions and units without their ranges.
    pub fn region_table(&self) -> RegionTable {
        let region = |(index, name): (usize, &String)| crate::region::Region {
            name: name.clone(),
            units: self.attributes.iter().filter(|a| a.region == index).map(|a| a.unit).collect(),
        };
        RegionTable { regions: self.regions.iter().enumerate().map(region).collect() }
    }

    /// Parses `attributes.toml` and checks it.
    pub fn parse(text: &str) -> Result<Self> {
        let table: Self = toml::from_str(text).map_err(|e| toml_error(&e, text))?;
        table.validate()?;
        Ok(table)
    }

    /// Reads `attributes.toml`.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).map_err(|e| FormatError::io(path, "read", &e))?;
        Self::parse(&text)
            .map_err(|e| e.in_file(path).or_hint("the file is written by `dataset build`; build the dataset again"))
    }

    /// Writes `attributes.toml`, whole or not at all.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let text =
            toml::to_string(self).map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(&path))?;
        atomic::write_file(path, text.as_bytes())
    }

    fn validate(&self) -> Result<()> {
        let fail = |message: String| Err(FormatError::new(ErrorKind::Inconsistent, message));
        self.region_table().validate()?;
        for a in &self.attributes {
            if a.region >= self.regions.len() {
                return fail(format!("`{}` names region {} of {}", a.unit, a.region, self.regions.len()));
            }
            if ![a.au_min, a.au_max, a.au_max_scale, a.neutral].iter().all(|v| v.is_finite()) {
                return fail(format!("`{}` has a range that is not a number", a.unit));
            }
            // Written so that a width that overflows is refused as well.
            if a.active && !(MIN_RANGE..=f32::MAX).contains(&a.width()) {
                return fail(format!("`{}` is active but its range {}..{} is empty", a.unit, a.au_min, a.au_max));
            }
        }
        if self.attributes.windows(2).any(|w| w[0].region > w[1].region) {
            return fail("attributes must stand region after region".to_owned());
        }
        Ok(())
    }
}

/// A TOML error with its line.
pub(crate) fn toml_error(error: &toml::de::Error, text: &str) -> FormatError {
    if text.trim().is_empty() {
        return FormatError::new(ErrorKind::Empty, "is empty");
    }
    let line = error.span().map(|s| text[..s.start.min(text.len())].matches('\n').count() as u64 + 1);
    let result = FormatError::syntax(error.message().trim().replace('\n', ", "));
    match line {
        Some(line) => result.at_line(line),
        None => result,
    }
}
