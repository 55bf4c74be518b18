"""Who may drive: arming, which every fault, stop and contact withdraws, and sources of commands with their senders.

The model of the sources is twist_mux of ROS.
"""

from __future__ import annotations

from collections import Counter
from typing import Final, NamedTuple

from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import ASKED, LATCHING

MANUAL: Final = "manual"
AUTOMATIC: Final = "automatic"
STARTED: Final = "not armed since the start"

# Reasons to refuse a request to arm. A fault that holds is another one (omnid.core.control.safety_rules).
OLDER_THAN_STOP: Final = "older than the last stop"
TOO_LATE: Final = "it was not handled in time"


# Origins of reports of bumpers and cliff sensors.
BUS: Final = "bus"
MOTOR: Final = "motor"


class ContactState(NamedTuple):
    """State of the sensors of one origin; `begun` shows a contact that has begun and ended between two messages."""

    holding: frozenset[str] = frozenset()  # contacts that hold now: BUMPER, CLIFF
    begun: int = 0  # contacts so far
    newest: str = ""  # the last one that has begun

    def after(self, contact: str, *, holds: bool) -> ContactState:
        """Return the state after a message of one sensor (BUMPER, CLIFF)."""
        if not holds:
            return self._replace(holding=self.holding - {contact})
        begins = contact not in self.holding
        return ContactState(self.holding | {contact}, self.begun + begins, contact if begins else self.newest)


NO_CONTACT: Final = ContactState()


class Contacts:
    """Follows the sensors of all origins."""

    def __init__(self) -> None:
        self._states: dict[str, ContactState] = {}
        self._begun: set[str] = set()  # since the last step

    def update(self, origin: str, state: ContactState) -> None:
        """Replace the state of an origin."""
        before, self._states[origin] = self._states.get(origin, NO_CONTACT), state
        self._begun |= {state.newest} if state.begun > before.begun else set()

    def take(self) -> set[str]:
        """Return the contacts that hold, or have begun since the last call."""
        found, self._begun = self._begun, set()
        return found.union(*(state.holding for state in self._states.values()))


class ArmRequest(NamedTuple):
    """A request to arm.

    arrival_ns: by the clock that steps the control law. id: rises with each request, and the answer carries it.
    """

    arrival_ns: int
    id: int = 0


class ArmAnswer(NamedTuple):
    """The answer to the newest request to arm.

    id: that of the request, 0 before the first one. refusal: why it was refused, empty if it was accepted.
    """

    id: int = 0
    refusal: str = ""


NO_ANSWER: Final = ArmAnswer()


class Arming:
    """State machine of the permission to drive.

    - At the start the base is disarmed.
    - A fault disarms it while the fault holds. After the fault, mode "manual" waits for a request, and "automatic" arms
      without one.
    - A requested stop latches in both modes. Only a request that arrived after the stop releases it, so that one that
      was sent before the stop and delayed on its way does not.
    - A bumper and a cliff sensor latch as well, and every request is refused while they report a contact.
    """

    def __init__(self, mode: str) -> None:
        """Begin disarmed; mode: MANUAL or AUTOMATIC."""
        self._automatic = mode == AUTOMATIC
        self._stop_ns = 0  # arrival of the newest stop
        self._released_ns = 0  # arrival of the request that released the last stop
        self._request: ArmRequest | None = None
        self._touched = False  # True while a contact is latched
        self.armed = False
        self.reason = STARTED  # why the base is disarmed: a requested stop, else the first fault; empty while armed
        self.answer = NO_ANSWER
        self.stop_count = 0  # how often a stop or a fault has made a request necessary
        self.stopped_by = ""  # the newest of their reasons, kept while armed again

    @property
    def stop_asked(self) -> bool:
        """True if a stop was requested and is not yet released."""
        return self._stop_ns > self._released_ns

    @property
    def needs_request(self) -> bool:
        """True if only a request to arm lets the wheels turn again."""
        return not self.armed and (self.stop_asked or self._touched or not self._automatic)

    def stop(self, asked_ns: int) -> None:
        """Take the arrival of a stop; a repeated or earlier one changes nothing."""
        self._stop_ns = max(self._stop_ns, asked_ns)

    def request(self, request: ArmRequest) -> None:
        """Take a request, which the next step answers."""
        self._request = request

    def step(self, fault: str, now_ns: int, longest_s: float) -> ArmRequest | None:
        """Disarm at a stop or a fault, answer the newest request, and return the request if it was accepted.

        fault: the fault that holds now, empty without one. longest_s: an older request is refused.
        """
        # 1. A fault or a requested stop disarms.
        waited = self.reason if self.needs_request else ""
        self._touched |= fault in LATCHING
        if self.armed and fault:
            self.armed, self.reason = False, fault
        if self.stop_asked:
            self.armed, self.reason = False, ASKED
        if self.needs_request and self.reason != waited:
            self.stop_count, self.stopped_by = self.stop_count + 1, self.reason
        # 2. The newest request is answered, and arms where nothing refuses it.
        request, self._request = self._request, None
        if request is not None:
            refusal = fault or (OLDER_THAN_STOP if request.arrival_ns <= self._stop_ns else "")
            if not refusal and not 0 <= now_ns - request.arrival_ns <= longest_s * 1e9:
                refusal = TOO_LATE
            self.answer = ArmAnswer(request.id, refusal)
            if not refusal:
                self._released_ns, self._touched = request.arrival_ns, False
                self.armed, self.reason = True, ""
                return request
        # 3. In the automatic mode the base is armed without a request, except after a stop or a latched contact.
        if self._automatic and not fault and not self.stop_asked and not self._touched:
            self.armed, self.reason = True, ""
        return None


OPERATOR: Final = "operator"  # has priority
PLANNER: Final = "planner"

# Reasons to refuse a command, which are counted.
LOWER_PRIORITY: Final = "a source of higher priority drives"
OTHER_SENDER: Final = "another sender drives"


class TimedSetpoint(NamedTuple):
    """A setpoint, the time of its arrival by the clock that steps the law, and where it comes from.

    age_ns: its age at its arrival, 0 where it is not known.
    """

    arrival_ns: int
    setpoint: Setpoint
    source: str = OPERATOR
    sender: str = ""  # identity of the program that sent it; empty where it is not known
    age_ns: int = 0


class CommandSelector:
    """Selects the command that drives.

    A source that has sent a command within hold_s keeps out the sources of lower priority, and the program that sent
    it keeps out other programs on the same source. A source of higher priority takes over at once; the one it replaces
    must send again. Refused commands are counted by reason. Programs without an identity count as one.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_ns = round(hold_s * 1e9)
        self.current: TimedSetpoint | None = None  # the newest accepted command
        self.refused: Counter[str] = Counter()
        self.conflict = ""  # the last two senders that have used one source at the same time, in words

    def offer(self, command: TimedSetpoint) -> None:
        """Take a command or refuse it; one that arrived before the current one changes nothing."""
        refusal = self._refusal(command)
        if refusal:
            self.refused[refusal] += 1
        elif self.current is None or command.arrival_ns >= self.current.arrival_ns:
            self.current = command

    def _refusal(self, command: TimedSetpoint) -> str:
        current = self.current
        if current is None or command.arrival_ns - current.arrival_ns > self._hold_ns:
            return ""
        if command.source == current.source:
            if command.sender == current.sender:
                return ""
            self.conflict = f"two programs send commands as {command.source!r}: those of {command.sender!r} are refused"
            return OTHER_SENDER
        return "" if command.source == OPERATOR else LOWER_PRIORITY
