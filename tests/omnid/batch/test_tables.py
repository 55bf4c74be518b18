"""The results of a batch as CSV, Parquet and a page that links to each."""

from __future__ import annotations

import csv
from pathlib import Path

from omnid.batch.job_runner import FAILED, OK, JobResult
from omnid.batch.tables import write_tables


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def test_tables_hold_names_that_are_no_formulas_and_no_html(tmp_path: Path) -> None:
    write_tables(
        [JobResult("=1+1", "/logs/<b>.mcap", FAILED, "<script>alert(1)</script>"), JobResult("a", "/a", OK)], tmp_path
    )
    assert "'=1+1" in rows(tmp_path)
    text = (tmp_path / "index.html").read_text()
    assert "<script>" not in text and "&lt;script&gt;" in text
