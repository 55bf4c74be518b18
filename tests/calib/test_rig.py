"""Axes and signs: mirrors by the law of reflection, misaligned rigs, rigs of two cameras, panoramas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.importers import straight_up
from calib.models.camera import Array, OmniCamera
from calib.models.lens import DoubleSphereCamera
from calib.models.names import sees_directly
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.panorama import Cylinder, fit_cylinder, remap_tables
from calib.rig import MountedCamera, Rig, is_turned_over, rig_between
from tests.simulation.rigs import lens, lens_rig

FOCAL_PX = 200.0
CENTER = (384.0, 380.0)
# A camera under a mirror, or a lens, that looks up in a world with x forward, y left, z up: forward is up in its
# image. From below, left is then on the right, whether in a mirror or directly.


def reflected(points: Array) -> Array:
    """Return pixels of world points in an orthographic camera below a convex paraboloid with focus at the origin.

    The paraboloid r^2 = 1 + 2 z has its vertex at the bottom: |p| = 1 + z. A ray towards the focus is reflected
    vertically down, which the law of reflection proves here. u points left, v backward: u x v is up.
    """
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    on_mirror = rays / (1 - rays[:, 2:])
    np.testing.assert_allclose((on_mirror[:, :2] ** 2).sum(axis=1), 1 + 2 * on_mirror[:, 2], rtol=0, atol=1e-9)
    normals = np.column_stack([on_mirror[:, :2], -np.ones(len(rays))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    leaving = -rays + 2 * (rays * normals).sum(axis=1, keepdims=True) * normals
    np.testing.assert_allclose(leaving, np.broadcast_to([0, 0, -1.0], rays.shape), rtol=0, atol=1e-9)
    return np.column_stack([CENTER[0] + FOCAL_PX * on_mirror[:, 1], CENTER[1] - FOCAL_PX * on_mirror[:, 0]])


def parabolic_omni() -> MountedCamera:
    """Return the mirror in Kalibr's convention: fu < 0, camera x right, y backward, z down."""
    T_cam_rig = se3.transform([[0, -1, 0], [-1, 0, 0], [0, 0, -1]], [0, 0, 0])
    return MountedCamera(UnifiedCamera(1.0, (-FOCAL_PX, FOCAL_PX), CENTER, (768, 768)), T_cam_rig)


def parabolic_ocam() -> MountedCamera:
    """Return the mirror in the toolbox's convention: camera x backward (rows), y left (columns), z down."""
    polynomial = (-FOCAL_PX / 2, 0.0, 1 / (2 * FOCAL_PX))
    T_cam_rig = se3.transform([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], [0, 0, 0])
    return MountedCamera(OcamCamera(polynomial, CENTER[::-1], (1.0, 0.0, 0.0), (768, 768)), T_cam_rig)


@pytest.mark.parametrize("mounted", [parabolic_omni(), parabolic_ocam()], ids=["omni", "ocam"])
def test_both_models_follow_the_law_of_reflection(mounted: MountedCamera, around: Array) -> None:
    assert se3.is_rigid(mounted.T_cam_rig)
    pixels = mounted.camera.project(se3.apply(mounted.T_cam_rig, around))
    np.testing.assert_allclose(pixels, reflected(around), rtol=0, atol=1e-7)


def rectified(rig: Rig, points: Array, cylinder: Cylinder) -> tuple[Array, Array]:
    """Return panorama pixels of points (rig frame) through each camera: project, lift, rotate to the cylinder."""
    found = []
    for mounted in (rig.lower, rig.upper):
        rays = mounted.camera.lift(mounted.camera.project(se3.apply(mounted.T_cam_rig, points)))
        R_rect_cam = rig.T_rect_rig[:3, :3] @ mounted.T_cam_rig[:3, :3].T
        found.append(cylinder.pixels(rays @ R_rect_cam.T))
    return found[0], found[1]


def test_columns_are_equal_and_disparity_is_focal_baseline_over_distance(rig: Rig, around: Array) -> None:
    cylinder = Cylinder(1200, 400, 200.0)
    lower, upper = rectified(rig, around, cylinder)
    assert np.isfinite(lower).all() and np.isfinite(upper).all()
    np.testing.assert_allclose(cylinder.wrap(upper[:, 0] - lower[:, 0]), 0, rtol=0, atol=1e-9)
    axis = (rig.upper.viewpoint - rig.lower.viewpoint) / rig.baseline_m
    distance = np.linalg.norm(np.cross(around - rig.lower.viewpoint, axis), axis=1)
    disparity = upper[:, 1] - lower[:, 1]
    assert (disparity > 0).all()
    np.testing.assert_allclose(disparity, 1200 / (2 * np.pi) * rig.baseline_m / distance, rtol=0, atol=1e-8)


def test_remap_tables_equal_the_projection(rig: Rig) -> None:
    cylinder = fit_cylinder(rig, 800)
    for mounted in (rig.lower, rig.upper):
        maps = remap_tables(rig, mounted, cylinder, pad_px=16)
        assert maps[0].shape == (cylinder.height, 832)
        np.testing.assert_array_equal(maps[0][:, :32], maps[0][:, 800:])
        column, row, distance = 250, cylinder.height // 2, 2.5
        azimuth = np.pi - (column + 0.5) / cylinder.focal_px
        z = distance * (cylinder.row0 - row) / cylinder.focal_px
        viewpoint = se3.apply(rig.T_rect_rig, [mounted.viewpoint])
        point = viewpoint + np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), z])
        pixel = mounted.camera.project(se3.apply(mounted.T_cam_rig @ se3.inverse(rig.T_rect_rig), point))
        np.testing.assert_allclose([maps[0][row, column + 16], maps[1][row, column + 16]], pixel[0], rtol=0, atol=1e-3)


OCAM = OcamCamera((-300.0, 0, 1.4e-3, -1.6e-6, 4e-9), (240.0, 376.0), (1.0, 0.0, 0.0), (752, 480))


@pytest.mark.parametrize(
    ("camera", "is_lens"),
    [
        (OCAM, False),
        (replace(OCAM, view="direct"), True),
        (UnifiedCamera(1.5, (900.0, 900.0), (376.0, 240.0), (752, 480)), True),
        (UnifiedCamera(1.5, (-900.0, 900.0), (376.0, 240.0), (752, 480)), False),
        (UnifiedCamera(0.0, (900.0, 900.0), (376.0, 240.0), (752, 480)), True),
        (DoubleSphereCamera(-0.2, 0.6, (300.0, 300.0), (376.0, 240.0), (752, 480)), True),
    ],
)
def test_without_a_mask_a_lens_sees_to_the_corners_and_a_mirror_in_the_largest_disc(
    camera: OmniCamera, is_lens: bool
) -> None:
    corner, edge = np.array([[1.0, 1.0]]), np.array([[376.0, 1.0]])
    seen = MountedCamera(camera, np.eye(4)).visible
    assert seen.contains(edge).all() and seen.contains(corner).all() == is_lens == sees_directly(camera)


def test_rig_between_is_upright_with_x_along_the_image_axis() -> None:
    lower, upper = parabolic_omni().camera, parabolic_ocam().camera
    for camera, T_down in ((lower, parabolic_omni().T_cam_rig), (upper, parabolic_ocam().T_cam_rig)):
        rig = rig_between(camera, camera, straight_up(0.25), ("a", "b"))
        np.testing.assert_allclose(rig.upper.viewpoint, [0, 0, 0.25], rtol=0, atol=1e-15)
        # The image's u axis runs to the robot's left here, and the rig's x is that axis.
        np.testing.assert_allclose(rig.lower.T_cam_rig[:3, 0], T_down[:3, 1], rtol=0, atol=1e-12)


def test_exchanged_cameras_turn_the_rig_over() -> None:
    for mirror in (parabolic_omni().camera, parabolic_ocam().camera):
        assert not is_turned_over(rig_between(mirror, mirror, straight_up(0.25)))
        assert is_turned_over(rig_between(mirror, mirror, se3.inverse(straight_up(0.25))))
    rig = lens_rig(lens("ds", 90))  # that looks ahead
    camera = rig.lower.camera
    T_lower_upper = rig.lower.T_cam_rig @ se3.inverse(rig.upper.T_cam_rig)
    assert not is_turned_over(rig) and not is_turned_over(rig_between(camera, camera, T_lower_upper))
    assert is_turned_over(rig_between(camera, camera, se3.inverse(T_lower_upper)))
    up = rig_between(camera, camera, straight_up(0.25))  # such a lens may look up or down
    assert not is_turned_over(up)
