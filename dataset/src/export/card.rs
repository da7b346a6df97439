//! The dataset card: what a package holds, whom it shows and under which consent.

use std::fmt::Write as _;

use risorius_formats::nerfies::Dataset;

use crate::provenance::Provenance;

/// The card as Markdown with the front matter that dataset hubs read.
pub(super) fn markdown(dataset: &Dataset, provenance: &Provenance, scale: u32) -> String {
    let mut text = String::from(
        "---\npretty_name: Face capture with action units\ntags: [face, facial-action-units, multi-view]\nconfigs:\n- config_name: frames\n  data_files: frames.parquet\n---\n\n# Face capture with action units\n\n",
    );
    let _ = writeln!(
        text,
        "{} frames ({} for fitting, {} held out) with cameras, {} attributes and pictures at 1/{scale} of the recorded size.\n",
        dataset.ids.len(),
        dataset.train_ids.len(),
        dataset.val_ids.len(),
        dataset.mapping.len()
    );
    text.push_str("## Who is seen, and under which consent\n\n");
    if provenance.takes.is_empty() {
        text.push_str("Not stated. Ask before you pass it on.\n");
    }
    for take in &provenance.takes {
        let or = |value: &str| {
            let line = value.split_whitespace().collect::<Vec<_>>().join(" ");
            if line.is_empty() { "not stated".to_owned() } else { line }
        };
        let _ =
            writeln!(text, "- take `{}`: subject: {}; consent: {}", take.name, or(&take.subject), or(&take.consent));
    }
    text.push_str(
        "\nThe pictures show a person. Use them only as the consent allows, and do not try to find out who it is.\n\n## Files\n\n\
         - `frames.parquet`: a row per chosen frame: `id`, `take`, `frame`, `split`, `has_masks`, `AUxx_attribute` (-1 to 1), `AUxx_intensity` (0 to 5; null where the AU does not move), `image`, the lens in pixels of the full-size picture, `camera_from_world` as quaternion and translation (OpenCV axes).\n\
         - `images/<id>.png`\n\
         - `tables/{frames,aus,poses}/take_dir=take-NAME/`: every recorded frame, chosen or not, a folder per take; the column `take` is its name.\n\n\
         ```python\nimport polars as pl\nframes = pl.read_parquet(\"frames.parquet\")\naus = pl.read_parquet(\"tables/aus/**/*.parquet\", hive_partitioning=True)\n```\n\n## Attributes\n\n",
    );
    let _ = writeln!(text, "{}", dataset.mapping.join(", "));
    text
}
