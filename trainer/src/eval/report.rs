//! The report of an evaluation as one page of HTML without outside parts, and its table as CSV.

use risorius_formats::html::escaped;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;

use super::Evaluation;
use super::control::{Control, Decoupling};
use crate::error::Result;
use crate::view::ramp;

/// Views that are shown as the worst, and as the best.
const SHOWN: usize = 4;
/// A difference of this many levels has the brightest colour of an error map.
const FULL_LEVELS: f32 = 64.0;

const STYLE: &str = "body{font:14px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:#1c1c22;background:#fff}\
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}table{border-collapse:collapse;margin:.5rem 0}\
th,td{padding:.15rem .6rem;text-align:right;border-bottom:1px solid #ddd;font-variant-numeric:tabular-nums}\
th:first-child,td:first-child{text-align:left}.three{display:grid;grid-template-columns:repeat(3,minmax(0,13rem));gap:.4rem;margin:.3rem 0 1.2rem}\
.three img{width:100%;display:block}.three figcaption,.quiet{color:#63636e}figure{margin:0}.matrix td{padding:.1rem .3rem;font-size:.8rem}";

/// What a report is made of.
pub struct Report<'a> {
    /// The avatar's name.
    pub name: &'a str,
    /// The scores, if pictures were compared.
    pub evaluation: Option<&'a Evaluation>,
    /// AU control, if it was measured.
    pub control: Option<&'a Control>,
    /// Decoupling, if it was measured.
    pub decoupling: Option<&'a Decoupling>,
}

impl Report<'_> {
    /// The page; `pair` gives a view's picture and its truth by the view's number.
    pub fn html(&self, pair: impl Fn(usize) -> Option<(RgbImage, RgbImage)>) -> Result<String> {
        let mut page = format!(
            "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{0}: evaluation</title><style>{STYLE}</style><h1>{0}</h1>\n",
            escaped(self.name)
        );
        if let Some(evaluation) = self.evaluation {
            write_means(&mut page, evaluation);
            write_pairs(&mut page, evaluation, &pair)?;
        }
        if let Some(control) = self.control {
            write_control(&mut page, control);
        }
        if let Some(decoupling) = self.decoupling {
            write_decoupling(&mut page, decoupling);
        }
        if let Some(evaluation) = self.evaluation {
            write_views(&mut page, evaluation);
        }
        page.push_str("</html>\n");
        Ok(page)
    }
}

/// Every view's numbers, one row each.
pub fn csv(evaluation: &Evaluation) -> String {
    let names: BTreeSet<String> = evaluation.views.iter().flat_map(super::ViewScore::numbers).map(|(n, _)| n).collect();
    let parts: BTreeSet<&String> = evaluation.views.iter().flat_map(|v| v.parts_psnr_db.keys()).collect();
    let mut text = String::from("id,kind");
    for name in &names {
        let _ = write!(text, ",{name}");
    }
    for part in &parts {
        let _ = write!(text, ",psnr_db {part}");
    }
    text.push('\n');
    for view in &evaluation.views {
        let numbers: BTreeMap<String, f64> = view.numbers().into_iter().collect();
        let _ = write!(text, "{},{}", quoted(&view.id), quoted(view.kind.as_deref().unwrap_or("")));
        let cells = names.iter().map(|n| numbers.get(n)).chain(parts.iter().map(|p| view.parts_psnr_db.get(*p)));
        for cell in cells {
            text.push(',');
            if let Some(v) = cell {
                let _ = write!(text, "{v:.5}");
            }
        }
        text.push('\n');
    }
    text
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

/// A number of a table, and what it means.
fn shown(name: &str, value: f64) -> String {
    if name.ends_with("_db") || name.ends_with("_mm") { format!("{value:.2}") } else { format!("{value:.4}") }
}

fn table(page: &mut String, first: &str, rows: &BTreeMap<String, BTreeMap<String, f64>>) {
    let names: BTreeSet<&String> = rows.values().flat_map(BTreeMap::keys).collect();
    let _ = write!(page, "<table><tr><th>{first}</th>");
    for name in &names {
        let _ = write!(page, "<th>{}</th>", escaped(name));
    }
    page.push_str("</tr>\n");
    for (row, values) in rows {
        let _ = write!(page, "<tr><td>{}</td>", escaped(row));
        for name in &names {
            let cell = values.get(*name).map_or_else(String::new, |v| shown(name, *v));
            let _ = write!(page, "<td>{cell}</td>");
        }
        page.push_str("</tr>\n");
    }
    page.push_str("</table>\n");
}

fn write_means(page: &mut String, evaluation: &Evaluation) {
    let _ = writeln!(page, "<h2>Means over {} views</h2>", evaluation.views.len());
    table(page, "views", &evaluation.means);
    if !evaluation.mean_parts.is_empty() {
        page.push_str("<h2>Parts of the picture</h2><p class=\"quiet\">Head and background by the avatar's own depth, regions by its own masks (one half and more).</p>\n");
        table(page, "part", &evaluation.mean_parts);
    }
    let few = evaluation.views.iter().filter_map(|v| v.ms_ssim).map(|s| s.scales).min().filter(|s| *s < 5);
    if let Some(scales) = few {
        let _ = writeln!(
            page,
            "<p>MS-SSIM with {scales} scales only, since pictures are small: not comparable with five.</p>"
        );
    }
}

fn write_pairs(
    page: &mut String,
    evaluation: &Evaluation,
    pair: &impl Fn(usize) -> Option<(RgbImage, RgbImage)>,
) -> Result<()> {
    let mut order: Vec<usize> = (0..evaluation.views.len()).collect();
    order.sort_by(|a, b| evaluation.views[*a].psnr_db.total_cmp(&evaluation.views[*b].psnr_db));
    let worst: Vec<usize> = order.iter().copied().take(SHOWN).collect();
    let best: Vec<usize> = order.iter().rev().copied().take(SHOWN).filter(|i| !worst.contains(i)).collect();
    for (title, chosen) in [("Worst views", worst), ("Best views", best)] {
        if chosen.is_empty() {
            continue;
        }
        let _ = writeln!(
            page,
            "<h2>{title}</h2><p class=\"quiet\">Truth, avatar, and their greatest difference in a channel: bright from {FULL_LEVELS} levels of 255.</p>"
        );
        for i in chosen {
            let view = &evaluation.views[i];
            let Some((picture, truth)) = pair(i) else { continue };
            let numbers: Vec<String> =
                view.numbers().into_iter().map(|(n, v)| format!("{n} {}", shown(&n, v))).collect();
            let kind = view.kind.as_deref().map_or_else(String::new, |k| format!(" ({})", escaped(k)));
            let _ = writeln!(
                page,
                "<figure><figcaption>{}{kind}: {}</figcaption><div class=\"three\">{}{}{}</div></figure>",
                escaped(&view.id),
                numbers.join(", "),
                img(&truth, "truth")?,
                img(&picture, "avatar")?,
                img(&error_map(&picture, &truth), "difference")?
            );
        }
    }
    Ok(())
}

/// The greatest difference over channels, as colours.
pub fn error_map(a: &RgbImage, b: &RgbImage) -> RgbImage {
    let mut map = RgbImage::new(a.width(), a.height());
    let pixels = a.as_raw().as_chunks::<3>().0.iter().zip(b.as_raw().as_chunks::<3>().0);
    for (out, (a, b)) in map.as_mut().as_chunks_mut::<3>().0.iter_mut().zip(pixels) {
        let most = a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
        *out = ramp(f32::from(most) / FULL_LEVELS);
    }
    map
}

fn img(image: &RgbImage, alt: &str) -> Result<String> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 88).encode_image(image).map_err(|e| {
        crate::error::TrainerError::Image { path: Path::new("report.html").to_owned(), message: e.to_string() }
    })?;
    Ok(format!("<img alt=\"{alt}\" src=\"data:image/jpeg;base64,{}\">", STANDARD.encode(bytes)))
}

fn write_control(page: &mut String, control: &Control) {
    let _ = writeln!(
        page,
        "<h2>AU control</h2><p>Each AU is swept alone from neutral to the strongest that the capture saw, and read again from the renders by the tracker. Mean ICC(3,1) <b>{:.3}</b> over {} AUs, {:.3} over those that the tracker reads; ICC(2,1) {:.3}, ICC(1,1) {:.3}. {} of {} frames had no face.</p>",
        control.mean_icc_3_1,
        control.units.len(),
        control.mean_readable_icc_3_1,
        control.mean_icc_2_1,
        control.mean_icc_1_1,
        control.lost_frames,
        control.frames
    );
    page.push_str("<table><tr><th>AU</th><th>ICC(3,1)</th><th>ICC(2,1)</th><th>ICC(1,1)</th><th>ICC(3,1), all frames</th><th>correlation</th></tr>\n");
    let cell = |v: Option<f64>| v.map_or_else(|| "–".to_owned(), |v| format!("{v:.3}"));
    for u in &control.units {
        let mark = if u.readable { "" } else { " *" };
        let of = |f: fn(&super::Icc) -> f64| cell(u.sweep.as_ref().map(f));
        let _ = writeln!(
            page,
            "<tr><td>{} {}{mark}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            u.unit,
            escaped(&u.name),
            of(|i| i.icc_3_1),
            of(|i| i.icc_2_1),
            of(|i| i.icc_1_1),
            cell(u.all_frames.map(|i| i.icc_3_1)),
            cell(u.correlation)
        );
    }
    page.push_str("</table>\n");
    if control.units.iter().any(|u| !u.readable) {
        page.push_str("<p class=\"quiet\">* the tracker is said not to read it.</p>\n");
    }
    let _ = writeln!(
        page,
        "<h2>Cross-talk</h2><p class=\"quiet\">Rows: the AU that is swept; columns: how much the reading of an AU rises per unit. Mean off the diagonal {:.3}.</p><table class=\"matrix\"><tr><th></th>",
        control.mean_cross_talk
    );
    for u in &control.units {
        let _ = write!(page, "<th>{}</th>", u.unit.trim_start_matches("AU"));
    }
    page.push_str("</tr>\n");
    for (u, row) in control.units.iter().zip(&control.cross_talk) {
        let _ = write!(page, "<tr><td>{}</td>", u.unit);
        for v in row {
            let strength = v.unwrap_or(0.0).clamp(-1.0, 1.0);
            let hue = if strength >= 0.0 { "230,120,30" } else { "50,110,200" };
            let text = v.map_or_else(String::new, |v| format!("{v:.2}"));
            let _ = write!(page, "<td style=\"background:rgba({hue},{:.2})\">{text}</td>", strength.abs());
        }
        page.push_str("</tr>\n");
    }
    page.push_str("</table>\n");
}

fn write_decoupling(page: &mut String, decoupling: &Decoupling) {
    let _ = writeln!(
        page,
        "<h2>Decoupling</h2><p>Each AU goes from neutral to its strongest; changes where its region's mask is 0 are spill. Greatest change {} levels of 255, 99.9 % of the colours at most {}, mean {:.4}.</p><table><tr><th>AU</th><th>region</th><th>greatest outside</th><th>99.9 % outside</th><th>greatest, mask below 2 %</th><th>mean outside</th><th>mean inside</th></tr>",
        decoupling.outside_max, decoupling.outside_999, decoupling.outside_mean
    );
    for u in &decoupling.units {
        let _ = writeln!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.4}</td><td>{:.2}</td></tr>",
            u.unit,
            escaped(&u.region),
            u.outside_max,
            u.outside_999,
            u.faint_max,
            u.outside_mean,
            u.inside_mean
        );
    }
    page.push_str("</table>\n");
}

fn write_views(page: &mut String, evaluation: &Evaluation) {
    let rows = evaluation.views.iter().map(|v| (v.id.clone(), v.numbers().into_iter().collect())).collect();
    page.push_str("<h2>Every view</h2>\n");
    table(page, "view", &rows);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::ViewScore;
    use crate::eval::scores::testing::pattern;

    fn evaluation() -> Evaluation {
        let view = |id: &str, psnr_db: f64| ViewScore {
            id: id.to_owned(),
            kind: Some("novel, <view>".to_owned()),
            psnr_db,
            ..ViewScore::default()
        };
        Evaluation::new((0..10).map(|i| view(&format!("{i:03}"), 20.0 + f64::from(i))).collect()).unwrap()
    }

    #[test]
    fn the_page_shows_the_worst_first_and_escapes_names() {
        let evaluation = evaluation();
        let report = Report { name: "a<b", evaluation: Some(&evaluation), control: None, decoupling: None };
        let page = report.html(|_| Some((pattern(32, 32, 0), pattern(32, 32, 3)))).unwrap();
        assert!(page.contains("a&lt;b") && !page.contains("a<b") && !page.contains("<view>"));
        assert_eq!(page.matches("data:image/jpeg;base64").count(), 3 * 8);
        let (worst, best) = (page.find("000 (novel").unwrap(), page.find("009 (novel").unwrap());
        assert!(worst < best);
        assert!(!page.contains("http"), "nothing from elsewhere");
    }

    #[test]
    fn the_table_has_a_row_per_view() {
        let text = csv(&evaluation());
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "id,kind,psnr_db");
        assert_eq!(lines[1], "000,\"novel, <view>\",20.00000");
        assert_eq!(lines.len(), 11);
    }

    #[test]
    fn equal_pictures_have_a_dark_error_map() {
        let a = pattern(8, 8, 0);
        assert!(error_map(&a, &a).pixels().all(|p| p.0 == ramp(0.0)));
    }
}
