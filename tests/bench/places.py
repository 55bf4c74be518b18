"""Recognition of places, measured: `python -m tests.bench.places laps|queries|kidnapped|sessions FOLDER ...`.

laps: errors of odometry and of the pose in the map, and the loops, for folders of `python -m tests.simulation` with a
closed path (two_laps) or with places that look alike (twin, symmetric, brick_corridor). --wrong-deg rotates the upper
camera of the rig about a random axis. queries: views of a world, which has changed meanwhile, in the map of a two_laps
folder. kidnapped: the log of such a folder is cut and goes on elsewhere. sessions: the log is replayed again and again
into one map file, with a keyframe every 0.1 m, the last time with the default settings; 7 fill 1,000 keyframes.
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

import omnid
from calib import se3
from calib.models.camera import Array
from calib.rig import Rig
from calib.rig_file import read_rig
from omnid.cli import main as run_command
from omnid.core.places.localisation import MapLocaliser
from omnid.core.places.map_pose import OdometryFrame
from omnid.core.places.place_map import PlaceLimits, PlaceMap
from omnid.engine.kernel_cache import prepare_kernels
from omnid.formats.place_file import read_places
from omnid.formats.tum import Trajectory, read_tum
from omnid.messages import OdometryUpdate, PlaceUpdate
from omnid.recordings.evaluation import evaluate
from omnid.runs.run_result import RunResult
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.stages.places import Places
from omnid.tracking_state import MapState
from tests.bench.results import Cell, Column, ResultTable
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.replay.edited import images, save
from tests.simulation.closed_worlds import ring, with_other_posters, with_people
from tests.simulation.rigs import with_upper_rotated

FALSE_M, FALSE_RAD = 0.1, math.radians(2)  # error of a loop that is a false one
NEAR_M, LEFT_M = 0.5, 4.0  # a revisit: so near to a place that was left so long ago (m of path)
LAP = 0.5  # share of a two_laps log that is the first lap
SEARCHES, PERIOD_NS = 6, 200_000_000  # of a query, after which it is given up
AFTER_CUT = 50  # pairs of a log after it was cut
LAPS: Final = (
    Column("log"),
    Column("rig off by", "deg", 1),
    Column("odometry: ATE", "mm", 1),
    Column("its end", "mm", 1),
    Column("live in the map: ATE", "mm", 1),
    Column("its end", "mm", 1),
    Column("ratio", "", 2),
    Column("at the end: ATE", "mm", 1),
    Column("its ratio", "", 2),
    Column("loops"),
    Column("false loops"),
    Column("loop after revisit", "m", 1),
    Column("keyframes"),
    Column("processor time of places", "%", 1),
)
SESSIONS: Final = (
    Column("session"),
    Column("keyframes"),
    Column("dropped so far"),
    Column("loops"),
    Column("file", "MB", 1),
    Column("read, processor time", "s", 2),
    Column("processor time of places", "%", 1),
    Column("a pair, mean", "ms", 1),
    Column("a pair, most", "ms", 0),
    Column("localised", "%", 1),
    Column("live ATE in the map", "mm", 1),
    Column("largest memory", "MB", 0),
)
KIDNAPPED: Final = (
    Column("log"),
    Column("carried", "m", 1),
    Column("localised after", "s", 1),
    Column("error after that", "mm", 0),
    Column("wrong after that"),
    Column("largest step of odom", "mm", 0),
)
QUERIES: Final = (
    Column("map"),
    Column("queries"),
    Column("right", "%", 1),
    Column("wrong"),
    Column("not localised"),
    Column("time to localise, p95", "s", 1),
    Column("error p50", "mm", 1),
    Column("error, most", "mm", 1),
    Column("heading, most", "deg", 2),
    Column("longest search, processor time", "ms", 0),
    Column("the wrong ones"),
)
TABLES: Final = {
    "laps": ("Loops on closed drives, and places that look alike", LAPS),
    "queries": ("Queries in a map", QUERIES),
    "kidnapped": ("A log that goes on elsewhere", KIDNAPPED),
    "sessions": ("One map extended by session after session", SESSIONS),
}


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
    truth, started = read_tum(folder / "truth.txt"), time.process_time()
    with timed_places() as spent:
        result = replayed(folder, degrees, seed)
    share = sum(spent) / (time.process_time() - started)
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
        100 * share,
    ]


@contextmanager
def timed_places() -> Iterator[list[float]]:
    """Yield a list that gets the processor times [s] of the places stage in this block."""
    spent: list[float] = []
    untimed = Places.process

    def process(self: Places, odometry: OdometryUpdate) -> PlaceUpdate:
        started = time.thread_time()
        result = untimed(self, odometry)
        spent.append(time.thread_time() - started)
        return result

    Places.process = process  # type: ignore[method-assign]
    try:
        yield spent
    finally:
        Places.process = untimed  # type: ignore[method-assign]


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


@dataclass(frozen=True, slots=True)
class Answer:
    """Outcome of a query: time until it was localised (inf: not), its errors, and the processor time of a search."""

    time_s: float
    error_m: float
    error_rad: float
    work_s: float

    @property
    def is_right(self) -> bool:
        """True if it is localised within 5 cm and 0.5 degrees."""
        return self.error_m < 0.05 and self.error_rad < math.radians(0.5)

    @property
    def is_wrong(self) -> bool:
        """True if it is localised elsewhere."""
        return math.isfinite(self.time_s) and not self.is_right


def queries(folder: Path, seed: int, count: int) -> list[Answer]:
    """Return the answers to views of a two_laps world, beside the path, at any yaw, in other light, with changes."""
    result, rig = replayed(folder, 0.0, 0), read_rig(folder / "rig.toml")
    assert result.places is not None
    poses = read_tum(folder / "truth.txt").T
    rng = np.random.default_rng([seed, 41])
    cameras = RenderedCameras.of(rig, ring(seed))
    answers = []
    for number in range(count):
        T = poses[rng.integers(round(LAP * len(poses)))] @ se3.exp(
            [*rng.uniform(-0.28, 0.28, 2), 0, 0, 0, rng.uniform(-np.pi, np.pi)]
        )
        scene = with_people(with_other_posters(ring(seed), rng, 0.2), rng, T[:2, 3])
        here = replace(cameras, scene=scene)
        answers.append(_asked(here, result.places, (poses[0], T), (number, float(rng.uniform(0.7, 1.3)))))
    return answers


def _asked(cameras: RenderedCameras, places: PlaceMap, poses: tuple[Array, Array], view: tuple[int, float]) -> Answer:
    """Return the answer of a robot that stands; poses: of the map and of the rig; view: number and brightness."""
    localiser = MapLocaliser(cameras.model, PlaceLimits(), deepcopy(places), localize_only=True)
    T_rig_rect = se3.inverse(cameras.rig.T_rect_rig)
    T_map_rect = se3.inverse(poses[0] @ T_rig_rect) @ poses[1] @ T_rig_rect
    ideal = [
        view[1] * render_grey(cameras.scene, mounted, poses[1]) for mounted in (cameras.rig.lower, cameras.rig.upper)
    ]
    rng, longest_s = np.random.default_rng([view[0], 42]), 0.0
    for search in range(SEARCHES):
        lower, upper = (sensor.expose(image, rng) for sensor, image in zip(cameras.exposures, ideal, strict=True))
        stereo = cameras.stereo_frame(SEARCHES * view[0] + search, lower, upper)
        frame = OdometryFrame(
            stereo,
            search * PERIOD_NS,
            np.eye(4),
            1e-8 * np.eye(6),
            False,
            0,
            True,
            lambda: np.full(360, np.nan, np.float32),
            lambda: np.zeros(360, np.float32),
        )
        started = time.process_time()
        pose = localiser.process(frame)
        longest_s = max(longest_s, time.process_time() - started)
        if pose.state is MapState.LOCALIZED:
            return Answer(1e-9 * PERIOD_NS * search, *motion_errors(pose.T_map_odom, T_map_rect), longest_s)
    return Answer(math.inf, math.inf, math.inf, longest_s)


def queries_row(name: str, answers: Sequence[Answer]) -> list[Cell]:
    """Return the share that was localised, and the time it took."""
    right = [answer for answer in answers if answer.is_right]
    times = sorted(answer.time_s for answer in answers)
    wrong = [
        f"{number} by {answer.error_m:.3f} m, {math.degrees(answer.error_rad):.2f} deg"
        for number, answer in enumerate(answers)
        if answer.is_wrong
    ]
    errors: tuple[Cell, ...] = (None, None, None)
    if right:
        errors = (
            1e3 * float(np.median([a.error_m for a in right])),
            1e3 * max(a.error_m for a in right),
            math.degrees(max(a.error_rad for a in right)),
        )
    return [
        name,
        len(answers),
        100 * len(right) / len(answers),
        len(wrong),
        sum(math.isinf(answer.time_s) for answer in answers),
        times[int(0.95 * len(times))],
        *errors,
        1e3 * max(answer.work_s for answer in answers),
        "; ".join(wrong),
    ]


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


def session_rows(folder: Path, count: int) -> Iterator[list[Cell]]:
    """Yield a row for each of the sessions that extend one map; the last one has the default distances and rate."""
    truth, rig = read_tum(folder / "truth.txt"), folder / "rig.toml"
    denser = ["places.limits.keyframe_m=0.1", "places.limits.keyframe_deg=5"]
    with TemporaryDirectory() as work:
        path = Path(work) / "a.omap"
        built = ["map", "build", str(folder / "log.mcap"), "-o", str(path), "--rig", str(rig), "--quiet"]
        assert run_command([*built, *(word for setting in denser for word in ("--set", setting))]) == 0
        for session in range(1, count):
            settings = denser if session < count - 1 else []
            started = time.process_time()
            with timed_places() as spent:
                result = omnid.replay(folder / "log.mcap", rig, overrides=[*settings, f"places.map={path}"])
            share = sum(spent) / (time.process_time() - started)
            began = time.process_time()
            places, _ = read_places(path)
            read_s = time.process_time() - began
            error = evaluate(Trajectory(result.stamps_ns, result.T_map_rig_live), truth)
            localised = sum(state is MapState.LOCALIZED for state in result.map_states) / len(result.map_states)
            yield [
                f"{session + 1}{'' if settings else ', default'}",
                len(places),
                places.dropped,
                places.loops,
                path.stat().st_size / 1e6,
                read_s,
                100 * share,
                1e3 * sum(spent) / len(spent),
                1e3 * max(spent),
                100 * localised,
                1e3 * error.ate_rmse_m,
                resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
            ]


def main() -> None:
    """Print the rows as soon as they are measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("laps", "queries", "kidnapped", "sessions"))
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="named NAME_sSEED")
    parser.add_argument("--wrong-deg", type=float, nargs="*", default=[0.0, 0.1])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--runs", type=int, default=7, help="sessions")
    args = parser.parse_args()
    prepare_kernels(lambda _level, _text: None)  # their compilation is no part of the shares
    title, columns = TABLES[args.what]
    table = ResultTable(f"places_{args.what}", title, columns)
    for folder in args.folders:
        seed = int(folder.name.rpartition("_s")[2])
        match args.what:
            case "laps":
                for degrees in args.wrong_deg:
                    table.add(*laps_row(folder, degrees, seed), folder=folder)
            case "queries":
                table.add(*queries_row(folder.name, queries(folder, seed, args.count)), folder=folder)
            case "sessions":
                for row in session_rows(folder, args.runs):
                    table.add(*row, folder=folder)
            case "kidnapped":
                table.add(*kidnapped_row(folder, seed), folder=folder)


if __name__ == "__main__":
    main()
