"""--lower and --upper of `omnid run` and `omnid record`: devices, or the topics of a log."""

from __future__ import annotations

from importlib.resources import files

import pytest

from omnid.cli import main
from tests.omnid.transport.bus_fixtures import free_endpoint

SAMPLE = str(files("omnid.sample") / "log.mcap")
TOPIC = "/{}/image_raw/compressed"


def error(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main([*arguments]) == 2
    return capsys.readouterr().err


def test_a_log_is_read_by_its_topics(capsys: pytest.CaptureFixture[str]) -> None:
    run = ("run", "--log", SAMPLE, "--once", "--set", f'bus.listen=["{free_endpoint()}"]')
    assert "no topic '/front'" in error(capsys, *run, "--lower", "/front")
    exchanged = error(capsys, *run, "--lower", TOPIC.format("upper"), "--upper", TOPIC.format("lower"))
    assert "exchange --lower and --upper" in exchanged


def test_record_opens_the_named_devices(capsys: pytest.CaptureFixture[str]) -> None:
    assert "/dev/no-camera" in error(capsys, "record", "--lower", "/dev/no-camera", "--upper", "/dev/null")
