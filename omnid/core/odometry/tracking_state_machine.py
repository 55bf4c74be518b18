"""State machine of the tracking state: all its transitions are in one pure function.

NOT_STARTED ----------------------------------------------> LOST
STARTED, ACCEPTED ----------------------------------------> TRACKING
STARTED again after an unknown motion --------------------> DEGRADED, and the reset counter rises
ACCEPTED with few inliers, after a gap or a refused frame -> DEGRADED
ACCEPTED with a runner-up that is nearly as likely -----------> DEGRADED
ACCEPTED with few inliers that the upper camera shows ------> DEGRADED
REFUSED, less than lost_s after the first such frame -----> DEGRADED
REFUSED from then on -------------------------------------> LOST, and the map is started again when
                                                            textured frames matched nothing for restart_s,
                                                            or one was recognised elsewhere
REFUSED, carried on by wheels and gyro -------------------> DEGRADED, and the map is started again likewise

The motion since the last fix is unknown from the first frame on to which wheels and gyro carried nothing, or that was
recognised elsewhere. It is unknown, too, where a map is started again although they say that the base has hardly
moved: the old map would be in view, so the base was carried away, or its wheels and gyro are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from omnid.core.odometry.estimates import OdometryLimits
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
    lower_only: bool = False  # the upper camera does not show many of the inliers
    runner_up: bool = False  # another motion explains the images nearly as well
    textured: bool = True  # the frame has enough corners for a map
    elsewhere: bool = False  # it was recognised at a place to which the predicted motion does not lead
    turned: bool = False  # an accepted pose has another heading than was published
    carried: bool = False  # wheels and gyro carry the pose on
    stayed: bool = False  # the pose has hardly changed since the last fix, and no landmark of the map shows it


@dataclass(frozen=True, slots=True)
class TrackingStatus:
    """Tracking state after a frame, with the counters that lead to the next one."""

    state: TrackingState = TrackingState.LOST
    refused_s: float | None = None  # from the first of consecutive refused frames to this one; None: it was not refused
    unmatched_s: float | None = None  # the same of textured ones after lost_s; None: there was none
    time_since_fix_s: float = 0.0  # since the last accepted frame
    restart: bool = False  # the map is to be started again at this frame
    has_begun: bool = False  # a map was started once
    unknown_motion: bool = False  # nothing measured the whole motion since the last fix
    resets: int = 0  # times that odom has lost its relation to what was published

    @property
    def is_refused(self) -> bool:
        """True if the frame was refused."""
        return self.refused_s is not None


def next_status(status: TrackingStatus, facts: FrameFacts, limits: OdometryLimits) -> TrackingStatus:
    """Return the status after a frame."""
    unknown_motion = status.unknown_motion or (status.has_begun and not facts.carried)

    if facts.outcome is FrameOutcome.STARTED:
        # A map that takes the place of a lost one says nothing about the motion between the two.
        state = TrackingState.DEGRADED if unknown_motion and not facts.elsewhere else TrackingState.TRACKING
        return TrackingStatus(state, has_begun=True, resets=status.resets + unknown_motion)

    if facts.outcome is FrameOutcome.ACCEPTED:
        few_inliers = facts.inliers < limits.good_inliers
        after_gap = status.is_refused or facts.dt_s > limits.max_gap_s
        is_doubtful = few_inliers or after_gap or facts.lower_only or facts.runner_up
        state = TrackingState.DEGRADED if is_doubtful else TrackingState.TRACKING
        return TrackingStatus(state, has_begun=True, resets=status.resets + facts.turned)

    if facts.outcome is FrameOutcome.REFUSED:
        return _after_refusal(status, facts, limits, unknown_motion=unknown_motion)

    return TrackingStatus(
        TrackingState.DEGRADED if facts.carried else TrackingState.LOST,
        time_since_fix_s=status.time_since_fix_s + facts.dt_s,
        has_begun=status.has_begun,
        unknown_motion=unknown_motion,
        resets=status.resets,
    )


def _after_refusal(
    status: TrackingStatus, facts: FrameFacts, limits: OdometryLimits, *, unknown_motion: bool
) -> TrackingStatus:
    """Return the status after a frame that was refused; unknown_motion: before it is known that it stayed."""
    # Nothing is seen in a time without frames: no more of it counts than goes without a doubt.
    step_s = min(facts.dt_s, limits.max_gap_s)
    refused_s, unmatched_s = _longer(status.refused_s, step_s), status.unmatched_s
    is_lost = refused_s >= limits.lost_s
    if is_lost and facts.textured:
        unmatched_s = _longer(unmatched_s, step_s)
    restart = is_lost and (facts.elsewhere or (unmatched_s is not None and unmatched_s >= limits.restart_s))
    return TrackingStatus(
        TrackingState.LOST if is_lost and not facts.carried else TrackingState.DEGRADED,
        refused_s,
        unmatched_s,
        status.time_since_fix_s + facts.dt_s,
        restart,
        has_begun=True,
        unknown_motion=unknown_motion or (restart and facts.stayed),
        resets=status.resets,
    )


def _longer(since_s: float | None, step_s: float) -> float:
    """Return the time since a first frame after one more; None: this is the first one."""
    return 0.0 if since_s is None else since_s + step_s
