"""Bags of ROS 1: the frames of the same MCAP file, compressed, not closed, cut."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer

from drivers.frame import gray
from drivers.logs.log_formats import log_info
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_info import LogState
from tests.drivers.logs.bags import ROS1, write_bag
from tests.drivers.logs.foreign_logs import PAIRS, expected, read
from tests.drivers.logs.mcap_logs import START_NS, pairs


@pytest.mark.parametrize("compression", ["", "BZ2", "LZ4"])
def test_a_ros1_bag_has_the_frames_of_the_same_mcap(tmp_path: Path, compression: str) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS), compression)
    found, reader = read(path)
    assert found == expected(tmp_path) and not reader.warnings
    with closing(LogReader(path)) as again:
        assert again.pair_estimate() == PAIRS


def test_raw_images_of_ros1(tmp_path: Path) -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    types = ROS1.types
    stamp = types["builtin_interfaces/msg/Time"](sec=START_NS // 10**9, nanosec=5)
    message = types["sensor_msgs/msg/Image"](
        types["std_msgs/msg/Header"](seq=7, stamp=stamp, frame_id="abc"), 3, 4, "mono8", 0, 4, pixels.ravel()
    )
    data = bytes(ROS1.serialize_ros1(message, "sensor_msgs/msg/Image"))
    with Ros1Writer(tmp_path / "log.bag") as writer:
        for topic in ("/lower/image_raw", "/upper/image_raw"):
            writer.write(writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=ROS1), START_NS, data)
    with closing(LogReader(tmp_path / "log.bag")) as reader:
        frames = list(reader.frames())
    assert [frame.stamp_ns for frame in frames] == [START_NS + 5] * 2
    assert all((gray(frame) == pixels).all() for frame in frames)


def test_tells_that_a_bag_is_cut(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS))
    path.write_bytes(path.read_bytes()[:-3000])
    assert log_info(path).state is LogState.BROKEN


def test_a_bag_that_was_not_closed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS))
    whole = path.read_bytes()
    index = int.from_bytes(whole[whole.index(b"index_pos=") + 10 :][:8], "little")
    path.write_bytes(whole[:index].replace(b"index_pos=" + index.to_bytes(8, "little"), b"index_pos=" + bytes(8)))
    found, reader = read(path)
    assert found == expected(tmp_path) and reader.truncated and "was not closed" in reader.warnings[0]


def test_a_bomb_is_skipped(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(1), "BZ2")
    data = path.read_bytes()
    at = data.index(b"size=") + 5
    path.write_bytes(data[:at] + (2**32 - 1).to_bytes(4, "little") + data[at + 4 :])
    found, reader = read(path)
    assert found == [] and reader.counts["broken_records"] == 1
