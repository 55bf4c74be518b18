"""Dense points that an earlier view contradicts: what is fixed to the camera, and wrong ranges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.earlier_view import HALF_PX, EarlierView, contradicted
from omnid.core.odometry.exposure_times import Exposure
from tests.omnid.core.scenery import texture, wrapped

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CYLINDER = Cylinder(width=480, height=120, row0=60.0)
RANGE_M = 3.0  # of the wall about the rig, a cylinder about the first pose
ROWS = slice(90, 98)  # of a bright reflection of the camera in its mirror
T_EARLIER_NOW = se3.transform(se3.exp(np.array([0, 0, 0, 0, 0, 0.1]))[:3, :3], np.array([0.4, 0.1, 0.0]))
EVERYWHERE = np.ones((120, 480), bool)


def seen_from(T_rect_now: Array) -> Image:
    """Return the panorama of the wall as it is seen from another pose than that of now, which is its middle."""
    T_wall_rect = se3.inverse(T_rect_now)
    u, v = np.meshgrid(np.arange(480.0), np.arange(120.0))
    rays = CYLINDER.rays(np.column_stack([u.ravel(), v.ravel()])) @ T_wall_rect[:3, :3].T
    at = T_wall_rect[:3, 3]
    along, out = rays[:, :2] @ at[:2], RANGE_M**2 - at[:2] @ at[:2]
    points = at + (np.sqrt(along**2 + out) - along)[:, None] * rays
    columns, rows = CYLINDER.pixels(points).astype(np.float32).T.reshape(2, *u.shape)
    wall = np.hstack([texture(1), texture(1)[:, :1]])
    return np.asarray(cv2.remap(wall, columns % 480, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), np.uint8)


def with_reflection(image: Image) -> Image:
    reflected = image.copy()
    reflected[ROWS] = 100 + texture(7)[ROWS] // 2
    return reflected


def wrong(
    now: Image,
    earlier: Image,
    range_m: float,
    rows: slice,
    usable: NDArray[np.bool_] = EVERYWHERE,
    exposure: Exposure | None = None,
) -> float:
    """Return the share of contradicted points of some rows of the first pose's panorama at a distance."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(0.0, 480, 5), np.arange(120.0)[rows]))
    pixels = np.column_stack([u, v])
    view = EarlierView(wrapped(earlier), usable, T_EARLIER_NOW, exposure)
    found = contradicted(wrapped(now), pixels, range_m * CYLINDER.rays(pixels), CYLINDER, view)
    return float(found.mean())


MIDDLE = slice(40, 80)


def test_points_at_their_range_are_confirmed_under_another_exposure() -> None:
    now, earlier = seen_from(np.eye(4)), seen_from(T_EARLIER_NOW)
    dimmed = np.asarray(cv2.convertScaleAbs(earlier, alpha=0.7, beta=20), np.uint8)
    assert wrong(now, dimmed, RANGE_M, MIDDLE) < 0.02


def test_points_at_a_wrong_range_are_contradicted() -> None:
    now, earlier = seen_from(np.eye(4)), seen_from(T_EARLIER_NOW)
    assert wrong(now, earlier, 0.5 * RANGE_M, MIDDLE) > 0.7


def test_what_is_fixed_to_the_camera_is_contradicted() -> None:
    now, earlier = (with_reflection(seen_from(T)) for T in (np.eye(4), T_EARLIER_NOW))
    inside = slice(ROWS.start + HALF_PX, ROWS.stop - HALF_PX)
    # Where turn and translation cancel, both hypotheses are the same place.
    assert wrong(now, earlier, 1.5 * RANGE_M, inside) > 0.75
    assert wrong(now, earlier, RANGE_M, MIDDLE) < 0.02
