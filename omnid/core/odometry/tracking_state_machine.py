"""State machine of the tracking state: all its transitions are methods that return the next status.

NOT_STARTED ----------------------------------------------> LOST
STARTED, ACCEPTED ----------------------------------------> TRACKING
STARTED again after an unknown motion --------------------> DEGRADED, and the reset counter rises
ACCEPTED with few inliers, after a gap or a refused frame -> DEGRADED
ACCEPTED with more than one hypothesis of the motion -------> DEGRADED
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

from dataclasses import dataclass, replace

from omnid.core.odometry.estimates import OdometryLimits
from omnid.tracking_state import TrackingState


@dataclass(frozen=True, slots=True)
class TrackingStatus:
    """Tracking state after a frame, with the counters that lead to the next one; dt_s: since the frame before.

    carried: wheels and gyro carry the pose on. elsewhere: the frame was recognised at a place to which the predicted
    motion does not lead.
    """

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

    def started(self, *, carried: bool = False, elsewhere: bool = False) -> TrackingStatus:
        """Return the status after a frame at which a map was started."""
        # A map that takes the place of a lost one says nothing about the motion between the two.
        unknown_motion = self._is_unknown(carried)
        state = TrackingState.DEGRADED if unknown_motion and not elsewhere else TrackingState.TRACKING
        return TrackingStatus(state, has_begun=True, resets=self.resets + unknown_motion)

    def without_map(self, dt_s: float, *, carried: bool = False) -> TrackingStatus:
        """Return the status after a frame that has too few landmarks to start a map, where there is none."""
        return TrackingStatus(
            TrackingState.DEGRADED if carried else TrackingState.LOST,
            time_since_fix_s=self.time_since_fix_s + dt_s,
            has_begun=self.has_begun,
            unknown_motion=self._is_unknown(carried),
            resets=self.resets,
        )

    def accepted(
        self, dt_s: float, limits: OdometryLimits, *, doubtful: bool = False, turned: bool = False
    ) -> TrackingStatus:
        """Return the status after a frame whose pose was accepted; turned: its heading is not what was published.

        doubtful: few inliers, few of them in the upper camera, or another motion that explains the images as well.
        """
        doubtful = doubtful or self.is_refused or dt_s > limits.max_gap_s
        state = TrackingState.DEGRADED if doubtful else TrackingState.TRACKING
        return TrackingStatus(state, has_begun=True, resets=self.resets + turned)

    def refused(
        self,
        dt_s: float,
        limits: OdometryLimits,
        *,
        textured: bool = True,
        elsewhere: bool = False,
        carried: bool = False,
        stayed: bool = False,
    ) -> TrackingStatus:
        """Return the status after a frame without a pose; textured: it has enough corners for a map.

        stayed: the predicted pose has hardly changed since the last fix, and no landmark of the map shows it.
        """
        # Nothing is seen in a time without frames: no more of it counts than goes without a doubt.
        step_s = min(dt_s, limits.max_gap_s)
        refused_s, unmatched_s = _longer(self.refused_s, step_s), self.unmatched_s
        is_lost = refused_s >= limits.lost_s
        if is_lost and textured:
            unmatched_s = _longer(unmatched_s, step_s)
        restart = is_lost and (elsewhere or (unmatched_s is not None and unmatched_s >= limits.restart_s))
        return replace(
            self,
            state=TrackingState.LOST if is_lost and not carried else TrackingState.DEGRADED,
            refused_s=refused_s,
            unmatched_s=unmatched_s,
            time_since_fix_s=self.time_since_fix_s + dt_s,
            restart=restart,
            has_begun=True,
            unknown_motion=self._is_unknown(carried) or (restart and stayed),
        )

    def _is_unknown(self, carried: bool) -> bool:
        return self.unknown_motion or (self.has_begun and not carried)


def _longer(since_s: float | None, step_s: float) -> float:
    """Return the time since a first frame after one more; None: this is the first one."""
    return 0.0 if since_s is None else since_s + step_s
