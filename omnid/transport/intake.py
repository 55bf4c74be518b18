"""Intake of the bus from the messages that others send, with a limit for each key.

zenoh puts messages into a ring without any Python, where the newest replace the oldest. A thread takes a bounded number
of them, so that no flood takes the time of the stages: with a Python callback, each message would. One pass goes over
the rings of all commands, stops first; the queries among them wait for their answers here.
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import count
from typing import Any, Final

import zenoh

from omnid.transport import ros2
from omnid.transport.bus_config import BusConfig
from omnid.transport.topics import ARM, MOST_OPEN, STOP, Answer, Request, command_of, request_key

PERIOD_S: Final = 0.004  # Time between two passes.


class Ring:
    """The messages, or the queries, of one key that wait; at most so many a second are taken.

    It holds those of a quarter of a second: so long a flood can hold one up. floods: how often there were more.
    """

    def __init__(self, declare: Callable[..., Any], key: str, rate_hz: float, topic: str = "") -> None:
        self.key, self.topic, self._rate_hz = key, topic, rate_hz
        self._capacity = max(4, round(rate_hz / 4))
        self._declared = declare(key, zenoh.handlers.RingChannel(self._capacity))
        self._allowed, self._at_s = 0.0, -math.inf
        self.floods = 0

    def messages(self) -> Iterator[Any]:
        """Yield the messages that may be decoded now; the others wait, until newer ones replace them."""
        now_s = time.monotonic()
        # One more than the ring holds at once: what comes at once is no flood.
        self._allowed = min(self._capacity + 1, self._allowed + (now_s - self._at_s) * self._rate_hz)
        self._at_s = now_s
        while self._allowed >= 1.0:
            # An empty ring is the usual case, hundreds of times a second: it costs one call.
            if (message := self._declared.try_recv()) is None:
                return
            self._allowed -= 1.0
            yield message
        self.floods += 1


class OpenRequests:
    """The queries that wait for their answers. Where there are too many, the oldest one is dropped."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._open: dict[int, tuple[str, zenoh.Query]] = {}
        self._answered: deque[tuple[zenoh.Query, Answer]] = deque(maxlen=MOST_OPEN)

    def add(self, topic: str, query: zenoh.Query | None) -> int:
        """Return the id of a message; query: what waits for the answer to it, None for a message that was put."""
        id = next(self._numbers)
        if query is not None:
            self._open[id] = topic, query
            if len(self._open) > MOST_OPEN:
                self._open.pop(min(self._open.copy()), None)
        return id

    def answer(self, id: int, answer: Answer, *, also_before: str = "") -> None:
        """Answer a request, once, from any thread, without waiting.

        also_before: a topic on which a request takes the place of earlier ones, which get the same answer.
        """
        for other, (topic, query) in self._open.copy().items():
            if (other == id or (other < id and topic == also_before)) and self._open.pop(other, None) is not None:
                self._answered.append((query, answer))

    def send(self) -> None:
        """Send the answers; this may block while a program does not read, so it has a thread of its own."""
        while self._answered:
            query, answer = self._answered.popleft()
            with suppress(zenoh.ZError):  # the program has gone
                query.reply(query.key_expr, json.dumps(answer._asdict()), encoding=zenoh.Encoding.APPLICATION_JSON)


class CommandIntake:
    """Passes commands on within the budgets of their keys, by `process`, which one thread calls again and again."""

    def __init__(
        self,
        session: zenoh.Session,
        config: BusConfig,
        topics: Iterable[str],
        requests: OpenRequests,
        callback: Callable[[Request], None],
    ) -> None:
        """topics: those to receive besides stops and requests to arm. requests: keeps unanswered queries.

        callback: takes each message, in the thread of `process`.
        """
        self._callback, self._open = callback, requests
        self.rings: list[Ring] = []  # those of requests to arm and of stops are the last ones
        for topic in (*sorted({*topics} - {ARM, STOP}), ARM, STOP):
            command = command_of(topic)
            places: list[tuple[Callable[..., Any], str]] = [(session.declare_subscriber, f"{config.robot}/{topic}")]
            if config.ros2 == "rmw_zenoh":  # a key of it ends with the type of the message and the hash of that type
                places += [(session.declare_subscriber, f"{config.ros2_domain}/{config.robot}/{topic}/*/*")]
            if command.is_request:
                places += [(session.declare_queryable, f"{config.robot}/{request_key(topic)}")]
            self.rings += [Ring(declare, key, command.rate_hz, topic) for declare, key in places]

    def process(self) -> None:
        """Pass on what has come. Of a stop and a request to arm in one pass the stop wins.

        Which of the two was sent first is not known, because messages of different topics have no common order.
        """
        # 1. Stops.
        stopped, asked_to_arm = self._stop(), False
        # 2. All other messages; requests to arm are the last of them.
        for ring in self.rings:
            for message in ring.messages() if ring.topic != STOP else ():
                asked_to_arm |= ring.topic == ARM
                # A request names one robot and one topic: a query for several keys is none.
                if isinstance(message, zenoh.Sample) or str(message.key_expr) == ring.key:
                    self._pass_on(ring.topic, message)
        # 3. After a request to arm: a stop that came in the meantime, or else that of step 1 once more.
        if asked_to_arm and not self._stop() and stopped:
            self._callback(Request(STOP))

    def _stop(self) -> bool:
        """Pass on the stops that have come; return whether there was one."""
        samples = [sample for ring in self.rings if ring.topic == STOP for sample in ring.messages()]
        if samples:
            self._pass_on(STOP, samples[-1])
        return bool(samples)

    def _pass_on(self, topic: str, message: zenoh.Sample | zenoh.Query) -> None:
        """Pass on a message with the identity of the program that sent it, empty where it names none.

        Programs with omnid.client give the source of their messages and attach an identity to their requests. Programs
        with rmw_zenoh attach the gid of their publisher. zenoh itself adds nothing. The identity proves nothing: what a
        program may do is decided by the access rules.
        """
        payload = b"" if message.payload is None else message.payload.to_bytes()
        sender, sent_ns, echo_ns = ros2.read_attachment(message.attachment.to_bytes() if message.attachment else b"")
        query = message if isinstance(message, zenoh.Query) else None
        if isinstance(message, zenoh.Sample) and message.source_info is not None:
            sender = str(message.source_info.source_id.zid)
        self._callback(Request(topic, payload, sender, sent_ns, self._open.add(topic, query), echo_ns))
