"""Relocalisation of the odometry: after a break, a frame is recognised among its newest keyframes as a place is."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.local_map import Keyframe
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.features import describe
from omnid.core.places.place_map import PlaceFeatures, PlaceLimits
from omnid.core.places.recognition import FAR, NEAR, search
from omnid.core.types.stereo_model import StereoModel


class Relocaliser:
    """Keep the newest keyframes, as many as a search compares, and find the pose of a frame relative to them."""

    def __init__(self, model: StereoModel) -> None:
        self._model = replace(model, cylinder=model.cylinder.full_turn)  # Columns of features are those of a full turn.
        self._kept: deque[tuple[StereoFrame, Keyframe]] = deque(maxlen=FAR.compared)
        self._features: dict[int, PlaceFeatures] = {}

    def add(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keep a frame and its keyframe; one near the last keyframe replaces it. It is described when it is needed."""
        if self._kept:
            apart_m = self._kept[-1][1].T_odom_rect[:3, 3] - keyframe.T_odom_rect[:3, 3]
            if np.linalg.norm(apart_m) < PlaceLimits().keyframe_m:
                self._kept.pop()
        self._kept.append((frame.packed(), keyframe))

    def clear(self) -> None:
        """Remove all keyframes."""
        self._kept.clear()
        self._features.clear()

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """Return the pose with the most inliers, with the complete covariance; None where no keyframe is recognised."""
        # 1. Describe the frame, and the keyframes that no search has described before.
        here = describe(frame)
        self._features = {kept.seq: self._features.get(kept.seq) or describe(kept) for kept, _ in self._kept}
        # 2. Search it among them, as in the map of places.
        keyframes = {keyframe.seq: keyframe for _, keyframe in self._kept}
        poses = {seq: keyframe.T_odom_rect for seq, keyframe in keyframes.items()}
        effort = NEAR._replace(compared=len(keyframes))
        best = search(here, self._features, poses, effort, self._model)
        if best is None:
            return None
        A = se3.adjoint(se3.inverse(best.T_place_rect))
        covariance = best.covariance + A @ keyframes[best.id].covariance @ A.T
        matches = max(best.matches, best.inliers)
        return PoseEstimate(poses[best.id] @ best.T_place_rect, covariance, matches, matches, best.inliers)
