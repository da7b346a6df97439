#!/usr/bin/env python3
"""Asks a corpus with polars, DuckDB, Spark and `dataset stats`, and fails unless all answers are equal.

usage: compare.py CORPUS [--dataset PROGRAM] [--only polars,duckdb,spark]

Engines that this Python lacks are named and left out; exit status 1 if answers differ, 3 if fewer than two engines are
here. Numbers may differ by 1e-9 of their size: sums are added in another order.
"""

import argparse
import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

ENGINES = {"polars": "polars", "duckdb": "duckdb", "spark": "pyspark"}
HERE = Path(__file__).resolve().parent


def main():
    parser = argparse.ArgumentParser(description="Compares the engines' answers.")
    parser.add_argument("corpus")
    parser.add_argument("--dataset", default=str(HERE.parents[2] / "target/release/dataset"))
    parser.add_argument("--only", default="polars,duckdb,spark")
    args = parser.parse_args()
    found = {}
    for engine in args.only.split(","):
        if importlib.util.find_spec(ENGINES[engine]) is None:
            print(f"SKIPPED {engine}: `{ENGINES[engine]}` is not installed in {sys.executable}; see docs/corpora.md", file=sys.stderr)
            continue
        done = subprocess.run([sys.executable, HERE / f"with_{engine}.py", args.corpus], stdout=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(f"with_{engine}.py failed")
        found[engine] = json.loads(done.stdout)
    if Path(args.dataset).is_file():
        found["dataset stats"] = of_stats(args.dataset, args.corpus)
    if len(found) < 2:
        print("SKIPPED: fewer than two engines are here", file=sys.stderr)
        return 3
    (first, answer), *others = found.items()
    differences = [d for name, other in others for d in differ(f"{first} and {name}", answer, other)]
    for line in differences[:20]:
        print(line, file=sys.stderr)
    rows = {name: len(table) for name, table in answer.items()}
    verdict = "differ" if differences else "are equal"
    print(f"answers of {', '.join(found)} {verdict}: {rows['aus']} AU rows, {rows['worst']} worst takes, {rows['drift']} drifts")
    return 1 if differences else 0


def of_stats(program, corpus):
    """`dataset stats CORPUS --json` in the shape of the engines' answers."""
    done = subprocess.run([program, "stats", corpus, "--json", "-q"], stdout=subprocess.PIPE, check=True, text=True)
    stats = json.loads(done.stdout)
    aus = [
        {"subject": subject, "au": au, **{k: a[k] for k in ("frames", "mean", "raised")}}
        for subject, units in sorted(stats["aus"].items())
        for au, a in sorted(units.items())
    ]
    worst = [{k: w[k] for k in ("subject", "take", "untrusted", "psnr_db")} for w in stats["worst"]]
    drift = [{"subject": s, **{k: a[k] for k in ("takes", "mean", "first", "drift")}} for s, a in sorted(stats["icc"].items())]
    return {"aus": aus, "worst": worst, "drift": drift}


def differ(who, a, b, at=""):
    if isinstance(a, dict) and isinstance(b, dict):
        if a.keys() != b.keys():
            return [f"{who}: {at}: {sorted(a)} and {sorted(b)}"]
        return [d for k in a for d in differ(who, a[k], b[k], f"{at}.{k}")]
    if isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            return [f"{who}: {at}: {len(a)} and {len(b)} rows"]
        return [d for i, (x, y) in enumerate(zip(a, b)) for d in differ(who, x, y, f"{at}[{i}]")]
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return [] if math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12) else [f"{who}: {at}: {a} and {b}"]
    return [] if a == b else [f"{who}: {at}: {a!r} and {b!r}"]


if __name__ == "__main__":
    sys.exit(main())
