"""Writes ONNX files: a minimal encoder of the format (protocol buffers). Standard library only."""

import struct

FLOAT, INT64 = 1, 7
OPSET, IR_VERSION = 13, 7


def varint(value):
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def field(number, value):
    """A number, or bytes with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, str):
        value = value.encode()
    return varint(number << 3 | 2) + varint(len(value)) + value


def tensor(name, shape, values, kind=FLOAT):
    """`values`: numbers, or their bytes."""
    raw = values if isinstance(values, bytes) else struct.pack(f"<{len(values)}{'f' if kind == FLOAT else 'q'}", *values)
    return b"".join(field(1, d) for d in shape) + field(2, kind) + field(8, name) + field(9, raw)


def attribute(name, value):
    if isinstance(value, int):
        return field(1, name) + field(3, value) + field(20, 2)
    return field(1, name) + b"".join(field(8, v) for v in value) + field(20, 7)


def value_info(name, shape):
    # A size that is a word may be anything.
    dims = b"".join(field(1, field(2 if isinstance(d, str) else 1, d)) for d in shape)
    return field(1, name) + field(2, field(1, field(1, FLOAT) + field(2, dims)))


class Graph:
    """A graph under construction."""

    def __init__(self):
        self.nodes, self.constants, self.count = [], [], 0

    def constant(self, shape, values, kind=FLOAT):
        name = f"c{len(self.constants)}"
        self.constants.append(tensor(name, shape, values, kind))
        return name

    def raw(self, shape, data):
        """Numbers as the bytes they are stored in."""
        return self.constant(shape, bytes(data))

    def numbers(self, values):
        return self.constant([len(values)], values, INT64)

    def node(self, kind, inputs, output=None, **attributes):
        output = output or f"v{len(self.nodes)}"
        body = b"".join(field(1, i) for i in inputs) + field(2, output) + field(3, f"n{len(self.nodes)}") + field(4, kind)
        body += b"".join(field(5, attribute(k, v)) for k, v in sorted(attributes.items()))
        self.nodes.append(body)
        return output

    def to_bytes(self, name, inputs, outputs):
        """`inputs`, `outputs`: (name, shape) of each."""
        graph = b"".join(field(1, n) for n in self.nodes) + field(2, name) + b"".join(field(5, c) for c in self.constants)
        graph += b"".join(field(11, value_info(*i)) for i in inputs) + b"".join(field(12, value_info(*o)) for o in outputs)
        opset = field(1, "") + field(2, OPSET)
        return field(1, IR_VERSION) + field(2, "risorius") + field(7, graph) + field(8, opset)
