//! A small install of OpenFace's AU models for tests, with numbers of our own.

use std::path::Path;

use glam::DVec3;

/// A number between −1 and 1 that looks random, the same for the same `i`.
pub(crate) fn wave(i: usize) -> f64 {
    let n = (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let n = (n ^ (n >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    ((n ^ (n >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// A point model as OpenFace's text file.
pub(crate) fn point_model_text(mean: &[DVec3; 68], modes: &[[DVec3; 68]], variances: &[f64]) -> String {
    let all = |points: &[DVec3; 68]| (0..3).flat_map(|axis| points.map(|p| p[axis])).collect::<Vec<f64>>();
    let lines = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join("\n");
    let modes: Vec<Vec<f64>> = modes.iter().map(all).collect();
    let by_rows: Vec<f64> = (0..204).flat_map(|row| modes.iter().map(move |m| m[row])).collect();
    let count = modes.len();
    format!(
        "# The mean values of the components (in mm)\n204\n1\n6\n{}\n# The principal components (eigenvectors)\n204\n{count}\n6\n{}\n# The variances of the components (eigenvalues)\n1\n{count}\n6\n{}\n",
        lines(&all(mean)),
        lines(&by_rows),
        lines(variances)
    )
}

/// A linear AU model as OpenFace's binary file; see `aus/openface/predictors.rs`.
#[derive(Clone, Debug)]
pub(crate) struct ModelFile {
    /// 0 and 1: static and dynamic regressor; 4 and 5: static and dynamic machine.
    pub kind: i32,
    /// Only where the kind is 1.
    pub cutoff: f64,
    pub mean: Vec<f64>,
    pub weights: Vec<f64>,
    pub bias: f64,
}

impl ModelFile {
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let mut bytes = self.kind.to_le_bytes().to_vec();
        if self.kind == 1 {
            bytes.extend(self.cutoff.to_le_bytes());
        }
        let count = self.mean.len() as i32;
        for (size, values) in [([1, count], &self.mean), ([count, 1], &self.weights)] {
            bytes.extend([size[0], size[1], 6].iter().flat_map(|v| v.to_le_bytes()));
            bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        }
        bytes.extend(self.bias.to_le_bytes());
        if self.kind >= 4 {
            bytes.extend([1.0f64, 0.0].iter().flat_map(|v| v.to_le_bytes()));
        }
        bytes
    }
}

/// Writes an OpenFace install with a point model of three modes over `mean` and these AU models, `DIR/AU_predictors`.
pub(crate) fn write_openface_install(dir: &Path, mean: &[DVec3; 68], models: &[(&str, ModelFile)]) {
    let folder = dir.join("AU_predictors");
    std::fs::create_dir_all(folder.join("svr_combined")).unwrap();
    std::fs::create_dir_all(dir.join("model/pdms")).unwrap();
    let main =
        "AUPredictor AU_all_best.txt\r\nPDM In-the-wild_aligned_PDM_68.txt\r\nTriangulation tris_68_full.txt\r\n";
    std::fs::write(folder.join("main_dynamic_svms.txt"), main).unwrap();
    let mode =
        |j: usize| std::array::from_fn(|i| DVec3::new(wave(9 * i + j), wave(9 * i + j + 3), wave(9 * i + j + 6)) * 0.1);
    let modes: Vec<[DVec3; 68]> = (0..3).map(mode).collect();
    let text = point_model_text(mean, &modes, &[400.0, 100.0, 25.0]);
    std::fs::write(folder.join("In-the-wild_aligned_PDM_68.txt"), text).unwrap();
    // A fan around the tip of the nose covers the outline, whatever else it covers.
    let triangles: String = (0..26).map(|i| format!("30 {i} {}\n", i + 1)).chain(["30 26 0\n".to_owned()]).collect();
    std::fs::write(folder.join("tris_68_full.txt"), format!("27\n3\n4\n{triangles}")).unwrap();
    let mut list = String::new();
    for (i, (unit, model)) in models.iter().enumerate() {
        let name = format!("svr_combined/AU_{i}_comb.dat");
        std::fs::write(folder.join(&name), model.bytes()).unwrap();
        list.extend([name.as_str(), " ", unit, "\r\n"]);
    }
    std::fs::write(folder.join("AU_all_best.txt"), list).unwrap();
}
