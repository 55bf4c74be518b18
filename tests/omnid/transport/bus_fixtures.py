"""Fixtures for tests of the bus: endpoints, messages, sessions, a router and subscribers that do not import omnid."""

from __future__ import annotations

import contextlib
import json
import random
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import zenoh

from calib import se3
from omnid.client import Robot
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.topics import Request
from tests.ports import free_port

DEADLINE_S = 30.0

ROUTER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("ready", flush=True)
    time.sleep(1000)
"""


def free_endpoint(protocol: str = "tcp") -> str:
    return f"{protocol}/127.0.0.1:{free_port()}"


def odometry(i: int) -> bytes:
    """Encode a different pose for each i, with i in the nanoseconds of its stamp."""
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.1 * i]), [0.25 * i, -1.0, 0.0])
    return codec.odometry_cdr(10**9 + i, T, np.eye(6) * i, np.arange(6.0), np.eye(6))


@contextlib.contextmanager
def script(text: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program in another process; yield when it has printed that it is ready."""
    with subprocess.Popen([sys.executable, "-c", text, *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def session(**settings: object) -> Iterator[zenoh.Session]:
    """Open a zenoh session; double underscores in the names stand for slashes."""
    config = zenoh.Config()
    defaults = {"scouting__multicast__enabled": False, "transport__shared_memory__enabled": False}
    for key, value in (defaults | settings).items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    opened = zenoh.open(config)
    try:
        yield opened
    finally:
        opened.close()  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def robot() -> Iterator[tuple[Bus, Robot, list[Request]]]:
    """Yield a bus that keeps what comes, and a program on it."""
    endpoint, received = free_endpoint(), list[Request]()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as program:
        bus.subscribe_commands(received.append)
        yield bus, program, received


def damaged(rng: random.Random, good: bytes) -> bytes:
    """Return bytes of which some are changed, or the last ones are missing."""
    data = bytearray(good)
    for _ in range(rng.randint(0, 8)):
        data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data[: rng.randint(0, len(data))]) if rng.random() < 0.3 else bytes(data)
