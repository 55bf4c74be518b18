"""Disturbances of real lenses, lamps and cameras: `python -m tests.bench.disturbances [--only NAME ...] [--seeds]`.

Each row is one drive in rooms, rendered with one disturbance of tests/simulation/disturbances.py, with none ("clean"),
or with all together ("all"); the same rig, path and walls, or photographs on them. The error over sigma is that of the
position, sqrt(e^T C^-1 e / 3). A second table has the other parts of the same replays: places in the map of the clean
drive, depth by stereo, the check of the rig (which is right), and obstacles.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

import omnid
from calib import se3
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.calibration.rig_check import check_rig, read_rig_pairs
from omnid.config import PanoramaConfig, load_config
from omnid.core.places.place_map import PlaceMap
from omnid.core.rig.column_finding import RigFinding
from omnid.core.rig.rig_health import RigContradictedError
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from omnid.runs.replay import ReplayOptions, run_log
from omnid.runs.run_result import RunResult
from omnid.tracking_state import MapState
from tests.bench.disturbance_depth import DepthMeasure
from tests.bench.results import Cell, Column, ResultTable
from tests.simulation import build, write_log
from tests.simulation.disturbances import DISTURBANCES, Disturbance
from tests.simulation.photographs import with_photographs

SIZE, PAIRS = 384, 40
ALONE_SEEDS: Final = 2  # of those given, for each disturbance by itself
CLEAN: Final = "clean"
PHOTOGRAPHS: Final = "photographs"
CASES: Final[dict[str, tuple[Disturbance, ...]]] = {
    CLEAN: (),
    "all": DISTURBANCES,
    PHOTOGRAPHS: (),
    f"{PHOTOGRAPHS}, all": DISTURBANCES,
    **{name: (name,) for name in DISTURBANCES},
}
REMARKS: Final = (
    f"`rooms`, {PAIRS} pairs of {SIZE} px. Wanted of all together: within a factor of 3 of the clean log, length "
    "within 0.2 %, error over sigma below 2. Photographs: of bricks, gravel, grass and others on walls, floor, "
    "pictures and boxes.",
    "Gloss: a floor that reflects a quarter of the light like a mirror. Glass: before a third of the pictures. "
    "Windows: another third of them, saturated, in the floor and the glass too. Shadows: of boxes and robot on the "
    "floor. Restarts: a tenth of the images has lost rows of blocks with their restart markers; such images are "
    "refused, so that their pairs have no pose.",
)
PART_REMARKS: Final = (
    "Places: the share of the poses that are known in the map of the clean drive, and the largest error of those. "
    "Depth: points of keyframes against the world: the median error of the range, and the share that is wrong by more "
    "than 5 % and 3 of their own sigmas. Rig: what `calibrate drive --only check` says of the right rig. Obstacles: "
    "sectors whose obstacle was called free, of those that have one, and ranges before the nearest obstacle.",
)


def measure(name: str, seed: int, maps: dict[str, PlaceMap | None], tables: tuple[ResultTable, ResultTable]) -> None:
    """Render a drive, replay it in the map of the clean one with the same walls, and add its rows.

    maps: those by the case that is clean; such a case adds its own.
    """
    walls = PHOTOGRAPHS if name.startswith(PHOTOGRAPHS) else CLEAN
    run = build("rooms", seed, SIZE, PAIRS)
    scene = with_photographs(run.scene, seed) if walls == PHOTOGRAPHS else run.scene
    with TemporaryDirectory() as work:
        log, path = Path(work) / "log.mcap", Path(work) / "rig.toml"
        write_log(Path(work), run.rig, run.poses, scene, sensor=run.sensor, seed=seed, disturbances=CASES[name])
        truth, rig = read_tum(Path(work) / "truth.txt"), read_rig(path)
        if name == walls:
            maps[walls] = omnid.replay(log, path).places
        refused, config = False, load_config(None, [])
        measured = DepthMeasure(scene, dict(zip(truth.stamps_ns.tolist(), truth.T, strict=True)), rig, config)
        options = ReplayOptions(
            rig=rig, inline=True, collect=True, observer=measured, places=deepcopy(maps[walls]), localize_only=True
        )
        try:
            result = run_log(log, config, options)
        except RigContradictedError:
            refused = True
            result = run_log(log, load_config(None, ["rig.check=off"]), options)
        with closing(LogReader(log)) as reader:
            finding = check_rig(read_rig_pairs(reader, rig), rig, PanoramaConfig()).finding
    label, origin = f"{name}, seed {seed}", ("disturbances", seed)
    tables[0].add(label, *odometry_cells(result, truth), refused, seed=origin)
    tables[1].add(label, *place_cells(result, truth), *depth_cells(measured, finding), seed=origin)


def odometry_cells(result: RunResult, truth: Trajectory) -> list[Cell]:
    """Return length, errors, errors over sigma, and states."""
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), truth)
    T = truth.T[np.searchsorted(truth.stamps_ns, result.stamps_ns)]
    wrong = se3.log(se3.inverse(se3.inverse(T[0]) @ T) @ se3.inverse(result.T_odom_rig[0]) @ result.T_odom_rig)[1:, :3]
    squared = np.einsum("ni,nij,nj->n", wrong, np.linalg.inv(result.covariances[1:, :3, :3]), wrong) / 3
    return [
        100 * found.length_error_ratio,
        1e3 * found.ate_rmse_m,
        1e3 * float(np.linalg.norm(wrong[-1])),
        math.sqrt(float(np.median(squared))),
        math.sqrt(float(squared.max())),
        ", ".join(f"{state} {count}" for state, count in Counter(map(str, result.states)).items()),
    ]


def place_cells(result: RunResult, truth: Trajectory) -> list[Cell]:
    """Return the share of poses that are localised, and the largest error of them [mm]; the map begins as the log."""
    T = truth.T[np.searchsorted(truth.stamps_ns, result.stamps_ns)]
    known = np.array([state is MapState.LOCALIZED for state in result.map_states])
    apart = se3.inverse(se3.inverse(truth.T[0]) @ T) @ result.T_map_rig_live
    largest_m = float(np.linalg.norm(apart[known, :3, 3], axis=1).max()) if known.any() else math.nan
    return [100 * known.sum() / len(truth.T), 1e3 * largest_m]


def depth_cells(measured: DepthMeasure, finding: RigFinding) -> list[Cell]:
    """Return errors of depth, the angle of the right rig with its sigma and state, and errors of obstacles."""
    errors, wrong = np.abs(np.concatenate(measured.errors)), np.concatenate(measured.wrong)
    sigma_deg = math.degrees(np.linalg.norm(finding.drift.turn_sigma)) if finding.drift else math.nan
    return [
        100 * float(np.median(errors)),
        100 * float(wrong.mean()),
        finding.turn_deg,
        sigma_deg,
        str(finding.state),
        *measured.obstacle_shares,
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, *range(603, 608)])
    parser.add_argument(
        "--only", nargs="+", choices=list(CASES), default=list(CASES), help="each after the clean drive with its walls"
    )
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
    parts = (
        Column("disturbance"),
        Column("localised", "%", 0),
        Column("largest error in the map", "mm", 1),
        Column("range, median error", "%", 2),
        Column("wrong ranges", "%", 1),
        Column("angle of the rig", "deg", 3),
        Column("sigma", "deg", 3),
        Column("rig"),
        Column("missed obstacles", "%", 2),
        Column("false ones", "%", 2),
    )
    tables = (
        ResultTable("disturbances", "Disturbances of real images", columns, REMARKS),
        ResultTable("disturbances_parts", "Disturbances: places, depth, rig, obstacles", parts, PART_REMARKS),
    )
    for number, seed in enumerate(args.seeds):
        maps: dict[str, PlaceMap | None] = {}
        for name in args.only:
            if number < ALONE_SEEDS or name in (CLEAN, "all"):
                measure(name, seed, maps, tables)


if __name__ == "__main__":
    main()
