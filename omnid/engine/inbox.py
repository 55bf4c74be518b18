"""Bounded queues in front of the stages that run in threads of their own."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable

from omnid.engine.flow import END, LOSSLESS, NEWEST, Policy, newest
from omnid.engine.telemetry import StageStats

NOTABLE_S = 1e-3  # shorter work after a result was passed on is ignored
LASTING = 0.9  # share of an earlier longest time that still counts after each message
EARLY = 0.75  # of the time expected for that work: to come late would cost the reader more than an older message does


class InFlight:
    """Counts the messages that wait in the inboxes of a graph, or are being processed."""

    def __init__(self) -> None:
        self._count = 0
        self._changed = threading.Condition()

    def add(self, count: int) -> None:
        """Add to the number of messages; a negative count: they are done or dropped."""
        with self._changed:
            self._count += count
            if not self._count:
                self._changed.notify_all()

    def is_none(self, timeout_s: float) -> bool:
        """True as soon as there is none; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, timeout_s)


class StageInbox:
    """Bounded queue of a reader for a number of writers; it ends when all of them have ended.

    Up to `depth` messages of each writer wait. With the policy NEWEST a writer drops its own oldest message: so none
    of two cameras takes the place of the other one's image.
    """

    def __init__(
        self,
        stats: StageStats,
        writers: int,
        depth: int,
        policy: Policy,
        in_flight: InFlight,
        merge: Callable[[object, object], object] = newest,
    ) -> None:
        """in_flight: the count of the graph, in which a message is until its reader asks for the next one.

        merge: returns what takes the place of a dropped message and the writer's next one.
        """
        self._in_flight, self._has_taken, self._merge = in_flight, False, merge
        self._stats, self._writers, self._depth, self._policy = stats, writers, depth, policy
        self._capacity = depth * writers
        self._messages: deque[tuple[int, object]] = deque()  # messages with the number of the writer
        self._changed = threading.Condition()
        self._closed = False
        self._taken_ns = 0  # when the reader took the message it works on; 0: it is idle
        self._passed_ns = 0  # when the result of that message was passed on; 0: not yet
        self._work_s = 0.0  # how long the reader works on a message, see passed_on
        self._after_s = 0.0  # how long it works after it has passed on the result, where it does: a moving mean
        self._behind: StageInbox | None = None  # inbox of the stage for which the reader prepares messages
        self._ahead: list[StageInbox] = []  # inboxes of readers that prepare messages for this one

    def prepare_for(self, behind: StageInbox) -> None:
        """Let the reader take messages no earlier than the other inbox's reader can take the results."""
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
                message = self._make_room(writer, message)
            self._messages.append((writer, message))
            self._in_flight.add(1)
            self._stats.busy_since_ns = self._stats.busy_since_ns or time.monotonic_ns()
            self._changed.notify_all()

    def _make_room(self, writer: int, message: object) -> object:
        """Drop the oldest message of a writer if need be; return the message that is to be added."""
        own = [k for k, (other, _) in enumerate(self._messages) if other == writer]
        if len(own) < self._depth:
            return message
        oldest = self._messages[own[0]][1]
        if len(own) > 1:
            self._messages[own[1]] = writer, self._merge(oldest, self._messages[own[1]][1])
        else:
            message = self._merge(oldest, message)
        del self._messages[own[0]]
        self._in_flight.add(-1)
        self._stats.dropped += 1
        return message

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
            self._has_taken = True
        self._tell_ahead()
        return message

    def passed_on(self) -> None:
        """Note that the reader has passed on its result, and how long that took: the longest time, which decays.

        The mean would not do for a reader that combines messages: only every second frame completes a pair.
        """
        self._passed_ns = time.monotonic_ns()
        self._work_s = max((self._passed_ns - self._taken_ns) * 1e-9, LASTING * self._work_s)
        self._tell_ahead()

    def _finished(self) -> None:
        """Note that the reader is idle."""
        if self._has_taken:
            self._has_taken = False
            self._in_flight.add(-1)
        if not self._taken_ns:
            return
        after_s = (time.monotonic_ns() - self._passed_ns) * 1e-9
        if after_s > NOTABLE_S:
            self._after_s = (after_s + (self._after_s or after_s)) / 2
        self._taken_ns = self._passed_ns = 0
        self._tell_ahead()

    def _spare_s(self) -> float:
        """Return for how long the result of a message taken now would wait for its reader, s.

        Where a result waits already, none is prepared, except towards the end of the reader's work after a message.
        That work is long: the result that waits has become old by then, and the newest replaces it.
        """
        behind = self._behind
        if behind is None:
            return 0.0
        now_ns, taken_ns, passed_ns = time.monotonic_ns(), behind._taken_ns, behind._passed_ns
        left_s = 0.0
        if passed_ns:
            left_s = EARLY * behind._after_s - (now_ns - passed_ns) * 1e-9
        elif taken_ns:
            left_s = behind._work_s - (now_ns - taken_ns) * 1e-9
        if behind._messages and not passed_ns:
            return math.inf
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
            self._in_flight.add(-len(self._messages))
            self._messages.clear()
            self._stats.busy_since_ns = 0
            self._taken_ns = self._passed_ns = 0
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
