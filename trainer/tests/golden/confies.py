"""Golden outputs of a tiny CoNFies network, from the fact sheet's formulas alone, in NumPy and double precision.

    python confies.py > confies.json

Weights come from a formula on the parameter's name and index, so that the test can fill the same network without a file
of weights. Everything is written as loops and matrices, without a line of the project's code: networks, encodings, rigid
motion, masking, both levels' sampling, rendering and losses.
"""

import json
import math

import numpy as np

GROUPS = [[0], [1, 2]]
K, N, FRAMES, LATENT, DIMS = 3, 2, 3, 5, 2
WARP_BANDS, SHEET_BANDS, HYPER_BANDS, TEMPLATE_BANDS, VIEW_BANDS = 3, 3, 2, 3, 2
HYPER_WINDOW, WARP_WINDOW = 1.3, 1.6
RAYS, COARSE, FINE, NEAR, FAR = 4, 6, 5, 0.5, 2.5
MASK_WEIGHT, LATENT_WEIGHT, ATTRIBUTE_WEIGHT = 0.01, 1e-4, 0.07

shapes = {}


def parameter(name, *shape):
    """The value of element i of a parameter: a sine whose phase is a sum over the letters of its name."""
    shapes[name] = list(shape)
    phase = sum((j + 1) * b for j, b in enumerate(name.encode())) % 1009
    values = [math.sin(0.137 * phase + 1.7 * i) for i in range(math.prod(shape))]
    amplitude = 0.1 if "biases" in name or name == "latent" else 0.45
    # The network holds 32-bit numbers.
    return np.float32(amplitude * np.array(values)).astype(np.float64).reshape(shape)


def layer_shapes(inputs, depth, width, outputs):
    skip = 4 if depth > 4 else None
    for layer in range(depth):
        yield (inputs if layer == 0 else width + (inputs if layer == skip else 0)), width
    if outputs:
        yield width, outputs


def mlp(name, x, depth, width, outputs, group=None):
    """Dense layers with ReLU; before the fifth hidden layer the input is appended. `group` = (index, of how many)."""
    h = x
    sizes = list(layer_shapes(x.shape[1], depth, width, outputs))
    for layer, (a, b) in enumerate(sizes):
        if group is None:
            w, bias = parameter(f"{name}.weights.{layer}", a, b), parameter(f"{name}.biases.{layer}", b)
        else:
            index, of = group
            w = parameter(f"{name}.weights.{layer}", of, a, b)[index]
            bias = parameter(f"{name}.biases.{layer}", of, b)[index]
        if layer == 4 and layer < depth:
            h = np.concatenate([h, x], axis=1)
        h = h @ w + bias
        if layer < depth:
            h = np.maximum(h, 0.0)
    return h


def encode(x, bands, identity, a=None):
    parts = [x] if identity else []
    for k in range(bands):
        weight = 1.0 if a is None else 0.5 * (1 - math.cos(math.pi * min(max(a - k, 0.0), 1.0)))
        parts += [weight * np.sin(2.0**k * x), weight * np.sin(2.0**k * x + math.pi / 2)]
    return np.concatenate(parts, axis=1)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def softplus(x):
    return np.log1p(np.exp(-np.abs(x))) + np.maximum(x, 0)


def rigid(w, v, x):
    """x' of one point, by the exponential of the screw (Modern Robotics, 3.88)."""
    theta = np.linalg.norm(w)
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]) / theta
    rotation = np.eye(3) + math.sin(theta) * hat + (1 - math.cos(theta)) * hat @ hat
    g = theta * np.eye(3) + (1 - math.cos(theta)) * hat + (theta - math.sin(theta)) * hat @ hat
    return rotation @ x + g @ (v / theta)


def field(level, points, omega, alpha, direction):
    """Density, colour, mask logits and β of samples; all inputs have a row per sample."""
    screw = mlp("deformation.net", np.concatenate([encode(points, WARP_BANDS, True, WARP_WINDOW), omega], 1), 5, 8, 6)
    warped = np.array([rigid(s[:3], s[3:], p) for s, p in zip(screw, points)])
    sheet = encode(points, SHEET_BANDS, False)
    w = [
        mlp("ambient.per_attribute", np.concatenate([sheet, alpha[:, i : i + 1]], 1), 5, 6, DIMS, (i, K))
        for i in range(K)
    ]
    w0 = mlp("ambient.rest", np.concatenate([sheet, omega], 1), 5, 6, DIMS)
    position = encode(warped, TEMPLATE_BANDS, True)
    code = [encode(v, HYPER_BANDS, False, HYPER_WINDOW) for v in w]
    code0 = encode(w0, HYPER_BANDS, False, HYPER_WINDOW)

    logits = []
    for n, group in enumerate(GROUPS):
        own = np.concatenate([code[i] for i in group] + [code0], 1)
        name = f"{level}.masks.nets.{n}"
        hidden = mlp(f"{name}.trunk", np.concatenate([position, own], 1), 2, 6, None, (0, 1))
        # Rows of the branch's kernel: position, hidden, own.
        logits.append(mlp(f"{name}.branch", np.concatenate([position, hidden, own], 1), 1, 4, 1, (0, 1)))
    logits = np.concatenate(logits, 1)

    beta = []
    for i in range(K):
        own = np.concatenate([position, code0, code[i]], 1)
        hidden = mlp(f"{level}.uncertainty.nets.trunk", own, 1, 5, None, (i, K))
        beta.append(softplus(mlp(f"{level}.uncertainty.nets.branch", hidden, 1, 3, 1, (i, K))) + 0.03)
    beta = np.concatenate(beta, 1)

    m = sigmoid(logits)
    rest = 1 - np.clip(m.sum(1, keepdims=True), 0, 1)
    masked = [w[i] * m[:, n : n + 1] for n, group in enumerate(GROUPS) for i in group] + [w0 * rest]
    hyper = np.concatenate([encode(v, HYPER_BANDS, False, HYPER_WINDOW) for v in masked], 1)
    depth, width = (2, 7) if level == "coarse" else (6, 9)
    out = mlp(f"{level}.template.trunk", np.concatenate([position, hyper], 1), depth, width, 1 + width)
    color_in = np.concatenate([out[:, 1:], encode(direction, VIEW_BANDS, True)], 1)
    color = sigmoid(mlp(f"{level}.template.color", color_in, 1, 6, 3))
    return softplus(out[:, 0]), color, logits, beta


def weights(density, z):
    delta = np.append(np.diff(z), 1e10)
    a = 1 - np.exp(-density * delta)
    return a * np.cumprod(np.append(1.0, 1 - a[:-1] + 1e-10))


def importance(z, w, count):
    """Quantiles of the piecewise constant density of the interior weights over the mid-points, and the old depths."""
    bins, pdf = (z[1:] + z[:-1]) / 2, w[1:-1] + 1e-5
    cdf = np.append(0.0, np.cumsum(pdf / pdf.sum()))
    new = []
    for u in np.linspace(0, 1, count):
        i = min(max(int(np.searchsorted(cdf, u, side="right")) - 1, 0), len(pdf) - 1)
        new.append(bins[i] + (u - cdf[i]) / (cdf[i + 1] - cdf[i]) * (bins[i + 1] - bins[i]))
    return np.sort(np.append(z, new))


def focal(logit, y):
    p = np.clip(sigmoid(logit), 1e-4, 1 - 1e-4)
    return -(0.5 * (1 - p) ** 1.5 * y * np.log(p) + 0.5 * p**1.5 * (1 - y) * np.log(1 - p))


def noise(n, seed):
    return np.float32([math.sin(2.1 * i + seed) for i in range(n)]).astype(np.float64)


frames = [0, 2, 1, 2]
latent = parameter("latent", FRAMES, LATENT)
omega = latent[frames]
alpha = np.tanh(mlp("attribute.net", omega, 6, 7, K))
origins = 0.2 * noise(RAYS * 3, 1.0).reshape(RAYS, 3)
directions = noise(RAYS * 3, 2.0).reshape(RAYS, 3) + np.array([0.0, 0.0, 2.0])
directions = np.float32(directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float64)
truth = (noise(RAYS * 3, 3.0).reshape(RAYS, 3) + 1) / 2
true_masks = (noise(RAYS * N, 4.0).reshape(RAYS, N) > 0.2).astype(float)
masks_given = np.array([[1.0] * N, [1.0] * N, [0.0] * N, [1.0] * N])
true_alpha = noise(RAYS * K, 5.0).reshape(RAYS, K)
alpha_given = np.array([[1.0] * K, [0.0] * K, [1.0, 1.0, 0.0], [1.0] * K])

out, total = {}, 0.0
depths = [np.linspace(NEAR, FAR, COARSE) for _ in range(RAYS)]
for level in ["coarse", "fine"]:
    rendered = []
    samples = []
    next_depths = []
    for r in range(RAYS):
        z = depths[r]
        points = origins[r] + z[:, None] * directions[r]
        row = lambda v: np.repeat(v[r : r + 1], len(z), axis=0)
        density, color, logits, beta = field(level, points, row(omega), row(alpha), row(directions))
        w = weights(density, z)
        samples.append({"z": z, "density": density, "weights": w})
        rendered.append((w @ color, w @ logits, w @ beta))
        next_depths.append(importance(z, w, FINE))
    rgb, logits, beta = (np.array(v) for v in zip(*rendered))
    terms = {
        "reconstruction": np.mean((rgb - truth) ** 2),
        "mask": (masks_given * focal(logits, true_masks)).sum() / (masks_given.sum() + 1e-7),
        "attribute": (alpha_given * ((alpha - true_alpha) ** 2 / (2 * beta**2) + np.log(beta) ** 2 / 2)).sum()
        / (alpha_given.sum() + 1e-7),
        "latent": np.mean((omega**2).sum(1)),
    }
    total += terms["reconstruction"] + MASK_WEIGHT * terms["mask"] + LATENT_WEIGHT * terms["latent"]
    total += ATTRIBUTE_WEIGHT * terms["attribute"]
    out[level] = {
        "depths": [list(s["z"]) for s in samples],
        "density": [list(s["density"]) for s in samples],
        "weights": [list(s["weights"]) for s in samples],
        "rgb": rgb.tolist(),
        "mask_logits": logits.tolist(),
        "beta": beta.tolist(),
        "terms": terms,
    }
    depths = next_depths

out["alpha"] = alpha.tolist()
out["total"] = total
out["parameters"] = shapes
print(json.dumps(out, indent=None, separators=(",", ":")))
