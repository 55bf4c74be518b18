"""A table of errors in bad light: `python -m tests.benchmark.light DIM:BRIGHT ...`, folders of two logs of one drive.

Render them by `python -m tests.simulation NAME --seed N --out BRIGHT` and the same with `--dim` and another folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import omnid
from calib import se3
from omnid.diagnostics.run_summary import summary_entries
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.runs.run_result import RunResult
from tests.benchmark.accuracy import rig_of

HEAD = ("| log | length | ATE rmse | in good light | ratio | error over sigma, rms | states |\n"
        "|---|---|---|---|---|---|---|")


def row(dim: Path, bright: Path) -> str:
    """Return one row of the table: a drive in bad light, and the same in good light."""
    result, found = replayed(dim)
    reference = replayed(bright)[1]
    cells = [dim.name, f"{100 * found.length_error_ratio:+.3f} %", f"{1e3 * found.ate_rmse_m:.2f} mm",
             f"{1e3 * reference.ate_rmse_m:.2f} mm", f"{found.ate_rmse_m / reference.ate_rmse_m:.1f}",
             f"{error_over_sigma(result, read_tum(dim / 'truth.txt')):.2f}", summary_entries(result.counters)["states"]]
    return f"| {' | '.join(cells)} |"


def replayed(folder: Path) -> tuple[RunResult, Metrics]:
    """Return the result of a log and its errors."""
    result = omnid.replay(folder / "log.mcap", rig_of(folder))
    return result, evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))


def error_over_sigma(result: RunResult, truth: Trajectory) -> float:
    """Return the rms of the errors of x, y and z by their standard deviations, of all poses but the first."""
    _, ours, theirs = np.intersect1d(result.stamps_ns, truth.stamps_ns, return_indices=True)
    T_odom_rig = se3.inverse(truth.T[theirs[0]]) @ truth.T[theirs]
    error = result.T_odom_rig[ours, :3, 3] - T_odom_rig[:, :3, 3]
    variance = np.diagonal(result.covariances[ours], axis1=1, axis2=2)[:, :3]
    return float(np.sqrt((error[1:] ** 2 / variance[1:]).mean()))


def main() -> None:
    """Print the table, each row as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", metavar="DIM:BRIGHT")
    print(HEAD)
    for pair in parser.parse_args().logs:
        dim, bright = (Path(name) for name in pair.split(":"))
        print(row(dim, bright), flush=True)


if __name__ == "__main__":
    main()
