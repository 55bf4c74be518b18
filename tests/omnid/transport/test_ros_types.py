"""Types of ROS 2 are loaded when the first one is used."""

from __future__ import annotations

import subprocess
import sys

import pytest
from rosbags.typesys.stores import ros2_humble

from omnid.transport import ros_types


def test_types_are_those_of_rosbags() -> None:
    assert ros_types.std_msgs__msg__Header is ros2_humble.std_msgs__msg__Header
    with pytest.raises(AttributeError):
        _ = ros_types.no_such_type


def test_nothing_is_loaded_before_a_type_is_used() -> None:
    program = (
        "import sys; from omnid.transport import ros_types; name = 'rosbags.typesys.stores.ros2_humble'; "
        "before = name in sys.modules; ros_types.std_msgs__msg__Header; print(before, name in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"
