#!/usr/bin/env python3
"""Constant offsets from the tracker's 68 points to OpenFace's, for `tracker run --aus openface`.

    openface_offsets.py OURS.csv THEIRS.csv [OURS.csv THEIRS.csv ...] > tracker/src/aus/openface/offsets.rs

Each pair is the tracker's openface.csv and a table of OpenFace itself of the same clip; rows match by frame number. The
offset of a point is constant in the frame of the head, in outer-eye distances: least squares over the frames of a clip,
then the mean over the clips and over both sides of the face. Only landmarks are read, no AUs. Python's own library only.
"""

import csv
import math
import sys

MIRROR = (list(range(16, -1, -1)) + list(range(26, 16, -1)) + list(range(27, 31)) + list(range(35, 30, -1))
          + [45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40] + list(range(54, 47, -1)) + list(range(59, 54, -1))
          + list(range(64, 59, -1)) + list(range(67, 64, -1)))
# Turns of a head in a clip tell little about depth.
DEPTH_RIDGE = 0.3


def table(path):
    with open(path, newline="") as f:
        rows = [{k.strip(): v for k, v in row.items()} for row in csv.DictReader(f)]
    good = [r for r in rows if float(r["success"]) == 1 and float(r["confidence"]) >= 0.8]
    return {int(float(r["frame"])): r for r in good}


def numbers(row, names):
    return [float(row[n]) for n in names]


def rotation(x, y, z):
    cx, sx, cy, sy, cz, sz = math.cos(x), math.sin(x), math.cos(y), math.sin(y), math.cos(z), math.sin(z)
    return [[cy * cz, -cy * sz, sy], [cx * sz + cz * sx * sy, cx * cz - sx * sy * sz, -cy * sx]]


def solve(a, b):
    m = [row[:] + [v] for row, v in zip(a, b)]
    for i in range(3):
        p = max(range(i, 3), key=lambda r: abs(m[r][i]))
        m[i], m[p] = m[p], m[i]
        for r in range(3):
            if r != i:
                k = m[r][i] / m[i][i]
                m[r] = [x - k * y for x, y in zip(m[r], m[i])]
    return [m[i][3] / m[i][i] for i in range(3)]


def offsets(ours, theirs):
    """Offset of each point, and the distance of the points before and after it, outer-eye distances."""
    frames = sorted(ours.keys() & theirs.keys())
    seen = []
    for f in frames:
        a, b = ours[f], theirs[f]
        r = rotation(*numbers(a, ["pose_Rx", "pose_Ry", "pose_Rz"]))
        p, q = ([numbers(row, [f"x_{i}", f"y_{i}"]) for i in range(68)] for row in (a, b))
        e, g = (numbers(a, [f"{axis}_{i}" for axis in "XYZ"]) for i in (36, 45))
        flat = math.hypot(e[0] - g[0], e[1] - g[1])
        unit = math.dist(p[36], p[45]) * math.dist(e, g) / flat
        seen.append((r, [[(v - u) / unit for u, v in zip(x, y)] for x, y in zip(p, q)]))
    out, before, after = [], 0.0, 0.0
    for i in range(68):
        ata = [[0.0] * 3 for _ in range(3)]
        atb = [0.0] * 3
        for r, d in seen:
            for row, v in zip(r, d[i]):
                for j in range(3):
                    atb[j] += row[j] * v
                    for k in range(3):
                        ata[j][k] += row[j] * row[k]
        ata[2][2] += DEPTH_RIDGE * len(seen)
        out.append(solve(ata, atb))
        if i >= 17:
            for r, d in seen:
                left = [v - sum(a * b for a, b in zip(row, out[i])) for row, v in zip(r, d[i])]
                before += math.hypot(*d[i]) / len(seen) / 51
                after += math.hypot(*left) / len(seen) / 51
    print(f"{len(frames)} frames, inner points {before:.4f} apart, {after:.4f} without the offset", file=sys.stderr)
    return out


def main():
    pairs = list(zip(sys.argv[1::2], sys.argv[2::2]))
    clips = [offsets(table(a), table(b)) for a, b in pairs]
    mean = [[sum(c[i][k] for c in clips) / len(clips) for k in range(3)] for i in range(68)]
    both = [[0.5 * (mean[i][k] + (-1 if k == 0 else 1) * mean[MIRROR[i]][k]) for k in range(3)] for i in range(68)]
    print("//! From the tracker's 68 points to OpenFace's: constant offsets, made by `tools/train-aus/openface_offsets.py`.\n")
    print("use glam::DVec3;\n\nuse super::point_model::POINTS;\n")
    print("/// From the tracker's point to OpenFace's in the frame of the head, outer-eye distances.")
    print("pub(super) fn offset(point: usize) -> DVec3 {\n    DVec3::from(OFFSETS[point]) * 1e-4\n}\n")
    print("/// x right, y down, z away from the camera, ten-thousandths of the outer-eye distance.")
    print("const OFFSETS: [[f64; 3]; POINTS] = [")
    for o in both:
        print("    [" + ", ".join(f"{round(v * 1e4)}.0" for v in o) + "],")
    print("];")


main()
