"""A table of errors against the truth: `python -m tests.bench.accuracy FOLDER ... [--set SECTION.KEY=VALUE ...]`.

Each folder holds log.mcap, truth.txt and a rig.toml or camchain.yaml, as `python -m tests.simulation` writes them. With
--cloud the points of `omnid replay --cloud` are compared with the surfaces of the world, too: a folder is then named
RECIPE_sSEED. A cell of 10 cm is seen if a point within 10 cm of a surface lies in it. The rig is exact, but for
--truth-mm: the log is real, and its truth of a body with other axes, whose positions err by this standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from numpy.typing import NDArray

import omnid
from calib import se3
from calib.importers import parse_chain
from calib.rig import Rig, RigCovariance
from calib.rig_file import read_rig, write_rig
from omnid.diagnostics.status import summary_entries
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import body_rotation, evaluate
from tests.bench.paper.measures import surface_distance_m
from tests.bench.results import Cell, ResultTable, columns, family_and_seed, run
from tests.simulation.recipes import build

CELL_M: Final = 0.1  # of the cells that count as seen, and largest distance of their points from a surface
EXACT: Final = RigCovariance(("baseline",), np.zeros(1), np.eye(1))  # nothing is added for the rig
FAR_M: Final = 0.2  # a point farther from all surfaces is wrong
OF_POSES = (
    "log",
    "pairs",
    "length|%|3",
    "ATE rmse|mm|2",
    "end|mm|2",
    "heading, max|deg|3",
    "RPE|mm|2",
    "NEES, median||1",
)
OF_CLOUD = ("points of the cloud", "their error p50|cm|2", "p90|cm|2", f"beyond {FAR_M} m|%|2", "cells seen")


def row(folder: Path, overrides: Sequence[str], *, cloud: bool, truth_mm: float) -> list[Cell]:
    """Return one row of the table: the errors of one log, the shares of its states, and the errors of its cloud."""
    rig = rig_of(folder) if truth_mm else replace(rig_of(folder), covariance=EXACT)
    result = omnid.replay(folder / "log.mcap", rig, overrides=overrides)
    truth, estimate = read_tum(folder / "truth.txt"), Trajectory(result.stamps_ns, result.T_odom_rig)
    if truth_mm:
        truth = Trajectory(truth.stamps_ns, truth.T @ se3.inverse(body_rotation(estimate, truth)))
    m = evaluate(estimate, truth)
    return [
        folder.name,
        m.pairs,
        100 * m.length_error_ratio,
        1e3 * m.ate_rmse_m,
        1e3 * m.end_error_m,
        math.degrees(m.heading_max_rad),
        1e3 * m.rpe_translation_rmse_m,
        float(np.median(squared_errors(result, truth, 1e-3 * truth_mm))),
        summary_entries(result.counters)["states"],
        *(cloud_cells(folder, result, truth) if cloud else ()),
    ]


def cloud_cells(folder: Path, result: omnid.RunResult, truth: Trajectory) -> list[Cell]:
    """Return the number of points of the cloud, their distances from the surfaces of the world, and the cells seen."""
    world = family_and_seed(folder.name)
    if world is None:
        raise SystemExit(f"{folder}: expected a folder RECIPE_sSEED, whose world is known")
    assert result.map is not None
    points = se3.apply(truth.T[0], result.map.xyz)
    error = surface_distance_m(build(*world, pairs=len(truth.T)).scene, points)
    cells = np.unique(np.floor(points[error < CELL_M] / CELL_M), axis=0)
    p50, p90 = (100 * float(np.percentile(error, percent)) for percent in (50, 90))
    return [len(points), p50, p90, 100 * float((error > FAR_M).mean()), len(cells)]


def position_errors(result: omnid.RunResult, truth: Trajectory) -> NDArray[np.float64]:
    """Return the errors (N - 1, 3) [m] of the positions after the first pose, in the axes of the nearest true pose."""
    nearest = np.abs(truth.stamps_ns[None] - np.asarray(result.stamps_ns)[:, None]).argmin(axis=1)
    T, found = truth.T[nearest], result.T_odom_rig
    return se3.log(se3.inverse(se3.inverse(T[0]) @ T) @ se3.inverse(found[0]) @ found)[1:, :3]


def squared_errors(result: omnid.RunResult, truth: Trajectory, truth_m: float = 0.0) -> NDArray[np.float64]:
    """Return e^T C^-1 e (N - 1,) of the positions e after the first pose, of which 3 is expected.

    truth_m: standard deviation of each true position.
    """
    wrong, C = position_errors(result, truth), result.covariances[1:, :3, :3] + 2 * truth_m**2 * np.eye(3)
    return np.asarray(np.einsum("ni,nij,nj->n", wrong, np.linalg.inv(C), wrong))


def rig_of(folder: Path) -> Rig:
    """Return the rig of a log; Kalibr's by way of a rig.toml, whose rounding moves the last digits of the errors."""
    camchain = folder / "camchain.yaml"
    if not camchain.exists():
        return read_rig(folder / "rig.toml")
    with TemporaryDirectory() as work:
        path = Path(work) / "rig.toml"
        write_rig(path, parse_chain(Path(camchain).read_text()))
        return read_rig(path)


def accuracy(folders: Sequence[Path], *, set_: Sequence[str] = (), cloud: bool = False, truth_mm: float = 0.0) -> None:
    """Print the table, each row as soon as it is measured."""
    title = f"Logs, {' '.join(set_) or 'default settings'}"
    table = ResultTable("accuracy", title, columns(*OF_POSES, "states", *OF_CLOUD * cloud))
    for folder in folders:
        table.add(*row(folder, set_, cloud=cloud, truth_mm=truth_mm), folder=folder)


if __name__ == "__main__":
    run(accuracy)
