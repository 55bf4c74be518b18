"""Recognition of places, measured: `python -m tests.bench.places laps|kidnapped FOLDER ...`.

laps: errors of odometry and of the pose in the map, and the loops, for folders of `python -m tests.simulation` with a
closed path (two_laps) or with places that look alike (twin, symmetric, brick_corridor). --wrong-deg rotates the upper
camera of the rig about a random axis. kidnapped: the log of such a folder is cut and goes on elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

import omnid
from calib import se3
from calib.models.camera import Array
from calib.rig import Rig
from calib.rig_file import read_rig
from omnid.core.places.place_map import PlaceMap
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from omnid.runs.replay import RunResult
from omnid.tracking_state import MapState
from tests.bench.results import Cell, ResultTable, columns, run
from tests.omnid.core.scenery import motion_errors
from tests.replay.edited import images, save
from tests.simulation.rigs import with_upper_rotated

FALSE_M, FALSE_RAD = 0.1, math.radians(2)  # error of a loop that is a false one
NEAR_M, LEFT_M = 0.5, 4.0  # a revisit: so near to a place that was left so long ago (m of path)
AFTER_CUT = 50  # pairs of a log after it was cut
LAPS: Final = columns(
    *("log", "rig off by|deg|1", "odometry: ATE|mm|1", "its end|mm|1", "live in the map: ATE|mm|1", "its end|mm|1"),
    *("ratio||2", "at the end: ATE|mm|1", "its ratio||2", "loops", "false loops", "loop after revisit|m|1"),
    "keyframes",
)
KIDNAPPED: Final = columns(
    *("log", "carried|m|1", "localised after|s|1", "error after that|mm|0", "wrong after that"),
    "largest step of odom|mm|0",
)


def disturbed(rig: Rig, degrees: float, seed: int) -> Rig:
    """Return the rig whose upper camera is rotated about a random axis."""
    axis = np.random.default_rng(seed).standard_normal(3)
    return with_upper_rotated(rig, tuple((degrees * axis / np.linalg.norm(axis)).tolist())) if degrees else rig


def replayed(folder: Path, degrees: float, seed: int) -> RunResult:
    """Return the run of a folder's log."""
    rig = disturbed(read_rig(folder / "rig.toml"), degrees, seed)
    return omnid.replay(folder / "log.mcap", rig, overrides=["rig.check=off"])


def laps_row(folder: Path, degrees: float, seed: int) -> list[Cell]:
    """Return one row of the table."""
    truth = read_tum(folder / "truth.txt")
    result = replayed(folder, degrees, seed)
    odom, live, final = (
        evaluate(Trajectory(result.stamps_ns, T), truth)
        for T in (result.T_odom_rig, result.T_map_rig_live, result.T_map_rig)
    )
    errors = loop_errors(result.places or PlaceMap(), truth, read_rig(folder / "rig.toml"))
    false = sum(m > FALSE_M or rad > FALSE_RAD for m, rad in errors)
    after_m = after_revisit_m(truth.T, result.map_states)
    return [
        folder.name,
        degrees,
        1e3 * odom.ate_rmse_m,
        1e3 * odom.end_error_m,
        1e3 * live.ate_rmse_m,
        1e3 * live.end_error_m,
        live.ate_rmse_m / odom.ate_rmse_m,
        1e3 * final.ate_rmse_m,
        final.ate_rmse_m / odom.ate_rmse_m,
        len(errors),
        false,
        after_m,
        len(result.places or ()),
    ]


def loop_errors(places: PlaceMap, truth: Trajectory, rig: Rig) -> list[tuple[float, float]]:
    """Return the errors [m, rad] of the loops of a map."""

    def pose(id: int) -> Array:
        nearest = np.abs(truth.stamps_ns - places.keyframes[id].stamp_ns).argmin()
        return np.asarray(truth.T[nearest] @ se3.inverse(rig.T_rect_rig))

    return [
        motion_errors(link.T_a_b, se3.inverse(pose(link.a)) @ pose(link.b)) for link in places.links if link.is_loop
    ]


def after_revisit_m(T: Array, states: Sequence[MapState]) -> float:
    """Return the path from the first revisit of a place to the first pose that is localised; NaN without one."""
    if MapState.LOCALIZED not in states:
        return math.nan
    path_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    apart = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=2)
    again = ((apart < NEAR_M) & (path_m[:, None] - path_m[None] > LEFT_M)).any(axis=1)
    first = int(again.argmax()) if again.any() else len(T) - 1
    return float(path_m[states.index(MapState.LOCALIZED)] - path_m[first])


def kidnapped_row(folder: Path, seed: int) -> list[Cell]:
    """Return the time from the cut of a log until the pose in the map is right, and the errors after that."""
    truth, taken = read_tum(folder / "truth.txt"), images(folder / "log.mcap")
    count = len(truth.stamps_ns)
    cut = round(0.5 * count)
    begin = int(np.random.default_rng([seed, 43]).integers(round(0.1 * count), round(0.35 * count)))
    kept = [image for image in taken if image.pair < cut]
    kept += [image.later(cut - begin) for image in taken if begin <= image.pair < begin + AFTER_CUT]
    with TemporaryDirectory() as work:
        result = omnid.replay(save(Path(work) / "log.mcap", kept), read_rig(folder / "rig.toml"))
    T_true = np.concatenate([truth.T[:cut], truth.T[begin : begin + AFTER_CUT]])[: len(result.stamps_ns)]
    errors = [motion_errors(a, b) for a, b in zip(result.T_map_rig_live, se3.inverse(T_true[0]) @ T_true, strict=True)]
    steps_m = np.linalg.norm(np.diff(result.T_odom_rig[:, :3, 3], axis=0), axis=1)
    after = [k for k in range(cut, len(errors)) if result.map_states[k] is MapState.LOCALIZED]
    jump_m = float(np.linalg.norm(truth.T[begin, :3, 3] - truth.T[cut - 1, :3, 3]))
    if not after:
        return [folder.name, jump_m, None, None, None, 1e3 * steps_m.max()]
    found = next((k for k in after if errors[k][0] < FALSE_M), after[-1])
    wrong = sum(errors[k][0] > FALSE_M for k in after if k > found)
    largest_m = max(errors[k][0] for k in after if k >= found)
    return [folder.name, jump_m, 0.1 * (found - cut), 1e3 * largest_m, wrong, 1e3 * steps_m.max()]


def laps(folders: Sequence[Path], *, wrong_deg: Sequence[float] = (0.0, 0.1)) -> None:
    """Print the errors of closed drives, and of places that look alike, by the error of the rig."""
    table = ResultTable("places_laps", "Loops on closed drives, and places that look alike", LAPS)
    for folder in folders:
        for degrees in wrong_deg:
            table.add(*laps_row(folder, degrees, seed_of(folder)), folder=folder)


def kidnapped(folders: Sequence[Path]) -> None:
    """Print the errors after the cut of logs that go on elsewhere."""
    table = ResultTable("places_kidnapped", "A log that goes on elsewhere", KIDNAPPED)
    for folder in folders:
        table.add(*kidnapped_row(folder, seed_of(folder)), folder=folder)


def seed_of(folder: Path) -> int:
    """Return the seed of a folder NAME_sSEED."""
    return int(folder.name.rpartition("_s")[2])


if __name__ == "__main__":
    run(laps, kidnapped)
