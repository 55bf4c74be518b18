"""The encoder: which messages are made of an update, and the state of the navigation as a status entry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from drivers.motor import VelocityCommand
from omnid.core.mapping.voxel_map import MapPoints
from omnid.messages import MapUpdate, NavigationUpdate, RequestAnswer
from omnid.navigation_state import NavigationState
from omnid.sinks.encoder import Encoder, MapEncoding, Outgoing, navigation_status
from omnid.transport.codec import ERROR, OK, WARN

OFFSET_NS = 10**18


def decoded(message: Outgoing, points: int = 10) -> list[tuple[str, Any]]:
    """Return topics and messages of ROS 2."""
    store, encode = get_typestore(Stores.ROS2_HUMBLE), Encoder(np.eye(4), MapEncoding(points), OFFSET_NS)
    return [(sent.topic, store.deserialize_cdr(sent.payload, sent.schema)) for sent in encode(message)]


def test_a_command_is_in_unix_time_and_in_the_frame_of_the_base() -> None:
    [(topic, twist)] = decoded(VelocityCommand(5 * 10**9, 0.25, 0.0, -0.5))
    assert (topic, twist.header.frame_id, twist.header.stamp.sec) == ("drive", "base_link", 10**9 + 5)
    assert (twist.twist.linear.x, twist.twist.angular.z) == (0.25, -0.5)


def test_a_cloud_has_the_most_confident_points_in_their_order() -> None:
    xyz = np.arange(12, dtype=np.float32).reshape(4, 3)
    ages = np.zeros(4, np.int32)
    points = MapPoints(xyz, np.array([0.9, 0.1, 0.2, 0.8], np.float32), ages, ages)
    [(topic, cloud)] = decoded(MapUpdate(1, 1, points, np.zeros((0, 2))), points=2)
    shown = np.frombuffer(cloud.data.tobytes(), np.float32).reshape(cloud.width, -1)[:, :3]
    assert topic == "cloud" and shown.tolist() == xyz[[0, 3]].tolist()


@pytest.mark.parametrize(
    ("state", "level"),
    [(NavigationState.DRIVING, OK), (NavigationState.BLOCKED, WARN), (NavigationState.FAILED, ERROR)],
)
def test_the_level_follows_the_state_of_the_navigation(state: NavigationState, level: int) -> None:
    status = navigation_status(NavigationUpdate(1, 1, None, state, "why"))
    assert (status.level, status.message) == (level, f"{state}: why")


def test_the_entry_has_what_is_known() -> None:
    least = navigation_status(NavigationUpdate(1, 1, None, NavigationState.IDLE))
    assert least.values == {"state": "idle"} and least.message == "idle"
    answers = (RequestAnswer(1, "b", "no map"),)
    update = NavigationUpdate(
        1, 1, None, NavigationState.DRIVING, "", "goal", 7, 1.25, -0.5, 2, teaching="way", taught_m=3.0, answers=answers
    )
    assert navigation_status(update).values == {
        "state": "driving",
        "task": "goal",
        "command_ns": "7",
        "left_m": "1.250",
        "offset_m": "-0.500",
        "loops_left": "2",
        "teaching": "way",
        "taught_m": "3.00",
        "request": "b",
        "refusal": "no map",
    }
