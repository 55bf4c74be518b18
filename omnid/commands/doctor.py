"""`omnid doctor`: check all that the daemon needs, with advice where something is missing."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import JSON, SETTINGS, command, print_json, settings_of

if TYPE_CHECKING:
    from omnid.config import Config
    from omnid.doctor.finding import Finding

ROOT = Path("/")  # folder of sys, dev and proc
BYTES_PER_PIXEL = 0.3  # upper bound for a JPEG of a textured image


@command(*SETTINGS, JSON, examples=("doctor --config /etc/omnid/omnid.toml",))
def run(args: argparse.Namespace) -> int:
    """Print a line for each check; return 1 if something is wrong."""
    from omnid.doctor.finding import summary

    found: list[Finding] = []
    for finding in examine(settings_of(args)):
        if not args.json:
            print(finding, flush=True)
        found.append(finding)
    if args.json:
        print_json(found)
    else:
        print(summary(found))
    return int(any(finding.level == "error" for finding in found))


def examine(config: Config) -> Iterator[Finding]:
    """Return the findings of all checks, the quick ones first."""
    from drivers.cameras.v4l2_device import capture_devices
    from omnid.doctor import devices, machine

    camera, wanted = config.cameras, config.realtime
    named = {name: camera.settings(name) for name in ("lower", "upper")}
    yield from devices.cameras(named, capture_devices(ROOT), ROOT)
    yield from machine.rig(Path(camera.rig), (camera.width_px, camera.height_px), config.obstacles.ring.floor_m)
    yield from devices.motor(config.motor, ROOT)
    yield from machine.rights(max(wanted.motor_priority, wanted.capture_priority), wanted.lock_memory)
    yield machine.clock()
    yield machine.compiled_functions()
    rate = 2 * camera.width_px * camera.height_px * BYTES_PER_PIXEL * (camera.rate_hz or 30.0)
    yield from machine.disk(machine.STATE / config.record.folder, config.record, rate)
    yield machine.bus(config.bus)
