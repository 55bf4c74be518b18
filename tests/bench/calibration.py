"""Rigs by boards and by drives, against the truth: `python -m tests.bench.calibration chain|check|real`.

Every seed is another rig of ray-traced mirrors (tests/simulation/rigs.py): cameras tilted by 0.7 degrees below mirrors
that are up to 1.5 % off shape.

chain: 24 pairs of images of a board, `omnid calibrate rig` with all defaults, and a drive of 5 m with a turn of 94
degrees. Images and logs that are in --folder already are used again. --drives: the rig of the boards is also calibrated
by a round through a room and tried on the same drive. --amount: part of tilt and shape; 0: perfect mirrors. --bend-mm,
--stretch: the board is not as drawn. Wanted: 0.1 % of the length on 10 of 10 rigs, and errors near their stated sigma.

check: what `omnid calibrate drive --only check` says of right rigs, whose upper camera is turned by nothing, by drives
of 5 m in a corridor.

real: the rig of real boards, with a published baseline of 110.0 to 110.1 mm (../shared/data/euroc_boards).
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

import omnid
from calib import se3
from calib.boards.board import AS_DRAWN, AprilGrid, Board, PrintShape
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.rig import Rig
from calib.rig_file import read_rig
from omnid.calibration.images import BY_NAME
from omnid.calibration.rig_check import check_log
from omnid.cli import main as omnid_main
from omnid.core.rig.rig_health import RigState
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.ray_caster import Sensor
from tests.bench.results import ResultTable, columns, run
from tests.simulation import corridor, paths
from tests.simulation.boards import BoardRenderer, board_poses_around_rig
from tests.simulation.disturbances import jpeg
from tests.simulation.logs import write_log
from tests.simulation.recipes import build, mild_rig
from tests.simulation.rigs import with_real_mirrors

FAMILY = "rigs of boards"
BOARD = Board(9, 6, 0.05)
SENSOR = Sensor(noise_sigma=2.0)
SIZE, PAIRS, DRIVE, ROOM = 768, 24, "two_walls", "rooms"
DISTANCE_M = (0.3, 0.7)


def board_rig(seed: int, amount: float) -> tuple[Rig, Rig]:
    """Return the rig of a seed with ray-traced mirrors, and the same one with perfect mirrors."""
    perfect = mild_rig(seed, SIZE)
    return (with_real_mirrors(perfect, seed, amount) if amount else perfect), perfect


def render_boards(seed: int, amount: float, folder: Path, shape: PrintShape = AS_DRAWN) -> None:
    """Write pairs of images of a board of that shape as lower_*.jpg, upper_*.jpg, unless they are there."""
    if (folder / "rendered").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    rig, perfect = board_rig(seed, amount)
    sides = (("lower", rig.lower), ("upper", rig.upper))
    renderers = {name: BoardRenderer(BOARD, mounted, shape) for name, mounted in sides}
    for k, T in enumerate(board_poses_around_rig(perfect, BOARD, PAIRS, seed=seed, distance_m=DISTANCE_M)):
        made = {name: one.render_board(T, seed=1000 * seed + k, sensor=SENSOR) for name, one in renderers.items()}
        for name, _ in sides:
            (folder / f"{name}_{k:02d}.jpg").write_bytes(jpeg(made[name].image))
    (folder / "rendered").touch()


def render_drive(name: str, seed: int, amount: float, folder: Path) -> None:
    """Write the log of a drive of the rig, by the recipe of that name."""
    if not (folder / "log.mcap").exists():
        run = build(name, seed, SIZE)
        write_log(folder, board_rig(seed, amount)[0], run.poses, run.scene, sensor=run.sensor, seed=seed)


def calibrate(folder: Path, output: Path) -> Rig:
    """Return the rig that `omnid calibrate rig` makes of the images of a folder, and print its line."""
    board = ["--corners", f"{BOARD.columns}x{BOARD.rows}", "--square-mm", f"{1e3 * BOARD.square_m:g}"]
    words = ["calibrate", "rig", str(folder), *board, "--view", "mirror", "--quiet", "--replace", "-o", str(output)]
    with contextlib.redirect_stdout(sys.stderr):
        code = omnid_main(words)
    if code != 0:
        raise SystemExit(f"{folder}: calibrate ended with code {code}")
    return read_rig(output)


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


def chain(
    *,
    seeds: Sequence[int] = (3, 4),
    folder: Path = Path("build/chain"),
    amount: float = 1.0,
    drives: bool = False,
    bend_mm: float = 0.0,
    stretch: float = 0.0,
) -> None:
    """Measure rigs of boards, and of drives, on a drive."""
    head = columns(
        *("seed", "calibrated by", "baseline|%|3", "length|%|3", "ATE|mm|2", "heading, max|deg|3"),
        *("stated sigma of the length|%|3", "time|s|1"),
    )
    table = ResultTable("calibration_chain", "Boards, rig, drive", head)
    shape = PrintShape((1e-3 * bend_mm, 0.0, 0.0, stretch))
    for seed in seeds:
        truth = board_rig(seed, amount)[0]
        log, room = (folder / f"{kind}_a{amount:g}_s{seed}" for kind in ("drive", ROOM))
        boards = folder / f"boards_a{amount:g}_s{seed}_b{bend_mm:g}_{stretch:g}"
        render_boards(seed, amount, boards, shape)
        render_drive(DRIVE, seed, amount, log)
        begin_s = time.monotonic()
        found = {"boards": (calibrate(boards, boards / "rig.toml"), time.monotonic() - begin_s)}
        if drives:
            render_drive(ROOM, seed, amount, room)
            begin_s = time.monotonic()
            again = omnid.calibrate_drive(room / "log.mcap", found["boards"][0]).rig
            found["boards, then a drive"] = again, time.monotonic() - begin_s
        for name, (rig, spent_s) in found.items():
            sigma, errors = drive_uncertainty(rig), drive(log, in_true_frame(rig, truth))
            baseline, stated = 100 * (rig.baseline_m / truth.baseline_m - 1), 100 * sigma.scale if sigma else None
            table.add(seed, name, baseline, *errors, stated, spent_s, seed=(FAMILY, seed))


def check(*, seeds: Sequence[int] = (3, 4)) -> None:
    """Check right rigs."""
    head = columns("seed", "state", "angle|deg|3", "error over sigma||2")
    table = ResultTable("calibration_check", "Right rigs by their check", head)
    for seed in seeds:
        rig = mild_rig(seed, SIZE // 2)
        with TemporaryDirectory() as folder:
            write_log(Path(folder), rig, paths.spline_path(seed, 12, 0.4), corridor(seed, 13.0), seed=seed)
            finding = check_log(Path(folder) / "log.mcap", rig, BY_NAME).finding
        drift, ratio = finding.drift, math.nan
        if drift is not None:
            ratio = math.sqrt(drift.turn @ np.linalg.solve(drift.covariance[:3, :3], drift.turn) / 3)
        fits = "fits" if finding.state is RigState.FITS else f"WRONG: {finding.state}"
        table.add(seed, fits, finding.turn_deg, ratio, seed=("right rigs", seed))


def real(*, folder: Path = Path("../shared/data/euroc_boards")) -> None:
    """Calibrate the real rig."""
    print(omnid.calibrate_rig(folder, AprilGrid(6, 6, 0.088, 0.3), view="direct"))


if __name__ == "__main__":
    cv2.setNumThreads(1)
    run(chain, check, real)
