"""Commands and requests from the bus: a ring buffer for each topic, and one pass over all of them, stops first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import zenoh

from omnid.transport import ros2
from omnid.transport.bus_config import BusConfig
from omnid.transport.intake import UNKNOWN, Intake, budget_of
from omnid.transport.open_requests import OpenRequests
from omnid.transport.requests import Request
from omnid.transport.topics import ARM, REQUEST_TOPICS, STOP, request_key

RequestCallback: TypeAlias = Callable[[Request], None]
PERIOD_S: Final = 0.004  # Time between two passes.
_UNKNOWN: Final = "cmd/**"
_LAST: Final = (ARM, STOP)


class _Ring(NamedTuple):
    """The messages, or the queries, of one key that wait."""

    topic: str
    prefix: str  # of the key, before the topic
    intake: Intake[Any]


class CommandIntake:
    """Passes commands on within the budgets of their keys, by `process`, which one thread calls again and again."""

    def __init__(
        self,
        session: zenoh.Session,
        config: BusConfig,
        topics: Mapping[str, str],
        requests: OpenRequests,
        callback: RequestCallback,
    ) -> None:
        """topics: those with a ring of their own; all others below `cmd` share one. requests: keeps unanswered queries.

        callback: takes each message, in the thread of `process`.
        """
        self._callback, self._open = callback, requests
        self._topics = frozenset((*topics, *_LAST))
        self._declared: list[object] = []  # zenoh undeclares what is no longer referred to
        self._rings = list(self._declare(session, config))
        self._stops = [ring for ring in self._rings if ring.topic == STOP]

    @property
    def intakes(self) -> Sequence[Intake[Any]]:
        """The takers of the messages of all rings, with the counts of refused messages."""
        return [ring.intake for ring in self._rings]

    def process(self) -> None:
        """Pass on what has come. Of a stop and a request to arm in one pass the stop wins.

        Which of the two was sent first is not known, because messages of different topics have no common order.
        """
        # 1. Stops.
        stopped, asked_to_arm = self._stop(), False
        # 2. All other messages; requests to arm are the last of them.
        for ring in self._rings:
            if ring.topic == STOP:
                continue
            for message in ring.intake.messages():
                asked_to_arm |= ring.topic == ARM
                if topic := self._topic(ring, message):
                    self._pass_on(topic, message)
        # 3. After a request to arm: a stop that came in the meantime, or else that of step 1 once more.
        if asked_to_arm and not self._stop() and stopped:
            self._callback(Request(STOP))

    def _stop(self) -> bool:
        """Pass on the stops that have come; return whether there was one."""
        samples = [sample for ring in self._stops for sample in ring.intake.messages()]
        if samples:
            self._pass_on(STOP, samples[-1])
        return bool(samples)

    def _pass_on(self, topic: str, message: zenoh.Sample | zenoh.Query) -> None:
        payload = b"" if message.payload is None else message.payload.to_bytes()
        attached = b"" if message.attachment is None else message.attachment.to_bytes()
        id = self._open.add(topic, message if isinstance(message, zenoh.Query) else None)
        self._callback(Request(topic, payload, sender_of(message), ros2.sent_ns_in(attached), id))

    def _topic(self, ring: _Ring, message: zenoh.Sample | zenoh.Query) -> str:
        """Return the topic of a message; empty for a message that is not passed on.

        These are queries of several keys, since a request names one robot and one topic, and messages in the shared
        ring whose topic has a ring of its own.
        """
        key = str(message.key_expr).removeprefix(ring.prefix)
        if isinstance(message, zenoh.Query):
            return ring.topic if key == request_key(ring.topic) else ""
        if ring.topic != _UNKNOWN:
            return ring.topic
        # A key of rmw_zenoh ends with the type of the message and the hash of that type.
        topic = key if ring.prefix == self._rings[0].prefix else key.rsplit("/", 2)[0]
        return "" if topic in self._topics else topic

    def _declare(self, session: zenoh.Session, config: BusConfig) -> Iterator[_Ring]:
        """Declare subscribers and queryables; yield their rings."""
        own, ros = f"{config.robot}/", f"{config.ros2_domain}/{config.robot}/"
        for topic in (*sorted(self._topics - {*_LAST}), _UNKNOWN, *_LAST):
            yield self._ring(session.declare_subscriber, own, topic, topic)
            if config.ros2 == "rmw_zenoh":
                yield self._ring(session.declare_subscriber, ros, topic, topic if topic == _UNKNOWN else f"{topic}/*/*")
            if topic in REQUEST_TOPICS:
                yield self._ring(session.declare_queryable, own, topic, request_key(topic))

    def _ring(self, declare: Callable[..., Any], prefix: str, topic: str, key: str) -> _Ring:
        budget = UNKNOWN if topic == _UNKNOWN else budget_of(topic)
        declared = declare(f"{prefix}{key}", zenoh.handlers.RingChannel(budget.burst))
        self._declared.append(declared)
        return _Ring(topic, prefix, Intake(key, declared.try_recv, budget, sender_of))


def sender_of(message: zenoh.Sample | zenoh.Query) -> str:
    """Return the identity of the program that sent a message, empty where it names none.

    Programs with omnid.client give the source of their messages and attach an identity to their requests. Programs
    with rmw_zenoh attach the gid of their publisher. zenoh itself adds nothing. The identity proves nothing: what a
    program may do is decided by the access rules.
    """
    if isinstance(message, zenoh.Sample) and message.source_info is not None:
        return str(message.source_info.source_id.zid)
    return "" if message.attachment is None else ros2.gid_in(message.attachment.to_bytes())
