"""Goals and routes from another program: requests, their answers, and progress until the end."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import Final

from omnid.client import NavigationReport, Robot, Subscription
from omnid.errors import OmnidError
from omnid.monitor.arming import CONNECT_S, driver_of
from omnid.navigation_state import NavigationState
from omnid.transport.bus_config import BusConfig
from omnid.transport.navigation_codec import PlanarGoal, goal_cdr, string_cdr
from omnid.transport.topics import GOAL, NAVIGATION, ROUTE

ANSWER_S: Final = 5.0
SILENCE_S: Final = 10.0  # without a report, after which the robot counts as gone
SHOWN_S: Final = 0.5  # between two lines of progress
_ENDS: Final = tuple(state for state in NavigationState if state.is_end)


class NavigationClient:
    """A connection that sends requests and follows what becomes of them."""

    def __init__(self, bus: BusConfig) -> None:
        """Connect; raise OmnidError where the robot cannot be reached or receives no commands."""
        self._robot = Robot(settings=bus, timeout_s=CONNECT_S)
        try:
            self._driver = driver_of(self._robot)
            self._reports: Subscription[NavigationReport] = self._robot.subscribe(NavigationReport)
            newest = self._reports.wait(SILENCE_S)  # one a second, or fewer where a simulation is slow
            if newest is None:
                raise OmnidError(f"{bus.robot} reports no navigation: check that its daemon runs with a motor, and "
                                 "gives poses")
            self._newest: NavigationReport = newest
        except BaseException:
            self._robot.close()
            raise

    def goal(self, x_m: float, y_m: float, heading_rad: float | None, frame: str) -> NavigationReport:
        """Ask for a drive to a pose; return the report with the answer. Raise OmnidError with the refusal."""
        stamp_ns = time.time_ns()
        self._driver.send(GOAL, goal_cdr(PlanarGoal(stamp_ns, frame, x_m, y_m, heading_rad)))
        return self._answer(lambda report: report.request_stamp_ns == stamp_ns)

    def navigate(self, verb: str) -> NavigationReport:
        """Cancel, pause or resume; as `goal`."""
        return self._text(NAVIGATION, verb)

    def route(self, text: str) -> NavigationReport:
        """Ask for what a text of cmd/route says; as `goal`."""
        return self._text(ROUTE, text)

    def next(self, timeout_s: float) -> NavigationReport | None:
        """Return the next report, None after the timeout."""
        return self._reports.wait(timeout_s)

    def follow(self, show: Callable[[NavigationReport], None]) -> NavigationReport:
        """Show the progress until the end of the drive; return the last report.

        Raise OmnidError where the robot is silent for SILENCE_S.
        """
        while self._newest.state not in _ENDS:
            show(self._newest)
            self._newest = self._expected()
        return self._newest

    def close(self) -> None:
        """End the connection."""
        self._robot.close()

    def __enter__(self) -> NavigationClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _expected(self) -> NavigationReport:
        """Return the next report. Raise OmnidError where none comes."""
        report = self._reports.wait(SILENCE_S)
        if report is not None:
            return report
        raise OmnidError(f"{self._robot.name} has been silent for {SILENCE_S:g} s: it stops by itself; see "
                         "`omnid listen`")

    def _text(self, topic: str, text: str) -> NavigationReport:
        before = self._newest.request_number
        self._driver.send(topic, string_cdr(text))
        return self._answer(lambda report: report.request_number != before)

    def _answer(self, is_answer: Callable[[NavigationReport], bool]) -> NavigationReport:
        deadline_s = time.monotonic() + ANSWER_S
        while time.monotonic() < deadline_s:
            report = self._reports.wait(deadline_s - time.monotonic())
            if report is not None:
                self._newest = report
                if is_answer(report):
                    if report.refusal:
                        raise OmnidError(f"{self._robot.name} refuses: {report.refusal}")
                    return report
        raise OmnidError(f"{self._robot.name} has not answered within {ANSWER_S:g} s: either this program must not "
                         "command it (bus.command_users, bus.command_names), the clocks differ, or it gives no poses; "
                         "see its log")


class ProgressLine:
    """Shows reports: on a terminal one line that is rewritten, else a line for each new state."""

    def __init__(self) -> None:
        self._rewrites = sys.stdout.isatty()
        self._last = ""
        self._shown_s = -math.inf

    def __call__(self, report: NavigationReport) -> None:
        """Show a report."""
        words = f"{report.state}: {report.reason}" if report.reason else report.state
        if self._rewrites:
            if time.monotonic() - self._shown_s >= SHOWN_S or words != self._last:
                left = f", {report.left_m:.2f} m left" if math.isfinite(report.left_m) else ""
                sys.stdout.write(f"\r\x1b[K{words}{left}")
                sys.stdout.flush()
                self._shown_s = time.monotonic()
        elif words != self._last:
            print(words, flush=True)
        self._last = words

    def end(self) -> None:
        """End the line."""
        if self._rewrites and self._last:
            print()


def drive_to_end(client: NavigationClient) -> int:
    """Show a drive until its end; Ctrl-C cancels it. Return 0 if it has reached its goal, else 1."""
    line = ProgressLine()
    try:
        report = client.follow(line)
    except KeyboardInterrupt:
        line.end()
        report = client.navigate("cancel")
    else:
        line.end()
    print(f"{report.state}: {report.reason}" if report.reason else report.state)
    return int(report.state != NavigationState.REACHED)
