"""Rigs calibrated from rendered boards, against ground truth: `python -m tests.bench.boards_truth [--seeds 1 2]`.

Every seed is another rig: mirrors of xi 0.75 to 1; focal lengths, centres, baseline and rotation are random. Errors are
also printed in parts of their stated standard deviation.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from calib import se3
from calib.boards.board import Board
from calib.fit.boards.camera_fit import fit_camera, refine_camera_calibration
from calib.fit.boards.rig_fit import RigCalibration, fit_rig, refine_rig_calibration
from calib.fit.boards.rig_problem import PairView
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from omnid.calibration.board_search import find_boards
from omnid.calibration.images import PairedImages, read_pairs
from omnid.simulation.rendering.sensor import Sensor
from tests.simulation.boards import BoardRenderer, board_poses_around_rig

BOARD = Board(7, 6, 0.03)
LIMITS = {"focal_percent": 0.05, "centre_px": 0.1, "turn_deg": 0.02, "baseline_mm": 0.3}


def random_rig(seed: int, size: int) -> Rig:
    """Return a rig of two different mirror cameras, the upper one rotated and shifted."""
    rng, mounted = np.random.default_rng([seed, 5]), []
    T_upper_lower = se3.transform(
        se3.rotation_exp([*rng.uniform(-0.03, 0.03, 2), rng.uniform(-0.5, 0.5)]),
        [*rng.uniform(-0.006, 0.006, 2), rng.uniform(0.13, 0.22)],
    )
    for T in (np.eye(4), T_upper_lower):
        xi, focal = rng.uniform(0.75, 1.0), rng.uniform(0.25, 0.28) * size
        u, v = (size - 1) / 2 + rng.uniform(-0.01, 0.01, 2) * size
        camera = UnifiedCamera(xi, (-focal * xi, focal * xi * rng.uniform(0.995, 1.005)), (u, v), (size, size))
        mounted.append(MountedCamera(camera, T, Mask((u, v), 0.065 * size, 0.485 * size)))
    return Rig(mounted[0], mounted[1])


def render_pairs(rig: Rig, folder: Path, seed: int, pairs: int) -> PairedImages:
    """Render images of a board on all sides of a rig."""
    renderers = {"lower": BoardRenderer(BOARD, rig.lower), "upper": BoardRenderer(BOARD, rig.upper)}
    for k, T in enumerate(board_poses_around_rig(rig, BOARD, pairs, seed=seed, distance_m=(0.2, 0.42))):
        for name, renderer in renderers.items():
            rendered = renderer.render_board(T, seed=1000 * seed + k, sensor=Sensor(noise_sigma=1.0))
            cv2.imwrite(str(folder / f"{name}_{k:02d}.png"), rendered.image)
    return read_pairs(folder)


def calibrated(images: PairedImages) -> RigCalibration:
    """Calibrate a rig like `omnid calibrate rig --model omni`."""
    seen, cameras = [], []
    for side in images.sides:
        views = find_boards(side, BOARD, thorough=True)
        height, width = next(iter(side.values())).shape
        first = fit_camera(views, BOARD, (width, height), "omni")
        cameras.append(refine_camera_calibration(first, side, "omni", "mirror").camera)
        seen.append({view.name: view for view in views})
    pairs = [PairView(name, (seen[0].get(name), seen[1].get(name))) for name in images.names]
    found = fit_rig([view for view in pairs if any(view.seen)], BOARD, (cameras[0], cameras[1]))
    return refine_rig_calibration(found, images.sides)


def errors(found: RigCalibration, truth: Rig) -> dict[str, tuple[float, float]]:
    """Return errors in the units of LIMITS, and the largest in parts of its stated standard deviation."""
    T = truth.upper.T_cam_rig
    motion = se3.log(found.T_upper_lower @ se3.inverse(T))
    baseline_m = float(np.linalg.norm(se3.inverse(T)[:3, 3]))
    focal, centre = [], []
    for camera, mounted, values in zip(
        (found.lower, found.upper), (truth.lower, truth.upper), found.parameters, strict=True
    ):
        assert isinstance(camera, UnifiedCamera) and isinstance(mounted.camera, UnifiedCamera)
        sigma = {name: value_sigma for name, _, value_sigma in values}
        focal += _scale(camera, mounted.camera, sigma["fu"])
        centre += [
            (abs(a - b), abs(a - b) / sigma[name])
            for a, b, name in zip(camera.center, mounted.camera.center, ("pu", "pv"), strict=True)
        ]
    turn_deg = float(np.rad2deg(np.linalg.norm(motion[3:])))
    off_m = abs(found.baseline_m - baseline_m)
    return {
        "focal_percent": max(focal),
        "centre_px": max(centre),
        "turn_deg": (turn_deg, float(np.abs(motion[3:] / found.motion_sigma[3:]).max())),
        "baseline_mm": (1e3 * off_m, off_m / found.baseline_sigma_m),
    }


def _scale(camera: UnifiedCamera, truth: UnifiedCamera, sigma_px: float) -> list[tuple[float, float]]:
    """Return the scale error at the horizon [%], and in sigmas: fu and xi alone are strongly correlated."""
    at: list[Array] = [
        one.project(np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])) for one in (camera, truth)
    ]
    sizes = [np.array([np.ptp(p[:2, 0]), np.ptp(p[2:, 1])]) for p in at]
    off = np.abs(sizes[0] / sizes[1] - 1)
    return [(100 * float(part), float(part) * abs(truth.focal[0]) / sigma_px) for part in off]


def main(arguments: Sequence[str]) -> int:
    """Print a line for each rig; 1 if an error exceeds LIMITS."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.boards_truth")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--size", type=int, default=640)
    parser.add_argument("--pairs", type=int, default=16)
    args, bad = parser.parse_args(arguments), 0
    for seed in args.seeds:
        truth = random_rig(seed, args.size)
        with tempfile.TemporaryDirectory() as folder:
            found = calibrated(render_pairs(truth, Path(folder), seed, args.pairs))
        off = errors(found, truth)
        bad += any(value > LIMITS[name] for name, (value, _) in off.items())
        line = ", ".join(f"{name} {value:.4f} ({ratio:.1f} sigma)" for name, (value, ratio) in off.items())
        print(f"seed {seed}, {args.size} px, {found.pairs} pairs, {found.fit.mean_px:.3f} px: {line}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
