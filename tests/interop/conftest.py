"""Logs that are read by programs of other projects."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from tests.interop.known import Expected, write_known
from tests.replay.recorded import recorded_run

POSES = 12  # of the live run


class Known(NamedTuple):
    """A log and its expected content."""

    path: Path
    expected: Expected


@pytest.fixture(scope="session", params=("lz4", "none"))
def known(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Known:
    """A log of known numbers, with chunks as `--record` and as `omnid run` writes them."""
    path = tmp_path_factory.mktemp("known") / f"{request.param}.mcap"
    return Known(path, write_known(path, request.param))


@pytest.fixture(scope="session")
def live(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a live run: images, poses, map, states, commands to the wheels."""
    return recorded_run(scene, tmp_path_factory.mktemp("live"), POSES)
