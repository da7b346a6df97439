"""Renders people with known action units and runs the landmark networks over them: what the AU regressor is trained on.

Rendering makes the networks' own noise and bias part of the data: the regressor learns what they see of each AU, not what
the shapes do.

usage: make_data.py --basis ict_face_basis.npz --models DIR --photos DIR --out data.npz [--people N] [--frames N] [--seed N]

`--photos` holds photographs and videos of faces for the skins; `--models` the three networks that `tools/models` fetches.
The aligned faces need a canonical mesh: it is the mean of 40 people at rest, the same for every `--seed`.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

import face
from detect import Detector
from fhog import aligned_face, fhog, template
from geometry import canonical_mesh
from network import BLENDSHAPE_POINTS, SIZE, Mesh, crop_around, session
from render import Light, backdrop, normals_of, photograph, project, rasterise, turn
from skins import dressed, skin
from wrinkles import Folds

FOCAL = 1200.0
SUPERSAMPLING = 1.25
CANONICAL_SEED, CANONICAL_PEOPLE, CANONICAL_FRAMES = 20, 40, 3


def photographs(folder):
    for path in sorted(Path(folder).rglob("*")):
        if path.suffix in (".png", ".jpg"):
            yield path, cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        elif path.suffix in (".mp4", ".mov"):
            ok, picture = cv2.VideoCapture(str(path)).read()
            if ok:
                yield path, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def skins_of(basis, mesh, detector, folder, skip):
    out = []
    for path, picture in photographs(folder):
        if any(word in path.name for word in skip):
            continue
        for crop in detector(picture):
            try:
                out.append(skin(basis, mesh, picture, crop))
            except ValueError:
                continue
    if not out:
        raise SystemExit(f"error: {folder}: no face found in any picture")
    return out


class Person:
    """One recording of one person: shape, skin, light, camera, and where the mesh's points lie on the shape."""

    def __init__(self, basis, rng, skins, hull):
        self.basis, self.rng, self.hull = basis, rng, hull
        self.rest = basis.person(np.clip(rng.normal(0, rng.uniform(0.3, 0.8), 100), -2, 2))
        self.colours = dressed(basis, rng, skins)
        self.folds = Folds(basis, rng)
        self.light, self.light_follows_head = Light(rng), rng.random() < 0.3
        self.distance = rng.uniform(40, 110)
        self.style = face.style(rng)
        self.backdrop = backdrop(rng, int(SIZE * SUPERSAMPLING))
        self.yaw, self.pitch = rng.uniform(0.05, 0.4), rng.uniform(0.03, 0.18)

    def frame(self, neutral):
        """One picture: (rgb, rotation [3, 3], AUs [17], the 68 points in crop pixels)."""
        rng, basis = self.rng, self.basis
        aus, weights = (np.zeros(17), np.zeros(len(basis.names))) if neutral else face.expression(basis, rng, self.style)
        if rng.random() < 0.4:
            face.gaze(basis, rng, weights)
        rotation = turn(rng.normal(0, self.yaw), rng.normal(0, self.pitch), rng.normal(0, 0.08))
        vertices = basis.shape(self.rest, weights)
        place = np.array([rng.normal(0, 4), rng.normal(0, 4), self.distance * rng.uniform(0.92, 1.08)])
        points, camera = project(vertices, rotation, place, FOCAL)
        crop = list(crop_around(points[self.hull]))
        # As in a video: the crop comes from the frame before.
        crop[0] += crop[2] * rng.normal(0, 0.01)
        crop[1] += crop[2] * rng.normal(0, 0.01)
        crop[2] *= 1 + rng.normal(0, 0.015)
        crop[3] += rng.normal(0, 0.015)
        side = int(SIZE * SUPERSAMPLING)
        k, c, s = side / crop[2], np.cos(crop[3]), np.sin(crop[3])
        in_crop = ((points - crop[:2]) @ np.array([[c, -s], [s, c]]) * k + side / 2).astype(np.float32)
        normals = normals_of(vertices, basis.triangles)
        seen = normals if self.light_follows_head else normals @ rotation.T.astype(np.float32)
        colours = self.colours * self.folds.shade(aus, len(self.colours))
        picture = self.backdrop.copy()
        rasterise(in_crop, camera[:, 2].astype(np.float32), self.light.shade(seen, colours).astype(np.float32), basis.triangles, picture)
        picture = cv2.resize(picture, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        return photograph(rng, picture), rotation, aus, in_crop[basis.landmark68] / SUPERSAMPLING


def hull_of(basis, mesh, skins, rng):
    """The vertex under each of the 478 points, from one look at a resting face."""
    person = Person(basis, rng, skins, basis.landmark68)
    vertices = basis.neutral
    points, camera = project(vertices, np.eye(3), np.array([0, 0, 80.0]), FOCAL)
    low, high = points[basis.landmark68].min(0), points[basis.landmark68].max(0)
    crop = (*((low + high) / 2), float((high - low).max()) * 1.6, 0.0)
    for _ in range(3):
        flat = ((points - crop[:2]) * SIZE / crop[2] + SIZE / 2).astype(np.float32)
        picture = np.full((SIZE, SIZE, 3), 0.5, np.float32)
        shade = person.light.shade(normals_of(vertices, basis.triangles), person.colours).astype(np.float32)
        rasterise(flat, camera[:, 2].astype(np.float32), shade, basis.triangles, picture)
        rgb = (np.clip(picture, 0, 1) * 255).astype(np.uint8)
        found, _ = mesh(rgb, (SIZE / 2, SIZE / 2, SIZE, 0.0))
        front = np.flatnonzero((np.arange(len(points)) < face.FACE_END) & (basis.neutral[:, 2] > -2))
        distance = np.linalg.norm(found[:, None, :2] - flat[front][None], axis=2)
        hull = front[distance.argmin(1)]
        crop = crop_around(points[hull])
    return hull


def canonical_of(basis, mesh, skins, hull):
    """The canonical mesh [478, 3]: the mean of some people at rest."""
    found = []
    for number in range(CANONICAL_PEOPLE):
        person = Person(basis, np.random.default_rng([CANONICAL_SEED, number]), skins, hull)
        found += [mesh(person.frame(True)[0], (SIZE / 2, SIZE / 2, SIZE, 0.0))[0] for _ in range(CANONICAL_FRAMES)]
    return canonical_mesh(np.array(found, np.float64))


def main():
    parser = argparse.ArgumentParser()
    for name in ("basis", "models", "photos", "out"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--people", type=int, default=240)
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--skip", nargs="*", default=[], help="words of file names that are not used as skins")
    args = parser.parse_args()
    basis = face.Basis(args.basis)
    models = Path(args.models)
    mesh, blend = Mesh(models / "face_landmarks_detector.onnx"), session(models / "face_blendshapes.onnx")
    skins = skins_of(basis, mesh, Detector(models), args.photos, args.skip)
    hull = hull_of(basis, mesh, skins, np.random.default_rng(CANONICAL_SEED))
    canonical = canonical_of(basis, mesh, skins, hull)
    target = template(canonical)
    rows = {k: [] for k in ("person", "neutral", "rotation", "aus", "mesh", "blend", "truth68", "face", "fhog", *mesh.inner)}
    kinds = {"person": np.int32, "neutral": bool, "face": np.uint8, **{k: np.float16 for k in ("fhog", *mesh.inner)}}
    begun = time.time()
    for number in range(args.people):
        person = Person(basis, np.random.default_rng([args.seed, number]), skins, hull)
        for k in range(args.frames):
            neutral = k < args.frames // 4
            rgb, rotation, aus, truth = person.frame(neutral)
            points, presence = mesh(rgb, (SIZE / 2, SIZE / 2, SIZE, 0.0))
            if presence < 0.5:
                continue
            pixels = (points[BLENDSHAPE_POINTS, :2][None]).astype(np.float32)
            coefficients = blend.run(None, {blend.get_inputs()[0].name: pixels})[0].ravel()
            face_px = aligned_face(rgb, points, target)
            values = (number, neutral, rotation, aus, points, coefficients, truth, face_px, fhog(face_px), *mesh.features)
            for key, value in zip(rows, values):
                rows[key].append(np.asarray(value, kinds.get(key, np.float32)))
            if number < 3 and k in (0, 30, 40, 50):
                cv2.imwrite(str(Path(args.out).with_suffix(f".{number}_{k}.png")), rgb[:, :, ::-1])
        if number % 20 == 19:
            print(f"{number + 1} of {args.people} people, {time.time() - begun:.0f} s", flush=True)
    np.savez(args.out, canonical=canonical, **{k: np.array(v) for k, v in rows.items()})


if __name__ == "__main__":
    main()
