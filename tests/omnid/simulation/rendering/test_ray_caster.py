"""Rendered corners equal the camera model's projection, so that exchanged or inverted transforms are detected."""

import itertools

import cv2
import numpy as np
import pytest

from calib import se3
from calib.rig import MountedCamera, Rig
from omnid.simulation.rendering import ray_caster
from tests.simulation import Rectangle, Scene, build, make_rig, render, wall
from tests.simulation.paths import planar_poses
from tests.simulation.rigs import with_real_mirrors

SIZE = 192
SQUARES, SQUARE_M, DISTANCE_M = 4, 0.36, 1.1
RIGS = {
    "straight": make_rig(size=SIZE),
    "misaligned": make_rig(
        size=SIZE,
        scale=0.9,
        baseline_m=0.24,
        misaligned_deg=(5, -4, 31),
        offset_mm=(12, -20),
        lower_misaligned_deg=(-3, 6, -50),
        lower_offset_mm=(40, 25),
        centre_px=(2.3, -1.6),
    ),
    "xi 0.8, distorted": make_rig(
        size=SIZE,
        xi=0.8,
        distortion=(-0.03, 0.004, 0.002, -0.003),
        centre_px=(-1.2, 2.7),
        misaligned_deg=(2, 3, 20),
        lower_misaligned_deg=(-1, 2, 70),
    ),
}
POSE = se3.exp([0.31, -0.22, 1.17, 0.05, -0.04, 0.7])


def chessboards(pose: np.ndarray, count: int = 4) -> Scene:
    """Return chessboards on all sides of the pose, at its height, each tilted a little."""
    board = np.kron(np.indices((SQUARES, SQUARES)).sum(axis=0) % 2, np.ones((100, 100)))
    texture = (40 + 180 * board).astype(np.uint8)
    sheets = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        R = se3.rotation_exp([0, 0, angle]) @ se3.rotation_exp([0.1 * (-1) ** i, 0.25, 0.2])
        u, v = R @ [0, -1.0, 0] * SQUARES * SQUARE_M, R @ [0, 0, -1.0] * SQUARES * SQUARE_M
        centre = pose[:3, 3] + DISTANCE_M * np.array([np.cos(angle), np.sin(angle), -0.2])
        sheets.append(Rectangle(centre - (u + v) / 2, u, v, texture))
    return Scene(tuple(sheets))


def inner_corners(sheet: Rectangle) -> np.ndarray:
    steps = np.arange(1, SQUARES) / SQUARES
    return sheet.points(np.array(list(itertools.product(steps, steps))))


def project(mounted: MountedCamera, points: np.ndarray) -> np.ndarray:
    return mounted.camera.project(se3.apply(mounted.T_cam_rig @ se3.inverse(POSE), points))


def corner_errors_px(mounted: MountedCamera) -> np.ndarray:
    """Return the distance of every visible corner in the image from its projection."""
    scene = chessboards(POSE)
    image = render(scene, mounted, POSE, 3)
    expected = project(mounted, np.concatenate([inner_corners(s) for s in scene.rectangles]))
    expected = expected[mounted.visible.contains(expected, 8)]
    start = np.ascontiguousarray(expected + 0.7, np.float32)
    enough = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    found = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), enough)
    return np.asarray(np.linalg.norm(found.reshape(-1, 2) - expected, axis=1))


@pytest.mark.parametrize("which", ["lower", "upper"])
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_rendered_corners_equal_the_projection(rig: Rig, which: str) -> None:
    errors = corner_errors_px(getattr(rig, which))
    assert len(errors) >= 15
    assert np.median(errors) < 0.1
    assert errors.max() < 0.3


def test_nearer_surfaces_occlude_farther_ones_in_any_order() -> None:
    rng = np.random.default_rng(0)
    far, near = (wall(rng, "plain", (x, 1.0), (x, -1.0)) for x in (2.0, 1.5))
    dark = Rectangle(near.origin, near.edge_u, near.edge_v, np.full((8, 8), 10, np.uint8))
    pose, camera = planar_poses(np.zeros((1, 2)), np.zeros(1))[0], RIGS["straight"].lower
    one, other = (render(Scene(order), camera, pose) for order in ((far, dark), (dark, far)))
    assert np.array_equal(one, other)
    assert np.array_equal(one, render(Scene((dark,)), camera, pose))


def test_no_ray_passes_between_walls_that_meet() -> None:
    """The corner lies in a diagonal of the image, on which rays meet it exactly."""
    white, up = np.full((8, 8), 255, np.uint8), np.array([0, 0, -2.0])
    origins, edges = ([1.0, -1, 1], [1.0, 1, 1]), ([0, 2.0, 0], [-2.0, 0, 0])
    walls = tuple(Rectangle(np.array(o), np.array(e), up, white) for o, e in zip(origins, edges, strict=True))
    image = render(Scene(walls), RIGS["straight"].lower, np.eye(4)).astype(float)
    seen = cv2.erode((cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((5, 5))) > 0).astype(np.uint8), np.ones((7, 7)))
    assert (image[seen > 0] > 0.9 * np.median(image[seen > 0])).all()
    assert seen.sum() > 2000


@pytest.mark.parametrize("is_real", [False, True])
def test_a_camera_sees_what_all_tiles_would_show(monkeypatch: pytest.MonkeyPatch, is_real: bool) -> None:
    run = build("rooms", 3, SIZE, 5)
    mounted = (with_real_mirrors(run.rig, 3) if is_real else run.rig).lower
    twists = None, np.array([1.5e-3, 1.5e-3, 0, 0, 0, 0]), np.array([0, 0, 0, 0, 0, 6e-4])  # from row to row
    found = [ray_caster.render_grey(run.scene, mounted, run.poses[2], 2, twist) for twist in twists]
    # All rectangles are tried in all tiles, however far they are.
    monkeypatch.setattr(
        ray_caster, "tiles_that_see", lambda table, corners, *_: np.ones((len(table.angles), len(corners)), bool)
    )
    monkeypatch.setattr(ray_caster, "MARGIN_M", 1e6)
    wanted = [ray_caster.render_grey(run.scene, mounted, run.poses[2], 2, twist) for twist in twists]
    np.testing.assert_array_equal(found, wanted)
