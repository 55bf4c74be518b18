"""Errors and stated sigmas on drives rendered for it: `python -m tests.bench.rendered SET [--only CASE ...] [--seeds]`.

A set is one of

- lenses: pairs of equal lenses one above the other, 0.2 m apart, the upper one turned by 0.7 degrees, 5 m in a corridor
  in steps of 5 cm. The end wall is 8 m beyond the last pose; `_wall`: 1.2 m, so that the last metres show one plane,
  which tells a turn from a step aside by its perspective only. Limits were set on the seeds of 30 degrees.
  Wanted are 0.5, 0.2 and 0.1 % of the length for 30, 90 and 180 degrees, and 0.1 % and 3 mm for stitched images.
- honesty: drives on which poses were, or may be, wrong without saying so. Of `alike` and `too fast` all but the first
  pose must not be `tracking`. The rig is right: a refusal of it is a failure.
- disturbances: drives in rooms with each disturbance of tests/simulation/disturbances.py, with none (`clean`), with all
  together. Wanted of all together: ATE within a factor of 3 of the clean drive,
  length within 0.2 %, errors below 2 sigmas.
- slow: parked for 150 s, wanted at most 5 mm of length and 1 mm of error; 2 mm/s for 60 s, wanted 10 % of the length.

The error over sigma is that of the position, sqrt(e^T C^-1 e / 3); NEES is the mean of e^T C^-1 e, of which 3 is right.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal

import numpy as np

import omnid
from calib.models.lens import full_turn
from calib.rig import ShutterTimes
from calib.rig_file import read_rig
from omnid.core.rig.rig_health import RigContradictedError
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.ray_caster import Sensor
from omnid.tracking_state import TrackingState
from tests.bench.accuracy import EXACT, position_errors, squared_errors
from tests.bench.results import Cell, ResultTable, columns, run
from tests.simulation import SimulatedRun, build, corridor, paths, write_log
from tests.simulation.builders import repeating, room
from tests.simulation.disturbances import DISTURBANCES, Disturbance
from tests.simulation.logs import Readout
from tests.simulation.recipes import DIM, mild_rig
from tests.simulation.rigs import lens, lens_rig

SIZE: Final = 384
STEP_M: Final = 0.05
LINE_US: Final = 52.0  # of a rolling shutter
COLUMNS: Final = columns(
    "drive",
    *("length|mm|1", "length|%|2", "ATE rmse|mm|1", "error at the end|mm|1", "largest error|mm|1"),
    *("NEES||1", "error over sigma, median||1", "largest||1", "largest while tracking||1", "states", "rig refused"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """A drive of a seed, and how its log is made."""

    drive: Callable[[int], SimulatedRun]
    disturbances: tuple[Disturbance, ...] = ()
    line_us: float = 0.0
    is_exact: bool = False  # the replay is told that the rig is exact


def by_lens(
    model: str, field_deg: float, size: tuple[int, int] = (640, 480), beyond_m: float = 8.0, pairs: int = 100
) -> Case:
    """Return a drive with two lenses; beyond_m: from the last pose to the end wall."""
    rig = lens_rig(full_turn(size) if model == "equirectangular" else lens(model, field_deg, size))

    def drive(seed: int) -> SimulatedRun:
        return SimulatedRun(rig, paths.spline_path(seed, pairs, STEP_M), corridor(seed, STEP_M * pairs + 2 + beyond_m))

    return Case(drive)


def alike(seed: int) -> SimulatedRun:
    """Return steps of 28 cm in a corridor that repeats after 30 cm: nothing tells these from 2 cm back."""
    ahead = np.column_stack([0.28 * np.arange(30) - 2.0, np.zeros(30)])
    return SimulatedRun(mild_rig(seed, SIZE), paths.planar_poses(ahead, np.zeros(30)), repeating(seed, 40.0))


def too_fast(seed: int) -> SimulatedRun:
    """Return 10 m/s before a limit of 5 m/s."""
    return SimulatedRun(mild_rig(seed, SIZE), paths.spline_path(seed, 20, 1.0), corridor(seed, 40.0))


def slow(seed: int, pairs: int = 600, step_m: float = 2e-4) -> SimulatedRun:
    """Return a way straight ahead in a room."""
    ahead = step_m * np.outer(np.arange(pairs), [1.0, 0.0])
    return SimulatedRun(mild_rig(seed, SIZE), paths.planar_poses(ahead, np.zeros(pairs)), room(seed))


def rooms(seed: int, pairs: int = 60, sensor: Sensor | None = None, tilt_deg: float = 0.0) -> SimulatedRun:
    """Return a drive in a room, by another sensor, or shaken from pair to pair."""
    made = build("rooms", seed, SIZE, pairs)
    poses = paths.vibrate(made.poses, seed + 1, tilt_deg) if tilt_deg else made.poses
    return replace(made, poses=poses, sensor=sensor or made.sensor)


ROOMS: Final = partial(rooms, pairs=40)
SETS: Final[dict[str, dict[str, Case]]] = {
    "lenses": {
        "pinhole_30": by_lens("pinhole", 30),
        "pinhole_60": by_lens("pinhole", 60),
        "pinhole_90": by_lens("pinhole", 90),
        "equidistant_180": by_lens("equidistant", 180),
        "ds_180": by_lens("ds", 180),
        "equidistant_270": by_lens("equidistant", 270, (800, 480)),
        "pinhole_30_wall": by_lens("pinhole", 30, beyond_m=1.2),
        "pinhole_90_wall": by_lens("pinhole", 90, beyond_m=1.2),
        "equirectangular_360": by_lens("equirectangular", 360, (1280, 640)),
    },
    "honesty": {
        "bricks": Case(lambda seed: build("brick_corridor", seed, pairs=40), is_exact=True),
        "alike": Case(alike, is_exact=True),
        "wall": replace(by_lens("pinhole", 30, beyond_m=1.2), is_exact=True),
        "too fast": Case(too_fast, is_exact=True),
        "dim": Case(partial(rooms, sensor=DIM), is_exact=True),
        "bumpy": Case(partial(rooms, sensor=Sensor(), tilt_deg=0.3), line_us=LINE_US, is_exact=True),
    },
    "disturbances": {
        "clean": Case(ROOMS),
        "all": Case(ROOMS, DISTURBANCES),
        **{name: Case(ROOMS, (name,)) for name in DISTURBANCES},
    },
    "slow": {"parked": Case(partial(slow, pairs=1500, step_m=0.0)), "creeping": Case(slow)},
}
# The seeds of docs/RESULTS.md.
SEEDS: Final = {
    "lenses": (1, 2, 600, 608),
    "honesty": (3, 603, 604),
    "disturbances": (3, *range(603, 608)),
    "slow": (1, 600),
}


def render(folder: Path, case: Case, seed: int) -> None:
    """Write the log of a case."""
    made = case.drive(seed)
    readout = Readout(line_time_us=(case.line_us, case.line_us))
    options = {"sensor": made.sensor, "readout": readout, "disturbances": case.disturbances}
    write_log(folder, made.rig, made.poses, made.scene, seed=seed, **options)  # type: ignore[arg-type]


def measured(case: Case, seed: int) -> list[Cell]:
    """Render a drive, replay it, and return its figures."""
    with TemporaryDirectory() as work:
        log = Path(work) / "log.mcap"
        render(log.parent, case, seed)
        truth, rig = read_tum(log.with_name("truth.txt")), read_rig(log.with_name("rig.toml"))
        if case.is_exact:
            rig = replace(rig, covariance=EXACT, times=ShutterTimes(0.0, 1e-6 * case.line_us))
        try:
            refused, result = False, omnid.replay(log, rig)
        except RigContradictedError:
            refused, result = True, omnid.replay(log, rig, overrides=["rig.check=off"])
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), truth)
    largest_m = float(np.linalg.norm(position_errors(result, truth), axis=1).max())
    squared = squared_errors(result, truth)
    tracking = np.array([state is TrackingState.TRACKING for state in result.states[1:]])
    return [
        1e3 * found.length_estimate_m,
        100 * found.length_error_ratio,
        *(1e3 * length_m for length_m in (found.ate_rmse_m, found.end_error_m, largest_m)),
        float(squared.mean()),
        *(math.sqrt(value / 3) for value in (float(np.median(squared)), squared.max())),
        math.sqrt(squared[tracking].max() / 3) if tracking.any() else None,
        ", ".join(f"{state} {count}" for state, count in Counter(map(str, result.states)).items()),
        refused,
    ]


def rendered(
    set: Literal["lenses", "honesty", "disturbances", "slow"], *, seeds: Sequence[int] = (), only: Sequence[str] = ()
) -> None:
    """Print the table of a set, by default of all its cases and of the seeds of docs/RESULTS.md."""
    cases = SETS[set]
    if missing := [name for name in only if name not in cases]:
        raise SystemExit(f"--only: {', '.join(missing)}: expected some of {', '.join(cases)}")
    table = ResultTable(set, f"Rendered drives: {set}", COLUMNS)
    for name in only or cases:
        for seed in seeds or SEEDS[set]:
            table.add(f"{name}, seed {seed}", *measured(cases[name], seed), seed=(set, seed))


if __name__ == "__main__":
    run(rendered)
