"""From scores to intensities: the prior of resting scores, gains, presences, and how good they are."""

import numpy as np


def pose_terms(rotation):
    """1, yaw, pitch and their squares [N, 6]; radians, of the rotations that `similarities` gives."""
    yaw = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
    pitch = np.arcsin(np.clip(-rotation[:, 1, 2], -1, 1))
    return np.stack([np.ones_like(yaw), yaw, pitch, yaw * yaw, yaw * pitch, pitch * pitch], 1)


def icc31(a, b):
    """ICC(3,1), consistency, of two raters."""
    d = np.stack([a, b], 1)
    n, k = d.shape
    mean = d.mean()
    rows, columns = k * ((d.mean(1) - mean) ** 2).sum(), n * ((d.mean(0) - mean) ** 2).sum()
    between = rows / (n - 1)
    error = (((d - mean) ** 2).sum() - rows - columns) / ((n - 1) * (k - 1))
    return float((between - error) / (between + (k - 1) * error))


def baseline_prior(scores, terms, person, neutral):
    """Mean [17, 6] and deviation [17, 6] over people of the resting score's pose terms, and its noise [17]."""
    count = scores.shape[1]
    mean, deviation, noise = np.zeros((count, 6)), np.full((count, 6), 1.0), np.full(count, 0.3)
    people = [(terms[m].astype(float), scores[m]) for p in np.unique(person) if (m := (person == p) & neutral).sum() >= 3]
    for j in range(count):
        # Expectation–maximisation of a linear model with coefficients that differ by person.
        for _ in range(30):
            found, spread, squares, rows = [], [], 0.0, 0
            for q, s in people:
                covariance = np.linalg.inv(q.T @ q / noise[j] ** 2 + np.diag(1 / deviation[j] ** 2))
                c = covariance @ (q.T @ s[:, j] / noise[j] ** 2 + mean[j] / deviation[j] ** 2)
                found.append(c)
                spread.append(np.diag(covariance))
                squares += ((s[:, j] - q @ c) ** 2).sum() + np.trace(q @ covariance @ q.T)
                rows += len(q)
            found = np.array(found)
            mean[j] = found.mean(0)
            deviation[j] = np.sqrt(((found - mean[j]) ** 2).mean(0) + np.mean(spread, 0)).clip(1e-3)
            noise[j] = max(np.sqrt(squares / rows), 1e-3)
    return mean, deviation, noise


def best_gain(scores, aus):
    """Gain and threshold of each AU with the best agreement: least squares alone shrinks what is hard to see."""
    gains, thresholds = [], []
    for j in range(scores.shape[1]):
        tried = [
            (icc31(np.clip(g * (scores[:, j] - t), 0, 5), aus[:, j]), g, t)
            for g in np.arange(0.8, 6.01, 0.1)
            for t in np.arange(0, 0.81, 0.1)
        ]
        _, gain, threshold = max(tried)
        gains.append(gain)
        thresholds.append(threshold)
    return np.array(gains), np.array(thresholds)


def f1(found, truth):
    both = (found & truth).sum()
    return 2 * both / max((found.sum() + truth.sum()), 1)


def best_presence(intensity, aus):
    """The intensity from which an AU counts as present, where the truth is 1 (FACS A) or more."""
    levels = np.arange(0.3, 2.51, 0.1)
    return np.array([max(levels, key=lambda v: f1(intensity[:, j] >= v, aus[:, j] >= 1)) for j in range(aus.shape[1])])
