"""Localisation by the shape of a room whose walls look otherwise than in the map."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.limits import PlaceLimits
from omnid.core.places.localisation import MapLocaliser
from omnid.core.places.map_pose import MapPose, OdometryFrame
from omnid.core.places.place_features import PlaceFeatures
from omnid.core.places.place_map import PlaceKeyframe, PlaceMap
from omnid.core.places.scan_localiser import ScanLocaliser
from omnid.tracking_state import MapState
from tests.omnid.core.mapping.rooms import pose, scan_of
from tests.omnid.core.places.test_particle_filter import CORNERED, MAPPED, SYMMETRIC, drive
from tests.omnid.core.scenery import Array, RenderedCameras

NOT_FREE = np.zeros(SECTORS, np.float32)  # as in maps of earlier versions
OUT = drive(pose(-0.6, 0.2, 2.0), 24, 0.3)


def saved(walls: Array, path: Array = MAPPED) -> PlaceMap:
    """Return a map of a drive in a room, without anything by which a view is recognised."""
    places = PlaceMap()
    for id, T in enumerate(path):
        nothing = PlaceFeatures(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
        places.add(
            PlaceKeyframe(
                id,
                0,
                id,
                T,
                np.eye(6),
                np.zeros((16, 128), np.int8),
                scan_of(walls, T, 0.02, id).astype(np.float16),
                NOT_FREE.astype(np.float16),
                nothing,
            ),
            T,
        )
    return places


def poses(cameras: RenderedCameras, walls: Array, limits: PlaceLimits) -> list[MapPose]:
    """Drive through the room with a saved map of it; odom begins at the start of the drive."""
    stereo: StereoFrame = cameras.frame(1, np.eye(4))
    localiser = MapLocaliser(cameras.model, limits, saved(walls))
    found = []
    for number, T in enumerate(OUT):
        T_odom_rect = se3.inverse(OUT[0]) @ T
        frame = OdometryFrame(
            stereo,
            number * 300_000_000,
            T_odom_rect,
            number * 1e-6 * np.eye(6),
            False,
            0,
            True,
            lambda T=T, number=number: scan_of(walls, T, 0.02, 100 + number),
            lambda: NOT_FREE,
        )
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


def test_two_proposed_poses_are_ambiguous_until_moving_tells_them_apart() -> None:
    """Two halls of one shape with a passage between them, in which an alcove lies nearer to one of them."""
    halls = np.concatenate([np.delete(SYMMETRIC, 1, axis=0), np.delete(SYMMETRIC + np.array([10, 0]), 3, axis=0)])
    passage = np.array(
        [
            [[3, -2], [3, -0.6]],
            [[3, 0.6], [3, 2]],
            [[3, 0.6], [7, 0.6]],
            [[7, -2], [7, -0.6]],
            [[7, 0.6], [7, 2]],
            [[3, -0.6], [3.4, -0.6]],
            [[3.4, -0.6], [3.4, -1.8]],
            [[3.4, -1.8], [4.9, -1.8]],
            [[4.9, -1.8], [4.9, -0.6]],
            [[4.9, -0.6], [7, -0.6]],
        ],
        float,
    )
    walls = np.concatenate([halls, passage])
    truth = np.concatenate([drive(pose(-1.0, 0.4, 0.3), 12, 0.6), drive(pose(-0.9, 0.0, 0.0), 24, 0.0)])
    localiser = ScanLocaliser(saved(walls, drive(pose(-2.0, 0.0, 0.0), 65, 0.0)))
    found = []
    for number, T in enumerate(truth):
        scan = scan_of(walls, T, 0.02, number)
        found.append(localiser.process(T, lambda scan=scan: scan, [pose(10.0, 0.0, np.pi) @ truth[0], truth[0]]))
        if number == 12:
            assert localiser.ambiguous >= 3 and localiser.T_map_rect(T) is None
    # In this drive odom is the map.
    located = [one for one in found if one is not None]
    assert found[-1] is not None and all(np.linalg.norm(one.T_map_odom[:2, 3]) < 0.1 for one in located)


@pytest.mark.parametrize(("walls", "limits"), [(CORNERED, PlaceLimits()), (SYMMETRIC, PlaceLimits(by_scan=True))])
def test_it_stays_odometry_where_it_is_off_or_the_room_is_symmetric(
    cameras: RenderedCameras, walls: Array, limits: PlaceLimits
) -> None:
    assert {one.state for one in poses(cameras, walls, limits)} == {MapState.ODOMETRY_ONLY}
