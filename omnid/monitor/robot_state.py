"""The state of a robot as its messages show it: one inbox and one decoder for terminals, pages and viewers."""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any, Final, NamedTuple

from omnid.core.nanoseconds import S_PER_NS
from omnid.engine.telemetry import Histogram
from omnid.errors import OmnidError
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.transport.codec import Diagnostics, DiagnosticStatus, Pose
from omnid.transport.status_names import SIMULATION, STAGE_PREFIX, Key
from omnid.transport.topics import PUBLISHED

LEVELS: Final = ("", "warning", "ERROR", "stale")  # of a status, by its number
NO_POSE_S: Final = 2.0  # Without a pose for this time, state and rate of the last poses are no longer shown.
OTHER_CLOCK_NS: Final = 3_600 * 10**9  # Stamps that differ by more are of two clocks.
_INBOX_DEPTH: Final = 2000
_RECENT: Final = 100  # poses


class ReceivedMessage(NamedTuple):
    """A message as it arrived."""

    received_ns: int  # Unix time, which may be set between two messages
    topic: str
    payload: bytes
    attachment: bytes
    arrival_ns: int  # the same by CLOCK_MONOTONIC


class RobotState:
    """Newest pose and status of one robot, counters and latencies, in constant memory.

    Messages wait in an inbox, of which the oldest are dropped and counted when it is full.
    """

    def __init__(self) -> None:
        self._inbox: SimpleQueue[ReceivedMessage] = SimpleQueue()
        self.dropped = 0  # messages
        self.pose: Pose | None = None
        self.statuses: dict[str, DiagnosticStatus] = {}
        self.alive: bool | None = None  # the daemon's liveliness token; None while it is not known
        self.poses = self.missed = self.broken = 0
        self.age = Histogram()  # s, from the capture of a pose's images to its arrival; empty for a simulated clock
        self.recent: deque[Pose] = deque(maxlen=_RECENT)  # newest poses of the run: what is seen from one comes later
        self._arrivals_s: deque[float] = deque(maxlen=_RECENT)

    def put(self, topic: str, payload: bytes, attachment: bytes) -> None:
        """Add a message that has just arrived, from any thread; does not block."""
        self._inbox.put(ReceivedMessage(time.time_ns(), topic, payload, attachment, time.monotonic_ns()))
        if self._inbox.qsize() > _INBOX_DEPTH:
            with suppress(Empty):
                self._inbox.get_nowait()
                self.dropped += 1

    def next(self, timeout_s: float) -> tuple[ReceivedMessage, Any] | None:
        """Process the oldest message of the inbox; return it and its content, or None after the timeout."""
        try:
            message = self._inbox.get(timeout=max(0.0, timeout_s))
        except Empty:
            return None
        return message, self.process(message)

    def process(self, message: ReceivedMessage) -> Any:
        """Return the content of a message, whose pose or status is kept; None, and count it, where it is unreadable."""
        if message.topic not in PUBLISHED:
            return None
        try:
            content = PUBLISHED[message.topic].decode(message.payload, message.attachment)
        except OmnidError:
            self.broken += 1
            return None
        if isinstance(content, Pose):
            content = self._add_pose(replace(content, received_ns=message.received_ns), message.arrival_ns * S_PER_NS)
        elif isinstance(content, Diagnostics):
            self.add_diagnostics(content)
        return content

    def set_alive(self, alive: bool) -> None:
        """Keep whether the daemon's liveliness token is there; from any thread."""
        self.alive = alive

    def forget_ended(self) -> bool:
        """Forget the statuses of a daemon that has ended: it may start again in another state. True if there were any.

        It is called by the thread that processes the messages.
        """
        had_any = bool(self.statuses) and self.alive is False
        if had_any:
            self.statuses.clear()
        return had_any

    def add_diagnostics(self, diagnostics: Diagnostics) -> None:
        """Keep the newest status of each part of the robot."""
        for status in diagnostics.statuses:
            if status.name in self.statuses or len(self.statuses) < MOST_ENTRIES:
                self.statuses[status.name] = status
        if self.real_time_factor:
            self.age = Histogram()

    def _add_pose(self, pose: Pose, arrival_s: float) -> Pose:
        """Count a pose. Skipped sequence numbers of a run are missed poses."""
        if self.pose is not None and pose.attachment.run == self.run:
            self.missed += max(0, pose.attachment.seq - self.pose.attachment.seq - 1)
        else:
            self.recent.clear()
        self.recent.append(pose)
        self.pose = pose
        self.poses += 1
        self._arrivals_s.append(arrival_s)
        age_ns = pose.received_ns - pose.stamp_ns
        if not self.real_time_factor and 0 <= age_ns < OTHER_CLOCK_NS:
            self.age.add(age_ns * S_PER_NS)
        return pose

    @property
    def run(self) -> str:
        """Identity of the daemon's run, which begins a new odom."""
        return "" if self.pose is None else self.pose.attachment.run

    @property
    def real_time_factor(self) -> str:
        """Simulated time over time on the wall; empty for a robot whose clock is that of its computer."""
        simulation = self.statuses.get(SIMULATION)
        return "" if simulation is None else simulation.values.get(Key.REAL_TIME_FACTOR, "")

    @property
    def time_since_pose_s(self) -> float:
        """Time since the newest pose arrived; inf before the first."""
        return time.monotonic() - self._arrivals_s[-1] if self._arrivals_s else math.inf

    @property
    def rate_hz(self) -> float:
        """Rate of the last poses; 0 where there are none."""
        if len(self._arrivals_s) < 2 or self.time_since_pose_s > NO_POSE_S:
            return 0.0
        return (len(self._arrivals_s) - 1) / max(1e-6, self._arrivals_s[-1] - self._arrivals_s[0])

    @property
    def state(self) -> str:
        """Tracking state of the newest pose, or the time since it and whether the daemon is still there."""
        if self.pose is None:
            return "no pose yet: no robot of this name is there" if self.alive is None else "no pose yet"
        if self.time_since_pose_s > NO_POSE_S:
            gone = ", its daemon has ended or cannot be reached" if self.alive is False else ""
            return f"no pose for {self.time_since_pose_s:.0f} s{gone}"
        return plain(self.pose.state)


def importance(status: DiagnosticStatus) -> tuple[int, bool, str]:
    """Return a key by which entries are sorted: the worst first, stages last, then by name."""
    return -(status.level % len(LEVELS)), status.name.startswith(STAGE_PREFIX), status.name
