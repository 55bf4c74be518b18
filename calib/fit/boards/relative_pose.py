"""Relative pose initialisation: the transform between two cameras from boards that both see, by consensus of pairs.

The order of a board's corners may be ambiguous in one image; the consensus decides it for every pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import BoardView, CalibrationBoard
from calib.boards.board_pose import ambiguous_orders, board_pose, pose_error_rad
from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera

# Largest mean ray error of a board's pose in a given camera; beyond it the corners or the camera are wrong.
MAX_POSE_ERROR_RAD = np.deg2rad(1.0)
# Distance of two transforms: angle [rad] plus shift relative to the baseline. A pair is an inlier below INLIER_RATIO
# times the median distance, within these limits.
MIN_INLIER_DISTANCE, MAX_INLIER_DISTANCE, INLIER_RATIO = 0.06, 0.3, 5.0
# The order of corners is ambiguous if a transform farther away than any inlier costs less than this ratio.
MIN_COST_RATIO = 3.0
ViewPair = tuple[BoardView | None, BoardView | None]


@dataclass(frozen=True, slots=True)
class RelativePoseInitialisation:
    """The relative pose of two cameras, and the views consistent with it."""

    T_upper_lower: Array  # (4, 4)
    T_lower_board: dict[int, Array]  # (4, 4) by view
    orders: dict[int, NDArray[np.intp]]  # (N,) of the upper corners, by pair
    rejected: tuple[tuple[int, str], ...]  # view and reason


def initialise_relative_pose(
    views: Sequence[ViewPair], board: CalibrationBoard, cameras: tuple[OmniCamera, OmniCamera]
) -> RelativePoseInitialisation:
    """Find the transform with the most consistent pairs, and the board's pose in every view.

    Raises CalibError if no board fits both cameras or the order of the corners is ambiguous.
    """
    # 1. The board's pose in every view, for the upper camera with every possible order of the corners.
    orders = ambiguous_orders(board)
    lower = {k: poses[0] for k, poses in _poses_of(cameras[0], [seen for seen, _ in views], board, orders[:1]).items()}
    upper = _poses_of(cameras[1], [seen for _, seen in views], board, orders)
    both = sorted(lower.keys() & upper.keys())
    if not both:
        raise CalibError(
            "calibrate rig: no board fits both cameras; check --corners, and that the camera files are "
            "those of these cameras, lower and upper"
        )
    # 2. Consensus of the transforms of all pairs.
    best, apart = _consensus(np.array([upper[k] @ se3.inverse(lower[k]) for k in both]))
    gap = apart.min(axis=1)
    limit = float(np.clip(INLIER_RATIO * np.median(gap), MIN_INLIER_DISTANCE, MAX_INLIER_DISTANCE))
    outliers = {k: float(gap[i]) for i, k in enumerate(both) if gap[i] > limit}
    # 3. The pose of the board in the lower camera's frame, for each view that is left.
    placed = {k: T for k, T in lower.items() if k not in outliers and (k in upper or views[k][1] is None)}
    placed |= {k: se3.inverse(best) @ T[0] for k, T in upper.items() if views[k][0] is None}
    orders_of = {k: orders[int(apart[i].argmin())] for i, k in enumerate(both) if k not in outliers}
    # 4. Outlier pairs and views without a pose are rejected.
    rejected = [(k, "no board fits its corners") for k in range(len(views)) if k not in placed and k not in outliers]
    rejected += [
        (
            k,
            f"its relative pose of the cameras is {np.rad2deg(distance):.1f} deg or more off that of the "
            "others: was the board moving?",
        )
        for k, distance in outliers.items()
    ]
    return RelativePoseInitialisation(best, dict(sorted(placed.items())), orders_of, tuple(rejected))


def _poses_of(
    camera: OmniCamera, views: Sequence[BoardView | None], board: CalibrationBoard, orders: Sequence[NDArray[np.intp]]
) -> dict[int, Array]:
    """Return by view the board's poses (S, 4, 4) for each order of its corners; views that do not fit are left out."""
    found = dict[int, Array]()
    for k, seen in enumerate(views):
        poses = [] if seen is None else [board_pose(camera, seen.pixels[order], board) for order in orders]
        fitting = [
            T
            for T, order in zip(poses, orders, strict=False)
            if seen is not None
            and T is not None
            and pose_error_rad(camera, T, seen.pixels[order], board) < MAX_POSE_ERROR_RAD
        ]
        if len(fitting) == len(orders):
            found[k] = np.array(fitting)
    return found


def _consensus(candidates: Array) -> tuple[Array, Array]:
    """Return the candidate (4, 4) of (K, S, 4, 4) with the most support, and the distances (K, S) of all from it."""
    flat = candidates.reshape(-1, 4, 4)
    # The distances (K S, K, S) of all from each: angle [rad] plus shift in parts of the length of the translation.
    R, t = se3.R_of(flat), se3.t_of(flat)
    gaps = se3.rotation_log(np.swapaxes(R, -1, -2) @ R[:, None])
    length = np.maximum(np.linalg.norm(t, axis=-1), np.finfo(float).tiny)[:, None]
    distances = np.linalg.norm(gaps, axis=-1) + np.linalg.norm(t - t[:, None], axis=-1) / length
    apart = distances.reshape(-1, *candidates.shape[:2])
    nearest = apart.min(axis=2)
    # Far ones count alike: the cost is that of MSAC (Torr and Zisserman 2000).
    cost = np.minimum(nearest, MAX_INLIER_DISTANCE).mean(axis=1)
    best = int(cost.argmin())
    others = cost[apart[best].ravel() > MAX_INLIER_DISTANCE]
    if candidates.shape[1] > 1 and others.size and others.min() < max(MIN_COST_RATIO * cost[best], MIN_INLIER_DISTANCE):
        raise CalibError(
            "calibrate rig: a board with two even or two odd sides looks the same upside down, and its orientation is "
            "ambiguous in these pairs; hold it at more places, or use a board with one odd and one even side"
        )
    return flat[best], apart[best]
