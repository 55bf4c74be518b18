"""One robot on the bus and one server for all tests of this folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from omnid.transport.bus import Bus, BusConfig
from tests.omnid.transport.bus_fixtures import free_endpoint

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
from tests.omnid.web.servers import WebServer, served

ROBOT = "rover"


@pytest.fixture(scope="module")
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture(scope="module")
def bus(endpoint: str) -> Iterator[Bus]:
    with contextlib.closing(Bus(BusConfig(robot=ROBOT, listen=(endpoint,)))) as bus:
        yield bus


@pytest.fixture(scope="module")
def server(bus: Bus, endpoint: str) -> Iterator[WebServer]:
    with served("--robot", ROBOT, "--connect", endpoint) as found:
        yield found
