#!/usr/bin/env python3
"""A corpus asked with polars: how AUs are spread over subjects, the worst takes, how the ICC of AU control drifts.

usage: with_polars.py CORPUS      prints JSON; with_duckdb.py and with_spark.py print the same
"""

import json
import sys

import polars as pl


def scan(corpus, table):
    """A table, lazily: only the columns and files that a question needs are read."""
    return pl.scan_parquet(f"{corpus}/tables/{table}/**/*.parquet", hive_partitioning=True, missing_columns="insert")


def aus(corpus):
    frames = scan(corpus, "aus")
    units = [name for name in frames.collect_schema().names() if name.endswith("_intensity")]
    long = frames.select("subject", *units).unpivot(index="subject", variable_name="au", value_name="value")
    value = pl.col("value").cast(pl.Float64)
    return (
        long.drop_nulls("value")
        .group_by("subject", pl.col("au").str.strip_suffix("_intensity"))
        .agg(frames=pl.len(), mean=value.mean(), raised=(value >= 1).mean())
        .sort("subject", "au")
    )


def worst(corpus, count=5):
    of_all = pl.col("view").is_null() & pl.col("part").is_null() & (pl.col("kind") == "all")
    psnr = scan(corpus, "metrics").filter(of_all & (pl.col("metric") == "psnr_db"))
    lost = scan(corpus, "datasets").select(
        "subject", "take", untrusted=(pl.col("frames").cast(pl.Float64) - pl.col("valid")) / pl.col("frames")
    )
    return (
        psnr.join(lost, on=["subject", "take"])
        .select("subject", "take", "untrusted", psnr_db="value")
        .sort("psnr_db", "subject", "take")
        .head(count)
    )


def drift(corpus):
    icc = scan(corpus, "metrics").filter((pl.col("metric") == "mean_icc_3_1") & (pl.col("kind") == "control"))
    order = scan(corpus, "datasets").select("subject", "take", "take_number")
    by_time = icc.join(order, on=["subject", "take"]).sort("subject", "take_number", "take")
    value = pl.col("value")
    return (
        by_time.group_by("subject", maintain_order=True)
        .agg(takes=pl.len(), mean=value.mean(), first=value.first(), drift=value.last() - value.first())
        .sort("subject")
    )


def answers(corpus):
    questions = {"aus": aus(corpus), "worst": worst(corpus), "drift": drift(corpus)}
    return {name: table.collect(engine="streaming").to_dicts() for name, table in questions.items()}


if __name__ == "__main__":
    print(json.dumps(answers(sys.argv[1]), indent=1))
