"""Permissions on the bus: certificates made with openssl, users with passwords, real sessions."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from omnid.client import Answer, Driver, Robot, Unreachable
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.requests import Request
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.waiting import wait_until

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")


def openssl(*words: str) -> None:
    subprocess.run(["openssl", *words], check=True, capture_output=True)


def authority(folder: Path, name: str) -> None:
    openssl(
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
        "-days",
        "2",
        "-subj",
        f"/CN={name}",
        "-keyout",
        str(folder / f"{name}.key"),
        "-out",
        str(folder / f"{name}.pem"),
    )


def certificate(folder: Path, name: str, signer: str) -> None:
    request, extra = folder / f"{name}.csr", folder / f"{name}.ext"
    extra.write_text("subjectAltName=IP:127.0.0.1,DNS:localhost\n")
    openssl(
        "req",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
        "-subj",
        f"/CN={name}",
        "-keyout",
        str(folder / f"{name}.key"),
        "-out",
        str(request),
    )
    openssl(
        "x509",
        "-req",
        "-in",
        str(request),
        "-days",
        "2",
        "-CA",
        str(folder / f"{signer}.pem"),
        "-CAkey",
        str(folder / f"{signer}.key"),
        "-CAcreateserial",
        "-extfile",
        str(extra),
        "-out",
        str(folder / f"{name}.pem"),
    )


@pytest.fixture(scope="module")
def credentials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys and certificates of the robot, a driver and a guest, and of a stranger with another authority."""
    folder = tmp_path_factory.mktemp("credentials")
    for name in ("ca", "other"):
        authority(folder, name)
    for name, signer in (("robot", "ca"), ("driver", "ca"), ("guest", "ca"), ("stranger", "other")):
        certificate(folder, name, signer)
    return folder


def robot(credentials: Path, **more: object) -> BusConfig:
    own = {
        "tls_ca": credentials / "ca.pem",
        "tls_listen_key": credentials / "robot.key",
        "tls_listen_certificate": credentials / "robot.pem",
    }
    return BusConfig(listen=(free_endpoint("tls"),), tls_mutual=True, **{k: str(v) for k, v in own.items()}, **more)


def visitor(credentials: Path, endpoint: str, name: str | None) -> BusConfig:
    own = (
        {}
        if name is None
        else {
            "tls_connect_key": str(credentials / f"{name}.key"),
            "tls_connect_certificate": str(credentials / f"{name}.pem"),
        }
    )
    return BusConfig(connect=(endpoint,), tls_ca=str(credentials / "ca.pem"), **own)


@pytest.mark.hazard("H44")
@needs_openssl
@pytest.mark.parametrize("name", ["stranger", None], ids=["wrong certificate", "no certificate"])
def test_refuses_connections_without_a_valid_certificate(credentials: Path, name: str | None) -> None:
    config = robot(credentials)
    with contextlib.closing(Bus(config)) as bus:
        bus.publish("odom", odometry(1))
        with Robot(settings=visitor(credentials, config.listen[0], "guest")) as guest:
            assert guest.alive
        with pytest.raises(Unreachable), Robot(settings=visitor(credentials, config.listen[0], name)) as intruder:
            assert not intruder.alive  # a client of TLS 1.3 may learn of it a moment later only
            raise Unreachable("connected, but receives nothing")


@contextlib.contextmanager
def commands_to(config: BusConfig) -> Iterator[list[str]]:
    received: list[str] = []
    with contextlib.closing(Bus(config)) as bus:

        def take(request: Request) -> None:
            received.append(request.topic)
            bus.answer(request.id, Answer(True, "armed"))

        bus.subscribe_commands(take, {})
        yield received


def asks_to_arm(driver: Driver) -> bool:
    """Return whether a program that asks to arm gets an answer."""
    try:
        return driver.arm(timeout_s=2.0).done
    except OmnidError:
        return False


@pytest.mark.hazard("H02")
@needs_openssl
def test_everyone_may_stop_and_named_certificates_may_drive_and_arm(credentials: Path) -> None:
    config = robot(credentials, command_names=("driver",))
    with (
        commands_to(config) as received,
        Robot(settings=visitor(credentials, config.listen[0], "guest")) as guest,
        Robot(settings=visitor(credentials, config.listen[0], "driver")) as driver,
    ):
        refused, accepted = guest.driver(), driver.driver()
        wait_until(lambda: refused.stop() is None and bool(received))
        wait_until(lambda: asks_to_arm(accepted) and "cmd/arm" in received)
        time.sleep(0.3)
        count = received.count("cmd/arm")
        for _ in range(5):
            refused.twist(1.0, 0.0)
            refused.heading(1.0, 0.0)
            assert not asks_to_arm(refused)
        guest.driver("planner").twist(1.0, 0.0)
        time.sleep(0.3)
        assert set(received) == {"cmd/stop", "cmd/arm"} and received.count("cmd/arm") == count
        assert guest.alive, "a client without the permission to drive can still subscribe"


@pytest.mark.hazard("H44", "H49")
def test_users_need_their_password_and_the_permission_to_drive(tmp_path: Path) -> None:
    (tmp_path / "users").write_text("ada:countess\nbob:builder\n")
    for name, password in (("ada", "countess"), ("bob", "builder"), ("eve", "builder")):
        (tmp_path / name).write_text(f"{password}\n")
    endpoint = free_endpoint()
    config = BusConfig(listen=(endpoint,), users_file=str(tmp_path / "users"), command_users=("ada",))

    def connected(name: str) -> Robot:
        return Robot(settings=BusConfig(connect=(endpoint,), user=name, password_file=str(tmp_path / name)))

    with commands_to(config) as received, connected("ada") as ada, connected("bob") as bob:
        drivers = bob.driver(), ada.driver()
        wait_until(lambda: not any(driver.twist(0.1, 0.0) for driver in drivers) and len(received) >= 3)
        time.sleep(0.2)
        count = len(received)
        for _ in range(5):
            drivers[0].twist(0.1, 0.0)
            assert not asks_to_arm(drivers[0])
        time.sleep(0.3)
        assert len(received) == count and asks_to_arm(drivers[1])
        for everything in ("**", "omnid/**", "**/@request/*", "omnid/@request/arm"):
            assert not list(bob._session.get(everything, payload=codec.header_cdr(time.time_ns()), timeout=1.0))
        assert len(received) == count + 1
        key, forged = "omnid/@request/arm", '{"done": false, "text": "forged"}'
        with bob._session.declare_queryable(key, lambda query: query.reply(key, forged)):
            assert all(asks_to_arm(drivers[1]) for _ in range(5)), "a stranger answers no request"
        wait_until(lambda: drivers[0].stop() is None and "cmd/stop" in received)
        with pytest.raises(Unreachable):
            connected("eve")
        with pytest.raises(Unreachable):
            Robot(connect=(endpoint,))


def test_drops_messages_that_others_publish_under_the_robots_name() -> None:
    """A forged pose that is sent to the robot is not forwarded to its subscribers."""
    config = BusConfig(listen=(free_endpoint(),))
    with contextlib.closing(Bus(config)) as bus, Robot(connect=config.listen) as listener:
        received: list[bytes] = []
        listener.on_message(lambda topic, payload, _: received.append(payload))
        with plain_client(config.listen[0]) as forger:

            def forge_and_publish() -> bool:
                forger.put("omnid/odom", b"forged")
                bus.publish("odom", odometry(1))
                return len(received) > 5

            wait_until(forge_and_publish)
    assert set(received) == {odometry(1)}


def test_passes_unknown_commands_on_to_be_counted() -> None:
    config = BusConfig(listen=(free_endpoint(),))
    with commands_to(config) as received, plain_client(config.listen[0]) as sender:
        wait_until(lambda: sender.put("omnid/cmd/dance", b"") is None and "cmd/dance" in received)


def plain_client(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in (("mode", "client"), ("connect/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
