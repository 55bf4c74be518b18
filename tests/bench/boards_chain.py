"""Boards, rig, drive: rendered rigs of real mirrors from the calibration to the drive's error.

`python -m tests.bench.boards_chain --seeds 1 2 --folder DIR`: for every seed another rig (tests/simulation/rigs.py:
cameras tilted by 0.7 degrees below ray-traced mirrors, up to 1.5 % off shape), 24 pairs of images of a board, `omnid
calibrate rig` with all defaults, and a drive of 5 m with a large turn. Images and logs that are in DIR already are used
again. --drives: the rig of the boards is also self-calibrated, on a round through a room, with the covariance of the
boards as prior, and tried on the same drive.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import omnid
from calib import se3
from calib.boards.board import Board
from calib.models.camera import Array
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid.calibration.drive import calibrate_drive
from omnid.cli import main as omnid_main
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from tests.bench.results import Column, ResultTable
from tests.simulation.boards import BoardRenderer, board_poses_around_rig
from tests.simulation.logs import write_log
from tests.simulation.recipes import build, mild_rig
from tests.simulation.rigs import with_real_mirrors

BOARD = Board(9, 6, 0.05)
SENSOR = Sensor(noise_sigma=2.0)
SIZE, PAIRS, DRIVE, ROOM = 768, 24, "two_walls", "rooms"
DISTANCE_M = (0.3, 0.7)
# Pairs that the hint of `calibrate rig` asks for (--high): where the upper image is near its rim.
HIGH_SEED, HIGH_DISTANCE_M, HIGH_ELEVATION_DEG = 5000, (0.6, 0.8), (100.0, 125.0)
REMARKS = (
    "24 pairs of a 9x6 board of 50 mm, 768 px, noise 2, JPEG; `calibrate rig` with all defaults; then a drive of 5 m "
    "with a turn of 94 degrees (99 pairs). Real mirrors: ray-traced, up to 1.5 % off shape, cameras tilted by 0.7 "
    "degrees below them. Wanted: 0.1 % of the length on 10 of 10 rigs of each.",
)


def board_rig(seed: int, amount: float) -> tuple[Rig, Rig]:
    """Return the rig of a seed with ray-traced mirrors, and the same one with perfect mirrors."""
    perfect = mild_rig(seed, SIZE)
    return (with_real_mirrors(perfect, seed, amount) if amount else perfect), perfect


def board_poses(perfect: Rig, seed: int, high: int) -> list[Array]:
    """Return the poses T_rig_board (4, 4) of the pairs of a seed, and of so many with higher boards."""
    poses = board_poses_around_rig(perfect, BOARD, PAIRS, seed=seed, distance_m=DISTANCE_M)
    if high:
        poses += board_poses_around_rig(
            perfect, BOARD, high, seed=seed + HIGH_SEED, distance_m=HIGH_DISTANCE_M, elevation_deg=HIGH_ELEVATION_DEG
        )
    return poses


def render_boards(seed: int, amount: float, folder: Path, high: int = 0) -> None:
    """Write pairs of images as lower_*.jpg, upper_*.jpg, and the true corners as corners.npy (pairs, 2, N, 2)."""
    if (folder / "corners.npy").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    rig, perfect = board_rig(seed, amount)
    sides = (("lower", rig.lower), ("upper", rig.upper))
    renderers = {name: BoardRenderer(BOARD, mounted) for name, mounted in sides}
    corners = []
    for k, T in enumerate(board_poses(perfect, seed, high)):
        made = {name: one.render_board(T, seed=1000 * seed + k, sensor=SENSOR) for name, one in renderers.items()}
        for name, mounted in sides:
            jpeg = MountedSensor.of(SENSOR, mounted.visible, mounted.camera.size).jpeg(made[name].image)
            (folder / f"{name}_{k:02d}.jpg").write_bytes(jpeg)
        corners.append([made[name].corners for name, _ in sides])
    np.save(folder / "corners.npy", np.array(corners))


def render_drive(name: str, seed: int, amount: float, folder: Path) -> None:
    """Write the log of a drive of the rig, by the recipe of that name."""
    if not (folder / "log.mcap").exists():
        run = build(name, seed, SIZE)
        write_log(folder, board_rig(seed, amount)[0], run.poses, run.scene, sensor=run.sensor, seed=seed)


def calibrate(folder: Path, output: Path, options: Sequence[str] = ()) -> str:
    """Calibrate by the images of a folder, and return the printed line."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        code = omnid_main(
            [
                "calibrate",
                "rig",
                str(folder),
                "--corners",
                f"{BOARD.columns}x{BOARD.rows}",
                "--square-mm",
                f"{1e3 * BOARD.square_m:g}",
                "-o",
                str(output),
                *options,
            ]
        )
    if code != 0:
        raise SystemExit(f"{folder}: calibrate ended with code {code}")
    return text.getvalue().strip()


def sigma(line: str) -> float:
    """Return the standard deviation of the length of drives [%] that a calibration states in its line."""
    found = re.search(r"scale uncertain by ([0-9.e-]+) %", line)
    if found is None:
        raise SystemExit(f"no sigma in: {line}")
    return float(found[1])


def in_true_frame(found: Rig, truth: Rig) -> Rig:
    """Return a calibrated rig in the frame of the true one, by the rays of the lower camera."""
    rng, (u, v) = np.random.default_rng(0), truth.lower.visible.center
    azimuth, part = rng.uniform(0, 2 * np.pi, 2000), np.sqrt(rng.uniform(0.05, 0.9, 2000))
    radius = truth.lower.visible.outer_px * part
    pixels = np.column_stack([u + radius * np.cos(azimuth), v + radius * np.sin(azimuth)])
    rays, true_rays = found.lower.camera.lift(pixels), truth.lower.camera.lift(pixels)
    seen = np.isfinite(rays + true_rays).all(axis=1)
    left, _, right = np.linalg.svd(rays[seen].T @ true_rays[seen])
    T_found_true = se3.transform(left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right, np.zeros(3))
    T_lower_rig = T_found_true @ truth.lower.T_cam_rig
    T_upper_lower = found.upper.T_cam_rig @ se3.inverse(found.lower.T_cam_rig)
    return replace(
        found,
        lower=replace(found.lower, T_cam_rig=T_lower_rig),
        upper=replace(found.upper, T_cam_rig=T_upper_lower @ T_lower_rig),
    )


def drive(folder: Path, rig: Rig) -> tuple[float, float, float]:
    """Return the drive's errors with a rig: length [%], ATE [mm], largest error of the heading [deg]."""
    result = omnid.replay(folder / "log.mcap", rig=rig)
    result.save_tum(folder / "estimate.txt")
    found = evaluate(read_tum(folder / "estimate.txt"), read_tum(folder / "truth.txt"))
    return 100 * found.length_error_ratio, 1e3 * found.ate_rmse_m, math.degrees(found.heading_max_rad)


def main(arguments: Sequence[str]) -> int:
    """Print the lines of every seed."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.boards_chain")
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 4])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--amount", type=float, default=1.0, help="part of tilt and shape; 0: perfect mirrors")
    parser.add_argument("--drives", action="store_true", help="self-calibrate as well")
    parser.add_argument("--high", type=int, default=0, help="further pairs in the outer part of the images")
    parser.add_argument("--only", choices=("boards", "drive"), help="render and stop")
    parser.add_argument("--options", nargs="*", default=[], help="further words for `calibrate rig`, like model=omni")
    args = parser.parse_args(arguments)
    columns = (
        Column("seed"),
        Column("mirrors"),
        Column("calibrated by"),
        Column("length", "%", 3),
        Column("ATE", "mm", 2),
        Column("heading, max", "deg", 3),
        Column("stated sigma of the length", "%", 3),
    )
    table = ResultTable("boards_chain", "Boards, rig, drive", columns, REMARKS)
    suffix = f"_high{args.high}" if args.high else ""
    mirrors = "real" if args.amount else "perfect"
    for seed in args.seeds:
        boards, log = (args.folder / f"{kind}_a{args.amount:g}_s{seed}" for kind in ("boards", "drive"))
        boards = boards.with_name(boards.name + suffix)
        if args.only != "drive":
            render_boards(seed, args.amount, boards, args.high)
        if args.only != "boards":
            render_drive(DRIVE, seed, args.amount, log)
        if args.only:
            continue
        options = [part for word in args.options for part in ("--" + word).split("=")]
        line = calibrate(boards, boards / "rig.toml", options)
        truth = board_rig(seed, args.amount)[0]
        found = in_true_frame(read_rig(boards / "rig.toml"), truth)
        table.add(seed, mirrors, "boards", *drive(log, found), sigma(line), seed=("rigs of boards", seed))
        if args.drives:
            room = args.folder / f"{ROOM}_a{args.amount:g}_s{seed}"
            render_drive(ROOM, seed, args.amount, room)
            again = calibrate_drive([room / "log.mcap"], read_rig(boards / "rig.toml"))
            write_rig(boards / "rig_drive.toml", again.rig)
            errors = drive(log, in_true_frame(again.rig, truth))
            table.add(seed, mirrors, "boards, then a drive", *errors, None, seed=("rigs of boards", seed))
    return 0


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main(sys.argv[1:]))
