"""Small logs for the tests, written with mcap and rosbags, not with the code under test."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

STORE: Any = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
LOWER, UPPER = "/lower/image_raw/compressed", "/upper/image_raw/compressed"
START_NS = 1_700_000_000 * 10**9


class Entry(NamedTuple):
    topic: str
    type: str
    data: bytes
    log_time_ns: int


def header(stamp_ns: int, frame_id: str = "camera") -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def jpeg(value: int, size: int = 16) -> bytes:
    return cv2.imencode(".jpg", np.full((size, size), value % 256, np.uint8))[1].tobytes()


def compressed(stamp_ns: int, data: bytes, format_: str = "jpeg", little_endian: bool = True) -> bytes:
    message = TYPES[COMPRESSED](header(stamp_ns), format_, np.frombuffer(data, np.uint8))
    return bytes(STORE.serialize_cdr(message, COMPRESSED, little_endian=little_endian))


def image_message(
    stamp_ns: int, encoding: str, pixels: NDArray[Any], bigendian: int = 0, little_endian: bool = True
) -> bytes:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    message = TYPES[IMAGE](
        header(stamp_ns), pixels.shape[0], pixels.shape[1], encoding, bigendian, rows.shape[1], rows.ravel()
    )
    return bytes(STORE.serialize_cdr(message, IMAGE, little_endian=little_endian))


def text(words: str) -> bytes:
    return bytes(STORE.serialize_cdr(TYPES["std_msgs/msg/String"](words), "std_msgs/msg/String"))


def image(topic: str, stamp_ns: int, value: int = 0) -> Entry:
    return Entry(topic, COMPRESSED, compressed(stamp_ns, jpeg(value)), stamp_ns)


def pairs(count: int, lower: str = LOWER, upper: str = UPPER) -> list[Entry]:
    """The images of count pairs, 0.1 s apart, the upper camera 1 ms later."""
    stamps = [START_NS + index * 10**8 for index in range(count)]
    return [image(t, s + d, s // 10**8) for s in stamps for t, d in ((lower, 0), (upper, 10**6))]


def write_log(
    path: Path,
    entries: Iterable[Entry],
    attachments: Sequence[tuple[str, bytes]] = (),
    schema_names: dict[str, str] | None = None,
    **options: Any,
) -> Path:
    """The path, written with the options of mcap's Writer; schema_names renames the types in the file."""
    settings: dict[str, Any] = {"chunk_size": 4096, "compression": CompressionType.NONE} | options
    with path.open("wb") as file:
        writer = Writer(file, **settings)
        writer.start("ros2", "test")
        for name, data in attachments:
            writer.add_attachment(0, 0, name, "", data)
        ids: dict[str, int] = {}
        for topic, kind, data, log_time_ns in entries:
            if topic not in ids:
                name = (schema_names or {}).get(kind, kind)
                definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
                ids[topic] = writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", definition))
            writer.add_message(ids[topic], log_time_ns, data, log_time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


BARE: dict[str, Any] = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
