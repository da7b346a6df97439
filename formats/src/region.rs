//! The face regions and which AU belongs to which: many AUs to one region mask (paper, figure 3; fact sheet §6.1).

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::attribute::toml_error;
use crate::{ActionUnit, ErrorKind, FormatError, Result};

/// One region mask and its AUs, in the model's order.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Region {
    /// A short name, such as `brow`.
    pub name: String,
    /// The AUs that may change what lies in this region.
    pub units: Vec<ActionUnit>,
}

/// All regions; the mask label of a region is its index + 1, label 0 is the rest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RegionTable {
    /// The regions in label order.
    pub regions: Vec<Region>,
}

impl RegionTable {
    /// The paper's table: brow 3, eye 5 and mouth 9 AUs.
    pub fn paper() -> Self {
        let region = |name: &str, numbers: &[u8]| Region {
            name: name.to_owned(),
            units: numbers.iter().map(|&n| ActionUnit(n)).collect(),
        };
        Self {
            regions: vec![
                region("brow", &[1, 2, 4]),
                region("eye", &[5, 6, 7, 9, 45]),
                region("mouth", &[10, 12, 14, 15, 17, 20, 23, 25, 26]),
            ],
        }
    }

    /// Reads a table of one's own: a TOML file with `[[regions]]`.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).map_err(|e| FormatError::io(path, "read", &e))?;
        toml::from_str(&text).map_err(|e| {
            toml_error(&e, &text).in_file(path).with_hint("write `[[regions]]`, `name = \"brow\"`, `units = [\"AU01\", \"AU02\"]` for each of brow, eye and mouth")
        })
    }

    /// The same regions with only the AUs in `units`; a region may end up empty.
    #[must_use]
    pub fn restricted_to(&self, units: &[ActionUnit]) -> Self {
        let keep = |region: &Region| Region {
            name: region.name.clone(),
            units: region.units.iter().copied().filter(|u| units.contains(u)).collect(),
        };
        Self { regions: self.regions.iter().map(keep).collect() }
    }

    /// All AUs in model order: region after region.
    pub fn units(&self) -> Vec<ActionUnit> {
        self.regions.iter().flat_map(|r| r.units.iter().copied()).collect()
    }

    /// The index of the region that `unit` belongs to.
    pub fn region_of(&self, unit: ActionUnit) -> Option<usize> {
        self.regions.iter().position(|r| r.units.contains(&unit))
    }

    /// Fails when an AU stands in two regions.
    pub fn validate(&self) -> Result<()> {
        let mut units = self.units();
        units.sort_unstable();
        match units.windows(2).find(|w| w[0] == w[1]) {
            Some(w) => Err(FormatError::new(ErrorKind::Inconsistent, format!("`{}` belongs to two regions", w[0]))),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_groups_are_3_5_9() {
        let table = RegionTable::paper();
        table.validate().unwrap();
        assert_eq!(table.regions.iter().map(|r| r.units.len()).collect::<Vec<_>>(), [3, 5, 9]);
        let units = table.units();
        // The render scripts of the released code drive pairs (1, 9) and (2, 15).
        assert_eq!([units[1], units[9], units[2], units[15]].map(|u| u.0), [2, 12, 4, 25]);
        assert_eq!(table.region_of(ActionUnit(45)), Some(1));
        assert_eq!(table.region_of(ActionUnit(28)), None);
    }
}
