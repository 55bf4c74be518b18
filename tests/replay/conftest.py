"""The command line under test."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from tests.replay.command import Command


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str]) -> Command:
    """Return the command line as a function."""
    return Command(capsys)


@pytest.fixture
def unused_tcp_port() -> int:
    """Return a port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def taken_port() -> Iterator[int]:
    """Yield a port on which a server listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield int(server.getsockname()[1])
