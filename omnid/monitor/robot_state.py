"""What has come of a robot: letters as they arrive, and what they add up to."""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple

from omnid.engine.telemetry import Histogram
from omnid.errors import OmnidError
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.decode import Pose, Report, pose_from, report_from

SILENT_S: Final = 2.0
_MOST_WAITING: Final = 2000
_LONGEST_LINE: Final = 400  # letters
_MOST_STATUSES: Final = 100
_RATE_OVER: Final = 100  # poses
_LONGEST_NS: Final = 3_600 * 10**9  # a message that is older, or from the future, was stamped by another clock


class ReceivedMessage(NamedTuple):
    """One message as it came."""

    received_ns: int  # of Unix time
    topic: str
    payload: bytes
    note: bytes


class Inbox:
    """What has come and was not looked at yet; when too much waits, the oldest is forgotten and counted."""

    def __init__(self) -> None:
        self._letters: SimpleQueue[ReceivedMessage] = SimpleQueue()
        self.forgotten = 0

    def take(self, topic: str, payload: bytes, note: bytes) -> None:
        """Adds a message that has just come; never waits."""
        self._letters.put(ReceivedMessage(time.time_ns(), topic, payload, note))
        if self._letters.qsize() > _MOST_WAITING:
            with suppress(Empty):
                self._letters.get_nowait()
                self.forgotten += 1

    def next(self, timeout_s: float) -> ReceivedMessage | None:
        """The oldest message, waited for at most so long."""
        with suppress(Empty):
            return self._letters.get(timeout=max(0.0, timeout_s))
        return None


class RobotState:
    """What has come of one robot, in constant memory."""

    def __init__(self) -> None:
        self.pose: Pose | None = None
        self.statuses: dict[str, DiagnosticStatus] = {}
        self.poses = self.missed = self.broken = 0
        self.age, self.way = Histogram(), Histogram()  # from the images to here; from the robot's network to here
        self._arrivals: deque[float] = deque(maxlen=_RATE_OVER)

    def take(self, letter: ReceivedMessage) -> Pose | None:
        """Counts a message; the pose in it, if it is one."""
        try:
            if letter.topic == "odom":
                return self._take_pose(pose_from(letter.payload, letter.note, letter.received_ns))
            if letter.topic == "status":
                self.take_report(report_from(letter.payload))
        except OmnidError:
            self.broken += 1
        return None

    def take_report(self, report: Report | None) -> None:
        """What the parts of the robot say of themselves; the newest of each."""
        for status in report.statuses if report is not None else ():
            if status.name in self.statuses or len(self.statuses) < _MOST_STATUSES:
                self.statuses[status.name] = status

    def _take_pose(self, pose: Pose) -> Pose:
        """Numbers that were left out were missed; a smaller one is a new start."""
        if self.pose is not None and 0 <= self.pose.note.seq < pose.note.seq:
            self.missed += pose.note.seq - self.pose.note.seq - 1
        self.pose = pose
        self.poses += 1
        self._arrivals.append(pose.received_ns * 1e-9)
        for histogram, since_ns in ((self.age, pose.stamp_ns), (self.way, pose.note.sent_ns)):
            if 0 <= pose.received_ns - since_ns < _LONGEST_NS:
                histogram.add((pose.received_ns - since_ns) * 1e-9)
        return pose

    @property
    def silent_s(self) -> float:
        """How long ago the newest pose came."""
        return time.time() - self._arrivals[-1] if self._arrivals else math.inf

    @property
    def rate_hz(self) -> float:
        """Poses per second of late."""
        if len(self._arrivals) < 2 or self.silent_s > SILENT_S:
            return 0.0
        return (len(self._arrivals) - 1) / max(1e-6, self._arrivals[-1] - self._arrivals[0])

    @property
    def state(self) -> str:
        """Of the newest pose, or for how long there has been none."""
        if self.pose is None or self.silent_s > SILENT_S:
            return f"silent for {self.silent_s:.0f} s"
        return plain(self.pose.state)


def plain(text: str) -> str:
    """Without what could command a terminal, and not endless: it comes from the network."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)[:_LONGEST_LINE]
