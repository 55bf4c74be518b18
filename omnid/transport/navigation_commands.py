"""Requests to the navigation from the network, validated: `cmd/goal`, `cmd/path`, `cmd/navigation`, `cmd/route`.

goal is a geometry_msgs/msg/PoseStamped, path a nav_msgs/msg/Path, both in the frame map or odom; a quaternion of zeros
asks for no heading. navigation and route are std_msgs/msg/String: "cancel", "pause", "resume"; "teach NAME [replace]",
"finish", "repeat NAME [reverse] [loops=N]", "stop". A String has no stamp of its own: its time of sending is in the
attachment, or it is the last word, stamp=NANOSECONDS.
"""

from __future__ import annotations

import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue
from typing import Final

from omnid.core.navigation.path import FARTHEST_M
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationCommand,
    NavigationFrame,
    NavigationRequest,
    PathRequest,
    RouteAction,
    RouteRequest,
    is_halt,
    navigation_verb,
    route_request,
)
from omnid.errors import OmnidError
from omnid.transport.codec import OK, DiagnosticStatus, goal_from_cdr, path_from_cdr, string_from_cdr
from omnid.transport.freshness import Freshness
from omnid.transport.requests import Answer, Request
from omnid.transport.status_names import REFUSED_PREFIX, REQUESTS
from omnid.transport.topics import GOAL, NAVIGATION, PATH

LONGEST_PAYLOAD: Final = 1 << 20  # bytes
LONGEST_TEXT_PAYLOAD: Final = 4096
MOST_WAITING: Final = 64  # requests
_STAMPED: Final = re.compile(r"(.*\S)\s+stamp=(\d{1,19})\s*", re.DOTALL)


class NavigationReceiver:
    """Passes valid requests on and counts the others; called from threads of the bus, never raises.

    What ends a motion (cancel, pause, finish, stop) is obeyed whatever its age. All else needs a fresh stamp: a request
    that waited in a network must not start a drive minutes later.
    """

    def __init__(
        self,
        target: Callable[[NavigationCommand], None],
        freshness: Freshness,
        *,
        report: Callable[[str], None] | None = None,
    ) -> None:
        """target: may be called from any thread. freshness: as of CommandReceiver. report: takes lines for the log."""
        self._target, self._freshness, self._report = target, freshness, report
        self.accepted = 0
        self.refused: Counter[str] = Counter()  # by topic

    def status(self) -> DiagnosticStatus:
        """Return how many requests were accepted, and how many were not valid, by topic."""
        refused = {f"{REFUSED_PREFIX}{key}": str(count) for key, count in sorted(self.refused.items())}
        return DiagnosticStatus(REQUESTS, OK, "", {"accepted": str(self.accepted), **refused})

    def receive(self, message: Request) -> Answer | None:
        """Handle one message; return the refusal, None where the target answers."""
        try:
            request, stamp_ns = self._parsed(message.topic, message.payload)
            if not (is_halt(request) or _is_finish(request)):
                self._freshness.require(message, time.monotonic_ns(), stamp_ns)
        except OmnidError as error:
            self.refused[message.topic] += 1
            if self._report is not None:
                self._report(f"a request on {message.topic} is refused: {error}")
            return Answer(False, str(error))
        self.accepted += 1
        self._target(NavigationCommand(request, time.time_ns(), stamp_ns or message.sent_ns, message.id))
        return None

    def _parsed(self, key: str, payload: bytes) -> tuple[NavigationRequest, int]:
        longest = LONGEST_PAYLOAD if key == PATH else LONGEST_TEXT_PAYLOAD
        if len(payload) > longest:
            raise OmnidError(f"{len(payload)} bytes: expected at most {longest}")
        if key == GOAL:
            goal = goal_from_cdr(payload)
            _check_near(goal.x_m, goal.y_m)
            return GoalRequest(_frame(goal.frame), goal.x_m, goal.y_m, goal.heading_rad), goal.stamp_ns
        if key == PATH:
            path = path_from_cdr(payload)
            _check_near(*path.xy.ravel())
            return PathRequest(_frame(path.frame), path.xy, path.heading_rad), path.stamp_ns
        text, stamp_ns = _stamp_of(string_from_cdr(payload))
        return (navigation_verb(text) if key == NAVIGATION else route_request(text)), stamp_ns


def _stamp_of(text: str) -> tuple[str, int]:
    """Return a text without the stamp at its end, and that stamp, 0 where there is none."""
    found = _STAMPED.fullmatch(text)
    return (found[1], int(found[2])) if found else (text, 0)


def _is_finish(request: NavigationRequest) -> bool:
    return isinstance(request, RouteRequest) and request.action is RouteAction.FINISH


def _frame(name: str) -> NavigationFrame:
    if name not in list(NavigationFrame):
        raise OmnidError(f"the frame {name[:40]!a}: expected map or odom")
    return NavigationFrame(name)


def _check_near(*positions_m: float) -> None:
    if not all(abs(value) <= FARTHEST_M for value in positions_m):
        raise OmnidError(f"a position beyond {FARTHEST_M:g} m: check the sender")


class RequestQueue:
    """Requests from threads of the bus to the graph: a source that loses none but the oldest of too many."""

    def __init__(self) -> None:
        self._waiting: deque[NavigationCommand] = deque(maxlen=MOST_WAITING)
        self._wake: SimpleQueue[bool] = SimpleQueue()  # True: there is a request; False: the end

    def put(self, command: NavigationCommand) -> None:
        """Add a request; from any thread."""
        self._waiting.append(command)
        self._wake.put(True)

    def end(self) -> None:
        """End `batches`; from any thread."""
        self._wake.put(False)

    def batches(self) -> Iterator[Iterable[NavigationCommand]]:
        """Yield for each request all that wait; taking them removes them.

        An inbox may drop a batch: the next one has its requests.
        """
        while self._wake.get():
            yield self._taken()

    def _taken(self) -> Iterator[NavigationCommand]:
        while self._waiting:
            yield self._waiting.popleft()
