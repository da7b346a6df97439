"""The masked, aligned face and its histograms of oriented gradients (FHOG): what the AU readout sees of the skin.

Aligned face: 112 × 112, a similarity in the picture from the stable points of the mesh to the canonical mesh seen from the
front; outer eye corners 50 px apart, the middle of the face oval at (56, 56); black outside the face oval.
FHOG (Felzenszwalb et al. 2010, PAMI 32(9)): cells of 8 px, 12 × 12 inner cells × 31 numbers: 18 signed orientations,
9 unsigned ones, 4 texture energies. `tracker/src/aus/fhog.rs` computes the same numbers.
"""

import numpy as np
from numba import njit

from geometry import STABLE

SIDE, CELL, CELLS, NUMBERS = 112, 8, 12, 31
FHOG_NUMBERS = CELLS * CELLS * NUMBERS
EYES_PX = 50.0  # between the outer eye corners of the canonical mesh
FACE_OVAL = [
    10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149, 150, 136, 172, 58, 132, 93,
    234, 127, 162, 21, 54, 103, 67, 109,
]  # fmt: skip
DIRECTIONS = np.array([[np.cos(o * np.pi / 9), np.sin(o * np.pi / 9)] for o in range(9)], np.float32)


def template(canonical):
    """Where the points of the canonical mesh [478, 3] lie in the aligned face [478, 2]."""
    oval = canonical[FACE_OVAL, :2]
    return (canonical[:, :2] - (oval.min(0) + oval.max(0)) / 2) * EYES_PX + SIDE / 2


def face_from_picture(points, target):
    """2×3 similarity from the picture to the aligned face, least squares over the stable points; pixel centres at .5."""
    a, b = points[STABLE, :2].astype(np.float64), target[STABLE]
    ca, cb = a.mean(0), b.mean(0)
    a, b = a - ca, b - cb
    real, imaginary = (a * b).sum(), (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    linear = np.array([[real, -imaginary], [imaginary, real]]) / (a**2).sum()
    return np.c_[linear, cb - linear @ ca]


@njit(cache=True)
def sample(picture, picture_from_face, oval):
    """Bilinear samples [112, 112, 3] of the picture, 0 outside the polygon `oval` [36, 2] (aligned px, even–odd rule)."""
    h, w = picture.shape[:2]
    out = np.zeros((SIDE, SIDE, 3), np.float32)
    for row in range(SIDE):
        v = row + 0.5
        for column in range(SIDE):
            u = column + 0.5
            inside = False
            for i in range(len(oval)):
                ax, ay = oval[i]
                bx, by = oval[i - 1]
                if (ay > v) != (by > v) and u < (bx - ax) * (v - ay) / (by - ay) + ax:
                    inside = not inside
            if not inside:
                continue
            x = picture_from_face[0, 0] * u + picture_from_face[0, 1] * v + picture_from_face[0, 2] - 0.5
            y = picture_from_face[1, 0] * u + picture_from_face[1, 1] * v + picture_from_face[1, 2] - 0.5
            left, top = int(np.floor(x)), int(np.floor(y))
            if left < 0 or top < 0 or left + 1 >= w or top + 1 >= h:
                continue
            fx, fy = x - left, y - top
            for c in range(3):
                above = picture[top, left, c] * (1 - fx) + picture[top, left + 1, c] * fx
                below = picture[top + 1, left, c] * (1 - fx) + picture[top + 1, left + 1, c] * fx
                out[row, column, c] = above * (1 - fy) + below * fy
    return out


def aligned_face(picture, points, target):
    """The masked, aligned face [112, 112, 3] of a picture in which the mesh has `points` [478, 3]."""
    matrix = face_from_picture(points, target)
    oval = points[FACE_OVAL, :2] @ matrix[:, :2].T + matrix[:, 2]
    inverse = np.linalg.inv(matrix[:, :2])
    back = np.c_[inverse, -inverse @ matrix[:, 2]]
    return sample(picture, back.astype(np.float32), oval.astype(np.float32))


@njit(cache=True)
def fhog(face):
    """FHOG [12 × 12 × 31] of an aligned face [112, 112, 3], levels 0–255."""
    count = SIDE // CELL
    histogram = np.zeros((count + 2, count + 2, 18), np.float32)
    for y in range(1, SIDE - 1):
        yp = (y + 0.5) / CELL - 0.5
        iy = int(np.floor(yp))
        wy = np.float32(yp - iy)
        for x in range(1, SIDE - 1):
            best, gx, gy = np.float32(-1), np.float32(0), np.float32(0)
            for c in range(3):
                dx = face[y, x + 1, c] - face[y, x - 1, c]
                dy = face[y + 1, x, c] - face[y - 1, x, c]
                size = dx * dx + dy * dy
                if size > best:
                    best, gx, gy = size, dx, dy
            if best <= 0:
                continue
            largest, orientation = np.float32(0), 0
            for o in range(9):
                dot = DIRECTIONS[o, 0] * gx + DIRECTIONS[o, 1] * gy
                if dot > largest:
                    largest, orientation = dot, o
                elif -dot > largest:
                    largest, orientation = -dot, o + 9
            length = np.sqrt(best)
            xp = (x + 0.5) / CELL - 0.5
            ix = int(np.floor(xp))
            wx = np.float32(xp - ix)
            histogram[iy + 1, ix + 1, orientation] += length * (1 - wx) * (1 - wy)
            histogram[iy + 1, ix + 2, orientation] += length * wx * (1 - wy)
            histogram[iy + 2, ix + 1, orientation] += length * (1 - wx) * wy
            histogram[iy + 2, ix + 2, orientation] += length * wx * wy
    energy = np.zeros((count, count), np.float32)
    for y in range(count):
        for x in range(count):
            for o in range(9):
                both = histogram[y + 1, x + 1, o] + histogram[y + 1, x + 1, o + 9]
                energy[y, x] += both * both
    out = np.zeros((CELLS, CELLS, NUMBERS), np.float32)
    for y in range(CELLS):
        for x in range(CELLS):
            for corner in range(4):
                top, left = y + corner // 2, x + corner % 2
                block = energy[top, left] + energy[top, left + 1] + energy[top + 1, left] + energy[top + 1, left + 1]
                scale = np.float32(1) / np.sqrt(block + np.float32(1e-4))
                texture = np.float32(0)
                for o in range(18):
                    h = min(histogram[y + 2, x + 2, o] * scale, np.float32(0.2))
                    out[y, x, o] += np.float32(0.5) * h
                    texture += h
                for o in range(9):
                    both = histogram[y + 2, x + 2, o] + histogram[y + 2, x + 2, o + 9]
                    out[y, x, 18 + o] += np.float32(0.5) * min(both * scale, np.float32(0.2))
                out[y, x, 27 + corner] = np.float32(0.2357) * texture
    return out.ravel()
