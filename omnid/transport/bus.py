"""The zenoh bus: publishes CDR messages under the robot's name, answers who asks for the newest, hears commands.

A session owns no thread of ours: whoever calls `publish` may wait up to zenoh's drop time (1 ms, 50 ms for fragmented
messages), so only sinks with a bounded inbox of their own, and tickers, call it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import zenoh

from omnid.errors import OmnidError
from omnid.transport import ros2
from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.session import open_session, reason
from omnid.transport.topics import HEARD, SAID, Topic

__all__ = ["Bus", "BusConfig"]

ALIVE: Final = "alive"  # below the robot's name: a liveliness token, there as long as the daemon is
Take = Callable[[str, bytes], None]


class Bus:
    """An open zenoh session; endpoints to connect to may come and go, those to listen on must be free.

    lost: messages that nobody could be sent, since a client has not found its router yet.
    """

    def __init__(self, config: BusConfig) -> None:
        """Opens the session, a client's with the first `join`; OmnidError where the configuration cannot be used."""
        self._config = checked(config)
        self._session: zenoh.Session | None = None
        self._channels: dict[str, _Channel] = {}
        self._newest: dict[str, tuple[bytes, zenoh.Encoding, bytes | None]] = {}
        self._take: Take | None = None
        self._graph: _Graph | None = None
        self._held: list[object] = []  # what is declared lives as long as it is referred to
        self._left = False
        self.lost = 0
        if not self.seeks:
            self._open()

    @property
    def seeks(self) -> bool:
        """Whether it is one for which somebody must call `join` now and then."""
        return self._config.mode == "client"

    def join(self) -> None:
        """Looks for the router once, unless it was found: zenoh itself waits for none, but comes back to a lost one."""
        if self._session is None and not self._left:
            with suppress(OmnidError):  # the configuration has been checked: it is not there yet
                self._open()

    def status(self) -> DiagnosticStatus:
        """Whether there is anybody to speak to, and what was said to nobody."""
        waiting = self._session is None
        said = f"no router yet at {', '.join(self._config.connect)}" if waiting else "open"
        return DiagnosticStatus(
            "omnid: bus", WARN if waiting else OK, said, {"mode": self._config.mode, "lost": str(self.lost)}
        )

    def publish(self, topic: str, payload: bytes, note: bytes | None = None) -> None:
        """Sends CDR bytes as `<robot>/<topic>`, and as ROS 2 wants them; dropped in congestion.

        note: what goes along for those who know omnid. A topic with a leading '/' is the same for all robots of ROS 2.
        """
        if topic not in SAID:
            raise OmnidError(f"bus key {topic!r} is not said here; one of {', '.join(SAID)}")
        if SAID[topic].late:
            self._newest[topic] = (payload, zenoh.Encoding.APPLICATION_CDR, note)
        if self._session is None:
            self.lost += 1
            return
        try:
            self._channels[topic].put(payload, note)
        except zenoh.ZError as error:
            raise OmnidError(f"bus cannot publish {topic}: {reason(error)}; restart") from error

    def tell(self, name: str, text: str) -> None:
        """Has whoever asks for `<robot>/<name>` told the text, such as the configuration."""
        self._newest[name] = (text.encode(), zenoh.Encoding.TEXT_PLAIN, None)
        if self._session is not None:
            self._answer(self._session, name)

    def hear(self, take: Take) -> None:
        """Has take(key, payload) called for whatever comes as `<robot>/cmd/...`, key from `cmd` on.

        In a thread of zenoh's.
        """
        self._take = take
        if self._session is not None:
            self._listen(self._session, take)

    def close(self) -> None:
        """Ends the session; a second call does nothing. A listener that hangs is left alone after zenoh's 10 s."""
        if not self._left and self._session is not None:
            with suppress(zenoh.ZError):  # told of such a listener: nothing is lost here
                self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type
        self._left = True

    def _open(self) -> None:
        session = open_session(self._config)
        self._graph = graph = _Graph(session, self._config)
        self._held.append(session.liveliness().declare_token(f"{self._config.robot}/{ALIVE}"))
        self._channels = {name: _Channel(session, self._config, name, graph) for name in SAID}
        for name in {*self._newest, *(name for name, topic in SAID.items() if topic.late)}:
            self._answer(session, name)
        if self._take is not None:
            self._listen(session, self._take)
        self._session = session

    def _answer(self, session: zenoh.Session, name: str) -> None:
        key = f"{self._config.robot}/{name}"

        def on_query(query: zenoh.Query) -> None:
            if name in self._newest:
                payload, encoding, note = self._newest[name]
                query.reply(key, payload, encoding=encoding, attachment=note)

        self._held.append(session.declare_queryable(key, on_query))

    def _listen(self, session: zenoh.Session, take: Take) -> None:
        plain = f"{self._config.robot}/cmd/**"
        skipped = len(self._config.robot) + 1
        self._held.append(session.declare_subscriber(plain, _taker(take, skipped)))
        if self._config.ros2 == "rmw_zenoh":
            key = f"{self._config.ros2_domain}/{plain}"
            skipped += len(str(self._config.ros2_domain)) + 1
            self._held.append(session.declare_subscriber(key, _taker(take, skipped, ending=2)))
        if self._graph is not None:
            for name, schema in HEARD.items():
                self._graph.announce("MS", name, schema)


def _taker(take: Take, skipped: int, ending: int = 0) -> Callable[[zenoh.Sample], None]:
    """Hands samples on under their key without its first characters and last parts."""

    def on_sample(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)[skipped:]
        take(key.rsplit("/", ending)[0] if ending else key, sample.payload.to_bytes())

    return on_sample


class _Graph:
    """What ROS 2 is told of us: a node and its topics."""

    def __init__(self, session: zenoh.Session, config: BusConfig) -> None:
        self._session, self._config = session, config
        self._node = ros2.RmwNode(config.ros2_domain, str(session.zid()), ros2.node_name(config.robot))
        self._tokens: list[zenoh.LivelinessToken] = []
        if config.ros2 == "rmw_zenoh":
            self._declare(self._node.token)

    def announce(self, kind: str, topic: str, schema: str) -> str:
        """Declares a publisher (MP) or a subscription (MS); its token, "" where ROS 2 is off."""
        name = ros_name(self._config.robot, topic)
        if self._config.ros2 == "rmw_zenoh":
            entity = 1 + [*SAID, *HEARD].index(topic)
            make = self._node.publisher if kind == "MP" else self._node.subscription
            return self._declare(make(entity, name, schema))
        if self._config.ros2 == "ros2dds":
            return self._declare(ros2.bridge_token(str(self._session.zid()), kind, name[1:], schema))
        return ""

    def _declare(self, token: str) -> str:
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token


def ros_name(robot: str, topic: str) -> str:
    """A topic's name in ROS 2."""
    return topic if topic.startswith("/") else f"/{robot}/{topic}"


class _Channel:
    """The publishers of one topic: the plain one, and the one that ROS 2 wants where that is another."""

    def __init__(self, session: zenoh.Session, config: BusConfig, name: str, graph: _Graph) -> None:
        topic, ros = SAID[name], ros_name(config.robot, name)
        plain = f"{config.robot}/{name.removeprefix('/')}"
        self._plain = _publisher(session, plain, topic)
        token = graph.announce("MP", name, topic.schema)
        key = ros2.data_key(config.ros2_domain, ros, topic.schema) if config.ros2 == "rmw_zenoh" else ros[1:]
        other = config.ros2 != "off" and key != plain
        self._ros = _publisher(session, key, topic) if other else None
        self._gid = ros2.gid_of(token) if config.ros2 == "rmw_zenoh" else b""
        self._seq = 0

    def put(self, payload: bytes, note: bytes | None) -> None:
        """Sends to whoever listens; what nobody listens to costs microseconds."""
        self._plain.put(payload, attachment=note)
        if self._ros is not None:
            self._seq += 1
            beside = ros2.attachment(self._seq, time.time_ns(), self._gid) if self._gid else None
            self._ros.put(payload, attachment=beside)


def _publisher(session: zenoh.Session, key: str, topic: Topic) -> zenoh.Publisher:
    """Not express: each message would fill one of the few batches of every router on the way, and poses were dropped
    there; the latency is the same.
    """
    return session.declare_publisher(
        key,
        encoding=zenoh.Encoding.APPLICATION_CDR,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME if topic.realtime else zenoh.Priority.DATA,
        express=False,
        reliability=zenoh.Reliability.RELIABLE,
    )
