"""Where am I? After darkness or a blow, keyframes are recognised by SIFT features (Lowe 2004) and matched in 3-D."""

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
from omnid.core.odometry.pose_estimation import StereoModel, gauss_newton, ransac
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.stereo.triangulation import point_covariance, triangulate

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

RATIO = 0.8  # a match must be this much nearer than the second best (Lowe 2004)
FEATURES = 1500
SIGMA_PX = 0.7  # deviation of SIFT positions and of the disparities beside them


@dataclass(frozen=True, slots=True)
class KeyframeDescriptor:
    """Recognisable points of a keyframe: SIFT descriptors (N, 128), views (N, 3) px, points (N, 3) m in its frame."""

    descriptors: NDArray[np.float32]
    views: Array
    points: Array


class Relocaliser:
    """Remembers a bounded number of keyframes, and finds the pose of a new sight among them."""

    def __init__(self, model: StereoModel, places: int = 8, apart_m: float = 0.3) -> None:
        self._model = StereoModel(model.cylinder, model.baseline_m, SIGMA_PX)
        self._apart_m = apart_m
        self._sights: deque[tuple[StereoFrame, Keyframe]] = deque(maxlen=places)
        self._places: dict[int, KeyframeDescriptor] = {}

    def remember(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keeps a sight and its pose; one close to the last replaces it. Nothing is computed until it is needed."""
        if self._sights and _distance_m(self._sights[-1][1], keyframe) < self._apart_m:
            self._sights.pop()
        self._sights.append((frame, keyframe))
        kept = {frame.seq for frame, _ in self._sights}
        self._places = {seq: place for seq, place in self._places.items() if seq in kept}

    def forget(self) -> None:
        """Forgets all keyframes."""
        self._sights.clear()
        self._places.clear()

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """The best supported pose of a sight relative to the keyframes, newest first; None where none fits."""
        here = _describe(frame, self._model)
        fits = (self._match(here, *remembered, frame.seq) for remembered in reversed(self._sights))
        return max((fit for fit in fits if fit), key=lambda fit: fit.inliers, default=None)

    def _match(
        self, here: KeyframeDescriptor, remembered: StereoFrame, keyframe: Keyframe, seed: int
    ) -> PoseEstimate | None:
        if remembered.seq not in self._places:
            self._places[remembered.seq] = _describe(remembered, self._model)
        there = self._places[remembered.seq]
        a, b = _pairs(there.descriptors, here.descriptors)
        if len(a) < 12:
            return None
        points, views = there.points[a], here.views[b]
        T_curr_ref, agree = ransac(points, views, self._model, np.random.default_rng(seed), 3.0)
        if agree.sum() < 12:
            return None
        spread = point_covariance(points[agree], self._model.cylinder, self._model.baseline_m, SIGMA_PX)
        estimate = gauss_newton(points[agree], spread, views[agree], T_curr_ref, self._model)
        inliers = int((estimate.squared < 16).sum())
        A = se3.adjoint(estimate.T)
        covariance = estimate.covariance + A @ keyframe.covariance @ A.T
        return PoseEstimate(keyframe.T_odom_rect @ se3.inverse(estimate.T), covariance, len(a), len(a), inliers)


def _distance_m(a: Keyframe, b: Keyframe) -> float:
    return float(np.linalg.norm(a.T_odom_rect[:3, 3] - b.T_odom_rect[:3, 3]))


def _describe(frame: StereoFrame, model: StereoModel) -> KeyframeDescriptor:
    """The SIFT features of the lower panorama whose disparity is known."""
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


def _pairs(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices into a and b of descriptors that are each other's clear nearest."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * a @ b.T
    best = squared.argmin(axis=1)
    nearest = squared[np.arange(len(a)), best]
    second = np.partition(squared, 1, axis=1)[:, 1]
    mutual = squared.argmin(axis=0)[best] == np.arange(len(a))
    chosen = np.flatnonzero(mutual & (nearest < RATIO**2 * second))
    return chosen, best[chosen]
