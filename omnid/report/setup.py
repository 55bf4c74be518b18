"""The sections about what a run was made with: rig, settings, file; what comes from the log is escaped here."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any, Final

import numpy as np

from calib import se3
from calib.models.ocam import OcamCamera
from calib.rig import MountedCamera, Rig
from omnid.config import Config
from omnid.report.page import facts, note, table
from omnid.report.report_data import ReportData
from omnid.settings import dump

_LARGEST: Final = 1 << 18  # bytes of settings
_MOST: Final = 60
_MOST_TOPICS: Final = 60
_LONGEST: Final = 120  # characters of a value


def setup(recording: ReportData) -> list[str]:
    """The rig, and the settings that are not the usual ones."""
    rig = [facts([(name, escape(value)) for name, value in _rig_rows(recording.rig)])] if recording.rig else \
        [note(recording.rig_fault)]
    settings = recording.attachments.get("omnid.toml")
    found = None if settings is None else _unusual(settings)
    if found is None:
        told = [note("No settings are attached." if settings is None else "The attached settings cannot be read.")]
    elif not found:
        told = ["<p>All settings are the usual ones.</p>"]
    else:
        rows = [tuple(map(escape, row)) for row in found]
        told = ["<div class='words scroll'>", table(("setting", "here", "usual"), rows), "</div>"]
    return ["<h2>Rig and settings</h2>", *rig, *told]


def contents(recording: ReportData) -> list[str]:
    """The topics of the file."""
    topics = list(recording.survey.topics.items())
    rows = [(escape(name), escape(kind), str(count)) for name, (kind, count) in topics[:_MOST_TOPICS]]
    more = [note(f"and {len(topics) - _MOST_TOPICS} more topics")] if len(topics) > _MOST_TOPICS else []
    attached = ", ".join(f"{name} ({size} bytes)" for name, size in recording.survey.attachments.items())
    return ["<h2>What is in the file</h2>", "<div class='words scroll'>", table(("topic", "type", "messages"), rows),
            "</div>", *more, f"<p>Attached: {escape(attached or 'nothing')}.</p>"]


def _rig_rows(rig: Rig) -> list[tuple[str, str]]:
    """What the rig is, as name and value."""
    place = rig.T_base_rig
    turn = np.rad2deg(se3.rotation_log(place[:3, :3]))
    at = ", ".join(f"{value:.3g}" for value in place[:3, 3])
    rows = [("baseline", f"{rig.baseline_m * 1e3:.2f} mm"), ("lower camera", _camera(rig.lower)),
            ("upper camera", _camera(rig.upper))]
    if np.allclose(place, np.eye(4)):
        return [*rows, ("on the robot", "the rig's frame is the robot's")]
    return [*rows, ("on the robot", f"at {at} m, turned by {', '.join(f'{value:.3g}' for value in turn)} deg")]


def _camera(mounted: MountedCamera) -> str:
    camera = mounted.camera
    model = f"ocam, {camera.view} view" if isinstance(camera, OcamCamera) else "omni"
    return f"{model}, {camera.size[0]}x{camera.size[1]} px, {'with a' if mounted.mask else 'without a'} mask"


def _unusual(settings: bytes) -> list[tuple[str, str, str]] | None:
    """Name, value and usual value of the settings that differ from omnid's own; None where they cannot be read."""
    try:
        given = tomllib.loads(settings[: _LARGEST + 1].decode()) if len(settings) <= _LARGEST else None
    except (ValueError, RecursionError):
        return None
    if given is None:
        return None
    usual = dict(_flat(tomllib.loads(dump(Config()))))
    found = [(name, _shown(value), _shown(usual[name]) if name in usual else "unknown to this omnid")
             for name, value in _flat(given) if name not in usual or usual[name] != value]
    return found[:_MOST]


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, object]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}"[:_LONGEST], value


def _shown(value: object) -> str:
    said = str(value)
    return said if len(said) <= _LONGEST else f"{said[:_LONGEST]}..."
