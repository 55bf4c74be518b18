"""`omnid record`: record the images of both cameras, for a calibration or a replay."""

from __future__ import annotations

import argparse
import logging
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import SETTINGS, cameras, command, option, settings_of

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.config import Config


@command(
    option(
        "folder",
        type=Path,
        nargs="?",
        setting="record.folder",
        help="folder of the files; default: record.folder of the settings",
    ),
    option(
        "--rig",
        type=Path,
        setting="cameras.rig",
        help="a rig.toml to attach; default: cameras.rig of the settings, if it exists",
    ),
    *cameras("the {camera} camera; default: cameras.{camera} of the settings", "DEVICE", are_settings=True),
    *SETTINGS,
    examples=("record recordings/ --rig rig.toml", "record boards/ --lower /dev/video0 --upper /dev/video2"),
)
def run(args: argparse.Namespace) -> int:
    """Record until a signal comes; return 1 if nothing was recorded."""
    from drivers.cameras.v4l2_camera import V4l2Camera
    from drivers.frame import Camera
    from omnid.runs.record import record

    config = settings_of(args)
    rig = _rig(config, wanted=args.rig is not None)
    cameras: tuple[Camera, ...] = ("lower", "upper")
    config.cameras.require_two_devices()
    with ExitStack() as closing:
        sources: dict[Camera, V4l2Camera] = {}
        for name in cameras:
            sources[name] = V4l2Camera(config.cameras.settings(name), name, on_event=_log)
            closing.callback(sources[name].close)
        state = record(sources, config, rig, _log).state
    return 0 if state.messages > state.lost + state.refused else 1


def _rig(config: Config, *, wanted: bool) -> str:
    """Return the rig's TOML; "" if there is none, because the recording may be for its calibration."""
    from calib.rig_file import read_rig, rig_toml

    path = Path(config.cameras.rig)
    if not (wanted or path.exists()):
        _log(logging.WARNING, f"no rig is attached because {path} does not exist: `omnid replay` will need --rig")
        return ""
    return rig_toml(read_rig(path))


def _log(level: int, text: str) -> None:
    from omnid.engine.logging_setup import log

    log(level, text)
