"""Tags that a run sees: their poses in the map as it is at the end."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.config import Config
from omnid.core.places.tags import TagPose
from omnid.messages import MapKeyframes, OdometryUpdate, PlaceUpdate
from omnid.simulation.rendering.rigs import make_rig
from omnid.sinks.tag_collector import TagCollector
from omnid.stages.geometry import geometry
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]

TAG_M = np.array([5.0, 0.0, 1.0])
DRIFT = 0.02  # to the left, of odometry, by the way
STEP_M, SEEN_M, PAIRS = 0.5, 5.0, 60


@dataclass
class Found:
    """Finds what it is given in place of panoramas."""

    refused = 0

    def process(self, lower: TagPose | None, _: object) -> list[TagPose]:
        return [] if lower is None else [lower]


def at(x_m: float, y_m: float) -> Array:
    return se3.transform(np.eye(3), [x_m, y_m, 0.0])


def collected(
    moved_m: float, *, has_map: bool = True, is_late: bool = False, drift: float = DRIFT, odd_views: int = 0
) -> TagCollector:
    """Return the collector of a drive past a tag; the map moves its keyframes to the left by moved_m at the end.

    is_late: each pair comes after its pose in the map; odd_views: views that show the tag two metres higher.
    """
    place = geometry(make_rig(size=256), Config().panorama)
    collector = TagCollector(place, {1: 0.16})
    collector._finder = cast(Any, Found())
    T_rig_rect = place.T_rig_rect
    T_map_rect = {number: at(number * STEP_M, -moved_m) @ T_rig_rect for number in range(PAIRS)}
    for number in range(PAIRS):
        T_map_rig = at(number * STEP_M, 0.0)
        tag = None
        if number * STEP_M < SEEN_M:
            up = np.array([0.0, 0.0, 2.0 * (number < odd_views)])
            T_rect_tag = se3.inverse(T_map_rig @ T_rig_rect) @ se3.transform(np.eye(3), TAG_M + up)
            tag = TagPose(1, T_rect_tag, 1e-6 * np.eye(6), 1.0)
        odometry = object.__new__(OdometryUpdate)
        depth = SimpleNamespace(panoramas=SimpleNamespace(lower=tag, upper=None))
        T_odom_rig = at(number * STEP_M, drift * number * STEP_M)
        for name, value in (
            ("seq", number),
            ("state", TrackingState.TRACKING),
            ("T_odom_rig", T_odom_rig),
            ("depth", depth),
        ):
            object.__setattr__(odometry, name, value)
        if not is_late:
            collector.process(odometry)
        if has_map:
            keyframes = MapKeyframes(dict.fromkeys(T_map_rect, 0), T_map_rect if number == PAIRS - 1 else {})
            collector.process(
                PlaceUpdate(
                    number,
                    number,
                    T_map_rig @ se3.inverse(T_odom_rig),
                    T_map_rig,
                    np.eye(6),
                    MapState.LOCALIZED,
                    number,
                    keyframes=keyframes,
                )
            )
        if is_late:
            collector.process(odometry)
    return collector


@pytest.mark.parametrize(("moved_m", "is_late"), [(0.0, False), (0.3, False), (0.3, True)])
def test_a_tag_is_where_the_map_has_its_keyframes_at_the_end(moved_m: float, is_late: bool) -> None:
    """Odometry has drifted by half a metre since it was passed, and a loop has moved the keyframes."""
    tag = collected(moved_m, is_late=is_late).tags()[1]
    base = geometry(make_rig(size=256), Config().panorama).rig.T_base_rig
    np.testing.assert_allclose(se3.inverse(base) @ tag.T, se3.transform(np.eye(3), TAG_M - [0, moved_m, 0]), atol=1e-6)
    assert tag.rejected == 0 and tag.views == round(SEEN_M / STEP_M)


def test_without_a_map_it_is_where_odometry_saw_it() -> None:
    tag = collected(0.3, has_map=False, drift=0.0).tags()[1]
    base = geometry(make_rig(size=256), Config().panorama).rig.T_base_rig
    np.testing.assert_allclose(se3.inverse(base) @ tag.T, se3.transform(np.eye(3), TAG_M), atol=1e-6)


def test_a_tag_that_is_seen_in_several_places_is_left_out() -> None:
    assert not collected(0.0, odd_views=4).tags()
    assert collected(0.0, odd_views=1).tags()[1].rejected == 1
