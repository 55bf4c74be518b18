"""Topics of the bus: name, type and delivery of each. A name with a leading '/' is the same for all robots.

Requests to a robot are queries for `<robot>/@request/NAME` with the message of `cmd/NAME`.

The time of sending and the identity of the sender are attached, as to a message. The answer is JSON, such as
{"done": false, "text": "not armed: ..."}. (An error of zenoh would not do: it makes one itself after the timeout.)
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple, TypeAlias

from omnid.transport import codec
from omnid.transport.status_names import decode_navigation

MAP_POSE: Final = "map_pose"
SCAN: Final = "scan"
PANORAMA: Final = "panorama"
CLOCK: Final = "/clock"  # Time of runs whose clock is not the computer's.


class Topic(NamedTuple):
    """A published topic and how it is delivered."""

    schema: str  # ROS 2 message type
    decode: Callable[..., Any] = lambda *_: None  # takes payload and attachment; None: no program of omnid reads it
    realtime: bool = False  # sent before messages of all other topics
    latched: bool = False  # late subscribers can query the newest message
    transient_local: bool = False  # ... and those of ROS 2 receive it


PUBLISHED: Final = {
    "odom": Topic(codec.ODOMETRY_SCHEMA, codec.decode_pose, realtime=True, latched=True),
    "pose": Topic(codec.POSE_SCHEMA, realtime=True, latched=True),
    MAP_POSE: Topic(codec.MAP_POSE_SCHEMA, codec.decode_map_pose, latched=True),
    "/tf": Topic(codec.TRANSFORM_SCHEMA, realtime=True),
    "/tf_static": Topic(codec.TRANSFORM_SCHEMA, latched=True, transient_local=True),
    "status": Topic(codec.DIAGNOSTICS_SCHEMA, codec.decode_diagnostics, latched=True),
    "cloud": Topic(codec.POINT_CLOUD_SCHEMA, codec.decode_cloud, latched=True),
    "map": Topic(codec.GRID_SCHEMA, codec.decode_map, latched=True, transient_local=True),
    SCAN: Topic(codec.SCAN_SCHEMA, codec.decode_scan),
    "moving": Topic(codec.POINT_CLOUD_SCHEMA),
    "drive": Topic(codec.TWIST_SCHEMA),
    PANORAMA: Topic(codec.IMAGE_SCHEMA, codec.decode_panorama),
    "navigation": Topic(codec.DIAGNOSTICS_SCHEMA, decode_navigation, latched=True),
    "plan": Topic(codec.PATH_SCHEMA, latched=True),
    "path": Topic(codec.PATH_SCHEMA, codec.path_from_cdr, latched=True),
    "wheel_odom": Topic(codec.ODOMETRY_SCHEMA),
    "imu": Topic(codec.IMU_SCHEMA),
    CLOCK: Topic(codec.CLOCK_SCHEMA, realtime=True),
}
TIME: Final = "time"  # a query for the robot's own time, which senders repeat
STOP: Final = "cmd/stop"
ARM: Final = "cmd/arm"
BUMPER: Final = "cmd/bumper"
CLIFF: Final = "cmd/cliff"
GOAL: Final = "cmd/goal"
PATH: Final = "cmd/path"
NAVIGATION: Final = "cmd/navigation"
ROUTE: Final = "cmd/route"
MAP: Final = "cmd/map"
SAVE_MAP: Final = "save"  # the request on it
WHEEL_ODOM: Final = "cmd/wheel_odom"
IMU: Final = "cmd/imu"
NAVIGATION_TOPICS: Final = (GOAL, PATH, NAVIGATION, ROUTE)
SENSOR_TOPICS: Final = (WHEEL_ODOM, IMU)
TWIST: Final = "cmd/twist"
HEADING: Final = "cmd/heading"
PLANNER_TWIST: Final = "cmd/planner/twist"
PLANNER_HEADING: Final = "cmd/planner/heading"


class Command(NamedTuple):
    """Type, highest rate and largest size of the messages that are accepted on a topic."""

    schema: str  # ROS 2 message type
    rate_hz: float = 1000.0  # messages that are decoded a second: of setpoints, samples
    longest: int = 4096  # bytes
    is_request: bool = False  # it has an answer: it may be asked by a query as well


_request = partial(Command, rate_hz=50.0, is_request=True)
# Samples are below `cmd`, too, because they move the pose while the cameras show nothing: only programs that may
# command the robot may write them.
COMMANDS: Final = {
    STOP: Command("std_msgs/msg/Empty", longest=sys.maxsize),  # anything
    ARM: _request(codec.HEADER_SCHEMA),  # with the time it was sent
    **dict.fromkeys((BUMPER, CLIFF), Command(codec.BOOL_SCHEMA)),  # all but a fresh False is a contact
    GOAL: _request(codec.POSE_SCHEMA),  # in map or odom; a quaternion of zeros asks for no heading
    PATH: _request(codec.PATH_SCHEMA, rate_hz=2.0, longest=1 << 20),
    # "cancel", "pause", "resume"; "teach NAME [replace]", "finish", "repeat NAME [reverse] [loops=N]", "stop"; "save".
    # Its time of sending is attached, or the last word, stamp=NANOSECONDS.
    **dict.fromkeys((NAVIGATION, ROUTE, MAP), _request(codec.STRING_SCHEMA)),
    WHEEL_ODOM: Command(codec.ODOMETRY_SCHEMA),
    IMU: Command(codec.IMU_SCHEMA),
    # In base_link: linear.x m/s, angular.z rad/s; or a plain Twist, whose time of sending is attached.
    **dict.fromkeys((TWIST, PLANNER_TWIST), Command(codec.TWIST_SCHEMA)),
    # In odom: x the speed in m/s, z the heading in rad.
    **dict.fromkeys((HEADING, PLANNER_HEADING), Command(codec.VECTOR_SCHEMA)),
}


def request_key(topic: str) -> str:
    """Return the key of queries that ask what a message on a topic asks: "cmd/arm" -> "@request/arm".

    No star matches a part that begins with @: neither a query nor a permission for everything reaches a request.
    """
    return f"@request/{topic.removeprefix('cmd/')}"


def ros_name(robot: str, topic: str) -> str:
    """Return the ROS 2 name of a robot's topic, which is also its name in recordings: "odom" -> "/<robot>/odom"."""
    return topic if topic.startswith("/") else f"/{robot}/{topic}"


def plain_key(robot: str, topic: str) -> str:
    """Return the key of a robot's topic for programs without ROS 2, always below its name: "/tf" -> "<robot>/tf"."""
    return f"{robot}/{topic.removeprefix('/')}"


MAX_OPEN: Final = 64  # requests that wait for their answers; each holds a message in memory


class Request(NamedTuple):
    """A message to the robot."""

    topic: str  # from `cmd` on
    payload: bytes = b""
    sender: str = ""  # identity of the program that sent it, empty if unknown
    sent_ns: int = 0  # of Unix time, for a message without stamp; 0: it does not say it
    id: int = 0  # rises with each message
    echo_ns: int = 0  # the robot's own time as the sender repeats it (omnid.transport.commands); 0: it does not
    has_namesake: bool = False  # another robot on the bus has this one's name


class Answer(NamedTuple):
    """The answer to a request."""

    done: bool
    text: str  # what was done, or why not with the remedy


Answers: TypeAlias = dict[int, Answer]  # by the ids of the requests


def answer_of(payload: bytes) -> Answer | None:
    """Decode an answer; None for any other bytes."""
    try:
        found = json.loads(payload)
        return Answer(bool(found["done"]), str(found["text"]))
    except (ValueError, TypeError, LookupError, RecursionError):
        return None
