"""Listens to robots and tells them where to go: a few lines of Python on any machine.

    from omnid.client import subscribe

    with subscribe("omnid") as poses:  # on another machine: connect=("tcp/robot:7447",)
        for pose in poses:
            print(f"{pose.state}: {pose.x_m:.3f} m, {pose.y_m:.3f} m, {pose.yaw_rad:.3f} rad")
            if pose.x_m > 2.0:
                break

Each step of the loop gives the newest pose; those that came while it was busy are gone. The first is the last one that
the robot had found, however long ago: see its stamp. A lost connection is taken up again, without an error. Several
kinds of message and commands go over one connection, see Robot and Driver. Needs eclipse-zenoh, rosbags and numpy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Final, Generic, Self, TypeVar, cast

import zenoh

from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.decode import Cloud, Map, Pose, Report, cloud_from, map_from, pose_from, report_from
from omnid.transport.pose_attachment import Note
from omnid.transport.session import Unreachable, open_session

__all__ = ["HERE", "Cloud", "Driver", "Map", "Note", "Pose", "Report", "Robot", "Subscription", "Unreachable",
           "subscribe"]

T = TypeVar("T")
HERE: Final = "tcp/127.0.0.1:7447"
_DECODE: Final[dict[type[Any], tuple[str, Callable[[bytes, bytes], Any]]]] = {
    Pose: ("odom", pose_from),
    Report: ("status", report_from),
    Cloud: ("cloud", cloud_from),
    Map: ("map", map_from),
}
_ANSWER_S: Final = 1.0
_NAP_S: Final = 0.002


class Subscription(Generic[T]):
    """The newest message of one kind, again and again; broken: how many could not be read."""

    def __init__(self, session: zenoh.Session, key: str, decode: Callable[[bytes, bytes], T],
                 hang_up: Callable[[], None] | None = None) -> None:
        self._decode, self._hang_up = decode, hang_up
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        self._late = _asked(session, key)
        self.broken = 0

    def newest(self) -> T | None:
        """What has come since the last time of asking, if anything; waits for nothing."""
        sample = self._subscriber.try_recv()
        late, self._late = self._late, None  # what comes by itself is newer
        return self._message(sample or late)

    def wait(self, timeout_s: float) -> T | None:
        """The next message, or None after so long."""
        deadline_s = time.monotonic() + timeout_s
        while (message := self.newest()) is None and time.monotonic() < deadline_s:
            time.sleep(_NAP_S)
        return message

    def __iter__(self) -> Iterator[T]:
        """Messages as long as somebody wants them."""
        while True:
            message = self.newest()
            if message is None:
                message = self._message(self._subscriber.recv())
            if message is not None:
                yield message

    def close(self) -> None:
        """Ends the subscription."""
        with suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type
        if self._hang_up is not None:
            self._hang_up()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _message(self, sample: zenoh.Sample | None) -> T | None:
        if sample is None:
            return None
        try:
            return self._decode(sample.payload.to_bytes(), _beside(sample))
        except OmnidError:
            self.broken += 1
            return None


def _beside(sample: zenoh.Sample) -> bytes:
    return b"" if sample.attachment is None else sample.attachment.to_bytes()


def _asked(session: zenoh.Session, key: str) -> zenoh.Sample | None:
    """What is answered under a key, if anything."""
    for reply in session.get(key, timeout=_ANSWER_S):
        if reply.ok is not None:
            return reply.ok
    return None


class Robot:
    """A connection to a robot, directly or through a router.

    settings: of TLS, user and password, as in the section [bus] of omnid's own.
    """

    def __init__(self, robot: str = "omnid", connect: tuple[str, ...] = (HERE,), settings: BusConfig | None = None,
                 patience_s: float = 0.0) -> None:
        """Connects; OmnidError where nobody answers within patience_s."""
        given = settings or BusConfig(robot=robot, connect=connect)
        self.name = given.robot
        self._session = _reached(checked(_as_client(given)), patience_s)
        self._each: list[object] = []  # what is declared lives as long as it is referred to

    def subscribe(self, kind: type[T]) -> Subscription[T]:
        """Messages of a kind: Pose, Report or Cloud."""
        return self._subscription(kind)

    def _subscription(self, kind: type[T], hang_up: Callable[[], None] | None = None) -> Subscription[T]:
        key, decode = _DECODE[kind]
        decoder = cast("Callable[[bytes, bytes], T]", decode)
        return Subscription(self._session, f"{self.name}/{key}", decoder, hang_up)

    def each(self, take: Callable[[str, bytes, bytes], None]) -> None:
        """Has take(topic, message, note) called for whatever the robot says from now on, in a thread of zenoh's.

        The message is CDR of ROS 2, the note what goes along with `odom`. take must be quick and never raise.
        """
        skipped = len(self.name) + 1

        def on_sample(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr)[skipped:], sample.payload.to_bytes(), _beside(sample))

        self._each.append(self._session.declare_subscriber(f"{self.name}/*", on_sample))

    def driver(self) -> Driver:
        """What sends commands to the wheels."""
        return Driver(self._session, self.name)

    def ask(self, name: str) -> str:
        """What the robot says of itself: its `config` or its `rig`, both TOML; "" where it does not answer."""
        answer = _asked(self._session, f"{self.name}/{name}")
        return "" if answer is None else answer.payload.to_bytes().decode("utf-8", "replace")

    @property
    def alive(self) -> bool:
        """Whether its daemon runs and can be reached."""
        replies = self._session.liveliness().get(f"{self.name}/alive", timeout=_ANSWER_S)
        return any(reply.ok is not None for reply in replies)

    def close(self) -> None:
        """Ends the connection; a second call does nothing."""
        with suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _as_client(given: BusConfig) -> BusConfig:
    """Peers that share a router never hear of each other, clients do."""
    chosen = {name: getattr(given, name) for name in
              ("robot", "connect", "config", "retry_s", "tls_ca", "tls_connect_key", "tls_connect_certificate", "user",
               "password_file")}
    return BusConfig(mode="client", listen=(), **{**chosen, "connect": given.connect or (HERE,)})


def _reached(config: BusConfig, patience_s: float) -> zenoh.Session:
    deadline_s = time.monotonic() + patience_s
    while True:
        try:
            return open_session(config, guarded=False)
        except Unreachable:
            if time.monotonic() >= deadline_s:
                raise
        time.sleep(min(config.retry_s, 0.5))


class Driver:
    """Sends commands. They are good for a moment only (helm.deadlines.command_s): go on sending, or the wheels stop.

    From one point to the next, from anywhere:

        import math
        from omnid.client import Pose, Robot

        with Robot("omnid") as robot:
            driver, poses = robot.driver(), robot.subscribe(Pose)
            for x_m, y_m in [(1.0, 0.0), (1.0, 1.0)]:
                for pose in poses:
                    dx_m, dy_m = x_m - pose.x_m, y_m - pose.y_m
                    if math.hypot(dx_m, dy_m) < 0.1 or pose.state == "lost":
                        break
                    driver.heading(0.3, math.atan2(dy_m, dx_m))
            driver.twist(0.0, 0.0)
    """

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._publishers = {name: _commander(session, f"{robot}/cmd/{name}") for name in ("twist", "heading", "stop")}

    @property
    def heard(self) -> bool:
        """Whether a robot listens to commands at the other end."""
        status: Any = self._publishers["twist"].matching_status  # zenoh's stub takes it for a bool
        return bool(status.matching)

    def twist(self, velocity_mps: float, yaw_rate_radps: float) -> None:
        """Drives with this forward speed and yaw rate (counter-clockwise)."""
        payload = codec.twist_stamped_cdr(time.time_ns(), "base_link", velocity_mps, yaw_rate_radps)
        self._publishers["twist"].put(payload)

    def heading(self, velocity_mps: float, heading_rad: float) -> None:
        """Drives with this speed while it holds a heading in odom (counter-clockwise)."""
        self._publishers["heading"].put(codec.heading_cdr(time.time_ns(), velocity_mps, heading_rad))

    def stop(self) -> None:
        """Stops the wheels, whatever else was asked for."""
        self._publishers["stop"].put(b"")


def _commander(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """Commands overtake everything and wait for room: a stop that is dropped is none."""
    return session.declare_publisher(
        key,
        encoding=zenoh.Encoding.APPLICATION_CDR,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )


def subscribe(robot: str = "omnid", connect: tuple[str, ...] = (HERE,), settings: BusConfig | None = None,
              patience_s: float = 0.0) -> Subscription[Pose]:
    """A robot's poses over a connection of their own; all else as Robot takes it."""
    connection = Robot(robot, connect, settings, patience_s)
    return connection._subscription(Pose, connection.close)
