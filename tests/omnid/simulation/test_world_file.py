"""World files: what they describe stands and walks there, and wrong ones are refused in one line."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib import se3
from calib.rig import MountedCamera, Rig
from omnid.errors import OmnidError
from omnid.simulation.world import Walkers, clearance_m, load_world, shipped_worlds
from tests.simulation import Rectangle, Scene, make_rig, render

HALL = """
schema = 1
start = [0.0, 0.0, 90.0]
[space]
low = [-2.0, -2.0]
high = [4.0, 2.0]
[[wall]]
points = [[2.0, 1.0], [2.0, -1.0]]
texture = "white"
[[wall.doors]]
at_m = 0.5
width_m = 0.9
[[box]]
at = [0.0, 1.0]
size_m = [0.4, 0.2, 0.5]
texture = "granite"
[[person]]
path = [[-1.0, -1.0], [1.0, -1.0]]
speed_mps = 0.5
repeat = "back and forth"
[[person]]
path = [[3.0, 1.5], [3.0, 0.5]]
starts_within_m = 2.0
"""


def write(folder: Path, text: str) -> str:
    path = folder / "hall.toml"
    path.write_text(text, "utf-8")
    return str(path)


def test_walls_have_doors_and_boxes_have_outlines(tmp_path: Path) -> None:
    world = load_world(write(tmp_path, HALL), 1)
    assert world.start == pytest.approx((0.0, 0.0, np.pi / 2))
    segments = world.obstacles(1.2)
    assert clearance_m(segments, (2.0, 0.05), 0.2) == pytest.approx(0.25)  # in the door: 0.45 m to either side
    assert clearance_m(segments, (2.0, 0.8), 0.2) == pytest.approx(-0.2)  # in the wall
    assert clearance_m(segments, (0.0, 0.0), 0.2) == pytest.approx(0.7)
    assert clearance_m(world.obstacles(2.5), (2.0, 0.05), 0.2) == pytest.approx(-0.2)  # the lintel
    raised = load_world(write(tmp_path, HALL.replace("[0.4, 0.2, 0.5]", "[0.4, 0.2, 0.5]\nbottom_m = 1.3")), 1)
    assert clearance_m(raised.obstacles(1.2), (0.0, 1.0), 0.2) > 0.5  # below the box


@pytest.mark.parametrize("name", shipped_worlds())
def test_shipped_worlds_are_drawn_from_a_seed(name: str) -> None:
    one, same, other = load_world(name, 1), load_world(name, 1), load_world(name, 2)
    assert all(np.array_equal(a.texture, b.texture) for a, b in zip(one.standing, same.standing, strict=True))
    assert not all(np.array_equal(a.texture, b.texture) for a, b in zip(one.standing, other.standing, strict=False))
    assert clearance_m(one.obstacles(1.2), one.start[:2], 0.2) > 0.3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "schema"),
        ('texture = "white"', 'texture = "whit"', "wall\\[0\\].texture: expected one of"),
        ("high = [4.0, 2.0]", "high = [-1.9, 2.0]", "space.high"),
        ("[space]", "[space", "expected TOML"),
        ("start = [0.0, 0.0, 90.0]", "start = [0.0, 2.1, 90.0]", "start: expected a place within"),
    ],
)
def test_wrong_worlds_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(OmnidError, match=message):
        load_world(write(tmp_path, HALL.replace(old, new)), 1)


def test_people_walk_and_some_wait_for_the_robot(tmp_path: Path) -> None:
    people = Walkers(load_world(write(tmp_path, HALL), 1).people)
    people.advance(1.0, (-5.0, 0.0))
    assert people.places()[0] == pytest.approx((-0.5, -1.0, 0.0))
    people.advance(5.0, (-5.0, 0.0))
    assert people.places()[0] == pytest.approx((0.5, -1.0, -np.pi))
    assert people.places()[1][:2] == (3.0, 1.5)
    people.advance(6.0, (1.5, 0.5))
    people.advance(6.5, (1.5, 0.5))
    assert people.places()[1][:2] == pytest.approx((3.0, 1.0))
    people.advance(60.0, (-5.0, 0.0))
    assert people.places()[1][:2] == pytest.approx((3.0, 0.5))


# Rendered corners equal the camera model's projection, so that exchanged or inverted transforms are detected.
SIZE = 192
SQUARES, SQUARE_M, DISTANCE_M = 4, 0.36, 1.1
RIGS = {
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
    expected = project(mounted, np.concatenate([inner_corners(s) for s in scene]))
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
