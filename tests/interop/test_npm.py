"""@mcap/core 2.2.2 with @foxglove/rosmsg2-serialization 3.1.0, the readers of Foxglove and Lichtblick, under node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from tests.interop.conftest import Known
from tests.interop.known import ATTACHED, Expected, digest, plain
from tests.interop.programs import lines, npm_reader

pytestmark = pytest.mark.interop


def read(log: Path) -> tuple[dict[str, Any], Expected]:
    """Return the header of the log and its messages by topic; assert that log times are the stamps."""
    reader = npm_reader()
    head, *messages = lines(["node", reader, log], reader.parent)
    found: Expected = {}
    for entry in messages:
        message = entry["message"]
        if "/cmd/" not in entry["topic"]:
            stamp = message.get("transforms", [message])[0]["header"]["stamp"]
            assert int(entry["log_ns"]) == stamp["sec"] * 10**9 + stamp["nanosec"]
        found.setdefault(entry["topic"], []).append(message)
    return head, found


def test_reads_the_numbers_that_were_written(known: Known) -> None:
    head, found = read(known.path)
    assert head == {"profile": "ros2", "attachments": {name: digest(data) for name, data in ATTACHED.items()}}
    assert found == known.expected


def test_reads_a_live_recording_as_rosbags_does(live: Path) -> None:
    expected: Expected = {}
    with AnyReader([live]) as bag:
        for place, _, data in bag.messages():
            expected.setdefault(place.topic, []).append(plain(bag.deserialize(data, place.msgtype)))
    head, found = read(live)
    assert set(head["attachments"]) == {"rig.toml", "omnid.toml"} and len(found) >= 8
    assert found == expected
