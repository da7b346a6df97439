"""Skin that folds: darker lines where an expression folds it, by anatomy and much simplified.

Shapes alone do not wrinkle, real faces do, and the landmark network sees it. Places are centimetres on the mean face.
"""

import numpy as np

from face import FACE_END, UNITS


def _near(x, low, high, soft=0.35):
    """1 between low and high, falling off softly."""
    rise = lambda u: 1 / (1 + np.exp(-np.clip(4 * u / soft, -60, 60)))
    return rise(x - low) * rise(high - x)


def _line(x, y, a, b, width):
    """1 along the segment from a to b, falling off with the distance."""
    a, d = np.array(a), np.array(b) - np.array(a)
    t = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / (d @ d), 0, 1)
    return np.exp(-(((x - a[0] - t * d[0]) ** 2 + (y - a[1] - t * d[1]) ** 2) / width**2))


class Folds:
    """The folds of one person: where they run and how deep they are."""

    def __init__(self, basis, rng):
        v = basis.neutral[:FACE_END]
        x, y, z = v.T
        front = _near(z, 4.5, 99, 1.0)
        depth = rng.uniform(0, 0.35) if rng.random() < 0.8 else 0.0
        own = lambda: depth * rng.uniform(0.4, 1.4)
        wave = lambda u, length: 0.5 + 0.5 * np.cos(2 * np.pi * u / length + rng.uniform(0, 6.28))
        ax = np.abs(x)
        self.parts = []

        def part(weights, pattern):
            self.parts.append(([UNITS.index(u) for u in weights], list(weights.values()), own() * pattern * front))

        arch = y + 0.1 * rng.normal() * x + rng.uniform(0, 0.03) * x**2
        forehead = _near(y, 6.2, 9.8, 0.6)
        part({1: 0.2, 2: 0.05}, forehead * _near(ax, -9, 2.8, 0.8) * wave(arch, rng.uniform(0.7, 1.4)))
        part({1: 0.05, 2: 0.2}, forehead * _near(ax, 1.8, 5.8, 0.8) * wave(arch, rng.uniform(0.7, 1.4)))
        part({4: 0.2}, _near(y, 4.0, 6.6) * _near(ax, -9, 1.5) * wave(x, rng.uniform(0.6, 1.1)))
        part({9: 0.2}, _near(y, 2.2, 4.2) * _near(ax, -9, 1.4) * wave(y - 0.4 * ax, rng.uniform(0.5, 0.8)))
        angle = np.arctan2(y - 3.4, ax - 4.4)
        part({6: 0.2, 12: 0.05}, _near(ax, 5.0, 6.8) * _near(y, 1.8, 5.0) * wave(angle, rng.uniform(0.3, 0.5)))
        under = _line(ax, y, (1.9, 2.5), (3.2, 2.1), 0.3) + _line(ax, y, (3.2, 2.1), (4.6, 2.6), 0.3)
        part({6: 0.15, 7: 0.1}, under)
        part({12: 0.12, 9: 0.15, 10: 0.15, 6: 0.05}, 1.3 * _line(ax, y, (1.9, 0.3), (3.6, -3.0), 0.35))
        part({14: 0.2, 12: 0.05}, 1.3 * _line(ax, y, (3.2, -2.9), (3.3, -3.9), 0.3))
        part({20: 0.15, 12: 0.05}, _line(ax, y, (3.9, -2.2), (4.1, -4.6), 0.35))
        part({15: 0.2}, _line(ax, y, (2.8, -4.1), (3.1, -5.4), 0.35))
        pebbles = np.sin(x * rng.uniform(4, 7) + rng.uniform(0, 6)) * np.sin(y * rng.uniform(4, 7))
        part({17: 0.2}, _near(ax, -9, 1.8) * _near(y, -7.2, -5.3) * (0.5 + 0.5 * pebbles))
        part({23: 0.2}, _near(ax, -9, 2.6) * (_near(y, -2.9, -2.0, 0.2) + _near(y, -5.2, -4.4, 0.2)) * wave(x, rng.uniform(0.4, 0.7)))
        part({25: 0.04, 26: 0.06}, _line(ax, y, (2.9, -4.2), (3.0, -6.2), 0.4))

    def shade(self, aus, count):
        """Factor for the colour of each of `count` vertices."""
        dark = np.zeros(FACE_END)
        for units, weights, pattern in self.parts:
            strength = min(sum(w * aus[u] for u, w in zip(units, weights)), 1.2)
            if strength > 0:
                dark += strength * pattern
        out = np.ones(count, np.float32)
        out[:FACE_END] = np.clip(1 - dark, 0.3, 1)
        return out[:, None]
