"""The zenoh bus: publishes CDR messages below the robot's name, answers queries and receives commands.

Bus starts no thread of its own. `publish` may block for up to zenoh's drop time (1 ms, 50 ms for fragmented messages),
so only sinks with a bounded inbox of their own, and tickers, call it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Final

import zenoh

from omnid.errors import OmnidError
from omnid.transport import ros2, status_names
from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.codec import ERROR, OK, WARN, DiagnosticStatus
from omnid.transport.publishers import RosGraph, TopicPublisher
from omnid.transport.session import EndpointTaken, open_session, reason, router_in_place
from omnid.transport.topics import PUBLISHED

__all__ = ["Bus", "BusConfig"]

ALIVE: Final = "alive"  # liveliness token below the robot's name; exists as long as the daemon runs
_ALIVE_TIMEOUT_S: Final = 1.0  # of the search for a robot of the same name
# Key from `cmd` on, payload, identity of the sender, time of sending [ns of Unix time].
CommandCallback = Callable[[str, bytes, str, int], None]


class Bus:
    """An open zenoh session. Remote endpoints may come and go; local endpoints must be free.

    lost: messages that could not be sent because a client has not reached its router yet.
    """

    def __init__(self, config: BusConfig, warn: Callable[[str], None] = lambda _: None) -> None:
        """Open the session, or that of a client with the first `connect`.

        Raise OmnidError for a wrong configuration, and where a robot of the same name is on the bus already. Later ones
        are reported by one call of warn, in a zenoh thread, and in the status.
        """
        self._config, self._warn = checked(config), warn
        self._namesakes: set[str] = set()  # keys of the liveliness tokens of other robots of the same name
        self._warned = False
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, TopicPublisher] = {}
        self._newest: dict[str, tuple[bytes, zenoh.Encoding, bytes | None]] = {}
        self._on_command: CommandCallback | None = None
        self._command_topics: Mapping[str, str] = {}
        self._graph: RosGraph | None = None
        self._declared: list[object] = []  # zenoh undeclares what is no longer referred to
        self._closed = False
        self.lost = 0
        if not self.needs_router:
            self._open_peer()

    @property
    def needs_router(self) -> bool:
        """True for a client, whose `connect` must be called from time to time."""
        return self._config.mode == "client"

    def connect(self) -> None:
        """Try once to reach the router, unless it was reached before: zenoh reconnects by itself only after that."""
        if self._session is None and not self._closed:
            with suppress(OmnidError):  # the configuration has been checked, so the router is not there yet
                self._open()

    def status(self) -> DiagnosticStatus:
        """Return whether the bus is open and the name unique, and the number of messages lost before that."""
        level, message = OK, "open"
        if self._session is None:
            level, message = WARN, f"no router yet at {', '.join(self._config.connect)}"
        elif self._namesakes:
            level, message = ERROR, self._same_name
        values = {"mode": self._config.mode, "lost": str(self.lost), "same_name": str(len(self._namesakes))}
        return DiagnosticStatus(status_names.BUS, level, message, values)

    def publish(self, topic: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Send CDR bytes as `<robot>/<topic>`, and under the key that ROS 2 expects; dropped in congestion.

        attachment: zenoh attachment for subscribers that know omnid. A topic with a leading '/' has no robot's name.
        """
        if topic not in PUBLISHED:
            raise OmnidError(f"bus key {topic!r} is not published; expected one of {', '.join(PUBLISHED)}")
        if PUBLISHED[topic].latched:
            self._newest[topic] = (payload, zenoh.Encoding.APPLICATION_CDR, attachment)
        if self._session is None:
            self.lost += 1
            return
        try:
            self._publishers[topic].put(payload, attachment)
        except zenoh.ZError as error:
            raise OmnidError(f"bus cannot publish {topic}: {reason(error)}; restart") from error

    def serve(self, name: str, text: str) -> None:
        """Answer queries for `<robot>/<name>` with a text, such as the configuration; a second text replaces it."""
        is_new = name not in self._newest
        self._newest[name] = (text.encode(), zenoh.Encoding.TEXT_PLAIN, None)
        if is_new and self._session is not None:
            self._declare_queryable(self._session, name)

    def subscribe_commands(self, callback: CommandCallback, topics: Mapping[str, str]) -> None:
        """Call callback(key, payload, sender, sent_ns) for each message on `<robot>/cmd/...`, in a zenoh thread.

        key: from `cmd` on. sender: empty where the message does not name it. sent_ns: 0 where it does not
        say it. topics: with their types, for ROS 2.
        """
        self._on_command, self._command_topics = callback, topics
        if self._session is not None:
            self._declare_subscribers(self._session, callback)

    def close(self) -> None:
        """End the session; a second call does nothing. zenoh gives up on a subscriber that blocks after 10 s."""
        if not self._closed and self._session is not None:
            with suppress(zenoh.ZError):  # raised for such a subscriber; nothing of ours is lost
                self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type
        self._closed = True

    @property
    def _same_name(self) -> str:
        return (f"another robot on the bus has the name {self._config.robot!r}, and both obey the same commands; "
                "change bus.robot of one of them")

    def _open_peer(self) -> None:
        """Open the session of a peer; where ROS 2's router (rmw_zenohd) holds the endpoints, that of its client."""
        try:
            self._open()
        except EndpointTaken:
            client = router_in_place(self._config) if self._config.ros2 == "rmw_zenoh" else None
            if client is None:
                raise
            self._warn(f"the zenoh router at {', '.join(client.connect)} is joined as a client: who "
                       "may connect is decided there")
            self._config = client
            self._open()

    def _open(self) -> None:
        session = open_session(self._config)
        if self._finds_same_name(session):
            if not self.needs_router:
                session.close()  # type: ignore[no-untyped-call]  # the stub has no return type
                raise OmnidError(self._same_name)
            self._report_same_name()
        self._watch_names(session)
        self._graph = graph = RosGraph(session, self._config)
        self._declared.append(session.liveliness().declare_token(f"{self._config.robot}/{ALIVE}"))
        self._publishers = {name: TopicPublisher(session, self._config, name, graph) for name in PUBLISHED}
        for name in {*self._newest, *(name for name, topic in PUBLISHED.items() if topic.latched)}:
            self._declare_queryable(session, name)
        for name, (payload, _, attached) in self._newest.items():  # published before the router was reached
            if name in PUBLISHED and PUBLISHED[name].transient_local:
                self._publishers[name].put(payload, attached)
        if self._on_command is not None:
            self._declare_subscribers(session, self._on_command)
        self._session = session

    def _finds_same_name(self, session: zenoh.Session) -> bool:
        """True if a robot of this name is on the bus; peers that share a router only see it as a client."""
        if _is_alive(session, self._config.robot):
            return True
        if self.needs_router or not self._config.connect:
            return False
        try:
            client = open_session(replace(self._config, mode="client", listen=()), guarded=False)
        except OmnidError:  # no router yet
            return False
        try:
            return _is_alive(client, self._config.robot)
        finally:
            client.close()  # type: ignore[no-untyped-call]

    def _watch_names(self, session: zenoh.Session) -> None:
        """Declare a token with the session's identity, and watch those of other robots of the same name."""
        own = f"{self._config.robot}/{ALIVE}/{session.zid()}"

        def on_token(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.DELETE:
                self._namesakes.discard(key)
            elif key != own:
                self._namesakes.add(key)
                self._report_same_name()

        liveliness = session.liveliness()
        self._declared.append(liveliness.declare_token(own))
        names = f"{self._config.robot}/{ALIVE}/*"
        self._declared.append(liveliness.declare_subscriber(names, on_token, history=True))

    def _report_same_name(self) -> None:
        if not self._warned:
            self._warned = True
            self._warn(self._same_name)

    def _declare_queryable(self, session: zenoh.Session, name: str) -> None:
        key = f"{self._config.robot}/{name.removeprefix('/')}"

        def on_query(query: zenoh.Query) -> None:
            if name in self._newest:
                payload, encoding, attachment = self._newest[name]
                query.reply(key, payload, encoding=encoding, attachment=attachment)

        self._declared.append(session.declare_queryable(key, on_query))

    def _declare_subscribers(self, session: zenoh.Session, callback: CommandCallback) -> None:
        plain = f"{self._config.robot}/cmd/**"
        prefix_length = len(self._config.robot) + 1
        self._declared.append(session.declare_subscriber(plain, _sample_callback(callback, prefix_length)))
        if self._config.ros2 == "rmw_zenoh":
            key = f"{self._config.ros2_domain}/{plain}"
            prefix_length += len(str(self._config.ros2_domain)) + 1
            on_sample = _sample_callback(callback, prefix_length, suffix_parts=2)  # message type and its hash
            self._declared.append(session.declare_subscriber(key, on_sample))
        if self._graph is not None:
            for name, schema in self._command_topics.items():
                self._graph.subscription(name, schema)


def _is_alive(session: zenoh.Session, robot: str) -> bool:
    replies = session.liveliness().get(f"{robot}/{ALIVE}", timeout=_ALIVE_TIMEOUT_S)
    return any(reply.ok is not None for reply in replies)


def _sample_callback(
    callback: CommandCallback, prefix_length: int, suffix_parts: int = 0
) -> Callable[[zenoh.Sample], None]:
    """Return a zenoh callback that passes on the key without its first characters and last parts, payload and sender.
    """

    def on_sample(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)[prefix_length:]
        topic = key.rsplit("/", suffix_parts)[0] if suffix_parts else key
        callback(topic, sample.payload.to_bytes(), _sender(sample), _sent_ns(sample))

    return on_sample


def _sender(sample: zenoh.Sample) -> str:
    """Return the identity of the program that sent a sample, empty where it names none.

    Programs with omnid.client give the source of their messages, those of rmw_zenoh the gid of their publisher; zenoh
    itself adds nothing. No proof: permissions are those of the access rules.
    """
    if sample.source_info is not None:
        return str(sample.source_info.source_id.zid)
    return "" if sample.attachment is None else ros2.gid_in(sample.attachment.to_bytes())


def _sent_ns(sample: zenoh.Sample) -> int:
    """Return the time of sending that rmw_zenoh attaches to a sample, 0 without."""
    return 0 if sample.attachment is None else ros2.sent_ns_in(sample.attachment.to_bytes())
