"""AUs straight from MediaPipe's blendshape coefficients: which of them make which AU."""

import numpy as np

from face import UNITS

# The order of the network's coefficients; `_neutral` comes first.
NAMES = (
    "_neutral browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft cheekSquintRight "
    "eyeBlinkLeft eyeBlinkRight eyeLookDownLeft eyeLookDownRight eyeLookInLeft eyeLookInRight eyeLookOutLeft eyeLookOutRight "
    "eyeLookUpLeft eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight jawForward jawLeft jawOpen jawRight "
    "mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft "
    "mouthLowerDownRight mouthPressLeft mouthPressRight mouthPucker mouthRight mouthRollLower mouthRollUpper mouthShrugLower "
    "mouthShrugUpper mouthSmileLeft mouthSmileRight mouthStretchLeft mouthStretchRight mouthUpperUpLeft mouthUpperUpRight "
    "noseSneerLeft noseSneerRight"
).split()

# Left and right together; the AU at full strength has the sum 1.
TABLE = {
    1: {"browInnerUp": 1}, 2: {"browOuterUp": 1}, 4: {"browDown": 1}, 5: {"eyeWide": 1},
    6: {"mouthSmile": 0.5, "eyeSquint": 0.5}, 7: {"eyeSquint": 1}, 9: {"noseSneer": 1, "mouthUpperUp": 0.5}, 10: {"mouthUpperUp": 1},
    12: {"mouthSmile": 1}, 14: {"mouthDimple": 1, "mouthPress": 0.5}, 15: {"mouthFrown": 1}, 17: {"mouthShrugLower": 1},
    20: {"mouthStretch": 1}, 23: {"mouthPress": 1, "mouthRollLower": 0.5, "mouthRollUpper": 0.5},
    25: {"mouthLowerDown": 1, "jawOpen": 1, "mouthClose": -1}, 26: {"jawOpen": 1}, 45: {"eyeBlink": 1},
}  # fmt: skip


def table_weights():
    """[52, 17]: intensities 0–5 from coefficients 0–1."""
    out = np.zeros((len(NAMES), len(UNITS)), np.float32)
    for j, unit in enumerate(UNITS):
        for name, weight in TABLE[unit].items():
            for index in [i for i, n in enumerate(NAMES) if n.removesuffix("Left").removesuffix("Right") == name]:
                out[index, j] = 5 * weight / (1 if NAMES[index] == name else 2)
    return out
