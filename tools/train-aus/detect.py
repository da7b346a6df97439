"""Faces in a whole picture, by MediaPipe's short-range detector: only to find where photographs have faces."""

import cv2
import numpy as np

from network import session

SIZE = 128
ANCHORS = np.array([
    [(x + 0.5) / grid, (y + 0.5) / grid] for grid, each in ((16, 2), (8, 6)) for y in range(grid) for x in range(grid) for _ in range(each)
])  # fmt: skip


class Detector:
    def __init__(self, models):
        self.session = session(models / "face_detector.onnx")

    def __call__(self, rgb):
        """Crops (x, y, side, angle) of all faces: of the whole picture, and of squares of it for small ones."""
        h, w = rgb.shape[:2]
        boxes, scores = [], []
        for side in (max(h, w), min(h, w) / 2, min(h, w) / 3):
            steps = lambda length: np.linspace(0, max(length - side, 0), int(np.ceil(max(length - side, 0) / side * 2)) + 1)
            for top in steps(h):
                for left in steps(w):
                    self.look(rgb, left, top, side, boxes, scores)
        kept = []
        for i in np.argsort(-np.array(scores)):
            if all(overlap(boxes[i], k) < 0.2 for k in kept):
                kept.append(boxes[i])
        return [((b[0] + b[2]) / 2, (b[1] + b[3]) / 2, max(b[2] - b[0], b[3] - b[1]) * 1.5, 0.0) for b in kept]

    def look(self, rgb, left, top, side, boxes, scores):
        k = side / SIZE
        matrix = np.array([[k, 0, left + 0.5 * k - 0.5], [0, k, top + 0.5 * k - 0.5]])
        patch = cv2.warpAffine(rgb, matrix, (SIZE, SIZE), flags=cv2.INTER_AREA | cv2.WARP_INVERSE_MAP)
        rows, logits = self.session.run(["regressors", "classificators"], {"input": patch[None].astype(np.float32) / 127.5 - 1})
        for i in np.flatnonzero(logits.ravel() > 1.5):
            centre, size = (rows[0, i, :2] + ANCHORS[i] * SIZE) * k + [left, top], rows[0, i, 2:4] * k
            boxes.append(np.concatenate([centre - size / 2, centre + size / 2]))
            scores.append(logits.ravel()[i])


def overlap(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    both = np.prod(np.clip(high - low, 0, None))
    return both / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - both)
