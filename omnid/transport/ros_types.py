"""Types of ROS 2 (Humble) messages, by rosbags, loaded at first use: they are many, and most commands need none."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_humble import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    found = getattr(importlib.import_module("rosbags.typesys.stores.ros2_humble"), name)
    globals()[name] = found  # so that this function is called once for a type
    return found
