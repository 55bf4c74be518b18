"""Frames of logs: encodings, topics, stamps; wheels and gyros in the bytes of ROS messages."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import Camera, Frame, gray
from drivers.logs.log_reader import WHOLE, LogCameras, LogReader, MotionTopics, TimeSource, choose_topics
from drivers.logs.ros_messages import IMAGE_TYPES, IMU, ODOMETRY, parse_image, parse_motion
from drivers.motion import GyroSample, MotionSample, WheelSample
from tests.drivers.logs.mcap_logs import (
    COMPRESSED,
    IMAGE,
    LOWER,
    START_NS,
    STORE,
    TYPES,
    UPPER,
    Entry,
    compressed,
    header,
    image,
    image_message,
    jpeg,
    pairs,
    text,
    write_bag,
    write_log,
)

REAL_LOGS = Path(__file__).parents[4] / "shared" / "data"


def read(path: Path, **options: Any) -> tuple[list[Frame], LogReader]:
    reader = LogReader(path, span_s=options.pop("span_s", WHOLE), cameras=LogCameras(**options))
    frames = list(reader.frames())
    reader.close()
    return frames, reader


def stamps_by_rosbags(path: Path, topic: str) -> list[int]:
    with AnyReader([path], default_typestore=STORE) as reader:
        found = [
            STORE.deserialize_cdr(m[2], m[0].msgtype).header.stamp for m in reader.messages() if m[0].topic == topic
        ]
    return sorted(stamp.sec * 10**9 + stamp.nanosec for stamp in found)


@pytest.mark.parametrize(("name", "count"), [("two_walls", 99), ("two_walls_crooked", 33)])
def test_a_real_log_gives_every_frame_in_order(name: str, count: int) -> None:
    path = REAL_LOGS / name / "log.mcap"
    if not path.exists():
        pytest.skip("the shared logs are not here")
    frames, reader = read(path)
    for camera in ("lower", "upper"):
        mine = [(f.seq, f.stamp_ns) for f in frames if f.camera == camera]
        assert mine == list(enumerate(stamps_by_rosbags(path, reader.topics[camera])))
        assert len(mine) == count
    assert [f.stamp_ns for f in frames] == sorted(f.stamp_ns for f in frames)
    assert {gray(frame).shape for frame in frames[::50]} == {(768, 768)}
    assert (reader.warnings, reader.pair_estimate()) == ([], count)


@pytest.mark.parametrize("little_endian", [True, False])
def test_raw_images_with_the_names_of_cv_bridge_are_decoded(tmp_path: Path, little_endian: bool) -> None:
    pixels = np.random.default_rng(2).integers(0, 256, (9, 14, 3), np.uint8)
    data = image_message(START_NS, "8UC3", pixels, little_endian=little_endian)
    frames, _ = read(write_log(tmp_path / "log.mcap", [Entry(t, IMAGE, data, 0) for t in ("/cam/top", "/cam/bottom")]))
    assert [frame.camera for frame in frames] == ["lower", "upper"]
    for frame in frames:
        np.testing.assert_array_equal(gray(frame), cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))


def deep_log(folder: Path, kind: str, images: list[NDArray[np.uint16]]) -> Path:
    """Write a log with images of the lower camera; kind: byte order of mono16, or png."""
    entries = []
    for index, pixels in enumerate(images):
        stamp_ns = START_NS + index * 10**8
        if kind == "png":
            data, kind_of_message = compressed(stamp_ns, cv2.imencode(".png", pixels)[1].tobytes(), "png"), COMPRESSED
        else:
            data, kind_of_message = image_message(stamp_ns, "mono16", pixels.astype(kind), int(kind == ">u2")), IMAGE
        entries += [Entry(topic, kind_of_message, data, stamp_ns) for topic in (LOWER, UPPER)]
    return write_log(folder / "log.mcap", entries)


@pytest.mark.parametrize("kind", ["<u2", ">u2", "png"])
@pytest.mark.parametrize("bits", [10, 16])
def test_the_upper_eight_of_the_stated_bits_are_shown(tmp_path: Path, kind: str, bits: int) -> None:
    whole = np.linspace(0, 2**bits - 1, 48 * 64).reshape(48, 64).astype(np.uint16)
    frames, reader = read(deep_log(tmp_path, kind, [whole, whole // 200]), bits=bits)
    expected = [(image >> (bits - 8)).tolist() for image in (whole, whole // 200)]
    assert [gray(frame).tolist() for frame in frames if frame.camera == "lower"] == expected and not reader.warnings


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("colours", [False, True])
def test_a_pattern_that_was_compressed_as_it_is_becomes_grey(tmp_path: Path, suffix: str, colours: bool) -> None:
    """As image_transport does; a driver that compresses colours says the same of its source."""
    pattern = np.zeros((16, 16), np.uint8)
    pattern[::2, ::2] = 200  # red
    image = (
        np.dstack([np.zeros_like(pattern), np.zeros_like(pattern), np.full_like(pattern, 200)]) if colours else pattern
    )
    coding = [cv2.IMWRITE_JPEG_QUALITY, 100] if suffix == ".jpg" else []
    data = compressed(START_NS, cv2.imencode(suffix, image, coding)[1].tobytes(), "bayer_rggb8; jpeg compressed ")
    frames, _ = read(write_log(tmp_path / "log.mcap", [Entry(t, COMPRESSED, data, 0) for t in (LOWER, UPPER)]))
    assert np.abs(gray(frames[0])[2:-2, 2:-2] - 0.299 * 200).max() < 4


def test_a_part_of_a_log_is_counted_from_its_start(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", pairs(10))
    frames, reader = read(log, span_s=(0.2, 0.5))
    assert frames[0].stamp_ns == START_NS + 2 * 10**8 and frames[-1].stamp_ns <= START_NS + 5 * 10**8
    assert reader.counts["lower"] + reader.counts["upper"] == len(frames) == 7
    assert not reader.warnings and reader.pair_estimate() is None
    with pytest.raises(DriverError, match=r"ends 0.9 s after its first image.*5 s found"):
        read(log, span_s=(5.0, 9.0))


# Topics

CHATTER = Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ("/lower/image_raw/compressed", "/upper/image_raw/compressed"),
        ("/camera_bottom/image", "/camera_top/image"),
        ("/lower/upsampled", "/upper/down_sampled"),
    ],
)
def test_cameras_are_identified_by_name(tmp_path: Path, lower: str, upper: str) -> None:
    reader = LogReader(write_log(tmp_path / "log.mcap", [CHATTER, *pairs(2, lower, upper)]))
    assert reader.topics == {"lower": lower, "upper": upper}
    assert [frame.camera for frame in reader.frames()] == ["lower", "upper"] * 2


def test_requested_topics_are_read(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2, "/a", "/b"))
    with pytest.raises(DriverError, match=r"found /a, /b; give --lower and --upper"):
        LogReader(path)
    reader = LogReader(path, LogCameras("/b", "/a"))
    assert reader.topics == {"lower": "/b", "upper": "/a"} and len(list(reader.frames())) == 4


@pytest.mark.parametrize("given", ["/cam{}/image_raw", "/cam{}/image_raw/compressed"])
@pytest.mark.parametrize("logged", ["/cam{}/image_raw", "/cam{}/image_raw/compressed"])
def test_an_image_is_one_topic_raw_and_compressed(tmp_path: Path, given: str, logged: str) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2, *map(logged.format, (0, 1))))
    reader = LogReader(path, LogCameras(given.format(0), given.format(1)))
    assert reader.topics == {"lower": logged.format(0), "upper": logged.format(1)} and len(list(reader.frames())) == 4


IMAGES = {"/a/lower/image_raw": IMAGE, "/a/upper/image_raw": IMAGE}


@pytest.mark.parametrize(
    ("topics", "wanted", "message"),
    [
        ({}, {}, "no image topics in log: found no messages; .*`omnid log info`"),
        ({"/lower/a": IMAGE, "/imu": "x/msg/Y"}, {}, "no topics named after the upper camera in log: found /lower/a;"),
        ({"/a": IMAGE, "/b": IMAGE}, {}, "found /a, /b; give --lower and --upper"),
        (IMAGES, {"lower": "/nowhere"}, "no topic '/nowhere' of images in log: found /a/lower/image_raw, /a/upper"),
        ({"/lower\n\x1b[2J": IMAGE}, {}, r"/lower\\n\\x1b"),
    ],
)
def test_ambiguity_is_an_error_that_lists_the_candidates(
    topics: dict[str, str], wanted: dict[Camera, str], message: str
) -> None:
    with pytest.raises(DriverError, match=message) as caught:
        choose_topics("log", topics, (wanted.get("lower"), wanted.get("upper")))
    assert str(caught.value).isprintable()


# Wheels and gyros

VECTOR, QUATERNION, ZEROS = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"], np.zeros(36)


def odometry(velocity_mps: float, yaw_rate_radps: float) -> bytes:
    pose = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](9.0, 9.0, 9.0), QUATERNION(9.0, 9.0, 9.0, 9.0)
    )
    twist = TYPES["geometry_msgs/msg/Twist"](VECTOR(velocity_mps, 9.0, 9.0), VECTOR(9.0, 9.0, yaw_rate_radps))
    parts = (
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, ZEROS),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, ZEROS),
    )
    return serialised(TYPES[ODOMETRY](header(5, "odom"), "base_link", *parts), ODOMETRY)


def imu(rates: tuple[float, float, float], frame: str = "imu", covariance: float = 0.0, stamp_ns: int = 5) -> bytes:
    nine = np.zeros(9)
    nine[0] = covariance
    rest = VECTOR(9.0, 9.0, 9.0), np.zeros(9)
    head = header(stamp_ns, frame)
    message = TYPES[IMU](head, QUATERNION(9.0, 9.0, 9.0, 9.0), np.zeros(9), VECTOR(*rates), nine, *rest)
    return serialised(message, IMU)


def serialised(message: Any, kind: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, kind))


def sample(kind: str, data: bytes) -> MotionSample:
    return parse_motion(kind, memoryview(data))


def test_a_bag_of_ros1_has_the_samples_of_its_imu(tmp_path: Path) -> None:
    rates = Entry("/imu", IMU, imu((0.1, 0.2, 0.3), stamp_ns=START_NS), START_NS)
    path = write_bag(tmp_path / "log.bag", [rates, *pairs(2)])
    with closing(LogReader(path, motion=MotionTopics(imu="/imu"))) as reader:
        samples = [message for message in reader.messages() if not isinstance(message, Frame)]
    assert samples == [GyroSample(START_NS, 0.1, 0.2, 0.3)]


def test_the_rates_are_those_of_the_base() -> None:
    assert sample(ODOMETRY, odometry(0.3, -0.2)) == WheelSample(5, 0.3, -0.2)
    assert sample(IMU, imu((0.1, 0.2, 0.3))) == GyroSample(5, 0.1, 0.2, 0.3)
    assert sample(IMU, imu((0.1, 0.2, 0.3), "base_link")) == GyroSample(5, 0.1, 0.2, 0.3, of_base=True)
    without_turn = sample(ODOMETRY, odometry(0.3, math.nan))
    assert isinstance(without_turn, WheelSample) and math.isnan(without_turn.yaw_rate_radps)


@pytest.mark.parametrize(
    ("kind", "data", "reason"),
    [
        (ODOMETRY, odometry(math.nan, 0.1), "not finite"),
        (IMU, imu((0, 0, math.nan)), "not finite"),
        (IMU, imu((0.0, 0.0, 0.0), covariance=-1.0), "covariance begins with -1"),
        (ODOMETRY, imu((0.0, 0.0, 0.0)), "truncated or invalid"),
    ],
)
def test_invalid_rates_are_refused(kind: str, data: bytes, reason: str) -> None:
    with pytest.raises(FrameDecodeError, match=reason):
        sample(kind, data)


MESSAGES = {
    COMPRESSED: image(LOWER, 10**18).data,
    IMAGE: image_message(10**18, "mono8", np.zeros((4, 5), np.uint8)),
    ODOMETRY: odometry(1.0, 1.0),
    IMU: imu((1.0, 1.0, 1.0)),
}


@pytest.mark.parametrize("kind", MESSAGES)
def test_damaged_messages_raise_only_decode_errors(kind: str) -> None:
    chance, whole = random.Random(3), MESSAGES[kind]

    def parse(data: bytes) -> object:
        return parse_image(kind, memoryview(data)) if kind in IMAGE_TYPES else sample(kind, data)

    parse(whole)
    for size in range(0, len(whole) // 2, 3):
        with pytest.raises(FrameDecodeError):
            parse(whole[:size])
    for _ in range(500):
        changed = bytearray(whole)
        changed[chance.randrange(len(whole))] = chance.randrange(256)
        try:
            parse(bytes(changed))
        except FrameDecodeError as error:
            assert "\n" not in str(error)


# Stamps of images that cannot be used, and clocks that are set: what is read, in order, and the line that says so


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


def stamped(path: Path, time: TimeSource = "auto") -> tuple[list[Frame], list[str]]:
    with closing(LogReader(path, LogCameras(time=time))) as reader:
        return list(reader.frames()), reader.warnings


def shown(frames: list[Frame]) -> list[tuple[str, bytes]]:
    return [(frame.camera, bytes(frame.data)) for frame in frames]


AS_TAKEN: Final = [
    ("lower" if topic == LOWER else "upper", jpeg(6 * number + (topic == UPPER)))
    for number in range(COUNT)
    for topic in (LOWER, UPPER)
]
# Stamps of headers -> part of the line that refuses them.
WRONG: Final[dict[str, tuple[Times, str]]] = {
    "microseconds for nanoseconds": (lambda topic, number, ns: ns // 1000, "headers are 100 us apart"),
    "one of the future": (lambda topic, number, ns: ns + 3600 * S * (number == HALF), "run back by 3599.9"),
    "a clock set back within a period": (back(0.13), "run back by 0.030 s at image 21"),
    "the clock of one camera set back": (
        lambda topic, number, ns: ns - S * (number >= HALF and topic == LOWER),
        "run back by 0.900 s at image 21",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_headers_that_cannot_be_used_are_refused_and_the_setting_is_named(tmp_path: Path, name: str) -> None:
    stamp, line = WRONG[name]
    path = write_log(tmp_path / "log.mcap", entries(stamp))
    with pytest.raises(DriverError, match=f"{line}.*log.time = "):
        stamped(path)
    frames, warnings = stamped(path, time="log")
    assert shown(frames) == AS_TAKEN and not warnings


@pytest.mark.parametrize(
    ("stamp", "line"),
    [
        (lambda topic, number, ns: ns * (topic == UPPER), "headers of 40 images are 0"),
        (lambda topic, number, ns: ns * (number != HALF), "headers of 2 images are 0"),
    ],
    ids=["of one camera", "of one image"],
)
def test_times_of_logging_are_used_where_headers_are_not_set(tmp_path: Path, stamp: Times, line: str) -> None:
    frames, warnings = stamped(write_log(tmp_path / "log.mcap", entries(stamp)))
    assert shown(frames) == AS_TAKEN and len(warnings) == 1 and re.search(line, warnings[0])
    steps = np.diff([frame.stamp_ns for frame in frames if frame.camera == "lower"])
    assert (np.abs(steps - STEP_NS) <= DELAY_NS).all()


@pytest.mark.parametrize("logged", [lambda topic, number, ns: 0, back(1)], ids=["none", "a clock set back"])
def test_right_headers_are_used_whatever_the_times_of_logging(tmp_path: Path, logged: Times) -> None:
    frames, warnings = stamped(write_log(tmp_path / "log.mcap", entries(right, logged)))
    assert shown(frames) == AS_TAKEN and not warnings
    assert [frame.stamp_ns for frame in frames if frame.camera == "lower"] == [taken(LOWER, n) for n in range(COUNT)]


@pytest.mark.parametrize(("source", "first_ns"), [("header", 5 * S), ("log", START_NS + DELAY_NS), ("auto", 5 * S)])
def test_the_setting_decides(tmp_path: Path, source: TimeSource, first_ns: int) -> None:
    """A clock that counts from the start of the computer is one as well."""
    path = write_log(tmp_path / "log.mcap", entries(lambda topic, number, ns: ns - START_NS + 5 * S))
    frames, warnings = stamped(path, time=source)
    assert frames[0].stamp_ns == first_ns and shown(frames) == AS_TAKEN and not warnings


def test_equal_images_with_equal_stamps_are_one(tmp_path: Path) -> None:
    """As where two recordings of one robot were merged."""
    written = [entry for entry in entries(right) for _ in range(2)]
    with closing(LogReader(write_log(tmp_path / "log.mcap", written))) as reader:
        assert shown(list(reader.frames())) == AS_TAKEN
        assert reader.counts["duplicate"] == 80
