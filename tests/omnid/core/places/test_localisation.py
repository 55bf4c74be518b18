"""A drive there and back along a corridor whose odometry drifts: the map corrects it, and states what is known."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.localisation import SEARCHES, MapLocaliser, MapPose, OdometryFrame
from omnid.core.places.place_map import PlaceLimits
from omnid.tracking_state import MapState
from tests.omnid.core.scenery import Array, RenderedCameras, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

STEP_M = 0.2
OUT = np.arange(0.0, 4.2, STEP_M)
# The way back is 0.15 m to the left of the way out, in the opposite direction.
XY = np.concatenate([np.column_stack([OUT, 0 * OUT]), np.column_stack([OUT[::-1], 0 * OUT + 0.15])])
POSES = planar_poses(XY, np.repeat([0.0, np.pi], len(OUT)))
DRIFT = se3.exp([0.004, 0.003, 0.0, 0, 0, np.deg2rad(0.08)])  # of each step
COVARIANCE = np.diag([0.002] * 3 + [np.deg2rad(0.05)] * 3) ** 2  # of each step


@pytest.fixture(scope="module")
def frames(cameras: RenderedCameras) -> list[StereoFrame]:
    return [cameras.frame(100 + k, T) for k, T in enumerate(POSES)]


def odometry(
    frames: Sequence[StereoFrame], poses: Array = POSES, resets: int = 0, start: int = 0
) -> list[OdometryFrame]:
    """The frames with poses that drift, from the identity on."""
    found, T, covariance = [], np.eye(4), np.zeros((6, 6))
    for k, stereo in enumerate(frames):
        if k:
            step = se3.inverse(poses[k - 1]) @ poses[k] @ DRIFT
            A = se3.adjoint(se3.inverse(step))
            T, covariance = T @ step, A @ covariance @ A.T + COVARIANCE
        found.append(
            OdometryFrame(
                stereo,
                (start + k) * 200_000_000,
                T,
                covariance,
                False,
                resets,
                True,
                lambda: (np.full(SECTORS, np.nan, np.float32), np.zeros(SECTORS, np.float32)),
            )
        )
    return found


def run(localiser: MapLocaliser, frames: Sequence[OdometryFrame]) -> list[MapPose]:
    return [localiser.process(frame) for frame in frames]


@pytest.fixture(scope="module")
def out(cameras: RenderedCameras, frames: list[StereoFrame]) -> MapLocaliser:
    """The way out; tests take a copy."""
    localiser = MapLocaliser(cameras.model, PlaceLimits())
    run(localiser, odometry(frames[: len(OUT)]))
    return localiser


def test_loops_halve_the_error_and_odom_never_jumps(
    cameras: RenderedCameras, frames: list[StereoFrame], out: MapLocaliser
) -> None:
    localiser, drive = deepcopy(out), odometry(frames)
    found = run(MapLocaliser(cameras.model, PlaceLimits()), drive)
    # The same frames give the same bytes.
    for a, b in zip(run(localiser, drive[len(OUT) :]), found[len(OUT) :], strict=True):
        assert a.T_map_odom.tobytes() == b.T_map_odom.tobytes() and a.covariance.tobytes() == b.covariance.tobytes()
    truth = [se3.inverse(POSES[0]) @ T for T in POSES]
    by_odometry = [motion_errors(frame.T_odom_rect, T)[0] for frame, T in zip(drive, truth, strict=True)]
    in_map = [
        motion_errors(pose.T_map_odom @ frame.T_odom_rect, T)[0]
        for pose, frame, T in zip(found, drive, truth, strict=True)
    ]
    assert by_odometry[-1] > 0.1 and in_map[-1] < 0.3 * by_odometry[-1]
    assert localiser.counts["loops"] >= 5
    # The map's end error lies within what the covariance says, which is far less than that of odometry.
    sigma = float(np.sqrt(np.trace(found[-1].covariance[:3, :3])))
    assert in_map[-1] < 4 * sigma and sigma < 0.1
    states = [pose.state for pose in found]
    assert states[0] is MapState.ODOMETRY_ONLY and states[-1] is MapState.LOCALIZED
    first = states.index(MapState.LOCALIZED)
    assert all(np.array_equal(pose.T_map_odom, np.eye(4)) for pose in found[:first])
    # A place that was left 3 m ago is recognised within 1 m.
    assert first * STEP_M < 3.0 + OUT[-1] / 2 + 1.0 + 1.0


def test_a_robot_that_was_carried_away_is_localised_again(frames: list[StereoFrame], out: MapLocaliser) -> None:
    """After the reset odom is meaningless in the map until three frames agree."""
    localiser = deepcopy(out)
    there = list(range(len(OUT) + 8, len(OUT) + 14))
    lost = replace(odometry(frames)[0], lost=True)
    assert localiser.process(lost).state is MapState.LOST
    again = odometry([frames[k] for k in there], POSES[there], resets=1, start=1000)
    found = run(localiser, again)
    assert found[0].state is MapState.ODOMETRY_ONLY and found[-1].state is MapState.LOCALIZED
    error_m, error_rad = motion_errors(
        found[-1].T_map_odom @ again[-1].T_odom_rect, se3.inverse(POSES[0]) @ POSES[there[-1]]
    )
    assert error_m < 0.25 and error_rad < 0.05  # the drift of the drive there


def test_a_motion_that_odometry_missed_is_found_by_the_places_that_contradict_it(
    cameras: RenderedCameras, frames: list[StereoFrame], out: MapLocaliser
) -> None:
    """As after a lift, or on wheels that slip in the dark."""
    carried_m, seen = 1.2, [*range(7), *range(13, len(POSES))]
    true, by_odometry = POSES[seen], POSES[seen].copy()
    by_odometry[7:, 0, 3] -= carried_m
    localiser = MapLocaliser(cameras.model, PlaceLimits(), deepcopy(out).map())
    saved = set(localiser.places.keyframes)
    drive = odometry([frames[k] for k in seen], by_odometry, start=1000)
    found = run(localiser, drive)
    truth = [se3.inverse(POSES[0]) @ T for T in true]
    error_m = [
        motion_errors(pose.T_map_odom @ frame.T_odom_rect, T)[0]
        for pose, frame, T in zip(found, drive, truth, strict=True)
    ]
    was_wrong = [k for k in range(7, len(found)) if found[k].is_known and error_m[k] > 0.5]
    # First the wrong pose is trusted, then it is reported as unknown.
    assert was_wrong and not found[was_wrong[-1] + 1].is_known
    assert found[-1].state is MapState.LOCALIZED and error_m[-1] < 0.25
    # Keyframes that were placed wrongly are not saved.
    at = {frame.stamp_ns: T for frame, T in zip(drive, truth, strict=True)}
    kept = localiser.map()
    new = [keyframe for id, keyframe in kept.keyframes.items() if id not in saved]
    assert new and max(motion_errors(kept.poses[one.id], at[one.stamp_ns])[0] for one in new) < 0.5


def test_a_robot_at_rest_in_the_dark_is_localised_when_there_is_light(
    cameras: RenderedCameras, frames: list[StereoFrame], out: MapLocaliser
) -> None:
    """However long it was dark: longer than all searches of the dark images take."""
    at, dark, light = len(OUT) + 8, SEARCHES + 2, 4
    localiser = MapLocaliser(cameras.model, PlaceLimits(), deepcopy(out).places)
    seen = [cameras.darkness(400)] * dark + [frames[at]] * light
    standing = [replace(odometry([stereo])[0], stamp_ns=k * 200_000_000) for k, stereo in enumerate(seen)]
    found = run(localiser, standing)
    assert {pose.state for pose in found[: dark + 1]} == {MapState.ODOMETRY_ONLY}
    assert found[-1].state is MapState.LOCALIZED
    assert motion_errors(found[-1].T_map_odom, se3.inverse(POSES[0]) @ POSES[at])[0] < 0.25


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_saved_map_is_extended_by_another_run_elsewhere_in_it_unless_it_is_for_localisation_alone(
    cameras: RenderedCameras, frames: list[StereoFrame], out: MapLocaliser, localize_only: bool
) -> None:
    known = deepcopy(out).places
    before = {id: pose.copy() for id, pose in known.poses.items()}
    back = slice(len(OUT) + 3, len(OUT) + 14)
    drive = odometry(frames[back], POSES[back])
    localiser = MapLocaliser(cameras.model, PlaceLimits(), known, localize_only=localize_only)
    found = run(localiser, drive)
    assert found[-1].state is MapState.LOCALIZED
    error_m, _ = motion_errors(found[-1].T_map_odom @ drive[-1].T_odom_rect, se3.inverse(POSES[0]) @ POSES[back][-1])
    assert error_m < 0.25
    new = [keyframe for id, keyframe in known.keyframes.items() if id not in before]
    assert new and {keyframe.session for keyframe in new} == {1}
    assert any(len(keyframe.features.views) for keyframe in new) != localize_only
    if localize_only:
        for id, pose in before.items():
            np.testing.assert_allclose(known.poses[id], pose, atol=1e-9)


def test_in_a_saved_map_the_covariance_is_that_of_the_place_and_not_of_odom(
    cameras: RenderedCameras, frames: list[StereoFrame], out: MapLocaliser
) -> None:
    """A run begins with the covariance 0 in odom; where that is in the map is what its first loops say."""
    (one,) = odometry([frames[30]])
    localiser = MapLocaliser(cameras.model, PlaceLimits(), deepcopy(out.places))
    found = run(localiser, [replace(one, stamp_ns=k * 200_000_000) for k in range(6)])
    sigmas_m = [float(np.sqrt(np.trace(pose.covariance[:3, :3]))) for pose in found]
    for pose, sigma_m in zip(found, sigmas_m, strict=True):
        assert 0.002 < sigma_m < 0.1 if pose.state is MapState.LOCALIZED else sigma_m > 1000.0
    assert {pose.state for pose in found} == {MapState.ODOMETRY_ONLY, MapState.LOCALIZED}


def test_a_saved_map_is_joined_with_the_oldest_place(
    cameras: RenderedCameras, frames: list[StereoFrame], out: MapLocaliser
) -> None:
    """A run that never recognised anything is left out, and counted."""
    elsewhere = replace(cameras, scene=corridor(8))
    localiser = MapLocaliser(cameras.model, PlaceLimits(), deepcopy(out).places)
    run(localiser, odometry([elsewhere.frame(320, POSES[0])]))
    assert localiser.counts["unjoined"] == 1 and len(localiser.places) == len(out.places) + 1
    saved = localiser.map()
    assert list(saved.keyframes) == list(out.places.keyframes) and len(saved.links) == len(out.places.links)
