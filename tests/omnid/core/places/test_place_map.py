"""The map of places: what leaves it within its bounds, which parts links join, its landmarks and its grid."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.scan_grid import FREE, OCCUPIED
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap, PlaceRig
from omnid.core.places.place_views import grid, landmarks
from omnid.core.stereo.triangulation import view
from tests.omnid.core.mapping.rooms import OPEN, box, pose, scan_of


def keyframe(number: int, features: int = 10) -> PlaceKeyframe:
    """A keyframe with random evidence."""
    return PlaceKeyframe(
        number,
        0,
        number,
        np.eye(4),
        np.eye(6),
        np.zeros((16, 128), np.int8),
        np.full(360, np.nan, np.float16),
        np.zeros(360, np.float16),
        PlaceFeatures(np.zeros((features, 128), np.uint8), np.zeros((features, 3), np.float32)),
    )


def bent_way(number: float) -> np.ndarray:
    """A pose on a bent path."""
    return se3.exp([number, 0.3 * number, 0, 0, 0, 0.1 * number])


def link(a: int, b: int, inliers: int = 0) -> Link:
    """The exact edge between two keyframes."""
    return Link(a, b, se3.inverse(bent_way(a)) @ bent_way(b), 1e-4 * np.eye(6), inliers)


def chain(count: int, **bounds: int) -> PlaceMap:
    """Keyframes one after the other."""
    places = PlaceMap(**bounds)
    for number in range(count):
        places.add(keyframe(number), bent_way(number), link(number - 1, number) if number else None)
    return places


def test_a_full_map_drops_what_others_are_nearest_to() -> None:
    places = PlaceMap(max_keyframes=4)
    for number, x in enumerate((0.0, 1.0, 1.1, 2.0, 3.0)):
        places.add(keyframe(number), bent_way(x))
    assert list(places.keyframes) == [0, 2, 3, 4] and set(places.poses) == set(places.keyframes)


def test_the_parts_of_a_map_are_those_that_links_join() -> None:
    places = chain(5)
    places.links = [link(0, 1), link(3, 4), link(4, 0, inliers=30)]
    assert places.parts() == [[0, 1, 3, 4], [2]]
    places.drop(4)
    assert places.parts() == [[0, 1, 3], [2]], "its links go on to its neighbour"


CYLINDER = Cylinder(1200, 400, 150.0)
# The rig stands 0.5 m above the base and looks to its left.
RIG = PlaceRig(CYLINDER, 0.25, pose(0, 0, 0.2), se3.transform(se3.rotation_exp([0, 0, np.pi / 2]), [0, 0, 0.5]), "ab12")
ROOM = box((-3.0, -2.0), (4.0, 2.5))
LANDMARK = np.array([[2.0, 1.0, 0.28]])  # in the map's rectified frame


def seeing_keyframe(id: int, T: np.ndarray, session: int = 0) -> PlaceKeyframe:
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
        found.add(seeing_keyframe(id, T), T, link)
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
