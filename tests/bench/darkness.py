"""Darkness with wheels and gyro: `python -m tests.bench.darkness FOLDER ... [--start S] [--seconds S] [--without]`.

The images of a rendered log are black for some seconds; samples of wheels and gyro, with errors that omnid does not
know, are made from the true poses. Printed are the true motion and the error of the pose over the dark time.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.logs.log_reader import LogReader
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.core.rig.rig_health import RigHealth
from omnid.formats.tum import read_tum
from omnid.messages import OdometryUpdate
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry, with_rims
from omnid.stages.odometry import OdometryStage
from omnid.stages.synchronise import Synchronise
from tests.bench.accuracy import rig_of
from tests.bench.results import Column, ResultTable
from tests.simulation.motion_samples import SensorErrors, motion_samples

ERRORS = SensorErrors(
    distance=1.03, turn=0.95, wheel_offset_s=0.015, gyro_offset_s=-0.01, bias_radps=(0.01, -0.006, 0.015)
)
SENSED_SEED = 7


class DarkDrive(NamedTuple):
    """Poses of a drive of which a part is dark."""

    poses: list[OdometryUpdate]
    dark: list[bool]  # of each pose's pair
    stage: OdometryStage


def dark_drive(folder: Path, dark_s: tuple[float, float], errors: SensorErrors | None) -> DarkDrive:
    """Run a log whose images are black from one time to another [s]; errors: of the sensors, None without them."""
    config, rig, truth = Config(), rig_of(folder), read_tum(folder / "truth.txt")
    reader = LogReader(folder / "log.mcap")
    rig = with_rims(rig, reader.frames())
    shape = geometry(rig, config.panorama)
    T_base_rig = rig.T_base_rig
    samples: list[MotionSample] = (
        []
        if errors is None
        else motion_samples(truth.stamps_ns, T_base_rig @ truth.T @ se3.inverse(T_base_rig), errors, SENSED_SEED)
    )
    pairing, front_end = Synchronise(rig, config.pair), FrontEnd(shape, config, RigHealth(shape.cylinder, "off"))
    drive = DarkDrive([], [], front_end.odometry)
    start_ns, given = int(truth.stamps_ns[0]), 0
    for frame in reader.frames():
        while given < len(samples) and samples[given].stamp_ns <= frame.stamp_ns + 20_000_000:
            pairing.process(samples[given])
            given += 1
        pair = pairing.process(frame)
        if pair is None:
            continue
        dark = dark_s[0] <= (pair.stamp_ns - start_ns) * 1e-9 < dark_s[1]
        if dark:
            noise = np.random.default_rng(pair.seq).integers(0, 4, (2, *pair.lower.shape)).astype(np.uint8)
            pair = replace(pair, lower=noise[0], upper=noise[1])
        drive.poses.append(front_end.process(pair))
        drive.dark.append(dark)
    return drive


class DarkResult(NamedTuple):
    """Error over the dark time, against the true motion."""

    driven_m: float
    turned_rad: float
    error_m: float  # of the last dark pose
    heading_rad: float
    sigmas: float  # of the error of the position, by the covariance
    after_m: float  # of the first pose after it
    states: dict[str, int]  # of the dark poses


def dark_result(drive: DarkDrive, T_odom_rig: NDArray[np.float64]) -> DarkResult:
    """Compare with the true poses (N, 4, 4) of all pairs."""
    dark = np.flatnonzero(drive.dark)
    first, last = int(dark[0]) - 1, int(dark[-1])

    def error(index: int) -> NDArray[np.float64]:
        found = se3.inverse(drive.poses[first].T_odom_rig) @ drive.poses[index].T_odom_rig
        true = se3.inverse(T_odom_rig[first]) @ T_odom_rig[index]
        return se3.inverse(true) @ found

    steps = T_odom_rig[first : last + 1]
    states = [drive.poses[int(index)].state.value for index in dark]
    covariance = drive.poses[last].covariance[:3, :3]
    wrong = drive.poses[last].T_odom_rig[:3, 3] - (se3.inverse(T_odom_rig[0]) @ T_odom_rig[last])[:3, 3]
    after = min(last + 1, len(drive.poses) - 1)
    return DarkResult(
        float(np.linalg.norm(np.diff(steps[:, :3, 3], axis=0), axis=1).sum()),
        float(np.abs([se3.yaw(se3.inverse(a) @ b) for a, b in pairwise(steps)]).sum()),
        float(np.linalg.norm(error(last)[:3, 3])),
        abs(float(se3.yaw(error(last)))),
        math.sqrt(float(wrong @ np.linalg.solve(covariance, wrong)) / 3),
        float(np.linalg.norm(error(after)[:3, 3])),
        {state: states.count(state) for state in dict.fromkeys(states)},
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--start", type=float, default=4.0, help="start of the darkness, s")
    parser.add_argument("--seconds", type=float, default=3.0, help="its length, s")
    parser.add_argument("--without", action="store_true", help="no sensors")
    args = parser.parse_args(arguments)
    columns = (
        Column("log"),
        Column("dark", "s", 1),
        Column("driven", "m", 2),
        Column("turned", "deg", 0),
        Column("error at its end", "mm", 1),
        Column("goal: 2 cm + 1 %", "mm", 0),
        Column("heading", "deg", 2),
        Column("error over sigma", "", 1),
        Column("after it", "mm", 1),
        Column("states"),
    )
    sensors = "no sensors" if args.without else "with wheels and gyro"
    table = ResultTable("darkness", f"Darkness {sensors}", columns)
    for folder in args.folders:
        drive = dark_drive(folder, (args.start, args.start + args.seconds), None if args.without else ERRORS)
        found = dark_result(drive, read_tum(folder / "truth.txt").T)
        table.add(
            folder.name,
            args.seconds,
            found.driven_m,
            math.degrees(found.turned_rad),
            1e3 * found.error_m,
            1e3 * (0.02 + 0.01 * found.driven_m),
            math.degrees(found.heading_rad),
            found.sigmas,
            1e3 * found.after_m,
            ", ".join(f"{state} {count}" for state, count in found.states.items()),
            folder=folder,
        )


if __name__ == "__main__":
    main()
