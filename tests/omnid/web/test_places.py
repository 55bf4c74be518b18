"""Connections that show no token keep no stop out."""

from __future__ import annotations

import contextlib
import json
import select
import socket

import pytest

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
pytest.importorskip("uvicorn", reason="needs the packages of omnid[web]")
from omnid.transport.bus import Bus
from omnid.web import places
from omnid.web.places import MOST_CONNECTIONS, ConnectionPlaces
from omnid.web.server import _listening
from tests.omnid.web.servers import WebServer


def test_a_connection_without_a_token_of_the_address_with_most_of_them_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "MOST_CONNECTIONS", 4)
    found = ConnectionPlaces()
    kept = [found.admit(address) for address in (("phone", 1), ("crowd", 1))]
    found.know(("crowd", 1))
    for port in range(2, 20):
        found.admit(("crowd", port))
    assert len(found) == 4 and found.lost == 16
    assert kept[0] in found._places.values() and kept[1] in found._places.values()


@pytest.mark.hazard("H51")
def test_more_silent_connections_than_places_keep_no_request_out(server: WebServer, bus: Bus) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MOST_CONNECTIONS + 100):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port)))
        assert server.request("/metrics", headers=server.bearer).status == 200
        assert "done" in json.loads(server.request("/stop", "POST", server.bearer).text)


def test_a_silent_connection_stays_with_the_system_until_its_first_bytes() -> None:
    """A crowd that says nothing, and connects again at once, must not drive out the connection of a stop."""
    with _listening("127.0.0.1:0") as listener, socket.create_connection(listener.getsockname()) as browser:
        assert select.select([listener], [], [], 0.3)[0] == []
        browser.sendall(b"POST /stop")
        assert select.select([listener], [], [], 10.0)[0] == [listener]
