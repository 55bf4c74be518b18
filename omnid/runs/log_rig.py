"""The rig that is attached to a log."""

from __future__ import annotations

from pathlib import Path

from calib.rig import Rig
from calib.rig_file import parse_rig
from drivers.logs.log_reader import LogReader
from omnid.errors import OmnidError


def attached_rig(reader: LogReader, log: Path) -> Rig:
    """Return the rig of the rig.toml that is attached to the log; OmnidError if there is none."""
    attached = reader.attachments().get("rig.toml")
    if attached is None:
        raise OmnidError(
            f"{log}: no rig.toml is attached to the log; give one with --rig, made by `omnid calibrate "
            "import camchain.yaml -o rig.toml`"
        )
    return parse_rig(attached, None, f"{log}: attached rig.toml")
