"""Times from a cause to wheels at rest, in the midst of a route that a simulated robot repeats in a closed loop.

The wheels are simulated in this process, the daemon with its cameras is `tests.faults.simulated_daemon`, in real time.
The map and the route come from a drive in lock-step. When a cause has ended, nothing may move before cmd/arm, nor
after it before "resume".
"""

from __future__ import annotations

import random
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from omnid.config import load_config
from omnid.simulation.demonstration import ROUTE, TeachAndRepeat
from omnid.simulation.lockstep import simulate
from omnid.simulation.robot import make_robot, traction
from omnid.simulation.world_file import load_world
from omnid.transport import topics
from omnid.transport.navigation_codec import string_cdr
from omnid.transport.status_names import Key
from tests.benchmark.results import ResultTable
from tests.faults.simulated_daemon import SEED, SIZE_PX, WORLD, PoseFile, PoseWriter
from tests.faults.stop_times import (
    ARM_PERIOD_S,
    CAUSES,
    COLUMNS,
    STILL_S,
    Cause,
    Robot,
    StopTime,
    cells,
    failed_cells,
    measured,
)
from tests.ports import free_port
from tests.replay.live import Base, Operator, answers, started
from tests.waiting import wait_until

PATIENCE_S: Final = 120.0
DRIVES_MPS: Final = 0.25
PHASE_S: Final = 2.0  # span of the random moments: straights and curves
TEACH_S: Final = 60.0
LOOPS: Final = 1000

ROUTE_CAUSES: Final[dict[str, Cause]] = {
    **{
        name: CAUSES[name]
        for name in (
            "cmd/stop, the operator goes on sending",
            "no images of one camera",
            "no images at all",
            "the daemon does not run (SIGSTOP)",
            "nothing of it runs (SIGSTOP)",
            "the motor controller hears nothing",
            "SIGTERM",
            "the daemon killed (SIGKILL)",
            "its controller process killed",
        )
    },
    "the plug of the motor controller pulled": Cause(lambda robot: robot.base.twin.unplug(), None),
}
RENAMED: Final = {"cmd/stop, the operator goes on sending": "cmd/stop"}


def teach(folder: Path) -> None:
    """Write a map and a route in it into a folder."""
    config = load_config(None, [f"places.map={folder / 'site.omap'}", f"navigation.routes={folder / 'routes'}"])
    script = TeachAndRepeat(lambda line: None)
    simulate(load_world(WORLD, SEED), make_robot(SIZE_PX), script, seconds=TEACH_S, seed=SEED, config=config)
    assert script.end == "reached", script.end


@contextmanager
def started_robot(site: Path, folder: Path) -> Iterator[Robot]:
    """Yield a robot that knows where it is on the map of a site, and stands at the start of the route."""
    port = free_port()
    shutil.copytree(site, folder)
    with ExitStack() as ends:
        base = Base(folder)
        ends.callback(base.close)
        wheels, made = base.line.base, make_robot(SIZE_PX)
        wheels.pose, wheels.limits = load_world(WORLD, SEED).start, made.limits
        wheels.traction = traction(made.wheels, SEED)
        poses = PoseFile(folder / "poses")
        ends.callback(PoseWriter(base.twin, poses).close)
        settings = [
            f'bus.listen=["tcp/127.0.0.1:{port}"]',
            "live.status_s=0.2",
            f"places.map={folder / 'site.omap'}",
            f"navigation.routes={folder / 'routes'}",
            "places.localize_only=true",
        ]
        command = [
            sys.executable,
            "-m",
            "tests.faults.simulated_daemon",
            "--motor",
            str(base.port),
            "--poses",
            str(folder / "poses"),
            *(word for setting in settings for word in ("--set", setting)),
        ]
        daemon = ends.enter_context(started(command, port))
        wait_until(lambda: answers(port) or not daemon.alive, "the bus", PATIENCE_S)
        assert daemon.alive, daemon.process.communicate()[1]
        operator = Operator(port)
        ends.callback(operator.close)
        wait_until(lambda: operator.poses and operator.message("places") == "localized", "a place", PATIENCE_S)
        yield Robot(daemon, operator, base)


def text(operator: Operator, topic: str, words: str) -> None:
    """Send a request to the navigation."""
    operator.send(topic, string_cdr(f"{words} stamp={time.time_ns()}"))


class RouteDrive:
    """Begins the route, and goes on with it after each cause."""

    def __init__(self, rng: random.Random) -> None:
        self._rng, self._begun = rng, False

    def __call__(self, robot: Robot) -> None:
        """Arm; the wheels stand until the route is asked for, or the drive is resumed; then wait for full speed.

        On a busy machine a pose may be late, which disarms: then it is armed and resumed again.
        """
        since_s = time.monotonic()
        wait_until(lambda: armed(robot.operator), "the arming", PATIENCE_S)
        time.sleep(STILL_S)
        assert not robot.base.line.moved_since(since_s), "the wheels turned before somebody asked for it"
        wait_until(lambda: self._drives(robot), "motion", PATIENCE_S)
        time.sleep(self._rng.uniform(0.0, PHASE_S))
        wait_until(lambda: self._drives(robot), "motion", PATIENCE_S)

    def _drives(self, robot: Robot) -> bool:
        """Ask for motion where there is none; True at full speed."""
        operator = robot.operator
        if not robot.base.drives and armed(operator):
            if self._begun:
                text(operator, topics.NAVIGATION, "resume")
            else:
                text(operator, topics.ROUTE, f"repeat {ROUTE} loops={LOOPS}")
            time.sleep(ARM_PERIOD_S)
        self._begun = self._begun or robot.base.drives
        return robot.base.line.base.velocity_mps > DRIVES_MPS


def armed(operator: Operator) -> bool:
    """Return whether the robot is armed; ask for it where it is not."""
    if operator.values("wheels").get(Key.ARMED) == "1":
        return True
    operator.arm()
    time.sleep(ARM_PERIOD_S)
    return False


def stop_times(site: Path, folder: Path, name: str, count: int, seed: int) -> list[StopTime]:
    """Return the times of so many stops by one cause."""
    rng, cause, times = random.Random(f"{seed} route {name}"), ROUTE_CAUSES[name], []
    ends_drive = cause.end is None or name.startswith("cmd/stop")  # a stop cancels it: it is asked for again
    for number in range(count if ends_drive else 1):
        with started_robot(site, folder / f"{number}") as robot:
            drive = RouteDrive(rng)
            for _ in range(1 if ends_drive else count):
                times.append(measured(robot, cause, rng, drive))
                if cause.end is not None:
                    since_s = time.monotonic()
                    cause.end(robot)
                    time.sleep(STILL_S)
                    assert not robot.base.line.moved_since(since_s), "the wheels turned again without cmd/arm"
    return times


def run(folder: Path, words: list[str], count: int, seed: int) -> int:
    """Measure a row for each cause whose name has one of the words; return the number of causes that did not stop."""
    site = folder / "site"
    site.mkdir()
    teach(site)
    title = "From a cause to wheels at rest, in the midst of a route"
    table = ResultTable("faults_routes", "faults", title, COLUMNS, continued=True)
    failed = 0
    for number, name in enumerate(name for name in ROUTE_CAUSES if not words or any(word in name for word in words)):
        shown = RENAMED.get(name, name)
        try:
            table.add(*cells(shown, stop_times(site, folder / f"route-{number}", name, count, seed)))
        except AssertionError as error:
            failed += 1
            table.add(*failed_cells(shown, error))
    return failed
