"""Errors of calibrated rigs in parts of their stated standard deviations: `python -m tests.bench.rig_sigmas`.

Every seed is another rig of ray-traced mirrors (tests/simulation/rigs.py) and 24 poses of a board. The corners are
projected by the true mirrors, with normal noise, and the rig is fitted as `omnid calibrate rig` does by default. With
--folder DIR the corners come from the rendered images of tests/bench/boards_chain.py instead.

Compared are quantities that a user notices and that do not depend on the choice of frames and parameters: lengths and
headings of a short drive among walls, the elevation of the rays of fixed pixels, the rotation between the cameras'
rays, and the distance of the points to which the rays of each mirror are nearest.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calib import se3
from calib.boards.board import Board, BoardView
from calib.fit.boards.camera_selection import select_calibration
from calib.fit.boards.rig_covariance import rig_covariance
from calib.fit.boards.rig_fit import RigCalibration
from calib.fit.boards.rig_problem import PairView
from calib.fit.boards.rig_selection import select_rig
from calib.fit.rig_uncertainty import (
    AZIMUTHS,
    SIGMA_STEP,
    SLOPES,
    WALLS_M,
    drive_uncertainty,
    perturbed_rig,
)
from calib.models import wavefront
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import OcamCamera, project_near
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig
from calib.rig_frame import rig_between
from tests.bench.boards_chain import BOARD, DISTANCE_M, PAIRS, board_rig, calibrate, render_boards
from tests.bench.results import Column, ResultTable
from tests.simulation.boards import board_poses_around_rig
from tests.simulation.mirrors import MirrorCamera

# Standard deviation of the corners that the board finder has in the images of boards_chain.
NOISE_PX = 0.015
DRIVE_M, DIRECTIONS, STEPS = 0.1, 4, 8
RINGS, RING_PIXELS = (0.35, 0.6, 0.85), 72
NAMES = (
    "scale",
    "heading",
    *(f"{side} elevation {ring}" for side in ("lower", "upper") for ring in RINGS),
    "rotation x",
    "rotation y",
    "rotation z",
    "baseline",
)


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


def calibrated(views: list[PairView], size: tuple[int, int]) -> RigCalibration:
    """Fit the rig by default, as `omnid calibrate rig` does to the same corners."""
    chosen = [
        select_calibration([view.seen[side] for view in views if view.seen[side] is not None], BOARD, size)
        for side in (0, 1)
    ]
    mirrors = [one.polynomial for one in chosen]
    assert mirrors[0] is not None and mirrors[1] is not None
    cameras = (chosen[0].calibration.camera, chosen[1].calibration.camera)
    return select_rig(views, BOARD, cameras, (mirrors[0], mirrors[1])).calibration


def mounted_rig(found: RigCalibration) -> Rig:
    """Return the rig of a calibration, with its covariance."""
    rig = rig_between(found.lower, found.upper, se3.inverse(found.T_upper_lower))
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
    for _ in range(STEPS):
        triangulated = triangulated + _point_steps(rig, triangulated, start)
    for azimuth_rad in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        move = DRIVE_M * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
        end = _pixels(truth, se3.apply(T_true_rect, points - move))
        T = se3.transform(np.eye(3), -T_start[:3, :3] @ move)
        for _ in range(STEPS):
            T = se3.exp(_pose_step(rig, se3.apply(T, triangulated), end)) @ T
        back = se3.inverse(T)
        length = float(np.linalg.norm(back[:3, 3]))
        heading = float((rig.T_rect_rig[:3, :3] @ se3.rotation_log(back[:3, :3]))[2])
        squares += np.array([length / DRIVE_M - 1, heading / DRIVE_M]) ** 2 / DIRECTIONS
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


def ray_values(rig: Rig, truth: Rig) -> Array:
    """Return elevations of the rings of fixed pixels [rad], the rotation between the cameras [rad], the baseline [m].

    The rotation is that between the rays of both cameras to points of the true rig that are far away: 0 if it is right.
    """
    values = list[float]()
    for mounted, true in ((rig.lower, truth.lower), (rig.upper, truth.upper)):
        values += _ring_elevations(mounted.camera, true)
    azimuth, slope = (part.ravel() for part in np.meshgrid(2 * np.pi * np.arange(32) / 32, SLOPES))
    far = 1e6 * np.column_stack([np.cos(azimuth), np.sin(azimuth), slope])
    rays = []
    for mounted, true in ((rig.lower, truth.lower), (rig.upper, truth.upper)):
        pixels = true.camera.project(far @ true.T_cam_rig[:3, :3].T)
        rays.append(_central(mounted.camera).lift(pixels) @ (rig.T_rect_rig[:3, :3] @ mounted.T_cam_rig[:3, :3].T).T)
    return np.array([*values, *se3.rotation_log(_rotation(rays[0], rays[1])), rig.baseline_m])


def _ring_elevations(camera: OmniCamera, true: MountedCamera) -> list[float]:
    (u, v), outer = true.visible.center, true.visible.outer_px
    angle = 2 * np.pi * np.arange(RING_PIXELS) / RING_PIXELS
    means = [
        _central(camera)
        .lift(np.column_stack([u + outer * ring * np.cos(angle), v + outer * ring * np.sin(angle)]))
        .mean(axis=0)
        for ring in RINGS
    ]
    axis = means[0] / np.linalg.norm(means[0])
    return [float(np.arccos(mean @ axis)) for mean in means]


def _central(camera: OmniCamera) -> OmniCamera:
    """Return the camera with the directions of its rays as if they met in the viewpoint."""
    return replace(camera, wavefront=(0.0,) * wavefront.TERMS) if isinstance(camera, OcamCamera) else camera


def true_baseline_m(truth: Rig) -> float:
    """Return the distance of the mirrors' viewpoints: the points with which wavefronts describe their rays best."""
    points = []
    for mounted in (truth.lower, truth.upper):
        camera = mounted.camera
        if not isinstance(camera, MirrorCamera):
            points.append(mounted.viewpoint)
            continue
        (u, v), outer = mounted.visible.center, mounted.visible.outer_px
        angle, part = np.meshgrid(2 * np.pi * np.arange(48) / 48, np.linspace(0.3, 0.95, 14))
        origin, d = camera.rays(
            np.column_stack([u + outer * (part * np.cos(angle)).ravel(), v + outer * (part * np.sin(angle)).ravel()])
        )
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        terms = [wavefront.offsets(d, tuple(one), 1.0) for one in np.eye(wavefront.TERMS)]
        J = np.concatenate([across, np.stack(terms, axis=-1)], axis=2).reshape(-1, 3 + wavefront.TERMS)
        at = np.linalg.lstsq(J, np.einsum("nij,nj->ni", across, origin).ravel(), rcond=None)[0][:3]
        points.append(se3.apply(se3.inverse(mounted.T_cam_rig), at[None])[0])
    return float(np.linalg.norm(points[1] - points[0]))


def scores(rig: Rig, truth: Rig) -> dict[str, float]:
    """Return errors in parts of their stated standard deviations, by NAMES of quantities."""
    predicted, covariance = drive_uncertainty(rig), rig.covariance
    assert predicted is not None and covariance is not None
    drive = drive_errors(rig, truth) / (predicted.scale, predicted.heading_rad_m)
    steps = np.diag(SIGMA_STEP * covariance.sigmas)
    J = np.stack(
        [
            ray_values(perturbed_rig(rig, covariance.names, step), truth)
            - ray_values(perturbed_rig(rig, covariance.names, -step), truth)
            for step in steps
        ],
        axis=-1,
    )
    sigmas = np.sqrt(np.einsum("ip,pq,iq->i", J, covariance.correlation, J)) / (2 * SIGMA_STEP)
    right = [value for true in (truth.lower, truth.upper) for value in _ring_elevations(true.camera, true)]
    off = ray_values(rig, truth) - [*right, 0.0, 0.0, 0.0, true_baseline_m(truth)]
    return dict(zip(NAMES, [*drive.tolist(), *(off / sigmas).tolist()], strict=True))


def main(arguments: Sequence[str]) -> int:
    """Print a line for each rig, and the rms over all of them."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.rig_sigmas")
    parser.add_argument("--seeds", type=int, nargs="+", default=[*range(21, 41)])
    parser.add_argument("--amount", type=float, default=1.0, help="part of tilt and shape; 0: perfect mirrors")
    parser.add_argument("--noise-px", type=float, default=NOISE_PX)
    parser.add_argument("--folder", type=Path, help="rendered images, with names as those of boards_chain")
    args, found = parser.parse_args(arguments), list[dict[str, float]]()
    for seed in args.seeds:
        truth, perfect = board_rig(seed, args.amount)
        if args.folder is None:
            views = projected_views(truth, perfect, BOARD, PAIRS, args.noise_px, seed=seed, noise_seed=[seed, 17])
            calibration = calibrated(views, truth.lower.camera.size)
            rig, line = mounted_rig(calibration), f"{calibration.fit.mean_px:.4f} px"
        else:
            boards = args.folder / f"boards_a{args.amount:g}_s{seed}"
            render_boards(seed, args.amount, boards)
            line = calibrate(boards, boards / "rig_sigmas.toml").split(": ", 1)[1]
            rig = read_rig(boards / "rig_sigmas.toml")
        found.append(scores(rig, truth))
        words = " ".join(f"{value:+.2f}" for value in found[-1].values())
        print(f"seed {seed}, {type(rig.lower.camera).__name__}, {line}, {drive_uncertainty(rig)}: {words}", flush=True)
    noise = f"corners with noise of {args.noise_px:g} px" if args.folder is None else "rendered images"
    table = ResultTable(
        "rig_sigmas",
        f"Errors over stated standard deviations of boards, {noise}",
        (Column("quantity"), Column("rms", "", 2), Column("mean", "", 2)),
    )
    table.seeds = [("rigs of boards", seed) for seed in args.seeds]
    for name in NAMES:
        values = np.array([one[name] for one in found])
        table.add(name, np.sqrt((values**2).mean()), values.mean())
    return 0


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main(sys.argv[1:]))
