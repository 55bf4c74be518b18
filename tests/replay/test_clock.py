"""The computer's clock is set while a robot drives: a daemon as a process, with an operator whose clock is not set."""

from __future__ import annotations

import time
from pathlib import Path

from mcap.reader import make_reader

from omnid.client import Robot
from omnid.core.control.safety_rules import COMMAND_STALE
from omnid.transport.status_names import STOPPED_PREFIX
from tests.replay.live import patient, robot
from tests.waiting import wait_until

FAULTY = "tests.replay.faulty"
AHEAD_S = (3600, -3600, 30)  # of the daemon's clock, one after the other


def test_stamps_follow_the_clock_and_an_operator_drives_on_by_the_robots_own_time(course: Path, tmp_path: Path) -> None:
    recordings = tmp_path / "recordings"
    settings = patient(
        "record.enabled=true",
        "record.images_hz=0",
        f"record.folder='{recordings}'",
        "record.free_mb=0",
        "controller.deadlines.command_s=8",
    )
    with robot(course, tmp_path, *settings, module=FAULTY) as (daemon, operator, base):
        with Robot(connect=f"tcp/127.0.0.1:{daemon.port}") as client:
            driver = client.driver()

            def drives_at(ahead_s: float) -> bool:
                """Go on driving; true while it does, and poses are of the daemon's clock."""
                driver.heading(0.3, 0.0)
                return base.drives and abs(operator.poses[-1].stamp_ns * 1e-9 - time.time() - ahead_s) < 15

            wait_until(lambda: drives_at(0), "motion")
            for ahead_s in AHEAD_S:
                daemon.write_line(f"clock {ahead_s}")
                wait_until(lambda ahead_s=ahead_s: drives_at(ahead_s), "stamps of the new time")  # type: ignore[misc]
            wait_until(lambda: drives_at(30) and operator.values("clock").get("steps") == "3", "the status")
            assert f"{STOPPED_PREFIX}{COMMAND_STALE}" not in operator.values("wheels")
            assert "it was set forwards by 1.01 h" in operator.message("clock")
            # Who stamps by a clock that was not set is told why that does not count, and may arm by omnid's client.
            operator.drive()
            wait_until(lambda: "refused, too old" in operator.values("wheels"), "the refusal")
            assert "by the robot's clock; " in operator.values("wheels")["command_refusal"]
            assert driver.arm().done
        code, err = daemon.end()
    assert code == 0 and err.count("the computer's clock was set") == len(AHEAD_S)
    spans_s = []
    for path in recordings.glob("*.mcap"):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None and summary.statistics is not None
        spans_s.append((summary.statistics.message_end_time - summary.statistics.message_start_time) * 1e-9)
    assert len(spans_s) == 1 + len(AHEAD_S) and max(spans_s) < 600, "a step begins a file, and is within none"
