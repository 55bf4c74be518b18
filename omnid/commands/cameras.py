"""`omnid cameras`: list the cameras, their modes, and a udev rule that gives them persistent names."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path("/")  # folder of sys and dev
_ADVICE = """
To name them /dev/omnid/lower and /dev/omnid/upper in whatever order they are plugged in, put this into {file}
(exchange lower and upper if they are the other way round), then run
`udevadm control --reload && udevadm trigger --subsystem-match=video4linux`:
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `cameras` to the command line."""
    parser = subparsers.add_parser("cameras", help="list cameras, their modes and the udev rule to copy")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the list; return 1 if there is no camera."""
    from drivers.cameras.v4l2_devices import RULES_FILE, capture_devices, describe_device, udev_rules

    devices = capture_devices(ROOT)
    if not devices:
        print("omnid: no cameras: the kernel has no capture device; check the cables and the output of `dmesg`",
              file=sys.stderr)
        return 1
    print("\n\n".join("\n".join(describe_device(device)) for device in devices))
    if rules := list(udev_rules(devices)):
        print(_ADVICE.format(file=RULES_FILE), *rules, sep="\n")
    return 0
