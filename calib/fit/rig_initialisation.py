"""A first transform between two cameras from boards that both saw, each board's turn decided by all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board, BoardView
from calib.boards.board_pose import board_pose, pose_error_rad, turns
from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera

# A camera that is given must see every board as one to this; else the corners, or the camera, are wrong.
MAX_POSE_ERROR_RAD = np.deg2rad(1.0)
# Pairs agree when their transforms are this near, a turn and a shift in parts of the distance taken together.
AGREE, AGREE_AT_MOST, AGREE_RATIO = 0.06, 0.3, 5.0
# Another transform that is this different, and that fits not much worse, leaves the turns open.
OTHER, CLEARLY_WORSE = 0.3, 3.0
Seen = tuple[BoardView | None, BoardView | None]


@dataclass(frozen=True, slots=True)
class Agreed:
    """T_upper_lower, the boards' poses by view, the orders of the upper corners by pair, and what does not agree."""

    T_upper_lower: Array  # (4, 4)
    T_lower_board: dict[int, Array]
    orders: dict[int, NDArray[np.intp]]
    rejected: tuple[tuple[int, str], ...]


def agree(views: Sequence[Seen], board: Board, cameras: tuple[OmniCamera, OmniCamera]) -> Agreed:
    """The transform on which most pairs agree, and what it makes of every view. CalibError where it is not clear."""
    orders = turns(board)
    lower = {k: T for k, (seen, _) in enumerate(views)
             if seen and (T := _pose(cameras[0], seen.pixels, board)) is not None}
    upper = {k: poses for k, (_, seen) in enumerate(views)
             if seen and (poses := _poses(cameras[1], seen, board, orders)) is not None}
    both = sorted(lower.keys() & upper.keys())
    if not both:
        raise CalibError("calibrate rig: no board fits both cameras; check --corners, and that the camera files are "
                         "those of these cameras, lower and upper")
    best, apart = _consensus(np.array([upper[k] @ se3.inverse(lower[k]) for k in both]))
    gap = apart.min(axis=1)
    limit = float(np.clip(AGREE_RATIO * np.median(gap), AGREE, AGREE_AT_MOST))
    odd = {k: float(gap[i]) for i, k in enumerate(both) if gap[i] > limit}
    placed = {k: T for k, T in lower.items() if k not in odd and (k in upper or views[k][1] is None)}
    placed |= {k: se3.inverse(best) @ T[0] for k, T in upper.items() if views[k][0] is None}
    rejected = [(k, "no board fits its corners") for k in range(len(views)) if k not in placed and k not in odd]
    rejected += [(k, f"it has the cameras {np.rad2deg(by):.1f} deg or more from where the others have them: was the "
                  "board moving?") for k, by in odd.items()]
    orders_of = {k: orders[int(apart[i].argmin())] for i, k in enumerate(both) if k not in odd}
    return Agreed(best, dict(sorted(placed.items())), orders_of, tuple(rejected))


def _pose(camera: OmniCamera, pixels: Array, board: Board) -> Array | None:
    T = board_pose(camera, pixels, board)
    return T if T is not None and pose_error_rad(camera, T, pixels, board) < MAX_POSE_ERROR_RAD else None


def _poses(camera: OmniCamera, seen: BoardView, board: Board, orders: Sequence[NDArray[np.intp]]) -> Array | None:
    """The board's poses (S, 4, 4), one for every order of its corners."""
    poses = [_pose(camera, seen.pixels[order], board) for order in orders]
    fitting = [T for T in poses if T is not None]
    return np.array(fitting) if len(fitting) == len(poses) else None


def _consensus(candidates: Array) -> tuple[Array, Array]:
    """The one of the candidates (K, S, 4, 4) with most support, and how far (K, S) all are from it."""
    flat = candidates.reshape(-1, 4, 4)
    apart = np.array([_apart(candidates, T) for T in flat])  # (K S, K, S)
    cost = np.median(apart.min(axis=2), axis=1) + 0.1 * np.minimum(apart.min(axis=2), 1.0).mean(axis=1)
    best = int(cost.argmin())
    others = cost[apart[best].ravel() > OTHER]
    if candidates.shape[1] > 1 and others.size and others.min() < max(CLEARLY_WORSE * cost[best], AGREE):
        raise CalibError("calibrate rig: a board with two even or two odd sides looks the same upside down, and these "
                         "pairs leave open which way up it was; hold it in more places, or take a board with one side "
                         "odd and one even")
    return flat[best], apart[best]


def _apart(T: Array, other: Array) -> Array:
    """How far transforms (..., 4, 4) are from another: angle [rad] plus shift in parts of its length."""
    gap = se3.rotation_log(np.swapaxes(T[..., :3, :3], -1, -2) @ other[:3, :3])
    shift = np.linalg.norm(T[..., :3, 3] - other[:3, 3], axis=-1)
    return np.asarray(np.linalg.norm(gap, axis=-1) + shift / max(float(np.linalg.norm(other[:3, 3])), 1e-9))
