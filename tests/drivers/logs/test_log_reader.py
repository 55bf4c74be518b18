from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from drivers.errors import DriverError
from drivers.frame import Camera, Frame, gray
from drivers.logs.log_reader import LogReader
from drivers.logs.ros_messages import JointWheels
from drivers.logs.topics import MotionTopics, choose_motion_topics, choose_topics
from tests.drivers.logs.mcap_logs import (
    BARE,
    COMPRESSED,
    IMAGE,
    LOWER,
    START_NS,
    STORE,
    UPPER,
    Entry,
    compressed,
    image_message,
    jpeg,
    pairs,
    text,
    write_log,
)

REAL_LOGS = Path(__file__).parents[4] / "shared" / "data"


def read(path: Path, **options: Any) -> tuple[list[Frame], LogReader]:
    reader = LogReader(path, **options)
    frames = list(reader.frames())
    reader.close()
    return frames, reader


def places(frames: list[Frame]) -> list[tuple[str, int, int]]:
    return [(frame.camera, frame.seq, frame.stamp_ns) for frame in frames]


def in_order(count: int) -> list[tuple[str, int, int]]:
    stamps = [START_NS + index * 10**8 for index in range(count)]
    return [place for n, s in enumerate(stamps) for place in (("lower", n, s), ("upper", n, s + 10**6))]


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
    assert (reader.truncated, reader.warnings, reader.pair_estimate()) == (False, [], count)


@pytest.mark.parametrize("little_endian", [True, False])
def test_raw_images_by_the_names_of_cv_bridge(tmp_path: Path, little_endian: bool) -> None:
    pixels = np.random.default_rng(2).integers(0, 256, (9, 14, 3), np.uint8)
    data = image_message(START_NS, "8UC3", pixels, little_endian=little_endian)
    frames, _ = read(write_log(tmp_path / "log.mcap", [Entry(t, IMAGE, data, 0) for t in ("/cam/top", "/cam/bottom")]))
    assert [frame.camera for frame in frames] == ["lower", "upper"]
    for frame in frames:
        np.testing.assert_array_equal(gray(frame), cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_colours_that_are_taken_for_brightness_are_a_question(tmp_path: Path, encoding: str) -> None:
    """Of yuv422 the luma is the second of two bytes, of yuv422_yuy2 the first."""
    luma = np.random.default_rng(2).integers(0, 256, (9, 14), np.uint8)
    pixels = np.dstack([np.full_like(luma, 120), luma])
    data = image_message(START_NS, encoding, pixels)
    log = write_log(tmp_path / "log.mcap", [Entry(topic, IMAGE, data, START_NS) for topic in (LOWER, UPPER)])
    frames, reader = read(log)
    if encoding == "yuv422":
        assert (gray(frames[0]) == luma).all() and not reader.warnings
    else:
        assert len(reader.warnings) == 2 and "is its encoding right? yuv422 is UYVY" in reader.warnings[0]


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
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_the_upper_eight_of_the_stated_bits_are_shown(tmp_path: Path, kind: str, bits: int) -> None:
    whole = np.linspace(0, 2**bits - 1, 48 * 64).reshape(48, 64).astype(np.uint16)
    frames, reader = read(deep_log(tmp_path, kind, [whole, whole // 200]), bits=bits)
    expected = [(image >> (bits - 8)).tolist() for image in (whole, whole // 200)]
    assert [gray(frame).tolist() for frame in frames if frame.camera == "lower"] == expected and not reader.warnings


def test_samples_above_the_stated_bits_are_white_and_black_images_are_a_question(tmp_path: Path) -> None:
    images = [np.full((4, 4), value, np.uint16) for value in (1000, 4000)]
    path = deep_log(tmp_path, "<u2", images)
    frames, _ = read(path, bits=10)
    assert [int(gray(frame)[0, 0]) for frame in frames if frame.camera == "upper"] == [250, 255]
    _, reader = read(path)
    assert len(reader.warnings) == 2 and "none above 4095: of a camera of 10 or 12 bits" in reader.warnings[0]
    assert "--set cameras.bits=12, in `omnid calibrate rig` and `drive` --bits 12" in reader.warnings[0]


@pytest.mark.parametrize(
    ("suffix", "format_", "encoding"),
    [
        (".jpg", "bgr8; jpeg compressed bgr8", "jpeg"),
        (".png", "mono8; png compressed ", "png"),
        (".png", "jpeg", "png"),
        (".jpg", "", "jpeg"),
    ],
)
def test_first_bytes_decide_the_compression(tmp_path: Path, suffix: str, format_: str, encoding: str) -> None:
    data = compressed(START_NS, cv2.imencode(suffix, np.full((8, 8), 90, np.uint8))[1].tobytes(), format_)
    frames, _ = read(write_log(tmp_path / "log.mcap", [Entry(t, COMPRESSED, data, 0) for t in (LOWER, UPPER)]))
    assert [frame.encoding for frame in frames] == [encoding] * 2
    assert abs(int(gray(frames[0])[4, 4]) - 90) < 2


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
    assert [(camera, seq) for camera, seq, _ in places(frames)] == [
        (camera, seq) for seq in range(4) for camera in ("lower", "upper")
    ][: len(frames)]
    assert frames[0].stamp_ns == START_NS + 2 * 10**8 and frames[-1].stamp_ns <= START_NS + 5 * 10**8
    assert reader.counts["lower"] + reader.counts["upper"] == len(frames) == 7
    assert not reader.truncated and not reader.warnings and reader.pair_estimate() is None
    with pytest.raises(DriverError, match=r"ends 0.9 s after its first image.*5 s found"):
        read(log, span_s=(5.0, 9.0))


@pytest.mark.parametrize("seed", range(5))
def test_sorts_frames_within_the_window(tmp_path: Path, seed: int) -> None:
    """The times of logging differ from those of the headers."""
    chance, entries = random.Random(seed), pairs(60)
    moved = sorted(range(len(entries)), key=lambda index: index + chance.uniform(0, 16))
    assert moved != sorted(moved)
    logged = [entries[index]._replace(log_time_ns=START_NS + number) for number, index in enumerate(moved)]
    frames, reader = read(write_log(tmp_path / "log.mcap", logged))
    assert places(frames) == in_order(60)
    assert not reader.warnings


@pytest.mark.parametrize("logged", ["never", "fast", "in parts"])
@pytest.mark.parametrize("step_s", [0, -3])
def test_a_log_whose_times_were_made_camera_by_camera_is_ordered_by_headers(
    tmp_path: Path, logged: str, step_s: int
) -> None:
    """As a conversion writes it: with no log times, or those of the conversion. The cameras' clock may be set."""
    entries = pairs(60)
    moved = [
        entry._replace(data=compressed(entry.log_time_ns + step_s * 10**9 * (n >= 60), jpeg(n)))
        for n, entry in enumerate(entries)
    ]
    parts = [moved[:80], moved[80:]] if logged == "in parts" else [moved]
    written = [entry for part in parts for entry in sorted(part, key=lambda entry: entry.topic)]
    times = [0 if logged == "never" else START_NS + n * 5 * 10**6 for n in range(120)]
    log = [entry._replace(log_time_ns=ns) for entry, ns in zip(written, times, strict=True)]
    frames, reader = read(write_log(tmp_path / "log.mcap", log))
    assert [bytes(frame.data) for frame in frames] == [jpeg(n) for n in range(120)]
    assert len(reader.warnings) == (step_s != 0) and all("set back by 3.0" in line for line in reader.warnings)


def test_frames_that_were_logged_long_after_are_in_order(tmp_path: Path) -> None:
    entries = pairs(60)  # the images of the first pair were logged 6 s after they were taken
    late = [entry._replace(log_time_ns=START_NS + 6 * 10**9) for entry in entries[:2]]
    frames, reader = read(write_log(tmp_path / "log.mcap", entries[2:] + late))
    assert places(frames) == in_order(60) and not reader.warnings


def test_replaces_an_unset_stamp_by_the_log_time(tmp_path: Path) -> None:
    entries = [Entry(e.topic, e.type, compressed(0, jpeg(1)), e.log_time_ns) for e in pairs(3)]
    frames, reader = read(write_log(tmp_path / "log.mcap", entries))
    assert places(frames) == in_order(3)
    assert reader.counts["unstamped"] == 6 and len(reader.warnings) == 1


# Topics

CHATTER = Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ("/lower/image_raw/compressed", "/upper/image_raw/compressed"),
        ("/camera_bottom/image", "/camera_top/image"),
        ("/cam/down/image", "/cam/up/image"),
        ("/lower/upsampled", "/upper/down_sampled"),
        ("/LOWER", "/Upper"),
    ],
)
def test_identifies_cameras_by_name(tmp_path: Path, lower: str, upper: str) -> None:
    reader = LogReader(write_log(tmp_path / "log.mcap", [CHATTER, *pairs(2, lower, upper)]))
    assert reader.topics == {"lower": lower, "upper": upper}
    assert [frame.camera for frame in reader.frames()] == ["lower", "upper"] * 2


@pytest.mark.parametrize("layout", [{}, BARE, BARE | {"use_chunking": False}])
def test_requested_topics_with_and_without_a_summary(tmp_path: Path, layout: dict[str, Any]) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2, "/a", "/b"), **layout)
    with pytest.raises(DriverError, match=r"found /a, /b; give --lower and --upper"):
        LogReader(path)
    reader = LogReader(path, lower="/b", upper="/a")
    assert reader.topics == {"lower": "/b", "upper": "/a"} and len(list(reader.frames())) == 4


@pytest.mark.parametrize("given", ["/cam{}/image_raw", "/cam{}/image_raw/compressed"])
@pytest.mark.parametrize("logged", ["/cam{}/image_raw", "/cam{}/image_raw/compressed"])
def test_an_image_is_one_topic_raw_and_compressed(tmp_path: Path, given: str, logged: str) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2, *map(logged.format, (0, 1))))
    reader = LogReader(path, *map(given.format, (0, 1)))
    assert reader.topics == {"lower": logged.format(0), "upper": logged.format(1)} and len(list(reader.frames())) == 4


IMAGES = {"/a/lower/image_raw": IMAGE, "/a/upper/image_raw": IMAGE}


@pytest.mark.parametrize(
    ("topics", "wanted", "message"),
    [
        ({}, {}, "no messages can be read in log: `omnid log info`"),
        ({"/imu": "sensor_msgs/msg/Imu", "/tf": ""}, {}, "no image topics in log: found /imu, /tf"),
        (
            {"/lower/a": IMAGE, "/imu": "x/msg/Y"},
            {},
            "no upper camera in log: found only /lower/a; give --upper",
        ),
        ({"/cam/image": IMAGE}, {}, "no lower camera in log: found only /cam/image"),
        ({"/cam": IMAGE}, {"lower": "/cam", "upper": "/cam"}, "topic '/cam' of log is named for both cameras"),
        (
            {"/a": IMAGE, "/b": IMAGE},
            {},
            "cameras in log apart: found /a, /b; give --lower and --upper",
        ),
        (IMAGES, {"lower": "/nowhere"}, "no topic '/nowhere' in log: found /a/lower/image_raw, /a/upper"),
        (IMAGES | {"/imu": "sensor_msgs/msg/Imu"}, {"lower": "/imu"}, "'/imu' in log holds sensor_msgs/msg/Imu"),
        (IMAGES, {"lower": "/a/upper/image_raw"}, "no upper camera in log"),
        (IMAGES | {"/b/lower": IMAGE}, {}, "several lower cameras in log: found /a/lower/image_raw, /b/lower"),
        ({"/lower\n\x1b[2J": IMAGE}, {}, r"/lower\\n\\x1b"),
        ({f"/t{n:02}": "" for n in range(40)}, {}, "/t15 and 24 more"),
    ],
)
def test_ambiguity_is_an_error_that_lists_the_candidates(
    topics: dict[str, str], wanted: dict[Camera, str], message: str
) -> None:
    with pytest.raises(DriverError, match=message) as caught:
        choose_topics("log", topics, {"lower": wanted.get("lower"), "upper": wanted.get("upper")})
    assert str(caught.value).isprintable()


def test_wheels_of_joints_are_an_odometry_where_omnid_has_recorded_them() -> None:
    wanted = MotionTopics(joints=JointWheels("left", "right", 0.1, 0.5))
    recorded = {"/omnid/wheel_odom": "nav_msgs/msg/Odometry", "/omnid/odom": "nav_msgs/msg/Odometry"}
    assert choose_motion_topics("log", recorded, wanted).names == {"/omnid/wheel_odom"}
    joints = recorded | {"/joints": "sensor_msgs/msg/JointState"}
    assert choose_motion_topics("log", joints, wanted).names == {"/joints"}
