"""Client of a robot: subscribe to its messages and send it commands, from any machine.

    from omnid.client import subscribe

    with subscribe("omnid") as poses:  # on another machine: connect=("tcp/robot:7447",)
        for pose in poses:
            print(f"{pose.state}: {pose.x_m:.3f} m, {pose.y_m:.3f} m, {pose.yaw_rad:.3f} rad")
            if pose.x_m > 2.0:
                break

Each step of the loop yields the newest pose; older ones that arrived meanwhile are dropped. The first one is the last
pose that the robot has published, which may be old: check its stamp. A lost connection is restored without an error.
Several kinds of message, and commands, share one connection: see Robot and Driver. Needs eclipse-zenoh, rosbags, numpy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Final, Generic, Self, TypeVar

import zenoh

from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from omnid.transport.codec import Cloud, Diagnostics, Map, PlanarPath, Pose, PoseAttachment, Scan
from omnid.transport.driver import CONNECT_S, POLL_S, Driver, RobotTime
from omnid.transport.session import ALIVE, HERE, QUERY_S, Unreachable, open_client, robots_there
from omnid.transport.status_names import NavigationReport
from omnid.transport.topics import PUBLISHED, Answer

__all__ = [
    "CONNECT_S",
    "HERE",
    "Answer",
    "Cloud",
    "Diagnostics",
    "Driver",
    "Map",
    "NavigationReport",
    "Pose",
    "PoseAttachment",
    "Robot",
    "Scan",
    "Subscription",
    "Unreachable",
    "subscribe",
]

T = TypeVar("T")
_TOPICS: Final[dict[type[Any], str]] = {
    Pose: "odom",
    Diagnostics: "status",
    Cloud: "cloud",
    Map: "map",
    PlanarPath: "path",
    NavigationReport: "navigation",
    Scan: "scan",
}


class Subscription(Generic[T]):
    """The newest message of one kind; older ones are dropped. broken: number of messages that could not be decoded."""

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        decode: Callable[[bytes, bytes], T],
        on_close: Callable[[], None] | None = None,
    ) -> None:
        self._decode, self._on_close = decode, on_close
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        self._latched = _queried(session, key)
        self.broken = 0

    def newest(self) -> T | None:
        """Return the newest message since the last call, or None; does not block."""
        sample = self._subscriber.try_recv()
        # The message that the robot had kept counts only until another has arrived.
        latched, self._latched = self._latched, None
        return self._message(sample or latched)

    def wait(self, timeout_s: float) -> T | None:
        """Return the next message, or None after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while (message := self.newest()) is None and time.monotonic() < deadline_s:
            time.sleep(POLL_S)  # the channel has no wait with a timeout
        return message

    def __iter__(self) -> Iterator[T]:
        """Yield messages without end."""
        while True:
            message = self.newest()
            if message is None:
                message = self._message(self._subscriber.recv())
            if message is not None:
                yield message

    def close(self) -> None:
        """End the subscription."""
        with suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type
        if self._on_close is not None:
            self._on_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _message(self, sample: zenoh.Sample | None) -> T | None:
        if sample is None:
            return None
        try:
            return self._decode(sample.payload.to_bytes(), _attachment(sample))
        except OmnidError:
            self.broken += 1
            return None


def _attachment(sample: zenoh.Sample) -> bytes:
    return b"" if sample.attachment is None else sample.attachment.to_bytes()


def _queried(session: zenoh.Session, key: str) -> zenoh.Sample | None:
    """Return the answer to a query for a key, if there is any."""
    replies = list(session.get(key, timeout=QUERY_S))
    return next((reply.ok for reply in replies if reply.ok is not None), None)


class Robot:
    """A connection to a robot, direct or through a router; it is ended once.

    settings: section [bus] of omnid's configuration, for TLS and passwords, which its file `config` holds.
    """

    def __init__(
        self,
        robot: str = "omnid",
        connect: str | Sequence[str] = (HERE,),
        settings: BusConfig | None = None,
        timeout_s: float = 0.0,
    ) -> None:
        """Connect; raise Unreachable where no endpoint answers within timeout_s, OmnidError for wrong settings."""
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
        given = settings or BusConfig(robot=robot, connect=endpoints)
        self.name = given.robot
        self._session = open_client(given, timeout_s)
        self._time = RobotTime(self._session, self.name)
        self._declared: list[object] = []  # zenoh undeclares what nothing refers to any longer

    def close(self) -> None:
        """End the connection; a second call does nothing."""
        with suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def subscribe(self, kind: type[T]) -> Subscription[T]:
        """Subscribe to messages of a kind: Pose, Diagnostics, Cloud, Map, NavigationReport or Scan."""
        return self._subscription(kind)

    def _subscription(self, kind: type[T], on_close: Callable[[], None] | None = None) -> Subscription[T]:
        topic = _TOPICS[kind]
        return Subscription(self._session, f"{self.name}/{topic}", PUBLISHED[topic].decode, on_close)

    def on_message(
        self, callback: Callable[[str, bytes, bytes], None], topic: str = "*", *, kept: bool = False
    ) -> Callable[[], None]:
        """Call callback(topic, payload, attachment) for each message of the robot from now on, in a zenoh thread.

        The payload is CDR; `odom` and `panorama` have an attachment. The callback must be quick and never raise.
        topic: the only one to receive; default: all. kept: also for the message of it that the robot has kept, before
        this returns. Return a function that ends the subscription.
        """
        prefix_length = len(self.name) + 1

        def on_sample(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr)[prefix_length:], sample.payload.to_bytes(), _attachment(sample))

        subscriber = self._session.declare_subscriber(f"{self.name}/{topic}", on_sample)
        self._declared.append(subscriber)
        if kept and (sample := _queried(self._session, f"{self.name}/{topic}")) is not None:
            on_sample(sample)

        def end() -> None:
            self._declared.remove(subscriber)
            with suppress(zenoh.ZError):
                subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type

        return end

    def driver(self, source: str = "") -> Driver:
        """Return a sender of commands to the wheels.

        source: one of controller.sources.names, such as "planner"; empty for that of the highest priority.
        """
        if not self._time.now_ns:
            self._time.ask()
        return Driver(self._session, self.name, self._time, source)

    def query(self, name: str) -> str:
        """Return the robot's `config` or `rig`, both TOML; "" where it does not answer."""
        answer = _queried(self._session, f"{self.name}/{name}")
        return "" if answer is None else answer.payload.to_bytes().decode("utf-8", "replace")

    def on_alive(self, callback: Callable[[bool], None]) -> None:
        """Call callback(True) when the robot's daemon is there, callback(False) when it is gone, in a zenoh thread."""

        def on_token(sample: zenoh.Sample) -> None:
            callback(sample.kind == zenoh.SampleKind.PUT)

        tokens = self._session.liveliness()
        self._declared.append(tokens.declare_subscriber(f"{self.name}/{ALIVE}", on_token, history=True))

    @property
    def robots_there(self) -> str:
        """Names of the robots that are there, this one included, as a part of a sentence."""
        return robots_there(self._session)

    @property
    def alive(self) -> bool:
        """True if the robot's daemon runs and can be reached."""
        replies = self._session.liveliness().get(f"{self.name}/{ALIVE}", timeout=QUERY_S)
        return any(reply.ok is not None for reply in replies)


def subscribe(
    robot: str = "omnid",
    connect: str | Sequence[str] = (HERE,),
    settings: BusConfig | None = None,
    timeout_s: float = 0.0,
) -> Subscription[Pose]:
    """Subscribe to a robot's poses over a connection of their own; arguments as those of Robot."""
    connection = Robot(robot, connect, settings, timeout_s)
    return connection._subscription(Pose, connection.close)
