"""Small logs in all formats for the tests, written with mcap and rosbags, not with the code under test."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray
from rosbags.convert.converter import migrate_bytes
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
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
    **options: Any,
) -> Path:
    """The path, written with the options of mcap's Writer."""
    settings: dict[str, Any] = {"chunk_size": 4096, "compression": CompressionType.NONE} | options
    with path.open("wb") as file:
        writer = Writer(file, **settings)
        writer.start("ros2", "test")
        for name, data in attachments:
            writer.add_attachment(0, 0, name, "", data)
        ids: dict[str, int] = {}
        for topic, kind, data, log_time_ns in entries:
            if topic not in ids:
                definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
                ids[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", definition))
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


# Small logs in all other formats for the tests: bags of ROS 2 (SQLite) and ROS 1, written by rosbags, and folders


ROS1: Any = get_typestore(Stores.ROS1_NOETIC)


def write_db3(folder: Path, entries: Sequence[Entry], zstd: bool = False) -> Path:
    writer = Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if zstd:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=STORE)
            for topic, kind in {entry.topic: entry.type for entry in entries}.items()
        }
        for entry in entries:
            writer.write(connections[entry.topic], entry.log_time_ns, entry.data)
    return next(folder.glob("*.db3"))


def write_killed_db3(folder: Path, entries: Sequence[Entry]) -> Path:
    """Write the file that a recorder leaves when it is killed: all messages are in its write-ahead log."""
    whole, killed = write_db3(folder, entries), folder / "killed"
    killed.mkdir()
    with closing(sqlite3.connect(whole)) as bag:
        rows = bag.execute("SELECT * FROM messages").fetchall()
        bag.execute("DELETE FROM messages")
        bag.commit()
        bag.execute("VACUUM")
        bag.execute("PRAGMA journal_mode = WAL")
        bag.execute("PRAGMA wal_autocheckpoint = 0")
        bag.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
        bag.commit()
        for suffix in ("", "-wal"):
            shutil.copy(f"{whole}{suffix}", f"{killed / whole.name}{suffix}")
    return killed / whole.name


def ros1_bytes(entry: Entry) -> bytes:
    migrated = migrate_bytes(STORE, ROS1, entry.type, entry.type, {}, entry.data, src_is2=True, dst_is2=False)
    return bytes(migrated)


def write_bag(path: Path, entries: Sequence[Entry], compression: str = "", chunk_bytes: int = 1 << 20) -> Path:
    writer = Ros1Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=ROS1)
            for topic, kind in {entry.topic: entry.type for entry in entries}.items()
        }
        for entry in entries:
            writer.write(connections[entry.topic], entry.log_time_ns, ros1_bytes(entry))
    return path


def write_zstd_mcap(path: Path, entries: Sequence[Entry]) -> Path:
    """Write an MCAP file as `ros2 bag record -s mcap --compression-mode message` does: each message is compressed."""
    compressed = [entry._replace(data=zstandard.compress(entry.data)) for entry in entries]
    return write_log(path, compressed, chunk_size=700)


def write_folders(top: Path, entries: Sequence[Entry], names: Callable[[int], str] = str, suffix: str = ".jpg") -> Path:
    """Write a folder of images for each camera; names: file names of log times."""
    for entry in entries:
        folder = top / ("lower" if entry.topic == LOWER else "upper")
        folder.mkdir(parents=True, exist_ok=True)
        data = STORE.deserialize_cdr(entry.data, entry.type).data
        if suffix != ".jpg":
            data = cv2.imencode(suffix, cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))[1]
        (folder / f"{names(entry.log_time_ns)}{suffix}").write_bytes(data.tobytes())
    return top
