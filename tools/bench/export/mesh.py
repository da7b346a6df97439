#!/usr/bin/env python3
"""How an exported mesh looks from aside, beside the avatar itself: PSNR on the head, and how much of it is bare. NumPy, Pillow.

usage: tools/bench/export/mesh.py RUN MESH.glb --out DIR [--trainer target/release/trainer] [--yaw 0,15,25,35,-25]
"""

import argparse
import json
import math
import pathlib
import struct
import subprocess

import numpy as np
from PIL import Image


def read_glb(path):
    data = pathlib.Path(path).read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20:20 + size])
    body = data[20 + size + 8:]

    def numbers(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: np.float32, 5125: np.uint32, 5123: np.uint16}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(body, kind, accessor["count"] * width, start).reshape(-1, width)

    primitive = document["meshes"][0]["primitives"][0]
    return (numbers(primitive["attributes"]["POSITION"]).astype(float), numbers(primitive["attributes"]["COLOR_0"])[:, :3].astype(float),
            numbers(primitive["indices"]).reshape(-1, 3).astype(int))


def srgb(v):
    v = np.clip(v, 0, 1)
    return 255 * np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def rasterise(points, colors, triangles, camera):
    """Nearest surface of every pixel; `points` in the camera's axes (z forward)."""
    width, height = camera["width"], camera["height"]
    image, depth = np.zeros((height, width, 3)), np.full((height, width), np.inf)
    z = points[:, 2]
    xy = np.stack([camera["fx"] * points[:, 0] / z + camera["cx"], camera["fy"] * points[:, 1] / z + camera["cy"]], 1)
    for a, b, c in triangles[(z[triangles] > 0).all(1)]:
        (ax, ay), (bx, by), (cx, cy) = xy[a], xy[b], xy[c]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        x0, x1 = max(math.ceil(min(ax, bx, cx) - 0.5), 0), min(math.floor(max(ax, bx, cx) - 0.5), width - 1)
        y0, y1 = max(math.ceil(min(ay, by, cy) - 0.5), 0), min(math.floor(max(ay, by, cy) - 0.5), height - 1)
        if abs(area) < 1e-12 or x1 < x0 or y1 < y0:
            continue
        x, y = np.arange(x0, x1 + 1) + 0.5, (np.arange(y0, y1 + 1) + 0.5)[:, None]
        u = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
        v = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
        near = (1 - u - v) * z[a] + u * z[b] + v * z[c]
        window = np.s_[y0:y1 + 1, x0:x1 + 1]
        hit = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (near < depth[window])
        color = (1 - u - v)[..., None] * colors[a] + u[..., None] * colors[b] + v[..., None] * colors[c]
        depth[window] = np.where(hit, near, depth[window])
        image[window] = np.where(hit[..., None], color, image[window])
    return srgb(image), np.isfinite(depth)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=pathlib.Path)
    parser.add_argument("mesh")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--trainer", default="target/release/trainer")
    parser.add_argument("--yaw", default="0,15,25,35,-25")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    yaws = [float(v) for v in args.yaw.split(",")]
    keys = "".join(f"[[key]]\nsecs = {i}\norbit = {{ yaw_deg = {yaw} }}\npreset = \"neutral\"\n" for i, yaw in enumerate(yaws))
    (args.out / "path.toml").write_text("fps = 1\n" + keys)
    subprocess.run([args.trainer, "render", args.run, "--path", args.out / "path.toml", "--out", args.out / "avatar", "--alpha", "-q", "--no-progress"], check=True)
    saved = json.loads((args.run / "model.json").read_text())
    camera = saved["default_camera"]
    rows = np.array(camera["camera_from_world"])
    eye = rows[:, :3] @ np.array(saved["center_in_world"]) + rows[:, 3]  # the head's middle in the camera's axes
    points, colors, triangles = read_glb(args.mesh)
    flip = np.array([1, -1, -1])
    strips = []
    print(f"{len(points)} vertices, {len(triangles)} triangles")
    print("  yaw   PSNR dB   bare %")
    for i, yaw in enumerate(yaws):
        truth = np.asarray(Image.open(args.out / "avatar" / f"{i:03}.png")).astype(float)
        head = truth[..., 3] > 250
        best = None
        for sign in (1, -1):
            a = math.radians(sign * yaw)
            turn = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
            image, covered = rasterise((points * flip) @ turn.T + eye, colors, triangles, camera)
            both = head & covered
            error = ((image - truth[..., :3])[both] ** 2).mean()
            if best is None or error < best[0]:
                best = (error, image, covered)
            if yaw == 0:
                break
        error, image, covered = best
        print(f"{yaw:5.0f} {10 * math.log10(255 ** 2 / error):9.2f} {100 * (head & ~covered).sum() / head.sum():8.2f}")
        strips += [np.where(head[..., None], truth[..., :3], 0), np.where(covered[..., None], image, [0, 160, 0])]
    Image.fromarray(np.concatenate(strips, 1).astype(np.uint8)).save(args.out / "aside.png")


if __name__ == "__main__":
    main()
