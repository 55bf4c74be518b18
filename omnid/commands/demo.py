"""`omnid demo`: replay the sample log in real time with all outputs, and compare with the ground truth."""

from __future__ import annotations

import argparse
from importlib.resources import as_file, files
from pathlib import Path

from omnid.commands.config import add_settings
from omnid.commands.replay import replay_and_print


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `demo` to the command line."""
    parser = subparsers.add_parser("demo", help="replay a sample in real time: files, bus and a simulated motor")
    parser.add_argument("--output", type=Path, default=Path("omnid-demo"), metavar="FOLDER",
                        help="folder of the output files; default %(default)s")
    parser.add_argument("--quiet", action="store_true", help="do not show the progress")
    add_settings(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Replay the sample and print its errors against the truth."""
    from omnid.config import load_config
    from omnid.formats.tum import read_tum
    from omnid.recordings.evaluation import evaluate, format_metrics
    from omnid.runs.replay import ReplayOptions

    _make_folder(args.output)
    tum = args.output / "trajectory.tum"
    options = ReplayOptions(tum=tum, cloud=args.output / "map.ply", plan=args.output / "plan.png",
                            record=args.output / "log.mcap", publish=True, bus_optional=True, realtime=True,
                            settings=args.config)
    config = load_config(args.config, ["motor.port=simulated", "controller.setpoint.velocity_mps=0.3",
                                       *args.overrides])
    sample = files("omnid.sample")
    with as_file(sample / "log.mcap") as log, as_file(sample / "truth.txt") as truth:
        code = replay_and_print(log, config, options, quiet=args.quiet)
        if code == 0:
            print(f"\nagainst the truth:\n{format_metrics(evaluate(read_tum(tum), read_tum(truth)))}")
    print(f"\nfiles: {', '.join(str(path) for _, path in options.files)}")
    return code


def _make_folder(folder: Path) -> None:
    from omnid.errors import OmnidError

    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OmnidError(f"--output {folder}: cannot be made ({error.strerror}); name another folder") from error
