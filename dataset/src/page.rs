//! `report/index.html`: one page that needs nothing but itself; no script, no address, no other file.

use risorius_formats::html::escaped;
use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::rows::Rows;
use crate::stats::{Evenness, Report};

/// A chart with its heading.
#[derive(Clone, Debug)]
pub(crate) struct Figure {
    pub(crate) title: String,
    pub(crate) svg: String,
}

const STYLE: &str = "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1280px;padding:0 1em;color:#222}\
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}table{border-collapse:collapse;margin:.6em 0}\
td,th{padding:.2em .8em .2em 0;text-align:right;border-bottom:1px solid #ddd;font-variant-numeric:tabular-nums}\
td:first-child,th:first-child{text-align:left}.flag{margin:.2em 0;padding:.3em .7em;border-left:4px solid #e69f00;background:#fdf6e7}\
.quiet{color:#666}svg,img{max-width:100%;height:auto}pre{background:#f4f4f4;padding:.8em;overflow:auto;font-size:12px}";

/// The whole page.
pub(crate) fn html(
    rows: &Rows,
    report: &Report,
    settings: &str,
    figures: &[Figure],
    contact_sheet_png: Option<&[u8]>,
) -> String {
    let names: Vec<String> = rows.takes.iter().map(|t| escaped(&t.name)).collect();
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>Dataset {}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n",
        names.join(", ")
    );
    let _ = writeln!(page, "<h1>Dataset of {}</h1>", names.join(", "));
    let _ = writeln!(
        page,
        "<p>{} frames chosen of {} usable ones by the objective <b>{}</b>; {} for fitting, {} held out ({}).</p>",
        report.chosen,
        report.candidates,
        report.sampling.name(),
        report.split.train,
        report.split.val,
        report.split.kind.name()
    );
    flags(&mut page, report);
    numbers(&mut page, report);
    for figure in figures {
        // Inside a page an SVG needs no document head.
        let start = figure.svg.find("<svg").unwrap_or(0);
        let _ = writeln!(page, "<h2>{}</h2>\n{}", escaped(&figure.title), sized(&figure.svg[start..]));
    }
    if let Some(png) = contact_sheet_png {
        let _ = writeln!(
            page,
            "<h2>Contact sheet</h2>\n<p class=\"quiet\">Regions tinted, background darkened where the head is known; a bar per AU, full at intensity 5.</p>\n<img alt=\"chosen frames with their masks\" src=\"data:image/png;base64,{}\">",
            STANDARD.encode(png)
        );
    }
    attributes(&mut page, report);
    let _ = writeln!(page, "<h2>Settings</h2>\n<pre>{}</pre>\n</body>\n</html>", escaped(settings.trim_end()));
    page
}

fn flags(page: &mut String, report: &Report) {
    page.push_str("<h2>What to look at</h2>\n");
    if report.flags.is_empty() {
        page.push_str("<p class=\"quiet\">Nothing stands out.</p>\n");
    }
    for flag in &report.flags {
        let _ = writeln!(page, "<p class=\"flag\"><b>{}</b>: {}</p>", escaped(&flag.kind), escaped(&flag.message));
    }
}

fn numbers(page: &mut String, report: &Report) {
    page.push_str("<h2>How even</h2>\n<table><tr><th></th><th>block entropy</th><th>entropy per AU</th><th>variation</th><th>above rest</th><th>empty blocks</th><th>cells of views</th><th>largest gap</th></tr>\n");
    let mut row = |name: &str, e: &Evenness, views: &str| {
        let _ = writeln!(
            page,
            "<tr><td>{name}</td><td>{:.3}</td><td>{:.3}</td><td>{:.2}</td><td>{:.2}</td><td>{}</td>{views}</tr>",
            e.block_entropy, e.entropy, e.coefficient_of_variation, e.raised_variation, e.empty_blocks
        );
    };
    let views = |c: &crate::views::Coverage| {
        format!("<td>{} of {}</td><td>{:.1}°</td>", c.cells_chosen, c.cells, c.largest_gap_deg)
    };
    row("all usable frames", &report.evenness_before, "<td></td><td></td>");
    row("evenly over time", &report.evenness_uniform, &views(&report.coverage_uniform));
    row("chosen", &report.evenness_after, &views(&report.coverage));
    page.push_str("</table>\n<table><tr><th>take</th><th>frames</th><th>per second</th><th>valid</th><th>lost</th><th>unsure</th><th>incomplete</th><th>posed</th></tr>\n");
    for take in &report.takes {
        let c = take.counts;
        let _ = writeln!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{:.2}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            escaped(&take.name),
            c.frames,
            take.fps,
            c.valid,
            c.lost,
            c.low_confidence,
            c.incomplete,
            take.posed
        );
    }
    page.push_str("</table>\n");
    let split = &report.split;
    if let (Some([time, least]), Some([angle, _])) = (split.nearest_ms, split.nearest_view_deg) {
        let known = split.known_combinations.unwrap_or(0.0) * 100.0;
        let _ = writeln!(
            page,
            "<p>Held-out frames lie {time:.0} ms (median; {least:.0} ms at least) and {angle:.1}° from the nearest frame for fitting; {known:.0} % of them show a combination of AUs that fitting sees.</p>"
        );
    }
}

fn attributes(page: &mut String, report: &Report) {
    page.push_str("<h2>Attributes</h2>\n<table><tr><th>AU</th><th>name</th><th>region</th><th>smallest</th><th>largest</th><th>neutral</th><th>chosen frames per level</th></tr>\n");
    for a in &report.attributes {
        let counts: Vec<String> = a.histogram_after.iter().map(ToString::to_string).collect();
        let state = if a.active { "" } else { " (inactive)" };
        let _ = writeln!(
            page,
            "<tr><td>{}{state}</td><td>{}</td><td>{}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{}</td></tr>",
            a.unit,
            a.name,
            escaped(&a.region),
            a.au_min,
            a.au_max,
            a.neutral,
            counts.join(" · ")
        );
    }
    page.push_str("</table>\n");
}

/// An SVG that shrinks with the page: its size becomes its view box.
fn sized(svg: &str) -> String {
    let Some(end) = svg.find('>') else { return svg.to_owned() };
    let (head, rest) = svg.split_at(end);
    if head.contains("viewBox") {
        return svg.to_owned();
    }
    let number = |key: &str| -> Option<&str> {
        let start = head.find(&format!("{key}=\""))? + key.len() + 2;
        head[start..].split('"').next()
    };
    match (number("width"), number("height")) {
        (Some(w), Some(h)) => format!("{head} viewBox=\"0 0 {w} {h}\"{rest}"),
        _ => svg.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_become_markup() {
        assert_eq!(escaped("<b>&\"x\""), "&lt;b&gt;&amp;&quot;x&quot;");
        assert_eq!(
            sized("<svg width=\"5\" height=\"7\" xmlns=\"x\">\n</svg>"),
            "<svg width=\"5\" height=\"7\" xmlns=\"x\" viewBox=\"0 0 5 7\">\n</svg>"
        );
    }
}
