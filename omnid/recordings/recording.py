"""Recorded runs: which topic holds the poses, and the messages of one robot, decoded in the order of log time.

Any log with a topic of nav_msgs/msg/Odometry can be read. The robot's other topics have the same name up to the
last slash, and the last part under which omnid publishes them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from drivers.errors import FrameDecodeError
from drivers.frame import Frame
from drivers.logs.log import listed
from drivers.logs.log_reader import open_log
from drivers.logs.ros_messages import IMAGE_TYPES, parse_image
from omnid.errors import OmnidError
from omnid.transport.codec import (
    ODOMETRY_SCHEMA,
    TWIST_SCHEMA,
    Cloud,
    Diagnostics,
    Pose,
    PoseInMap,
    Scan,
    TwistRecord,
    twist_from_cdr,
)
from omnid.transport.topics import MAP_POSE, PANORAMA, PUBLISHED, SCAN

ODOMETRY: Final = "odom"
STATUS: Final = "status"
CLOUD: Final = "cloud"
DRIVE: Final = "drive"
TWIST_COMMAND: Final = "cmd/twist"
IMAGES: Final = (PANORAMA, "lower/image_raw/compressed", "lower/image_raw")  # in the order of preference

Content: TypeAlias = Pose | PoseInMap | Diagnostics | Cloud | Scan | TwistRecord | Frame


class RecordedMessage(NamedTuple):
    """A decoded message; name: last part of its topic, one of the constants above or of omnid.transport.topics."""

    name: str
    content: Content


class RecordingReader:
    """Reads the messages of one robot of a log: the one whose poses are on a topic of nav_msgs/msg/Odometry.

    log: closed by close(). topic: of the poses; robot: its name. unreadable: messages left out, by topic: not of their
    type, or not finite; complete once all messages are read.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        """topic: of the poses, such as /omnid/odom.

        Without, it is the only topic of its type, else the only `.../odom`. Raise DriverError without a log,
        OmnidError where there is no such topic, or several and none is named.
        """
        self.log, self.unreadable = open_log(path), Counter[str]()
        counts, topics = self.log.counts(), self.log.topics
        known = [name for name, schema in sorted(topics.items()) if schema == ODOMETRY_SCHEMA and counts[name]]
        found = [name for name in known if topic in (None, name)]
        if len(found) > 1:
            found = [name for name in found if name.endswith(f"/{ODOMETRY}")]
        if len(found) != 1:
            wrong = f"no {ODOMETRY_SCHEMA} on {topic!r}" if topic else f"{len(known)} topics of {ODOMETRY_SCHEMA}"
            remedy = "name one by --topic" if known else f"`omnid replay {path} --record out.mcap` makes a recording"
            raise OmnidError(f"{path}: {wrong}: found {listed(known or topics, 'none')}; {remedy}")
        (self.topic,) = found
        self._prefix = self.topic.rpartition("/")[0]
        self.robot = self._prefix.strip("/") or self.topic

    def close(self) -> None:
        """Close the log; may be called twice."""
        self.log.close()

    def no_pose(self) -> OmnidError:
        """Return the error for a log whose topic of the poses has none that can be read."""
        path = self.log.path
        return OmnidError(f"{path}: topic {self.topic!r} has no readable pose; `omnid log info {path}` checks the log")

    def image_name(self) -> str:
        """Return the name of the robot's preferred images, "" where there are none."""
        return next((name for name in IMAGES if f"{self._prefix}/{name}" in self.log.topics), "")

    def messages(self, names: Iterable[str]) -> Iterator[RecordedMessage]:
        """Yield the messages of topics with these names."""
        wanted = {self.topic if name == ODOMETRY else f"{self._prefix}/{name}": name for name in names if name}
        for message in self.log.messages(wanted.keys()):
            name = wanted[message.topic]
            kind, decode = DECODERS.get(name, ("", None))
            content: Content
            try:
                if name in IMAGES and message.kind in IMAGE_TYPES:
                    content = parse_image(message.kind, message.data)
                elif decode is not None and message.kind == kind:
                    content = decode(bytes(message.data))
                else:
                    continue
            except (OmnidError, FrameDecodeError):
                self.unreadable[message.topic] += 1
                continue
            yield RecordedMessage(name, content)


def _finite_twist(data: bytes) -> TwistRecord:
    twist = twist_from_cdr(data)
    if not (math.isfinite(twist.velocity_mps) and math.isfinite(twist.yaw_rate_radps)):
        raise OmnidError(f"a command of {twist.velocity_mps} m/s and {twist.yaw_rate_radps} rad/s: expected numbers")
    return twist


# Type and decoder of each topic.
DECODERS: Final[Mapping[str, tuple[str, Callable[[bytes], Content]]]] = {
    **{name: (PUBLISHED[name].schema, PUBLISHED[name].decode) for name in (ODOMETRY, MAP_POSE, STATUS, CLOUD, SCAN)},
    **dict.fromkeys((DRIVE, TWIST_COMMAND), (TWIST_SCHEMA, _finite_twist)),
}
