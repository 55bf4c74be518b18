"""Topics: the first source has the short ones too, and requests have keys that no star matches."""

from __future__ import annotations

import pytest
import zenoh

from omnid.transport.topics import ARM, PUBLISHED, REQUEST_TOPICS, STOP, command_topics, request_key, ros_name


def test_each_source_has_its_topics_and_the_short_ones_are_those_of_all() -> None:
    topics = command_topics(("operator", "planner"))
    named = {f"cmd/{source}{kind}" for source in ("", "operator/", "planner/") for kind in ("twist", "heading")}
    assert named <= topics.keys() and len(topics) - len(named) == len(command_topics(())) - 2
    assert topics["cmd/planner/twist"] == topics["cmd/twist"] == "geometry_msgs/msg/TwistStamped"
    assert {STOP, ARM} | REQUEST_TOPICS <= topics.keys() and not topics.keys() & PUBLISHED.keys()


@pytest.mark.parametrize("topic", sorted(REQUEST_TOPICS))
def test_no_star_matches_the_key_of_a_request(topic: str) -> None:
    key = zenoh.KeyExpr(f"omnid/{request_key(topic)}")
    assert not any(zenoh.KeyExpr(pattern).intersects(key) for pattern in ("**", "omnid/**", "omnid/*/*"))
    assert str(key).endswith(topic.removeprefix("cmd"))


def test_names_of_ros_are_below_the_robot_unless_they_are_those_of_all() -> None:
    assert (ros_name("bob", "odom"), ros_name("bob", "/tf")) == ("/bob/odom", "/tf")
