"""The layout for Foxglove names topics that the robot publishes, and panels that exist in it."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from typing import Any

from omnid.transport.topics import PUBLISHED, ros_name


def panels(node: Any) -> list[str]:
    """Return the panels of a layout tree."""
    return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])


def test_the_layout_shows_topics_of_the_robot() -> None:
    text = (files("omnid.viewer") / "foxglove.json").read_text()
    layout = json.loads(text)
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    named = {name.partition(".")[0] for name in re.findall(r'"(/omnid/[^"]+)"', text)}
    assert named and named <= {ros_name("omnid", topic) for topic in PUBLISHED}
