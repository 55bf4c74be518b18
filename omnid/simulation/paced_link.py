"""The daemon's end of a controller in simulated time: messages reach it at ticks, and are dated by its clock."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from queue import Empty, Full, Queue, SimpleQueue
from typing import Final, TypeAlias

from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.controller.controller import Controller
from omnid.controller.statistics import ControllerStatistics, TickReport
from omnid.core.control.arming import ArmRequest
from omnid.core.control.collision_monitor import ControllerRing
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.contacts import NO_CONTACT
from omnid.core.control.control_law import ControllerPose
from omnid.engine.flow import nothing
from omnid.engine.telemetry import StageStats

MOST_COMMANDS: Final = 64  # If this number of commands waits for the stages, the simulated time waits, too.
POLL_S: Final = 0.1

# Hands a message to the controller; its argument is the arrival by the simulated clock [ns].
Delivery: TypeAlias = Callable[[Controller, int], None]


class PacedLink:
    """A DriveLink whose controller is stepped by a simulation.

    Poses and rings reach it `delay_ns` after their images, as on a robot that needs that time; setpoints, stops and
    requests to arm with the next tick.
    """

    def __init__(self, stats: StageStats, delay_ns: int) -> None:
        """stats: counters of the tick."""
        self.statistics = ControllerStatistics(stats)
        self.take_wheels: Callable[[WheelSample], object] = nothing
        self._delay_ns = delay_ns
        self._posted: SimpleQueue[tuple[int, Delivery]] = SimpleQueue()
        self._commands: Queue[VelocityCommand] = Queue(MOST_COMMANDS)
        self._contacts = NO_CONTACT
        self._ended = False

    def send_pose(self, pose: ControllerPose) -> None:
        """Send a pose."""
        self._posted.put((pose.stamp_ns + self._delay_ns, lambda controller, _: controller.set_pose(pose)))

    def send_ring(self, ring: ControllerRing) -> None:
        """Send an obstacle ring."""
        self._posted.put((ring.stamp_ns + self._delay_ns, lambda controller, _: controller.set_ring(ring)))

    def send_setpoint(self, command: TimedSetpoint) -> None:
        """Send a setpoint."""
        self._post(lambda controller, at_ns: controller.set_command(command._replace(arrival_ns=at_ns)))

    def stop(self) -> None:
        """Stop the wheels until `arm` is called later."""
        self._post(lambda controller, at_ns: controller.stop(at_ns))

    def touch(self, contact: str, *, holds: bool) -> None:
        """Report a bumper or a cliff sensor; from one thread."""
        contacts = self._contacts = self._contacts.after(contact, holds=holds)
        self._post(lambda controller, _: controller.touch(contacts))

    def arm(self, request: ArmRequest) -> None:
        """Ask to arm."""
        self._post(lambda controller, at_ns: controller.arm(request._replace(arrival_ns=at_ns)))

    def end(self) -> None:
        """Let `commands` end when the last ones are taken; the simulation makes sure that the wheels are at rest."""
        self._ended = True

    def commands(self) -> Iterator[VelocityCommand]:
        """Yield the commands of the ticks until the end."""
        while True:
            try:
                yield self._commands.get(timeout=POLL_S)
            except Empty:
                if self._ended:
                    return

    def posted(self) -> Iterator[tuple[int, Delivery]]:
        """Yield what was sent since the last call, with the time from which it may be delivered [ns]."""
        while not self._posted.empty():
            yield self._posted.get()

    def take(self, report: TickReport) -> None:
        """Take the report of a tick; wait until its command has room."""
        self.statistics.add(report._replace(state=copy.deepcopy(report.state)))  # the controller changes its own
        while report.command is not None and not self._ended:
            try:
                self._commands.put(report.command, timeout=POLL_S)
                return
            except Full:
                pass

    def _post(self, deliver: Delivery) -> None:
        self._posted.put((0, deliver))
