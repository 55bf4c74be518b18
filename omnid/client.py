"""Client of a robot: subscribe to its messages and send it commands, from any machine.

    from omnid.client import Pose, Robot

    with Robot("omnid") as robot:  # on another machine: connect=("tcp/robot:7447",)
        for pose in robot.subscribe(Pose):
            print(f"{pose.state}: {pose.x_m:.3f} m, {pose.y_m:.3f} m, {pose.yaw_rad:.3f} rad")
            if pose.x_m > 2.0:
                break

Each step of the loop yields the newest pose; older ones that arrived meanwhile are dropped. The first one is the last
pose that the robot has published, which may be old: check its stamp. A lost connection is restored without an error.
Several kinds of message, and commands, share one connection. Needs eclipse-zenoh, rosbags, numpy.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from typing import Any, Final, Generic, Literal, TypeVar

import zenoh

from omnid.errors import OmnidError
from omnid.transport import codec, ros2, topics
from omnid.transport.codec import Cloud, Diagnostics, Map, PlanarPath, Pose, PoseAttachment, Scan
from omnid.transport.session import ALIVE, CONNECT_S, HERE, PERIOD_S, BusConfig, Unreachable, has_receiver, open_client
from omnid.transport.status_names import NavigationReport
from omnid.transport.topics import PUBLISHED, Answer

__all__ = [
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
]

T = TypeVar("T")
ANSWER_S: Final = 10.0  # longer than writing a map or a route
_TOPICS: Final[dict[type[Any], str]] = {
    Pose: "odom",
    Diagnostics: "status",
    Cloud: "cloud",
    Map: "map",
    PlanarPath: "path",
    NavigationReport: "navigation",
    Scan: "scan",
}
# A stop must not be lost, and overtakes all else; requests go the same way.
_QUALITY: Final[dict[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
}


class Subscription(AbstractContextManager["Subscription[T]"], Generic[T]):
    """The newest message of one kind; older ones, and what cannot be decoded, are dropped."""

    def __init__(self, session: zenoh.Session, key: str, decode: Callable[[bytes, bytes], T]) -> None:
        self._decode = decode
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        self._latched = _queried(session, key)

    def newest(self) -> T | None:
        """Return the newest message since the last call, or None; does not block."""
        # The message that the robot had kept counts only until another has arrived.
        latched, self._latched = self._latched, None
        return self._message(self._subscriber.try_recv() or latched)

    def wait(self, timeout_s: float) -> T | None:
        """Return the next message, or None after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while (message := self.newest()) is None and time.monotonic() < deadline_s:
            time.sleep(PERIOD_S)  # the channel has no wait with a timeout
        return message

    def __iter__(self) -> Iterator[T]:
        """Yield messages without end."""
        while True:
            message = self.newest()
            if message is None:
                message = self._message(self._subscriber.recv())
            if message is not None:
                yield message

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type

    def _message(self, sample: zenoh.Sample | None) -> T | None:
        with suppress(OmnidError):
            return None if sample is None else self._decode(sample.payload.to_bytes(), _attachment(sample))
        return None


def _attachment(sample: zenoh.Sample) -> bytes:
    return b"" if sample.attachment is None else sample.attachment.to_bytes()


def _queried(session: zenoh.Session, key: str) -> zenoh.Sample | None:
    """Return the answer to a query for a key, if there is any."""
    replies = list(session.get(key, timeout=CONNECT_S))
    return next((reply.ok for reply in replies if reply.ok is not None), None)


class Robot(AbstractContextManager["Robot"]):
    """A connection to a robot, direct or through a router; it is ended once.

    settings: section [bus] of omnid's configuration, for TLS and passwords, which its file `config` holds.
    """

    def __init__(
        self, robot: str = "omnid", connect: str | Sequence[str] = (HERE,), settings: BusConfig | None = None
    ) -> None:
        """Connect; raise Unreachable where no endpoint answers within CONNECT_S, OmnidError for wrong settings."""
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
        given = settings or BusConfig(robot=robot, connect=endpoints)
        self.name = given.robot
        self._session = open_client(given)
        self._declared: list[object] = []  # zenoh undeclares what nothing refers to any longer
        # The robot's own time less this computer's monotonic clock, when its answer came; time of the query.
        self._offset_ns: int | None = None
        self._asked_s = -math.inf

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; a second call does nothing."""
        with suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type

    def subscribe(self, kind: type[T]) -> Subscription[T]:
        """Subscribe to messages of a kind: Pose, Diagnostics, Cloud, Map, NavigationReport or Scan."""
        topic = _TOPICS[kind]
        return Subscription(self._session, f"{self.name}/{topic}", PUBLISHED[topic].decode)

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

        return subscriber.undeclare

    def driver(self, source: Literal["operator", "planner"] = "operator") -> Driver:
        """Return a sender of commands to the wheels; the operator has priority over the planner."""
        self.now_ns(waits=True)
        return Driver(self, self._session, source)

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
    def alive(self) -> bool:
        """True if the robot's daemon runs and can be reached."""
        replies = self._session.liveliness().get(f"{self.name}/{ALIVE}", timeout=CONNECT_S)
        return any(reply.ok is not None for reply in replies)

    def now_ns(self, *, waits: bool = False) -> int:
        """Return the robot's own time, which senders attach in place of their clocks; 0: it is unknown.

        The robot is asked for it, at most once in CONNECT_S. waits: ask now, and wait for the answer.
        """

        def set_offset(reply: zenoh.Reply) -> None:
            with suppress(ValueError):
                if reply.ok is not None:
                    self._offset_ns = int(reply.ok.payload.to_bytes()) - time.monotonic_ns()

        if waits or time.monotonic() - self._asked_s > CONNECT_S:
            self._asked_s, key = time.monotonic(), f"{self.name}/{topics.TIME}"
            if waits:
                for reply in self._session.get(key, timeout=CONNECT_S):
                    set_offset(reply)
            else:
                self._session.get(key, set_offset, timeout=CONNECT_S)
        return 0 if self._offset_ns is None else time.monotonic_ns() + self._offset_ns


class Driver:
    """Sender of commands and requests. It attaches the robot's own time, so this computer's clock need not be right.

    A command is valid for controller.deadlines.command_s only: keep sending, or the wheels stop.

    The wheels turn only while the robot is armed: it is disarmed at its start, by each stop and by each fault. Two
    senders of one source do not drive at once: the first keeps it until it has been silent for a while.

    Drive from one waypoint to the next:

        import math
        from omnid.client import Pose, Robot

        with Robot("omnid") as robot:
            driver, poses = robot.driver(), robot.subscribe(Pose)
            print(driver.arm().text)
            for x_m, y_m in [(1.0, 0.0), (1.0, 1.0)]:
                for pose in poses:
                    dx_m, dy_m = x_m - pose.x_m, y_m - pose.y_m
                    if math.hypot(dx_m, dy_m) < 0.1 or pose.state == "lost":
                        break
                    driver.heading(0.3, math.atan2(dy_m, dx_m))
            driver.twist(0.0, 0.0)
    """

    def __init__(self, robot: Robot, session: zenoh.Session, source: Literal["operator", "planner"]) -> None:
        self._robot, self._session, cdr = robot, session, zenoh.Encoding.APPLICATION_CDR
        self._twist, self._heading = topics.TWIST, topics.HEADING
        if source == "planner":
            self._twist, self._heading = topics.PLANNER_TWIST, topics.PLANNER_HEADING
        self._publishers = {
            topic: session.declare_publisher(f"{robot.name}/{topic}", encoding=cdr, **_QUALITY)
            for topic in (self._twist, self._heading, topics.STOP, topics.ARM)
        }
        self._sent, self._gid = 0, ros2.gid_of(str(session.zid()))
        self.asked_ns = 0  # time of sending of the newest request, which the reports of a drive repeat

    def require_connected(self) -> None:
        """Return as soon as a robot subscribes to the commands. Raise OmnidError after CONNECT_S."""
        self._require(self._publishers[topics.STOP], "receives commands")

    def twist(self, velocity_mps: float, yaw_rate_radps: float) -> None:
        """Drive with this forward speed and yaw rate (counter-clockwise)."""
        self.send(self._twist, codec.twist_stamped_cdr(time.time_ns(), "base_link", velocity_mps, yaw_rate_radps))

    def heading(self, velocity_mps: float, heading_rad: float) -> None:
        """Drive with this speed and hold a heading in odom (counter-clockwise)."""
        vector = (velocity_mps, 0.0, heading_rad)
        self.send(self._heading, codec.encoded(codec.VECTOR_SCHEMA, (time.time_ns(), "odom"), vector))

    def stop(self) -> None:
        """Stop the wheels, whatever else was commanded, until `arm` is called."""
        self.send(topics.STOP, b"")

    def arm(self, timeout_s: float = ANSWER_S) -> Answer:
        """Ask the robot to arm; it refuses while a fault holds. Only commands that arrive after it move the wheels.

        Raise OmnidError as `ask`.
        """
        return self.ask(topics.ARM, codec.header_cdr, timeout_s)

    def goal(self, x_m: float, y_m: float, heading_rad: float | None = None, frame: str = "odom") -> Answer:
        """Ask the robot to drive to a pose in odom or map; None: with any heading. Raise OmnidError as `ask`."""
        return self.ask(topics.GOAL, lambda now_ns: codec.goal_cdr(now_ns, frame, (x_m, y_m), heading_rad))

    def navigate(self, verb: str) -> Answer:
        """Ask the robot to cancel, pause or resume its drive. Raise OmnidError as `ask`."""
        return self.ask(topics.NAVIGATION, lambda _: codec.string_cdr(verb))

    def route(self, text: str) -> Answer:
        """Ask for what a text of cmd/route says, such as "repeat hall". Raise OmnidError as `ask`."""
        return self.ask(topics.ROUTE, lambda _: codec.string_cdr(text))

    def save_map(self) -> Answer:
        """Ask the robot to save its map now. Raise OmnidError as `ask`."""
        return self.ask(topics.MAP, lambda _: codec.string_cdr(topics.SAVE_MAP))

    def ask(self, topic: str, payload_at: Callable[[int], bytes], timeout_s: float = ANSWER_S) -> Answer:
        """Send the request that a message on a topic such as cmd/goal is, and wait for the robot's answer.

        payload_at: returns the CDR bytes for a time of sending [ns of Unix time]. Raise OmnidError where no robot takes
        such requests within CONNECT_S, or none answers.
        """
        key = f"{self._robot.name}/{topics.request_key(topic)}"
        with self._session.declare_querier(key, timeout=timeout_s, **_QUALITY) as querier:
            self._require(querier, "takes such requests")
            self._robot.now_ns(waits=True)
            self.asked_ns = now_ns = time.time_ns()
            for reply in querier.get(payload=payload_at(now_ns), attachment=self._attached(now_ns)):
                if reply.ok is not None and (answer := topics.answer_of(reply.ok.payload.to_bytes())) is not None:
                    return answer
        raise OmnidError(
            f"{self._robot.name} has not answered: either this program must not command it (access_control in "
            "zenoh's file of the robot or router), or it gives no poses; see `omnid listen`"
        )

    def send(self, topic: str, payload: bytes) -> None:
        """Send CDR bytes on a topic of the wheels; the identity of this program distinguishes senders."""
        publisher, attachment = self._publishers[topic], self._attached(time.time_ns())
        publisher.put(payload, source_info=zenoh.SourceInfo(publisher.id, self._sent), attachment=attachment)

    def _attached(self, sent_ns: int) -> bytes:
        """Return the attachment with the time of sending: by this computer's clock, and by the robot's own."""
        self._sent += 1
        return ros2.attachment(self._sent, sent_ns, self._gid, self._robot.now_ns())

    def _require(self, declared: zenoh.Publisher | zenoh.Querier, does: str) -> None:
        """Wait for a robot that takes what is sent. Raise OmnidError after CONNECT_S."""
        deadline_s = time.monotonic() + CONNECT_S
        while not has_receiver(declared):
            if time.monotonic() > deadline_s:
                raise OmnidError(
                    f"no robot {self._robot.name!r} {does} there: check --robot and --connect, and that its daemon "
                    "runs, with a motor where it is to drive"
                )
            time.sleep(PERIOD_S)
