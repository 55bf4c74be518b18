"""Images of an MCAP file without its index, and of one that was converted from ROS 1."""

from __future__ import annotations

import struct
from contextlib import closing
from pathlib import Path

from mcap.writer import Writer as McapWriter

from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from drivers.logs.topic_choice import MotionTopics
from drivers.motion import GyroSample
from tests.drivers.logs.bags import ros1_bytes
from tests.drivers.logs.foreign_logs import PAIRS, expected, read
from tests.drivers.logs.mcap_logs import START_NS, pairs


def test_an_mcap_that_was_converted_from_ros1(tmp_path: Path) -> None:
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros1", "test")
        schema = writer.register_schema("sensor_msgs/CompressedImage", "ros1msg", b"")
        imu = writer.register_channel("/imu", "ros1", writer.register_schema("sensor_msgs/Imu", "ros1msg", b""))
        channels: dict[str, int] = {}
        for entry in pairs(PAIRS):
            if entry.topic not in channels:
                channels[entry.topic] = writer.register_channel(entry.topic, "ros1", schema)
            writer.add_message(channels[entry.topic], entry.log_time_ns, ros1_bytes(entry), entry.log_time_ns)
        rates = struct.pack("<IIII37d", 1, 100, 0, 0, *[0.0] * 13, 0.1, 0.2, 0.3, *[0.0] * 21)
        writer.add_message(imu, START_NS, rates, START_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    assert read(tmp_path / "log.mcap")[0] == expected(tmp_path)
    with closing(LogReader(tmp_path / "log.mcap", motion=MotionTopics(imu="/imu"))) as reader:
        samples = [message for message in reader.messages() if not isinstance(message, Frame)]
    assert samples == [GyroSample(100 * 10**9, 0.1, 0.2, 0.3)]
