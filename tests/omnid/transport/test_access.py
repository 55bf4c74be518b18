"""Permissions on the bus: omnid's own rules, and those of the shipped site.json5 with TLS, users and certificates."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from omnid.client import Answer, Driver, Robot, Unreachable
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import OK
from omnid.transport.status_names import BUS, entry
from omnid.transport.topics import Request
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry, script, session
from tests.waiting import wait_until

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")
SITE = Path(__file__).parents[3] / "omnid" / "transport" / "site.json5"
EC_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
USERS = ("one", "two", "ada", "bob")
ZENOHD = """
import sys, time, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("ready", flush=True)
    time.sleep(1000)
"""


def openssl(*words: object) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)


def authority(folder: Path, name: str) -> None:
    """Make a key and a certificate that is signed by itself."""
    files = ("-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem")
    openssl("req", "-x509", *EC_KEY, "-days", 2, "-subj", f"/CN={name}", *files)


def certificate(folder: Path, name: str, signer: str) -> None:
    """Make a key and a certificate for this machine that an authority signs."""
    key, pem, request, extra = (folder / f"{name}.{suffix}" for suffix in ("key", "pem", "csr", "ext"))
    extra.write_text("subjectAltName=IP:127.0.0.1,DNS:localhost\n")
    openssl("req", *EC_KEY, "-subj", f"/CN={name}", "-keyout", key, "-out", request)
    signed_by = ("-CA", folder / f"{signer}.pem", "-CAkey", folder / f"{signer}.key", "-CAcreateserial")
    openssl("x509", "-req", "-in", request, "-days", 2, *signed_by, "-extfile", extra, "-out", pem)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a site: keys, certificates, users; of ada and eve with the files of clients; eve has no password.

    `site.json5` is the shipped one with the names of these files; `certificates.json5` asks for certificates instead of
    passwords.
    """
    folder = tmp_path_factory.mktemp("site")
    for name in ("ca", "other"):
        authority(folder, name)
    for name, signer in (("site", "ca"), ("driver", "ca"), ("guest", "ca"), ("stranger", "other")):
        certificate(folder, name, signer)
    (folder / "users.txt").write_text("".join(f"{user}:secret of {user}\n" for user in USERS))
    text = SITE.read_text().replace("/etc/omnid/", f"{folder}/")
    (folder / "site.json5").write_text(text)
    tls = f'tls: {{ root_ca_certificate: "{folder}/ca.pem", enable_mtls: true,'
    text = text.replace("tls: {", tls).replace('usernames: ["ada"]', 'cert_common_names: ["driver"]')
    (folder / "certificates.json5").write_text(re.sub("auth: {.*", "", text))
    for user in (*USERS, "eve"):
        password = f"secret of {user if user != 'eve' else 'ada?'}"
        client_file(folder, user, {"auth": {"usrpwd": {"user": user, "password": password}}}, {})
    client_file(folder, "nobody", {}, {})
    for name in ("driver", "guest", "stranger"):
        keys = {"connect_private_key": f"{folder}/{name}.key", "connect_certificate": f"{folder}/{name}.pem"}
        client_file(folder, name, {}, {**keys, "enable_mtls": True})
    return folder


def client_file(folder: Path, name: str, transport: dict[str, object], tls: dict[str, object]) -> None:
    """Write zenoh's file of a client."""
    link = {"tls": {"root_ca_certificate": f"{folder}/ca.pem", **tls}}
    (folder / f"{name}.json5").write_text(json.dumps({"transport": {**transport, "link": link}}))


def visitor(site: Path, endpoint: str, name: str, robot: str = "omnid") -> Robot:
    """Return the connection of a program with the file of a user."""
    return Robot(settings=BusConfig(robot=robot, connect=(endpoint,), config=str(site / f"{name}.json5")))


@contextlib.contextmanager
def commands_to(config: BusConfig) -> Iterator[tuple[Bus, list[str]]]:
    """Yield a robot that answers all requests, and the topics of what it receives."""
    received: list[str] = []
    with contextlib.closing(Bus(config)) as bus:

        def take(request: Request) -> None:
            received.append(request.topic)
            bus.answer({request.id: Answer(True, "armed")})

        bus.subscribe_commands(take)
        yield bus, received


def asks_to_arm(driver: Driver) -> bool:
    """Return whether a program that asks to arm gets an answer."""
    try:
        return driver.arm(timeout_s=1.0).done
    except OmnidError:
        return False


def expect_rights(received: list[str], accepted: Robot, refused: Robot) -> None:
    """Expect that one program may drive and arm, that the other may look and stop only, and not answer requests."""
    driver, looker = accepted.driver(), refused.driver()
    wait_until(lambda: looker.stop() is None and "cmd/stop" in received)
    wait_until(lambda: driver.twist(0.1, 0.0) is None and "cmd/twist" in received)
    wait_until(lambda: asks_to_arm(driver))
    time.sleep(0.3)
    received.clear()
    for _ in range(3):
        looker.twist(1.0, 0.0)
        looker.heading(1.0, 0.0)
        refused.driver("planner").twist(1.0, 0.0)
    assert not asks_to_arm(looker)
    for everything in ("**", f"{refused.name}/**", "**/@request/*", f"{refused.name}/@request/arm"):
        replies = refused._session.get(everything, payload=codec.header_cdr(time.time_ns()), timeout=1.0)
        assert not any(reply.ok and "@request" in str(reply.ok.key_expr) for reply in replies)
    key, forged = f"{refused.name}/@request/arm", '{"done": false, "text": "forged"}'
    with refused._session.declare_queryable(key, lambda query: query.reply(key, forged)):
        assert all(asks_to_arm(driver) for _ in range(3)), "a stranger answers no request"
    assert set(received) == {"cmd/arm"} and len(received) == 3
    assert refused.alive, "who may not drive can still look"


@pytest.mark.hazard("H02", "H44")
@needs_openssl
def test_everyone_with_a_certificate_may_stop_and_named_ones_may_drive_and_arm(site: Path) -> None:
    endpoint = free_endpoint("tls")
    with (
        commands_to(BusConfig(listen=(endpoint,), config=str(site / "certificates.json5"))) as (_, received),
        visitor(site, endpoint, "driver") as driver,
        visitor(site, endpoint, "guest") as guest,
    ):
        expect_rights(received, driver, guest)
        for name in ("stranger", "nobody"):
            with pytest.raises(Unreachable), visitor(site, endpoint, name) as intruder:
                assert not intruder.alive  # a client of TLS 1.3 may learn of it a moment later only
                raise Unreachable("connected, but receives nothing")


@pytest.mark.hazard("H44", "H48", "H49")
@needs_openssl
def test_users_need_their_password_and_the_permission_to_drive(site: Path) -> None:
    endpoint = free_endpoint("tls")
    with (
        commands_to(BusConfig(listen=(endpoint,), config=str(site / "site.json5"))) as (bus, received),
        visitor(site, endpoint, "ada") as ada,
        visitor(site, endpoint, "bob") as bob,
    ):
        expect_rights(received, ada, bob)
        held = bob._session.liveliness().declare_token("omnid/alive/x")
        bob.driver().stop()
        wait_until(lambda: "cmd/stop" in received)
        assert bus.is_unique and entry(BUS, bus.stats()).level == OK, "only the robot declares tokens below its name"
        del held
        for name in ("eve", "nobody"):
            with pytest.raises(Unreachable):
                visitor(site, endpoint, name)


@pytest.mark.hazard("H48")
@needs_openssl
def test_behind_a_router_no_robot_speaks_for_another(site: Path) -> None:
    endpoint = free_endpoint("tls")
    (site / "router.json5").write_text((site / "site.json5").read_text().replace("tls/0.0.0.0:7447", endpoint))
    config = BusConfig(robot="hall/one", listen=(), connect=(endpoint,), config=str(site / "one.json5"))
    with (
        script(ZENOHD, str(site / "router.json5")),
        commands_to(config) as (bus, received),
        visitor(site, endpoint, "ada", "hall/one") as ada,
        visitor(site, endpoint, "bob", "hall/one") as bob,
        visitor(site, endpoint, "two", "hall/one") as other,
    ):
        expect_rights(received, ada, other)
        poses: list[bytes] = []
        bob.on_message(lambda _, payload, __: poses.append(payload), "odom")

        def publish_and_forge() -> bool:
            other._session.put("hall/one/odom", b"forged")
            bus.publish("odom", odometry(1))
            return len(poses) > 5

        wait_until(publish_and_forge)
        held = other._session.liveliness().declare_token("hall/one/alive/x")
        time.sleep(0.3)
        assert set(poses) == {odometry(1)} and bus.is_unique
        del held
        with pytest.raises(Unreachable):
            visitor(site, endpoint, "eve", "hall/one")


def test_messages_of_others_under_the_robots_name_are_dropped() -> None:
    """A forged pose that is sent to the robot is not forwarded to its subscribers."""
    endpoint, poses = free_endpoint(), list[bytes]()
    with (
        commands_to(BusConfig(listen=(endpoint,))) as (bus, received),
        Robot(connect=(endpoint,)) as listener,
        session(mode="client", connect__endpoints=[endpoint]) as forger,
    ):
        listener.on_message(lambda _, payload, __: poses.append(payload))

        def forge_and_publish() -> bool:
            forger.put("omnid/odom", b"forged")
            forger.put("omnid/cmd/twist", b"")
            bus.publish("odom", odometry(1))
            return len(poses) > 5 and "cmd/twist" in received

        wait_until(forge_and_publish)
        everything = forger.get("**", payload=codec.header_cdr(time.time_ns()), timeout=1.0)
        assert list(everything) and "cmd/arm" not in received
    assert set(poses) == {odometry(1)}
