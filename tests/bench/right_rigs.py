"""Right rigs by their check: `python -m tests.bench.right_rigs [--seeds N ...] [--only RIG ...]`.

Every log is a drive of 5 m in a corridor, 12 pairs, with the rig that took it. What `calibrate drive --only check` says
of it is compared with the truth: the upper camera is turned by nothing, and the rig fits. The error over sigma is that
of the turn, sqrt(w^T C^-1 w / 3) with its covariance C, of which 1 is expected.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from calib.rig import Rig
from drivers.logs.log_reader import LogReader
from omnid.calibration.rig_check import check_rig, read_rig_pairs
from omnid.config import PanoramaConfig
from omnid.core.rig.column_finding import RigFinding, RigState
from tests.bench.results import Column, ResultTable
from tests.bench.seeds import role_of
from tests.simulation import corridor, paths, write_log
from tests.simulation.recipes import mild_rig
from tests.simulation.rigs import lens, lens_rig

FAMILY: Final = "right rigs"
PAIRS, STEP_M, BEYOND_M = 12, 0.4, 8.0
FIRST_PAIRS: Final = 8  # those that the check at the start of a run uses at most
RIGS: Final[dict[str, Callable[[int], Rig]]] = {
    "pinhole_30": lambda _: lens_rig(lens("pinhole", 30)),
    "pinhole_90": lambda _: lens_rig(lens("pinhole", 90)),
    "equidistant_180": lambda _: lens_rig(lens("equidistant", 180)),
    "mirrors_384": lambda seed: mild_rig(seed, 384),
}
REMARKS: Final = (
    "Lenses of 640x480 px that see a sector, and pairs of mirrors in images of 384 px, another for each seed. Called "
    "wrong: logs whose rig does not fit by all pairs or by the first 8 alone.",
)


def checked(name: str, seed: int) -> tuple[RigFinding, RigFinding]:
    """Render a drive; return the finding by all its pairs, and that by the first ones."""
    rig = RIGS[name](seed)
    with TemporaryDirectory() as work:
        folder = Path(work)
        scene = corridor(seed, STEP_M * PAIRS + BEYOND_M)
        write_log(folder, rig, paths.spline_path(seed, PAIRS, STEP_M), scene, seed=seed)
        with closing(LogReader(folder / "log.mcap")) as reader:
            pairs = read_rig_pairs(reader, rig)
    config = PanoramaConfig()
    return check_rig(pairs, rig, config).finding, check_rig(pairs[:FIRST_PAIRS], rig, config).finding


def measure(name: str, role: str, seeds: Sequence[int], table: ResultTable) -> None:
    """Add the row of a rig over the seeds of one role."""
    angles_deg, errors, sigmas_deg, wrong = list[float](), list[float](), list[float](), 0
    for seed in seeds:
        whole, first = checked(name, seed)
        table.seeds.append((FAMILY, seed))
        wrong += any(finding.state not in (RigState.FITS, RigState.UNCHECKED) for finding in (whole, first))
        if whole.drift is not None:
            drift = whole.drift
            angles_deg.append(whole.turn_deg)
            sigmas_deg.append(float(np.rad2deg(np.linalg.norm(drift.turn_sigma))))
            errors.append(math.sqrt(drift.turn @ np.linalg.solve(drift.covariance[:3, :3], drift.turn) / 3))
    table.add(
        f"{name}, {role}",
        len(seeds),
        float(np.median(angles_deg)),
        max(angles_deg),
        float(np.median(sigmas_deg)),
        math.sqrt(np.square(errors).mean()),
        max(errors),
        wrong,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[*range(1, 6), *range(600, 610)])
    parser.add_argument("--only", nargs="+", choices=list(RIGS), default=list(RIGS))
    args = parser.parse_args(arguments)
    columns = (
        Column("rig, seeds"),
        Column("logs"),
        Column("angle, median", "deg", 3),
        Column("largest", "deg", 3),
        Column("sigma, median", "deg", 3),
        Column("error over sigma, rms", "", 2),
        Column("its largest", "", 2),
        Column("called wrong"),
    )
    table = ResultTable("right_rigs", "Right rigs by their check", columns, REMARKS)
    roles = {seed: role_of(FAMILY, seed) for seed in args.seeds}
    for name in args.only:
        for role in dict.fromkeys(roles.values()):
            measure(name, role, [seed for seed in args.seeds if roles[seed] == role], table)


if __name__ == "__main__":
    main()
