"""The command line of an installed program."""

from __future__ import annotations

import sys

import pytest

from tests.replay.command import Command


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    monkeypatch.setattr(sys, "prefix", "/srv/robot")
    return Command(capsys)
