"""Relocalisation: after a break, keyframes are recognised by SIFT features (Lowe 2004) and matched in 3-D."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import nearby_disparity
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.landmarks import Keyframe
from omnid.core.odometry.pose_estimation import gauss_newton, ransac
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.signature import Signature, signature, similarity
from omnid.core.stereo.triangulation import point_covariance, triangulate
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Set by trial on development seeds, where a line gives no other reason.
RATIO = 0.8  # largest distance of a match, as a share of the second best one's (Lowe 2004)
FEATURES = 1500  # SIFT features detected in a frame
SIGMA_PX = 0.7  # standard deviation of SIFT positions and of the disparities beside them
THRESHOLD_PX = 3.0  # largest error of a view in the consensus set
MIN_MATCHES = 12  # matches, and inliers among them, below which a keyframe is not recognised
# Squared Mahalanobis distance (4 sigma) from which a view is an outlier; so that 0.1 % of right ones are lost.
OUTLIER_SQUARED = 16.0
MAX_KEYFRAMES = 8  # kept in memory
MAX_MATCHED, MAX_DESCRIBED = 4, 1  # keyframes in one search, and those among them whose features are not yet known
ENOUGH_INLIERS = 60  # that end a search
KEYFRAMES_APART_M = 0.3  # a keyframe nearer to the last one replaces it


@dataclass(frozen=True, slots=True)
class KeyframeDescriptor:
    """SIFT features of a keyframe: descriptors (N, 128), views (N, 3) [px], points (N, 3) [m] in its frame."""

    descriptors: NDArray[np.float32]
    views: Array
    points: Array


class Relocaliser:
    """Keep at most max_keyframes keyframes, and find the pose of a frame relative to them."""

    def __init__(
        self, model: StereoModel, max_keyframes: int = MAX_KEYFRAMES, apart_m: float = KEYFRAMES_APART_M
    ) -> None:
        self._model = StereoModel(model.cylinder, model.baseline_m, SIGMA_PX)
        self._apart_m = apart_m
        self._kept: deque[tuple[StereoFrame, Keyframe]] = deque(maxlen=max_keyframes)
        self._descriptors: dict[int, KeyframeDescriptor] = {}
        self._signatures: dict[int, Signature] = {}
        self._searched = 0  # keyframes that the searches since the last addition or success have matched

    def add(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keep a frame and its keyframe; one near the last keyframe replaces it. Features are computed when needed."""
        if self._kept and _distance_m(self._kept[-1][1], keyframe) < self._apart_m:
            self._kept.pop()
        self._kept.append((frame, keyframe))
        self._signatures[frame.seq] = signature(frame.lower)
        self._searched = 0
        kept = {frame.seq for frame, _ in self._kept}
        self._descriptors = {seq: features for seq, features in self._descriptors.items() if seq in kept}
        self._signatures = {seq: found for seq, found in self._signatures.items() if seq in kept}

    def clear(self) -> None:
        """Remove all keyframes."""
        self._kept.clear()
        self._descriptors.clear()
        self._signatures.clear()

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """Return the pose with the most inliers among some keyframes, None where none of them is recognised.

        The most similar keyframes come first, and a search of the next frame goes on where this one ends: all at once
        would take a second, in which the robot has no pose at all.
        """
        here, seen = _describe(frame, self._model), signature(frame.lower)
        ranked = deque(sorted(self._kept, key=lambda kept: -similarity(seen, self._signatures[kept[0].seq])))
        ranked.rotate(-self._searched)
        best: PoseEstimate | None = None
        unknown = 0
        for kept, keyframe in list(ranked)[:MAX_MATCHED]:
            unknown += kept.seq not in self._descriptors
            if unknown > MAX_DESCRIBED:
                break
            self._searched += 1
            pose = self._match(here, frame.seq, kept, keyframe)
            if pose is not None and (best is None or pose.inliers > best.inliers):
                best = pose
            if best is not None and best.inliers >= ENOUGH_INLIERS:
                break
        if best is not None:
            self._searched = 0
        return best

    def _match(self, here: KeyframeDescriptor, seed: int, kept: StereoFrame, keyframe: Keyframe) -> PoseEstimate | None:
        """Return the pose relative to one keyframe, with the complete covariance; None where it is not recognised."""
        if kept.seq not in self._descriptors:
            self._descriptors[kept.seq] = _describe(kept, self._model)
        there = self._descriptors[kept.seq]
        a, b = _matches(there.descriptors, here.descriptors)
        if len(a) < MIN_MATCHES:
            return None
        points, views = there.points[a], here.views[b]
        T_curr_ref, is_inlier = ransac(points, views, self._model, np.random.default_rng(seed), THRESHOLD_PX)
        if is_inlier.sum() < MIN_MATCHES:
            return None
        spread = point_covariance(points[is_inlier], self._model.cylinder, self._model.baseline_m, SIGMA_PX)
        estimate = gauss_newton(points[is_inlier], spread, views[is_inlier], T_curr_ref, self._model)
        inliers = int((estimate.squared < OUTLIER_SQUARED).sum())
        A = se3.adjoint(estimate.T)
        covariance = estimate.covariance + A @ keyframe.covariance @ A.T
        return PoseEstimate(keyframe.T_odom_rect @ se3.inverse(estimate.T), covariance, len(a), len(a), inliers)


def _distance_m(a: Keyframe, b: Keyframe) -> float:
    """Return the distance between the poses of two keyframes."""
    return float(np.linalg.norm(a.T_odom_rect[:3, 3] - b.T_odom_rect[:3, 3]))


def _describe(frame: StereoFrame, model: StereoModel) -> KeyframeDescriptor:
    """Return the SIFT features of the lower panorama whose disparity is known."""
    mask = np.where(frame.usable, 255, 0).astype(np.uint8)
    image = np.ascontiguousarray(frame.lower.panorama)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=FEATURES).detectAndCompute(image, mask)
    if descriptors is None:
        return KeyframeDescriptor(np.zeros((0, 128), np.float32), np.zeros((0, 3)), np.zeros((0, 3)))
    pixels = np.array([k.pt for k in keypoints])
    views = np.column_stack([pixels, pixels[:, 1] + nearby_disparity(frame.disparity, pixels)])
    points = triangulate(views, model.cylinder, model.baseline_m)
    known = np.isfinite(points).all(axis=1)
    return KeyframeDescriptor(np.asarray(descriptors, np.float32)[known], views[known], points[known])


def _matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices (M,) into a and b of descriptors that are mutual nearest neighbours and pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * a @ b.T
    best = squared.argmin(axis=1)
    nearest = squared[np.arange(len(a)), best]
    second = np.partition(squared, 1, axis=1)[:, 1]
    mutual = squared.argmin(axis=0)[best] == np.arange(len(a))
    chosen = np.flatnonzero(mutual & (nearest < RATIO**2 * second))
    return chosen, best[chosen]
