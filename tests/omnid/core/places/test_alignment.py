"""A map is laid where landmarks are known to be, and turned by where they face."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.places.alignment import Landmark, align, fit, landmark
from omnid.core.places.place_views import base_poses
from tests.omnid.core.mapping.rooms import pose
from tests.omnid.formats.place_maps import RIG, some_places

T_PLAN_MAP = se3.transform(se3.rotation_exp([0, 0, 2.2]), [10.0, -4.0, 1.5])
SEEN = {
    5: Landmark("5", 5, 0.2, (1.0, 2.0, 0.5), 0.3),
    6: Landmark("6", 6, 0.2, (-3.0, 0.5, 1.0), None),
    7: Landmark("7", 7, 0.2, (2.0, -4.0, 0.2), -2.0),
}


def on_plan(mark: Landmark) -> Landmark:
    x, y, z = se3.apply(T_PLAN_MAP, np.array([mark.xyz_m]))[0].tolist()
    return replace(mark, xyz_m=(x, y, z), facing_rad=None if mark.facing_rad is None else mark.facing_rad + 2.2)


KNOWN = {id: on_plan(mark) for id, mark in SEEN.items()}


@pytest.mark.parametrize("ids", [(5,), (5, 6), (6, 7), (5, 6, 7)])
def test_one_landmark_that_faces_somewhere_or_two_tell_where_the_map_lies(ids: tuple[int, ...]) -> None:
    """Landmarks of one side only do not count."""
    T, left_m = fit({id: SEEN[id] for id in ids} | {8: SEEN[5]}, {id: KNOWN[id] for id in ids} | {9: KNOWN[5]})
    np.testing.assert_allclose(T, T_PLAN_MAP, atol=1e-9)
    assert sorted(left_m) == sorted(ids) and max(left_m.values()) < 1e-9


@pytest.mark.parametrize("ids", [(), (6,)])
def test_one_without_facing_does_not(ids: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="facing_deg"):
        fit({id: SEEN[id] for id in ids}, KNOWN)


@pytest.mark.parametrize("apart_m", [0.0, 0.001, 0.27])
def test_landmarks_one_above_the_other_do_not_either(apart_m: float) -> None:
    """The plan is turned by 2.2 rad, which nothing but noise tells; facings that are known tell it."""
    seen = {6: SEEN[6], 7: replace(SEEN[6], id=7, xyz_m=(-3.0 + apart_m, 0.5, 2.0))}
    known = {id: on_plan(mark) for id, mark in seen.items()}
    with pytest.raises(ValueError, match=rf"spread by {apart_m / np.sqrt(2):.2f} m, expected 0.2 m or more: add one"):
        fit(seen, known)
    facing = {id: replace(mark, facing_rad=0.3) for id, mark in seen.items()}
    T, _ = fit(facing, {id: on_plan(mark) for id, mark in facing.items()})
    np.testing.assert_allclose(T, T_PLAN_MAP, atol=1e-9)


def test_what_does_not_fit_is_reported() -> None:
    wrong = replace(KNOWN[6], xyz_m=(KNOWN[6].xyz_m[0] + 1.0, *KNOWN[6].xyz_m[1:]))
    _, left_m = fit(SEEN, KNOWN | {6: wrong})
    assert max(left_m, key=lambda id: left_m[id]) == 6 and left_m[6] > 0.3


def test_a_tag_faces_along_its_z_axis_or_nowhere() -> None:
    wall = pose(1.0, 2.0, 0.0)
    wall[:3, :3] = np.array([[-np.sin(0.7), np.cos(0.7), 0], [0, 0, 1], [np.cos(0.7), np.sin(0.7), 0]]).T
    assert landmark(3, 0.1, wall) == Landmark("3", 3, 0.1, (1.0, 2.0, 0.0), pytest.approx(0.7))
    assert landmark(3, 0.1, np.eye(4)).facing_rad is None


def test_an_aligned_map_is_published_in_the_axes_of_the_plan() -> None:
    places = some_places(4, features=5)
    before = base_poses(places, RIG)
    align(places, RIG, T_PLAN_MAP)
    moved = base_poses(places, RIG) @ RIG.T_base_rect
    np.testing.assert_allclose(moved, T_PLAN_MAP @ before @ RIG.T_base_rect, atol=1e-9)
