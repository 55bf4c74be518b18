"""Dense points that an earlier view contradicts: what is fixed to the camera, and wrong ranges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.earlier_kernels import HALF_PX, SAME, copy_windows, correlations
from omnid.core.odometry.earlier_view import EarlierView, contradicted
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.pixel_times import PixelTimes
from omnid.core.types.stereo_model import StereoModel
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


def test_points_are_seen_where_the_motion_puts_them_when_their_pixels_were_exposed() -> None:
    late_s, twist = 0.02, np.array([3.0, 0, 0, 0, 0, 4.0])
    now, earlier = seen_from(np.eye(4)), seen_from(se3.exp(-late_s * twist) @ T_EARLIER_NOW)
    rows_s = np.full((120, 480), late_s, np.float32)
    motion = RigVelocity(twist, np.zeros((6, 6)))
    exposure = Exposure(PixelTimes(0.0, rows_s, rows_s), motion, StereoModel(CYLINDER, 0.2))
    assert wrong(now, earlier, RANGE_M, MIDDLE, exposure=exposure) < 0.02
    assert wrong(now, earlier, RANGE_M, MIDDLE) > 0.2


def test_what_the_earlier_view_does_not_show_is_not_contradicted() -> None:
    now, earlier = seen_from(np.eye(4)), seen_from(T_EARLIER_NOW)
    assert wrong(now, earlier, 0.5 * RANGE_M, MIDDLE, ~EVERYWHERE) == 0


def test_at_rest_a_point_is_confirmed() -> None:
    """Both hypotheses are one there."""
    image, pixels = with_reflection(seen_from(np.eye(4))), np.array([[100.0, 94.0], [200.0, 60.0]])
    view = EarlierView(wrapped(image), EVERYWHERE, np.eye(4))
    assert not contradicted(wrapped(image), pixels, CYLINDER.rays(pixels), CYLINDER, view).any()


@pytest.mark.parametrize("seen", [(20.0, 30.0), (20.3, 30.6), (33.9, 7.1)])
def test_correlations_are_those_of_numpy(seen: tuple[float, float]) -> None:
    now, earlier = texture(3), texture(4)
    room = np.empty(3 * SAME, np.int32)
    copy_windows(now.ravel(), earlier.ravel(), now.shape[1], 40, 50, np.array(seen), room)
    in_world, on_rig = correlations(room)
    window = now[47:54, 37:44].ravel()
    assert on_rig == pytest.approx(np.corrcoef(window, earlier[47:54, 37:44].ravel())[0, 1], abs=1e-6)
    u, v = np.meshgrid(*(at + np.arange(-HALF_PX, HALF_PX + 1, dtype=np.float32) for at in seen))
    patch = cv2.remap(earlier.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    assert in_world == pytest.approx(np.corrcoef(window, patch.ravel())[0, 1], abs=0.02)


@pytest.mark.parametrize("row", [0.0, 2.0, 117.0, 119.0])
def test_a_window_that_leaves_the_image_contradicts_nothing(row: float) -> None:
    """Those of the middle row, of other texture, contradict more than half."""
    now, earlier = texture(3), texture(4)
    pixels = np.column_stack([np.arange(0.0, 480, 5), np.full(96, row)])
    view = EarlierView(wrapped(earlier), EVERYWHERE, np.eye(4))
    middle = np.column_stack([pixels[:, 0], np.full(96, 60.0)])
    assert not contradicted(wrapped(now), pixels, CYLINDER.rays(pixels), CYLINDER, view).any()
    assert contradicted(wrapped(now), middle, CYLINDER.rays(middle), CYLINDER, view).mean() > 0.5


def test_a_sector_has_no_points_beyond_its_ends() -> None:
    """A point that the earlier sector does not show is not contradicted."""
    sector = Cylinder(width=120, height=120, row0=60.0, turn_px=480, first=180)
    image = PaddedPanorama(texture(5, (120, 160)), 20, turn_px=480, first=180)
    pixels = np.array([[3.0, 50.0]])
    turned = se3.exp(np.array([0, 0, 0, 0, 0, 0.5]))
    view = EarlierView(image, np.ones((120, 120), bool), turned)
    assert not contradicted(image, pixels, sector.rays(pixels), sector, view).any()
