"""Commands from the network in a recording: unchanged, and only those that a reader can decode."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from omnid.config import Config
from omnid.runs.record import open_recorder
from omnid.sinks.command_log import command_recorder, logged_command
from omnid.transport import codec
from omnid.transport.commands import LONGEST_PAYLOAD
from omnid.transport.records import TwistRecord
from omnid.transport.topics import command_topics

TOPICS = command_topics(("operator", "planner"))
NOW_NS = 1_700_000_000 * 10**9


def test_a_plain_twist_is_recorded_as_what_the_topic_holds() -> None:
    plain = codec.twist_stamped_cdr(NOW_NS, "", 0.4, 0.5)[-48:]  # the six numbers
    message = logged_command("cmd/twist", b"\0\1\0\0" + plain, TOPICS)
    assert message is not None
    assert codec.twist_from_cdr(message.payload) == TwistRecord(0, "", 0.4, 0.5)
    assert logged_command("cmd/twist", b"\7\7\0\0" + plain, TOPICS) is None


def test_commands_are_recorded_unchanged(tmp_path: Path) -> None:
    config = Config()
    config = replace(config, record=replace(config.record, folder=str(tmp_path / "log"), free_mb=0, file_mb=1))
    recorder = open_recorder(config, "", lambda *_: None)
    offset_ns = NOW_NS - time.monotonic_ns()
    record = command_recorder(recorder, lambda: time.monotonic_ns() + offset_ns, TOPICS)
    record("cmd/heading", codec.heading_cdr(NOW_NS, 0.3, -1.2))
    record("cmd/twist", codec.twist_stamped_cdr(NOW_NS, "base_link", 0.4, 0.5))
    record("cmd/stop", b"whatever")
    record("cmd/arm", codec.header_cdr(NOW_NS))
    record("cmd/planner/heading", codec.heading_cdr(NOW_NS, 0.1, 0.2))
    record("cmd/heading", b"no heading")
    record("cmd/other/heading", codec.heading_cdr(NOW_NS, 0.1, 0.2))
    recorder.finish()
    (path,) = (tmp_path / "log").glob("*.mcap")
    with AnyReader([path]) as bag:
        found = {place.topic: (at_ns, bag.deserialize(data, place.msgtype)) for place, at_ns, data in bag.messages()}
    assert list(found) == [
        "/omnid/cmd/heading",
        "/omnid/cmd/twist",
        "/omnid/cmd/stop",
        "/omnid/cmd/arm",
        "/omnid/cmd/planner/heading",
    ]
    assert all(0 <= at_ns - NOW_NS < 60 * 10**9 for at_ns, _ in found.values())
    heading, twist = found["/omnid/cmd/heading"][1].vector, found["/omnid/cmd/twist"][1].twist
    assert (heading.x, heading.z, twist.linear.x, twist.angular.z) == (0.3, -1.2, 0.4, 0.5)


@pytest.mark.parametrize("key", ["cmd", "cmd/", "cmd/speed", "odom", "cmd/heading/more", ""])
def test_other_keys_are_left_out(key: str) -> None:
    assert logged_command(key, codec.heading_cdr(NOW_NS, 0.3, -1.2), TOPICS) is None


def test_any_bytes_are_accepted() -> None:
    numbers = np.random.default_rng(1)
    for key in TOPICS:
        for size in (0, 1, 3, 4, 5, 40, 64, 200, LONGEST_PAYLOAD):
            logged_command(key, numbers.bytes(size), TOPICS)
        assert logged_command(key, os.urandom(LONGEST_PAYLOAD + 1), TOPICS) is None
