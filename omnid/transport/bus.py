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
from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.intake import PERIOD_S, CommandIntake, Intake, OpenRequests, RequestCallback, burst_of
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
    """An open zenoh session. Remote endpoints may come and go; local endpoints must be free."""

    def __init__(
        self, config: BusConfig, warn: Callable[[str], None] = lambda _: None, *, gives_time: bool = False
    ) -> None:
        """Open the session, or that of a client with the first `connect`. gives_time: there is a topic /clock.

        Raise OmnidError for a wrong configuration. Each time that the name is no longer unique, warn is called, and the
        subscriber of commands receives a stop.
        """
        self._config, self._warn = checked(config), warn
        # A robot whose time is the computer's has none: programs that wait for it would believe to be in a simulation.
        self._topics = {name: topic for name, topic in PUBLISHED.items() if gives_time or name != CLOCK}
        self._namesakes: set[str] = set()  # liveliness tokens of other robots of this name
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, TopicPublisher] = {}
        self._newest: dict[str, tuple[bytes, bytes | None]] = {}  # payload and attachment of latched topics
        self._texts: dict[str, str | Callable[[], str]] = {}  # answers to queries, by name
        self._on_command: RequestCallback | None = None
        self._requests = OpenRequests()
        self.answer = self._requests.answer  # answers a request; nothing happens where no query waits for it
        self._command_topics: Mapping[str, str] = {}
        self._is_stopped: Callable[[], bool] = lambda: False
        self._stop_listener: StopListener | None = None
        self._node: ros2.RosNode | None = None
        self._declared: list[object] = []  # zenoh undeclares what is no longer referred to
        self._commands: CommandIntake | None = None
        self._queries: dict[str, Intake[zenoh.Query]] = {}  # by name
        self._pollers: list[Poller] = []
        self._flooded = 0  # floods at the last status
        self._closed = False
        if not self.needs_router:
            self._open()

    @property
    def needs_router(self) -> bool:
        """True for a client, whose `connect` must be called from time to time."""
        return self._config.is_client

    def connect(self) -> None:
        """Try once to reach the router, unless it was reached before: zenoh reconnects by itself only after that."""
        if self._session is None and not self._closed:
            with suppress(OmnidError):  # the configuration has been checked, so the router is not there yet
                self._open()

    def stats(self) -> dict[str, object]:
        """Return whether the bus is open, the name unique, and how often others sent too much."""
        intakes = [*(self._commands.intakes if self._commands else ()), *self._queries.values()]
        before, self._flooded = self._flooded, sum(intake.floods for intake in intakes)
        warning = ""
        if self._session is None:
            warning = f"no router yet at {', '.join(self._config.connect)}"
        elif self._flooded > before:
            warning = f"more messages on {max(intakes, key=attrgetter('floods')).key} than are taken: end their sender"
        return {
            "mode": "client" if self._config.is_client else "peer",
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
        if self._topics[topic].latched:
            self._newest[topic] = (payload, attachment)
        if self._session is None:
            return
        try:
            self._publishers[topic].put(payload, attachment)
        except zenoh.ZError as error:
            raise OmnidError(f"bus cannot publish {topic}: {reason(error)}; restart") from error

    def is_received(self, topic: str) -> bool:
        """True if a topic has a subscriber."""
        return self._session is not None and self._publishers[topic].is_received

    def serve(self, name: str, text: str | Callable[[], str]) -> None:
        """Answer queries for `<robot>/<name>` with a text, such as the configuration, or with that of the moment.

        A second call replaces the first.
        """
        is_new = name not in self._texts
        self._texts[name] = text
        if is_new and self._session is not None:
            self._declare_queryable(self._session, name)

    def subscribe_commands(
        self, callback: RequestCallback, topics: Mapping[str, str], is_stopped: Callable[[], bool] = lambda: False
    ) -> None:
        """Call callback for messages on `<robot>/cmd/...` and queries that ask the same, in a thread of the bus.

        topics: with their types, each with a budget of its own; what exceeds it is dropped and counted.
        is_stopped: True if a stop holds, which confirms stops that come as datagrams; they are passed on as others.
        """
        self._on_command, self._command_topics, self._is_stopped = callback, topics, is_stopped
        if self._session is not None:
            self._declare_subscribers(self._session, callback)

    def close(self) -> None:
        """End the session; a second call does nothing. zenoh gives up on a subscriber that blocks after 10 s."""
        for poller in self._pollers:
            poller.close()
        if self._stop_listener is not None:
            self._stop_listener.close()
        if not self._closed and self._session is not None:
            with suppress(zenoh.ZError):  # raised for such a subscriber; nothing of ours is lost
                self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type
        self._closed = True

    @property
    def _same_name(self) -> str:
        return (
            f"another robot on the bus has the name {self._config.robot!r}, and both obey the same commands: this "
            "one is not armed before the other has gone; change bus.robot of one of them"
        )

    def _open(self) -> None:
        session = open_session(self._config)
        self._watch_for_namesakes(session)
        config = self._config
        self._node = node = ros2.RosNode(session, config.robot, config.ros2_domain, is_on=config.ros2 != "off")
        self._publishers = {name: TopicPublisher(session, config, name, node) for name in self._topics}
        for name in {*self._texts, *(name for name, topic in self._topics.items() if topic.latched)}:
            self._declare_queryable(session, name)
        for name, (payload, attached) in self._newest.items():  # published before the router was reached
            if self._topics[name].transient_local:
                self._publishers[name].put(payload, attached)
        if self._on_command is not None:
            self._declare_subscribers(session, self._on_command)
        self._session = session
        self._pollers.append(Poller(self._answer_queries, QUERY_PERIOD_S, "bus queries"))

    def _watch_for_namesakes(self, session: zenoh.Session) -> None:
        """Declare the name, and watch for others: they keep this robot from being armed, never from starting."""
        own = f"{self._config.robot}/{ALIVE}/{session.zid()}"

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

        tokens = session.liveliness()
        self._declared += [
            tokens.declare_token(own),
            tokens.declare_subscriber(f"{self._config.robot}/{ALIVE}/*", on_token, history=True),
            tokens.declare_token(f"{self._config.robot}/{ALIVE}"),
        ]

    def _declare_queryable(self, session: zenoh.Session, name: str) -> None:
        key = plain_key(self._config.robot, name)
        rate_hz = command_of(ARM).rate_hz  # as of requests
        queryable = session.declare_queryable(key, zenoh.handlers.RingChannel(burst_of(rate_hz)))
        self._declared.append(queryable)
        self._queries[name] = Intake(f"queries for {name}", queryable.try_recv, rate_hz)

    def _answer_queries(self) -> None:
        """Answer the queries that have come, and the requests that are decided."""
        self._requests.send()
        for name, intake in list(self._queries.items()):
            for query in intake.messages():
                key, text = plain_key(self._config.robot, name), self._texts.get(name)
                if text is not None:
                    query.reply(key, text if isinstance(text, str) else text(), encoding=zenoh.Encoding.TEXT_PLAIN)
                elif name in self._newest:
                    payload, attachment = self._newest[name]
                    query.reply(key, payload, encoding=zenoh.Encoding.APPLICATION_CDR, attachment=attachment)

    def _declare_subscribers(self, session: zenoh.Session, callback: RequestCallback) -> None:
        if not self.is_unique:
            callback(Request(STOP))
        self._commands = CommandIntake(session, self._config, self._command_topics, self._requests, callback)
        self._pollers.append(Poller(self._commands.process, PERIOD_S, "bus commands"))
        self._stop_listener = StopListener(self._config, lambda: callback(Request(STOP)), self._is_stopped)
        self._pollers.append(Poller(self._stop_listener.process, PERIOD_S, "stop datagrams"))
        if self._node is not None:
            for name, schema in self._command_topics.items():
                self._node.subscription(name, schema)
