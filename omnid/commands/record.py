"""`omnid record`: record the images of both cameras, for a calibration or a replay."""

from __future__ import annotations

import argparse
import logging
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import SETTINGS, cameras, command, device_opener, option, settings_of

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
    from omnid.engine.logging_setup import log
    from omnid.runs.record import record

    config = settings_of(args)
    rig = _rig(config, wanted=args.rig is not None)
    open_camera = device_opener(config)
    with closing(open_camera("lower")) as lower, closing(open_camera("upper")) as upper:
        state = record({"lower": lower, "upper": upper}, config, rig, log).state
    return 0 if state.messages > state.lost + state.refused else 1


def _rig(config: Config, *, wanted: bool) -> str:
    """Return the rig's TOML; "" if there is none, because the recording may be for its calibration."""
    from calib.rig_file import read_rig, rig_toml
    from omnid.engine.logging_setup import log

    path = Path(config.cameras.rig)
    if not (wanted or path.exists()):
        log(logging.WARNING, f"no rig is attached because {path} does not exist: `omnid replay` will need --rig")
        return ""
    return rig_toml(read_rig(path))
