"""Reads TensorFlow Lite files: just as much of the format (a FlatBuffer) as converting a network needs. Standard library only."""

import struct

FLOAT32, FLOAT16, INT32 = 0, 1, 2

# `BuiltinOperator` of the TensorFlow Lite schema, as far as it is used.
OPERATORS = {
    0: "ADD", 2: "CONCATENATION", 3: "CONV_2D", 4: "DEPTHWISE_CONV_2D", 6: "DEQUANTIZE", 14: "LOGISTIC", 17: "MAX_POOL_2D",
    18: "MUL", 19: "RELU", 22: "RESHAPE", 34: "PAD", 39: "TRANSPOSE", 40: "MEAN", 41: "SUB", 42: "DIV", 45: "STRIDED_SLICE",
    54: "PRELU", 59: "NEG", 74: "SUM", 75: "SQRT", 76: "RSQRT", 99: "SQUARED_DIFFERENCE",
}  # fmt: skip


class Table:
    """A FlatBuffer table: fields by their number in the schema."""

    def __init__(self, data, at):
        self.data, self.at = data, at
        self.fields = at - struct.unpack_from("<i", data, at)[0]
        self.count = (struct.unpack_from("<H", data, self.fields)[0] - 4) // 2

    def _offset(self, field):
        return struct.unpack_from("<H", self.data, self.fields + 4 + 2 * field)[0] if field < self.count else 0

    def number(self, field, code="i", default=0):
        offset = self._offset(field)
        return struct.unpack_from("<" + code, self.data, self.at + offset)[0] if offset else default

    def _target(self, field):
        offset = self._offset(field)
        if not offset:
            return None
        place = self.at + offset
        return place + struct.unpack_from("<I", self.data, place)[0]

    def table(self, field):
        target = self._target(field)
        return Table(self.data, target) if target else None

    def tables(self, field):
        target = self._target(field)
        if target is None:
            return []
        count = struct.unpack_from("<I", self.data, target)[0]
        places = [target + 4 + 4 * i for i in range(count)]
        return [Table(self.data, p + struct.unpack_from("<I", self.data, p)[0]) for p in places]

    def numbers(self, field, code="i"):
        target = self._target(field)
        if target is None:
            return []
        count = struct.unpack_from("<I", self.data, target)[0]
        return list(struct.unpack_from(f"<{count}{code}", self.data, target + 4))

    def bytes(self, field):
        target = self._target(field)
        if target is None:
            return b""
        count = struct.unpack_from("<I", self.data, target)[0]
        return self.data[target + 4 : target + 4 + count]


class Tensor:
    def __init__(self, table, buffers):
        self.shape, self.kind = table.numbers(0), table.number(1, "b")
        self.name = table.bytes(3).decode()
        raw = buffers[table.number(2, "I")]
        code = {FLOAT32: "f", FLOAT16: "e", INT32: "i"}.get(self.kind)
        self.values = list(struct.unpack(f"<{len(raw) // struct.calcsize(code)}{code}", raw)) if raw and code else None


class Operator:
    def __init__(self, table, codes):
        number = codes[table.number(0, "I")]
        if number not in OPERATORS:
            raise ValueError(f"operator {number} of TensorFlow Lite is not known here")
        self.kind = OPERATORS[number]
        self.inputs, self.outputs, self.options = table.numbers(1), table.numbers(2), table.table(4)


class Network:
    """The first graph of a file: tensors, operators in the order they run, numbers of input and output tensors."""

    def __init__(self, data):
        if data[4:8] != b"TFL3":
            raise ValueError("is not a TensorFlow Lite file")
        model = Table(data, struct.unpack_from("<I", data, 0)[0])
        codes = [max(c.number(0, "b"), c.number(3, "i")) for c in model.tables(1)]
        buffers = [b.bytes(0) for b in model.tables(4)]
        graph = model.tables(2)[0]
        self.tensors = [Tensor(t, buffers) for t in graph.tables(0)]
        self.inputs, self.outputs = graph.numbers(1), graph.numbers(2)
        self.operators = [Operator(o, codes) for o in graph.tables(3)]
