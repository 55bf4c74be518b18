"""A table of errors against the truth: `python -m tests.bench.accuracy FOLDER ... [--set SECTION.KEY=VALUE ...]`.

Each folder holds log.mcap, truth.txt and a rig.toml or camchain.yaml, as `python -m tests.simulation` writes them.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import omnid
from calib.kalibr import import_kalibr
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid.diagnostics.run_summary import summary_entries
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.bench.results import Cell, Column, ResultTable

COLUMNS: Final = (
    Column("log"),
    Column("pairs"),
    Column("length", "%", 3),
    Column("ATE rmse", "mm", 2),
    Column("end", "mm", 2),
    Column("heading, max", "deg", 3),
    Column("RPE", "mm", 2),
    Column("states"),
)


def row(folder: Path, overrides: Sequence[str]) -> list[Cell]:
    """Return one row of the table: the errors of one log, and the shares of its states."""
    result = omnid.replay(folder / "log.mcap", rig_of(folder), overrides=overrides)
    m = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))
    return [
        folder.name,
        m.pairs,
        100 * m.length_error_ratio,
        1e3 * m.ate_rmse_m,
        1e3 * m.end_error_m,
        math.degrees(m.heading_max_rad),
        1e3 * m.rpe_translation_rmse_m,
        summary_entries(result.counters)["states"],
    ]


def rig_of(folder: Path) -> Rig:
    """Return the rig of a log; Kalibr's by way of a rig.toml, whose rounding moves the last digits of the errors."""
    camchain = folder / "camchain.yaml"
    if not camchain.exists():
        return read_rig(folder / "rig.toml")
    with TemporaryDirectory() as work:
        path = Path(work) / "rig.toml"
        write_rig(path, import_kalibr(camchain))
        return read_rig(path)


def main() -> None:
    """Print the table, each row as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", dest="overrides")
    args = parser.parse_args()
    title = f"Rendered logs, {' '.join(args.overrides) or 'default settings'}"
    table = ResultTable("accuracy", title, COLUMNS)
    for folder in args.folders:
        table.add(*row(folder, args.overrides), folder=folder)


if __name__ == "__main__":
    main()
