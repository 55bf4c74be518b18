"""Runs of the stages, live, simulated or over a log: `omnid run`, `simulate`, `replay`, `demo`; and `omnid record`."""

from __future__ import annotations

import argparse
import logging
import math
from contextlib import closing
from dataclasses import replace
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from calib import se3
from calib.rig_file import read_rig, rig_toml
from calib.se2_arrays import transform
from drivers.cameras.log_camera import LogCamera, LogPlayback
from drivers.logs.log_reader import LogCameras, LogReader
from omnid.commands import options
from omnid.config import Config
from omnid.controller.motor import SIMULATED
from omnid.diagnostics.status import show_progress, summary_entries, timing_table
from omnid.engine.logging_setup import log
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.runs.live import ConnectedRobot, record_frames, run_live
from omnid.runs.replay import ReplayOptions, run_log
from omnid.runs.wiring import attached_rig
from omnid.simulation.paced_robot import PacedRobot
from omnid.simulation.robot import make_robot
from omnid.simulation.world import load_world
from omnid.sinks.files import check_outputs, write_trajectory


@options.command(options.MAP, options.SETTINGS)
def run(args: argparse.Namespace) -> int:
    """Run the daemon until a signal comes: live cameras in, poses on the bus, commands to the wheels.

    --rig FILE [cameras.rig]   the rig.toml of the cameras; default: that attached to the log, or without --log
        cameras.rig of the settings
    --motor PORT [motor.port]  serial port of the controller, or 'simulated'
    --log LOG                  use the images of a log instead of cameras, for a trial without wheels and gyro: in real
        time, forwards and backwards until it is stopped
    --lower DEVICE|TOPIC       device of the lower camera; default: cameras.lower of the settings; with --log the topic
        of its images, default: found by name
    --upper DEVICE|TOPIC       the same of the upper camera
    --pace FACTOR=1            speed of the log relative to its recording
    --once                     stop at the end of the log

    examples:
      run --config /etc/omnid/omnid.toml
      run --log drive.mcap --rig rig.toml --motor simulated
      run --lower /dev/video0 --upper /dev/video2 --rig rig.toml
    """
    devices = {"cameras.lower": args.lower, "cameras.upper": args.upper}
    config = options.settings_of(args, devices if args.log is None else {}, run="run")
    if args.log is None:
        if args.once or args.pace != 1.0:
            raise OmnidError("--once and --pace need the images of a log: add --log, or leave them out")
        run_live(config, ConnectedRobot(options.device_opener(config)))
        return 0
    return _run_log(args, replace(config, controller=config.controller.of_log))


def _run_log(args: argparse.Namespace, config: Config) -> int:
    """Run on the images of a log."""
    cameras = LogCameras(args.lower, args.upper, config.cameras.bits)
    playback, rig = LogPlayback(args.log, cameras, pace=args.pace, once=args.once), None
    for warning in playback.warnings:
        log(logging.WARNING, warning)
    if not args.rig:
        with closing(LogReader(args.log, cameras)) as reader:
            rig = attached_rig(reader, args.log)
    run_live(config, ConnectedRobot(partial(LogCamera, playback), plays_log=True), rig)
    return 0


@options.command(options.MAP, options.SETTINGS)
def simulate(args: argparse.Namespace) -> int:
    """Run the daemon with a simulated robot until a signal comes.

    Cameras, motor controller and gyro (motion.imu=off: none) are simulated. Everything else is as in `omnid run`: then
    `omnid arm`, `omnid drive`, `omnid goto`, `omnid web`. Simulated time waits for the daemon: a busy computer slows it
    down, and no image is lost.

    world WORLD               room, corridor, building, hall, office, clutter, door_80, person_passes, or a file *.toml
    --seed N=1 0..            of textures and noise
    --rig FILE                the rig.toml of the cameras; default: a straight rig
    --size PX=512 64..2048    of the images without --rig
    --no-people               leave the people of the world out
    --light FACTOR=1 0.05..3  factor on the light
    --truth FILE              write the true poses in odom, in the TUM format, at the end

    examples:
      simulate room
      simulate corridor --light 0.5 --map corridor.omap --set bus.robot=rover
    """
    check_outputs([("--truth", args.truth)] if args.truth else [], [])
    config = options.settings_of(args, run="run")
    # 1. Run in the world.
    world = load_world(args.world, args.seed)
    people = () if args.no_people else world.people
    world = replace(world, people=people, brightness=args.light * world.brightness)
    robot = make_robot(args.size, read_rig(args.rig) if args.rig else None)
    config = replace(config, motor=replace(config.motor, port=SIMULATED))
    paced = PacedRobot(world, robot, config, args.seed)
    log(logging.INFO, f"{world.name} is simulated until Ctrl-C: `omnid arm`, `omnid drive` ... in another terminal")
    run_live(config, paced, paced.rig)
    # 2. Write the truth, and report contacts.
    if args.truth:  # the poses of the base since the first one, with the stamps of the poses on the bus
        T = np.array([transform(np.array(pose)) for pose in paced.truth.values()]).reshape(-1, 4, 4)
        stamps_ns = np.array([paced.clock.unix_ns(stamp_ns) for stamp_ns in paced.truth], np.int64)
        write_trajectory(args.truth, stamps_ns, se3.inverse(T[:1]) @ T)
    log(logging.INFO, f"contacts with obstacles: {paced.contacts}")
    return 0


@options.command(options.VERBOSE, options.QUIET, options.LOG, options.MAP, options.SETTINGS, options.JSON)
def replay(args: argparse.Namespace) -> int:
    """Run a recorded log through the stages of the daemon, and print a summary.

    Exit code 1: no pose was found, more than a tenth of the pairs is missing, or records of the log are damaged.

    log LOG              an .mcap, .db3 or .bag file, a folder with one or with its parts, or a folder with a folder of
        stamped images for each camera
    --start-s S=0 0..    leave out the first S seconds
    --seconds S 0.001..  read so many seconds only; default: to the end

    outputs:
    --tum FILE            trajectory, T_odom_rig, one row for every pair
    --map-tum FILE        trajectory in the map, T_map_rig: places that are recognised correct all poses before them
    --cloud FILE.ply      the map's points with confidence and age
    --plan FILE.png       the map from above with the path
    --record FILE.mcap    poses, transforms, states and map
    --rerun FILE.rrd      path, images with features, depth and plots for the viewer Rerun; not beside --record
    --publish             publish on the bus as `<robot>/odom` and so on; off by default, because a robot's daemon
        publishes there

    computation:
    --method default|paper [odometry.method]   paper: the odometry of the paper on its enhanced SAD, for comparison
    --tracker improved|klt [odometry.tracker]  feature tracker of the paper's method
    --inline    one thread, one pair after the other; same results
    --realtime  at the speed of the recording, where the computer is fast enough

    examples:
      replay drive.mcap --rig rig.toml --tum est.txt --cloud map.ply --plan plan.png
      replay drive.mcap --record out.mcap --method paper
      replay drive.mcap --rerun out.rrd
      replay drive.mcap --start-s 60 --seconds 20
    """
    config = options.settings_of(args, run="replay")
    given = ("rig", "tum", "map_tum", "cloud", "plan", "record", "publish", "inline")
    asked = ReplayOptions(
        **{name: vars(args)[name] for name in given},
        topics=(args.lower, args.upper),
        span_s=(args.start_s, math.inf if args.seconds is None else args.start_s + args.seconds),
        paced=args.realtime,
        settings=args.config,
    )
    if args.rerun is None:
        return replay_and_print(args.log, config, asked, args)
    if args.record is not None:
        raise OmnidError("--rerun and --record exclude each other: replay the log once for each")
    from omnid.commands.recordings import sink_of

    with closing(sink_of(args.rerun, args.log)) as sink:
        from omnid.viewer.rerun_sink import ReplayDrawing

        drawing = partial(ReplayDrawing, sink, config.obstacles.scan.max_range_m)
        drawn = replace(asked, map_every_s=config.live.cloud_s, observer=drawing)
        return replay_and_print(args.log, config, drawn, args)


def replay_and_print(log: Path, config: Config, asked: ReplayOptions, args: argparse.Namespace) -> int:
    """Replay a log, print warnings on stderr and the summary on stdout, and return the exit code.

    args: --quiet, --verbose, and perhaps --json.
    """
    result = run_log(log, config, asked if args.quiet else replace(asked, progress=show_progress))
    for warning in result.warnings:
        options.warn(warning)
    if getattr(args, "json", False):
        found = {name: getattr(result, name) for name in ("counters", "warnings", "signal", "elapsed_s")}
        options.print_json(found | {"timings": result.timings})
    else:
        entries = summary_entries(result.counters, verbose=args.verbose)
        pairs_hz = result.counters.pairs / max(1e-3, result.elapsed_s)
        entries["speed"] = f"{pairs_hz:.1f} pairs/s, in {result.elapsed_s:.1f} s"
        written = [*(path for _, path in asked.files), result.map_file, getattr(args, "rerun", None)]
        if any(written):
            entries["written"] = ", ".join(str(path) for path in written if path)
        lines = [f"{name:<9} {text}" for name, text in entries.items()]
        print(*(timing_table(result.timings) if args.verbose else ()), *lines, sep="\n")
    return 128 + result.signal if result.signal else int(result.counters.no_pose or bool(result.counters.loss))


@options.command(options.VERBOSE, options.QUIET, options.SETTINGS)
def demo(args: argparse.Namespace) -> int:
    """Replay a sample in real time, with files and bus, and print its errors.

    --output FOLDER=omnid-demo  folder of the output files

    examples:
      demo
      demo --output /tmp/demo --quiet
    """
    args.output.mkdir(parents=True, exist_ok=True)
    tum = args.output / "trajectory.tum"
    asked = ReplayOptions(
        tum=tum,
        cloud=args.output / "map.ply",
        plan=args.output / "plan.png",
        record=args.output / "log.mcap",
        publish=True,
        paced=True,
        settings=args.config,
    )
    config = options.settings_of(args)
    sample = files("omnid.sample")
    with as_file(sample / "log.mcap") as log, as_file(sample / "truth.txt") as truth:
        code = replay_and_print(log, config, asked, args)
        if code == 0:
            print(f"\nagainst the truth:\n{evaluate(read_tum(tum), read_tum(truth))}")
    return code


@options.command(options.SETTINGS)
def record(args: argparse.Namespace) -> int:
    """Record both cameras to MCAP files until Ctrl-C; exit code 1: nothing was recorded.

    folder [FOLDER] [record.folder]  folder of the files; default: record.folder of the settings
    --rig FILE [cameras.rig]         a rig.toml to attach; default: cameras.rig of the settings, if it exists
    --lower DEVICE [cameras.lower]   the lower camera; default: cameras.lower of the settings
    --upper DEVICE [cameras.upper]   the upper camera; default: cameras.upper of the settings

    examples:
      record recordings/ --rig rig.toml
      record boards/ --lower /dev/video0 --upper /dev/video2
    """
    config = options.settings_of(args)
    path, rig = Path(config.cameras.rig), ""
    if args.rig is not None or path.exists():
        rig = rig_toml(read_rig(path))
    else:  # the recording may be for its calibration
        log(logging.WARNING, f"no rig is attached because {path} does not exist: `omnid replay` will need --rig")
    open_camera = options.device_opener(config)
    with closing(open_camera("lower")) as lower, closing(open_camera("upper")) as upper:
        state = record_frames({"lower": lower, "upper": upper}, config, rig).state
    return 0 if state.messages > state.lost else 1
