"""`omnid run`: the daemon on the robot."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.config import add_settings

if TYPE_CHECKING:  # whoever asks for another command does not load the daemon
    from omnid.config import Config
    from omnid.live import Opener


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `run` to the command line."""
    parser = subparsers.add_parser("run", help="the daemon: two live cameras, poses on the bus, commands to the wheels")
    parser.add_argument("--rig", type=Path, help="the rig.toml of the cameras; default: cameras.rig of the settings")
    parser.add_argument("--motor", metavar="PORT", help="serial port of the controller, or 'simulated'")
    parser.add_argument("--log", type=Path, metavar="LOG", help="pictures of a log in the place of cameras, to try it "
                        "out: in real time, forwards and backwards until it is stopped")
    parser.add_argument("--pace", type=float, default=1.0, help="how many times as fast as it was recorded")
    parser.add_argument("--once", action="store_true", help="end with the log")
    add_settings(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Runs until it is told to end."""
    from omnid.config import Config
    from omnid.live import Live
    from omnid.settings import load

    named = {"cameras.rig": args.rig, "motor.port": args.motor}
    shortcuts = [f"{key}={value}" for key, value in named.items() if value is not None]
    config = load(Config, args.config, [*args.overrides, *shortcuts])
    cameras = _recorded(args) if args.log else _devices(config)
    return Live(config, cameras, _say).run()


def _say(severity: int, text: str) -> None:
    print(f"omnid: {text}", file=sys.stderr, flush=True)


def _devices(config: Config) -> Opener:
    from drivers.v4l2_camera import V4l2Camera

    return lambda camera: V4l2Camera(config.cameras.settings(camera), camera, report=_say)


def _recorded(args: argparse.Namespace) -> Opener:
    from drivers.log_camera import LogCamera, Pictures

    pictures = Pictures.of(args.log)
    epoch_ns = time.monotonic_ns()
    return lambda camera: LogCamera(pictures, camera, epoch_ns, pace=args.pace, once=args.once)
