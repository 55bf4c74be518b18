"""Stamps of images that cannot be used, and clocks that are set: what is read, in order, and the line that says so."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from drivers.logs.topics import MotionTopics
from drivers.motion import GyroSample
from tests.drivers.logs.bags import write_bag, write_db3
from tests.drivers.logs.mcap_logs import (
    COMPRESSED,
    LOWER,
    START_NS,
    STORE,
    TYPES,
    UPPER,
    Entry,
    compressed,
    header,
    jpeg,
    write_log,
)

S, STEP_NS, COUNT, HALF = 10**9, 10**8, 40, 20
SKEW_NS: Final = {LOWER: 0, UPPER: 10**6}
DELAY_NS: Final = 5 * 10**6  # between the stamp and the time of logging
Times = Callable[[str, int, int], int]  # topic, number of the image, true time -> another time


def taken(topic: str, number: int) -> int:
    return START_NS + number * STEP_NS + SKEW_NS[topic]


def entries(stamp: Times, logged: Times = lambda topic, number, ns: ns + DELAY_NS) -> list[Entry]:
    """Return the images of 40 pairs, each of another content, in the order in which they were logged."""
    found = []
    for number in range(COUNT):
        for topic in (LOWER, UPPER):
            ns = taken(topic, number)
            data = compressed(stamp(topic, number, ns), jpeg(6 * number + (topic == UPPER)))
            found.append(Entry(topic, COMPRESSED, data, logged(topic, number, ns)))
    return found


def back(size_s: float, at: int = HALF) -> Times:
    """Return times by a clock that is set back by so much before an image."""
    return lambda topic, number, ns: ns - int(size_s * S) * (number >= at)


def right(topic: str, number: int, ns: int) -> int:
    return ns


def read(path: Path, **options: object) -> tuple[list[Frame], list[str]]:
    with closing(LogReader(path, **options)) as reader:  # type: ignore[arg-type]
        return list(reader.frames()), reader.warnings


def shown(frames: list[Frame]) -> list[tuple[str, bytes]]:
    return [(frame.camera, bytes(frame.data)) for frame in frames]


AS_TAKEN: Final = [
    ("lower" if topic == LOWER else "upper", jpeg(6 * number + (topic == UPPER)))
    for number in range(COUNT)
    for topic in (LOWER, UPPER)
]
# Stamps that cannot be used -> part of the line.
UNUSABLE: Final[dict[str, tuple[Times, str]]] = {
    "zero of one camera": (lambda topic, number, ns: ns * (topic == UPPER), "for 80 images: .* headers are 0"),
    "one zero": (lambda topic, number, ns: ns * (number != HALF), "for 2 images: .* are 0"),
    "whole seconds": (lambda topic, number, ns: ns // S * S, "do not advance"),
    "stopped on the way": (lambda topic, number, ns: min(ns, taken(topic, HALF)), "do not advance"),
    "microseconds for nanoseconds": (lambda topic, number, ns: ns // 1000, "headers are 100 us apart"),
    "backwards": (lambda topic, number, ns: 2 * START_NS - ns, "run back by 0.600 s at image 7"),
    "ahead, then back": (lambda topic, n, ns: ns if n < HALF else 2 * taken(topic, HALF) + S - ns, "run back"),
    "two clocks": (lambda topic, number, ns: ns - 7 * S * (topic == LOWER), "7.000 s apart between the cameras"),
    "one of the future": (lambda topic, number, ns: ns + 3600 * S * (number == HALF), "run back by 3599.9"),
    "one of the past": (lambda topic, number, ns: ns - 3600 * S * (number == HALF), "run back by 3599.9"),
    "a clock set back by hours": (back(3600), "run back by 3599.900 s at image 21"),
    "a clock set back within a period": (back(0.13), "run back by 0.030 s at image 21"),
    "a clock set back at the start": (back(0.25, 1), "run back"),
    "a clock set back at the end": (back(1, COUNT - 1), "run back by 0.900 s at image 40"),
    "the clock of one camera set back": (
        lambda topic, number, ns: ns - S * (number >= HALF and topic == LOWER),
        "run back by 0.900 s at image 21",
    ),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_where_headers_cannot_be_used_the_times_of_logging_are(tmp_path: Path, name: str) -> None:
    stamp, line = UNUSABLE[name]
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(stamp)))
    assert shown(frames) == AS_TAKEN and len(warnings) == 1
    assert re.search(line, warnings[0])
    steps = np.diff([frame.stamp_ns for frame in frames if frame.camera == "lower"])
    assert (np.abs(steps - STEP_NS) <= DELAY_NS).all()


@pytest.mark.parametrize("write", [write_log, write_bag, write_db3], ids=["mcap", "bag", "db3"])
@pytest.mark.parametrize("size_s", [1, 0.2, 0.13])
def test_a_clock_that_is_set_back_for_headers_and_logging_is_refused(
    tmp_path: Path, write: Callable[[Path, list[Entry]], Path], size_s: float
) -> None:
    """No time says which of two images was taken first."""
    path = {write_db3: tmp_path / "bag", write_bag: tmp_path / "log.bag"}.get(write, tmp_path / "log.mcap")
    log = write(path, entries(back(size_s), back(size_s)))
    back_s = size_s - 0.1
    line = rf"headers run back by {back_s:.3f} s at image 21, and the times of logging run back by {back_s:.3f} s"
    with pytest.raises(DriverError, match=line):
        read(log)
    assert len(read(log, time="header")[0]) > COUNT


def test_microseconds_in_headers_and_logging_are_refused(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns // 1000, lambda t, n, ns: ns // 1000))
    with pytest.raises(DriverError, match="headers are 100 us apart, and the times of logging are 100 us apart"):
        read(path)
    assert read(path, time="header")[0]


def test_images_without_stamps_are_told_as_a_pause(tmp_path: Path) -> None:
    """As where the clock was set forward."""
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(back(-3), back(-3))))
    assert shown(frames) == AS_TAKEN
    assert warnings == ["3.1 s without images after image 20: a pause, or a clock that was set"]


# Times of logging that say nothing against headers which are right.
LATE: Final = range(12, 17)
LOGGED: Final[dict[str, Times]] = {
    "delays of up to three periods": lambda topic, number, ns: (
        ns + int(np.random.default_rng(2 * number + (topic == UPPER)).uniform(0, 3 * STEP_NS))
    ),
    "images that arrive a second late": lambda topic, n, ns: taken(topic, 27) + n if n in LATE else ns,
    "a disk that is busy for two seconds": lambda _, n, ns: max(ns, taken(LOWER, 32) + n) if n > 11 else ns,
    "none": lambda topic, number, ns: 0,
    "those of a conversion": lambda topic, number, ns: 2 * START_NS + 2_000_000 * number + SKEW_NS[topic],
    "a clock set back": back(1),
}


@pytest.mark.parametrize("name", LOGGED)
def test_right_headers_are_used_whatever_the_times_of_logging(tmp_path: Path, name: str) -> None:
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(right, LOGGED[name])))
    assert shown(frames) == AS_TAKEN and not warnings
    assert [frame.stamp_ns for frame in frames if frame.camera == "lower"] == [taken(LOWER, n) for n in range(COUNT)]


def test_a_conversion_camera_by_camera_is_ordered_by_headers(tmp_path: Path) -> None:
    """Its times of logging are those of the conversion, or none."""
    for logged in (lambda n: 0, lambda n: START_NS + n * 5 * 10**6):
        written = sorted(entries(right), key=lambda entry: entry.topic)
        log = [entry._replace(log_time_ns=logged(n)) for n, entry in enumerate(written)]
        frames, warnings = read(write_log(tmp_path / "log.mcap", log))
        assert shown(frames) == AS_TAKEN and not warnings


def test_cameras_with_two_clocks_are_told_where_their_times_of_logging_are_no_better(tmp_path: Path) -> None:
    clock: Times = lambda topic, number, ns: ns - 3 * S * (topic == UPPER)  # noqa: E731
    _, warnings = read(write_log(tmp_path / "log.mcap", entries(clock, clock)))
    assert any("upper camera begin and end 3.0 s before those of the lower one" in line for line in warnings)
    _, warnings = read(write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns + 60 * SKEW_NS[topic])))
    assert len(warnings) == 1 and "the clocks of the cameras differ by 0.060 s, half a period or more" in warnings[0]


@pytest.mark.parametrize(("source", "first_ns"), [("header", 5 * S), ("log", START_NS + DELAY_NS), ("auto", 5 * S)])
def test_the_setting_decides(tmp_path: Path, source: str, first_ns: int) -> None:
    """A clock that counts from the start of the computer is one as well."""
    path = write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns - START_NS + 5 * S))
    frames, warnings = read(path, time=source)
    assert frames[0].stamp_ns == first_ns and shown(frames) == AS_TAKEN and not warnings


def test_nanoseconds_beyond_a_second_are_carried_over(tmp_path: Path) -> None:
    written = []
    for entry in entries(right):
        message = STORE.deserialize_cdr(entry.data, COMPRESSED)
        stamp = message.header.stamp
        moved = TYPES["builtin_interfaces/msg/Time"](sec=stamp.sec - 2, nanosec=stamp.nanosec + 2 * S)
        head = TYPES["std_msgs/msg/Header"](stamp=moved, frame_id="")
        data = bytes(STORE.serialize_cdr(TYPES[COMPRESSED](head, "jpeg", message.data), COMPRESSED))
        written.append(entry._replace(data=data))
    frames, warnings = read(write_log(tmp_path / "log.mcap", written))
    assert shown(frames) == AS_TAKEN and frames[0].stamp_ns == START_NS and not warnings


def test_equal_images_with_equal_stamps_are_one(tmp_path: Path) -> None:
    """As where two recordings of one robot were merged."""
    written = [entry for entry in entries(right) for _ in range(2)]
    with closing(LogReader(write_log(tmp_path / "log.mcap", written))) as reader:
        assert shown(list(reader.frames())) == AS_TAKEN
        assert reader.counts["duplicate"] == reader.counts["repeated"] == 80


def test_samples_of_a_gyro_follow_the_clock_of_the_images(tmp_path: Path) -> None:
    """The computer's clock is set back by a second, and with it the stamps of images and gyro."""
    imu, clock = "sensor_msgs/msg/Imu", back(1)
    written = entries(clock)
    vector, rotation, nine = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"], np.zeros(9)
    for number in range(COUNT):
        ns = taken(LOWER, number) + STEP_NS // 2
        head = header(clock(LOWER, number, ns))
        rates = vector(0.0, 0.0, float(number))
        message = TYPES[imu](head, rotation(0.0, 0.0, 0.0, 1.0), nine, rates, nine, vector(0.0, 0.0, 9.8), nine)
        written.append(Entry("/imu", imu, bytes(STORE.serialize_cdr(message, imu)), ns + DELAY_NS))
    path = write_log(tmp_path / "log.mcap", sorted(written, key=lambda entry: entry.log_time_ns))
    with closing(LogReader(path, motion=MotionTopics(imu="/imu"))) as reader:
        messages = list(reader.messages())
    rates = [message.z_radps for message in messages if isinstance(message, GyroSample)]
    stamps = [message.stamp_ns for message in messages]
    assert rates == list(range(COUNT - 1)) and stamps == sorted(stamps)
