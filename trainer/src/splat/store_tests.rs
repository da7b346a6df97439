use risorius_splat::model::LATENT;

use super::*;

/// Some groups with numbers of the sizes that fits have.
fn lively(groups: usize, deformable: usize) -> Gaussians {
    let layout = Layout { region_of: vec![0, 1, 2, 2], also_in: vec![0, 4], regions: 3, latent: LATENT, images: 7 };
    let wave = |i: usize, size: f32| ((i * 7919 % 1009) as f32 / 504.5 - 1.0) * size;
    let many = |count: usize, size: f32| (0..count).map(|i| wave(i, size)).collect::<Vec<f32>>();
    Gaussians {
        deformable,
        base: many(groups * channel::COUNT * LANES, 3.0),
        deltas: many(deformable * layout.bases() * DELTAS * LANES, 0.02),
        gates: many(deformable * REGIONS * LANES, 1.0).into_iter().map(f32::abs).collect(),
        membership: many(groups * REGIONS * LANES, 5.0),
        head_weight: many(groups * LANES, 1.0).into_iter().map(f32::abs).collect(),
        layout,
    }
}

fn described(model: &Gaussians, plate: Option<&Plate>) -> SavedSplat {
    SavedSplat {
        layout: model.layout.clone(),
        groups: model.groups(),
        deformable: model.deformable,
        space: MetricSpace {
            metres_per_unit: 1.0,
            origin_in_world: glam::DVec3::ZERO,
            metric_from_world: glam::DMat3::IDENTITY,
        },
        intensities: true,
        plate: plate.map(|p| [p.width, p.height]),
    }
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn an_avatar_comes_back_as_near_as_stated() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let plate = Plate { width: 3, height: 2, rgb: (0..18).collect() };
    let model = lively(5, 2);
    write(&path, &model, Some(&plate)).unwrap();
    let (back, back_plate) = read(&path, &described(&model, Some(&plate))).unwrap();
    assert_eq!(back_plate, Some(plate));
    assert_eq!((&back.layout, back.deformable), (&model.layout, 2));
    for g in 0..5 {
        let means = |m: &Gaussians| m.base[g * channel::COUNT * LANES..][..3 * LANES].to_vec();
        assert_eq!(means(&back), means(&model), "means are kept whole");
    }
    assert!(largest_difference(&back.base, &model.base) <= 3.0 / 2048.0);
    assert!(largest_difference(&back.membership, &model.membership) <= 5.0 / 2048.0);
    assert!(largest_difference(&back.gates, &model.gates) <= 1.0 / 2048.0);
    assert!(largest_difference(&back.head_weight, &model.head_weight) <= 1.0 / 2048.0);
    assert!(largest_difference(&back.deltas, &model.deltas) <= 0.02 / 253.0);
    // What was read is written to the same bytes.
    let bytes = std::fs::read(&path).unwrap();
    write(&path, &model, None).unwrap();
    assert!(std::fs::read(&path).unwrap().len() < bytes.len());
}

#[test]
fn eighty_thousand_gaussians_fit_into_eight_megabytes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let mut model = lively(5000, 1250);
    // What the project has: 17 AUs, and a latent code that pictures do without.
    model.layout = Layout { region_of: vec![0; 17], also_in: Vec::new(), regions: 1, latent: 0, images: 700 };
    model.deltas = vec![1e-3; 1250 * 17 * DELTAS * LANES];
    write(&path, &model, None).unwrap();
    let megabytes = std::fs::metadata(&path).unwrap().len() as f64 * 1e-6;
    assert!(megabytes < 8.0, "{megabytes} MB");
}

#[test]
fn nothing_that_is_not_finite_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let breaks: [fn(&mut Gaussians); 4] = [
        |m| m.base[17] = f32::NAN,
        |m| m.deltas[3] = f32::INFINITY,
        // Finite, but beyond what sixteen bits hold.
        |m| m.base[channel::COLOR * LANES] = 1e6,
        |m| m.deltas[3] = 1e9,
    ];
    for change in breaks {
        let mut model = lively(3, 1);
        change(&mut model);
        let said = write(&path, &model, None).unwrap_err().to_string();
        assert!(said.contains("nothing is written") && !path.exists(), "{said}");
    }
}

#[test]
fn sizes_that_do_not_match_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let model = lively(5, 2);
    write(&path, &model, None).unwrap();
    let sound = described(&model, None);
    let changes: [fn(&mut SavedSplat); 6] = [
        |s| s.groups = 4,
        |s| s.groups = 1 << 60,
        |s| s.deformable = 6,
        |s| s.layout.region_of.push(0),
        |s| s.layout.latent = 0,
        |s| s.plate = Some([4, 4]),
    ];
    for change in changes {
        let mut saved = sound.clone();
        change(&mut saved);
        assert!(read(&path, &saved).is_err(), "{saved:?}");
    }
    assert!(read(&path, &sound).is_ok());
}
