"""Commands and requests to a robot: what omnid.client gives to the programs of others."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import zenoh

from omnid.errors import OmnidError
from omnid.transport import codec, ros2, topics
from omnid.transport.codec import goal_cdr, string_cdr
from omnid.transport.session import QUERY_S, has_receiver, robots_there

CONNECT_S: Final = 2.0  # A connection is complete within this time.
ANSWER_S: Final = 10.0  # more than a disk takes for a map or a route
POLL_S: Final = 0.002  # delay that waiting for something that cannot be waited for adds
# A stop must not be lost, and overtakes all else; requests go the same way.
_QUALITY: Final[dict[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
}


class RobotTime:
    """A robot's own time, which senders attach to what they send, so that no clock of theirs matters.

    The robot is asked for it, at most once in QUERY_S; in between it is followed by this computer's monotonic clock.
    """

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._session, self._key = session, f"{robot}/{topics.TIME}"
        self._told: tuple[int, int] | None = None  # the robot's time, and ours when it came
        self._asked_s = -math.inf

    def ask(self) -> None:
        """Ask the robot, and wait for its answer; a robot that is not there is not waited for."""
        self._asked_s = time.monotonic()
        for reply in self._session.get(self._key, timeout=QUERY_S):
            self._take(reply)

    def refresh(self) -> None:
        """Ask the robot where that is due, and do not wait."""
        if time.monotonic() - self._asked_s > QUERY_S:
            self._asked_s = time.monotonic()
            self._session.get(self._key, self._take, timeout=QUERY_S)

    @property
    def now_ns(self) -> int:
        """The robot's time, as late as its answer came; 0 where it is not known."""
        if self._told is None:
            return 0
        robot_ns, own_ns = self._told
        return robot_ns + time.monotonic_ns() - own_ns

    def _take(self, reply: zenoh.Reply) -> None:
        with suppress(ValueError):
            if reply.ok is not None:
                self._told = int(reply.ok.payload.to_bytes()), time.monotonic_ns()


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

    def __init__(self, session: zenoh.Session, robot: str, own_time: RobotTime, source: str = "") -> None:
        prefix = f"cmd/{source}" if source else "cmd"
        self._session, self._robot, self._time = session, robot, own_time
        self._twist, self._heading = f"{prefix}/{topics.TWIST}", f"{prefix}/{topics.HEADING}"
        self._publishers = {
            topic: _command_publisher(session, f"{robot}/{topic}")
            for topic in (self._twist, self._heading, topics.STOP, topics.ARM)
        }
        self._sent, self._gid = 0, ros2.gid_of(str(session.zid()))
        self.asked_ns = 0  # time of sending of the newest request, which the reports of a drive repeat

    @property
    def connected(self) -> bool:
        """True if a robot subscribes to the commands."""
        return has_receiver(self._publishers[topics.STOP])

    def require_connected(self) -> None:
        """Return as soon as a robot subscribes to the commands. Raise OmnidError after CONNECT_S."""
        if not _holds_in_time(lambda: self.connected):
            raise self._absent("receives commands")

    def twist(self, velocity_mps: float, yaw_rate_radps: float) -> None:
        """Drive with this forward speed and yaw rate (counter-clockwise)."""
        payload = codec.twist_stamped_cdr(time.time_ns(), "base_link", velocity_mps, yaw_rate_radps)
        self.send(self._twist, payload)

    def heading(self, velocity_mps: float, heading_rad: float) -> None:
        """Drive with this speed and hold a heading in odom (counter-clockwise)."""
        self.send(self._heading, codec.heading_cdr(time.time_ns(), velocity_mps, heading_rad))

    def stop(self) -> None:
        """Stop the wheels, whatever else was commanded, until `arm` is called."""
        self.send(topics.STOP, b"")

    def arm(self, timeout_s: float = ANSWER_S) -> topics.Answer:
        """Ask the robot to arm; it refuses while a fault holds. Only commands that arrive after it move the wheels.

        Raise OmnidError as `ask`.
        """
        return self.ask(topics.ARM, codec.header_cdr, timeout_s)

    def goal(self, x_m: float, y_m: float, heading_rad: float | None = None, frame: str = "odom") -> topics.Answer:
        """Ask the robot to drive to a pose in odom or map; None: with any heading. Raise OmnidError as `ask`."""
        return self.ask(topics.GOAL, lambda now_ns: goal_cdr(now_ns, frame, (x_m, y_m), heading_rad))

    def navigate(self, verb: str) -> topics.Answer:
        """Ask the robot to cancel, pause or resume its drive. Raise OmnidError as `ask`."""
        return self.ask(topics.NAVIGATION, lambda _: string_cdr(verb))

    def route(self, text: str) -> topics.Answer:
        """Ask for what a text of cmd/route says, such as "repeat hall". Raise OmnidError as `ask`."""
        return self.ask(topics.ROUTE, lambda _: string_cdr(text))

    def save_map(self) -> topics.Answer:
        """Ask the robot to save its map now. Raise OmnidError as `ask`."""
        return self.ask(topics.MAP, lambda _: string_cdr(topics.SAVE_MAP))

    def ask(self, topic: str, payload_at: Callable[[int], bytes], timeout_s: float = ANSWER_S) -> topics.Answer:
        """Send the request that a message on a topic such as cmd/goal is, and wait for the robot's answer.

        payload_at: returns the CDR bytes for a time of sending [ns of Unix time]. Raise OmnidError where no robot takes
        such requests within CONNECT_S, or none answers.
        """
        key = f"{self._robot}/{topics.request_key(topic)}"
        with self._session.declare_querier(key, timeout=timeout_s, **_QUALITY) as querier:
            if not _holds_in_time(lambda: has_receiver(querier)):
                raise self._absent("takes such requests")
            self._time.ask()
            self.asked_ns = now_ns = time.time_ns()
            for reply in querier.get(payload=payload_at(now_ns), attachment=self._attachment(now_ns)):
                if reply.ok is not None and (answer := topics.answer_of(reply.ok.payload.to_bytes())) is not None:
                    return answer
        raise OmnidError(
            f"{self._robot} has not answered: either this program must not command it (access_control in "
            "zenoh's file of the robot or router), or it gives no poses; see `omnid listen`"
        )

    def send(self, topic: str, payload: bytes) -> None:
        """Send CDR bytes on a topic such as cmd/goal, with the identity of this program, which distinguishes senders.

        The time of sending is attached: by this computer's clock, and by the robot's own.
        """
        if topic not in self._publishers:
            self._publishers[topic] = _command_publisher(self._session, f"{self._robot}/{topic}")
        self._time.refresh()
        publisher, attachment = self._publishers[topic], self._attachment(time.time_ns())
        publisher.put(payload, source_info=zenoh.SourceInfo(publisher.id, self._sent), attachment=attachment)

    def _absent(self, does: str) -> OmnidError:
        """Return the error that the robot does something no more, or never did."""
        return OmnidError(
            f"no robot {self._robot!r} {does} there ({robots_there(self._session)}): check --robot and --connect, and "
            "that its daemon runs, with a motor where it is to drive"
        )

    def _attachment(self, sent_ns: int) -> bytes:
        self._sent += 1
        return ros2.attachment(self._sent, sent_ns, self._gid, self._time.now_ns)


def _holds_in_time(condition: Callable[[], bool]) -> bool:
    """Wait for a condition; return True once it holds, False after CONNECT_S."""
    deadline_s = time.monotonic() + CONNECT_S
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(POLL_S)
    return True


def _command_publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """Declare a publisher of CDR."""
    return session.declare_publisher(key, encoding=zenoh.Encoding.APPLICATION_CDR, **_QUALITY)
