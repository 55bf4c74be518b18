"""Small bags of ROS 2 (SQLite) and ROS 1 for the tests, written by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from tests.drivers.logs.mcap_logs import STORE, Entry

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


def ros1_bytes(entry: Entry) -> bytes:
    message, types = STORE.deserialize_cdr(entry.data, entry.type), ROS1.types
    stamp = types["builtin_interfaces/msg/Time"](message.header.stamp.sec, message.header.stamp.nanosec)
    header = types["std_msgs/msg/Header"](3, stamp, message.header.frame_id)
    return bytes(ROS1.serialize_ros1(types[entry.type](header, message.format, message.data), entry.type))


def write_bag(path: Path, entries: Sequence[Entry], compression: str = "") -> Path:
    writer = Ros1Writer(path)
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
