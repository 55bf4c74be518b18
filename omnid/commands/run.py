"""`omnid run`: the daemon on the robot."""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter, defaultdict
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import MAP, SETTINGS, cameras, command, device_opener, option, settings_of
from omnid.errors import OmnidError

RUNNING = 2  # time that the cameras are opened: first for the masks, then for the run

if TYPE_CHECKING:  # the help and other commands do not load these
    from calib.rig import Rig
    from drivers.cameras.log_camera import LogCamera, LogMotion
    from drivers.frame import Camera
    from omnid.config import Config
    from omnid.runs.live import OpenCamera


@command(
    option(
        "--rig",
        type=Path,
        setting="cameras.rig",
        help="the rig.toml of the cameras; default: that attached to the log, or without --log cameras.rig of the "
        "settings",
    ),
    option("--motor", metavar="PORT", setting="motor.port", help="serial port of the controller, or 'simulated'"),
    option(
        "--log",
        type=Path,
        metavar="LOG",
        help="use the images of a log instead of cameras, for a trial: in real time, forwards and backwards until it "
        "is stopped",
    ),
    *cameras(
        "device of the {camera} camera; default: cameras.{camera} of the settings; with --log the topic of its images, "
        "default: found by name",
        "DEVICE|TOPIC",
    ),
    option("--pace", type=float, default=1.0, help="speed of the log relative to its recording; default %(default)s"),
    option("--once", action="store_true", help="stop at the end of the log"),
    MAP,
    *SETTINGS,
    examples=(
        "run --config /etc/omnid/omnid.toml",
        "run --log drive.mcap --rig rig.toml --motor simulated",
        "run --lower /dev/video0 --upper /dev/video2 --rig rig.toml",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Run until a signal comes."""
    from omnid.engine.process import use_one_malloc_arena

    use_one_malloc_arena()  # first: the next imports load numpy, which starts threads
    from omnid.config import unused_settings
    from omnid.engine.logging_setup import HANDLER, log
    from omnid.runs.live import ConnectedRobot, LiveRun

    devices = {"cameras.lower": args.lower, "cameras.upper": args.upper}
    config = settings_of(args, devices if args.log is None else {})
    for warning in unused_settings(config, "run", args.overrides):
        log(logging.WARNING, warning)
    show = HANDLER.show if sys.stderr.isatty() else None
    if args.log is None:
        if args.once or args.pace != 1.0:
            raise OmnidError("--once and --pace need the images of a log: add --log, or leave them out")
        return LiveRun(config, ConnectedRobot(device_opener(config)), log, show=show).run()
    config = replace(config, controller=config.controller.of_log)
    opener, motion = _recorded(args, config)
    robot = ConnectedRobot(opener, motion)
    return LiveRun(config, robot, log, None if args.rig else _attached_rig(args), show).run()


def _attached_rig(args: argparse.Namespace) -> Rig:
    from drivers.logs.log_reader import LogReader
    from omnid.runs.session import attached_rig

    with closing(LogReader(args.log, args.lower, args.upper)) as reader:
        return attached_rig(reader, args.log)


def _recorded(args: argparse.Namespace, config: Config) -> tuple[OpenCamera, LogMotion]:
    """Return what opens the cameras of a log, and its wheels and gyro: no others fit its images."""
    from drivers.cameras.log_camera import LogCamera, LogClock, LogImages, LogMotion
    from omnid.engine.logging_setup import log
    from omnid.runs.sensor_sources import motion_topics

    images = LogImages.load(args.log, args.lower, args.upper, motion_topics(config), config.cameras.bits)
    for warning in images.warnings:
        log(logging.WARNING, warning)
    clocks: defaultdict[int, LogClock] = defaultdict(LogClock)  # one for each time that both cameras are opened
    opened: Counter[Camera] = Counter()

    def open_camera(camera: Camera) -> LogCamera:
        opened[camera] += 1
        return LogCamera(images, camera, clocks[opened[camera]], pace=args.pace, once=args.once)

    return open_camera, LogMotion(images, clocks[RUNNING], pace=args.pace, once=args.once)
