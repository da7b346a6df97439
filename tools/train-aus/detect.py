"""Faces in a whole picture, by the RFB-320 detector: only to find where photographs have faces."""

import cv2
import numpy as np

from network import session


class Detector:
    def __init__(self, models):
        self.session = session(models / "face_detector_rfb320.onnx")

    def __call__(self, rgb):
        """Crops (x, y, side, angle) of all faces, surest first."""
        h, w = rgb.shape[:2]
        scale = min(320 / w, 240 / h)
        size = round(w * scale), round(h * scale)
        canvas = np.full((240, 320, 3), 127, np.float32)
        canvas[: size[1], : size[0]] = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        scores, boxes = self.session.run(None, {"input": ((canvas - 127) / 128).transpose(2, 0, 1)[None]})
        scores, boxes = scores[0, :, 1], boxes[0] * [320, 240, 320, 240] / scale
        kept = []
        for i in np.flatnonzero(scores > 0.7)[np.argsort(-scores[scores > 0.7])]:
            if all(overlap(boxes[i], k) < 0.3 for k in kept):
                kept.append(boxes[i])
        return [((b[0] + b[2]) / 2, (b[1] + b[3]) / 2, max(b[2] - b[0], b[3] - b[1]) * 1.5, 0.0) for b in kept]


def overlap(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    both = np.prod(np.clip(high - low, 0, None))
    return both / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - both)
