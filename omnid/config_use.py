"""Settings that one command uses and another ignores: a warning, or an error where they were asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from omnid.config import Config
from omnid.errors import OmnidError
from omnid.settings import changed

# Keys and sections that only one of `omnid run` and `omnid replay` uses; the longest path counts. "": both use it.
USED_ONLY_BY: Final[Mapping[str, str]] = MappingProxyType(
    {
        "bus.panorama_hz": "run",
        "cameras": "run",
        "controller.arming": "run",
        "controller.setpoint": "replay",
        "controller.sources": "run",
        "graph.depth": "replay",
        "live": "run",
        "log": "replay",
        "places.save_s": "run",
        "navigation": "run",
        "realtime": "run",
        "record": "run",
        "record.cloud_points": "",
        "rig": "run",
        "rig.check": "",
        "service": "run",
    }
)


def unused_settings(config: Config, command: str, overrides: Sequence[str]) -> list[str]:
    """Return the warning, if there is one, that a command ignores settings of the configuration file.

    command: run or replay. Raises OmnidError for an override that the command ignores, and for a setpoint in `run`:
    a robot must not be expected to drive by itself.
    """
    for override in overrides:
        path = ".".join(part.strip() for part in override.partition("=")[0].split("."))
        if _ignores(command, path):
            raise OmnidError(f"override {override!r}: `omnid {command}` does not use {path}: leave it out")
    ignored = [path for path in changed(config) if _ignores(command, path)]
    if command == "run":
        for path in ignored:
            if path.startswith("controller.setpoint."):
                raise OmnidError(
                    f"{path} is set, but `omnid run` drives by the setpoints that it receives, as "
                    "cmd/twist or cmd/heading: remove it from the configuration"
                )
    return [f"`omnid {command}` does not use these settings: {', '.join(ignored)}"] if ignored else []


def _ignores(command: str, path: str) -> bool:
    """True if only the other command uses the key."""
    parts = path.split(".")
    for depth in range(len(parts), 0, -1):
        only = USED_ONLY_BY.get(".".join(parts[:depth]))
        if only is not None:
            return only not in ("", command)
    return False
