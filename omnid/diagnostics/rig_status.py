"""The rig's entry of the status: its state, by columns of the panoramas."""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from omnid.core.rig.column_finding import RigState
from omnid.core.rig.rig_health import VIEWS, RigHealth
from omnid.transport.codec import ERROR, OK, WARN
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import RIG, Key

LEVELS: Final = MappingProxyType(
    {
        RigState.UNCHECKED: OK,
        RigState.FITS: OK,
        RigState.DRIFTED: WARN,
        RigState.EXCHANGED: ERROR,
        RigState.BROKEN: ERROR,
    }
)
ADVICE: Final = MappingProxyType(
    {
        RigState.UNCHECKED: "not checked yet: the robot must drive past different places",
        RigState.FITS: "fits",
        RigState.DRIFTED: "drifted: run omnid calibrate drive --only check on a recording; -o corrects the rotation of "
        "the upper camera",
        RigState.EXCHANGED: "the cameras are exchanged: exchange them in the configuration",
        RigState.BROKEN: "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: "
        "run omnid calibrate drive --only check on a recording",
    }
)


def rig_status(health: RigHealth) -> DiagnosticStatus:
    """Return the entry."""
    # 1. The state, with the words of the first pairs while the drive has shown nothing.
    state, finding = health.state, health.finding
    level, message = LEVELS[state], ADVICE[state]
    values = {str(Key.STATE): str(state), "new_views": str(health.new_views), "needed_views": str(VIEWS)}
    if finding is None and health.warning:
        level, message = max(level, WARN), health.warning
    # 2. The evidence of the newest finding.
    start = health.start_finding
    if start is not None:
        values["exchanged_matches"] = str(start.exchanged_matches)
    newest = finding or (start.straight if start is not None else None)
    if newest is not None:
        values |= {
            "turn_deg": f"{newest.turn_deg:.3f}",
            "offset_px": f"{newest.offset_px:+.2f}",
            "left_px": f"{newest.left_px:.2f}",
            "matches": str(newest.matches),
            "tried": str(newest.tried),
        }
    if finding is not None:
        values["age_s"] = f"{health.finding_age_s:.0f}"
    return DiagnosticStatus(RIG, level, message, values)
