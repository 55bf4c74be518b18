"""The reader of recorded runs: messages of one robot, decoded one by one in the order of the file.

Any MCAP log with a topic of nav_msgs/msg/Odometry can be read. The robot's other topics have the same name up to the
last slash, and the last part under which omnid publishes them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from functools import partial
from typing import Final, NamedTuple, TypeAlias

from drivers.errors import FrameDecodeError
from drivers.logs.mcap_catalog import Catalog, LogTopic
from drivers.logs.mcap_index import read_attachments, read_summary
from drivers.logs.mcap_info import LogInfo
from drivers.logs.mcap_messages import DataSection, LogMessage
from drivers.logs.mcap_records import LogFile, RecordError
from drivers.logs.ros_image import IMAGE_TYPES, RosImage, parse_image
from omnid.errors import OmnidError
from omnid.transport.codec import (
    DIAGNOSTICS_SCHEMA,
    MAP_POSE_SCHEMA,
    ODOMETRY_SCHEMA,
    POINT_CLOUD_SCHEMA,
    TWIST_SCHEMA,
    odometry_from_cdr,
    twist_from_cdr,
)
from omnid.transport.decode import Cloud, Diagnostics, PoseInMap, decode_cloud, decode_diagnostics, decode_map_pose
from omnid.transport.records import OdometryRecord, TwistRecord
from omnid.transport.scan_codec import SCAN_SCHEMA, Scan, decode_scan
from omnid.transport.topics import MAP_POSE, PANORAMA, SCAN

ODOMETRY: Final = "odom"
STATUS: Final = "status"
CLOUD: Final = "cloud"
DRIVE: Final = "drive"
TWIST_COMMAND: Final = "cmd/twist"
IMAGES: Final = (PANORAMA, "lower/image_raw/compressed", "lower/image_raw")  # in the order of preference
# A larger message is counted and not decoded, so that a damaged file cannot exhaust the memory.
MAX_MESSAGE_BYTES: Final = 64 * 2**20

Content: TypeAlias = OdometryRecord | PoseInMap | Diagnostics | Cloud | Scan | TwistRecord | RosImage
Decoder: TypeAlias = Callable[[memoryview], Content]


class RecordedMessage(NamedTuple):
    """A decoded message; name: last part of its topic, one of the constants above or of omnid.transport.topics."""

    name: str
    log_time_ns: int
    content: Content


class RecordingReader:
    """Reads the messages of one robot, the one with the given odometry topic (see choose_odometry_topic).

    unreadable: messages left out, by topic: larger than MAX_MESSAGE_BYTES, not of their type, or not finite.
    corrupt: chunks and records of the file left out. damaged: the same, and its missing end. All three are complete
    once all messages are read.
    """

    def __init__(self, found: LogInfo, odometry_topic: str) -> None:
        """Read the attachments. Raise DriverError where the file cannot be opened."""
        self.info, self.topic = found, odometry_topic
        self.unreadable: Counter[str] = Counter()
        self.corrupt = self.damaged = 0
        with closing(LogFile(found.path)) as file:
            self.attachments: Mapping[str, bytes] = read_attachments(file, read_summary(file))

    @property
    def robot(self) -> str:
        """Name of the robot: the odometry topic without its last part, or all of it where it has only one."""
        return self.topic.rpartition("/")[0].strip("/") or self.topic

    def topic_name(self, name: str) -> str:
        """Return the full name of a topic from its last part."""
        return self.topic if name == ODOMETRY else f"{self.topic.rpartition('/')[0]}/{name}"

    def image_name(self) -> str:
        """Return the name of the robot's preferred images, "" where there are none."""
        return next((name for name in IMAGES if self.topic_name(name) in self.info.topics), "")

    def messages(self, names: Iterable[str]) -> Iterator[RecordedMessage]:
        """Yield the messages of topics with these names."""
        wanted = {self.topic_name(name): name for name in names if name}
        with closing(LogFile(self.info.path)) as file:
            section = DataSection(file, Catalog())
            for message in section.messages():
                topic = section.catalog.topic(message.channel_id)
                name = None if topic is None else wanted.get(topic.name)
                decoder = None if topic is None or name is None else _decoder(name, topic)
                if topic is not None and name is not None and decoder is not None:
                    content = self._decoded(topic.name, message, decoder)
                    if content is not None:
                        yield RecordedMessage(name, message.log_time_ns, content)
            self.corrupt = section.broken
            self.damaged = section.broken + (not section.ended)

    def _decoded(self, topic: str, message: LogMessage, decoder: Decoder) -> Content | None:
        """Return the content of a message; None, and count it, where it cannot be decoded."""
        try:
            if message.record.size > MAX_MESSAGE_BYTES:
                raise OmnidError(f"a message of {message.record.size} bytes: expected at most {MAX_MESSAGE_BYTES}")
            return decoder(message.data())
        except (OmnidError, FrameDecodeError, RecordError):
            self.unreadable[topic] += 1
            return None


def _decoder(name: str, topic: LogTopic) -> Decoder | None:
    """Return the decoder of messages of a topic; None where they are of another type than expected."""
    if name in IMAGES and topic.type in IMAGE_TYPES:
        return partial(parse_image, topic.type, aligned=topic.aligned)
    expected, decoder = DECODERS.get(name, ("", None))
    return decoder if topic.type == expected else None


def _finite_twist(data: memoryview) -> TwistRecord:
    twist = twist_from_cdr(bytes(data))
    if not (math.isfinite(twist.velocity_mps) and math.isfinite(twist.yaw_rate_radps)):
        raise OmnidError(f"a command of {twist.velocity_mps} m/s and {twist.yaw_rate_radps} rad/s: expected numbers")
    return twist


DECODERS: Final[Mapping[str, tuple[str, Decoder]]] = {
    ODOMETRY: (ODOMETRY_SCHEMA, lambda data: odometry_from_cdr(bytes(data))),
    MAP_POSE: (MAP_POSE_SCHEMA, lambda data: decode_map_pose(bytes(data))),
    STATUS: (DIAGNOSTICS_SCHEMA, lambda data: decode_diagnostics(bytes(data))),
    CLOUD: (POINT_CLOUD_SCHEMA, lambda data: decode_cloud(bytes(data))),
    SCAN: (SCAN_SCHEMA, lambda data: decode_scan(bytes(data))),
    DRIVE: (TWIST_SCHEMA, _finite_twist),
    TWIST_COMMAND: (TWIST_SCHEMA, _finite_twist),
}
