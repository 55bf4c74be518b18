"""AprilTags in the panoramas as landmarks with names: their poses in the rectified frame, with covariance.

Olson 2011, "AprilTag: A robust and flexible visual fiducial system"; the detector is OpenCV's. Landmarks are the future
work of Dang et al. 2012, section VI.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.pose_estimation import gauss_newton, rigid_fit
from omnid.core.places.pose_graph import PoseEdges, optimise
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

MAX_TAG: Final = 586  # Largest number of the family 36h11; exact: it has 587.
MAX_NAME: Final = 64  # characters; so that files of any origin are bounded
SIZES_M: Final = (0.005, 10.0)  # Limits of a tag's edge, so that nonsense is refused.
# Standard deviation of a corner, that of the curvature in the panorama included; by trial on development seeds.
SIGMA_PX: Final = 0.35
# Mean squared error of the corners, in SIGMA_PX, of what is a tag of the known size; because it is three standard
# deviations.
LARGEST_SQUARED: Final = 9.0
CORRELATED_VIEWS: Final = 4.0  # views of a tag that count as one, because errors of the rig are common to them
# Corners of a tag of edge 1, in the order of the detector so that they are its pixels' points, seen from the front: x
# to the right, y up, z out of the face.
CORNERS: Final = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])


@dataclass(frozen=True, slots=True, eq=False)
class TagPose:
    """Pose of a tag: origin in its middle, x to the right and y up for a viewer in front of it, z out of its face."""

    id: int
    T_rect_tag: Array  # (4, 4)
    covariance: Array  # (6, 6) [t; r] of small motions in the rectified frame: T = exp(xi) T_rect_tag
    squared: float  # mean squared error of its corners' rows and columns, in standard deviations


class TagFinder:
    """Finds the tags of a family, of which those with a known size get a pose."""

    def __init__(self, model: StereoModel, sizes_m: Mapping[int, float]) -> None:
        """sizes_m: edge of the black square of each tag, by its id."""
        self._model, self._sizes_m = replace(model, sigma_px=SIGMA_PX), dict(sizes_m)
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.minMarkerPerimeterRate = 0.01  # by the panorama's width
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self._detector: Any = cv2.aruco.ArucoDetector(family, parameters)
        self.refused = 0  # tags whose corners fit no tag of their size

    def process(self, lower: PaddedPanorama, upper: PaddedPanorama) -> list[TagPose]:
        """Return the poses of the tags that both panoramas show, in the order of their ids."""
        # 1. Detect the corners of tags in both panoramas.
        in_lower, in_upper = self._corners(lower), self._corners(upper)
        # 2. Estimate the pose of each tag of known size that both show.
        found = []
        for id in sorted(in_lower.keys() & in_upper.keys() & self._sizes_m.keys()):
            pose = self._pose(id, in_lower[id], in_upper[id])
            if pose is None:
                self.refused += 1
            else:
                found.append(pose)
        return found

    def _corners(self, panorama: PaddedPanorama) -> dict[int, Array]:
        """Return the corners (4, 2) [px] of each tag that is seen once; columns are those without padding."""
        corners, ids, _ = self._detector.detectMarkers(panorama.image)
        found: dict[int, Array] = {}
        twice = set[int]()
        for id, four in zip([] if ids is None else ids.ravel().tolist(), corners, strict=True):
            pixels = four.reshape(4, 2).astype(float) - [panorama.pad_px, 0]
            columns = pixels[:, 0].mean()
            pixels[:, 0] -= panorama.period_px * np.floor(columns / panorama.period_px)
            # The padding shows a tag at the seam twice; another tag of the same number is no landmark.
            if id in found and np.abs(self._apart(found[id], pixels)).max() > 2.0:
                twice.add(id)
            found[id] = pixels
        return {id: pixels for id, pixels in found.items() if id not in twice}

    def _apart(self, a: Array, b: Array) -> Array:
        """Return differences (4, 2) [px] of corners."""
        return np.column_stack([self._model.cylinder.wrap(a[:, 0] - b[:, 0]), a[:, 1] - b[:, 1]])

    def _pose(self, id: int, lower: Array, upper: Array) -> TagPose | None:
        """Return the pose that explains the corners (4, 2) in both panoramas; None where none does."""
        views = np.column_stack([lower, upper[:, 1]])
        # Both panoramas measure the column.
        views[:, 0] += 0.5 * self._model.cylinder.wrap(upper[:, 0] - lower[:, 0])
        seen = triangulate(views, self._model.cylinder, self._model.baseline_m)
        if not np.isfinite(seen).all():
            return None
        points = CORNERS * self._sizes_m[id]
        start = rigid_fit(points, seen)
        result = gauss_newton(points, np.zeros((4, 3, 3)), views, start, self._model)
        squared = float(result.squared.mean()) / 3
        if not np.isfinite(result.T).all() or squared > LARGEST_SQUARED:
            return None
        return TagPose(id, result.T, max(1.0, squared) * result.covariance, squared)


@dataclass(frozen=True, slots=True, eq=False)
class TagEstimate:
    """Pose of a tag from several views; covariance (6, 6) [t; r] in the tag's axes: T exp(xi)."""

    T: Array  # (4, 4) in the frame of the poses it was made of
    covariance: Array
    views: int  # number of views that agree
    rejected: int


def fused(poses: Sequence[Array], covariances: Sequence[Array]) -> TagEstimate:
    """Return the pose that most of the poses (4, 4) of a tag agree on; covariances (6, 6) in the tag's axes."""
    count = len(poses)
    edges = PoseEdges(np.tile([0, 1], (count, 1)), np.array(poses), np.array(covariances), np.ones(count, bool))
    start = poses[int(np.argmin([np.trace(one) for one in covariances]))]
    result = optimise(np.stack([np.eye(4), start]), edges)
    accepted = int(result.accepted.sum())
    return TagEstimate(result.poses[1], CORRELATED_VIEWS * result.covariance, accepted, count - accepted)


def in_tag_axes(pose: TagPose) -> Array:
    """Return the covariance (6, 6) of a tag's pose in the tag's axes."""
    A = se3.adjoint(se3.inverse(pose.T_rect_tag))
    return np.asarray(A @ pose.covariance @ A.T)
