"""The tracking state along sequences of frames."""

from __future__ import annotations

import pytest

from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.tracking_state_machine import Tracking
from omnid.tracking_state import TrackingState

DT_S = 0.125
# Lost from the third refused frame on, and started again at the second unmatched one.
LIMITS = OdometryLimits(lost_s=0.2, restart_s=0.1, max_gap_s=0.5)
TRACKING, DEGRADED, LOST = TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.LOST


def after(frames: str, limits: OdometryLimits = LIMITS, dt_s: float = DT_S) -> list[tuple[TrackingState, int]]:
    """Return state and resets after each frame.

    s: a map is started, m: none can be, a: accepted, b: in doubt, g: after a gap, j: with another heading, r: refused,
    d: dark, e: recognised elsewhere; in capitals where wheels and gyro carry the pose, w: they also say it stands.
    """
    tracking, found = Tracking(limits), []
    for frame in frames:
        carried = frame.isupper() or frame == "w"
        if frame in "sS":
            tracking.start(carried=carried, is_elsewhere=False)
        elif frame in "mM":
            tracking.miss(dt_s, carried=carried)
        elif frame in "abgj":
            tracking.accept(0.75 if frame == "g" else dt_s, is_doubtful=frame == "b", is_reset=frame == "j")
        else:
            restarts = tracking.refuse(
                dt_s, is_textured=frame not in "dD", is_elsewhere=frame == "e", carried=carried, stayed=frame == "w"
            )
            if restarts:
                tracking.start(carried=carried, is_elsewhere=frame == "e")
        found.append((tracking.state, tracking.resets))
    return found


@pytest.mark.parametrize(
    ("frames", "states", "resets"),
    [
        ("saba", [TRACKING, TRACKING, DEGRADED, TRACKING], 0),
        ("mms", [LOST, LOST, TRACKING], 0),
        ("sga", [TRACKING, DEGRADED, TRACKING], 0),
        ("sraa", [TRACKING, DEGRADED, DEGRADED, TRACKING], 0),
        ("srja", [TRACKING, DEGRADED, DEGRADED, TRACKING], 1),
        ("sdddda", [TRACKING, DEGRADED, DEGRADED, LOST, LOST, DEGRADED], 0),
        # Textured frames that match nothing: the map is started again.
        ("srrrra", [TRACKING, DEGRADED, DEGRADED, LOST, DEGRADED, TRACKING], 1),
        ("sddrda", [TRACKING, DEGRADED, DEGRADED, LOST, LOST, DEGRADED], 0),
        # One recognised elsewhere begins at once, and the gap is known.
        ("srre", [TRACKING, DEGRADED, DEGRADED, TRACKING], 1),
        # Wheels and gyro carry the pose on; the motion is known only where they do so from the last fix on.
        ("sDDDDD", [TRACKING, *[DEGRADED] * 5], 0),
        ("sRRRRa", [TRACKING, DEGRADED, DEGRADED, DEGRADED, TRACKING, TRACKING], 0),
        ("sRrRR", [TRACKING, DEGRADED, DEGRADED, DEGRADED, DEGRADED], 1),
        # They say that it has hardly moved, and the images that the map is not in view.
        ("sRRRw", [TRACKING, DEGRADED, DEGRADED, DEGRADED, DEGRADED], 1),
        # No map can be started.
        ("sMMS", [TRACKING, DEGRADED, DEGRADED, TRACKING], 0),
        ("sMmS", [TRACKING, DEGRADED, LOST, DEGRADED], 1),
    ],
)
def test_states(frames: str, states: list[TrackingState], resets: int) -> None:
    found = after(frames)
    assert [state for state, _ in found] == states and found[-1][1] == resets


@pytest.mark.parametrize(("dt_s", "lost", "started_again"), [(0.25, 2, 4), (0.125, 3, 7), (0.0625, 5, 13)])
def test_times_and_not_frames_decide(dt_s: float, lost: int, started_again: int) -> None:
    found = after("s" + started_again * "r", OdometryLimits(lost_s=0.2, restart_s=0.5), dt_s)[1:]
    assert [state for state, _ in found[:-1]] == [DEGRADED] * (lost - 1) + [LOST] * (started_again - lost)
    assert [resets for _, resets in found] == [0] * (started_again - 1) + [1]
