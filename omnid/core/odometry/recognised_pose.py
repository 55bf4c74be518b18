"""The pose of a frame that was recognised among keyframes: the likeliest one by the patches of the local map.

Keyframes are recognised by a few corners, whose pose errs by centimetres, and which look the same elsewhere along
identical bricks. The patches of all landmarks in view make the pose as exact as any other, and tell which it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.frame_to_map import CoarsePose, FrameToMap
from omnid.core.odometry.local_map import Tracks
from omnid.core.odometry.runner_up_motions import RUNNER_UP_COST
from omnid.core.odometry.stereo_frame import StereoFrame

# Refinements of a recognised pose: the first one brings most patches into reach, the second one aligns them all.
ROUNDS = 2
# Refined poses that differ less are one: refined from two keyframes they differ by millimetres, and what repeats does
# so after some centimetres at least.
SAME_M, SAME_RAD = 0.02, 0.02


def likeliest_recognised(
    frame: StereoFrame, recognised: Iterable[PoseEstimate], exposure: Exposure, steps: FrameToMap
) -> PoseEstimate | None:
    """Return the likeliest of the poses that were recognised, refined; None where another one is nearly as likely."""
    # 1. Refine each pose by the patches.
    found = [refined for each in recognised if (refined := refine(frame, each, exposure, steps)) is not None]
    # 2. Take the likeliest one: the mean cost of a landmark in view is the negative logarithm of the likelihood.
    best = min(found, key=lambda estimate: estimate.cost, default=None)
    if best is None:
        return None
    # 3. Of two poses that explain the patches nearly as well, neither is known.
    rivals = [each for each in found if _is_elsewhere(best, each)]
    if any((each.cost - best.cost) * min(best.in_view, each.in_view) < RUNNER_UP_COST for each in rivals):
        return None
    return best


def refine(frame: StereoFrame, recognised: PoseEstimate, exposure: Exposure, steps: FrameToMap) -> PoseEstimate | None:
    """Return a recognised pose, refined by the keyframes' patches; None where too few agree.

    Corners and patches are two independent supports of the pose: the number of inliers is the smaller one of both.
    """
    none = np.zeros(0, np.intp)
    untracked = Tracks(none, np.zeros((0, 2)), np.zeros((0, 3)), 0)
    refined = recognised
    for _ in range(ROUNDS):
        start = CoarsePose(se3.inverse(refined.T_odom_rect), none, np.zeros(0), np.zeros(0), untracked)
        again = steps.refine(frame, start, exposure)
        if again is None:
            return None
        refined = again
    inliers = min(recognised.inliers, len(refined.landmarks))
    return replace(refined, visible=recognised.visible, tracked=recognised.tracked, inliers=inliers)


def _is_elsewhere(a: PoseEstimate, b: PoseEstimate) -> bool:
    """True if two estimates are different poses."""
    step = se3.log(se3.inverse(a.T_odom_rect) @ b.T_odom_rect)
    return bool(np.linalg.norm(step[:3]) > SAME_M or np.linalg.norm(step[3:]) > SAME_RAD)
