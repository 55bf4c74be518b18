"""Rigs by boards and by drives, against the truth: `python -m tests.bench.calibration chain|sigmas|check|real`.

Every seed is another rig of ray-traced mirrors (tests/simulation/rigs.py): cameras tilted by 0.7 degrees below mirrors
that are up to 1.5 % off shape.

chain: 24 pairs of images of a board, `omnid calibrate rig` with all defaults, and a drive of 5 m with a turn of 94
degrees. Images and logs that are in --folder already are used again. --drives: the rig of the boards is also calibrated
by a round through a room and tried on the same drive. --bend-mm, --stretch: the board is not as drawn. Wanted: 0.1 % of
the length on 10 of 10 rigs.

sigmas: errors of lengths and headings of a short drive among walls, as a fraction of their stated standard deviations.
The corners are projected by the true mirrors, with normal noise, and fitted as `omnid calibrate rig` does by default.

check: what `omnid calibrate drive --only check` says of right rigs, whose upper camera is turned by nothing.

real: the rig of real boards, with a published baseline of 110.0 to 110.1 mm (../shared/data/euroc_boards).
"""

from __future__ import annotations

import argparse
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
from calib.boards.aprilgrid import AprilGrid
from calib.boards.board import AS_DRAWN, Board, BoardView, PrintShape
from calib.fit.boards.rig_fit import PairView, RigCalibration, calibrate_boards, rig_covariance
from calib.fit.rig_uncertainty import AZIMUTHS, SLOPES, WALLS_M, drive_uncertainty
from calib.models.camera import Array
from calib.models.ocam import project_near
from calib.rig import Rig, rig_between
from calib.rig_file import read_rig, write_rig
from omnid.calibration.images import BY_NAME
from omnid.calibration.rig_check import check_log
from omnid.cli import main as omnid_main
from omnid.core.rig.column_finding import RigState
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from tests.bench.results import Column, ResultTable
from tests.simulation import corridor, paths
from tests.simulation.boards import BoardRenderer, board_poses_around_rig
from tests.simulation.logs import write_log
from tests.simulation.recipes import build, mild_rig
from tests.simulation.rigs import with_real_mirrors

FAMILY = "rigs of boards"
BOARD = Board(9, 6, 0.05)
SENSOR = Sensor(noise_sigma=2.0)
SIZE, PAIRS, DRIVE, ROOM = 768, 24, "two_walls", "rooms"
DISTANCE_M = (0.3, 0.7)
# Pairs that the hint of `calibrate rig` asks for (--high): where the upper image is near its rim.
HIGH_SEED, HIGH_DISTANCE_M, HIGH_ELEVATION_DEG = 5000, (0.6, 0.8), (100.0, 125.0)
# Standard deviation of the corners that the board finder has in these images.
NOISE_PX = 0.015
# The drive of the sigmas: its length, directions, and Gauss-Newton steps of each point and pose.
STEP_M, DIRECTIONS, ITERATIONS = 0.1, 4, 8
RINGS, RING_PIXELS = (0.35, 0.6, 0.85), 72


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


def render_boards(seed: int, amount: float, folder: Path, high: int = 0, shape: PrintShape = AS_DRAWN) -> None:
    """Write pairs of images of a board of that shape as lower_*.jpg, upper_*.jpg, unless they are there."""
    if (folder / "rendered").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    rig, perfect = board_rig(seed, amount)
    sides = (("lower", rig.lower), ("upper", rig.upper))
    renderers = {name: BoardRenderer(BOARD, mounted, shape) for name, mounted in sides}
    for k, T in enumerate(board_poses(perfect, seed, high)):
        made = {name: one.render_board(T, seed=1000 * seed + k, sensor=SENSOR) for name, one in renderers.items()}
        for name, mounted in sides:
            jpeg = MountedSensor.of(SENSOR, mounted.visible, mounted.camera.size).jpeg(made[name].image)
            (folder / f"{name}_{k:02d}.jpg").write_bytes(jpeg)
    (folder / "rendered").touch()


def render_drive(name: str, seed: int, amount: float, folder: Path) -> None:
    """Write the log of a drive of the rig, by the recipe of that name."""
    if not (folder / "log.mcap").exists():
        run = build(name, seed, SIZE)
        write_log(folder, board_rig(seed, amount)[0], run.poses, run.scene, sensor=run.sensor, seed=seed)


def calibrate(folder: Path, output: Path, options: Sequence[str] = ()) -> Rig:
    """Return the rig that `omnid calibrate rig` makes of the images of a folder, and print its line."""
    board = ["--corners", f"{BOARD.columns}x{BOARD.rows}", "--square-mm", f"{1e3 * BOARD.square_m:g}"]
    words = ["calibrate", "rig", str(folder), *board, "--view", "mirror", "--quiet", "-o", str(output), *options]
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


def projected_views(
    rig: Rig, perfect: Rig, board: Board, pairs: int, noise_px: float, *, seed: int, noise_seed: Sequence[int]
) -> list[PairView]:
    """Return the corners of boards around a perfect rig by the cameras of another one."""
    rng, views = np.random.default_rng(noise_seed), []
    for k, T in enumerate(board_poses_around_rig(perfect, board, pairs, seed=seed, distance_m=DISTANCE_M)):
        sides = []
        for mounted in (rig.lower, rig.upper):
            pixels = mounted.camera.project(se3.apply(mounted.T_cam_rig @ T, board.points))
            sides.append(BoardView(f"{k:02d}", pixels + rng.normal(0, noise_px, pixels.shape), 1.0))
        views.append(PairView(f"{k:02d}", (sides[0], sides[1])))
    return views


def mounted_rig(found: RigCalibration) -> Rig:
    """Return the rig of a calibration, with its covariance."""
    rig = rig_between(found.cameras[0], found.cameras[1], se3.inverse(found.T_upper_lower))
    return replace(rig, covariance=rig_covariance(found, rig))


def drive_errors(rig: Rig, truth: Rig) -> Array:
    """Return the rms over directions of the errors of a drive's length (relative) and heading [rad/m]."""
    T_rig_rect, T_true_rect = se3.inverse(rig.T_rect_rig), se3.inverse(truth.T_rect_rig)
    azimuth, slope, distance = (
        part.ravel() for part in np.meshgrid(2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS, SLOPES, WALLS_M)
    )
    points = distance[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth), slope])
    start = _pixels(truth, se3.apply(T_true_rect, points))
    seen = np.isfinite(start).all(axis=1)
    for mounted, pixels in zip((truth.lower, truth.upper), np.split(np.nan_to_num(start), 2, axis=1), strict=True):
        seen &= np.asarray(mounted.visible.contains(pixels))
    points, start, squares = points[seen], start[seen], np.zeros(2)
    # The rectified frames of both rigs differ by a rotation about z above all.
    T_start = T_rig_rect @ _between_frames(rig, truth)
    triangulated = se3.apply(T_start, points)
    for _ in range(ITERATIONS):
        triangulated = triangulated + _point_steps(rig, triangulated, start)
    for azimuth_rad in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        move = STEP_M * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
        end = _pixels(truth, se3.apply(T_true_rect, points - move))
        T = se3.transform(np.eye(3), -T_start[:3, :3] @ move)
        for _ in range(ITERATIONS):
            T = se3.exp(_pose_step(rig, se3.apply(T, triangulated), end)) @ T
        back = se3.inverse(T)
        length = float(np.linalg.norm(back[:3, 3]))
        heading = float((rig.T_rect_rig[:3, :3] @ se3.rotation_log(back[:3, :3]))[2])
        squares += np.array([length / STEP_M - 1, heading / STEP_M]) ** 2 / DIRECTIONS
    return np.sqrt(squares)


def _between_frames(rig: Rig, truth: Rig) -> Array:
    """Return the rotation (4, 4) from the true rectified frame to the one of a rig, by the lower camera's rays."""
    (u, v), radius = truth.lower.visible.center, truth.lower.visible.outer_px
    angle = np.repeat(2 * np.pi * np.arange(RING_PIXELS) / RING_PIXELS, len(RINGS))
    part = radius * np.tile(RINGS, RING_PIXELS)
    pixels = np.column_stack([u + part * np.cos(angle), v + part * np.sin(angle)])
    rays = [
        one.lower.camera.lift(pixels) @ (one.T_rect_rig[:3, :3] @ one.lower.T_cam_rig[:3, :3].T).T
        for one in (rig, truth)
    ]
    return se3.transform(_rotation(rays[1], rays[0]), np.zeros(3))


def _rotation(first: Array, second: Array) -> Array:
    """Return the rotation (3, 3) that maps unit vectors (N, 3) nearest to others."""
    left, _, right = np.linalg.svd(second.T @ first)
    return np.asarray(left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right)


def _pixels(rig: Rig, in_rig: Array) -> Array:
    """Return the pixels (N, 4) of points (N, 3) at their own distances."""
    return np.column_stack(
        [project_near(mounted.camera, se3.apply(mounted.T_cam_rig, in_rig)) for mounted in (rig.lower, rig.upper)]
    )


def _by_point(rig: Rig, points: Array) -> Array:
    step = 1e-5 * np.eye(3)
    return np.stack([(_pixels(rig, points + one) - _pixels(rig, points - one)) / 2e-5 for one in step], axis=-1)


def _point_steps(rig: Rig, points: Array, pixels: Array) -> Array:
    return np.einsum("nij,nj->ni", np.linalg.pinv(_by_point(rig, points)), pixels - _pixels(rig, points))


def _pose_step(rig: Rig, points: Array, pixels: Array) -> Array:
    by_point = _by_point(rig, points)
    J = np.concatenate([by_point, -by_point @ se3.hat(points)], axis=2).reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(J, (pixels - _pixels(rig, points)).ravel(), rcond=None)[0])


def chain(args: argparse.Namespace) -> None:
    """Measure rigs of boards, and of drives, on a drive."""
    columns = (
        Column("seed"),
        Column("calibrated by"),
        Column("baseline", "%", 3),
        Column("length", "%", 3),
        Column("ATE", "mm", 2),
        Column("heading, max", "deg", 3),
        Column("stated sigma of the length", "%", 3),
        Column("time", "s", 1),
    )
    table = ResultTable("calibration_chain", "Boards, rig, drive", columns)
    shape = PrintShape((1e-3 * args.bend_mm, 0.0, 0.0, args.stretch))
    options = [part for word in args.options for part in ("--" + word).split("=")]
    for seed in args.seeds:
        truth = board_rig(seed, args.amount)[0]
        log, room = (args.folder / f"{kind}_a{args.amount:g}_s{seed}" for kind in ("drive", ROOM))
        boards = args.folder / f"boards_a{args.amount:g}_s{seed}_h{args.high}_b{args.bend_mm:g}_{args.stretch:g}"
        render_boards(seed, args.amount, boards, args.high, shape)
        render_drive(DRIVE, seed, args.amount, log)

        def row(name: str, found: Rig, begin_s: float, seed: int = seed, truth: Rig = truth, log: Path = log) -> None:
            spent_s = time.monotonic() - begin_s
            sigma = drive_uncertainty(found)
            errors = drive(log, in_true_frame(found, truth))
            baseline = 100 * (found.baseline_m / truth.baseline_m - 1)
            table.add(seed, name, baseline, *errors, 100 * sigma.scale if sigma else None, spent_s, seed=(FAMILY, seed))

        begin_s = time.monotonic()
        found = calibrate(boards, boards / "rig.toml", options)
        row("boards", found, begin_s)
        if args.drives:
            render_drive(ROOM, seed, args.amount, room)
            begin_s = time.monotonic()
            again = omnid.calibrate_drive([room / "log.mcap"], found).rig
            write_rig(boards / "rig_drive.toml", again)
            row("boards, then a drive", again, begin_s)


def sigmas(args: argparse.Namespace) -> None:
    """Compare errors of a drive's length and heading with their stated standard deviations."""
    columns = (Column("quantity"), Column("rms", "", 2), Column("errors over sigma"))
    table, found = ResultTable("calibration_sigmas", "Errors over stated sigmas of boards", columns), []
    for seed in args.seeds:
        truth, perfect = board_rig(seed, args.amount)
        views = projected_views(truth, perfect, BOARD, PAIRS, NOISE_PX, seed=seed, noise_seed=[seed, 17])
        rig = mounted_rig(calibrate_boards(views, BOARD, [truth.lower.camera.size] * 2))
        stated = drive_uncertainty(rig)
        assert stated is not None
        found.append(drive_errors(rig, truth) / (stated.scale, stated.heading_rad_m))
        print(f"seed {seed}: {stated}: {found[-1]}", file=sys.stderr, flush=True)
    table.seeds = [(FAMILY, seed) for seed in args.seeds]
    for name, ratios in zip(("length", "heading"), np.array(found).T, strict=True):
        table.add(name, np.sqrt((ratios**2).mean()), " ".join(f"{ratio:.2f}" for ratio in ratios))


def check(args: argparse.Namespace) -> None:
    """Check right rigs by drives of 5 m in a corridor, 12 pairs."""
    columns = (Column("seed"), Column("state"), Column("angle", "deg", 3), Column("error over sigma", "", 2))
    table = ResultTable("calibration_check", "Right rigs by their check", columns)
    for seed in args.seeds:
        rig = mild_rig(seed, SIZE // 2)
        with TemporaryDirectory() as folder:
            write_log(Path(folder), rig, paths.spline_path(seed, 12, 0.4), corridor(seed, 13.0), seed=seed)
            finding = check_log(Path(folder) / "log.mcap", rig, BY_NAME)[0].finding
        drift, ratio = finding.drift, math.nan
        if drift is not None:
            ratio = math.sqrt(drift.turn @ np.linalg.solve(drift.covariance[:3, :3], drift.turn) / 3)
        fits = "fits" if finding.state is RigState.FITS else f"WRONG: {finding.state}"
        table.add(seed, fits, finding.turn_deg, ratio, seed=("right rigs", seed))


def real(args: argparse.Namespace) -> None:
    """Calibrate the real rig."""
    found = omnid.calibrate_rig(args.folder, AprilGrid(6, 6, 0.088, 0.3), view="direct")
    print(found)


def main(arguments: Sequence[str]) -> int:
    """Print the tables."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.calibration",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("part", choices=("chain", "sigmas", "check", "real"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 4])
    parser.add_argument("--folder", type=Path, default=Path("../shared/data/euroc_boards"), help="of images and logs")
    parser.add_argument("--amount", type=float, default=1.0, help="part of tilt and shape; 0: perfect mirrors")
    parser.add_argument("--drives", action="store_true", help="chain: calibrate by a drive as well")
    parser.add_argument("--high", type=int, default=0, help="chain: further pairs in the outer part of the images")
    parser.add_argument("--bend-mm", type=float, default=0.0, help="chain: bend of the board")
    parser.add_argument("--stretch", type=float, default=0.0, help="chain: by which its x is longer, like 0.002")
    parser.add_argument("--options", nargs="*", default=[], help="chain: words for `calibrate rig`, like view=mirror")
    args = parser.parse_args(arguments)
    {"chain": chain, "sigmas": sigmas, "check": check, "real": real}[args.part](args)
    return 0


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main(sys.argv[1:]))
