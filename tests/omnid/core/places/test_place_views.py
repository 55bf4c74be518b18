"""Views of a map: landmarks and grid in the axes of the base."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.scan_grid import FREE, OCCUPIED
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap, PlaceRig
from omnid.core.places.place_views import grid, landmarks
from omnid.core.stereo.triangulation import view
from tests.omnid.core.mapping.rooms import OPEN, box, pose, scan_of

CYLINDER = Cylinder(1200, 400, 150.0)
# The rig stands 0.5 m above the base and looks to its left.
RIG = PlaceRig(CYLINDER, 0.25, pose(0, 0, 0.2), se3.transform(se3.rotation_exp([0, 0, np.pi / 2]), [0, 0, 0.5]), "ab12")
ROOM = box((-3.0, -2.0), (4.0, 2.5))
LANDMARK = np.array([[2.0, 1.0, 0.28]])  # in the map's rectified frame


def keyframe(id: int, T: np.ndarray, session: int = 0) -> PlaceKeyframe:
    views = view(se3.apply(se3.inverse(T), LANDMARK), CYLINDER, RIG.baseline_m).astype(np.float32)
    features = PlaceFeatures(np.zeros((1, 128), np.uint8), views)
    scan = scan_of(ROOM, T).astype(np.float16)
    small, free_m = np.zeros((16, 128), np.int8), OPEN.astype(np.float16)
    return PlaceKeyframe(id, session, 10**9 * id, T, np.eye(6), small, scan, free_m, features)


def places(count: int = 6) -> PlaceMap:
    found = PlaceMap()
    for id in range(count):
        T = pose(0.3 * id, 0.1, 0.2 * id)
        link = Link(id - 1, id, se3.inverse(found.poses[id - 1]) @ T, np.eye(6)) if id else None
        found.add(keyframe(id, T), T, link)
    return found


def test_landmarks_of_several_keyframes_become_one_in_the_axes_of_the_base() -> None:
    points = landmarks(places(), RIG)
    assert len(points.xyz) == 1 and points.frames[0] == 6
    np.testing.assert_allclose(points.xyz, se3.apply(RIG.T_base_rect, LANDMARK), atol=0.01)


def test_the_grid_shows_the_room_where_the_base_sees_it() -> None:
    found = grid(places(), RIG, 0.05)
    corners = se3.apply(RIG.T_base_rect, np.array([[4.0, 0.0, 0], [0.5, 0.2, 0]]))
    cells = np.floor((corners[:, :2] - found.corner) / 0.05).astype(int)
    around = found.cells[cells[0, 1] - 1 : cells[0, 1] + 2, cells[0, 0] - 1 : cells[0, 0] + 2]
    assert OCCUPIED in around and found.cells[cells[1, 1], cells[1, 0]] == FREE
