"""Report sections about rig, settings and file. Text from the log is escaped here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any, Final

import numpy as np

from calib import se3
from calib.bounded_toml import parse_toml
from calib.models.names import model_in_words
from calib.rig import MountedCamera, Rig
from omnid.config import Config
from omnid.report.page import facts, note, table
from omnid.report.report_data import ReportData
from omnid.settings import dump

_MAX_SETTINGS_BYTES: Final = 1 << 18
_MAX_SETTINGS: Final = 60
_MAX_TOPICS: Final = 60
_MAX_VALUE: Final = 120  # characters


def setup(data: ReportData) -> list[str]:
    """Return the section with the rig and the settings that are not at their defaults."""
    rig = (
        [facts([(name, escape(value)) for name, value in _rig_rows(data.rig)])] if data.rig else [note(data.rig_fault)]
    )
    settings = data.attachments.get("omnid.toml")
    found = None if settings is None else _changed(settings)
    if found is None:
        rows = [note("No settings are attached." if settings is None else "The attached settings cannot be read.")]
    elif not found:
        rows = ["<p>All settings are at their defaults.</p>"]
    else:
        cells = [tuple(map(escape, row)) for row in found]
        rows = ["<div class='words scroll'>", table(("setting", "value", "default"), cells), "</div>"]
    return ["<h2>Rig and settings</h2>", *rig, *rows]


def contents(data: ReportData) -> list[str]:
    """Return the section with the topics of the file."""
    topics = list(data.info.topics.items())
    rows = [(escape(name), escape(kind), str(count)) for name, (kind, count) in topics[:_MAX_TOPICS]]
    more = [note(f"and {len(topics) - _MAX_TOPICS} more topics")] if len(topics) > _MAX_TOPICS else []
    attached = ", ".join(f"{name} ({size} bytes)" for name, size in data.info.attachments.items())
    return [
        "<h2>Content of the file</h2>",
        "<div class='words scroll'>",
        table(("topic", "type", "messages"), rows),
        "</div>",
        *more,
        f"<p>Attached: {escape(attached or 'nothing')}.</p>",
    ]


def _rig_rows(rig: Rig) -> list[tuple[str, str]]:
    """Return properties of the rig as name and value."""
    rotation_deg = ", ".join(f"{value:.3g}" for value in np.rad2deg(se3.rotation_log(rig.T_base_rig[:3, :3])))
    position_m = ", ".join(f"{value:.3g}" for value in rig.T_base_rig[:3, 3])
    rows = [
        ("baseline", f"{rig.baseline_m * 1e3:.2f} mm"),
        ("lower camera", _camera(rig.lower)),
        ("upper camera", _camera(rig.upper)),
    ]
    if np.allclose(rig.T_base_rig, np.eye(4)):
        return [*rows, ("on the robot", "not stated: the rig's frame is base_link")]
    return [*rows, ("on the robot", f"at {position_m} m, rotated by {rotation_deg} deg")]


def _camera(mounted: MountedCamera) -> str:
    camera = mounted.camera
    size, mask = f"{camera.size[0]}x{camera.size[1]} px", "with a mask" if mounted.mask else "without a mask"
    return f"{model_in_words(camera)}, {size}, {mask}"


def _changed(settings: bytes) -> list[tuple[str, str, str]] | None:
    """Return name, value and default of the settings that differ from the defaults; None where they cannot be read."""
    if len(settings) > _MAX_SETTINGS_BYTES:
        return None
    try:
        given = parse_toml(settings.decode())
    except (ValueError, RecursionError):
        return None
    defaults = dict(_flat(parse_toml(dump(Config()))))
    found = [
        (name, _shown(value), _shown(defaults[name]) if name in defaults else "unknown to this omnid")
        for name, value in _flat(given)
        if name not in defaults or defaults[name] != value
    ]
    return found[:_MAX_SETTINGS]


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, object]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}"[:_MAX_VALUE], value


def _shown(value: object) -> str:
    text = str(value)
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]}..."
