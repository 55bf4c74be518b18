"""Tracking state of the odometry, and the times and counts of losses.

A pose by the cameras is TRACKING; DEGRADED with few inliers, few of them in the upper camera, with more than one
hypothesis of the motion, or after a gap or a refused frame. A frame without one is DEGRADED while wheels and gyro carry
the pose, and for lost_s after the first such frame; then it is LOST. The map is started again when textured frames have
matched nothing for restart_s, or one was recognised elsewhere.

The motion since the last fix is unknown from the first frame on to which wheels and gyro carried nothing, or that was
recognised elsewhere. It is unknown, too, where a map is started again although they say that the base has hardly
moved: the old map would be in view, so the base was carried away, or its wheels and gyro are wrong. A map that is
started after an unknown motion is DEGRADED at first, and the reset counter rises.
"""

from __future__ import annotations

from omnid.core.odometry.estimates import OdometryLimits
from omnid.tracking_state import TrackingState


class Tracking:
    """Tracking state after a frame. dt_s: since the frame before. carried: wheels and gyro carry the pose."""

    def __init__(self, limits: OdometryLimits) -> None:
        self._limits = limits
        self.state = TrackingState.LOST
        self.resets = 0  # times that odom has lost its relation to what was published
        self.time_since_fix_s = 0.0  # since the last accepted frame
        self.unknown_motion = False  # nothing measured the whole motion since the last fix
        self._refused_s: float | None = None  # since the first of consecutive refused frames
        self._unmatched_s: float | None = None  # since the first textured one of them after lost_s
        self._has_begun = False  # a map was started once

    @property
    def is_refused(self) -> bool:
        """True if the frame was refused."""
        return self._refused_s is not None

    def accept(self, dt_s: float, *, is_doubtful: bool, is_reset: bool) -> None:
        """Update the state after a frame with a pose; is_reset: its heading is not what was published."""
        is_doubtful |= self.is_refused or dt_s > self._limits.max_gap_s
        self._fix(TrackingState.DEGRADED if is_doubtful else TrackingState.TRACKING, self.resets + is_reset)

    def refuse(
        self, dt_s: float, *, is_textured: bool, is_elsewhere: bool = False, carried: bool = False, stayed: bool = False
    ) -> bool:
        """Update the state after a frame without a pose; return whether the map is to be started again.

        is_textured: it has enough corners for a map. is_elsewhere: it was recognised at a place to which the predicted
        motion does not lead. stayed: the predicted pose has hardly changed since the last fix, and no landmark of the
        map shows it.
        """
        # Of a gap without frames no more than max_gap_s counts, because nothing could be seen in it.
        step_s = min(dt_s, self._limits.max_gap_s)
        self._refused_s = 0.0 if self._refused_s is None else self._refused_s + step_s
        is_lost = self._refused_s >= self._limits.lost_s
        if is_lost and is_textured:
            self._unmatched_s = 0.0 if self._unmatched_s is None else self._unmatched_s + step_s
        is_unmatched = self._unmatched_s is not None and self._unmatched_s >= self._limits.restart_s
        restarts = is_lost and (is_elsewhere or is_unmatched)
        self._has_begun = True
        self._predict(dt_s, is_lost=is_lost, carried=carried)
        self.unknown_motion |= restarts and stayed
        return restarts

    def start(self, *, carried: bool, is_elsewhere: bool = False) -> None:
        """Update the state after a frame at which a map was started."""
        # A map that replaces a lost one says nothing about the motion between the two.
        is_unknown = self.unknown_motion or (self._has_begun and not carried)
        is_doubtful = is_unknown and not is_elsewhere
        self._fix(TrackingState.DEGRADED if is_doubtful else TrackingState.TRACKING, self.resets + is_unknown)

    def miss(self, dt_s: float, *, carried: bool) -> None:
        """Update the state after a frame that has too few landmarks to start a map, where there is none."""
        self._refused_s = self._unmatched_s = None
        self._predict(dt_s, is_lost=True, carried=carried)

    def _fix(self, state: TrackingState, resets: int) -> None:
        self.state, self.resets, self.time_since_fix_s, self.unknown_motion = state, resets, 0.0, False
        self._refused_s, self._unmatched_s, self._has_begun = None, None, True

    def _predict(self, dt_s: float, *, is_lost: bool, carried: bool) -> None:
        self.state = TrackingState.LOST if is_lost and not carried else TrackingState.DEGRADED
        self.time_since_fix_s += dt_s
        self.unknown_motion |= self._has_begun and not carried
