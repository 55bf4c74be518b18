from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DriverError
from drivers.frame import Camera
from drivers.logs.log_reader import LogReader
from drivers.logs.ros_messages import JointWheels
from drivers.logs.topics import MotionTopics, choose_motion_topics, choose_topics
from tests.drivers.logs.mcap_logs import BARE, IMAGE, START_NS, Entry, pairs, text, write_log

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
