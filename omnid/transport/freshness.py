"""When was a message sent? One rule for all that can begin, resume or release a motion.

All times here are the robot's CLOCK_MONOTONIC. A message says when it was sent by

    echo   the robot's own time, as the robot told it to the sender, attached; no clock of anybody else is in it
    stamp  Unix time by the sender's clock, in its header or attached; compared with the robot's clocks

and the nearer of the two to its arrival counts. What can begin a motion (arm, a goal, the first setpoint of a stream,
the release of a contact) must say it, and have been sent within stale_s of its arrival: a message that waited in a
network, or was recorded, begins none. What goes on with a motion is as old as it says, and at least as its arrival; it
need not say anything. What ends a motion is taken in any case.
"""

from __future__ import annotations

import secrets
import time
from typing import Final

from omnid.core.nanoseconds import S_PER_NS
from omnid.engine.robot_clock import RobotClock, duration_words
from omnid.transport.requests import Refused, Request

UNSTAMPED: Final = "no stamp"
TOO_OLD, EARLY = "too old", "stamp in the future"
_CLOCKS: Final = (
    "synchronise the clocks, or stamp with the robot's own time: omnid.client attaches it, another program may repeat "
    "the stamp of the newest odom; controller.deadlines.command_s is the longest age"
)
_ADVICE: Final = {
    UNSTAMPED: "fill in the stamp (ROS 2: `header: auto`; String: last word stamp=NANOSECONDS), or repeat that of odom",
    TOO_OLD: f"on a busy computer try again; else {_CLOCKS}",
    EARLY: _CLOCKS,
}


def _refused(reason: str, found: str = "") -> Refused:
    """Return the refusal of a message that was not sent just now; found: what was measured."""
    return Refused(reason, f"{reason}{f': {found}' if found else ''}; {_ADVICE[reason]}")


class Freshness:
    """Judges when messages were sent; arrival_ns is when they came."""

    def __init__(self, stale_s: float, clock: RobotClock | None = None, simulated: RobotClock | None = None) -> None:
        """clock: that of the computer. simulated: that of a simulated robot, of which a stamp may be as well."""
        self._stale_ns = round(stale_s * 1e9)
        self._clock, self._simulated = clock or RobotClock(), simulated
        self._zero_ns = secrets.randbits(61)  # an echo of an earlier run is none of this one

    def own_time(self) -> str:
        """Return the robot's own time for senders, who repeat it as an echo."""
        return str(time.monotonic_ns() + self._zero_ns)

    def sent_ns(self, request: Request, arrival_ns: int, stamp_ns: int = 0) -> int | None:
        """Return when a message was sent; None: it does not say it.

        stamp_ns: in the message; 0: that which is attached counts.
        """
        found_ns = [request.echo_ns - self._zero_ns] if request.echo_ns else []
        if unix_ns := stamp_ns or request.sent_ns:
            found_ns.append(self._clock.stamp_ns(unix_ns))
            if self._simulated is not None:
                found_ns.append(arrival_ns - self._simulated.age_ns(unix_ns))
        return min(found_ns, key=lambda sent_ns: abs(arrival_ns - sent_ns), default=None)

    def require(self, request: Request, arrival_ns: int, stamp_ns: int = 0) -> int:
        """Return when what can begin a motion was sent. Raise Refused where it was not sent just now."""
        sent_ns = self.sent_ns(request, arrival_ns, stamp_ns)
        if sent_ns is None:
            raise _refused(UNSTAMPED)
        if sent_ns - arrival_ns > self._stale_ns:
            raise _refused(EARLY, f"by {duration_words((sent_ns - arrival_ns) * S_PER_NS)} by the robot's clock")
        return self._not_stale(sent_ns, arrival_ns)

    def of_stream(self, request: Request, arrival_ns: int, stamp_ns: int = 0) -> int:
        """Return when what goes on with a motion was sent, by itself or by its arrival: the earlier one counts.

        Raise Refused where that is long ago.
        """
        sent_ns = self.sent_ns(request, arrival_ns, stamp_ns)
        return self._not_stale(arrival_ns if sent_ns is None else min(arrival_ns, sent_ns), arrival_ns)

    def goes_on(self, before_ns: int, arrival_ns: int) -> bool:
        """True if a message belongs to the stream of the one that arrived before."""
        return 0 <= arrival_ns - before_ns <= self._stale_ns

    def _not_stale(self, sent_ns: int, arrival_ns: int) -> int:
        age_ns = arrival_ns - sent_ns
        if age_ns > self._stale_ns:
            raise _refused(TOO_OLD, f"sent {duration_words(age_ns * S_PER_NS)} ago by the robot's clock")
        return sent_ns
