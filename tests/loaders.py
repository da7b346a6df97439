#!/usr/bin/env python3
"""Opens a dataset and its exports with other people's readers, and compares what they see with our own files.

    tests/loaders.py DATASET EXPORTS

DATASET is a folder of `dataset build`; EXPORTS is an empty folder to export into, or one that was filled by an earlier
run; the command `dataset` is taken from PATH or from the variable DATASET_BIN. A reader that is not installed is skipped
with a word; any disagreement ends with status 1. Readers: polars, pandas, DuckDB, pyarrow, pycolmap, Pillow, and the
dataparser of nerfstudio:

    python3 -m venv venv && venv/bin/pip install polars pandas pyarrow duckdb pycolmap pillow numpy nerfstudio
"""

import glob
import importlib
import json
import os
import subprocess
import sys

failures, skipped, passed = [], [], []


def check(name, condition, message=""):
    (passed if condition else failures).append(name if condition else f"{name}: {message}")


def reader(name):
    try:
        return importlib.import_module(name)
    except ImportError as error:
        skipped.append(name)
        print(f"SKIPPED: {name} is not installed ({error}); what it would see is not checked")
        return None


def rotation(q):
    w, x, y, z = q
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def close(a, b, tolerance):
    return all(abs(x - y) <= tolerance for r, s in zip(a, b) for x, y in zip(r, s))


def camera_of(dataset, frame_id):
    with open(os.path.join(dataset, "camera", f"{frame_id}.json")) as file:
        return json.load(file)


def take_names(dataset):
    """The names of the takes, which are texts even where they look like numbers."""
    import tomllib

    with open(os.path.join(dataset, "takes.toml"), "rb") as file:
        return {take["name"] for take in tomllib.load(file)["take"]}


def tables(dataset, ids):
    """The partitioned tables, as one collection."""
    pattern = os.path.join(dataset, "tables", "aus", "**", "*.parquet")
    files = glob.glob(pattern, recursive=True)
    check("tables: there are files", len(files) > 0, pattern)
    if polars := reader("polars"):
        frame = polars.read_parquet(pattern, hive_partitioning=True)
        chosen = frame.filter(polars.col("id").is_not_null())
        check("polars: chosen ids", sorted(chosen["id"].to_list()) == sorted(ids), f"{chosen.height} rows")
        check("polars: `take` is a column of texts", frame.schema.get("take") == polars.String, str(frame.columns[:4]))
        names = take_names(dataset)
        check("polars: names of takes", set(frame["take"].unique()) == names, str(names))
        attributes = [c for c in frame.columns if c.endswith("_attribute")]
        low = min(chosen[c].min() for c in attributes)
        high = max(chosen[c].max() for c in attributes)
        check("polars: attributes are -1..1", -1.0 <= low and high <= 1.0, f"{low} to {high}")
    if duckdb := reader("duckdb"):
        connection = duckdb.connect()
        count, takes = connection.execute(
            f"select count(id), count(distinct take) from read_parquet('{pattern}', hive_partitioning = true)"
        ).fetchone()
        check("DuckDB: chosen ids and takes", count == len(ids) and takes == len(files), f"{count}, {takes}")
        found = connection.execute(
            f"select distinct take from read_parquet('{pattern}', hive_partitioning = true)"
        ).fetchall()
        check("DuckDB: names of takes", {row[0] for row in found} == take_names(dataset), str(found))
        poses = os.path.join(dataset, "tables", "poses", "**", "*.parquet")
        joined = connection.execute(
            f"select count(*) from read_parquet('{pattern}', hive_partitioning = true) a"
            f" join read_parquet('{poses}', hive_partitioning = true) p using (take, frame) where a.id is not null"
        ).fetchone()[0]
        check("DuckDB: every chosen row has a pose", joined == len(ids), str(joined))
    if (pandas := reader("pandas")) and reader("pyarrow"):
        frame = pandas.read_parquet(os.path.join(dataset, "tables", "frames"))
        check("pandas: chosen ids", frame["id"].notna().sum() == len(ids), str(len(frame)))
        check("pandas: names of takes", set(frame["take"]) == take_names(dataset), str(frame["take"].dtype))
        check("pandas: splits", set(frame["split"].dropna()) <= {"train", "val", "none"})


def parquet(dataset, folder, ids):
    if polars := reader("polars"):
        frame = polars.read_parquet(os.path.join(folder, "frames.parquet"))
        check("parquet export: ids", frame["id"].to_list() == ids)
        row = frame.row(len(ids) // 2, named=True)
        camera = camera_of(dataset, row["id"])
        q = [row[f"camera_from_world_q{k}"] for k in "wxyz"]
        check("parquet export: rotation", close(rotation(q), camera["orientation"], 1e-6))
        center = [[row[f"center_in_world_{k}"] for k in "xyz"]]
        check("parquet export: position", close(center, [camera["position"]], 1e-5))
        check("parquet export: picture", os.path.isfile(os.path.join(folder, row["image"])))


def colmap(dataset, folder, ids):
    pycolmap = reader("pycolmap")
    if not pycolmap:
        return
    model = pycolmap.Reconstruction(os.path.join(folder, "sparse", "0"))
    images = {os.path.splitext(image.name)[0]: image for image in model.images.values()}
    check("pycolmap: images", sorted(images) == sorted(ids), f"{len(images)} of {len(ids)}")
    for frame_id in (ids[0], ids[-1]):
        camera, image = camera_of(dataset, frame_id), images[frame_id]
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        check("pycolmap: rotation", close(pose.rotation.matrix().tolist(), camera["orientation"], 1e-6))
        check("pycolmap: position", close([image.projection_center().tolist()], [camera["position"]], 1e-5))
        lens = model.cameras[image.camera_id]
        scale = camera["image_size"][0] / lens.width
        check("pycolmap: focal length", abs(lens.focal_length_x * scale - camera["focal_length"]) < 1e-3)
        # A point before the camera lands where our own formula puts it (no distortion at the optical axis).
        axis = camera["orientation"][2]
        point = [c + 2.0 * a for c, a in zip(camera["position"], axis)]
        pixel = lens.img_from_cam(pose * point)
        expected = [camera["principal_point"][0] / scale, camera["principal_point"][1] / scale]
        check("pycolmap: projection", close([list(pixel)], [expected], 1e-3), f"{pixel} {expected}")


def transforms(dataset, folder, ids):
    with open(os.path.join(folder, "transforms.json")) as file:
        document = json.load(file)
    check("transforms.json: frames", [os.path.basename(f["file_path"])[:-4] for f in document["frames"]] == ids)
    check("transforms.json: relative paths", not any(os.path.isabs(f["file_path"]) for f in document["frames"]))
    for frame in document["frames"][:: max(1, len(ids) // 5)]:
        camera = camera_of(dataset, os.path.basename(frame["file_path"])[:-4])
        matrix = frame["transform_matrix"]
        # nerfstudio: columns are the camera's right, up and back in the world, then its place.
        columns = [[matrix[i][j] for i in range(3)] for j in range(4)]
        right, down, forward = camera["orientation"]
        expected = [right, [-v for v in down], [-v for v in forward], camera["position"]]
        check("transforms.json: axes", close(columns, expected, 1e-5))
    if pillow := reader("PIL.Image"):
        frame = document["frames"][0]
        size = pillow.open(os.path.join(folder, frame["file_path"])).size
        check("transforms.json: picture size", size == (frame["w"], frame["h"]), str(size))
    if parser := reader("nerfstudio.data.dataparsers.nerfstudio_dataparser"):
        from pathlib import Path

        config = parser.NerfstudioDataParserConfig(data=Path(folder), downscale_factor=1)
        outputs = config.setup().get_dataparser_outputs("train")
        check("nerfstudio: pictures for fitting", len(outputs.image_filenames) == len(document["train_filenames"]))


def main():
    dataset, exports = sys.argv[1:3]
    with open(os.path.join(dataset, "dataset.json")) as file:
        ids = json.load(file)["ids"]
    program = os.environ.get("DATASET_BIN", "dataset")
    for layout, look in (("parquet", parquet), ("colmap", colmap), ("transforms", transforms)):
        folder = os.path.join(exports, layout)
        subprocess.run([program, "export", dataset, "--to", layout, "--out", folder, "-q"], check=True)
        look(dataset, folder, ids)
    tables(dataset, ids)
    print(f"{len(passed)} checks passed, {len(failures)} failed, {len(set(skipped))} readers not installed")
    for failure in failures:
        print(f"FAILED: {failure}")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main()
