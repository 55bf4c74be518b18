"""`omnid view`: show path, map, images with features, depth and plots in rerun."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.listen import check_seconds
from omnid.commands.options import QUIET, RIG, ROBOT, SECONDS, SETTINGS, cameras, command, group, option, settings_of
from omnid.commands.replay import Output, replay_and_print
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.config import Config
    from omnid.viewer.targets import ViewerTarget


@command(
    option(
        "log",
        type=Path,
        nargs="?",
        metavar="LOG",
        help="a recording, which is shown as it stands, or a log of images, which goes through the stages; without "
        "one, a robot is listened to",
    ),
    group(
        "output; default: a window",
        option(
            "-o",
            "--output",
            type=Path,
            metavar="FILE.rrd",
            help="a file that `rerun FILE.rrd` opens, here or elsewhere; needs no display",
        ),
        option("--web", action="store_true", help="a browser of this machine"),
        option(
            "--port",
            type=int,
            default=0,
            metavar="N",
            help="of --web: serve the page at port N and its data at N + 1, for ssh -L; default: any free ones",
        ),
    ),
    group(
        "a log",
        option("--topic", metavar="TOPIC", help="the odometry topic of a recording, where there are several"),
        option("--replay", action="store_true", help="compute again from the images of a recording"),
        RIG,
        *cameras(),
        QUIET,
    ),
    group("a robot", *ROBOT, SECONDS),
    *SETTINGS,
    examples=("view out.mcap", "view out.mcap -o out.rrd", "view out.mcap --web --port 9090"),
)
def run(args: argparse.Namespace) -> int:
    """Show the log or the robot; return 1 if there was no pose to show."""
    _refuse_contradictions(args)
    _require_rerun()
    from omnid.viewer.view import check_file, show_robot, target_for

    config = settings_of(args)
    check_file(
        args.output,
        ("the log that is read", args.log),
        ("the rig that is read", args.rig),
        ("the configuration that is read", args.config),
    )
    place = target_for(args.output, args.web, args.port)
    if args.log is not None:
        return _log(args, config, place)
    code = show_robot(config.bus, args.seconds, place)
    if code == 1:
        print(
            f"omnid: no pose of {config.bus.robot} came: `omnid listen` names those that are there",
            file=sys.stderr,
        )
    return code


def _log(args: argparse.Namespace, config: Config, place: ViewerTarget) -> int:
    from functools import partial

    from omnid.viewer.view import Log, show_log

    log = Log(
        args.log,
        robot=args.robot,
        topic=args.topic,
        replay=args.replay,
        rig=args.rig,
        topics=(args.lower, args.upper),
        settings=args.config,
    )
    return show_log(log, config, place, partial(replay_and_print, output=Output(quiet=args.quiet)))


def _refuse_contradictions(args: argparse.Namespace) -> None:
    live = {"--connect": args.connect, "--seconds": args.seconds}
    of_log = {
        "--topic": args.topic,
        "--replay": args.replay,
        "--rig": args.rig,
        "--lower": args.lower,
        "--upper": args.upper,
    }
    wrong = [name for name, value in (of_log if args.log is None else live).items() if value]
    if wrong:
        instead = "name a LOG as well" if args.log is None else "leave out the LOG to show a robot"
        raise OmnidError(f"{wrong[0]} does not go with {'a robot' if args.log is None else args.log}: {instead}")
    if args.output is not None and args.web:
        raise OmnidError("-o and --web exclude each other: leave one of them out")
    if args.port and not args.web:
        raise OmnidError("--port belongs to --web: add it, or leave the port out")
    if not 0 <= args.port < 65535:
        raise OmnidError(f"--port {args.port}: expected a port of 1 to 65534")
    check_seconds(args.seconds)


def _require_rerun() -> None:
    import os
    from importlib.util import find_spec

    if find_spec("rerun") is None:
        raise OmnidError(
            f"omnid view draws with rerun, which is not installed: {sys.executable} -m pip install 'rerun-sdk>=0.41'"
        )
    os.environ.setdefault("RUST_LOG", "off")  # omnid reports errors of rerun itself
