"""TensorFlow Lite → ONNX for the few operators that face networks use.

TensorFlow Lite keeps pictures as [batch, height, width, channels], ONNX convolutions want the channels second: a tensor is
turned where the two meet, and once only. Weights stored as 16-bit floats become 32-bit.
"""

from math import prod

from onnx import Graph
from tflite import Network

TO_NCHW, TO_NHWC = [0, 3, 1, 2], [0, 2, 3, 1]
ELEMENTWISE = {"ADD": "Add", "SUB": "Sub", "MUL": "Mul", "DIV": "Div"}
UNARY = {"LOGISTIC": "Sigmoid", "RELU": "Relu", "NEG": "Neg", "SQRT": "Sqrt"}


def turned(values, shape, order):
    """The values of a 4-D array with its axes in another order."""
    strides = [prod(shape[i + 1 :]) for i in range(4)]
    size, step = [shape[o] for o in order], [strides[o] for o in order]
    return [
        values[a * step[0] + b * step[1] + c * step[2] + d * step[3]]
        for a in range(size[0]) for b in range(size[1]) for c in range(size[2]) for d in range(size[3])
    ]  # fmt: skip


class Converter:
    def __init__(self, data):
        self.network, self.graph = Network(data), Graph()
        self.names = {}  # tensor → its name in [n, h, w, c] order, and the same in [n, c, h, w]
        self.names_nchw = {}
        self.values = {i: t.values for i, t in enumerate(self.network.tensors) if t.values is not None}

    def shape(self, i):
        return self.network.tensors[i].shape

    def plain(self, i):
        """The name of a tensor in its own order of axes."""
        if i not in self.names:
            if i in self.values:
                self.names[i] = self.graph.constant(self.shape(i), self.values[i])
            else:
                self.names[i] = self.graph.node("Transpose", [self.names_nchw[i]], perm=TO_NHWC)
        return self.names[i]

    def nchw(self, i):
        if i not in self.names_nchw:
            self.names_nchw[i] = self.graph.node("Transpose", [self.plain(i)], perm=TO_NCHW)
        return self.names_nchw[i]

    def padding(self, i, options, kernel, strides):
        """Zeros on the top, left, bottom, right: `SAME` puts the odd one last."""
        if options.number(0, "b") == 1:
            return [0, 0, 0, 0]
        before, after = [], []
        for size, k, s in zip(self.shape(i)[1:3], kernel, strides):
            total = max((-(-size // s) - 1) * s + k - size, 0)
            before.append(total // 2)
            after.append(total - total // 2)
        return before + after

    def activation(self, name, options, field):
        kind = options.number(field, "b") if options else 0
        if kind not in (0, 1):
            raise ValueError(f"activation {kind} is not known here")
        return self.graph.node("Relu", [name]) if kind == 1 else name

    def convolution(self, op):
        depthwise = op.kind == "DEPTHWISE_CONV_2D"
        x, w = op.inputs[:2]
        shape = self.shape(w)
        strides = [op.options.number(2), op.options.number(1)]
        order = [3, 0, 1, 2] if depthwise else [0, 3, 1, 2]
        weights = self.graph.constant([shape[o] for o in order], turned(self.values[w], shape, order))
        inputs = [self.nchw(x), weights]
        if len(op.inputs) > 2 and op.inputs[2] >= 0:
            inputs.append(self.plain(op.inputs[2]))
        name = self.graph.node(
            "Conv", inputs, kernel_shape=shape[1:3], strides=strides, pads=self.padding(x, op.options, shape[1:3], strides),
            group=shape[3] if depthwise else 1,
        )  # fmt: skip
        self.names_nchw[op.outputs[0]] = self.activation(name, op.options, 4 if depthwise else 3)

    def pooling(self, op):
        x, o = op.inputs[0], op.options
        strides, kernel = [o.number(2), o.number(1)], [o.number(4), o.number(3)]
        pads = self.padding(x, o, kernel, strides)
        name = self.graph.node("MaxPool", [self.nchw(x)], kernel_shape=kernel, strides=strides, pads=pads)
        self.names_nchw[op.outputs[0]] = self.activation(name, o, 5)

    def elementwise(self, op):
        kind, (a, b) = ELEMENTWISE[op.kind], op.inputs
        if a in self.names_nchw and b in self.names_nchw and self.shape(a) == self.shape(b):
            name = self.graph.node(kind, [self.nchw(a), self.nchw(b)])
            self.names_nchw[op.outputs[0]] = self.activation(name, op.options, 0)
        else:
            name = self.graph.node(kind, [self.plain(a), self.plain(b)])
            self.names[op.outputs[0]] = self.activation(name, op.options, 0)

    def unary(self, op):
        x, y = op.inputs[0], op.outputs[0]
        if x in self.names_nchw:
            self.names_nchw[y] = self.graph.node(UNARY[op.kind], [self.nchw(x)])
        else:
            self.names[y] = self.graph.node(UNARY[op.kind], [self.plain(x)])

    def slice(self, op):
        begin, end, step = (self.values[i] for i in op.inputs[1:4])
        begin_mask, end_mask, shrink = op.options.number(0), op.options.number(1), op.options.number(4)
        rank = len(begin)
        begin = [0 if begin_mask >> i & 1 else b for i, b in enumerate(begin)]
        end = [2**31 - 1 if end_mask >> i & 1 else e for i, e in enumerate(end)]
        end = [b + 1 if shrink >> i & 1 else e for i, (b, e) in enumerate(zip(begin, end))]
        numbers = self.graph.numbers
        name = self.graph.node(
            "Slice", [self.plain(op.inputs[0]), numbers(begin), numbers(end), numbers(list(range(rank))), numbers(step)]
        )
        gone = [i for i in range(rank) if shrink >> i & 1]
        self.names[op.outputs[0]] = self.graph.node("Squeeze", [name, numbers(gone)]) if gone else name

    def operator(self, op):
        graph, y = self.graph, op.outputs[0]
        if op.kind == "DEQUANTIZE":
            # 16-bit weights: the values are read already.
            self.values[y] = self.values[op.inputs[0]]
        elif op.kind in ("CONV_2D", "DEPTHWISE_CONV_2D"):
            self.convolution(op)
        elif op.kind == "MAX_POOL_2D":
            self.pooling(op)
        elif op.kind in ELEMENTWISE:
            self.elementwise(op)
        elif op.kind in UNARY:
            self.unary(op)
        elif op.kind == "PRELU":
            slope = self.values[op.inputs[1]]
            self.names_nchw[y] = graph.node("PRelu", [self.nchw(op.inputs[0]), graph.constant([len(slope), 1, 1], slope)])
        elif op.kind == "PAD":
            pads = self.values[op.inputs[1]]
            before, after = [pads[2 * o] for o in TO_NCHW], [pads[2 * o + 1] for o in TO_NCHW]
            self.names_nchw[y] = graph.node("Pad", [self.nchw(op.inputs[0]), graph.numbers(before + after)])
        elif op.kind == "RESHAPE":
            self.names[y] = graph.node("Reshape", [self.plain(op.inputs[0]), graph.numbers(self.shape(y))])
        elif op.kind == "TRANSPOSE":
            self.names[y] = graph.node("Transpose", [self.plain(op.inputs[0])], perm=self.values[op.inputs[1]])
        elif op.kind == "CONCATENATION":
            axis = op.options.number(0)
            self.names[y] = graph.node("Concat", [self.plain(i) for i in op.inputs], axis=axis)
        elif op.kind in ("MEAN", "SUM"):
            axes, keep = self.values[op.inputs[1]], op.options.number(0, "b")
            if op.kind == "MEAN":
                self.names[y] = graph.node("ReduceMean", [self.plain(op.inputs[0])], axes=axes, keepdims=keep)
            else:
                self.names[y] = graph.node("ReduceSum", [self.plain(op.inputs[0]), graph.numbers(axes)], keepdims=keep)
        elif op.kind == "STRIDED_SLICE":
            self.slice(op)
        elif op.kind == "RSQRT":
            root = graph.node("Sqrt", [self.plain(op.inputs[0])])
            self.names[y] = graph.node("Reciprocal", [root])
        elif op.kind == "SQUARED_DIFFERENCE":
            gap = graph.node("Sub", [self.plain(i) for i in op.inputs])
            self.names[y] = graph.node("Mul", [gap, gap])


def onnx_from_tflite(data, inner=None):
    """The bytes of an ONNX file with the inputs and outputs of a TensorFlow Lite file, names included.

    `inner` names outputs to be added for tensors inside, {number: name}; these have the channels before height and width.
    """
    converter = Converter(data)
    network, graph = converter.network, converter.graph
    for i in network.inputs:
        converter.names[i] = network.tensors[i].name
    for op in network.operators:
        converter.operator(op)
    for i in network.outputs:
        graph.node("Identity", [converter.plain(i)], output=network.tensors[i].name)
    outputs = [(network.tensors[i].name, network.tensors[i].shape) for i in network.outputs]
    for i, name in (inner or {}).items():
        graph.node("Identity", [converter.nchw(i)], output=name)
        outputs.append((name, [network.tensors[i].shape[k] for k in TO_NCHW]))
    inputs = [(network.tensors[i].name, network.tensors[i].shape) for i in network.inputs]
    return graph.to_bytes("network", inputs, outputs)
