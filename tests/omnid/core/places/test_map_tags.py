"""Tags as landmarks of a map: where they hang, and the pose that one tells where nothing else is known."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.limits import PlaceLimits
from omnid.core.places.localisation import MapLocaliser
from omnid.core.places.map_pose import MapPose, OdometryFrame
from omnid.core.places.map_tags import MAX_VIEWS, MapTag, MapTags, TagView
from omnid.core.places.merge import merge
from omnid.core.places.place_map import PlaceMap
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.tracking_state import MapState
from tests.omnid.core.places.test_localisation import DRIFT, OUT, POSES, odometry, run
from tests.omnid.core.scenery import Array, RenderedCameras, motion_errors
from tests.simulation import Scene, corridor, make_rig

EDGE_M, QUIET_M = 0.54, 0.12  # of the black square, and the white border around it
AT = (2.0, 0.75, 1.2)  # m: the tag's middle; it looks to the right
TAG = MapTag(5, "dock", EDGE_M)
NEAR = slice(8, 13)  # poses that see it well
COVARIANCE = np.diag([0.002] * 3 + [0.01] * 3) ** 2


def hung(scene: Scene, at: tuple[float, float, float] = AT) -> Scene:
    """The scene with a tag, a little before its left wall."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(family, TAG.id, 360), *[80] * 4, cv2.BORDER_CONSTANT, value=255
    )
    half = EDGE_M / 2 + QUIET_M
    corner = np.array([at[0] - half, at[1], at[2] + half])
    return Scene((*scene.rectangles, Rectangle(corner, np.array([2 * half, 0, 0]), np.array([0, 0, -2 * half]), image)))


@pytest.fixture(scope="module")
def tagged() -> RenderedCameras:
    return RenderedCameras.of(make_rig(size=256), hung(corridor(1)))


@pytest.fixture(scope="module")
def frames(tagged: RenderedCameras) -> list[StereoFrame]:
    """The way out, past the tag."""
    return [tagged.frame(500 + k, T) for k, T in enumerate(POSES[NEAR])]


@pytest.fixture(scope="module")
def rebuilt(tagged: RenderedCameras) -> list[StereoFrame]:
    """The same way in a building of which nothing but the tag has stayed."""
    changed = replace(tagged, scene=hung(corridor(8)))
    return [changed.frame(520 + k, T) for k, T in enumerate(POSES[NEAR])]


@pytest.fixture(scope="module")
def known(tagged: RenderedCameras, frames: list[StereoFrame]) -> PlaceMap:
    """The map of the way out; tests take a copy."""
    return mapped(tagged, frames).places


def mapped(cameras: RenderedCameras, frames: list[StereoFrame]) -> MapLocaliser:
    places = PlaceMap()
    places.tags.known = {TAG.id: TAG}
    localiser = MapLocaliser(cameras.model, PlaceLimits(), places)
    run(localiser, exactly(frames))
    return localiser


def exactly(frames: list[StereoFrame], start: int = 0) -> list[OdometryFrame]:
    """The frames with the poses that they were seen from."""
    there = POSES[NEAR]
    return [
        replace(frame, T_odom_rect=se3.inverse(there[0]) @ T)
        for frame, T in zip(odometry(frames, there, start=start), there, strict=True)
    ]


def true_tag() -> Array:
    """Its pose in the map: x to the right and y up as one looks at it, z out of its face."""
    R = np.column_stack([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return np.asarray(se3.inverse(POSES[NEAR][0]) @ se3.transform(R, AT))


def errors_at_the_end(found: list[MapPose], drive: list[OdometryFrame]) -> tuple[float, float]:
    return motion_errors(found[-1].T_map_odom @ drive[-1].T_odom_rect, se3.inverse(POSES[NEAR][0]) @ POSES[NEAR][-1])


def test_a_tag_is_a_landmark_of_the_map(known: PlaceMap) -> None:
    """Its pose follows from its views, and moves with the keyframes."""
    [tag] = known.tags.all_located(known.poses).values()
    error_m, error_rad = motion_errors(tag.T, true_tag())
    assert tag.views >= 2 and tag.rejected == 0
    assert error_m < 0.02 and error_m < 4 * np.sqrt(np.trace(tag.covariance[:3, :3])) and error_rad < 0.05
    moved, by = deepcopy(known), se3.exp([1.0, 2.0, 0, 0, 0, 0.5])
    moved.move({id: by @ T for id, T in moved.poses.items()})
    np.testing.assert_allclose(moved.tags.all_located(moved.poses)[5].T, by @ tag.T, atol=1e-6)


def test_a_tag_tells_the_pose_at_the_start_where_no_view_is_recognised(
    tagged: RenderedCameras, known: PlaceMap, rebuilt: list[StereoFrame]
) -> None:
    drive = exactly(rebuilt, start=1000)
    localiser = MapLocaliser(tagged.model, PlaceLimits(), deepcopy(known), localize_only=True)
    found = run(localiser, drive)
    # A single frame never counts.
    assert [pose.state for pose in found[:2]] == [MapState.ODOMETRY_ONLY] * 2
    assert found[-1].state is MapState.LOCALIZED
    error_m, error_rad = errors_at_the_end(found, drive)
    sigma_m = float(np.sqrt(np.trace(found[-1].covariance[:3, :3])))
    assert error_m < 0.1 and error_rad < 0.1 and error_m < 4 * sigma_m
    assert len(localiser.places.tags.views) == len(known.tags.views)  # the map stays as it is


def test_a_robot_that_stands_before_a_tag_is_localised(
    tagged: RenderedCameras, known: PlaceMap, rebuilt: list[StereoFrame]
) -> None:
    standing = [replace(frame, T_odom_rect=np.eye(4)) for frame in exactly([rebuilt[2]] * 5, start=1000)]
    found = run(MapLocaliser(tagged.model, PlaceLimits(), deepcopy(known)), standing)
    assert found[-1].state is MapState.LOCALIZED
    assert motion_errors(found[-1].T_map_odom, se3.inverse(POSES[NEAR][0]) @ POSES[NEAR][2])[0] < 0.1


def test_without_the_tag_the_same_building_is_unknown(
    tagged: RenderedCameras, known: PlaceMap, rebuilt: list[StereoFrame]
) -> None:
    places = deepcopy(known)
    places.tags = MapTags()
    found = run(MapLocaliser(tagged.model, PlaceLimits(), places), exactly(rebuilt, start=1000))
    assert {pose.state for pose in found} == {MapState.ODOMETRY_ONLY}


def test_a_tag_that_hangs_in_two_places_tells_none(
    tagged: RenderedCameras, known: PlaceMap, rebuilt: list[StereoFrame]
) -> None:
    places = deepcopy(known)
    elsewhere = se3.exp([-3.0, 0, 0, 0, 0, 0])
    places.tags.add(
        [TagView(view.keyframe, view.tag, elsewhere @ view.T_rect_tag, view.covariance) for view in places.tags.views]
    )
    localiser = MapLocaliser(tagged.model, PlaceLimits(), places)
    found = run(localiser, exactly(rebuilt, start=1000))
    assert {pose.state for pose in found} == {MapState.ODOMETRY_ONLY}
    assert localiser.counts["tags_ambiguous"] >= 3


def test_a_tag_closes_a_loop_of_a_drive_that_drifts(
    tagged: RenderedCameras, frames: list[StereoFrame], rebuilt: list[StereoFrame]
) -> None:
    """Past the tag, on to the end, and back to it, where all else has been painted over."""
    localiser, drive = mapped(tagged, frames), exactly(frames)
    drifted = drive[-1].T_odom_rect
    on = [*[se3.exp([0.2, 0, 0, 0, 0, 0]) @ DRIFT] * 12, *[se3.exp([-0.2, 0, 0, 0, 0, 0]) @ DRIFT] * 12]
    for k, step in enumerate(on):
        drifted = drifted @ step
        localiser.process(
            replace(
                drive[-1],
                T_odom_rect=drifted,
                stamp_ns=(50 + k) * 200_000_000,
                lost=False,
                covariance=(k + 1) * COVARIANCE,
                stereo=tagged.darkness(600),
                is_keyframe=False,
            )
        )
    steps = [se3.inverse(a) @ b for a, b in zip(POSES[NEAR][::-1], POSES[NEAR][::-1][1:], strict=False)]
    back: list[OdometryFrame] = []
    for k, step in enumerate([np.eye(4), *steps]):
        drifted = drifted @ step
        back.append(
            replace(
                drive[0],
                T_odom_rect=drifted,
                stamp_ns=(100 + k) * 200_000_000,
                covariance=30 * COVARIANCE,
                stereo=rebuilt[::-1][k],
            )
        )
    found = run(localiser, back)
    truth = np.eye(4)  # the way back ends where the map begins
    assert motion_errors(drifted, truth)[0] > 0.09
    assert found[-1].state is MapState.LOCALIZED and localiser.counts["loops"] >= 3
    assert motion_errors(found[-1].T_map_odom @ drifted, truth)[0] < 0.06


def test_a_keyframe_that_leaves_gives_its_tags_to_the_next(known: PlaceMap) -> None:
    places = deepcopy(known)
    before, seen = places.tags.all_located(places.poses)[5], [view.keyframe for view in places.tags.views]
    places.drop(seen[0])
    after = places.tags.all_located(places.poses)[5]
    assert seen[0] not in {view.keyframe for view in places.tags.views} and len(places.tags.views) == len(seen)
    assert motion_errors(after.T, before.T)[0] < 0.005
    part = places.part([seen[1]])
    assert {view.keyframe for view in part.tags.views} <= {seen[1]} and part.tags.known == {5: TAG}


def test_maps_are_merged_with_their_tags(tagged: RenderedCameras, known: PlaceMap) -> None:
    places, other = deepcopy(known), deepcopy(known)
    assert merge(places, other, tagged.model) > 0
    assert len(places.tags.views) == 2 * len(known.tags.views)
    assert {view.keyframe for view in places.tags.views} <= places.keyframes.keys()
    np.testing.assert_allclose(places.tags.all_located(places.poses)[5].T[:3, 3], true_tag()[:3, 3], atol=0.02)


def test_maps_that_know_a_tag_in_other_sizes_are_not_joined(tagged: RenderedCameras, known: PlaceMap) -> None:
    """A view of a tag that is thought too large is too far away."""
    places, other = deepcopy(known), deepcopy(known)
    other.tags.known = {TAG.id: replace(TAG, size_m=1.25 * EDGE_M)}
    for join in (lambda: merge(places, other, tagged.model), lambda: places.tags.join(other.tags, int)):
        with pytest.raises(ValueError, match=r"tag 5 \(dock\) has an edge of 0\.675 m, but of 0\.54 m before"):
            join()
    assert places.tags.known == {TAG.id: TAG} and len(places.tags.views) == len(known.tags.views)
    assert places.keyframes.keys() == known.keyframes.keys()


def test_the_most_certain_views_of_a_tag_are_kept() -> None:
    tags = MapTags()
    tags.add(TagView(k, 5, np.eye(4), (MAX_VIEWS + 3 - k) * COVARIANCE) for k in range(MAX_VIEWS + 2))
    assert [view.keyframe for view in tags.views] == list(range(2, MAX_VIEWS + 2)) and tags.forgotten == 2
    assert OUT[-1] > AT[0]
