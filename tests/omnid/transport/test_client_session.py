"""Sessions of clients: wrong settings are refused at once, and the robots there are named."""

from __future__ import annotations

import contextlib

import pytest

from omnid.errors import OmnidError
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.client_session import open_client, robots_there
from omnid.transport.session import Unreachable
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.waiting import wait_until


def test_the_robots_that_are_reached_are_named() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(robot="bob", listen=(endpoint,)))):
        session = open_client(BusConfig(mode="peer", robot="ada", listen=("tcp/127.0.0.1:1",), connect=(endpoint,)))
        with contextlib.closing(session):
            assert robots_there(session) == "robots there: bob"


def test_many_robots_are_counted() -> None:
    endpoint = free_endpoint()
    with (
        contextlib.closing(Bus(BusConfig(robot="bob", listen=(endpoint,)))),
        contextlib.closing(open_client(BusConfig(connect=(endpoint,)))) as session,
        contextlib.closing(open_client(BusConfig(connect=(endpoint,)))) as other,
    ):
        held = [other.liveliness().declare_token(f"robot{number}/alive") for number in range(7)]
        wait_until(lambda: robots_there(session) == "robots there: bob, robot0, robot1, robot2, robot3, 3 more")
        del held


def test_no_router_and_wrong_settings_are_errors() -> None:
    with pytest.raises(Unreachable):
        open_client(BusConfig(connect=(free_endpoint(),)))
    with pytest.raises(OmnidError, match="write protocol/host:port") as caught:
        open_client(BusConfig(connect=("nowhere",)), timeout_s=60.0)
    assert not isinstance(caught.value, Unreachable)
