"""`omnid motor test`: find out how the motors are wired, wheel by wheel, and print the settings for that."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from omnid.commands.options import SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.controller.motor_settings import DriveSettings

_BEFORE = """The wheels will turn. Raise the robot so that none of them touches the ground, keep hands and hair away
from them, and have the emergency stop at hand. The daemon must not run. Ctrl-C stops the wheels. Type yes to begin: """


@command(
    option(
        "--motor",
        metavar="PORT",
        setting="motor.port",
        help="serial port of the controller, or 'simulated'; default: motor.port of the settings",
    ),
    option("--speed", type=float, default=0.1, metavar="MPS", help="of a wheel, m/s; default %(default)s"),
    option(
        "--turns",
        type=float,
        default=3.0,
        metavar="N",
        help="of the wheels for the scale, 0: do not test it; default %(default)s",
    ),
    *SETTINGS,
    examples=(
        "motor test --motor /dev/omnid/motor --config /etc/omnid/omnid.toml",
        "motor test --motor simulated --set motor.protocol=roboteq",
    ),
    description="Turn each motor forwards and back, ask which wheel moved and which way, then turn both wheels a "
    "number of times and ask for the true number. It prints the lines of the configuration that make the wheels turn "
    "as commanded.",
)
def run(args: argparse.Namespace) -> int:
    """Test the wiring and print the settings."""
    from drivers.motors.protocols.protocol_registry import motor_protocol
    from omnid.doctor.wheel_wiring import WiringTest

    config = settings_of(args).motor
    if not config.port:
        raise OmnidError("no motor controller is configured: name its port by --motor, or set motor.port")
    motor_protocol(config.protocol)  # known before anybody is asked to raise the robot
    test = WiringTest(config, ask, speed_mps=args.speed, turns=args.turns)
    if ask(_BEFORE).lower() != "yes":
        raise OmnidError("not begun: only `yes` starts the motors")
    drive = test.run()
    values = _lines(config.drive, drive)
    print("\n[motor.drive]", *(f"{key} = {value}" for key, value in values.items()), sep="\n")
    print("as it was set" if drive == config.drive else "different from the settings so far")
    return 0


def ask(question: str) -> str:
    """Print a question and return the answer. Raise OmnidError at the end of the input."""
    sys.stdout.write(question)
    sys.stdout.flush()
    line = sys.stdin.readline()
    if not line:
        raise OmnidError("no answer: the wheels stand")
    return line.strip()


def _lines(before: DriveSettings, drive: DriveSettings) -> dict[str, str]:
    """Return keys and TOML values: always those of the wiring, those of the scale only where the test changed them."""
    wiring = {name: str(getattr(drive, name)).lower() for name in ("swapped", "reverse_left", "reverse_right")}
    scale = {"gear": repr(drive.gear)} if drive.gear != before.gear else {}
    return wiring | scale
