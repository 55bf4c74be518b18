"""The one rule about the times of sending of commands: `bus.command_clock`.

What can begin or resume a motion needs a stamp of now, so that a message that waited in a network, or was recorded,
begins none later. What ends a motion needs none.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Final

from omnid.errors import OmnidError

UNSTAMPED: Final = "no stamp"
TOO_OLD, EARLY = "too old", "stamp in the future"
NOT_RISING: Final = "stamp does not rise"
USED_BEFORE: Final = "stamp was used before"
MOST_ARM_STAMPS: Final = 256  # remembered, where the senders' clocks are others
_CLOCKS: Final = (
    "on a busy computer try again; from another machine synchronise the clocks, or set bus.command_clock = "
    '"arrival"; controller.deadlines.command_s is the longest age'
)
ADVICE: Final = {
    UNSTAMPED: "fill in the stamp (ROS 2: `header: auto`; String: last word stamp=NANOSECONDS); for a plain Twist set "
    'bus.command_clock = "arrival"',
    TOO_OLD: _CLOCKS,
    EARLY: _CLOCKS,
    NOT_RISING: "one sender per topic, or arm the robot again for a sender whose clock began again",
}


class RefusedStamp(OmnidError):  # noqa: N818 - named after what it reports
    """A stamp that is not fresh; its first argument is the reason, which is counted."""


class StampRule:
    """Judges stamps, ns of Unix time by the sender's clock; 0: the message has none.

    Synchronised clocks: the stamp differs from this machine's clock by stale_s at most, before and after. Other clocks:
    the stamps of each topic rise; after a request to arm they may begin again lower, as of another sender, and that
    request needs a stamp that none of the last ones had.
    """

    def __init__(self, stale_s: float, *, synchronised: bool = True) -> None:
        self.synchronised = synchronised
        self._stale_ns = round(stale_s * 1e9)
        self._newest_ns: dict[str, int] = {}  # stamp of the newest message that was accepted, by topic
        self._arm_stamps_ns: deque[int] = deque(maxlen=MOST_ARM_STAMPS)

    def check(self, topic: str, stamp_ns: int) -> None:
        """Raise RefusedStamp for a message of a topic whose stamp is missing or not fresh."""
        if not stamp_ns:
            raise RefusedStamp(UNSTAMPED)
        if self.synchronised:
            self._check_age(stamp_ns)
            return
        if stamp_ns <= self._newest_ns.get(topic, 0):
            raise RefusedStamp(NOT_RISING)
        self._newest_ns[topic] = stamp_ns

    def check_arm(self, stamp_ns: int) -> None:
        """Raise RefusedStamp for a request to arm whose stamp is missing, not fresh or used before."""
        if not stamp_ns:
            raise RefusedStamp(UNSTAMPED)
        if self.synchronised:
            self._check_age(stamp_ns)
        elif stamp_ns in self._arm_stamps_ns:
            raise RefusedStamp(USED_BEFORE)

    def accept_arm(self, stamp_ns: int) -> None:
        """Remember a request to arm that was accepted; stamps may begin again after it."""
        self._arm_stamps_ns.append(stamp_ns)
        self._newest_ns.clear()

    def _check_age(self, stamp_ns: int) -> None:
        age_ns = time.time_ns() - stamp_ns
        if age_ns > self._stale_ns:
            raise RefusedStamp(TOO_OLD)
        if age_ns < -self._stale_ns:
            raise RefusedStamp(EARLY)
