"""The command line under test."""

from __future__ import annotations

import pytest

from tests.replay.command import Command


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str]) -> Command:
    """The command line, called as a function."""
    return Command(capsys)
