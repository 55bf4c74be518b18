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

import numpy as np
from numpy.typing import NDArray

import omnid
from calib import se3
from calib.kalibr import import_chain
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
    Column("NEES, median", "", 1),
    Column("states"),
)


def row(folder: Path, overrides: Sequence[str]) -> list[Cell]:
    """Return one row of the table: the errors of one log, and the shares of its states."""
    result = omnid.replay(folder / "log.mcap", rig_of(folder), overrides=overrides)
    truth = read_tum(folder / "truth.txt")
    m = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), truth)
    return [
        folder.name,
        m.pairs,
        100 * m.length_error_ratio,
        1e3 * m.ate_rmse_m,
        1e3 * m.end_error_m,
        math.degrees(m.heading_max_rad),
        1e3 * m.rpe_translation_rmse_m,
        float(np.median(squared_errors(result, truth))),
        summary_entries(result.counters)["states"],
    ]


def squared_errors(result: omnid.RunResult, truth: Trajectory) -> NDArray[np.float64]:
    """Return e^T C^-1 e (N - 1,) of the positions e after the first pose, of which 3 is expected.

    The truth of a pose is the one that is nearest in time. A rig without a stated covariance may be wrong by the prior
    that the odometry adds: for a rendered one, which is exact, the figure is then much smaller than 3.
    """
    nearest = np.abs(truth.stamps_ns[None] - np.asarray(result.stamps_ns)[:, None]).argmin(axis=1)
    T, found = truth.T[nearest], result.T_odom_rig
    wrong = se3.log(se3.inverse(se3.inverse(T[0]) @ T) @ se3.inverse(found[0]) @ found)[1:, :3]
    return np.asarray(np.einsum("ni,nij,nj->n", wrong, np.linalg.inv(result.covariances[1:, :3, :3]), wrong))


def rig_of(folder: Path) -> Rig:
    """Return the rig of a log; Kalibr's by way of a rig.toml, whose rounding moves the last digits of the errors."""
    camchain = folder / "camchain.yaml"
    if not camchain.exists():
        return read_rig(folder / "rig.toml")
    with TemporaryDirectory() as work:
        path = Path(work) / "rig.toml"
        write_rig(path, import_chain(camchain))
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
