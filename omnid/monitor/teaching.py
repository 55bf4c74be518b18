"""Recording of a route from a terminal: while somebody else drives, until Enter."""

from __future__ import annotations

import select
import sys

from omnid.client import NavigationReport, Robot
from omnid.errors import OmnidError
from omnid.monitor.navigation import SHOWN_S, granted


def record_until_enter(robot: Robot, name: str) -> int:
    """Show how long the route is until Enter, then have it written; Ctrl-C drops it. Return the exit code."""
    driver, reports = robot.driver(), robot.subscribe(NavigationReport)
    print(f"records {name}: drive it; Enter writes it, Ctrl-C drops it", flush=True)
    try:
        while not select.select([sys.stdin], [], [], SHOWN_S)[0]:
            report = reports.wait(SHOWN_S)
            if report is None:
                continue
            if report.teaching != name:
                raise OmnidError(f"the recording of {name} has ended: {report.refusal or 'by another program'}")
            if sys.stdout.isatty():
                sys.stdout.write(f"\r\x1b[K{report.taught_m:.1f} m")
                sys.stdout.flush()
        sys.stdin.readline()
        granted(robot, driver.route("finish"))
    except KeyboardInterrupt:
        driver.route("stop")
        print(f"\n{name} is dropped")
        return 130
    print(f"{name} is written")
    return 0
