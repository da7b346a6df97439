//! Folders of CoNeRF and CoNFies: attributes that people annotated.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DVec3};
use risorius_formats::attribute::{AU_MAX_SCALE, MIN_RANGE};
use risorius_formats::au::MAX_INTENSITY;
use risorius_formats::nerfies::{self, Dataset, Extras, Polygons};
use risorius_formats::pose_report::PoseMethod;
use risorius_formats::{ActionUnit, Attribute, AttributeSpec, AttributeTable, RegionTable, Reporter, Warning};

use super::{ImportOptions, Imported, Layout, refused};
use crate::error::Result;
use crate::export::scales_in;
use crate::provenance::Provenance;

/// Reads a folder that is not an export of ours.
pub(super) fn read(dir: &Path, layout: Layout, options: &ImportOptions, reporter: &dyn Reporter) -> Result<Imported> {
    if layout != Layout::Nerfies {
        return Err(refused(
            dir,
            "has cameras and pictures but no attributes, so there is nothing to steer",
            "import a CoNeRF folder, which has `annotations.yml`, or track the video and use `dataset build`",
        ));
    }
    let mut dataset = Dataset::read(dir)?;
    if dataset.mapping.is_empty() || dataset.annotations.is_empty() {
        return Err(refused(
            dir,
            "has no annotated attributes: `mapping.yml` and `annotations.yml` are missing or empty",
            "a plain Nerfies folder cannot be steered; track its video and use `dataset build`",
        ));
    }
    let units = units(dir, &dataset.mapping, options)?;
    let mut polygons = BTreeMap::new();
    for id in &dataset.ids {
        let path = nerfies::polygons_path(dir, id);
        if !path.is_file() {
            continue;
        }
        let mut outlines = Polygons::read(&path)?;
        let before = outlines.polygons.len();
        outlines.polygons.retain(|p| dataset.mapping.contains(&p.label));
        if outlines.polygons.len() < before {
            let message = format!("{}: outlines of unknown classes are left out", path.display());
            reporter.warn(Warning::new("unknown-class", message));
        }
        for polygon in &mut outlines.polygons {
            if let Some(class) = dataset.mapping.iter().position(|m| *m == polygon.label) {
                polygon.label = units[class].to_string();
            }
        }
        if !outlines.polygons.is_empty() {
            polygons.insert(id.clone(), outlines);
        }
    }
    let (table, new_class) = attribute_table(&dataset, &units, &polygons);
    for annotation in &mut dataset.annotations {
        annotation.class = new_class[annotation.class];
    }
    dataset.mapping = table.attributes.iter().map(|a| a.unit.to_string()).collect();
    dataset.extras = Some(extras(dir, &dataset, &polygons));
    let cameras = dataset.ids.iter().map(|id| (id.clone(), nerfies::camera_path(dir, id))).collect();
    let provenance = Provenance::default();
    Ok(Imported { dataset, table, provenance, polygons, rows: None, options: None, cameras, masks: None })
}

/// The AU of each class.
fn units(dir: &Path, mapping: &[String], options: &ImportOptions) -> Result<Vec<ActionUnit>> {
    let path = dir.join("mapping.yml");
    let unit = |name: &String| options.units.get(name).copied().or_else(|| name.parse().ok());
    let unknown: Vec<&str> = mapping.iter().filter(|m| unit(m).is_none()).map(String::as_str).collect();
    if let Some(first) = unknown.first() {
        return Err(refused(
            &path,
            format!("the classes {} are no AUs", unknown.join(", ")),
            format!("say which AU each of them stands for, such as `--au \"{first}=AU12\"`"),
        ));
    }
    if let Some(name) = options.units.keys().find(|k| !mapping.contains(k)) {
        return Err(refused(
            &path,
            format!("has no class `{name}`"),
            format!("its classes are {}", mapping.join(", ")),
        ));
    }
    let units: Vec<ActionUnit> = mapping.iter().filter_map(unit).collect();
    let mut seen = BTreeSet::new();
    match units.iter().find(|u| !seen.insert(**u)) {
        Some(twice) => {
            Err(refused(&path, format!("two classes stand for {twice}"), "give each class an AU of its own"))
        }
        None => Ok(units),
    }
}

/// The attributes, region after region, and where each class of the folder went.
///
/// A class with outlines of its own begins a region, and the classes behind it without outlines belong to it: so CoNeRF
/// has a region per class, and CoNFies files a group's outline under its first AU.
fn attribute_table(
    dataset: &Dataset,
    units: &[ActionUnit],
    polygons: &BTreeMap<String, Polygons>,
) -> (AttributeTable, Vec<usize>) {
    let outlined: BTreeSet<&str> = polygons.values().flat_map(|p| &p.polygons).map(|p| p.label.as_str()).collect();
    let mut regions: Vec<Vec<usize>> = Vec::new();
    for (class, unit) in units.iter().enumerate() {
        match regions.last_mut() {
            Some(region) if !outlined.contains(unit.to_string().as_str()) => region.push(class),
            _ => regions.push(vec![class]),
        }
    }
    let paper = RegionTable::paper();
    let name = |(index, classes): (usize, &Vec<usize>)| {
        let homes: BTreeSet<Option<usize>> = classes.iter().map(|&c| paper.region_of(units[c])).collect();
        let home = homes.first().copied().flatten().filter(|_| homes.len() == 1);
        home.map_or_else(|| format!("region-{}", index + 1), |h| paper.regions[h].name.clone())
    };
    let mut names: Vec<String> = regions.iter().enumerate().map(name).collect();
    for i in 1..names.len() {
        if names[..i].contains(&names[i]) {
            names[i] = format!("region-{}", i + 1);
        }
    }
    let mut attributes = Vec::new();
    let mut new_class = vec![0; units.len()];
    for (region, classes) in regions.iter().enumerate() {
        for &class in classes {
            new_class[class] = attributes.len();
            let values = || dataset.annotations.iter().filter(|a| a.class == class).map(|a| a.value);
            let range = values().fold((f32::MAX, f32::MIN), |(lo, hi), v| (lo.min(v), hi.max(v)));
            // −1 to 1 over the whole scale: what eq. 1 makes of 0 to 4.
            let mut spec = AttributeSpec::from_range(units[class], region, 0.0, MAX_INTENSITY, 0.0);
            spec.au_max_scale = AU_MAX_SCALE;
            spec.active = range.1 - range.0 >= MIN_RANGE;
            spec.neutral = spec.scale().intensity(Attribute(0.0)).0;
            attributes.push(spec);
        }
    }
    (AttributeTable { regions: names, attributes }, new_class)
}

/// Outline labels with their region's label, from the weakest to the strongest: a pixel that two outlines claim goes to
/// the mouth before the brow before the eye where the regions are the paper's, else to the later region.
pub(super) fn paint_order(table: &AttributeTable, polygons: &BTreeMap<String, Polygons>) -> Vec<(String, u8)> {
    let outlined: BTreeSet<&str> = polygons.values().flat_map(|p| &p.polygons).map(|p| p.label.as_str()).collect();
    let strength = |region: usize| match table.regions[region].as_str() {
        "mouth" => 2,
        "brow" => 1,
        _ => 0,
    };
    let labels = table.attributes.iter().filter(|a| outlined.contains(a.unit.to_string().as_str()));
    let mut order: Vec<_> = labels.map(|a| (strength(a.region), a.region, a.unit.to_string())).collect();
    order.sort();
    order.into_iter().map(|(_, region, label)| (label, region as u8 + 1)).collect()
}

/// What can be said about a folder of another program: the head is where the cameras look.
fn extras(dir: &Path, dataset: &Dataset, polygons: &BTreeMap<String, Polygons>) -> Extras {
    let cameras: Vec<_> = dataset.cameras.values().collect();
    let center = looked_at(cameras.iter().map(|c| (c.center(), c.camera_from_world.rotation.row(2))))
        .unwrap_or(dataset.scene.center_in_world);
    let nearest = cameras.iter().map(|c| c.center().distance(center)).fold(f64::INFINITY, f64::min);
    let near = dataset.scene.near / dataset.scene.scale;
    // The near plane stands before the face; a head is no larger than half the way to it.
    let head_radius = (nearest - near).clamp(0.05 * nearest, 0.5 * nearest);
    let scales = scales_in(dir);
    Extras {
        version: 1,
        default_scale: scales.iter().copied().find(|&s| s == 4).or(scales.last().copied()).unwrap_or(4),
        method: PoseMethod::ColmapModel,
        head_center: center,
        head_radius: if head_radius.is_finite() { head_radius } else { 1.0 },
        head_hull_in_world: None,
        units_per_metre: None,
        takes: vec!["imported".to_owned()],
        ids_without_masks: dataset.ids.iter().filter(|id| !polygons.contains_key(*id)).cloned().collect(),
        neutral_id: None,
        written_by: concat!("risorius-dataset ", env!("CARGO_PKG_VERSION")).to_owned(),
    }
}

/// The point nearest to all lines (origin, unit direction), in the least-squares sense; `None` where they are parallel.
fn looked_at(lines: impl Iterator<Item = (DVec3, DVec3)>) -> Option<DVec3> {
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for (origin, direction) in lines {
        let d = direction.try_normalize()?;
        let away = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += away;
        b += away * origin;
    }
    let size = a.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let point = a.inverse() * b;
    (a.determinant() > 1e-9 * size.powi(3) && point.is_finite()).then_some(point)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_meet_where_they_meet() {
        let goal = DVec3::new(0.3, -0.2, 2.0);
        let from = [DVec3::ZERO, DVec3::new(1.0, 0.0, 0.0), DVec3::new(0.0, 2.0, 0.5)];
        let found = looked_at(from.into_iter().map(|o| (o, (goal - o).normalize()))).unwrap();
        assert!((found - goal).length() < 1e-9);
        assert!(looked_at(from.into_iter().map(|o| (o, DVec3::Z))).is_none());
    }
}
