#!/usr/bin/env python3
"""A corpus asked with Spark: how AUs are spread over subjects, the worst takes, how the ICC of AU control drifts.

usage: with_spark.py CORPUS      prints JSON; with_polars.py and with_duckdb.py print the same. Needs Java 17.
"""

import json
import sys

from pyspark.sql import SparkSession
from pyspark.sql import functions as f
from pyspark.sql.window import Window


def answers(corpus, session):
    read = lambda table: session.read.option("mergeSchema", "true").parquet(f"{corpus}/tables/{table}")  # noqa: E731
    frames, metrics, datasets = read("aus"), read("metrics"), read("datasets")

    units = [name for name in frames.columns if name.endswith("_intensity")]
    value = f.col("value").cast("double")
    aus = (
        frames.unpivot("subject", units, "au", "value")
        .where("value is not null")
        .groupBy("subject", f.regexp_replace("au", "_intensity$", "").alias("au"))
        .agg(f.count("*").alias("frames"), f.avg(value).alias("mean"), f.avg((value >= 1).cast("double")).alias("raised"))
        .orderBy("subject", "au")
    )
    worst = (
        metrics.where("metric = 'psnr_db' and kind = 'all' and view is null and part is null")
        .join(datasets, ["subject", "take"])
        .selectExpr("subject", "take", "(frames - valid) / frames as untrusted", "value as psnr_db")
        .orderBy("psnr_db", "subject", "take")
        .limit(5)
    )
    by_time = Window.partitionBy("subject").orderBy("take_number", "take")
    whole = by_time.rowsBetween(Window.unboundedPreceding, Window.unboundedFollowing)
    drift = (
        metrics.where("metric = 'mean_icc_3_1' and kind = 'control'")
        .join(datasets, ["subject", "take"])
        .select("subject", "value", f.first("value").over(whole).alias("first"), f.last("value").over(whole).alias("last"))
        .groupBy("subject", "first", "last")
        .agg(f.count("*").alias("takes"), f.avg("value").alias("mean"))
        .selectExpr("subject", "takes", "mean", "first", "last - first as drift")
        .orderBy("subject")
    )
    tables = {"aus": aus, "worst": worst, "drift": drift}
    return {name: [row.asDict() for row in table.collect()] for name, table in tables.items()}


def main():
    session = (
        SparkSession.builder.master("local[2]")
        .appName("corpus")
        .config("spark.ui.enabled", "false")
        .config("spark.driver.bindAddress", "127.0.0.1")
        .config("spark.driver.host", "127.0.0.1")
        .config("spark.sql.shuffle.partitions", "4")
        .getOrCreate()
    )
    session.sparkContext.setLogLevel("ERROR")
    try:
        print(json.dumps(answers(sys.argv[1], session), indent=1))
    finally:
        session.stop()


if __name__ == "__main__":
    main()
