"""Errors of poses over their stated sigma: `python -m tests.bench.honesty [--only CASE ...] [--seeds N ...]`.

Each row is a rendered drive on which poses were, or may be, wrong without saying so. The error over sigma is that of
the position, sqrt(e^T C^-1 e / 3); NEES is the mean of e^T C^-1 e, of which 3 is expected. The rig is the right one: a
refusal of it is a failure.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from numpy.typing import NDArray

import omnid
from calib import se3
from calib.rig import ShutterTimes
from calib.rig_covariance import RigCovariance
from calib.rig_file import read_rig
from omnid.core.rig.rig_health import RigContradictedError
from omnid.formats.tum import read_tum
from omnid.simulation.people import Person, Walkers
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import DIM, Floats, Sensor
from omnid.simulation.rendering.shapes import box
from omnid.simulation.rendering.surfaces import Scene
from omnid.tracking_state import TrackingState
from tests.bench.accuracy import squared_errors
from tests.bench.results import Column, ResultTable
from tests.simulation import SimulatedRun, build, corridor, paths, write_log
from tests.simulation.closed_worlds import repeating
from tests.simulation.logs import pack_log
from tests.simulation.readout import Readout
from tests.simulation.recipes import mild_rig
from tests.simulation.rigs import lens, lens_rig

Array = NDArray[np.float64]

SIZE, LINE_US = 384, 52.0
PERSON_M: Final = (0.3, 0.5, 1.7)
PERIOD_S: Final = 0.1
EXACT: Final = RigCovariance(("baseline",), np.zeros(1), np.eye(1))  # nothing is added for the rig, which is right


def wall(seed: int) -> SimulatedRun:
    """Return a lens of 30 degrees that ends 1.2 m before a wall: the last metres show one plane."""
    poses = paths.spline_path(seed, 100, 0.05)
    return SimulatedRun(lens_rig(lens("pinhole", 30, (640, 480))), poses, corridor(seed, 8.2))


def alike(seed: int) -> SimulatedRun:
    """Return steps of 28 cm in a corridor that repeats after 30 cm."""
    ahead = np.column_stack([0.28 * np.arange(30) - 2.0, np.zeros(30)])
    return SimulatedRun(mild_rig(seed, SIZE), paths.planar_poses(ahead, np.zeros(30)), repeating(seed, 40.0))


def too_fast(seed: int) -> SimulatedRun:
    """Return 10 m/s before a limit of 5 m/s."""
    return SimulatedRun(mild_rig(seed, SIZE), paths.spline_path(seed, 20, 1.0), corridor(seed, 40.0))


def bricks(seed: int) -> SimulatedRun:
    """Return a corridor of bricks, whose length differs from wall to wall."""
    return build("brick_corridor", seed, pairs=40)


def dim(seed: int) -> SimulatedRun:
    """Return a drive in a room in dim light."""
    return replace(build("rooms", seed, SIZE, 60), sensor=DIM)


def bumpy(seed: int) -> SimulatedRun:
    """Return a drive that shakes by twice of what `rooms` does; its cameras have rolling shutters."""
    run = build("rooms", seed, SIZE, 60)
    return replace(run, poses=paths.vibrate(run.poses, seed + 1, 0.3), sensor=Sensor())


def people(seed: int) -> SimulatedRun:
    """Return a drive in a room in which five people walk back and forth, 0.5 to 1 m from the way."""
    return build("rooms", seed, SIZE, 60)


def walkers(seed: int) -> Walkers:
    """Return the people of that drive: two on each side of the loop at least, at 0.8 to 1.4 m/s."""
    rng = np.random.default_rng([seed, 51])
    walking = []
    for number in range(5):
        at, ends = rng.uniform(1.5, 1.8), rng.uniform(0.6, 1.4, 2) * (-1, 1)
        turn = np.pi / 2 * number
        c, s = np.cos(turn), np.sin(turn)
        first, last = ((float(c * at - s * end), float(s * at + c * end)) for end in ends)
        faces = tuple(box(rng, (0.0, 0.0), PERSON_M, 0.0))
        walking.append(Person(faces, (first, last), float(rng.uniform(0.8, 1.4)), "back and forth"))
    return Walkers(tuple(walking))


CASES: Final[dict[str, Callable[[int], SimulatedRun]]] = {
    "bricks": bricks,
    "alike": alike,
    "wall": wall,
    "too fast": too_fast,
    "dim": dim,
    "bumpy": bumpy,
    "people": people,
}
REMARKS: Final = (
    "bricks: identical ones on each wall, of other lengths on the others. alike: a corridor that is the same again "
    "after 30 cm, in steps of 28 cm: nothing tells these from 2 cm back, so all but the first pose must be degraded.",
    "wall: a sector of 30 degrees that one plane fills. too fast: 10 m/s before a limit of 5 m/s, so all but the first "
    "pose must not be tracking. dim: grey level 30, noise 5. bumpy: 0.3 degrees of tilt from pair to pair, rolling "
    "shutters. people: five of them walk back and forth, 0.5 to 1 m from the way.",
)


def write_log_of_people(folder: Path, run: SimulatedRun, seed: int) -> None:
    """Render a drive among the people of that seed."""
    about, cameras = walkers(seed), (run.rig.lower, run.rig.upper)

    def ideal_image(pair: int, camera: int) -> Floats:
        x_m, y_m = run.poses[pair, :2, 3].tolist()
        about.advance(PERIOD_S * pair, (x_m, y_m))
        scene = Scene((*run.scene.rectangles, *about.faces()))
        return render_grey(scene, cameras[camera], run.poses[pair], 2, np.zeros(6))

    pack_log(folder, run.rig, run.poses, ideal_image, sensor=run.sensor, seed=seed)


def measure(name: str, seed: int, table: ResultTable) -> None:
    """Render a drive, replay it, and add its row."""
    run = CASES[name](seed)
    readout = Readout(1.0, (0.0, 0.0), 0.0, (LINE_US, LINE_US)) if name == "bumpy" else Readout()
    times = ShutterTimes(0.0, 1e-6 * readout.line_time_us[0])
    with TemporaryDirectory() as work:
        folder = Path(work)
        if name == "people":
            write_log_of_people(folder, run, seed)
        else:
            write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=seed, readout=readout)
        truth, refused = read_tum(folder / "truth.txt"), False
        rig = replace(read_rig(folder / "rig.toml"), covariance=EXACT, times=times)
        try:
            result = omnid.replay(folder / "log.mcap", rig)
        except RigContradictedError:
            refused = True
            result = omnid.replay(folder / "log.mcap", rig, overrides=["rig.check=off"])
    T = truth.T[np.searchsorted(truth.stamps_ns, result.stamps_ns)]
    wrong = se3.log(se3.inverse(se3.inverse(T[0]) @ T) @ se3.inverse(result.T_odom_rig[0]) @ result.T_odom_rig)[1:, :3]
    squared = squared_errors(result, truth)
    tracking = np.array([state is TrackingState.TRACKING for state in result.states[1:]])
    counts = Counter(map(str, result.states))
    table.add(
        f"{name}, seed {seed}",
        1e3 * float(np.linalg.norm(wrong, axis=1).max()),
        float(squared.mean()),
        math.sqrt(squared.max() / 3),
        math.sqrt(squared[tracking].max() / 3) if tracking.any() else None,
        ", ".join(f"{state} {count}" for state, count in counts.items()),
        refused,
        seed=(f"honesty, {name}", seed),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 603, 604])
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    args = parser.parse_args(arguments)
    columns = (
        Column("drive"),
        Column("largest error", "mm", 1),
        Column("NEES", "", 1),
        Column("error over sigma, largest", "", 1),
        Column("largest while tracking", "", 1),
        Column("states"),
        Column("rig refused"),
    )
    table = ResultTable("honesty", "Errors over their sigma", columns, REMARKS)
    for name in args.only:
        for seed in args.seeds:
            measure(name, seed, table)


if __name__ == "__main__":
    main()
