"""Playback of a log at the rate at which it was recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.engine.playback_clock import PlaybackClock
from tests.omnid.stages.test_stages import stamped


@pytest.fixture(scope="module")
def frames(scene: Path) -> list[Frame]:
    return list(LogReader(scene / "log.mcap").frames())


def test_playback_waits_for_the_stamps_until_woken(frames: list[Frame]) -> None:
    frames_an_hour_apart = stamped(frames, ("lower", 0), ("lower", 3_600_000))
    clock = PlaybackClock()
    waiting = clock.messages(frames_an_hour_apart)
    assert next(waiting) is frames_an_hour_apart[0]
    clock.wake()
    assert next(waiting) is frames_an_hour_apart[1]
