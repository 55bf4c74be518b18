"""Bounded queues in front of the stages that run in threads of their own."""

from __future__ import annotations

import math
import threading
import time
from collections import deque

from omnid.engine.flow import END, LOSSLESS, NEWEST, Policy
from omnid.engine.telemetry import StageStats


class StageInbox:
    """Bounded queue of a reader for a number of writers; it ends when all of them have ended.

    Up to `depth` messages of each writer wait. With the policy NEWEST a writer drops its own oldest message: so none
    of two cameras takes the place of the other one's image.
    """

    def __init__(self, stats: StageStats, writers: int, depth: int, policy: Policy) -> None:
        self._stats, self._writers, self._depth, self._policy = stats, writers, depth, policy
        self._capacity = depth * writers
        self._messages: deque[tuple[int, object]] = deque()  # with the number of the writer
        self._changed = threading.Condition()
        self._closed = False
        self._taken_ns = 0  # when the reader took the message it works on; 0: it is idle
        self._work_s = 0.0  # how long the reader works on a message, see _finished
        self._behind: StageInbox | None = None  # of the stage for which the reader prepares messages
        self._ahead: list[StageInbox] = []  # of readers that prepare messages for this one

    def prepare_for(self, behind: StageInbox) -> None:
        """Let the reader take messages only so early that the other inbox's reader can take the results at once."""
        self._behind = behind
        behind._ahead.append(self)

    def put(self, writer: int, message: object) -> None:
        """Add a message of a writer."""
        with self._changed:
            if self._policy is LOSSLESS:
                self._changed.wait_for(lambda: len(self._messages) < self._capacity)  # or closed, which empties it
            if self._closed:  # the reader has ended
                self._stats.dropped += 1
                return
            if self._policy is NEWEST:
                self._make_room(writer)
            self._messages.append((writer, message))
            self._stats.busy_since_ns = self._stats.busy_since_ns or time.monotonic_ns()
            self._changed.notify_all()

    def _make_room(self, writer: int) -> None:
        own = [k for k, (other, _) in enumerate(self._messages) if other == writer]
        if len(own) >= self._depth:
            del self._messages[own[0]]
            self._stats.dropped += 1

    def get(self) -> object:
        """Return the next message, END after the last one; wait for it."""
        self._finished()
        with self._changed:
            self._stats.busy_since_ns = time.monotonic_ns() if self._messages else 0  # the last message is finished
            while not self._closed:
                spare_s = self._spare_s() if self._messages else math.inf
                if spare_s <= 0 or not (self._messages or self._writers):
                    break
                self._changed.wait(spare_s if spare_s < math.inf else None)
            if not self._messages:
                return END
            self._changed.notify_all()
            self._taken_ns = time.monotonic_ns()
            _, message = self._messages.popleft()
        self._tell_ahead()
        return message

    def _finished(self) -> None:
        """Note that the reader is idle, and how long it worked: the longest time, which decays by a tenth each time.

        The mean would not do for a reader that combines messages: only every second frame completes a pair.
        """
        if self._taken_ns:
            self._work_s = max((time.monotonic_ns() - self._taken_ns) * 1e-9, 0.9 * self._work_s)
            self._taken_ns = 0
            self._tell_ahead()

    def _spare_s(self) -> float:
        """Return for how long the result of a message taken now would wait for its reader, s."""
        behind = self._behind
        if behind is None:
            return 0.0
        if behind._messages:
            return math.inf
        taken_ns = behind._taken_ns
        left_s = behind._work_s - (time.monotonic_ns() - taken_ns) * 1e-9 if taken_ns else 0.0
        return left_s - self._work_s

    def _tell_ahead(self) -> None:
        """Wake the readers that prepare messages for this one."""
        for inbox in self._ahead:
            with inbox._changed:
                inbox._changed.notify_all()

    def end(self) -> None:
        """Count one writer less."""
        with self._changed:
            self._writers -= 1
            self._changed.notify_all()

    def close(self) -> None:
        """Drop and count all messages, those to come too: the reader has ended."""
        with self._changed:
            self._closed = True
            self._stats.dropped += len(self._messages)
            self._messages.clear()
            self._stats.busy_since_ns = 0
            self._taken_ns = 0
            self._changed.notify_all()
        self._tell_ahead()


class Port:
    """The end of one writer's stream at an inbox; a Reader."""

    def __init__(self, inbox: StageInbox, writer: int) -> None:
        self._inbox, self._writer = inbox, writer
        self.end = inbox.end

    def put(self, message: object) -> None:
        """Add a message of the writer."""
        self._inbox.put(self._writer, message)
