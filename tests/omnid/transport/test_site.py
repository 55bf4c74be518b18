"""The site of SITE.md: a router with TLS, users and rights, robots behind it, and the last state of one that is off."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from omnid.client import Answer, Diagnostics, Robot, Unreachable
from omnid.config import load_config
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.records import DiagnosticStatus
from omnid.transport.requests import Request
from omnid.transport.status_names import BUS
from tests.omnid.transport.bus_fixtures import free_endpoint, script
from tests.omnid.transport.test_access import asks_to_arm, authority, certificate, needs_openssl
from tests.waiting import wait_until

PAGE = (Path(__file__).parents[3] / "omnid" / "transport" / "SITE.md").read_text()
USERS = ("one", "two", "ada", "bob")
ROUTER = """
import sys, time, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("ready", flush=True)
    time.sleep(1000)
"""


def block(language: str, number: int = 0) -> str:
    """Return a block of the page."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[number]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the files of a running site; `endpoint` holds the router's address."""
    folder = tmp_path_factory.mktemp("site")
    authority(folder, "ca")
    certificate(folder, "router", "ca")
    endpoint = free_endpoint("tls")
    (folder / "endpoint").write_text(endpoint)
    (folder / "users.txt").write_text("".join(f"{user}:secret of {user}\n" for user in USERS))
    for user in USERS:
        (folder / user).write_text(f"secret of {user}\n")
    text = block("json5").replace("tls/0.0.0.0:7447", endpoint)
    for name in ("users.txt", "router.pem", "router.key"):
        text = text.replace(f'"{name}"', json.dumps(str(folder / name)))
    (folder / "site.json5").write_text(text)
    with script(ROUTER, str(folder / "site.json5")):
        yield folder


def settings(site: Path, user: str, robot: str) -> BusConfig:
    """Return the settings of a robot or a person, from the page."""
    text = block("toml").replace("tls/router.site:7447", (site / "endpoint").read_text())
    text = text.replace("/etc/omnid/ca.pem", str(site / "ca.pem")).replace("/etc/omnid/bus-password", str(site / user))
    text = text.replace('user = "one"', f'user = "{user}"').replace("hall/one", robot)
    path = site / f"{user}.toml"
    path.write_text(text)
    return load_config(path).bus


@contextlib.contextmanager
def robot(site: Path, user: str, name: str) -> Iterator[tuple[Bus, list[str]]]:
    """Yield a robot behind the router, and the commands that it receives."""
    received: list[str] = []
    with contextlib.closing(Bus(settings(site, user, name))) as bus:
        wait_until(lambda: bus.connect() is None and bus.status().message == "open")

        def take(request: Request) -> None:
            received.append(request.topic)
            bus.answer(request.id, Answer(True, name))

        bus.subscribe_commands(take, {})
        yield bus, received


def status(text: str) -> bytes:
    return codec.diagnostics_cdr(10**18, [DiagnosticStatus(BUS, 0, text, {})])


@needs_openssl
def test_ada_drives_bob_stops_and_no_robot_speaks_for_another(site: Path) -> None:
    with (
        robot(site, "one", "hall/one") as (bus, received),
        Robot(settings=settings(site, "ada", "hall/one"), timeout_s=10) as ada,
        Robot(settings=settings(site, "bob", "hall/one"), timeout_s=10) as bob,
        Robot(settings=settings(site, "two", "hall/one"), timeout_s=10) as other,
    ):
        drivers = {name: person.driver() for name, person in (("ada", ada), ("bob", bob), ("two", other))}
        wait_until(lambda: drivers["ada"].twist(0.1, 0.0) is None and "cmd/twist" in received)
        wait_until(lambda: drivers["bob"].stop() is None and "cmd/stop" in received)
        time.sleep(0.3)
        count = received.count("cmd/twist")
        for name in ("bob", "two"):
            drivers[name].twist(0.1, 0.0)
        time.sleep(0.3)
        assert received.count("cmd/twist") == count
        wait_until(lambda: asks_to_arm(drivers["ada"]))
        arms = received.count("cmd/arm")
        key = "hall/one/@request/arm"
        with other._session.declare_queryable(key, lambda query: query.reply(key, '{"done": true, "text": "forged"}')):
            assert drivers["ada"].arm() == (True, "hall/one")
        assert not any(map(asks_to_arm, (drivers["bob"], drivers["two"])))
        assert received.count("cmd/arm") == arms + 1
        with bob.subscribe(Diagnostics) as reports:
            bus.publish("status", status("mine"))
            wait_until(lambda: (report := reports.newest()) is not None and report.statuses[0].message == "mine")
            other._session.put("hall/one/status", status("forged"))
            time.sleep(0.3)
            assert reports.newest() is None


@needs_openssl
def test_a_wrong_password_and_no_password_are_refused(site: Path) -> None:
    settings(site, "ada", "hall/one")
    (site / "eve").write_text("secret of ada?\n")
    for user in ("eve", "bob"):
        given = settings(site, user, "hall/one")
        if user == "bob":
            given = BusConfig(connect=given.connect, tls_ca=given.tls_ca)
        with pytest.raises(Unreachable):
            Robot(settings=given)


@needs_openssl
def test_the_last_state_of_a_robot_that_is_off_is_kept(site: Path) -> None:
    keeper, client = settings(site, "bob", "hall/two"), site / "keeper.json5"
    client.write_text(
        json.dumps(
            {
                "mode": "client",
                "connect": {"endpoints": list(keeper.connect)},
                "scouting": {"multicast": {"enabled": False}},
                "transport": {
                    "auth": {"usrpwd": {"user": "bob", "password": "secret of bob"}},
                    "link": {"tls": {"root_ca_certificate": keeper.tls_ca}},
                },
            }
        )
    )
    with script(block("python"), str(client)):
        with (
            robot(site, "two", "hall/two") as (bus, _),
            Robot(settings=settings(site, "ada", "hall/two"), timeout_s=10) as ada,
            ada.subscribe(Diagnostics) as reports,
        ):
            wait_until(lambda: bus.publish("status", status("the last")) is None and reports.newest() is not None)
            time.sleep(0.5)
        with Robot(settings=settings(site, "ada", "hall/two"), timeout_s=10) as later:
            assert not later.alive
            with later.subscribe(Diagnostics) as kept:
                report = kept.newest()
    assert report is not None and report.statuses[0].message == "the last"
