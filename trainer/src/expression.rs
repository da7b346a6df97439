//! Expressions: an intensity for each AU of an avatar's table. Fields turn them into attributes or activations by their
//! scales ([`risorius_formats::AuScale`]).

use std::collections::BTreeMap;

use risorius_formats::{ActionUnit, AttributeTable, Intensity, Reporter, Warning};

/// Intensities this far beyond the capture's most are not told: the noise of trackers.
pub const TOLERANCE: f32 = 0.05;

/// The intensity of every AU of a table, in its order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Expression(pub Vec<Intensity>);

impl Expression {
    /// The capture's neutral face.
    pub fn neutral(table: &AttributeTable) -> Self {
        Self(table.attributes.iter().map(|a| a.scale().neutral()).collect())
    }

    /// The same with one AU changed.
    #[must_use]
    pub fn with(&self, au: usize, intensity: Intensity) -> Self {
        let mut changed = self.clone();
        if let Some(slot) = changed.0.get_mut(au) {
            *slot = intensity;
        }
        changed
    }
}

/// What expressions ask for that the capture does not show; AU by AU, told once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Unseen {
    /// AUs that never moved.
    pub inactive: std::collections::BTreeSet<ActionUnit>,
    /// AUs that are asked beyond the capture's most: the most that was asked, and the most that is shown.
    pub beyond: BTreeMap<ActionUnit, [f32; 2]>,
}

impl Unseen {
    /// The expression of AU intensities, those left out neutral; what the capture does not show is noted.
    pub fn expression(&mut self, table: &AttributeTable, intensities: &BTreeMap<ActionUnit, f32>) -> Expression {
        let mut expression = Expression::neutral(table);
        for (&unit, &value) in intensities {
            let known = table.index_of(unit).filter(|&k| table.attributes[k].active);
            match known {
                Some(k) => {
                    let (scale, intensity) = (table.attributes[k].scale(), Intensity(value));
                    if scale.excess(intensity).is_some_and(|excess| excess > TOLERANCE) {
                        let entry = self.beyond.entry(unit).or_insert([value, scale.most().0]);
                        entry[0] = entry[0].max(value);
                    }
                    expression.0[k] = intensity;
                }
                None if value.abs() < 1e-6 => {}
                None => {
                    self.inactive.insert(unit);
                }
            }
        }
        expression
    }

    /// Warns of everything that was noted.
    pub fn warn(&self, reporter: &dyn Reporter) {
        for unit in &self.inactive {
            let message = format!("`{unit}` ({}) never moved in the capture; it stays neutral", unit.facs_name());
            reporter.warn(Warning::new("inactive-au", message));
        }
        if self.beyond.is_empty() {
            return;
        }
        let list: Vec<String> =
            self.beyond.iter().map(|(unit, [asked, most])| format!("{unit} {asked:.1} (at most {most:.1})")).collect();
        let message =
            format!("asked for more than the capture shows, which is shown at its most instead: {}", list.join(", "));
        reporter.warn(Warning::new("beyond-capture", message));
    }
}

#[cfg(test)]
mod tests {
    use risorius_formats::AttributeSpec;
    use risorius_formats::report::Collected;

    use super::*;

    #[test]
    fn what_the_capture_does_not_show_is_told_once() {
        let attribute = |unit, most| AttributeSpec::from_range(ActionUnit(unit), 0, 0.0, most, 0.0);
        let table = AttributeTable {
            regions: vec!["face".to_owned()],
            attributes: vec![attribute(12, 3.0), attribute(26, 0.0)],
        };
        let mut unseen = Unseen::default();
        for value in [4.0, 5.0, 3.04] {
            let asked = [(ActionUnit(12), value), (ActionUnit(26), 2.0), (ActionUnit(45), 0.0)].into();
            let expression = unseen.expression(&table, &asked);
            assert_eq!(expression, Expression(vec![Intensity(value), Intensity(0.0)]));
        }
        let told = Collected::default();
        unseen.warn(&told);
        let warnings = told.warnings();
        assert_eq!(warnings.len(), 2, "{warnings:?}");
        assert!(warnings[1].message.contains("AU12 5.0 (at most 3.0)"), "{warnings:?}");
    }
}
