"""Skins for the shapes: colours of vertices, taken from photographs of faces, each once and then varied."""

import cv2
import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.optimize import least_squares

from face import EYES_END, FACE_END, GUMS_END, HEAD_END, LASHES, MOUTH_END, SOCKETS_END, TEETH_END
from network import POINT_OF_LANDMARK
from render import normals_of, project, turn

IDENTITIES = 30  # principal shapes that a single photograph can tell
SIZE_PENALTY = 1.0


def fit(basis, points68, size):
    """Rest of the face [V, 3] and its projection [V, 2] for 68 points in a picture (w, h); the expression is left alone."""
    inner = np.r_[17:60]
    vertex = basis.landmark68[inner]
    focal = 1.2 * max(size)
    middle = np.array(size) / 2
    eye = np.linalg.norm(points68[36] - points68[45])
    expressive = [basis.index(n) for n in ("jawOpen", "mouthSmile_L", "mouthSmile_R", "eyeBlink_L", "eyeBlink_R")]
    shapes = np.concatenate([basis.identity[:IDENTITIES][:, vertex], basis.expression[expressive][:, vertex]])

    def shape(p, neutral, modes):
        return neutral + np.tensordot(p[6:], modes, 1)

    def place(p, points):
        return project(points, turn(*p[:3]), p[3:6], focal)[0] + middle

    def residual(p):
        error = (place(p, shape(p, basis.neutral[vertex], shapes)) - points68[inner]).ravel() / eye * 100
        return np.concatenate([error, p[6 : 6 + IDENTITIES], 2 * p[6 + IDENTITIES :]])

    depth = focal * 8.9 / eye
    centre = (points68[30] - middle) / focal * depth
    start = np.zeros(6 + len(shapes))
    start[3:6] = [centre[0], centre[1], depth + 13]
    p = least_squares(residual, start, method="trf").x
    modes = np.concatenate([basis.identity[:IDENTITIES], basis.expression[expressive]])
    vertices = shape(p, basis.neutral, modes).astype(np.float32)
    flat = place(p, vertices)
    # The fit leaves a few pixels: the picture is bent to the points, so that brows and lips keep their places.
    bend = RBFInterpolator(flat[vertex], points68[inner] - flat[vertex], smoothing=1.0, kernel="thin_plate_spline")
    return vertices, turn(*p[:3]), p[3:6], flat + np.where((np.arange(len(flat)) < FACE_END)[:, None], bend(flat), 0)


def skin(basis, mesh, rgb, crop):
    """Colours [V, 3] 0–1 of the face in a photograph, from a crop in which the mesh finds it."""
    for _ in range(3):
        points, presence = mesh(rgb, crop)
        crop = mesh.next_crop(points)
    if presence < 0.5:
        raise ValueError("no face there")
    h, w = rgb.shape[:2]
    vertices, rotation, translation, flat = fit(basis, points[POINT_OF_LANDMARK, :2], (w, h))
    normals = normals_of(vertices, basis.triangles) @ rotation.T.astype(np.float32)
    facing = np.clip(normals[:, 2], 0, 1)
    flat = flat.astype(np.float32)
    inside = (flat > 2).all(1) & (flat < [w - 3, h - 3]).all(1)
    sampled = cv2.remap(rgb, flat[None, :, 0] - 0.5, flat[None, :, 1] - 0.5, cv2.INTER_LINEAR)[0].astype(np.float32) / 255
    weight = np.where(inside, np.clip((facing - 0.15) / 0.5, 0, 1), 0)
    weight[FACE_END:] = 0
    # Beyond the mesh lie hair, collar and background.
    outline = cv2.convexHull(points[:, :2].astype(np.float32))
    weight *= [cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for x, y in flat]
    # The other side of the face fills what this photograph does not see; what neither sees gets the mean skin.
    mirror = mirrored(basis)
    tone = np.median(sampled[:FACE_END][weight[:FACE_END] > 0.9], 0)
    around_eyes = np.abs(np.abs(basis.neutral[:FACE_END, 0]) - 3.2) < 2.2
    around_eyes &= np.abs(basis.neutral[:FACE_END, 1] - 3.0) < 1.2
    if np.median(sampled[:FACE_END][around_eyes]) < 0.5 * np.median(tone):
        raise ValueError("sunglasses")
    best = np.maximum(weight, 1e-3)[:, None]
    other = np.where(weight[mirror] > weight, weight[mirror], 0)[:, None]
    colours = (best * sampled + other * sampled[mirror] + 0.05 * tone) / (best + other + 0.05)
    colours[FACE_END:HEAD_END] = tone
    return colours.astype(np.float32), tone


_mirror = {}


def mirrored(basis):
    """The vertex on the other side of the face."""
    if id(basis) not in _mirror:
        from scipy.spatial import cKDTree

        _mirror[id(basis)] = cKDTree(basis.neutral).query(basis.neutral * [-1, 1, 1])[1]
    return _mirror[id(basis)]


def complexion(basis, rng):
    """Factors [FACE_END, 3] for the colours of a face: blotches, brows, beard and lips of its own."""
    v = basis.neutral[:FACE_END]
    x, y, z = v.T
    out = np.ones((FACE_END, 3))
    for _ in range(int(rng.integers(2, 7))):
        wave = rng.normal(0, 1, 3) * rng.choice([0.3, 0.8, 2.0])
        out *= 1 + rng.uniform(0, 0.07) * np.sin(v @ wave + rng.uniform(0, 6.28))[:, None] * rng.uniform(0.6, 1, 3)
    blob = lambda cx, cy, rx, ry: np.exp(-(((np.abs(x) - cx) / rx) ** 2 + ((y - cy) / ry) ** 2)) * (z > 3)
    brow = blob(rng.uniform(2.6, 3.6), rng.uniform(4.6, 5.6), rng.uniform(1.2, 2.2), rng.uniform(0.3, 0.6))
    out *= 1 - (rng.uniform(-0.25, 0.5) * brow)[:, None]
    if rng.random() < 0.4:
        chin, lip = blob(0, -6.5, rng.uniform(2, 5), 1.8), blob(0, -2.2, rng.uniform(1.5, 3), 0.5)
        out *= 1 - (rng.uniform(0, 0.5) * np.clip(chin + lip, 0, 1))[:, None]
    lips = blob(0, -3.7, 2.3, 0.8)[:, None] * rng.uniform(0, 0.3)
    return out * (1 - lips * np.array([0.0, 1.0, 0.7]))


def dressed(basis, rng, skins):
    """Colours [V, 3] of a new person: a skin or a mixture of two, its tone changed, hair, eyes, teeth and lashes added."""
    (a, tone), (b, _) = skins[rng.integers(len(skins))], skins[rng.integers(len(skins))]
    share = 0.0 if rng.random() < 0.5 else rng.uniform(0, 0.5)
    colours = (1 - share) * a + share * b
    if rng.random() < 0.5:
        colours = colours[mirrored(basis)]
    contrast, gain = rng.uniform(0.8, 1.3), rng.uniform(0.75, 1.25)
    tint = np.array([1, rng.normal(1, 0.05), rng.normal(1, 0.08)])
    colours = (tone + (colours - tone) * contrast) * gain * tint
    tone = tone * gain * tint
    colours[FACE_END:HEAD_END] = tone
    v = basis.neutral
    colours[:FACE_END] *= complexion(basis, rng)
    if rng.random() < 0.85:
        hair = rng.choice(np.array([[0.08, 0.06, 0.05], [0.25, 0.15, 0.08], [0.5, 0.38, 0.22], [0.35, 0.33, 0.32]]))
        line = rng.uniform(8.5, 10.5) - 0.05 * v[:, 0] ** 2 * rng.uniform(0, 1)
        crown = (v[:, 1] > line) | ((v[:, 2] < rng.uniform(-1, 2.5)) & (v[:, 1] > rng.uniform(-2, 3)))
        crown[HEAD_END:] = False
        colours[crown] = hair * rng.uniform(0.8, 1.2, (crown.sum(), 1))
    colours[HEAD_END:MOUTH_END] = [0.25, 0.08, 0.08]
    colours[MOUTH_END:SOCKETS_END] = 0.6 * tone
    colours[SOCKETS_END:GUMS_END] = [0.6, 0.3, 0.3]
    colours[GUMS_END:TEETH_END] = rng.uniform(0.65, 0.9) * np.array([1, 0.97, 0.88])
    iris = rng.choice(np.array([[0.25, 0.15, 0.08], [0.35, 0.45, 0.55], [0.35, 0.42, 0.3], [0.12, 0.08, 0.06]]))
    for eye in (slice(TEETH_END, TEETH_END + 1570), slice(TEETH_END + 1570, EYES_END)):
        ball = v[eye]
        middle = (ball.max(0) + ball.min(0)) / 2
        off = np.linalg.norm((ball - middle)[:, :2], axis=1)
        front = ball[:, 2] > middle[2]
        white = np.full((len(ball), 3), rng.uniform(0.75, 0.92))
        white[front & (off < 0.58)] = iris
        white[front & (off < 0.25)] = 0.02
        colours[eye] = white
    colours[LASHES] = colours[LASHES] * 0 + tone * rng.uniform(0.35, 0.9)
    return np.clip(colours, 0, 1.2).astype(np.float32)
