"""Corners to a hundredth of a pixel: each is looked at in its own square-on view of the board.

Edges in a mirror are bent and squares sheared; a window that is straight in the image then pulls the corner aside.
How board and image map, so that a window can be cut out along the board, the neighbours tell to second order, and a
first calibration exactly: without that second pass cameras come out some 0.04 % too large.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board
from calib.boards.board_shape import local_mapping, terms
from calib.boards.corner_candidates import Grey, sample
from calib.models.camera import Array, OmniCamera

ToImage = Callable[[Array], Array]  # (..., 2) squares from a corner, along the board, to pixels

# The window reaches so far into the four squares, near to whose far ends other edges begin, and no further than what
# the image's blur still bends.
REACH, REACH_PX = 0.42, 8
ROUNDS = 4
STILL_PX = 2e-3
# Further than this part of a square from where it started, a corner has run away and is put back.
MAX_MOVE = 0.3


def refine(image: NDArray[np.uint8], corners: Array) -> Array:
    """Corners (rows, columns, 2) [px] moved onto the image's; those that cannot be told stay where they are."""
    grey, refined = image.astype(np.float32), corners.copy()
    for _ in range(ROUNDS):
        moved = refined.copy()
        for j, i in np.argwhere(np.isfinite(corners[..., 0])):
            mapping = local_mapping(refined, int(j), int(i))
            if mapping is not None:
                moved[j, i] = _recentred(grey, mapping, corners[j, i])
        step = np.nanmax(np.linalg.norm(moved - refined, axis=2))
        refined = moved
        if step < STILL_PX:
            break
    return refined


def refine_with(image: NDArray[np.uint8], camera: OmniCamera, T_cam_board: Array, view: tuple[Board, Array]) -> Array:
    """The pixels (N, 2) of a view (board, pixels) moved onto the corners as a camera that nearly fits shows them."""
    (board, pixels), grey = view, image.astype(np.float32)
    refined = pixels.copy()
    for index in np.flatnonzero(np.isfinite(pixels[:, 0])):
        to_image = _through(camera, T_cam_board, (board, board.points[index]))
        moved = to_image(_settled(grey, to_image)[None])[0]
        if np.linalg.norm(moved - pixels[index]) < MAX_MOVE * _size(to_image) + 0.3:
            refined[index] = moved
    return refined


def _settled(grey: Grey, to_image: ToImage) -> Array:
    """Where (2,) [squares] the corner is, the window moved onto it step by step."""
    shift = np.zeros(2)

    def shifted(xy: Array) -> Array:
        return to_image(xy + shift)

    for _ in range(ROUNDS):
        shift = shift + _offset(grey, shifted)
    return shift


def _through(camera: OmniCamera, T_cam_board: Array, place: tuple[Board, Array]) -> ToImage:
    """The mapping about a point of the board (board, point (3,)) to the image, by a camera."""
    board, point = place

    def to_image(xy: Array) -> Array:
        offset = np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1) * board.square_m
        return camera.project(se3.apply(T_cam_board, (point + offset).reshape(-1, 3))).reshape(xy.shape)

    return to_image


def _recentred(grey: Grey, mapping: Array, start: Array) -> Array:
    """The corner's pixel (2,) as the window shows it, by a local mapping."""
    def to_image(xy: Array) -> Array:
        return np.asarray(terms(xy[..., 0], xy[..., 1]) @ mapping)

    moved = to_image(_offset(grey, to_image))
    return moved if np.linalg.norm(moved - start) < MAX_MOVE * _size(to_image) + 0.3 else start


def _size(to_image: ToImage) -> float:
    """Pixels per square at the corner."""
    ends = to_image(np.array([[0.0, 0], [0.01, 0], [0, 0.01]])) * 100
    return float(np.sqrt(abs(np.linalg.det(ends[1:] - ends[0]))))


def _offset(grey: Grey, to_image: ToImage) -> Array:
    """Where (2,) [squares] the window about the origin of a mapping shows its corner."""
    size = _size(to_image)
    reach = min(REACH, REACH_PX / max(size, 1e-6))
    side = int(np.clip(np.ceil(2 * reach * size), 5, 2 * REACH_PX)) // 2 * 2 + 1
    x, y = np.meshgrid(*2 * [np.linspace(-reach, reach, side)])
    pixels = to_image(np.stack([x, y], axis=-1))
    return _saddle(sample(grey, pixels), x, y) if np.isfinite(pixels).all() else np.zeros(2)


def _saddle(window: Array, x: Array, y: Array) -> Array:
    """Where (2,) the second-order surface through a window at x, y is level, 0 where it has no saddle.

    Lucchese and Mitra 2002. Halos and blooming, which push all four edges about, leave that point where it is: on real
    images it fits cameras better than where the edges' gradients cross.
    """
    reach = float(x.max())
    weight = np.exp(-(x * x + y * y) / (2 * (0.6 * reach) ** 2)).ravel()
    A = terms(x.ravel(), y.ravel()) * weight[:, None]
    _, gx, gy, xx, xy, yy = np.linalg.lstsq(A, window.ravel() * weight, rcond=None)[0]
    determinant = 4 * xx * yy - xy * xy
    if determinant >= 0:
        return np.zeros(2)
    shift = np.array([xy * gy - 2 * yy * gx, xy * gx - 2 * xx * gy]) / determinant
    return np.asarray(np.clip(shift, -reach, reach))
