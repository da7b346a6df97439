"""Faces with known action units: the ICT-FaceKit Light shapes, and what each AU does to them.

Lengths are centimetres; axes are those of the shapes: x to the subject's left, y up, z out of the face.
"""

import numpy as np

UNITS = [1, 2, 4, 5, 6, 7, 9, 10, 12, 14, 15, 17, 20, 23, 25, 26, 45]

# Shapes (left and right together) of an AU at its full intensity 5.
SHAPES_OF_UNIT = {
    1: {"browInnerUp": 1.0},
    2: {"browOuterUp": 1.0},
    4: {"browDown": 1.0},
    5: {"eyeWide": 1.0},
    6: {"cheekSquint": 1.0},
    7: {"eyeSquint": 1.0},
    9: {"noseSneer": 0.9},
    10: {"mouthUpperUp": 0.85},
    12: {"mouthSmile": 0.85},
    14: {"mouthDimple": 0.75},
    15: {"mouthFrown": 1.0},
    17: {"mouthShrugLower": 0.9},
    20: {"mouthStretch": 0.9},
    23: {"mouthPress": 1.0, "mouthRollLower": 0.28, "mouthRollUpper": 0.28},
    25: {"mouthLowerDown": 0.95, "jawOpen": 0.1},
    26: {"jawOpen": 0.62},
    45: {"eyeBlink": 1.0},
}

# How often each AU is shown: those that are hard to see more often.
SHARE = np.array([2.0 if unit in (1, 4, 5, 6, 7, 14, 15) else 1.0 for unit in UNITS])
SHARE /= SHARE.sum()

# What happens in a face beside the 17 AUs and must not be taken for one of them.
OTHER_SHAPES = ["mouthPucker", "mouthFunnel", "mouthLeft", "mouthRight", "jawLeft", "jawRight", "jawForward", "cheekPuff", "mouthShrugUpper"]
GAZES = [("eyeLookDown", "eyeLookDown"), ("eyeLookUp", "eyeLookUp"), ("eyeLookIn", "eyeLookOut"), ("eyeLookOut", "eyeLookIn")]

# Ranges of vertices.
FACE_END, HEAD_END, MOUTH_END, SOCKETS_END, GUMS_END, TEETH_END, EYES_END = 9409, 11248, 13294, 14062, 17039, 21451, 24591
LASHES = slice(25351, 26719)


class Basis:
    """The shapes: `neutral` [V, 3], `identity` [100, V, 3], `expression` [53, V, 3], all f32."""

    def __init__(self, path):
        file = np.load(path)
        self.neutral = file["neutral"].astype(np.float32)
        self.identity = file["identity"].astype(np.float32)
        self.expression = file["expression"].astype(np.float32)
        self.names = [str(n) for n in file["expression_names"]]
        self.landmark68 = file["landmark68"]
        triangles = file["triangles"]
        # Tear film and the discs that hide the rim of the eyeballs are transparent: left out.
        opaque = (triangles < EYES_END).all(1) | (triangles >= LASHES.start).all(1)
        self.triangles = np.ascontiguousarray(triangles[opaque].astype(np.int32))

    def index(self, name):
        return self.names.index(name)

    def person(self, coefficients):
        """The resting face of a person: coefficients [100] ~ N(0, 1)."""
        return self.neutral + np.tensordot(coefficients.astype(np.float32), self.identity, 1)

    def shape(self, rest, weights):
        """A face [V, 3] from its rest and the weights [53] of the expressions."""
        used = np.flatnonzero(weights)
        return rest + np.tensordot(weights[used].astype(np.float32), self.expression[used], 1)

    def add(self, weights, name, left, right):
        """Adds a shape, whose two sides may differ."""
        if name in self.names:
            weights[self.index(name)] += 0.5 * (left + right)
        else:
            weights[self.index(name + "_L")] += left
            weights[self.index(name + "_R")] += right


def expression(basis, rng, style):
    """A random expression: intensities [17] 0–5 and weights [53].

    `style` varies the strength of each shape, by person: nobody has exactly the artist's.
    """
    aus = np.zeros(len(UNITS))
    kind = rng.random()
    if kind < 0.45:
        count = 1
    elif kind < 0.9:
        count = int(rng.integers(2, 5))
    else:
        count = 0
    if count:
        aus[rng.choice(len(UNITS), count, replace=False, p=SHARE)] = 5 * rng.random(count) ** 0.8
    if rng.random() < 0.1:
        aus[-1] = 5 * rng.random()
    weights = np.zeros(len(basis.names))
    for unit, intensity in zip(UNITS, aus):
        if intensity == 0:
            continue
        tilt = 1 + (rng.normal(0, 0.35) if rng.random() < 0.25 else rng.normal(0, 0.05))
        tilt = float(np.clip(tilt, 0.2, 1.8))
        for name, full in SHAPES_OF_UNIT[unit].items():
            w = full * intensity / 5 * style[name]
            basis.add(weights, name, w * tilt, w * (2 - tilt))
    if rng.random() < 0.12:
        name = OTHER_SHAPES[rng.integers(len(OTHER_SHAPES))]
        w = 0.6 * rng.random()
        basis.add(weights, name, w, w)
    return aus, weights


def gaze(basis, rng, weights):
    """Turns the eyes a little; the lids follow."""
    left, right = GAZES[rng.integers(len(GAZES))]
    w = 0.5 * rng.random() ** 2
    weights[basis.index(left + "_L")] += w
    weights[basis.index(right + "_R")] += w


def style(rng):
    names = {n for shapes in SHAPES_OF_UNIT.values() for n in shapes}
    return {n: float(np.clip(rng.normal(1, 0.12), 0.7, 1.3)) for n in sorted(names)}
