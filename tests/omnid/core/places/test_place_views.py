"""Views of a map: parts, sizes, landmarks and grid in the axes of the base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.scan_grid import FREE, OCCUPIED
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap
from omnid.core.places.place_rig import PlaceRig
from omnid.core.places.place_views import base_poses, drives, grid, landmarks, loops_xy, parts, paths_xy, summary
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


def test_the_base_begins_at_the_origin() -> None:
    np.testing.assert_allclose(
        base_poses(places(), RIG)[0] @ [0, 0, 0, 1],
        RIG.T_base_rect @ pose(0, 0.1, 0) @ se3.inverse(RIG.T_base_rect) @ [0, 0, 0, 1],
    )
    assert base_poses(PlaceMap(), RIG).shape == (0, 4, 4)


def test_a_drive_ends_with_its_session_or_where_no_odometry_joins_its_keyframes() -> None:
    found = places()
    for id, session in ((6, 0), (7, 1)):
        found.add(keyframe(id, pose(1.0, 0.0, 0.0), session), pose(1.0, 0.0, 0.0))
    found.links.append(Link(6, 7, np.eye(4), np.eye(6)))
    assert drives(found) == [[0, 1, 2, 3, 4, 5], [6], [7]] and drives(PlaceMap()) == []
    # Nothing drove from one to the next.
    paths = paths_xy(found, RIG)
    assert np.flatnonzero(np.isnan(paths[:, 0])).tolist() == [6, 8, 10] and paths_xy(PlaceMap(), RIG).shape == (0, 2)
    np.testing.assert_array_equal(paths[:6], base_poses(places(), RIG)[:, :2, 3])
    found.links.append(Link(0, 5, np.eye(4), np.eye(6), 40))
    np.testing.assert_array_equal(loops_xy(found, RIG), paths[None, [0, 5]])
    assert loops_xy(PlaceMap(), RIG).shape == (0, 2, 2)


def test_parts_are_what_links_join() -> None:
    found = places()
    for id in (6, 7):
        found.add(keyframe(id, np.eye(4), 1), np.eye(4))
    assert parts(found) == [[0, 1, 2, 3, 4, 5], [6], [7]]
    found.links.append(Link(6, 7, np.eye(4), np.eye(6), 40))
    assert parts(found) == [[0, 1, 2, 3, 4, 5], [6, 7]]
    found.links.append(replace(found.links[-1], b=2))
    assert parts(found) == [[0, 1, 2, 3, 4, 5, 6, 7]] and parts(PlaceMap()) == []


def test_sizes() -> None:
    sizes = summary(places(), RIG)
    assert (sizes.keyframes, sizes.sessions, sizes.features, sizes.loops, sizes.parts) == (6, 1, 6, 0, 1)
    assert abs(sizes.path_m - 1.5) < 1e-9 and abs(np.hypot(*sizes.extent_m) - 1.5) < 1e-9
    assert (sizes.first_stamp_ns, sizes.last_stamp_ns) == (0, 5 * 10**9)
    assert summary(PlaceMap(), RIG).keyframes == 0
