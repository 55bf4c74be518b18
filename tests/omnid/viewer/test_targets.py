"""Targets of a view: contradictions, files that cannot be written, no display."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.omnid.viewer.rrd import need_rerun
from tests.replay.command import Command


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--web", "-o", "x.rrd"), "-o and --web"),
        (("--replay",), "--replay"),
        (("--port", "9090"), "--web"),
        (("--web", "--port", "65535"), "65534"),
        (("--seconds", "-1"), "--seconds"),
        (("log.mcap", "--connect", "tcp/127.0.0.1:1"), "--connect"),
        (("log.mcap", "--seconds", "3"), "--seconds"),
    ],
)
def test_refuses_contradictory_options(words: tuple[str, ...], expected: str, omnid: Command) -> None:
    assert expected in omnid.refused("view", *words)


def test_refuses_files_that_cannot_be_written(scene: Path, tmp_path: Path, omnid: Command) -> None:
    need_rerun()
    log = scene / "log.mcap"
    assert "no folder" in omnid.refused("view", log, "-o", tmp_path / "nowhere" / "x.rrd")
    assert "the log that is read" in omnid.refused("view", log, "-o", log)
    assert "device or a pipe" in omnid.refused("view", log, "-o", "/dev/full")


def test_without_a_display_the_alternatives_are_named(
    scene: Path, omnid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    need_rerun()
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    error = omnid.refused("view", scene / "log.mcap")
    assert "display" in error and "-o FILE.rrd" in error and "--web" in error
