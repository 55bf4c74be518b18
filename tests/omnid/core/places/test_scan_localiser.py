"""Localisation by the shape of a room whose walls look otherwise than in the map."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.limits import PlaceLimits
from omnid.core.places.localisation import MapLocaliser, MapPose, OdometryFrame
from omnid.core.places.place_map import PlaceFeatures, PlaceKeyframe, PlaceMap
from omnid.tracking_state import MapState
from tests.omnid.core.mapping.rooms import pose, scan_of
from tests.omnid.core.places.test_particle_filter import CORNERED, MAPPED, SYMMETRIC, drive
from tests.omnid.core.scenery import Array, RenderedCameras

OUT = drive(pose(-0.6, 0.2, 2.0), 24, 0.3)


def saved(walls: Array) -> PlaceMap:
    """Return a map of a drive in a room, without anything by which a view is recognised."""
    places = PlaceMap()
    for id, T in enumerate(MAPPED):
        nothing = PlaceFeatures(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
        places.add(PlaceKeyframe(id, 0, id, T, np.eye(6), np.zeros((16, 128), np.int8),
                                 scan_of(walls, T, 0.02, id).astype(np.float16), nothing), T)
    return places


def poses(cameras: RenderedCameras, walls: Array, limits: PlaceLimits) -> list[MapPose]:
    """Drive through the room with a saved map of it; odom begins at the start of the drive."""
    stereo: StereoFrame = cameras.frame(1, np.eye(4))
    localiser = MapLocaliser(cameras.model, limits, saved(walls))
    found = []
    for number, T in enumerate(OUT):
        T_odom_rect = se3.inverse(OUT[0]) @ T
        frame = OdometryFrame(stereo, number * 300_000_000, T_odom_rect, number * 1e-6 * np.eye(6), False, 0, True,
                              lambda T=T, number=number: scan_of(walls, T, 0.02, 100 + number))
        found.append(localiser.process(frame))
    return found


def test_the_shape_of_the_room_gives_the_pose(cameras: RenderedCameras) -> None:
    found = poses(cameras, CORNERED, PlaceLimits(by_scan=True))
    last = found[-1]
    assert found[0].state is MapState.ODOMETRY_ONLY and last.state is MapState.LOCALIZED
    error = se3.log(se3.inverse(OUT[0]) @ last.T_map_odom)
    assert np.linalg.norm(error[:2]) < 0.15 and abs(error[5]) < np.radians(4)
    at = se3.log(se3.inverse(last.T_map_odom @ se3.inverse(OUT[0]) @ OUT[-1]) @ OUT[-1])
    assert at @ np.linalg.solve(last.covariance, at) < 30 and np.linalg.eigvalsh(last.covariance)[0] > 0


@pytest.mark.parametrize(("walls", "limits"), [(CORNERED, PlaceLimits()), (SYMMETRIC, PlaceLimits(by_scan=True))])
def test_it_stays_odometry_where_it_is_off_or_the_room_is_symmetric(
    cameras: RenderedCameras, walls: Array, limits: PlaceLimits
) -> None:
    assert {one.state for one in poses(cameras, walls, limits)} == {MapState.ODOMETRY_ONLY}
