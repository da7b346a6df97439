"""The landmark and blendshape networks as the tracker runs them: crop, normalise, infer, map back."""

import cv2
import numpy as np
import onnxruntime as ort

SIZE = 256  # pixels of the crop's side
MARGIN = 1.5  # crop side over the longer side of the box around the points

# The cells of inner feature maps that are used, by the maps' size: rows and columns that see the face.
WINDOW = {8: (slice(0, 8), slice(0, 8)), 16: (slice(3, 14), slice(2, 14))}

# Points of the mesh that stand for the 68 (iBUG order), and those that the blendshape network reads.
POINT_OF_LANDMARK = [int(v) for v in (
    "127 234 93 132 58 136 150 176 152 400 379 365 288 361 323 454 356 70 63 105 66 107 336 296 334 293 300 168 197 5 4 98 97 2 326 327 "
    "33 160 158 133 153 144 362 385 387 263 373 380 61 39 37 0 267 269 291 405 314 17 84 181 78 81 13 311 308 402 14 178").split()]
BLENDSHAPE_POINTS = [int(v) for v in (
    "0 1 4 5 6 7 8 10 13 14 17 21 33 37 39 40 46 52 53 54 55 58 61 63 65 66 67 70 78 80 81 82 84 87 88 91 93 95 103 105 107 109 127 132 "
    "133 136 144 145 146 148 149 150 152 153 154 155 157 158 159 160 161 162 163 168 172 173 176 178 181 185 191 195 197 234 246 249 251 "
    "263 267 269 270 276 282 283 284 285 288 291 293 295 296 297 300 308 310 311 312 314 317 318 321 323 324 332 334 336 338 356 361 362 "
    "365 373 374 375 377 378 379 380 381 382 384 385 386 387 388 389 390 397 398 400 402 405 409 415 454 466 468 469 470 471 472 473 474 "
    "475 476 477").split()]


def session(path):
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def crop_around(points):
    """(centre x, centre y, side, angle) of the next crop: the box around the points, eyes level."""
    eyes = points[263, :2] - points[33, :2]
    angle = np.arctan2(eyes[1], eyes[0])
    c, s = np.cos(angle), np.sin(angle)
    level = points[:, :2] @ np.array([[c, s], [-s, c]]).T
    low, high = level.min(0), level.max(0)
    x, y = (low + high) / 2
    return c * x - s * y, s * x + c * y, float((high - low).max()) * MARGIN, angle


def picture_from_crop(crop):
    """2×3 matrix; pixel centres at .5 on both sides."""
    x, y, side, angle = crop
    k = side / SIZE
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[k * c, -k * s, 0], [k * s, k * c, 0]])
    matrix[:, 2] = np.array([x, y]) - matrix[:, :2] @ [SIZE / 2, SIZE / 2]
    return matrix


class Mesh:
    """478 points (x, y pixels of the picture, z in the same unit) and the probability that there is a face."""

    def __init__(self, path):
        self.session = session(path)
        self.input = self.session.get_inputs()[0].name
        self.next_crop = crop_around
        # What the network thinks inside, where the file gives it.
        self.inner = [o.name for o in self.session.get_outputs() if o.name.startswith("inner")]
        self.features = []

    def __call__(self, rgb, crop):
        matrix = picture_from_crop(crop)
        shifted = matrix.copy()
        shifted[:, 2] += matrix[:, :2] @ [0.5, 0.5] - 0.5
        patch = cv2.warpAffine(rgb, shifted, (SIZE, SIZE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        names = ["Identity", "Identity_1", *self.inner]
        out = self.session.run(names, {self.input: patch[None].astype(np.float32) / 255})
        self.features = [o[0][:, *WINDOW[o.shape[2]]].ravel() for o in out[2:]]
        points = out[0].reshape(-1, 3)
        presence = 1 / (1 + np.exp(-float(out[1].ravel()[0])))
        flat = points[:, :2] @ matrix[:, :2].T + matrix[:, 2]
        return np.concatenate([flat, points[:, 2:] * (crop[2] / SIZE)], 1), presence
