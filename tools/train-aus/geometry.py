"""Alignment of the mesh, the step from the mesh to the 68 points, and the model of resting faces.

Everything mirrors: what is learned for one side is learned for both.
"""

import numpy as np

from network import POINT_OF_LANDMARK

# Points of the mesh that move with the skull rather than with the expression.
STABLE = [33, 133, 263, 362, 168, 6, 197, 195, 5, 4, 1, 98, 327, 10, 151, 9, 8, 67, 297, 109, 338, 127, 356, 234, 454, 103, 332]

# The point on the other side of the face, of the 68.
MIRROR68 = [
    *range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, 35, 34, 33, 32, 31, 45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40,
    54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65,
]  # fmt: skip


def similarities(mesh, canonical):
    """Rotation [N, 3, 3], scale [N], centre [N, 1, 3] with canonical ≈ scale (mesh − centre) rotation + its own centre."""
    a, b = mesh[:, STABLE], canonical[STABLE]
    centre = a.mean(1, keepdims=True)
    a, b = a - centre, b - b.mean(0)
    u, s, vt = np.linalg.svd(np.einsum("nki,kj->nij", a, b))
    d = np.ones_like(s)
    d[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = np.einsum("nij,nj,njk->nik", u, d, vt)
    return rotation, (s * d).sum(1) / (a**2).sum((1, 2)), centre


def aligned(mesh, canonical):
    """The mesh [N, 478, 3] turned, scaled and moved onto the canonical one."""
    rotation, scale, centre = similarities(mesh, canonical)
    return scale[:, None, None] * np.einsum("nki,nij->nkj", mesh - centre, rotation) + canonical[STABLE].mean(0)


def canonical_mesh(mesh):
    """The mean of the resting meshes: middle at the origin, outer eye corners 1 apart, symmetric."""
    mean = mesh[0]
    for _ in range(4):
        mean = aligned(mesh, mean).mean(0)
        # Upright: the axis between the eye corners along x, forehead to chin along y.
        x = mean[263] - mean[33]
        x /= np.linalg.norm(x)
        y = mean[152] - mean[10]
        y -= x * (x @ y)
        y /= np.linalg.norm(y)
        mean = (mean - mean.mean(0)) @ np.stack([x, y, np.cross(x, y)]).T
        mean /= np.linalg.norm(mean[263] - mean[33])
    return mean


def point_offsets(mesh, truth68, canonical, weight=1.0):
    """What to add to each of the 68 points of the mesh, in the canonical frame [68, 3], to get to the shapes' own points."""
    rotation, scale, _ = similarities(mesh, canonical)
    back = np.einsum("nij->nji", rotation) / scale[:, None, None]
    error = truth68 - mesh[:, POINT_OF_LANDMARK, :2]
    offsets = np.zeros((68, 3))
    for i in range(68):
        a = np.concatenate([back[:, :, 0], back[:, :, 1]]) * np.concatenate([scale, scale])[:, None]
        b = np.concatenate([error[:, i, 0], error[:, i, 1]]) * np.concatenate([scale, scale])
        offsets[i] = np.linalg.solve(a.T @ a + weight * np.eye(3), a.T @ b)
    return 0.5 * (offsets + offsets[MIRROR68] * [-1, 1, 1])


def resting_shapes(basis, modes=25):
    """Mean [68, 3] and principal shapes [modes, 68, 3] of resting faces: millimetres, x right, y down, z away."""
    to_head = np.array([10, -10, -10])
    mean = basis.neutral[basis.landmark68] * to_head
    shapes = basis.identity[:, basis.landmark68] * to_head
    shapes = shapes - shapes.mean(1, keepdims=True)
    _, s, vt = np.linalg.svd(shapes.reshape(len(shapes), -1), full_matrices=False)
    return mean - mean.mean(0), (s[:modes, None] * vt[:modes]).reshape(modes, 68, 3)
