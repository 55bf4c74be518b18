"""`omnid simulate`: the daemon with a simulated robot in a simulated world, for users without a robot."""

from __future__ import annotations

import argparse
import logging
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import MAP, SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from collections.abc import Callable

    from drivers.motors.simulated.simulated_base import Pose


@command(
    option("world", help="room, corridor, building, hall, or a file *.toml (docs/drive.md)"),
    option("--seed", type=int, default=1, help="of textures and noise; default %(default)s"),
    option("--rig", type=Path, help="the rig.toml of the cameras; default: a straight rig"),
    option("--size", type=int, default=512, metavar="PX", help="of the images without --rig; default %(default)s"),
    option("--no-people", action="store_true", help="leave the people of the world out"),
    option("--light", type=float, default=1.0, help="factor on the light; default %(default)s"),
    option(
        "--other-posters",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the posters that is exchanged, 0 to 1; default %(default)s",
    ),
    option("--truth", type=Path, metavar="FILE", help="write the true poses in odom, in the TUM format, at the end"),
    MAP,
    *SETTINGS,
    examples=("simulate room", "simulate corridor --light 0.5 --map corridor.omap --set bus.robot=rover"),
    description="Run the daemon with a simulated robot: cameras, motor controller and gyro (motion.imu=off: none) are "
    "simulated. Everything else is as in `omnid run`: then `omnid arm`, `omnid drive`, `omnid goto`, `omnid web`. "
    "Simulated time waits for the daemon: a busy computer slows it down, and loses nothing.",
)
def run(args: argparse.Namespace) -> int:
    """Run until a signal comes."""
    from omnid.engine.process import use_one_malloc_arena

    use_one_malloc_arena()  # first: the next imports load numpy, which starts threads
    from calib.rig_file import read_rig
    from omnid.config import unused_settings
    from omnid.controller.motor import SIMULATED
    from omnid.engine.logging_setup import HANDLER, log
    from omnid.runs.live import LiveRun
    from omnid.simulation.paced_robot import PacedRobot
    from omnid.simulation.robot import make_robot
    from omnid.simulation.world_file import WorldOptions, load_world
    from omnid.sinks.files import check_outputs

    # 1. Check the options.
    check_outputs([("--truth", args.truth)] if args.truth else [], [])
    config = settings_of(args)
    for warning in unused_settings(config, "run", args.overrides):
        log(logging.WARNING, warning)
    if args.seed < 0:
        raise OmnidError(f"--seed {args.seed}: expected 0 or more")
    if not 64 <= args.size <= 2048:
        raise OmnidError(f"--size {args.size}: expected 64 to 2048 px")
    # 2. Run in the world.
    options = WorldOptions(people=not args.no_people, brightness=args.light, other_posters=args.other_posters)
    world = load_world(args.world, args.seed, options)
    robot = make_robot(args.size, read_rig(args.rig) if args.rig else None)
    config = replace(config, motor=replace(config.motor, port=SIMULATED))
    paced = PacedRobot(world, robot, config, args.seed, partial(log, logging.WARNING))
    run = LiveRun(config, paced, log, paced.rig, HANDLER.show if sys.stderr.isatty() else None)
    code = run.run()
    # 3. Write the truth, and report contacts.
    if args.truth:
        _write_truth(args.truth, paced.drive.truth, run.clock.unix_ns)
    log(logging.INFO, f"contacts with obstacles: {paced.drive.contacts}")
    return code


def _write_truth(path: Path, truth: dict[int, Pose], unix_ns: Callable[[int], int]) -> None:
    """Write the true poses of the base since the first one, with the stamps of the poses on the bus."""
    import numpy as np

    from calib import se3
    from omnid.sinks.files import write_trajectory

    poses = np.array(list(truth.values())).reshape(-1, 3)
    zero = np.zeros(len(poses))
    R = se3.rotation_exp(np.column_stack([zero, zero, poses[:, 2]]))
    T = se3.transform(R, np.column_stack([poses[:, :2], zero]))
    write_trajectory(path, np.array([unix_ns(stamp_ns) for stamp_ns in truth], np.int64), se3.inverse(T[:1]) @ T)
