"""State machine of the tracking state: all its transitions are in one pure function.

NOT_STARTED ----------------------------------------------> LOST
STARTED, ACCEPTED ----------------------------------------> TRACKING
STARTED again after an unknown motion --------------------> DEGRADED
ACCEPTED with few inliers, after a gap or a refused frame -> DEGRADED
ACCEPTED with a runner-up that is nearly as likely -----------> DEGRADED
REFUSED, up to lost_after - 1 consecutive frames ---------> DEGRADED
REFUSED from then on -------------------------------------> LOST, and the map is started again when
                                                            restart_after textured frames matched nothing,
                                                            or one was recognised elsewhere
REFUSED, carried on by wheels and gyro -------------------> DEGRADED, and the map is started again likewise
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from omnid.core.odometry.limits import OdometryLimits
from omnid.tracking_state import TrackingState


class FrameOutcome(Enum):
    """Result of the odometry for one frame."""

    STARTED = auto()  # a map was started at this frame
    NOT_STARTED = auto()  # there is no map, and the frame has too few landmarks to start one
    ACCEPTED = auto()  # a pose was found and accepted
    REFUSED = auto()  # no pose was found, or it was refused


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """Facts of one frame that the tracking state depends on."""

    outcome: FrameOutcome
    dt_s: float  # since the previous frame
    inliers: int = 0
    runner_up: bool = False  # another motion explains the images nearly as well
    textured: bool = True  # the frame has enough corners for a map
    elsewhere: bool = False  # it was recognised at a place to which the predicted motion does not lead
    carried: bool = False  # wheels and gyro carry the pose on


@dataclass(frozen=True, slots=True)
class TrackingStatus:
    """Tracking state after a frame, with the counters that lead to the next one."""

    state: TrackingState = TrackingState.LOST
    refused_frames: int = 0  # consecutive
    unmatched_frames: int = 0  # textured frames refused after lost_after others, since the last accepted one
    time_since_fix_s: float = 0.0  # since the last accepted frame
    restart: bool = False  # the map is to be started again at this frame


def next_status(status: TrackingStatus, facts: FrameFacts, limits: OdometryLimits) -> TrackingStatus:
    """Return the status after a frame."""
    time_since_fix_s = status.time_since_fix_s + facts.dt_s

    if facts.outcome is FrameOutcome.STARTED:
        # A map that takes the place of a lost one says nothing about the motion between the two.
        unknown_motion = status.refused_frames > 0 and not (facts.carried or facts.elsewhere)
        return TrackingStatus(TrackingState.DEGRADED if unknown_motion else TrackingState.TRACKING)

    if facts.outcome is FrameOutcome.NOT_STARTED:
        state = TrackingState.DEGRADED if facts.carried else TrackingState.LOST
        return TrackingStatus(state, time_since_fix_s=time_since_fix_s)

    if facts.outcome is FrameOutcome.ACCEPTED:
        few_inliers = facts.inliers < limits.good_inliers
        after_gap = status.refused_frames > 0 or facts.dt_s > limits.max_gap_s
        is_doubtful = few_inliers or after_gap or facts.runner_up
        return TrackingStatus(TrackingState.DEGRADED if is_doubtful else TrackingState.TRACKING)

    refused_frames = status.refused_frames + 1
    if refused_frames < limits.lost_after:
        return TrackingStatus(TrackingState.DEGRADED, refused_frames, status.unmatched_frames, time_since_fix_s)
    unmatched_frames = status.unmatched_frames + int(facts.textured)
    restart = facts.elsewhere or unmatched_frames >= limits.restart_after
    state = TrackingState.DEGRADED if facts.carried else TrackingState.LOST
    return TrackingStatus(state, refused_frames, unmatched_frames, time_since_fix_s, restart)
