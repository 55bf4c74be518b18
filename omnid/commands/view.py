"""A recording in images: `omnid report` writes a page about it, `omnid view` draws it, or a robot, in Rerun."""

from __future__ import annotations

import argparse
import math
import os
import socket
import subprocess
import sys
import time
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.atomic_file import write_file
from drivers.errors import FrameDecodeError
from omnid.client import Robot
from omnid.commands.options import ROBOT, SECONDS, SETTINGS, command, failed, settings_of, warn
from omnid.config import Config
from omnid.engine.process import handle_stop_signals, python, python_environment
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum
from omnid.monitor.robot_state import RobotState
from omnid.plain_text import plain
from omnid.recordings.recording import CLOUD, ODOMETRY, STATUS, RecordingReader
from omnid.report.recorded_run import RecordedRun
from omnid.report.report import report_html
from omnid.sinks.files import check_outputs
from omnid.transport.topics import MAP_POSE, PANORAMA, SCAN

if TYPE_CHECKING:  # it imports rerun, which may be missing
    from omnid.viewer.rerun_sink import RerunSink


@command(ROBOT, SECONDS, SETTINGS)
def run(args: argparse.Namespace) -> int:
    """Show a recording or a robot: path, map, images, plots (needs rerun). Exit code 1: there was no pose to show.

    log [LOG]               a recording, which is shown as it stands (of a log of images: `omnid replay LOG --rerun
        FILE.rrd`); without one, a robot is listened to
    -o, --output FILE.rrd   a file that `rerun FILE.rrd` opens, here or elsewhere; default: a window
    --topic TOPIC           the odometry topic of a recording, where there are several

    examples:
      view out.mcap
      view out.mcap -o out.rrd
      view --robot rover --connect tcp/robot:7447
    """
    config = settings_of(args)
    with closing(sink_of(args.output, args.log)) as sink:
        if args.log is None:
            _draw_robot(sink, config, math.inf if args.seconds is None else args.seconds)
        else:
            _draw_recording(sink, args.log, args.topic, args.robot)
    if sink.poses:
        print(f"{sink.poses} poses and {sink.images} images shown", flush=True)
    return int(not sink.poses)


def sink_of(output: Path | None, log: Path | None) -> RerunSink:
    """Return a sink that draws into a file, or into a window (output None).

    Raise OmnidError where Rerun is missing, or the file is the log.
    """
    if find_spec("rerun") is None:
        raise OmnidError(
            f"this draws with rerun, which is not installed: {sys.executable} -m pip install 'rerun-sdk>=0.41'"
        )
    os.environ.setdefault("RUST_LOG", "off")  # omnid reports errors of rerun itself
    import rerun

    from omnid.viewer.rerun_sink import RerunSink, layout

    if output is not None:
        check_outputs([("the drawing", output)], [] if log is None else [("the log that is read", log)])

    def opened() -> Any:
        stream = rerun.RecordingStream("omnid")
        if output is None:
            stream.connect_grpc(_viewer(), default_blueprint=layout())  # it waits for the viewer
            return stream
        try:
            stream.save(str(output), layout())
        except (OSError, RuntimeError) as error:
            raise OmnidError(f"{output}: cannot be written: {error}; name another file") from error
        return stream

    return RerunSink(opened)


def _viewer() -> str:
    """Start Rerun's viewer and return its address; unlike `rerun.spawn`, it is served to this machine only."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin"):
        raise OmnidError(
            "there is no display for a window: use -o FILE.rrd, which `rerun --serve-web FILE.rrd` shows in a browser"
        )
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = f"-m rerun_cli --bind 127.0.0.1 --port {port} --hide-welcome-screen --expect-data-soon".split()
    # In a session of its own: Ctrl-C does not end a window.
    environment = python_environment(RUST_LOG="warn")
    subprocess.Popen(python(*words), stdin=subprocess.DEVNULL, start_new_session=True, env=environment)
    return f"rerun+http://127.0.0.1:{port}/proxy"


def _draw_recording(sink: RerunSink, log: Path, topic: str | None, robot: str | None) -> None:
    """Draw what is recorded. Raise OmnidError where there is no pose in it."""
    broken_images = 0
    with closing(RecordingReader(log, topic, robot)) as reader:
        for message in reader.messages((ODOMETRY, MAP_POSE, STATUS, CLOUD, SCAN, reader.image_name())):
            try:
                sink.draw(message.content)
            except FrameDecodeError:
                broken_images += 1
    damaged = len(reader.log.faults) + bool(reader.log.cut)
    if unreadable := reader.unreadable.total() + damaged + broken_images:
        warn(f"{log}: {unreadable} messages or pieces cannot be read")
    if not sink.poses:
        raise reader.no_pose()


def _draw_robot(sink: RerunSink, config: Config, seconds: float) -> None:
    """Draw a live robot until a signal, or for a number of seconds."""
    end_s, signals, state = time.monotonic() + seconds, list[int](), RobotState()
    with (
        handle_stop_signals(lambda number, _: signals.append(number)),
        Robot(settings=config.bus) as robot,
    ):
        for topic in (ODOMETRY, MAP_POSE, SCAN, PANORAMA, STATUS, CLOUD):
            robot.on_message(state.put, topic, kept=topic in (STATUS, CLOUD))
        while time.monotonic() < end_s and not signals:
            _, content = state.next(0.5) or (None, None)
            if content is not None:
                sink.draw(content)
    if not sink.poses:
        failed(f"no pose of {config.bus.robot} came: `omnid listen` names those that are there")


@command()
def report(args: argparse.Namespace) -> int:
    """Write one HTML page about a recording: path, events, statistics.

    log LOG                           what `omnid replay --record` or `omnid run` with record.enabled wrote, or any MCAP
        with nav_msgs/msg/Odometry
    -o, --output FILE=report.html     the page
    --topic TOPIC                     the odometry topic, where there are several
    --truth FILE                      the true path of the rig, TUM format

    examples:
      report out.mcap -o report.html
    """
    inputs = [("the log that is read", args.log)] + ([("the truth", args.truth)] if args.truth else [])
    check_outputs([("--output", args.output)], inputs)
    truth = read_tum(args.truth) if args.truth else None
    recorded = RecordedRun(args.log, args.topic)
    html = report_html(recorded, truth)
    write_file(args.output, html.encode("utf-8", "replace"))  # a file's name may be no text
    line = f"{args.output}: {len(recorded.t_s)} poses of {recorded.topic}, {len(html) / 1e6:.2f} MB"
    print(plain(line))
    return 0
