"""The zenoh bus: publishes CDR messages below the robot's name, answers queries and receives commands.

`publish` may block for up to zenoh's drop time (1 ms, 50 ms for fragmented messages), so only sinks with a bounded
inbox of their own, and tickers, call it. Each topic has its plain key, and what ROS 2 needs to find and to read it.

What others send, zenoh puts into a ring for each key without any Python, where the newest replace the oldest. Two
threads (commands, queries) take a bounded number of them, so that no flood takes the time of the stages: with a Python
callback, each message would.
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from typing import Any, Final

import zenoh
from zenoh import ext

from omnid.engine.graph import Poller
from omnid.errors import OmnidError
from omnid.transport import ros2
from omnid.transport.session import ALIVE, PERIOD_S, BusConfig, has_receiver, open_session, reason
from omnid.transport.stop_datagram import StopListener
from omnid.transport.topics import (
    ARM,
    CLOCK,
    COMMANDS,
    MAX_OPEN,
    PUBLISHED,
    STOP,
    Answer,
    Answers,
    Request,
    plain_key,
    request_key,
    ros_name,
)

__all__ = ["Bus", "BusConfig"]

_HEARTBEAT_S: Final = 0.5  # rmw_zenoh's
_SAME_NAME: Final = (
    "another robot on the bus has this one's name, and both obey the same commands: this one is not armed before the "
    "other has gone; change bus.robot of one of them"
)


class TopicPublisher:
    """The zenoh publishers of one topic: the plain key, and the key of ROS 2 where that is another.

    They are not express: each express message fills one of the few batches of every router on the way. Poses were
    dropped there, and the latency is the same.
    """

    def __init__(self, session: zenoh.Session, config: BusConfig, name: str, node: ros2.RosNode) -> None:
        topic = PUBLISHED[name]
        self._gid, self._seq = ros2.gid_of(node.publisher(name, topic.schema, latched=topic.transient_local)), 0
        quality: dict[str, Any] = {
            "encoding": zenoh.Encoding.APPLICATION_CDR,
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": zenoh.Priority.REAL_TIME if topic.realtime else zenoh.Priority.DATA,
            "express": False,
            "reliability": zenoh.Reliability.RELIABLE,
        }
        self._plain = session.declare_publisher(plain_key(config.robot, name), **quality)
        self._ros: zenoh.Publisher | ext.AdvancedPublisher | None = None
        if config.ros2 == "rmw_zenoh":
            key = ros2.data_key(config.ros2_domain, ros_name(config.robot, name), topic.schema)
            if not topic.transient_local:
                self._ros = session.declare_publisher(key, **quality)
            else:  # as rmw_zenoh (rmw_publisher_data.cpp): a cache, detection of the publisher, heartbeats
                heartbeats = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S)
                self._ros = ext.declare_advanced_publisher(
                    session,
                    key,
                    **quality,
                    cache=ext.CacheConfig(1),
                    sample_miss_detection=heartbeats,
                    publisher_detection=True,
                )

    @property
    def is_received(self) -> bool:
        """True if there is a subscriber."""
        return any(has_receiver(one) for one in (self._plain, self._ros) if isinstance(one, zenoh.Publisher))

    def put(self, payload: bytes, attachment: bytes | None) -> None:
        """Send to all subscribers; microseconds where there are none."""
        self._plain.put(payload, attachment=attachment)
        if self._ros is not None:
            self._seq += 1
            self._ros.put(payload, attachment=ros2.attachment(self._seq, time.time_ns(), self._gid))


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


class Bus:
    """An open zenoh session. Remote endpoints may come and go, but the router of a client is there at the start."""

    def __init__(
        self, config: BusConfig, warn: Callable[[str], None] = lambda _: None, *, gives_time: bool = False
    ) -> None:
        """Open the session. gives_time: there is a topic /clock.

        Raise OmnidError for a wrong configuration, and where the router of a client cannot be reached. Each time that
        the name is no longer unique, warn is called, and the subscriber of commands receives a stop.
        """
        self._config, self._warn, self._closed = config, warn, False
        self._session = session = open_session(config)
        self._declared: list[object] = []  # zenoh undeclares what is no longer referred to
        self._namesakes: set[str] = set()  # liveliness tokens of other robots of this name
        self._on_command: Callable[[Request], Answer | None] = lambda _: None
        self._watch_for_namesakes()
        # A robot whose time is the computer's has none: programs that wait for it would believe to be in a simulation.
        topics = [name for name in PUBLISHED if gives_time or name != CLOCK]
        self._node = ros2.RosNode(session, config.robot, config.ros2_domain, is_on=config.ros2 != "off")
        self._publishers = {name: TopicPublisher(session, config, name, self._node) for name in topics}
        # Answers to queries, by name: a message or a text, or what returns it at the moment; attachment, encoding.
        self._kept: dict[str, tuple[bytes | str | Callable[[], str], bytes | None, zenoh.Encoding]] = {}
        self._queries = {name: self._queryable(name) for name in topics if PUBLISHED[name].latched}
        self._rings: list[Ring] = []  # of commands; those of requests to arm and of stops are the last ones
        self._ids = count(1)
        self._open: dict[int, zenoh.Query] = {}  # requests that wait for their answers, by id
        self._answered: deque[tuple[zenoh.Query, Answer]] = deque(maxlen=MAX_OPEN)
        self._stop_listener: StopListener | None = None
        self._pollers = [Poller(self._answer_queries, PERIOD_S, "bus queries")]

    def stats(self) -> dict[str, object]:
        """Return whether the name is unique, and how often others sent too much."""
        rings = [*self._rings, *self._queries.values()]
        # floods: how often a key had more messages than its budget
        floods, problem = sum(ring.floods for ring in rings), "" if self.is_unique else _SAME_NAME
        return {"same_name": len(self._namesakes), "floods": floods, "_error": problem, "_ok": "open"}

    @property
    def is_unique(self) -> bool:
        """True while no other robot on the bus has this one's name."""
        return not self._namesakes

    def publish(self, topic: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Send CDR bytes as `<robot>/<topic>`, and under the key that ROS 2 expects; dropped in congestion.

        attachment: zenoh attachment for subscribers that know omnid. A topic with a leading '/' has no robot's name.
        """
        if PUBLISHED[topic].latched:
            self._kept[topic] = payload, attachment, zenoh.Encoding.APPLICATION_CDR
        try:
            self._publishers[topic].put(payload, attachment)
        except zenoh.ZError as error:
            raise OmnidError(f"bus cannot publish {topic}: {reason(error)}; restart") from error

    def is_received(self, topic: str) -> bool:
        """True if a topic has a subscriber."""
        return self._publishers[topic].is_received

    def serve(self, name: str, text: str | Callable[[], str]) -> None:
        """Answer queries for `<robot>/<name>` with a text, such as the configuration, or with that of the moment."""
        self._kept[name] = text, None, zenoh.Encoding.TEXT_PLAIN
        self._queries[name] = self._queryable(name)

    def subscribe_commands(
        self,
        callback: Callable[[Request], Answer | None],
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Call callback for messages on COMMANDS and queries that ask the same, in a thread of the bus.

        It returns the answer, None where another part of the robot answers later or none is needed. Each topic has a
        budget of its own; what exceeds it is dropped and counted.
        is_stopped: True if a stop holds, which confirms stops that come as datagrams; they are passed on as others.
        """
        self._on_command = callback
        if not self.is_unique:
            callback(Request(STOP))
        subscriber, robot = self._session.declare_subscriber, self._config.robot
        for topic in (*sorted(COMMANDS.keys() - {ARM, STOP}), ARM, STOP):
            command = COMMANDS[topic]
            places: list[tuple[Callable[..., Any], str]] = [(subscriber, f"{robot}/{topic}")]
            if self._config.ros2 == "rmw_zenoh":  # a key of it ends with the type of the message and the type's hash
                places += [(subscriber, f"{self._config.ros2_domain}/{robot}/{topic}/*/*")]
            if command.is_request:
                places += [(self._session.declare_queryable, f"{robot}/{request_key(topic)}")]
            self._rings += [Ring(declare, key, command.rate_hz, topic) for declare, key in places]
        self._stop_listener = StopListener(self._config, lambda: callback(Request(STOP)), is_stopped)
        self._pollers += [
            Poller(self._take_commands, PERIOD_S, "bus commands"),
            Poller(self._stop_listener.process, PERIOD_S, "stop datagrams"),
        ]
        for name, command in COMMANDS.items():
            self._node.subscription(name, command.schema)

    def answer(self, answers: Answers) -> None:
        """Answer requests, each once, from any thread, without waiting; those that no query waits for are left out."""
        for id, answer in answers.items():
            if (query := self._open.pop(id, None)) is not None:
                self._answered.append((query, answer))

    def close(self) -> None:
        """End the session; a second call does nothing. zenoh gives up on a subscriber that blocks after 10 s."""
        if self._closed:
            return
        self._closed = True
        for poller in self._pollers:
            poller.close()
        if self._stop_listener is not None:
            self._stop_listener.close()
        with suppress(zenoh.ZError):  # raised for such a subscriber; nothing of ours is lost
            self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type

    def _watch_for_namesakes(self) -> None:
        """Declare the name, and watch for others: they keep this robot from being armed, never from starting."""
        own = f"{self._config.robot}/{ALIVE}/{self._session.zid()}"

        def on_token(sample: zenoh.Sample) -> None:
            key, was_unique = str(sample.key_expr), self.is_unique
            if sample.kind == zenoh.SampleKind.DELETE:
                self._namesakes.discard(key)
            elif key != own:
                self._namesakes.add(key)
                if was_unique:
                    self._warn(_SAME_NAME)
                    # Two robots that obey one operator are not what the operator expects.
                    self._on_command(Request(STOP))

        tokens = self._session.liveliness()
        self._declared += [
            tokens.declare_token(own),
            tokens.declare_subscriber(f"{self._config.robot}/{ALIVE}/*", on_token, history=True),
            tokens.declare_token(f"{self._config.robot}/{ALIVE}"),
        ]

    def _queryable(self, name: str) -> Ring:
        rate_hz = COMMANDS[ARM].rate_hz  # as of requests
        return Ring(self._session.declare_queryable, plain_key(self._config.robot, name), rate_hz)

    def _answer_queries(self) -> None:
        """Answer the requests that are decided, and the queries that have come.

        This may block while a program does not read.
        """
        while self._answered:
            query, answer = self._answered.popleft()
            with suppress(zenoh.ZError):  # the program has gone
                query.reply(query.key_expr, json.dumps(answer._asdict()), encoding=zenoh.Encoding.APPLICATION_JSON)
        for name, ring in list(self._queries.items()):
            for query in ring.messages():
                if name in self._kept:
                    kept, attachment, encoding = self._kept[name]
                    query.reply(ring.key, kept() if callable(kept) else kept, encoding=encoding, attachment=attachment)

    def _take_commands(self) -> None:
        """Pass on what has come. Of a stop and a request to arm in one pass the stop wins.

        Which of the two was sent first is not known, because messages of different topics have no common order.
        """
        # 1. Stops.
        stopped, asked_to_arm = self._take_stops(), False
        # 2. All other messages; requests to arm are the last of them.
        for ring in self._rings:
            for message in ring.messages() if ring.topic != STOP else ():
                asked_to_arm |= ring.topic == ARM
                # A request names one robot and one topic: a query for several keys is none.
                if isinstance(message, zenoh.Sample) or str(message.key_expr) == ring.key:
                    self._pass_on(ring.topic, message)
        # 3. After a request to arm: a stop that came in the meantime, or else that of step 1 once more.
        if asked_to_arm and not self._take_stops() and stopped:
            self._on_command(Request(STOP))

    def _take_stops(self) -> bool:
        """Pass on the stops that have come; return whether there was one."""
        samples = [sample for ring in self._rings if ring.topic == STOP for sample in ring.messages()]
        if samples:
            self._pass_on(STOP, samples[-1])
        return bool(samples)

    def _pass_on(self, topic: str, message: zenoh.Sample | zenoh.Query) -> None:
        """Pass on a message with the identity of the program that sent it, empty where it names none.

        Programs with omnid.client give the source of their messages and attach an identity to their requests. Programs
        with rmw_zenoh attach the gid of their publisher. zenoh itself adds nothing. The identity proves nothing: what a
        program may do is decided by the access rules.
        """
        payload, id = b"" if message.payload is None else message.payload.to_bytes(), next(self._ids)
        sender, sent_ns, echo_ns = ros2.read_attachment(message.attachment.to_bytes() if message.attachment else b"")
        if isinstance(message, zenoh.Query):
            self._open[id] = message
            if len(self._open) > MAX_OPEN:  # the oldest one is dropped
                self._open.pop(min(self._open.copy()), None)
        elif message.source_info is not None:
            sender = str(message.source_info.source_id.zid)
        request = Request(topic, payload, sender, sent_ns, id, echo_ns, has_namesake=not self.is_unique)
        if (answer := self._on_command(request)) is not None:
            self.answer({id: answer})
