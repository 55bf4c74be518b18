"""`omnid cameras`: which cameras are there, what they offer, and the udev rule that gives them names that stay."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path("/")  # where sys and dev are
_ADVICE = """
To call them /dev/omnid/lower and /dev/omnid/upper whatever is plugged in first, put this into {file}
(exchange lower and upper where they are the other way round), then run
`udevadm control --reload && udevadm trigger --subsystem-match=video4linux`:
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `cameras` to the command line."""
    parser = subparsers.add_parser("cameras", help="list cameras, their modes and the udev rule to copy")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the list; 1 if there is none."""
    from drivers.cameras.v4l2_devices import RULES_FILE, capture_devices, describe_device, udev_rules

    devices = capture_devices(ROOT)
    if not devices:
        print("omnid: no cameras: the kernel knows no capture device; check the cables, and what `dmesg` says of them",
              file=sys.stderr)
        return 1
    print("\n\n".join("\n".join(describe_device(device)) for device in devices))
    if rules := list(udev_rules(devices)):
        print(_ADVICE.format(file=RULES_FILE), *rules, sep="\n")
    return 0
