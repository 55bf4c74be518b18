"""The part of recognition that odometry needs after a break."""

from __future__ import annotations

from typing import Protocol

from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.landmarks import Keyframe
from omnid.core.odometry.stereo_frame import StereoFrame


class KeyframeLocaliser(Protocol):
    """A bounded store of keyframes that gives the pose of a frame among them; see core/places."""

    def add(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keep a keyframe and its frame."""

    def clear(self) -> None:
        """Drop all keyframes."""

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """Return the pose of a frame among the keyframes; None if it fits none."""
