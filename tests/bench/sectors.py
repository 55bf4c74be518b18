"""Pairs of lenses that see a sector: `python -m tests.bench.sectors [--seeds N ...] [--pairs N] [--only CASE ...]`.

Each row is a pair of equal lenses one above the other, the upper one misaligned, that looks ahead in a corridor; steps
of 5 cm. "open": the end wall is 8 m beyond the last pose. "wall": the drive ends 1.2 m before it, and the last metres
show one plane, which tells a turn from a step aside only by its perspective. Two pairs see the full turn: 360-degree
cameras with stitched images, and two mirrors on one axis in one image. Both are measured with their true rig, and with
the one that `omnid calibrate rig` makes of 24 images or pairs of a board.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np

import omnid
from calib import se3
from calib.models.equirectangular import full_turn
from calib.panorama import fit_cylinder
from calib.rig import Rig
from calib.rig_file import read_rig
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.bench.results import Column, ResultTable
from tests.simulation import corridor, paths, write_log
from tests.simulation.rigs import lens, lens_rig

STEP_M: Final = 0.05
STITCHED: Final = "equirectangular"


class Case(NamedTuple):
    """A lens, and where it drives."""

    model: str
    field_deg: float
    size: tuple[int, int] = (640, 480)
    beyond_m: float = 8.0  # from the last pose to the end wall

    @property
    def name(self) -> str:
        """Name on the command line."""
        return f"{self.model}_{self.field_deg:g}{'' if self.beyond_m > 2 else '_wall'}"


CASES: Final = (
    Case("pinhole", 30),
    Case("pinhole", 60),
    Case("pinhole", 90),
    Case("equidistant", 180),
    Case("ds", 180),
    Case("eucm", 180),
    Case("equidistant", 270, (800, 480)),
    Case("pinhole", 30, beyond_m=1.2),
    Case("pinhole", 90, beyond_m=1.2),
    Case(STITCHED, 360, (1280, 640)),
)

REMARKS: Final = (
    "Pairs of equal lenses of 640x480 px (equidistant_270: 800x480), 0.2 m apart, the upper one turned by 0.7 "
    "degrees; 5 m in a corridor in steps of 5 cm. Wanted are 0.5, 0.2 and 0.1 % for 30, 90 and 180 degrees. "
    "Corners of the images widen the sector of a fisheye; of 270 degrees it is a full turn with a part that is "
    "not seen.",
    "`_wall`: the drive ends 1.2 m before the end wall; in all other rows it is 8 m away. A wall that fills 30 "
    "degrees tells a turn from a step aside by its perspective only: where the pose is lost near the wall, the state "
    "says so. Most of its bricks are identical: until the first motion has decided on their depths, poses are "
    "`degraded`. Limits of that were set on the seeds of the two lenses of 30 degrees.",
)

FULL_TURN_REMARKS: Final = ("`equirectangular_360`: stitched images of 1280x640 px. Wanted are 0.1 % and 3 mm.",)


def rig_of(case: Case) -> Rig:
    """Return the true rig of a case."""
    return lens_rig(full_turn(case.size) if case.model == STITCHED else lens(case.model, case.field_deg, case.size))


def measure(case: Case, seed: int, pairs: int, table: ResultTable) -> None:
    """Render a drive, replay it, and add its row."""
    rig = rig_of(case)
    poses, scene = paths.spline_path(seed, pairs, STEP_M), corridor(seed, STEP_M * pairs + 2.0 + case.beyond_m)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_log(folder, rig, poses, scene, seed=seed)
        add_row(f"{case.name}, seed {seed}", folder, read_rig(folder / "rig.toml"), seed, table)


def add_row(name: str, folder: Path, rig: Rig, seed: int, table: ResultTable) -> None:
    """Replay the log of a folder with a rig, and add the row of its errors."""
    cylinder = fit_cylinder(rig)
    result, truth = omnid.replay(folder / "log.mcap", rig=rig), read_tum(folder / "truth.txt")
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), truth)
    wrong = se3.log(
        se3.inverse(se3.inverse(truth.T[0]) @ truth.T) @ (se3.inverse(result.T_odom_rig[0]) @ result.T_odom_rig)
    )[1:]
    covariance = result.covariances[1:]
    squared = np.einsum("ni,nij,nj->n", wrong[:, :3], np.linalg.inv(covariance[:, :3, :3]), wrong[:, :3]) / 3
    states = ", ".join(f"{state} {count}" for state, count in Counter(map(str, result.states)).items())
    table.add(
        name,
        360 * cylinder.width / cylinder.turn_px,
        cylinder.width,
        100 * found.length_error_ratio,
        1e3 * found.ate_rmse_m,
        1e3 * float(np.linalg.norm(wrong[-1, :3])),
        math.sqrt(float(np.median(squared))),
        math.sqrt(float(squared.max())),
        states,
        seed=("sectors", seed),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 600, 608])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--only", nargs="+", choices=[case.name for case in CASES])
    args = parser.parse_args(arguments)
    columns = (
        Column("lens, field [deg]"),
        Column("sector", "deg", 1),
        Column("columns"),
        Column("length", "%", 2),
        Column("ATE rmse", "mm", 1),
        Column("error at the end", "mm", 1),
        Column("error over sigma, median", "", 1),
        Column("largest", "", 1),
        Column("states"),
    )
    sectors = ResultTable("sectors", "Lenses that see a sector", columns, REMARKS)
    title = "Stitched images, and two mirrors in one image"
    full_turns = ResultTable("sectors_full_turns", title, columns, FULL_TURN_REMARKS)
    for case in CASES:
        for seed in args.seeds if args.only is None or case.name in args.only else []:
            measure(case, seed, args.pairs, full_turns if case.model == STITCHED else sectors)


if __name__ == "__main__":
    main()
