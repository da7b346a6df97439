#!/usr/bin/env python3
"""Cost per take against its length, as SVG.

usage: plot.py CORPUS OUT.svg
"""

import json
import sys
from pathlib import Path
from statistics import median

STAGES = ("record", "track", "poses", "dataset", "fit", "eval", "transfer", "collect")
COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#b07aa1", "#e15759", "#76b7b2", "#edc948", "#9c755f")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 760, 420, 64, 150, 28, 52


def nice(most):
    """A step that divides 0..most into four to eight parts."""
    step = 1.0
    while most / step > 8:
        step *= 2.5 if str(step)[0] == "2" else 2
    while most / step < 4:
        step /= 2
    return step


def cost_by_length(takes):
    """A bar per take that was finished, at its length in frames: CPU seconds of each stage, one upon the other; and a
    straight line through the sums."""
    points = [(t["frames"], t["cpu_seconds"], t["take"]) for t in takes if t.get("frames") and t.get("avatar")]
    if not points:
        return "<p>No take is finished yet.</p>"
    points.sort(key=lambda p: p[0])
    most_x, most_y = max(p[0] for p in points) * 1.06, max(sum(p[1].values()) for p in points) * 1.1
    x = lambda v: LEFT + v / most_x * (WIDTH - LEFT - RIGHT)  # noqa: E731
    y = lambda v: HEIGHT - BOTTOM - v / most_y * (HEIGHT - TOP - BOTTOM)  # noqa: E731
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
    ]
    step = nice(most_y)
    v = 0.0
    while v <= most_y:
        out.append(f'<path d="M{LEFT} {y(v):.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        out.append(f'<text x="{LEFT - 8}" y="{y(v) + 4:.1f}" text-anchor="end">{v:g}</text>')
        v += step
    step = nice(most_x)
    v = 0.0
    while v <= most_x:
        out.append(f'<path d="M{x(v):.1f} {HEIGHT - BOTTOM}v5" stroke="#888"/>')
        out.append(f'<text x="{x(v):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{v:g}</text>')
        v += step
    bar = max(3.0, min(14.0, 0.6 * (WIDTH - LEFT - RIGHT) / len(points)))
    for frames, cost, name in points:
        base = 0.0
        for stage, colour in zip(STAGES, COLOURS):
            seconds = cost.get(stage, 0.0)
            height = y(base) - y(base + seconds)
            if height > 0.05:
                out.append(
                    f'<rect x="{x(frames) - bar / 2:.1f}" y="{y(base + seconds):.1f}" width="{bar:.1f}" '
                    f'height="{height:.2f}" fill="{colour}"><title>{name}: {stage} {seconds:.1f} s</title></rect>'
                )
            base += seconds
    a, b = line([(p[0], sum(p[1].values())) for p in points])
    first, last = points[0][0], points[-1][0]
    if last > first:
        out.append(
            f'<path d="M{x(first):.1f} {y(a + b * first):.1f}L{x(last):.1f} {y(a + b * last):.1f}" '
            'stroke="#222" stroke-dasharray="5 4" fill="none"/>'
        )
        out.append(f'<text x="{LEFT + 8}" y="{TOP - 8}">{a:.1f} s {"+" if b >= 0 else "−"} {abs(1000 * b):.0f} s per 1,000 frames</text>')
    out.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 12}" text-anchor="middle">frames of the take</text>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    out.append(f'<text x="18" y="{middle}" text-anchor="middle" transform="rotate(-90 18 {middle})">CPU seconds</text>')
    for k, (stage, colour) in enumerate(zip(STAGES, COLOURS)):
        top = HEIGHT - BOTTOM - 20 * k
        out.append(f'<rect x="{WIDTH - RIGHT + 24}" y="{top - 10}" width="12" height="12" fill="{colour}"/>')
        out.append(f'<text x="{WIDTH - RIGHT + 42}" y="{top}">{stage}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def line(points):
    """The straight line of Theil and Sen: a few takes that went another way do not bend it."""
    slopes = [(q[1] - p[1]) / (q[0] - p[0]) for k, p in enumerate(points) for q in points[k + 1 :] if q[0] != p[0]]
    slope = median(slopes) if slopes else 0.0
    return median([y - slope * x for x, y in points]), slope


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: plot.py CORPUS OUT.svg")
    found = json.loads((Path(sys.argv[1]) / "report" / "report.json").read_text())
    Path(sys.argv[2]).write_text(cost_by_length(found["takes"]))
