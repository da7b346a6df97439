"""From scores to intensities: what is above a person's rest, presences, and how good they are."""

import numpy as np

NEUTRAL_RIDGE = 0.3


def pose_terms(rotation):
    """1, yaw and pitch [N, 3]; radians, of the rotations that `similarities` gives."""
    yaw = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
    pitch = np.arcsin(np.clip(-rotation[:, 1, 2], -1, 1))
    return np.stack([np.ones_like(yaw), yaw, pitch], 1)


def icc31(a, b):
    """ICC(3,1), consistency, of two raters."""
    d = np.stack([a, b], 1)
    n, k = d.shape
    mean = d.mean()
    rows, columns = k * ((d.mean(1) - mean) ** 2).sum(), n * ((d.mean(0) - mean) ** 2).sum()
    between = rows / (n - 1)
    error = (((d - mean) ** 2).sum() - rows - columns) / ((n - 1) * (k - 1))
    return float((between - error) / (between + (k - 1) * error))


def correlation(a, b):
    """Pearson's r of each column."""
    a, b = a - a.mean(0), b - b.mean(0)
    return (a * b).sum(0) / np.sqrt((a**2).sum(0) * (b**2).sum(0)).clip(1e-12)


def above_rest(values, person, neutral, terms):
    """What each row [D] differs by from its person's rest: a line in yaw and pitch through the person's neutral rows."""
    out = np.empty(values.shape, values.dtype)
    ridge = np.diag([1e-6, NEUTRAL_RIDGE, NEUTRAL_RIDGE])
    for number in np.unique(person):
        own = person == number
        a, rows = terms[own & neutral], values[own & neutral].astype(np.float32)
        line = np.linalg.solve(a.T @ a + ridge, a.T @ rows) if len(a) >= 3 else None
        rest = terms[own] @ line if line is not None else values[own].astype(np.float32).mean(0)
        out[own] = values[own].astype(np.float32) - rest
    return out


def f1(found, truth):
    both = (found & truth).sum()
    return 2 * both / max((found.sum() + truth.sum()), 1)


def best_presence(intensity, aus):
    """The intensity from which an AU counts as present, where the truth is 1 (FACS A) or more."""
    levels = np.arange(0.3, 2.51, 0.1)
    return np.array([max(levels, key=lambda v: f1(intensity[:, j] >= v, aus[:, j] >= 1)) for j in range(aus.shape[1])])
