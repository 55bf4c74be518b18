"""A controller on a bench: a motor driver that keeps its commands, and a clock that is set by hand."""

from __future__ import annotations

import math
from dataclasses import replace

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.motor_protocol import DifferentialDrive
from omnid.controller.controller import Controller
from omnid.controller.link import ControllerStatistics
from omnid.core.control.arming import AUTOMATIC, OPERATOR, ArmRequest, TimedSetpoint
from omnid.core.control.control_law import ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import Setpoint, VelocityLimits
from omnid.core.control.motion_monitor import AGREE, Conflict, TrustSettings
from omnid.core.control.safety_rules import Deadlines
from omnid.engine.graph import StageStats

PERIOD_S = 0.05
PERIOD_NS = 50_000_000
LIMITS = VelocityLimits(
    velocity_mps=0.4, acceleration_mps2=0.6, deceleration_mps2=1.5, yaw_rate_radps=0.8, yaw_acceleration_radps2=4.0
)
SETTINGS = ControllerSettings(Deadlines(), LIMITS, trust=TrustSettings(battery_v=11.0)).without_obstacles
UNATTENDED = replace(SETTINGS, arming=AUTOMATIC)
AHEAD = Setpoint(0.3, None, 0.0)


class Wheels:
    """A motor driver that keeps its commands; `silent` and `expired`: behaviour at the next command."""

    def __init__(self) -> None:
        self.commands: list[VelocityCommand] = []
        self.silent = self.expired = self.closed = False
        self.heading_rad, self.drive = math.nan, DifferentialDrive()
        self.fault, self.battery_v = 0, math.nan  # of its reports
        self.bumper = self.cliff = False  # of its reports
        self.velocity_mps: float | None = 0.0  # of its reports; None: as commanded

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Keep the command."""
        if self.silent:
            raise DriverError("motor on /dev/x gave no answer")
        self.commands.append(command)
        velocity_mps, yaw_rate_radps = self.drive.limited(command)
        if self.velocity_mps is not None:
            velocity_mps, yaw_rate_radps = self.velocity_mps, 0.0
        return MotorStatus(
            velocity_mps,
            self.heading_rad,
            yaw_rate_radps,
            self.expired,
            self.fault,
            self.battery_v,
            self.bumper,
            self.cliff,
        )

    def close(self) -> None:
        """Note that it was closed."""
        self.closed = True


class Bench:
    """A controller on a clock that is set by hand; drive: limits the commands, as the driver of a real base does."""

    def __init__(self, settings: ControllerSettings = SETTINGS, drive: DifferentialDrive | None = None) -> None:
        self.now_ns = 10**12
        self.unattended = settings.arming == AUTOMATIC
        self.wheels = Wheels()
        self.lines: list[str] = []
        self.wheels.drive = drive or self.wheels.drive
        self.controller = Controller(
            self.wheels,
            settings,
            PERIOD_S,
            self.lines.append,
            clock_ns=lambda: self.now_ns,
            limited=drive.limited if drive else None,
        )
        self.statistics = ControllerStatistics(StageStats())

    @property
    def last(self) -> VelocityCommand:
        return self.wheels.commands[-1]

    def send_pose(
        self,
        heading_rad: float = 0.0,
        *,
        state: str = "tracking",
        rate_radps: float = 0.0,
        age_s: float = 0.0,
        velocity_mps: float = math.nan,
        sigma_mps: float = 0.0,
        resets: int = 0,
        conflict: Conflict = AGREE,
    ) -> None:
        self.controller.take(
            ControllerPose(
                self.now_ns - round(age_s * 1e9),
                heading_rad,
                rate_radps,
                state,
                velocity_mps,
                sigma_mps,
                resets=resets,
                conflict=conflict,
            )
        )

    def send_setpoint(self, setpoint: Setpoint = AHEAD, source: str = OPERATOR, sender: str = "") -> None:
        self.now_ns += 1
        self.controller.take(TimedSetpoint(self.now_ns, setpoint, source, sender))

    def stop(self) -> None:
        self.controller.stop(self.now_ns)

    def arm(self) -> None:
        self.now_ns += 1
        self.controller.take(ArmRequest(self.now_ns, self.now_ns))

    def tick(self, late_s: float = 0.0) -> None:
        self.now_ns += PERIOD_NS + round(late_s * 1e9)
        self.statistics.add(self.controller.tick())

    def drive(self, ticks: int = 20, setpoint: Setpoint = AHEAD) -> None:
        if not self.unattended:
            self.send_pose()
            self.arm()
            self.tick()
        for _ in range(ticks):
            self.send_pose()
            self.send_setpoint(setpoint)
            self.tick()
