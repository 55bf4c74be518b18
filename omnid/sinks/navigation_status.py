"""The state of the navigation as a status entry, for its own topic and for the report of the daemon."""

from __future__ import annotations

import math

from omnid.messages import NavigationUpdate
from omnid.navigation_state import NavigationState
from omnid.transport.codec import ERROR, OK, WARN
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import NAVIGATION, Key

_LEVELS = {
    NavigationState.BLOCKED: WARN,
    NavigationState.NOT_LOCALISED: WARN,
    NavigationState.PAUSED: WARN,
    NavigationState.FAILED: ERROR,
}


def navigation_status(update: NavigationUpdate) -> DiagnosticStatus:
    """Return the entry of an update."""
    values: dict[str, str] = {Key.STATE: update.state}
    if update.task:
        values[Key.TASK] = update.task
    if update.command_ns:
        values[Key.COMMAND_NS] = str(update.command_ns)
    if update.reason:
        values[Key.REASON] = update.reason
    for key, number in ((Key.LEFT_M, update.left_m), (Key.OFFSET_M, update.offset_m)):
        if math.isfinite(number):
            values[key] = f"{number:.3f}"
    if update.loops_left > 1:
        values[Key.LOOPS_LEFT] = str(update.loops_left)
    if update.teaching:
        values |= {Key.TEACHING: update.teaching, Key.TAUGHT_M: f"{update.taught_m:.2f}"}
    if update.answer is not None:
        values[Key.REQUEST] = update.answer.request
        if update.answer.refusal:
            values[Key.REFUSAL] = update.answer.refusal
    message = f"{update.state}: {update.reason}" if update.reason else str(update.state)
    return DiagnosticStatus(NAVIGATION, _LEVELS.get(update.state, OK), message, values)
