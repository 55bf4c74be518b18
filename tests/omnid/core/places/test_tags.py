"""AprilTags in rendered panoramas: their poses at any azimuth, at the seam, and what is no landmark."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.places.tags import TagFinder
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
CYLINDER = Cylinder(1304, 378, 170.0)
MODEL = StereoModel(CYLINDER, 0.24)
PAD_PX = 40
WINDOW_PX = 60  # columns on both sides of a tag's middle that it may take
SIDE_PX, QUIET_PX = 80, 12  # of the black square in the printed image, and the white border around it


def facing(azimuth: float, distance_m: float, height_m: float = 0.1, turn: float = 0.0, tilt: float = 0.0) -> Array:
    """Return T_rect_tag of a tag that faces the rig, then turned about its vertical and tilted."""
    out, up = -np.array([np.cos(azimuth), np.sin(azimuth), 0]), np.array([0.0, 0, 1])
    R = np.column_stack([np.cross(up, out), up, out])
    at = [distance_m * np.cos(azimuth), distance_m * np.sin(azimuth), height_m]
    return se3.transform(R @ se3.rotation_exp([0, turn, 0]) @ se3.rotation_exp([tilt, 0, 0]), at)


def panorama(tags: list[tuple[int, Array, float]], viewpoint_m: float, seed: int = 0) -> PaddedPanorama:
    """Return the panorama from a height on the axis: tags (pose, edge [m]) before grey, with noise."""
    image = np.full((CYLINDER.height, CYLINDER.width), 120.0)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for id, T_rect_tag, edge_m in tags:
        printed = cv2.copyMakeBorder(
            cv2.aruco.generateImageMarker(family, id, SIDE_PX), *[QUIET_PX] * 4, cv2.BORDER_CONSTANT, value=255
        )
        middle = round(float(CYLINDER.pixels(T_rect_tag[:3, 3][None])[0, 0]))
        columns, rows = np.meshgrid(np.arange(middle - WINDOW_PX, middle + WINDOW_PX), np.arange(CYLINDER.height))
        rays = CYLINDER.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
        T_tag_rect = se3.inverse(T_rect_tag)
        start, along = se3.apply(T_tag_rect, [[0, 0, viewpoint_m]])[0], rays @ T_tag_rect[:3, :3].T
        distance = -start[2] / along[:, 2]
        px = (start + distance[:, None] * along)[:, :2] / edge_m * SIDE_PX
        xy = np.column_stack([px[:, 0], -px[:, 1]]) + SIDE_PX / 2 + QUIET_PX - 0.5
        inside = (distance > 0) & (along[:, 2] < 0) & ((xy >= 0) & (xy < len(printed) - 1)).all(axis=1)
        # Smooth as the optics would, at the resolution of the panorama.
        per_px = max(1.0, SIDE_PX / edge_m * np.linalg.norm(T_rect_tag[:3, 3]) / CYLINDER.focal_px)
        smooth = cv2.GaussianBlur(printed, (0, 0), 0.5 * per_px)
        found = cv2.remap(smooth, xy[inside].astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]
        image[rows.ravel()[inside], columns.ravel()[inside] % CYLINDER.width] = found
    image += np.random.default_rng(seed).normal(0, 1.5, image.shape)
    flat = np.clip(image, 0, 255).astype(np.uint8)
    return PaddedPanorama(np.pad(flat, ((0, 0), (PAD_PX, PAD_PX)), mode="wrap"), PAD_PX)


def both(*tags: tuple[int, Array, float]) -> tuple[PaddedPanorama, PaddedPanorama]:
    """Return both panoramas."""
    return panorama(list(tags), 0.0), panorama(list(tags), MODEL.baseline_m, 1)


@pytest.mark.parametrize(
    ("azimuth", "distance_m", "turn", "tilt"),
    [(0.3, 1.0, 0.0, 0.0), (-2.0, 1.5, 0.5, 0.1), (1.5, 0.8, -0.6, -0.2), (3.13, 1.2, 0.3, 0.0), (-3.1, 2.0, 0.2, 0.1)],
)
def test_a_tag_is_located_by_both_panoramas(azimuth: float, distance_m: float, turn: float, tilt: float) -> None:
    """At any azimuth, also at the seam."""
    T = facing(azimuth, distance_m, turn=turn, tilt=tilt)
    [found] = TagFinder(MODEL, {7: 0.2}).process(*both((7, T, 0.2)))
    error = se3.log(T @ se3.inverse(found.T_rect_tag))
    at = se3.log(se3.inverse(T) @ found.T_rect_tag)
    assert found.id == 7
    assert np.linalg.norm(at[:3]) < 0.015 * distance_m and np.linalg.norm(at[3:]) < 0.1 * distance_m
    assert error @ np.linalg.solve(found.covariance, error) < 30  # chi-squared of six: 99.99 %


def test_the_covariance_of_near_tags_is_that_of_their_errors() -> None:
    squared, finder = [], TagFinder(MODEL, dict.fromkeys(range(4), 0.2))
    for n in range(2):
        tags = [(id, facing(1.5 * id + 0.2 * n, 1.0 + 0.1 * n, turn=0.2 * (id - 1)), 0.2) for id in range(4)]
        for found in finder.process(*both(*tags)):
            error = se3.log(tags[found.id][1] @ se3.inverse(found.T_rect_tag))
            squared.append(error @ np.linalg.solve(found.covariance, error))
    assert len(squared) == 8 and np.mean(squared) < 12


def test_a_tag_of_unknown_size_has_no_pose_and_one_of_another_size_is_refused() -> None:
    seen, finder = both((7, facing(0.5, 1.0), 0.2)), TagFinder(MODEL, {7: 0.3})
    assert TagFinder(MODEL, {8: 0.2}).process(*seen) == []
    assert finder.process(*seen) == [] and finder.refused == 1


def test_two_tags_of_one_number_are_no_landmark() -> None:
    seen = both((7, facing(0.5, 1.0), 0.2), (7, facing(-1.5, 1.0), 0.2), (3, facing(2.5, 1.0), 0.2))
    assert [tag.id for tag in TagFinder(MODEL, {7: 0.2, 3: 0.2}).process(*seen)] == [3]


def test_a_tag_in_one_panorama_only_has_no_pose() -> None:
    lower, _ = both((7, facing(0.5, 1.0), 0.2))
    assert TagFinder(MODEL, {7: 0.2}).process(lower, panorama([], MODEL.baseline_m)) == []
