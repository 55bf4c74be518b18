"""What of panoramas is used: corners, parts fixed to the rig, dense points that an earlier view contradicts."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.earlier_view import HALF_PX, EarlierView, contradicted
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.static_mask import StaticMask
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.scenery import texture, turned, wrapped

ALL = np.ones((120, 480), bool)


def test_a_poster_full_of_contrast_does_not_take_all_corners() -> None:
    faint = (texture(1) // 5 + 100).astype(np.uint8)
    faint[:, 200:280] = texture(2)[:, 200:280]
    found = corners(wrapped(faint), ALL, 100)
    on_poster = (found[:, 0] >= 195) & (found[:, 0] < 285)
    assert len(found) == 100
    assert on_poster.mean() < 0.4
    assert (np.histogram(found[:, 0], bins=10, range=(0, 480))[0] >= 4).all()


def test_noise_is_no_corner() -> None:
    """The threshold follows the noise that the panorama is said to have."""
    noise = np.random.default_rng(2).normal(100, 12, (120, 480))
    image = np.clip(noise, 0, 255).astype(np.uint8)
    image[40:60, 200:230] = 220  # an object
    usable = np.zeros(image.shape, bool)
    usable[10:110] = True
    quiet = wrapped(image)
    noisy = PaddedPanorama(quiet.image, quiet.pad_px, noise_grey=12.0)
    found = corners(noisy, usable, 1000)
    assert len(corners(quiet, usable, 1000)) > 300 > 5 * len(found)
    of_object = np.array([[200.0, 40], [229, 40], [200, 59], [229, 59]])
    assert np.linalg.norm(of_object[:, None] - found[None], axis=2).min(axis=1).max() < 4


Image = NDArray[np.uint8]

STRUT = np.zeros((120, 480), bool)
STRUT[:, 100:116] = STRUT[100:] = True
BETWEEN_PX = 12


def behind_strut(k: int) -> Image:
    """The world after k turns of 12 columns to the left, behind a strut and a rim with scratches on them; noise."""
    image = turned(texture(1), BETWEEN_PX * k)
    image[STRUT] = texture(2)[STRUT] // 2
    return np.clip(image + np.random.default_rng(k).normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)


def turn_of(k: int) -> NDArray[np.float64]:
    return se3.exp([0, 0, 0, 0, 0, BETWEEN_PX * k * 2 * np.pi / 480])


def test_a_strut_is_masked_and_the_moving_world_is_not() -> None:
    mask = StaticMask()
    for k in range(12):
        mask.observe(behind_strut(k), turn_of(k))
    left = mask.without(ALL)
    assert left[STRUT].mean() < 0.02
    world = ALL.copy()
    world[:, 80:136], world[80:] = False, False
    assert left[world].mean() > 0.97


def test_bare_walls_are_not_masked() -> None:
    """Images on white walls: nearly all of the panorama stays the same, and none of it is fixed."""
    room = np.full((120, 480), 200, np.uint8)
    for column in (30, 170, 330):
        room[40:80, column : column + 40] = texture(3)[40:80, column : column + 40]
    mask = StaticMask()
    for k in range(40):
        mask.observe(turned(room, BETWEEN_PX * k), turn_of(k))
    assert mask.without(ALL).mean() > 0.97


Array = NDArray[np.float64]

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
