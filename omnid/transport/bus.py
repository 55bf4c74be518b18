"""The zenoh bus: publishes CDR messages below the robot's name, answers queries and receives commands.

`publish` may block for up to zenoh's drop time (1 ms, 50 ms for fragmented messages), so only sinks with a bounded
inbox of their own, and tickers, call it. Two threads take what others send, within budgets: commands, and queries.
Each topic has its plain key, and what ROS 2 needs to find and to read it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from operator import attrgetter
from typing import Any, Final

import zenoh
from zenoh import ext

from omnid.engine.threads import Poller
from omnid.errors import OmnidError
from omnid.transport import ros2
from omnid.transport.bus_config import BusConfig
from omnid.transport.intake import PERIOD_S, CommandIntake, OpenRequests, Ring
from omnid.transport.session import ALIVE, has_receiver, open_session, reason
from omnid.transport.stop_datagram import StopListener
from omnid.transport.topics import ARM, CLOCK, PUBLISHED, STOP, Request, Topic, command_of, plain_key, ros_name

__all__ = ["Bus", "BusConfig"]

_HEARTBEAT_S: Final = 0.5  # rmw_zenoh's
QUERY_PERIOD_S: Final = 0.01


class TopicPublisher:
    """The zenoh publishers of one topic: the plain key, and the key of ROS 2 where that is another."""

    def __init__(self, session: zenoh.Session, config: BusConfig, name: str, node: ros2.RosNode) -> None:
        topic = PUBLISHED[name]
        token = node.publisher(name, topic.schema, transient_local=topic.transient_local)
        self._gid, self._seq = ros2.gid_of(token), 0
        self._plain = _declared_publisher(session, plain_key(config.robot, name), topic)
        self._ros: zenoh.Publisher | ext.AdvancedPublisher | None = None
        if config.ros2 == "rmw_zenoh":
            key = ros2.data_key(config.ros2_domain, ros_name(config.robot, name), topic.schema)
            self._ros = _declared_publisher(session, key, topic, keeps=topic.transient_local)

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


def _declared_publisher(
    session: zenoh.Session, key: str, topic: Topic, *, keeps: bool = False
) -> zenoh.Publisher | ext.AdvancedPublisher:
    """Declare a publisher, not express: each express message fills one of the few batches of every router on the way.

    Poses were dropped there, and the latency is the same. keeps: it keeps its newest message for late subscribers, as
    rmw_zenoh does for transient local (rmw_publisher_data.cpp): a cache, detection of the publisher, heartbeats.
    """
    quality: dict[str, Any] = {
        "encoding": zenoh.Encoding.APPLICATION_CDR,
        "congestion_control": zenoh.CongestionControl.DROP,
        "priority": zenoh.Priority.REAL_TIME if topic.realtime else zenoh.Priority.DATA,
        "express": False,
        "reliability": zenoh.Reliability.RELIABLE,
    }
    if not keeps:
        return session.declare_publisher(key, **quality)
    return ext.declare_advanced_publisher(
        session,
        key,
        **quality,
        cache=ext.CacheConfig(1),
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
        publisher_detection=True,
    )


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
        self._on_command: Callable[[Request], None] | None = None
        self._watch_for_namesakes()
        # A robot whose time is the computer's has none: programs that wait for it would believe to be in a simulation.
        topics = [name for name in PUBLISHED if gives_time or name != CLOCK]
        self._node = ros2.RosNode(session, config.robot, config.ros2_domain, is_on=config.ros2 != "off")
        self._publishers = {name: TopicPublisher(session, config, name, self._node) for name in topics}
        self._newest: dict[str, tuple[bytes, bytes | None]] = {}  # payload and attachment of latched topics
        self._texts: dict[str, str | Callable[[], str]] = {}  # answers to queries, by name
        self._queries = {name: self._queryable(name) for name in topics if PUBLISHED[name].latched}
        self._requests = OpenRequests()
        self.answer = self._requests.answer  # answers a request; nothing happens where no query waits for it
        self._commands: CommandIntake | None = None
        self._stop_listener: StopListener | None = None
        self._flooded = 0  # floods at the last status
        self._pollers = [Poller(self._answer_queries, QUERY_PERIOD_S, "bus queries")]

    def stats(self) -> dict[str, object]:
        """Return whether the name is unique, and how often others sent too much."""
        rings = [*(self._commands.rings if self._commands else ()), *self._queries.values()]
        before, self._flooded = self._flooded, sum(ring.floods for ring in rings)
        warning = ""
        if self._flooded > before:
            warning = f"more messages on {max(rings, key=attrgetter('floods')).key} than are taken: end their sender"
        return {
            "same_name": len(self._namesakes),  # other robots of this name
            "floods": self._flooded,  # how often a key had more messages than its budget
            "_error": "" if self.is_unique else self._same_name,
            "_warning": warning,
            "_words": "open",
        }

    @property
    def is_unique(self) -> bool:
        """True while no other robot on the bus has this one's name."""
        return not self._namesakes

    def publish(self, topic: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Send CDR bytes as `<robot>/<topic>`, and under the key that ROS 2 expects; dropped in congestion.

        attachment: zenoh attachment for subscribers that know omnid. A topic with a leading '/' has no robot's name.
        """
        if PUBLISHED[topic].latched:
            self._newest[topic] = (payload, attachment)
        try:
            self._publishers[topic].put(payload, attachment)
        except zenoh.ZError as error:
            raise OmnidError(f"bus cannot publish {topic}: {reason(error)}; restart") from error

    def is_received(self, topic: str) -> bool:
        """True if a topic has a subscriber."""
        return self._publishers[topic].is_received

    def serve(self, name: str, text: str | Callable[[], str]) -> None:
        """Answer queries for `<robot>/<name>` with a text, such as the configuration, or with that of the moment."""
        self._texts[name] = text
        self._queries[name] = self._queryable(name)

    def subscribe_commands(
        self,
        callback: Callable[[Request], None],
        topics: Mapping[str, str],
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Call callback for messages on `<robot>/cmd/...` and queries that ask the same, in a thread of the bus.

        topics: with their types, each with a budget of its own; what exceeds it is dropped and counted.
        is_stopped: True if a stop holds, which confirms stops that come as datagrams; they are passed on as others.
        """
        self._on_command = callback
        if not self.is_unique:
            callback(Request(STOP))
        self._commands = CommandIntake(self._session, self._config, topics, self._requests, callback)
        self._stop_listener = StopListener(self._config, lambda: callback(Request(STOP)), is_stopped)
        self._pollers += [
            Poller(self._commands.process, PERIOD_S, "bus commands"),
            Poller(self._stop_listener.process, PERIOD_S, "stop datagrams"),
        ]
        for name, schema in topics.items():
            self._node.subscription(name, schema)

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

    @property
    def _same_name(self) -> str:
        return (
            f"another robot on the bus has the name {self._config.robot!r}, and both obey the same commands: this "
            "one is not armed before the other has gone; change bus.robot of one of them"
        )

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
                    self._warn(self._same_name)
                    # Two robots that obey one operator are not what the operator expects.
                    if self._on_command is not None:
                        self._on_command(Request(STOP))

        tokens = self._session.liveliness()
        self._declared += [
            tokens.declare_token(own),
            tokens.declare_subscriber(f"{self._config.robot}/{ALIVE}/*", on_token, history=True),
            tokens.declare_token(f"{self._config.robot}/{ALIVE}"),
        ]

    def _queryable(self, name: str) -> Ring:
        rate_hz = command_of(ARM).rate_hz  # as of requests
        return Ring(self._session.declare_queryable, plain_key(self._config.robot, name), rate_hz)

    def _answer_queries(self) -> None:
        """Answer the queries that have come, and the requests that are decided."""
        self._requests.send()
        for name, ring in list(self._queries.items()):
            for query in ring.messages():
                if (text := self._texts.get(name)) is not None:
                    query.reply(ring.key, text if isinstance(text, str) else text(), encoding=zenoh.Encoding.TEXT_PLAIN)
                elif name in self._newest:
                    payload, attachment = self._newest[name]
                    query.reply(ring.key, payload, encoding=zenoh.Encoding.APPLICATION_CDR, attachment=attachment)
