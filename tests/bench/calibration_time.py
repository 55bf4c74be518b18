"""Time of `omnid calibrate rig` on rendered pairs of images: `python -m tests.bench.calibration_time`.

The command by all its defaults, as a user runs it, from the prompt to the rig. The rendering does not count.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from calib import se3
from calib.boards.board import Board
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig
from omnid.simulation.rendering.sensor import Sensor
from tests.bench.results import Column, ResultTable
from tests.simulation.boards import BoardRenderer, board_poses_around_rig

SIZE = (1280, 800)
BOARD = Board(7, 6, 0.03)
T_UPPER_LOWER = se3.transform(se3.rotation_exp([0.02, -0.015, 0.3]), [0.004, -0.006, 0.18])
COLUMNS = (Column("pairs"), Column("time", "s", 1), Column("processor time", "s", 1), Column("baseline error", "%", 3))


def rig() -> Rig:
    """Return a rig of two perfect mirrors, the upper one turned about every axis."""
    mounted = []
    for xi, focal, center, T in (
        (0.93, (-213.5, 214.8), (641.3, 398.2), np.eye(4)),
        (0.97, (-216.7, 215.8), (637.6, 403.1), T_UPPER_LOWER),
    ):
        mounted.append(MountedCamera(UnifiedCamera(xi, focal, center, SIZE), T, Mask(center, 52.0, 387.0)))
    return Rig(mounted[0], mounted[1])


def render(folder: Path, pairs: int) -> Rig:
    """Write pairs of images of a board on all sides."""
    truth = rig()
    renderers = {"lower": BoardRenderer(BOARD, truth.lower), "upper": BoardRenderer(BOARD, truth.upper)}
    for seed, T in enumerate(board_poses_around_rig(truth, BOARD, pairs, distance_m=(0.2, 0.42))):
        for name, renderer in renderers.items():
            image = renderer.render_board(T, seed=seed, sensor=Sensor(noise_sigma=1.0)).image
            cv2.imwrite(str(folder / f"{name}_{seed:02d}.png"), image)
    return truth


def used_s() -> float:
    """Return the processor time of the programs that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=34)
    pairs = parser.parse_args().pairs
    table = ResultTable("calibration_time", "Calibration of a rig by all defaults, 1280x800", COLUMNS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = render(folder, pairs)
        before_s, start_s = used_s(), time.monotonic()
        words = [folder, "--corners", "7x6", "--square-mm", 30, "--view", "mirror", "--quiet"]
        words += ["-o", folder / "rig.toml"]
        subprocess.run(
            [sys.executable, "-m", "omnid", "calibrate", "rig", *map(str, words)], check=True, stdout=subprocess.DEVNULL
        )
        taken_s = time.monotonic() - start_s
        error = read_rig(folder / "rig.toml").baseline_m / truth.baseline_m - 1
        table.add(pairs, taken_s, used_s() - before_s, 100 * error)


if __name__ == "__main__":
    main()
