"""Fits the AU regressor and writes the tracker's weights.

usage: train.py --basis ict_face_basis.npz --data data.npz… --out face_v1.safetensors [--onnx au_regressor_v1.onnx]

The regressor is linear in the aligned mesh, the blendshape coefficients and the landmark network's inner maps. Trained is
what these differ by from the same person's rest at the same pose, because the tracker subtracts the rest too. Three
readouts are fitted: `full` with everything, `plain` without the inner maps, `bare` with the mesh alone.
"""

import argparse
import json

import numpy as np

import face
from export import onnx_of, quantised, safetensors
from geometry import aligned, canonical_mesh, point_offsets, resting_shapes, similarities
from scores import baseline_prior, best_gain, best_presence, icc31, pose_terms

READOUTS = {"full": ["mesh", "blendshapes", "inner8", "inner16"], "plain": ["mesh", "blendshapes"], "bare": ["mesh"]}
# Principal components of each input that are used: beyond them the networks' noise begins.
COMPONENTS = {"mesh": 250, "blendshapes": 50, "inner8": 700, "inner16": 1000}
SMALLEST = {"mesh": 1e-3, "blendshapes": 3e-3, "inner8": 0.0, "inner16": 0.0}
RIDGE = 300.0
NEUTRAL_RIDGE = 0.3


def above_rest(values, person, neutral, terms):
    """What each row differs by from the fit of its person's neutral rows to the pose."""
    out = np.empty_like(values)
    for number in np.unique(person):
        own = person == number
        a = terms[own & neutral]
        if len(a) < 3:
            out[own] = values[own] - values[own].mean(0)
            continue
        weight = NEUTRAL_RIDGE * np.eye(6, dtype=np.float32)
        weight[0, 0] = 1e-6
        out[own] = values[own] - terms[own] @ np.linalg.solve(a.T @ a + weight, a.T @ values[own & neutral])
    return out


def principal(x, count, rng):
    """Directions [D, count] and deviations [count] of the largest components (randomised subspace iteration)."""
    if x.shape[1] <= 2000:
        values, vectors = np.linalg.eigh((x.T @ x).astype(np.float64) / len(x))
        order = np.argsort(values)[::-1][:count]
        return vectors[:, order].astype(np.float32), np.sqrt(values[order].clip(1e-12)).astype(np.float32)
    basis = rng.standard_normal((x.shape[1], count + 60)).astype(np.float32)
    for _ in range(3):
        basis, _ = np.linalg.qr(x.T @ (x @ basis))
    small = x @ basis
    values, vectors = np.linalg.eigh((small.T @ small).astype(np.float64) / len(x))
    order = np.argsort(values)[::-1][:count]
    return basis @ vectors[:, order].astype(np.float32), np.sqrt(values[order].clip(1e-12)).astype(np.float32)


def readout(parts, whitened, directions, aus, train):
    """Weights of each part, [D, 17]."""
    z = np.hstack([whitened[p][train] for p in parts]).astype(np.float64)
    solved = np.linalg.solve(z.T @ z + RIDGE * np.eye(z.shape[1]), z.T @ aus[train])
    out, start = {}, 0
    for p in parts:
        count = whitened[p].shape[1]
        out[p] = directions[p] @ solved[start : start + count].astype(np.float32)
        start += count
    return out


def joined(paths):
    """The rows of several data files, as if they were one; people keep apart."""
    files, out = [np.load(p) for p in paths], {}
    for key in files[0].files:
        out[key] = np.concatenate([f[key] for f in files])
    starts = np.cumsum([0] + [f["person"].max() + 1 for f in files[:-1]])
    out["person"] = np.concatenate([f["person"] + s for f, s in zip(files, starts)])
    return out


def main():
    parser = argparse.ArgumentParser()
    for name in ("basis", "out"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--data", nargs="+", required=True)
    parser.add_argument("--onnx")
    parser.add_argument("--held-out", type=float, default=0.12, help="share of the people that gains are chosen on")
    args = parser.parse_args()
    data = joined(args.data)
    person, neutral, aus = data["person"], data["neutral"], data["aus"].astype(np.float64)
    mesh = data["mesh"].astype(np.float64)
    canonical = canonical_mesh(mesh[neutral])
    rotation, _, _ = similarities(mesh, canonical)
    terms = pose_terms(rotation).astype(np.float32)
    inputs = {"mesh": aligned(mesh, canonical).reshape(len(mesh), -1).astype(np.float32), "blendshapes": data["blend"]}
    inputs.update({k: data[k].astype(np.float32) for k in ("inner8", "inner16") if k in data})
    people = np.unique(person)
    held = np.isin(person, people[int(len(people) * (1 - args.held_out)) :])
    rng = np.random.default_rng(0)
    whitened, directions = {}, {}
    for name, values in inputs.items():
        x = above_rest(values, person, neutral, terms)
        # Every second row is enough for directions.
        vectors, deviation = principal(x[~held][::2], COMPONENTS[name], rng)
        keep = deviation > SMALLEST[name]
        vectors, deviation = vectors[:, keep], deviation[keep]
        directions[name] = vectors / deviation
        whitened[name] = x @ directions[name]
        print(f"{name}: {values.shape[1]} numbers, {vectors.shape[1]} components", flush=True)
    basis = face.Basis(args.basis)
    shape_mean, shape_modes = resting_shapes(basis)
    tensors = {
        "canonical": canonical, "point_offsets": point_offsets(mesh, data["truth68"], canonical),
        "shape_mean": shape_mean, "shape_modes": shape_modes,
    }  # fmt: skip
    report = {}
    for name, parts in READOUTS.items():
        parts = [p for p in parts if p in inputs]
        weights = {p: quantised(w) for p, w in readout(parts, whitened, directions, aus, ~held).items()}
        scores = sum(inputs[p] @ (q.astype(np.float32) * scale).T for p, (q, scale) in weights.items()).astype(np.float64)
        prior_mean, prior_deviation, noise = baseline_prior(scores, terms, person, neutral)
        rest = above_rest(scores, person, neutral, terms.astype(np.float64))[held]
        gain, threshold = best_gain(rest, aus[held])
        intensity = np.clip(gain * (rest - threshold), 0, 5)
        presence = best_presence(intensity, aus[held])
        for p, (q, scale) in weights.items():
            tensors[f"{name}.{p}"], tensors[f"{name}.{p}.scale"] = q, scale[:, 0]
        numbers = {"gain": gain, "threshold": threshold, "presence": presence, "noise": noise}
        tensors.update({f"{name}.{k}": v for k, v in numbers.items()})
        tensors.update({f"{name}.prior_mean": prior_mean, f"{name}.prior_deviation": prior_deviation})
        report[name] = {f"AU{u:02}": round(icc31(intensity[:, j], aus[held][:, j]), 3) for j, u in enumerate(face.UNITS)}
        report[name]["mean"] = round(float(np.mean(list(report[name].values()))), 3)
        print(name, json.dumps(report[name]), flush=True)
    safetensors(args.out, tensors, {"name": "risorius-face-1", "held_out_icc31": json.dumps(report)})
    if args.onnx:
        onnx_of(args.onnx, tensors, "full", READOUTS["full"])


if __name__ == "__main__":
    main()
