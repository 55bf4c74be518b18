"""Other robots of the same name: each robot declares a liveliness token with the identity of its session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import zenoh

from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from omnid.transport.session import open_session

ALIVE: Final = "alive"  # Key below the robot's name.
MOST_NAMESAKES: Final = 64  # Most that are distinguished; anyone may declare tokens where no users are configured.
_ALIVE_TIMEOUT_S: Final = 1.0


class Namesakes:
    """Watches for other robots of the same name. They keep this one from being armed, never from starting.

    Where the configuration names users or certificates, zenoh drops the tokens of others below this name.
    """

    def __init__(self, session: zenoh.Session, config: BusConfig, on_first: Callable[[], None]) -> None:
        """Declare the own tokens; on_first: called, in a zenoh thread or here, when the name is no longer unique."""
        self._config, self._on_first = config, on_first
        self._own = f"{config.robot}/{ALIVE}/{session.zid()}"
        self._names = f"{config.robot}/{ALIVE}/*"
        self._seen: set[str] = set()  # tokens of others
        self._behind: set[str] = set()  # those seen through a router that this session shares with them only
        liveliness = session.liveliness()
        self._declared = [
            liveliness.declare_token(self._own),
            liveliness.declare_subscriber(self._names, self._on_token, history=True),
            liveliness.declare_token(f"{config.robot}/{ALIVE}"),
        ]
        self.search()

    def __len__(self) -> int:
        """Return the number of other robots of this name."""
        return len(self._seen | self._behind)

    def search(self) -> None:
        """Search behind the router of a peer, as a client: peers that share a router do not see each other."""
        if self._config.mode == "client" or not self._config.connect:
            return
        try:
            client = open_session(replace(self._config, mode="client", listen=()), guarded=False)
        except OmnidError:  # no router yet
            return
        try:
            replies = client.liveliness().get(self._names, timeout=_ALIVE_TIMEOUT_S)
            found = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        finally:
            client.close()  # type: ignore[no-untyped-call]  # the stub has no return type
        before, self._behind = len(self), set(sorted(found - {self._own})[:MOST_NAMESAKES])
        if self._behind and not before:
            self._on_first()

    @property
    def behind_router(self) -> bool:
        """True if one was found by `search`, which alone finds out that it has gone."""
        return bool(self._behind)

    def _on_token(self, sample: zenoh.Sample) -> None:
        key, before = str(sample.key_expr), len(self)
        if sample.kind == zenoh.SampleKind.DELETE:
            self._seen.discard(key)
        elif key != self._own and len(self._seen) < MOST_NAMESAKES:
            self._seen.add(key)
            if not before:
                self._on_first()
