"""The command line under test."""

from __future__ import annotations

import socket

import pytest

from tests.replay.command import Command


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str]) -> Command:
    """The command line, called as a function."""
    return Command(capsys)


@pytest.fixture
def unused_tcp_port() -> int:
    """A port on this machine that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
