"""Mirrors below telecentric lenses: the wavefront that the image tells, found by boards, refused where it is none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy

from calib import se3
from calib.boards.board import Board
from calib.fit.boards.rig_fit import RigCalibration, fit_rig
from calib.fit.boards.rig_selection import START_M, START_TANGENTIAL, telecentric_if_as_good
from calib.fit.boards.telecentric_mirror import RADIUS_LOG_SIGMA, RADIUS_NAME, TelecentricMirror, wavefront_parts
from calib.fit.parameterisation import parameterise
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.models.wavefront import TERMS, WAVEFRONT_NAMES
from calib.rig import Rig
from tests.bench.boards_chain import board_rig
from tests.bench.rig_sigmas import projected_views
from tests.simulation.mirrors import MirrorCamera

RADIUS_M = 0.03
BOARD = Board(5, 4, 0.08)  # as large as one of 9 x 6 corners, with fewer of them to fit


def mirror(horizon_px: float, center: tuple[float, float], size: tuple[int, int], xi: float = 1.0) -> OcamCamera:
    """Return the camera below a paraboloid, or nearly the one of another xi; the terms of real mirrors are almost 0."""
    beta = (1 - xi) / (1 + xi)
    return OcamCamera(
        (-horizon_px / 2, 0.0, 0.5 * (1 - beta) / horizon_px, 0.0, 1e-13 - 0.5 * beta / horizon_px**3),
        (center[1], center[0]),
        (1.0, 0.0, 0.0),
        size,
        tangential=START_TANGENTIAL,
        wavefront=(START_M,) * TERMS,
    )


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("w_s", {"conic": 0.004}),
        ("w_a", {"ellipticity": 0.003}),
        ("w_x", {"tilt_rad": (0.003, 0.0)}),
        ("w_y", {"tilt_rad": (0.0, 0.003)}),
    ],
)
def test_a_ray_traced_mirror_has_the_wavefront_that_its_image_tells(name: str, shape: dict[str, float]) -> None:
    """All terms of camera, pose and wavefront are fitted to the pixels of points near and far."""
    traced = MirrorCamera(150.0, (320.0, 300.0), (640, 640), RADIUS_M, **shape)  # type: ignore[arg-type]
    rng = np.random.default_rng(1)
    up, azimuth = np.cos(np.deg2rad(rng.uniform(15, 110, 300))), rng.uniform(0, 2 * np.pi, 300)
    along = np.sqrt(1 - up**2)
    points = rng.choice([0.2, 0.4, 2.0], 300)[:, None] * np.column_stack(
        [along * np.cos(azimuth), along * np.sin(azimuth), up]
    )
    pixels, side = traced.project(points), parameterise(mirror(150.0, (320.0, 300.0), (640, 640)), wavefront=True)
    # Rows of the image are y of the mirror's frame, columns -x, and rays go up: x' = y, y' = -x, z' = z.
    R = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])

    def camera(steps: Array) -> OcamCamera:
        found = side.camera_at(steps)
        assert isinstance(found, OcamCamera)
        return found

    def errors(steps: Array) -> Array:
        T = se3.exp(1e-3 * steps[-6:])
        return np.asarray((camera(steps[:-6]).project_near(se3.apply(T, points @ R.T)) - pixels).ravel())

    found = scipy.optimize.least_squares(errors, np.zeros(len(side.names) + 6), x_scale="jac")
    assert np.abs(found.fun).max() < 5e-3
    fitted, index = camera(found.x[:-6]), WAVEFRONT_NAMES.index(name)
    assert abs(fitted.wavefront[index]) > 2e-5
    assert fitted.wavefront[index] == pytest.approx(RADIUS_M * wavefront_parts(fitted)[index], rel=0.1)


def test_the_parameterisation_starts_at_its_camera_and_gives_its_plain_parameters() -> None:
    camera = replace(mirror(150.0, (320.0, 300.0), (640, 640)), wavefront=(1e-4, -2e-4, 3e-4, 0.0, 5e-5))
    side = TelecentricMirror.about(camera)
    none = np.zeros(len(side.names))
    at = side.camera_at(none)
    assert isinstance(at, OcamCamera) and side.names[-1] == RADIUS_NAME
    np.testing.assert_allclose(at.wavefront, camera.wavefront, atol=1e-12)
    np.testing.assert_allclose(side.plain_values(none)[-TERMS:], camera.wavefront, atol=1e-12)
    assert side.plain_by_steps(none).shape == (len(none) - 1, len(none))
    # A larger mirror has a larger wavefront.
    larger = side.camera_at(np.append(none[:-1], 1.0))
    assert isinstance(larger, OcamCamera)
    np.testing.assert_allclose(larger.wavefront, np.array(camera.wavefront) * np.exp(RADIUS_LOG_SIGMA), atol=1e-12)


def freely_fitted(rig: Rig, perfect: Rig, xi: float = 1.0, pairs: int = 12) -> RigCalibration:
    starts = []
    for mounted in (perfect.lower, perfect.upper):
        assert isinstance(mounted.camera, UnifiedCamera)
        starts.append(mirror(abs(mounted.camera.focal[0]), mounted.camera.center, mounted.camera.size, xi))
    views = projected_views(rig, perfect, BOARD, pairs, 0.015, seed=21, noise_seed=[3])
    return fit_rig(views, BOARD, (starts[0], starts[1]))


@cache
def paraboloids() -> tuple[RigCalibration, RigCalibration]:
    """Return the fits of a rig of ray-traced mirrors: with free terms, and what is made of it."""
    free = freely_fitted(*board_rig(21, 1.0))
    return free, telecentric_if_as_good(free)


@pytest.mark.slow
def test_boards_of_paraboloids_give_the_profile_of_the_mirrors_twice_as_well() -> None:
    free, found = paraboloids()
    assert not free.telecentric and found.telecentric
    for one, other in zip(free.parameters, found.parameters, strict=True):
        assert [name for name, _, _ in one] == [name for name, _, _ in other]
        before, after = ({name: sigma for name, _, sigma in side} for side in (one, other))
        assert after["a4"] < 0.7 * before["a4"] and after["w_s"] < 0.5 * before["w_s"]
    assert len(found.covariance) == len(free.covariance)


@pytest.mark.slow
def test_mirrors_of_another_kind_are_not_taken_for_paraboloids() -> None:
    """Hyperboloids below their second focus: the image of another curve, and no wavefront."""
    _, perfect = board_rig(21, 1.0)
    xi, sides = 0.9, []
    for mounted in (perfect.lower, perfect.upper):
        camera = mounted.camera
        assert isinstance(camera, UnifiedCamera)
        focal = (camera.focal[0] * (1 + xi) / 2, camera.focal[1] * (1 + xi) / 2)
        sides.append(replace(mounted, camera=replace(camera, xi=xi, focal=focal)))
    free = freely_fitted(replace(perfect, lower=sides[0], upper=sides[1]), perfect, xi, pairs=7)
    assert telecentric_if_as_good(free) is free
