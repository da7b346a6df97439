#!/usr/bin/env python3
"""A corpus asked with DuckDB: how AUs are spread over subjects, the worst takes, how the ICC of AU control drifts.

usage: with_duckdb.py CORPUS      prints JSON; with_polars.py and with_spark.py print the same
"""

import json
import sys

import duckdb

AUS = """
    with long as (
        unpivot (select subject, columns('.*_intensity') from aus) on columns('.*_intensity') into name au value value
    )
    select subject, replace(au, '_intensity', '') as au, count(*) as frames,
           avg(value::double) as mean, avg((value >= 1)::int::double) as raised
    from long where value is not null group by all order by subject, au
"""
WORST = """
    select subject, take, (frames::double - valid) / frames as untrusted, value as psnr_db
    from metrics join datasets using (subject, take)
    where metric = 'psnr_db' and kind = 'all' and view is null and part is null
    order by psnr_db, subject, take limit 5
"""
DRIFT = """
    select subject, count(*) as takes, avg(value) as mean, first(value order by take_number, take) as first,
           last(value order by take_number, take) - first(value order by take_number, take) as drift
    from metrics join datasets using (subject, take)
    where metric = 'mean_icc_3_1' and kind = 'control'
    group by subject order by subject
"""


def answers(corpus):
    db = duckdb.connect()
    for table in ("aus", "metrics", "datasets"):
        db.execute(f"""
            create view {table} as select * from read_parquet('{corpus}/tables/{table}/**/*.parquet',
                hive_partitioning = true, union_by_name = true)
        """)
    rows = lambda sql: (lambda r: [dict(zip([c[0] for c in r.description], row)) for row in r.fetchall()])(db.execute(sql))  # noqa: E731
    return {"aus": rows(AUS), "worst": rows(WORST), "drift": rows(DRIFT)}


if __name__ == "__main__":
    print(json.dumps(answers(sys.argv[1]), indent=1))
