"""A small rasteriser for coloured vertices, fast enough for some ten thousand faces on one core."""

import cv2
import numpy as np
from numba import njit


@njit(cache=True)
def normals_of(vertices, triangles):
    out = np.zeros_like(vertices)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t]
        u = vertices[b] - vertices[a]
        v = vertices[c] - vertices[a]
        n0 = u[1] * v[2] - u[2] * v[1]
        n1 = u[2] * v[0] - u[0] * v[2]
        n2 = u[0] * v[1] - u[1] * v[0]
        for i in (a, b, c):
            out[i, 0] += n0
            out[i, 1] += n1
            out[i, 2] += n2
    for i in range(out.shape[0]):
        n = np.sqrt(out[i, 0] ** 2 + out[i, 1] ** 2 + out[i, 2] ** 2) + 1e-9
        out[i] /= n
    return out


@njit(cache=True)
def rasterise(points, depth, colours, triangles, picture):
    """Draws over `picture` [h, w, 3]; `points` [V, 2] pixels, pixel centres at .5; nearer is smaller `depth`."""
    h, w = picture.shape[:2]
    nearest = np.full((h, w), np.inf, np.float32)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t]
        ax, ay = points[a]
        bx, by = points[b]
        cx, cy = points[c]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        x0 = max(0, int(np.floor(min(ax, bx, cx) - 0.5)))
        x1 = min(w - 1, int(np.ceil(max(ax, bx, cx) - 0.5)))
        y0 = max(0, int(np.floor(min(ay, by, cy) - 0.5)))
        y1 = min(h - 1, int(np.ceil(max(ay, by, cy) - 0.5)))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                px, py = x + 0.5, y + 0.5
                wb = ((px - ax) * (cy - ay) - (py - ay) * (cx - ax)) / area
                wc = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) / area
                wa = 1 - wb - wc
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                z = wa * depth[a] + wb * depth[b] + wc * depth[c]
                if z < nearest[y, x]:
                    nearest[y, x] = z
                    for k in range(3):
                        picture[y, x, k] = wa * colours[a, k] + wb * colours[b, k] + wc * colours[c, k]


class Light:
    """One soft light from a side, the rest from all around; fixed to the room or to the head."""

    def __init__(self, rng):
        direction = np.array([rng.normal(0, 0.7), rng.normal(0.3, 0.4), 1.0])
        self.direction = (direction / np.linalg.norm(direction)).astype(np.float32)
        self.ambient = rng.uniform(0.25, 0.85)
        self.tint = rng.normal(1, 0.05, 3).astype(np.float32)
        self.gloss = rng.uniform(0, 0.12) if rng.random() < 0.5 else 0.0

    def shade(self, normals, colours):
        lambert = np.clip(normals @ self.direction, 0, 1)
        lit = self.ambient + (1.2 - self.ambient) * lambert
        half = self.direction + np.array([0, 0, 1], np.float32)
        half /= np.linalg.norm(half)
        shine = self.gloss * np.clip(normals @ half, 0, 1) ** 12
        return colours * (lit[:, None] * self.tint) + shine[:, None]


def project(vertices, rotation, translation, focal):
    """Head space (cm) to the picture: x right, y down, z forward; the middle of the picture is (0, 0)."""
    camera = vertices @ (np.diag([1, -1, -1]) @ rotation).T.astype(np.float32) + translation.astype(np.float32)
    return focal * camera[:, :2] / camera[:, 2:], camera


def turn(yaw, pitch, roll):
    """Rotation of the head in its own axes, radians."""
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rx = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    rz = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return rz @ rx @ ry


def backdrop(rng, size):
    """Something that is not a face: blurred noise, with straight edges half of the time."""
    coarse = rng.uniform(0, 1, (rng.integers(2, 12), rng.integers(2, 12), 3)).astype(np.float32)
    picture = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_NEAREST if rng.random() < 0.5 else cv2.INTER_CUBIC)
    return np.clip(0.2 + 0.6 * picture * rng.uniform(0.4, 1.2), 0, 1)


def photograph(rng, picture):
    """What a camera and a codec do: blur, noise, exposure, compression. 0–1 RGB in, 8-bit RGB out."""
    if rng.random() < 0.6:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.3))
    picture = picture * rng.uniform(0.8, 1.15) + rng.normal(0, rng.uniform(0, 0.02), picture.shape).astype(np.float32)
    eight = (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)
    if rng.random() < 0.5:
        ok, code = cv2.imencode(".jpg", eight, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))])
        eight = cv2.imdecode(code, cv2.IMREAD_COLOR)
    return eight
