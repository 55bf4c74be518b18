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


def later(size_ns: int) -> Times:
    """Return times by a clock that is set by so much before the second half of the images."""
    return lambda topic, number, ns: ns + size_ns * (number >= HALF) + DELAY_NS


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
    "all zero": (lambda topic, number, ns: 0, "for 80 images: the stamps of their headers are 0"),
    "zero of one camera": (lambda topic, number, ns: ns * (topic == UPPER), "headers are 0"),
    "all equal": (lambda topic, number, ns: START_NS, "for 80 images: the stamps of their headers do not advance"),
    "two and two equal": (lambda topic, number, ns: ns - number % 2 * STEP_NS, "do not advance"),
    "whole seconds": (lambda topic, number, ns: ns // S * S, "do not advance"),
    "microseconds for nanoseconds": (lambda topic, number, ns: ns // 1000, "headers are 100 us apart"),
    "backwards": (lambda topic, number, ns: 2 * START_NS - ns, "for 80 images: the stamps of their headers run back"),
    "ahead, then back": (lambda topic, n, ns: ns if n < HALF else 2 * taken(topic, HALF) + S - ns, "for 40 .* or jump"),
    "every third zero": (lambda topic, number, ns: ns * (number % 3 > 0), "for 28 images: .* are 0"),
    "stopped on the way": (lambda topic, number, ns: min(ns, taken(topic, HALF)), "for 38 images"),
    "two clocks": (lambda topic, number, ns: ns - 7 * S * (topic == LOWER), "7.000 s apart between the cameras"),
    "one of the future": (lambda topic, number, ns: ns + 3600 * S * (number == HALF), "for 2 images: .* lie ahead"),
    "one of the past": (lambda topic, number, ns: ns - 3600 * S * (number == HALF), "for 2 images: .* long before"),
    "the first of the future": (lambda topic, number, ns: ns + 3600 * S * (number == 0), "for 2 images: .* lie ahead"),
    "the first of the past": (lambda topic, number, ns: ns - 3600 * S * (number == 0), "for 2 images: .* long before"),
    "one zero": (lambda topic, number, ns: ns * (number != HALF), "for 2 images: .* are 0"),
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
@pytest.mark.parametrize("size_s", [-3600, -1, -0.3, -0.2, -0.13, 1, 3600])
@pytest.mark.parametrize("both", [True, False], ids=["headers and logging", "headers"])
def test_a_clock_that_is_set_begins_a_segment(tmp_path: Path, write: object, size_s: float, both: bool) -> None:
    """No image after it is sorted among those before it, nor lost; time runs on."""
    clock = later(int(size_s * S))
    stamp: Times = lambda topic, number, ns: clock(topic, number, ns) - DELAY_NS  # noqa: E731
    written = entries(stamp, clock) if both else entries(stamp)
    path = tmp_path / "log.mcap" if write is not write_db3 else tmp_path / "bag"
    frames, warnings = read(write(path.with_suffix(".bag") if write is write_bag else path, written))  # type: ignore[operator]
    assert shown(frames) == AS_TAKEN
    steps = np.diff([frame.stamp_ns for frame in frames if frame.camera == "lower"])
    if both and size_s > 0:
        assert steps.max() == size_s * S + STEP_NS, "as where nothing was recorded"
        assert len(warnings) == 1 and f"{size_s}.1 s without images after image 20: " in warnings[0]
        return
    assert (np.abs(steps - STEP_NS) <= DELAY_NS).all()
    way = "back" if size_s < 0 else "forward"
    assert len(warnings) == 1 and f"was set {way} by {abs(size_s):.1f}"[:-2] in warnings[0]
    assert "1.900 s after the first one: the images after it are a new segment" in warnings[0]


@pytest.mark.parametrize("at", [1, 2, 3, 36, 37, 38, 39])
@pytest.mark.parametrize("size_s", [-3600, -1, -0.25, 3])
def test_no_image_beside_a_step_at_either_end_is_sorted_among_the_others(
    tmp_path: Path, at: int, size_s: float
) -> None:
    """Too few images tell a step from wrong stamps: they have the times of logging."""
    stamp: Times = lambda topic, number, ns: ns + int(size_s * S) * (number >= at)  # noqa: E731
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(stamp)))
    assert shown(frames) == AS_TAKEN and len(warnings) == 1
    steps = np.diff([frame.stamp_ns for frame in frames if frame.camera == "lower"])
    assert (np.abs(steps - STEP_NS) <= DELAY_NS).all()


def test_a_clock_that_is_set_between_two_parts_begins_a_segment(tmp_path: Path) -> None:
    clock = later(-S)
    written = entries(lambda topic, number, ns: clock(topic, number, ns) - DELAY_NS, clock)
    write_log(tmp_path / "bag_0.mcap", written[: 2 * HALF])
    write_log(tmp_path / "bag_1.mcap", written[2 * HALF :])
    frames, warnings = read(tmp_path)
    assert shown(frames) == AS_TAKEN and len(warnings) == 1 and "set back by 1.0" in warnings[0]


def test_logging_with_varying_delay_is_no_step_of_a_clock(tmp_path: Path) -> None:
    def logged(topic: str, number: int, ns: int) -> int:
        return ns + int(np.random.default_rng(2 * number + (topic == UPPER)).uniform(0, 3 * STEP_NS))

    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns, logged)))
    assert shown(frames) == AS_TAKEN and not warnings


def test_cameras_with_two_clocks_are_told_where_their_times_of_logging_are_no_better(tmp_path: Path) -> None:
    clock: Times = lambda topic, number, ns: ns - 3 * S * (topic == UPPER)  # noqa: E731
    _, warnings = read(write_log(tmp_path / "log.mcap", entries(clock, clock)))
    assert len(warnings) == 1 and "upper camera begin and end 3.0 s before those of the lower one" in warnings[0]
    _, warnings = read(write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns + 60 * SKEW_NS[topic])))
    assert len(warnings) == 1 and "the clocks of the cameras differ by 0.060 s, half a period or more" in warnings[0]


def test_microseconds_in_headers_and_logging_are_refused(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns // 1000, lambda t, n, ns: ns // 1000))
    with pytest.raises(DriverError, match="100 us apart by their headers, 100 us by the times of logging"):
        read(path)
    assert read(path, time="header")[0]


def test_the_clock_of_one_camera_is_set(tmp_path: Path) -> None:
    stamp: Times = lambda topic, number, ns: ns - S * (number >= HALF and topic == LOWER)  # noqa: E731
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(stamp)))
    assert shown(frames) == AS_TAKEN and "set back by 1.000 s" in warnings[0]


def test_a_clock_is_set_twice_and_one_camera_is_away_at_the_second_time(tmp_path: Path) -> None:
    first, second = later(-S), range(30, 39)
    clock: Times = lambda topic, number, ns: first(topic, number, ns) - S // 2 * (number >= 30)  # noqa: E731
    written = entries(lambda topic, number, ns: clock(topic, number, ns) - DELAY_NS, clock)
    away = {2 * number + 1 for number in second}
    path = write_log(
        tmp_path / "log.mcap", [entry for at, entry in enumerate(written) if at not in away], chunk_size=99
    )
    frames, warnings = read(path)
    assert sorted(shown(frames)) == sorted(image for at, image in enumerate(AS_TAKEN) if at not in away)
    assert len(warnings) == 1 and "more steps follow" in warnings[0]


@pytest.mark.parametrize("unset", [False, True])
def test_late_and_resent_images_are_no_step_of_the_clock(tmp_path: Path, unset: bool) -> None:
    """Five images of each camera arrive a second late, all at once; the next one may have no stamp."""
    late = range(12, 17)
    logged: Times = lambda topic, number, ns: taken(topic, 27) + number if number in late else ns  # noqa: E731
    stamp: Times = lambda topic, number, ns: 0 if unset and number == 28 else ns  # noqa: E731
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(stamp, logged)))
    assert shown(frames) == AS_TAKEN and len(warnings) == unset


def test_delays_of_the_recorder_are_no_step_of_the_clock(tmp_path: Path) -> None:
    """The disk was busy for two seconds, so that what was taken then is logged afterwards."""
    logged: Times = lambda topic, number, ns: max(ns, taken(LOWER, 32) + number) if number > 11 else ns  # noqa: E731
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns, logged)))
    assert shown(frames) == AS_TAKEN and not warnings
    assert [frame.stamp_ns for frame in frames if frame.camera == "lower"] == [taken(LOWER, n) for n in range(COUNT)]


def test_times_of_a_conversion_tell_nothing_about_the_stamps(tmp_path: Path) -> None:
    """Three seconds without images are no step of the clock, though they were converted in two milliseconds."""
    stamp: Times = lambda topic, number, ns: ns + 3 * S * (number >= HALF)  # noqa: E731
    logged: Times = lambda topic, number, ns: 2 * START_NS + 2_000_000 * number + SKEW_NS[topic]  # noqa: E731
    frames, warnings = read(write_log(tmp_path / "log.mcap", entries(stamp, logged)))
    assert shown(frames) == AS_TAKEN and len(warnings) == 1 and "3.1 s without images" in warnings[0]
    assert frames[-1].stamp_ns == taken(UPPER, COUNT - 1) + 3 * S


@pytest.mark.parametrize(("source", "first_ns"), [("header", 5 * S), ("log", START_NS + DELAY_NS), ("auto", 5 * S)])
def test_the_setting_decides(tmp_path: Path, source: str, first_ns: int) -> None:
    """A clock that counts from the start of the computer is one as well, which is said."""
    path = write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns - START_NS + 5 * S))
    frames, warnings = read(path, time=source)
    assert frames[0].stamp_ns == first_ns and shown(frames) == AS_TAKEN
    assert len(warnings) == (source != "log") and all("begin in 1970" in line for line in warnings)


def test_nanoseconds_beyond_a_second_are_carried_over(tmp_path: Path) -> None:
    written = []
    for entry in entries(lambda topic, number, ns: ns):
        message = STORE.deserialize_cdr(entry.data, COMPRESSED)
        stamp = message.header.stamp
        moved = TYPES["builtin_interfaces/msg/Time"](sec=stamp.sec - 2, nanosec=stamp.nanosec + 2 * S)
        head = TYPES["std_msgs/msg/Header"](stamp=moved, frame_id="")
        data = bytes(STORE.serialize_cdr(TYPES[COMPRESSED](head, "jpeg", message.data), COMPRESSED))
        written.append(entry._replace(data=data))
    frames, warnings = read(write_log(tmp_path / "log.mcap", written))
    assert shown(frames) == AS_TAKEN and frames[0].stamp_ns == START_NS
    assert warnings == ["80 stamps have 10^9 nanoseconds or more, which were added to their seconds"]


def test_equal_images_with_equal_stamps_are_one(tmp_path: Path) -> None:
    """As where two recordings of one robot were merged."""
    written = [entry for entry in entries(lambda topic, number, ns: ns) for _ in range(2)]
    with closing(LogReader(write_log(tmp_path / "log.mcap", written))) as reader:
        assert shown(list(reader.frames())) == AS_TAKEN
        assert reader.counts["duplicate"] == reader.counts["repeated"] == 80


def test_samples_of_a_gyro_follow_the_clock_of_the_images(tmp_path: Path) -> None:
    """The computer's clock is set back by a second, and with it the stamps of images and gyro."""
    imu = "sensor_msgs/msg/Imu"
    clock = later(-S)
    written = entries(lambda topic, number, ns: clock(topic, number, ns) - DELAY_NS)
    vector, rotation, nine = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"], np.zeros(9)
    for number in range(COUNT):
        ns = taken(LOWER, number) + STEP_NS // 2
        head = header(clock(LOWER, number, ns) - DELAY_NS)
        rates = vector(0.0, 0.0, float(number))
        message = TYPES[imu](head, rotation(0.0, 0.0, 0.0, 1.0), nine, rates, nine, vector(0.0, 0.0, 9.8), nine)
        written.append(Entry("/imu", imu, bytes(STORE.serialize_cdr(message, imu)), ns + DELAY_NS))
    path = write_log(tmp_path / "log.mcap", sorted(written, key=lambda entry: entry.log_time_ns))
    with closing(LogReader(path, motion=MotionTopics(imu="/imu"))) as reader:
        messages = list(reader.messages())
    rates = [message.z_radps for message in messages if isinstance(message, GyroSample)]
    stamps = [message.stamp_ns for message in messages]
    assert rates == list(range(COUNT - 1)) and np.allclose(stamps, sorted(stamps), atol=DELAY_NS, rtol=0)
