"""Files: safetensors for the tracker, ONNX for everyone else."""

import json
import struct
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "model-fetch"))

from onnx import FLOAT, Graph, field, tensor  # noqa: E402


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


def int8_tensor(name, values):
    return b"".join(field(1, d) for d in values.shape) + field(2, 3) + field(8, name) + field(9, values.tobytes())


def onnx_of(path, tensors, readout, parts):
    """The linear readout as a graph: `features` [1, D], the parts one after the other, in; `scores` [1, 17] out."""
    graph = Graph()
    rows_of_parts, length = [], 0
    for part in parts:
        rows, scale = tensors[f"{readout}.{part}"], tensors[f"{readout}.{part}.scale"]
        graph.constants.append(int8_tensor(f"{part}_weights", rows))
        graph.constants.append(tensor(f"{part}_scale", [len(scale)], [float(s) for s in scale], FLOAT))
        rows_of_parts.append(graph.node("DequantizeLinear", [f"{part}_weights", f"{part}_scale"], axis=0))
        length += rows.shape[1]
    rows = graph.node("Concat", rows_of_parts, axis=1)
    turned = graph.node("Transpose", [rows], perm=[1, 0])
    graph.node("MatMul", ["features", turned], output="scores")
    Path(path).write_bytes(graph.to_bytes("au_readout", [("features", [1, length])], [("scores", [1, 17])]))
