"""Arming: permission to drive, which every fault and every stop withdraws."""

from __future__ import annotations

from typing import Final, NamedTuple

from omnid.core.control.contacts import LATCHING
from omnid.core.control.safety_rules import ASKED
from omnid.settings import knob

MANUAL: Final = "manual"
AUTOMATIC: Final = "automatic"
STARTED: Final = "not armed since the start"

# Reasons to refuse a request to arm, beside those of the faults (omnid.core.control.safety_rules).
OLDER_THAN_STOP: Final = "older than the last stop"
TOO_LATE: Final = "it was not handled in time"


def arming_knob() -> str:
    """Return the declaration of `controller.arming`."""
    return knob(
        MANUAL,
        "manual: the wheels turn only after cmd/arm (`omnid arm`), again after each stop and each "
        "fault; automatic: for service without an operator, faults that have passed need no cmd/arm, stops do",
        choices=(MANUAL, AUTOMATIC),
    )


class ArmRequest(NamedTuple):
    """A request to arm."""

    arrival_ns: int  # by the clock that steps the law
    id: int = 0  # rises with each request; the answer carries it


class ArmAnswer(NamedTuple):
    """The answer to the newest request to arm."""

    id: int  # of the request; 0: there was none
    refusal: str  # the reason; empty where the request was accepted


NO_ANSWER: Final = ArmAnswer(0, "")


class Arming:
    """State machine of the permission to drive.

    Disarmed at the start. Each fault disarms for as long as it holds; after it, mode "manual" waits for a request,
    "automatic" arms by itself. A stop that was asked for latches in both modes: only a request that arrived after it
    releases it, so that a request that was sent before the stop, and comes through later, does not. A bumper and a
    cliff sensor latch as well, and no request is accepted while they hold.
    A stale command is no fault: the operator has let go of the stick, and may go on.
    """

    def __init__(self, mode: str) -> None:
        """Begin disarmed; mode: MANUAL or AUTOMATIC."""
        self._automatic = mode == AUTOMATIC
        self._stop_ns = 0  # arrival of the newest stop
        self._released_ns = 0  # arrival of the request that released the last one
        self._request: ArmRequest | None = None
        self._touched = False  # a contact has latched
        self.armed = False
        self.reason = STARTED  # why it is disarmed: the first cause, or a stop; empty while armed
        self.answer = NO_ANSWER

    @property
    def stop_asked(self) -> bool:
        """True if a stop was asked for and not released."""
        return self._stop_ns > self._released_ns

    @property
    def needs_request(self) -> bool:
        """True if only a request to arm lets the wheels turn again."""
        return not self.armed and (self.stop_asked or self._touched or not self._automatic)

    def stop(self, asked_ns: int) -> None:
        """Take the time of the newest stop; an earlier one changes nothing, so it may be repeated."""
        self._stop_ns = max(self._stop_ns, asked_ns)

    def request(self, request: ArmRequest) -> None:
        """Take a request, which the next step answers."""
        self._request = request

    def step(self, fault: str, now_ns: int, longest_s: float) -> ArmRequest | None:
        """Disarm where a stop or a fault asks for it; return the request that was accepted in this step.

        fault: reason that disarms and holds now; empty without one. longest_s: age at which a request is too old.
        """
        # 1. A fault or a stop that was asked for disarms.
        self._touched |= fault in LATCHING
        if self.armed and fault:
            self.armed, self.reason = False, fault
        if self.stop_asked:
            self.armed, self.reason = False, ASKED
        # 2. The newest request is answered, and arms where nothing refuses it.
        request, self._request = self._request, None
        if request is not None:
            self.answer = ArmAnswer(request.id, self._refusal(request, fault, now_ns, longest_s))
            if not self.answer.refusal:
                self._released_ns, self._touched = request.arrival_ns, False
                self._arm()
                return request
        # 3. In the automatic mode the base is armed without a request, until a stop or a latching fault.
        if self._automatic and not fault and not self.stop_asked and not self._touched:
            self._arm()
        return None

    def _arm(self) -> None:
        self.armed, self.reason = True, ""

    def _refusal(self, request: ArmRequest, fault: str, now_ns: int, longest_s: float) -> str:
        if fault:
            return fault
        if request.arrival_ns <= self._stop_ns:
            return OLDER_THAN_STOP
        if not 0 <= now_ns - request.arrival_ns <= longest_s * 1e9:
            return TOO_LATE
        return ""
