"""Disturbances of real lenses, lamps and cameras: `python -m tests.benchmark.disturbances [--only NAME ...] [--seeds]`.

Each row is one drive in rooms, rendered with one disturbance of tests/simulation/disturbances.py, with none ("clean"),
or with all together ("all"); the same rig, path and walls. The error over sigma is that of the position,
sqrt(e^T C^-1 e / 3).
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

import omnid
from calib import se3
from omnid.core.rig.rig_health import RigContradictedError
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.benchmark.results import Column, ResultTable
from tests.simulation import build, write_log
from tests.simulation.disturbances import DISTURBANCES, Disturbance

SIZE, PAIRS = 384, 40
ALONE_SEEDS: Final = 2  # of those given, for each disturbance by itself
CASES: Final[dict[str, tuple[Disturbance, ...]]] = {
    "clean": (),
    "all": DISTURBANCES,
    **{name: (name,) for name in DISTURBANCES},
}
REMARKS: Final = (
    f"`rooms`, {PAIRS} pairs of {SIZE} px. Wanted of all together: within a factor of 3 of the clean log, length "
    "within 0.2 %, error over sigma below 2.",
    "Gloss: a floor that reflects a quarter of the light like a mirror. Windows: a third of the pictures, saturated, "
    "in the floor too. Not rendered: glass in front of pictures, cast shadows, broken restart markers of MJPG.",
)


def measure(name: str, seed: int, table: ResultTable) -> None:
    """Render a drive, replay it, and add its row."""
    run = build("rooms", seed, SIZE, PAIRS)
    with TemporaryDirectory() as work:
        folder = Path(work)
        write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=seed, disturbances=CASES[name])
        truth, refused = read_tum(folder / "truth.txt"), False
        try:
            result = omnid.replay(folder / "log.mcap", folder / "rig.toml")
        except RigContradictedError:
            refused = True
            result = omnid.replay(folder / "log.mcap", folder / "rig.toml", overrides=["rig.check=off"])
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), truth)
    T = truth.T[np.searchsorted(truth.stamps_ns, result.stamps_ns)]
    wrong = se3.log(se3.inverse(se3.inverse(T[0]) @ T) @ se3.inverse(result.T_odom_rig[0]) @ result.T_odom_rig)[1:, :3]
    squared = np.einsum("ni,nij,nj->n", wrong, np.linalg.inv(result.covariances[1:, :3, :3]), wrong) / 3
    table.add(
        f"{name}, seed {seed}",
        100 * found.length_error_ratio,
        1e3 * found.ate_rmse_m,
        1e3 * float(np.linalg.norm(wrong[-1])),
        math.sqrt(float(np.median(squared))),
        math.sqrt(float(squared.max())),
        ", ".join(f"{state} {count}" for state, count in Counter(map(str, result.states)).items()),
        refused,
        seed=("disturbances", seed),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, *range(603, 608)])
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    args = parser.parse_args(arguments)
    columns = (
        Column("disturbance"),
        Column("length", "%", 2),
        Column("ATE rmse", "mm", 1),
        Column("error at the end", "mm", 1),
        Column("error over sigma, median", "", 1),
        Column("largest", "", 1),
        Column("states"),
        Column("rig refused"),
    )
    table = ResultTable("disturbances", "accuracy", "Disturbances of real images", columns, REMARKS)
    for name in args.only:
        for seed in args.seeds if name in ("clean", "all") else args.seeds[:ALONE_SEEDS]:
            measure(name, seed, table)


if __name__ == "__main__":
    main()
