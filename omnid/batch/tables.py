"""The results of a batch as CSV, Parquet and a page that links to each."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Sequence
from html import escape
from io import StringIO
from pathlib import Path
from typing import Final
from urllib.parse import quote

from omnid.batch.job_runner import OK, JobResult, row_values
from omnid.formats.whole_file import write_whole
from omnid.plain_text import plain
from omnid.report.page import page, table

CSV_FILE: Final = "results.csv"
PARQUET_FILE: Final = "results.parquet"
INDEX_FILE: Final = "index.html"
COLUMNS: Final = tuple(name for name in JobResult.__slots__ if name != "key")
_STYLE: Final = "body{max-width:none}.bad{color:#a40}"
_HEAD: Final = (
    "log",
    "",
    "status",
    "pairs",
    "length",
    "tracking",
    "degraded",
    "lost",
    "resets",
    "ATE",
    "length error",
    "time",
)
_FILES: Final = (  # of a log that are linked, with the words of the link
    ("report.html", "report"),
    ("plan.png", "plan"),
    ("est.txt", "path"),
    ("map_est.txt", "path in the map"),
    ("cloud.ply", "cloud"),
    ("messages.txt", "messages"),
)
_FORMULA: Final = ("=", "+", "-", "@")  # first characters that spreadsheets execute
MOST_CHARACTERS: Final = 5000  # Most characters of a cell, which may contain the path of a log.


def write_tables(results: Sequence[JobResult], out: Path) -> list[Path]:
    """Write the tables into a folder, Parquet only where pyarrow is installed; return their paths."""
    ordered = sorted(results, key=lambda result: result.name)
    written = [out / CSV_FILE, out / INDEX_FILE]
    write_whole(written[0], _csv(ordered).encode())
    write_whole(written[1], page("omnid batch", _index(ordered, out), _STYLE).encode())
    try:
        import pyarrow as arrow
        import pyarrow.parquet as parquet
    except ImportError:
        return written
    rows = [_cells(result) for result in ordered]
    parquet.write_table(arrow.Table.from_pylist(rows), out / PARQUET_FILE)
    return [*written, out / PARQUET_FILE]


def _csv(results: Sequence[JobResult]) -> str:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for result in results:
        writer.writerow(["" if cell is None else _no_formula(cell) for cell in _cells(result).values()])
    return text.getvalue()


def _cells(result: JobResult) -> dict[str, object]:
    """Return the cells of a row by their columns: names of logs may come from anywhere, and be no text."""
    values = row_values(result)
    return {
        name: plain(value, MOST_CHARACTERS) if isinstance(value := values[name], str) else value for name in COLUMNS
    }


def _no_formula(cell: object) -> object:
    """Return a cell that a spreadsheet does not execute."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(_FORMULA) else cell


def _index(results: Sequence[JobResult], out: Path) -> list[str]:
    counts = Counter(result.status for result in results)
    total_s = sum(result.seconds for result in results)
    summary = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    head = f"<h1>omnid batch</h1><p>{len(results)} logs: {escape(summary or 'none')}; {total_s:.0f} s of work.</p>"
    return [head, table(_HEAD, [_row(result, out) for result in results])]


def _row(result: JobResult, out: Path) -> tuple[str, ...]:
    folder = quote(result.name)
    links = " ".join(
        f"<a href='{folder}/{file}'>{label}</a>" for file, label in _FILES if (out / result.name / file).is_file()
    )
    outcome = escape(plain(f"{result.status}: {result.error}" if result.error else result.status))
    status = outcome if result.status == OK else f"<span class='bad'>{outcome}</span>"
    return (
        escape(result.name),
        links,
        status,
        str(result.pairs),
        _metres(result.length_m),
        str(result.tracking),
        str(result.degraded),
        str(result.lost),
        str(result.resets),
        _metres(result.ate_rmse_m, 4),
        "" if math.isnan(result.length_error_ratio) else f"{result.length_error_ratio:+.3%}",
        f"{result.seconds:.1f} s",
    )


def _metres(value: float, digits: int = 2) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f} m"
