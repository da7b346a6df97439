#!/usr/bin/env python3
"""The report page of a corpus: takes, failures with their error line, metrics, pictures.

usage: report.py      in the corpus' folder; writes report/index.html and report/report.json
"""

import html
import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.dont_write_bytecode = True

import captures as table  # noqa: E402
import plot  # noqa: E402

STAGES = ("record", "track", "poses", "dataset", "fit", "eval", "transfer", "collect")
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #222 }
table { border-collapse: collapse; width: 100% } th, td { text-align: left; padding: .3em .6em; border-bottom: 1px solid #ddd }
td.n { text-align: right; font-variant-numeric: tabular-nums } tr.bad td { background: #fdecea } tr.open td { background: #fff8e1 }
img.face { height: 96px; border-radius: 4px; margin-right: 2px } td.face { white-space: nowrap } small { color: #666 } code { background: #f4f4f4; padding: 0 .2em }
"""


def read_json(path):
    try:
        return json.loads(Path(path).read_text())
    except (OSError, ValueError):
        return {}


def outcome(corpus, capture):
    """What became of a take."""
    states = {s: read_json(corpus / "state" / capture.id / f"{s}.json") for s in STAGES}
    row = {
        "id": capture.id,
        "subject": capture.subject,
        "take": f"{capture.subject}/{capture.take}",
        "avatar": states["fit"].get("ok", False),
        "seconds": {s: o["cost"]["seconds"] for s, o in states.items() if "cost" in o},
        "cpu_seconds": {s: o["cost"]["cpu_seconds"] for s, o in states.items() if "cost" in o},
        "peak_mib": max((o["cost"]["peak_mib"] for o in states.values() if "cost" in o), default=0),
        "frames": (states["record"].get("result") or {}).get("manifest", {}).get("frame_count"),
        "open": [s for s, o in states.items() if not o],
    }
    for stage, state in states.items():
        if state and not state["ok"] and not state.get("skipped"):
            row |= {"stage": stage, "error": state["error"], "hint": state.get("hint", "")}
            break
    # A driver without a track fails nothing but the transfer, and says so.
    if states["transfer"].get("because", "").startswith("driver "):
        row["note"] = states["transfer"]["because"]
    scores = read_json(corpus / "runs" / capture.id / "eval" / "eval.json")
    if scores:
        means = scores.get("means", {}).get("all", {})
        row |= {"psnr_db": means.get("psnr_db"), "ms_ssim": means.get("ms_ssim")}
        row["icc_3_1"] = (scores.get("control") or {}).get("mean_icc_3_1")
    row["views"] = [v["id"] for v in scores.get("views") or []]
    return row


def collect(corpus, rows):
    takes = [outcome(corpus, capture) for capture in rows.values()]
    return {
        "takes": takes,
        "avatars": sum(t["avatar"] for t in takes),
        "failed": [{k: t[k] for k in ("take", "stage", "error", "hint")} for t in takes if "error" in t],
        "open": sum(bool(t["open"]) and "error" not in t for t in takes),
    }


def number(value, digits):
    return "–" if value is None else f"{value:.{digits}f}"


def pictures(corpus, take):
    """Up to three pictures of the avatar, and the film, relative to the page."""
    run = corpus / "runs" / take["id"]
    # The folder may hold pictures of an earlier evaluation, too.
    found = [run / "eval" / "renders" / f"{view}.png" for view in take["views"]]
    chosen = [p for p in found[:: max(1, len(found) // 3)] if p.exists()][:3]
    links = [f'<img class="face" loading="lazy" src="{link(corpus, p)}" alt="">' for p in chosen]
    film = corpus / "transfers" / f"{take['id']}.mp4"
    more = [f'<a href="{link(corpus, film)}">transfer</a>'] if film.exists() else []
    for place, words in (("eval/report.html", "scores"),):
        if (run / place).exists():
            more.append(f'<a href="{link(corpus, run / place)}">{words}</a>')
    if (corpus / "datasets" / take["id"] / "report" / "index.html").exists():
        more.append(f'<a href="{link(corpus, corpus / "datasets" / take["id"] / "report" / "index.html")}">dataset</a>')
    return "".join(links) + "<br>" + " · ".join(more)


def link(corpus, path):
    return html.escape(os.path.relpath(path, corpus / "report").replace("%", "%25"))


def page(corpus, found):
    e = html.escape
    lines = [f"<!doctype html><html lang=en><meta charset=utf-8><title>Corpus</title><style>{STYLE}</style><h1>Corpus</h1>"]
    total = sum(sum(t["cpu_seconds"].values()) for t in found["takes"])
    lines.append(
        f"<p>{found['avatars']} avatars of {len(found['takes'])} takes, {len(found['failed'])} failed, "
        f"{found['open']} not done; {total / 60:.1f} CPU minutes.</p>"
    )
    if found["failed"]:
        lines.append("<h2>Failed</h2><table><tr><th>take<th>stage<th>error<th>what to do")
        for f in found["failed"]:
            cells = (f["take"], f["stage"], f["error"], f["hint"])
            lines.append('<tr class="bad">' + "".join(f"<td>{e(str(c))}" for c in cells))
        lines.append("</table>")
    lines.append("<h2>Takes</h2><table><tr><th>take<th>frames<th>PSNR, dB<th>MS-SSIM<th>ICC(3,1)<th>CPU s<th>peak MiB<th>avatar")
    for t in found["takes"]:
        state = "bad" if "error" in t else "open" if t["open"] else ""
        log = f'<br><small><a href="../logs/{e(t["id"]).replace("%", "%25")}/">logs</a></small>'
        said = t.get("error") and f"{t['stage']}: {t['error']}" or t.get("note") or (t["open"] and f"{t['open'][0]} to be done") or ""
        note = f"<br><small>{e(said)}</small>" if said else ""
        lines.append(
            f'<tr class="{state}"><td>{e(t["take"])}{log}{note}<td class=n>{t["frames"] or "–"}'
            f'<td class=n>{number(t.get("psnr_db"), 2)}<td class=n>{number(t.get("ms_ssim"), 3)}'
            f'<td class=n>{number(t.get("icc_3_1"), 3)}<td class=n>{sum(t["cpu_seconds"].values()):.1f}'
            f'<td class=n>{t["peak_mib"]:.0f}<td class=face>{pictures(corpus, t)}'
        )
    lines.append("</table><h2>Cost</h2>")
    lines.append(plot.cost_by_length(found["takes"]))
    return "\n".join(lines) + "\n"


def write(corpus, rows):
    """Writes the page; gives what it says."""
    corpus = Path(corpus)
    found = collect(corpus, rows)
    folder = corpus / "report"
    folder.mkdir(exist_ok=True)
    for name, text in (("report.json", json.dumps(found, indent=1) + "\n"), ("index.html", page(corpus, found))):
        staging = folder / f".{name}.part"
        staging.write_text(text, encoding="utf-8")
        staging.replace(folder / name)
    return found


if __name__ == "__main__":
    write(Path("."), table.read("captures.csv"))
