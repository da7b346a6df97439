"""Fits the AU readouts and writes the tracker's weights.

usage: train.py --basis ict_face_basis.npz --data data.npz… --out face_v2.safetensors

A readout is linear in what the networks and gradients say of a face; trained is what that differs by from the same person's
rest, because the tracker subtracts the rest too. Each kind of input has a ridge of its own in the unwhitened space:
W = (XᵀX/n + λ tr(XᵀX)/(200 n) · I)⁻¹ XᵀY/n. Directions with little variance in rendered data get little weight: on real
faces they carry noise. The scores of each kind are brought to the scale of intensities on people held out, and averaged.
"""

import argparse
import json

import numpy as np

import face
from export import quantised, safetensors
from geometry import aligned, point_offsets, resting_shapes, similarities
from scores import above_rest, best_presence, correlation, icc31, pose_terms
from table import table_weights

# λ of each kind; `mesh` is relative to its mean eigenvalue.
RIDGE = {"fhog": 0.3, "inner16": 0.1, "mesh": 3.0 * 200 / 1434}
# What reads the points of each readout, beside the FHOG that all of them read.
READOUTS = {"full": ["mesh", "blendshapes", "inner16"], "plain": ["mesh", "blendshapes"], "bare": ["mesh"]}
# Which kinds make each AU where they are there (f: FHOG, m: mesh, b: table of blendshapes, i: inner map): those that agree
# with OpenFace on real clips and with the truth on rendered people; docs/decisions/0011-aus-on-real-faces.md.
KINDS = {
    1: "fm", 2: "fmbi", 4: "fm", 5: "b", 6: "fmb", 7: "fm", 9: "f", 10: "fi", 12: "fmb", 14: "fi", 15: "fm", 17: "fi", 20: "fi", 23: "fi",
    25: "fmbi", 26: "fmb", 45: "fm",
}  # fmt: skip
LETTER = {"mesh": "m", "blendshapes": "b", "inner16": "i"}
# Intensity over the regression slope: costs nothing on real faces, and ridge shrinks.
GAIN = 1.3
PART = 2048


def joined(paths):
    """The rows of several data files, as if they were one; people keep apart. The canonical mesh is the first one's."""
    files, out = [np.load(p) for p in paths], {"canonical": np.load(paths[0])["canonical"]}
    for key in ("person", "neutral", "aus", "mesh", "blend", "truth68", "fhog", "inner16"):
        out[key] = np.concatenate([f[key] for f in files])
    starts = np.cumsum([0] + [f["person"].max() + 1 for f in files[:-1]])
    out["person"] = np.concatenate([f["person"] + s for f, s in zip(files, starts)])
    return out


def ridge(x, y, weight):
    """Weights [D, 17] for rows [N, D]; sums in parts, so that half-precision rows stay small."""
    count, numbers = x.shape
    square, product = np.zeros((numbers, numbers), np.float32), np.zeros((numbers, y.shape[1]), np.float32)
    for start in range(0, count, PART):
        rows = x[start : start + PART].astype(np.float32)
        square += rows.T @ rows / count
        product += rows.T @ y[start : start + PART].astype(np.float32) / count
    square[np.diag_indices(numbers)] += weight * np.trace(square) / 200
    return np.linalg.solve(square, product)


def scaled(scores, aus):
    """The slope of the truth over each score."""
    return (scores * aus).sum(0) / (scores**2).sum(0)


def times(x, weights):
    return np.concatenate([x[i : i + PART].astype(np.float32) @ weights for i in range(0, len(x), PART)])


def mixture(kinds):
    """For each AU the share [17] of the FHOG and the weights [17] of the kinds of points, which add up to 1."""
    share, of_kind = np.zeros(len(face.UNITS)), {k: np.zeros(len(face.UNITS)) for k in kinds}
    for j, unit in enumerate(face.UNITS):
        used = [k for k in kinds if LETTER[k] in KINDS[unit]]
        if "f" in KINDS[unit]:
            share[j] = 1 / (1 + len(used))
        # An AU without points of its own, or without those that are there, has them for the confidence.
        for k in used or kinds:
            of_kind[k][j] = 1 / len(used or kinds)
        if not used and "f" not in KINDS[unit]:
            share[j] = 0.5
    return share, of_kind


def main():
    parser = argparse.ArgumentParser()
    for name in ("basis", "out"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--data", nargs="+", required=True)
    parser.add_argument("--held-out", type=int, default=8, help="every such person is held out, for slopes and presences")
    args = parser.parse_args()
    data = joined(args.data)
    person, neutral, aus, canonical = data["person"], data["neutral"], data["aus"].astype(np.float32), data["canonical"]
    mesh = data["mesh"].astype(np.float64)
    rotation, _, _ = similarities(mesh, canonical)
    terms = pose_terms(rotation)
    held = np.isin(person, np.unique(person)[:: args.held_out])
    inputs = {"mesh": aligned(mesh, canonical).reshape(len(mesh), -1).astype(np.float32), "blendshapes": data["blend"]}
    inputs.update({k: data.pop(k) for k in ("fhog", "inner16")})
    weights, scores = {}, {}
    for kind in list(inputs):
        above = above_rest(inputs.pop(kind), person, neutral, terms)
        w = table_weights() if kind == "blendshapes" else ridge(above[~held], aus[~held], RIDGE[kind])
        found = times(above[held], w)
        slope = scaled(found, aus[held])
        weights[kind], scores[kind] = w * slope, found * slope
        print(f"{kind}: {len(w)} numbers, r {np.mean(correlation(found, aus[held])):.3f} on people held out", flush=True)
    shape_mean, shape_modes = resting_shapes(face.Basis(args.basis))
    tensors = {
        "canonical": canonical, "point_offsets": point_offsets(mesh, data["truth68"], canonical),
        "shape_mean": shape_mean, "shape_modes": shape_modes,
    }  # fmt: skip
    tensors["fhog"], tensors["fhog.scale"] = quantised(weights["fhog"])
    report = {}
    for name, kinds in READOUTS.items():
        share, of_kind = mixture(kinds)
        points = sum(scores[k] * of_kind[k] for k in kinds)
        mixed = share * scores["fhog"] + (1 - share) * points
        gain = GAIN * scaled(mixed, aus[held])
        intensity = np.clip(gain * mixed, 0, 5)
        for k in kinds:
            tensors[f"{name}.{k}"], tensors[f"{name}.{k}.scale"] = quantised(weights[k] * of_kind[k])
        reliability = correlation(mixed, aus[held]).clip(0, 1)
        numbers = {"share": share, "gain": gain, "presence": best_presence(intensity, aus[held]), "reliability": reliability}
        tensors.update({f"{name}.{k}": v for k, v in numbers.items()})
        found = {f"AU{u:02}": [round(float(reliability[j]), 2), round(icc31(intensity[:, j], aus[held][:, j]), 2)] for j, u in enumerate(face.UNITS)}
        report[name] = {"mean": [round(float(v), 3) for v in np.mean(list(found.values()), 0)], **found}
        print(name, json.dumps(report[name]), flush=True)
    people = len(np.unique(person))
    safetensors(args.out, tensors, {"name": "risorius-face-2", "people": str(people), "held_out_r_icc31": json.dumps(report)})


if __name__ == "__main__":
    main()
