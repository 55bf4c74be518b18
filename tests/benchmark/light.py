"""A table of errors in bad light: `python -m tests.benchmark.light DIM:BRIGHT ...`, folders of two logs of one drive.

Render them by `python -m tests.simulation NAME --seed N --out BRIGHT` and the same with `--dim` and another folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import numpy as np

import omnid
from calib import se3
from omnid.diagnostics.run_summary import summary_entries
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.runs.run_result import RunResult
from tests.benchmark.accuracy import rig_of
from tests.benchmark.results import Cell, Column, ResultTable

COLUMNS: Final = (
    Column("log"),
    Column("length", "%", 3),
    Column("ATE rmse", "mm", 2),
    Column("ATE in good light", "mm", 2),
    Column("ratio", "", 1),
    Column("error over sigma, rms", "", 2),
    Column("states"),
)


def row(dim: Path, bright: Path) -> list[Cell]:
    """Return one row of the table: a drive in bad light, and the same in good light."""
    result, found = replayed(dim)
    reference = replayed(bright)[1]
    return [
        dim.name,
        100 * found.length_error_ratio,
        1e3 * found.ate_rmse_m,
        1e3 * reference.ate_rmse_m,
        found.ate_rmse_m / reference.ate_rmse_m,
        error_over_sigma(result, read_tum(dim / "truth.txt")),
        summary_entries(result.counters)["states"],
    ]


def replayed(folder: Path) -> tuple[RunResult, Metrics]:
    """Return the result of a log and its errors."""
    result = omnid.replay(folder / "log.mcap", rig_of(folder))
    return result, evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))


def error_over_sigma(result: RunResult, truth: Trajectory) -> float:
    """Return the rms of the errors of x, y and z by their standard deviations, of all poses but the first."""
    _, ours, theirs = np.intersect1d(result.stamps_ns, truth.stamps_ns, return_indices=True)
    T_odom_rig = se3.inverse(truth.T[theirs[0]]) @ truth.T[theirs]
    in_odom = result.T_odom_rig[ours, :3, 3] - T_odom_rig[:, :3, 3]
    error = np.einsum("nji,nj->ni", result.T_odom_rig[ours, :3, :3], in_odom)  # in the axes of the rig
    variance = np.diagonal(result.covariances[ours], axis1=1, axis2=2)[:, :3]
    return float(np.sqrt((error[1:] ** 2 / variance[1:]).mean()))


def main() -> None:
    """Print the table, each row as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", metavar="DIM:BRIGHT")
    logs = parser.parse_args().logs
    table = ResultTable("light", "light and skew", "Bad light", COLUMNS)
    for pair in logs:
        dim, bright = (Path(name) for name in pair.split(":"))
        table.add(*row(dim, bright), folder=dim)


if __name__ == "__main__":
    main()
