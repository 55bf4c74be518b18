"""The command line under test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.ports import listening
from tests.replay.command import Command


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str]) -> Command:
    """Return the command line as a function."""
    return Command(capsys)


@pytest.fixture
def taken_port() -> Iterator[int]:
    """Yield a port on which a server listens."""
    with listening() as port:
        yield port
