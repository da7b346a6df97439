"""The safetensors file of the tracker's weights."""

import json
import struct
from pathlib import Path

import numpy as np


def quantised(weights):
    """[D, 17] to 8-bit rows [17, D] and the worth of their unit [17, 1]."""
    rows = weights.T
    scale = np.abs(rows).max(1, keepdims=True).clip(1e-12) / 127
    return np.rint(rows / scale).astype(np.int8), scale.astype(np.float32)


def safetensors(path, tensors, metadata):
    kinds = {np.dtype(np.int8): "I8", np.dtype(np.float32): "F32"}
    header, data, at = {"__metadata__": metadata}, [], 0
    for name in sorted(tensors):
        values = np.ascontiguousarray(tensors[name])
        if values.dtype != np.int8:
            values = values.astype(np.float32)
        raw = values.tobytes()
        header[name] = {"dtype": kinds[values.dtype], "shape": list(values.shape), "data_offsets": [at, at + len(raw)]}
        data.append(raw)
        at += len(raw)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    Path(path).write_bytes(struct.pack("<Q", len(text)) + text + b"".join(data))
