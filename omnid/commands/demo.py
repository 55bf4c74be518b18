"""`omnid demo`: replay the sample log in real time with all outputs, compared with the truth; or drive a simulation."""

from __future__ import annotations

import argparse
from importlib.resources import as_file, files
from pathlib import Path

from omnid.commands.options import QUIET, SETTINGS, command, option, settings_of
from omnid.commands.replay import Output, replay_and_print
from omnid.errors import OmnidError

DRIVE_S = 90.0  # Longest drive in simulated time.


@command(
    option(
        "--output",
        type=Path,
        default=Path("omnid-demo"),
        metavar="FOLDER",
        help="folder of the output files; default %(default)s",
    ),
    option(
        "--drive",
        action="store_true",
        help="a simulated robot is taught a route of 6 m and repeats it; takes a minute or two, and writes drive.png "
        "with both true paths",
    ),
    option("--seed", type=int, default=1, help="with --drive: of the world and its noise; default %(default)s"),
    option("--verbose", action="store_true", help="print all counters, and the times of all stages"),
    QUIET,
    *SETTINGS,
    examples=("demo", "demo --drive", "demo --output /tmp/demo --quiet"),
)
def run(args: argparse.Namespace) -> int:
    """Replay the sample and print its errors against the truth; or drive."""
    if args.drive:
        return _drive(args)
    from omnid.formats.tum import read_tum
    from omnid.recordings.evaluation import evaluate
    from omnid.runs.replay import ReplayOptions

    _make_folder(args.output)
    tum = args.output / "trajectory.tum"
    options = ReplayOptions(
        tum=tum,
        cloud=args.output / "map.ply",
        plan=args.output / "plan.png",
        record=args.output / "log.mcap",
        publish=True,
        bus_optional=True,
        paced=True,
        settings=args.config,
    )
    args.overrides = ["motor.port=simulated", "controller.setpoint.velocity_mps=0.3", *args.overrides]
    config = settings_of(args)
    sample = files("omnid.sample")
    with as_file(sample / "log.mcap") as log, as_file(sample / "truth.txt") as truth:
        code = replay_and_print(log, config, options, Output(args.quiet, args.verbose))
        if code == 0:
            print(f"\nagainst the truth:\n{evaluate(read_tum(tum), read_tum(truth))}")
    return code


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OmnidError(f"--output {folder}: cannot be made ({error.strerror}); name another folder") from error


def _drive(args: argparse.Namespace) -> int:
    """Drive a simulated robot; print the errors against the truth, and draw both paths."""
    import cv2
    import numpy as np

    from omnid.engine.kernel_cache import prepare_kernels
    from omnid.navigation_state import NavigationState
    from omnid.simulation.demonstration import TeachAndRepeat, both_paths, cross_track_m, draw, drift_m, seen_obstacles
    from omnid.simulation.lockstep import simulate
    from omnid.simulation.robot import make_robot
    from omnid.simulation.world_file import load_world

    if args.seed < 0:
        raise OmnidError(f"--seed {args.seed}: expected 0 or more")
    _make_folder(args.output)
    place_map, routes, image = (args.output / name for name in ("demo.omap", "routes", "drive.png"))
    config = settings_of(args, {"places.map": place_map, "navigation.routes": routes})
    place_map.unlink(missing_ok=True)  # of an earlier demonstration
    world, robot = load_world("room", args.seed), make_robot()
    prepare_kernels()  # which says so where it takes long
    if not args.quiet:
        print("a simulated robot is taught an oval and repeats it, in its own\ntime: a minute or two", flush=True)
    script = TeachAndRepeat(lambda line: None if args.quiet else print(line, flush=True))
    run = simulate(world, robot, script, seconds=DRIVE_S, seed=args.seed, config=config)
    first, second = both_paths(run, script.repeated_s)
    if not cv2.imwrite(str(image), draw(world, seen_obstacles(run), first, second)):
        raise OmnidError(f"{image}: cannot be written; name another folder by --output")
    end = script.end or f"not reached within {DRIVE_S:g} s"
    print(f"end       {end}, contacts with obstacles: {len(run.contacts)}")
    print(f"pose      {100 * drift_m(run):.1f} cm off at the end")
    if len(second):
        off_cm = 100 * cross_track_m(first, second)
        print(f"repeated  {np.percentile(off_cm, 95):.1f} cm off the taught path (95 %), {off_cm.max():.1f} at most")
    print(f"written   {image}, {place_map}")
    return 0 if script.end == NavigationState.REACHED else 1
