"""What was recorded: `omnid log info`, `eval`, `report`; `omnid view`, which also shows a robot."""

from __future__ import annotations

import argparse
import math
import os
import socket
import subprocess
import sys
import time
from collections import Counter
from contextlib import closing, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import se3
from drivers.errors import DriverError, FrameDecodeError
from drivers.logs.log import Log
from drivers.logs.log_reader import open_log
from omnid.client import Robot
from omnid.commands import options
from omnid.config import Config
from omnid.engine.process import handle_stop_signals, python, python_environment
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.formats.tum import Trajectory, read_tum
from omnid.monitor.robot_state import RobotState
from omnid.plain_text import plain, utc
from omnid.recordings.evaluation import body_rotation, evaluate
from omnid.recordings.recording import CLOUD, ODOMETRY, STATUS, RecordingReader
from omnid.report.recorded_run import RecordedRun
from omnid.report.report import report_html
from omnid.sinks.files import check_outputs
from omnid.transport.topics import PANORAMA, SCAN

if TYPE_CHECKING:  # it imports rerun, which may be missing
    from omnid.viewer.rerun_sink import RerunSink


@options.command()
def info(args: argparse.Namespace) -> int:
    """Print topics, types, counts, times, attachments, and whether the log is whole.

    Exit code 1: one is broken; 2: one is no log.

    logs LOG...  .mcap, .db3, .bag, or a folder of these or of images

    examples:
      log info recordings/*.mcap
      log info images
    """
    code = 0
    for number, path in enumerate(args.logs):
        try:
            log = open_log(path)
        except DriverError as error:
            options.failed(plain(str(error)))
            code = 2
            continue
        print("\n" * bool(number), end="")
        with closing(log):
            _show(log)
        code = max(code, int(bool(log.cut or log.faults)))
    return code


def _show(log: Log) -> None:
    """Print the properties of a log, and the table of its topics. The log may contain anything."""
    counts = Counter(message.topic for message in log.messages())  # what cannot be read shows by that
    skipped = f"{len(log.faults)} corrupt chunks or records, which are skipped" if log.faults else ""
    state = ": ".join(filter(None, (log.state, log.cut, skipped)))
    logged_ns, span = log.entries["time_ns"], ""
    if logged_ns.size:
        first_ns, last_ns = int(logged_ns.min()), int(logged_ns.max())
        span = f"{utc(first_ns)} to {utc(last_ns)}, {(last_ns - first_ns) / 1e9:.3f} s"
    listed = ", ".join(f"{name} ({len(data) / 1e3:.1f} kB)" for name, data in log.attachments().items())
    entries = {"log": str(log.path), "size": f"{log.size_bytes / 1e6:.1f} MB", "state": state, "time": span}
    entries |= {"messages": str(counts.total()), "attachments": listed or "none"}
    options.print_entries({name: plain(text) for name, text in entries.items()})
    rows = []
    for number, (name, kind) in enumerate(log.topics.items()):
        span_s = 1e-9 * np.ptp(logged_ns[log.topic == number]) if counts[name] > 1 else 0.0
        rate = f"{(counts[name] - 1) / span_s:.2f}" if span_s else "-"
        rows.append((plain(name), plain(kind) or "-", counts[name], rate))
    if rows:
        wide, wide_kind = (max(map(len, column)) for column in list(zip(*rows, strict=True))[:2])
        print(f"\n{'topic':<{wide}}  {'type':<{wide_kind}}{'messages':>10}{'Hz':>9}")
    for name, kind, count, rate in sorted(rows):
        print(f"{name:<{wide}}  {kind:<{wide_kind}}{count:>10}{rate:>9}")


@options.command(options.JSON)
def evaluate_run(args: argparse.Namespace) -> int:
    """Compare a trajectory with the truth, both in the TUM format.

    estimate EST           t x y z qx qy qz qw, T_odom_rig
    truth TRUTH            the same format, of the same rig frame in any world frame
    --tolerance-ms MS=10 0..  largest difference between the stamps of two poses
    --align origin|rigid=origin  the first pose, as evo's --align_origin; rigid: all positions, as its --align
    --frame rig|auto=rig   the body whose truth it is: the rig; auto: fit three angles by which its axes are turned, and
        print them

    examples:
      eval est.txt truth.txt
      eval est.txt imu_truth.txt --frame auto
      eval est.txt truth.txt --align rigid --json
    """
    estimate, truth, tolerance_s = read_tum(args.estimate), read_tum(args.truth), args.tolerance_ms * 1e-3
    known: dict[str, object] = {}
    if args.frame == "auto":
        T_rig_body = body_rotation(estimate, truth, tolerance_s)
        truth = Trajectory(truth.stamps_ns, truth.T @ se3.inverse(T_rig_body))
        turn_deg = np.rad2deg(se3.rotation_log(T_rig_body[:3, :3]))
        known["turned_deg"] = [round(float(angle), 2) for angle in turn_deg]
    metrics = evaluate(estimate, truth, tolerance_s, args.align)
    if args.json:
        options.print_json(asdict(metrics) | known)
        return 0
    if known:
        print(f"the truth is of a body turned by {known['turned_deg']} deg: fitted, so the errors are optimistic")
    print(metrics)
    return 0


@options.command(options.ROBOT, options.SECONDS, options.SETTINGS)
def view(args: argparse.Namespace) -> int:
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
    config = options.settings_of(args)
    with closing(sink_of(args.output, args.log)) as sink:
        if args.log is None:
            _draw_robot(sink, config, math.inf if args.seconds is None else args.seconds)
        else:
            _draw_recording(sink, args.log, args.topic)
    if sink.poses:
        print(f"{sink.poses} poses and {sink.images} images shown", flush=True)
    return int(not sink.poses)


def sink_of(output: Path | None, log: Path | None) -> RerunSink:
    """Return a sink that draws into a file, or into a window (output None).

    Raise OmnidError where Rerun is missing, or the file is the log.
    """
    options.require("view", "rerun")
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
    environment = python_environment(RUST_LOG="warn")
    # In a session of its own: Ctrl-C does not end a window.
    subprocess.Popen(python(*words), stdin=subprocess.DEVNULL, start_new_session=True, env=environment)
    return f"rerun+http://127.0.0.1:{port}/proxy"


def _draw_recording(sink: RerunSink, log: Path, topic: str | None) -> None:
    """Draw what is recorded. Raise OmnidError where there is no pose in it."""
    with closing(RecordingReader(log, topic)) as reader:
        for message in reader.messages((ODOMETRY, STATUS, CLOUD, SCAN, reader.image_name())):
            with suppress(FrameDecodeError):
                sink.draw(message.content)
    if unreadable := reader.unreadable.total() + len(reader.log.faults) + bool(reader.log.cut):
        options.warn(f"{log}: {unreadable} messages or pieces cannot be read")
    if not sink.poses:
        raise reader.no_pose()


def _draw_robot(sink: RerunSink, config: Config, seconds: float) -> None:
    """Draw a live robot until a signal, or for a number of seconds."""
    end_s, signals, state = time.monotonic() + seconds, list[int](), RobotState()
    with handle_stop_signals(lambda number, _: signals.append(number)), Robot(settings=config.bus) as robot:
        for topic in (ODOMETRY, SCAN, PANORAMA, STATUS, CLOUD):
            robot.on_message(state.put, topic, kept=topic in (STATUS, CLOUD))
        while time.monotonic() < end_s and not signals:
            if (content := state.next(0.5)) is not None:
                sink.draw(content)
    if not sink.poses:
        options.failed(f"no pose of {config.bus.robot} came: `omnid listen` names the robots that are there")


@options.command()
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
    write_whole(args.output, html.encode("utf-8", "replace"))  # a file's name may be no text
    print(plain(f"{args.output}: {len(recorded.t_s)} poses of {recorded.topic}, {len(html) / 1e6:.2f} MB"))
    return 0
