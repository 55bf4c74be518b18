"""The zenoh bus: publishes CDR messages under the robot's name.

A session owns no thread of ours: whoever calls `publish` may wait up to zenoh's drop time (1 ms, 50 ms for fragmented
messages), so only one sink thread with its own bounded inbox calls it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import zenoh

from omnid.errors import OmnidError

_KEY = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")
_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws)/[^/\s]+:\d{1,5}([?#].*)?|unixsock-stream/\S+")
_SOURCE_LINE = re.compile(r"\s+at /\S+\.rs:\d+\.?")


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Where the bus is: keys are `<robot>/...`; this machine only, unless told otherwise."""

    robot: str = "omnid"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()


class Bus:
    """An open zenoh peer; endpoints to connect to may come and go, those to listen on must be free."""

    def __init__(self, config: BusConfig) -> None:
        """Opens the session; OmnidError where a name or an endpoint cannot be used."""
        if not _KEY.fullmatch(config.robot):
            raise OmnidError(f"bus.robot is {config.robot!r}; use letters, digits, '_', '.', '-' and inner '/'")
        _check_endpoints("bus.listen", config.listen)
        _check_endpoints("bus.connect", config.connect)
        self._robot = config.robot
        self._left = False
        self._session = _open(config)

    def publish(self, key_suffix: str, payload: bytes, realtime: bool = False) -> None:
        """Sends CDR bytes as `<robot>/<key_suffix>`; overtaking other traffic where realtime, dropped in congestion."""
        if not _KEY.fullmatch(key_suffix):
            raise OmnidError(f"bus key {key_suffix!r} cannot be sent; use letters, digits, '_', '.', '-', inner '/'")
        try:
            self._session.put(
                f"{self._robot}/{key_suffix}",
                payload,
                encoding=zenoh.Encoding.APPLICATION_CDR,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME if realtime else zenoh.Priority.DATA,
                express=True,
            )
        except zenoh.ZError as error:
            raise OmnidError(f"bus cannot publish {self._robot}/{key_suffix}: {_reason(error)}; restart") from error

    def subscribe(self, key_suffix: str, take: Callable[[str, bytes], None]) -> None:
        """Has take(key_suffix, payload) called for whatever comes as `<robot>/<key_suffix>`, in a thread of zenoh's."""

        def on_sample(sample: zenoh.Sample) -> None:
            take(key_suffix, sample.payload.to_bytes())

        self._session.declare_subscriber(f"{self._robot}/{key_suffix}", on_sample)

    def close(self) -> None:
        """Ends the session; a second call does nothing. A listener that hangs is left alone after zenoh's 10 s."""
        if not self._left:
            self._left = True
            with suppress(zenoh.ZError):  # told of such a listener: nothing is lost here
                self._session.close()  # type: ignore[no-untyped-call]  # the stub has no return type


def _check_endpoints(knob: str, endpoints: tuple[str, ...]) -> None:
    for endpoint in endpoints:
        if not _ENDPOINT.fullmatch(endpoint):
            raise OmnidError(f"{knob} has {endpoint!r}; write protocol/host:port, for example tcp/127.0.0.1:7447")


def _open(config: BusConfig) -> zenoh.Session:
    try:
        return zenoh.open(_zenoh_config(config))
    except zenoh.ZError as error:
        asked = ", ".join(config.listen)
        raise OmnidError(
            f"bus cannot listen on {asked}: {_reason(error)}; stop the other program there or change bus.listen"
        ) from error


def _zenoh_config(config: BusConfig) -> zenoh.Config:
    """A peer: a client would fail without a router. Shared memory only pays above 100 kB and leaves files behind."""
    settings = {
        "mode": "peer",
        "listen/endpoints": list(config.listen),
        "connect/endpoints": list(config.connect),
        "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    answer = zenoh.Config()
    for key, value in settings.items():
        answer.insert_json5(key, json.dumps(value))
    return answer


def _reason(error: zenoh.ZError) -> str:
    """zenoh's own words in one line, without the places in its source."""
    return " ".join(_SOURCE_LINE.sub("", str(error)).split())
