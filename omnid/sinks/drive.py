"""Sinks that send poses, obstacles and setpoints to the controller, and the answers to requests."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.controller.link import DriveLink
from omnid.core.control.arming import PLANNER, TimedSetpoint
from omnid.core.control.control_law import ControllerPose, ControllerState
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import AWAITED
from omnid.core.navigation.requests import NavigationState
from omnid.core.rig.rig_health import RigHealth
from omnid.messages import NavigationUpdate, ObstacleScan, OdometryUpdate
from omnid.stages.obstacles import controller_scan
from omnid.tracking_state import TrackingState
from omnid.transport.status_names import with_reason
from omnid.transport.topics import Answer, Answers

NAVIGATION_SENDER: Final = "navigation"  # identity of the sender, which keeps other programs off its source


class LiveDrive:
    """Sends the controller what it drives by: poses, the obstacles around the base, setpoints of the navigation."""

    def __init__(self, link: DriveLink, T_base_rig: NDArray[np.float64], health: RigHealth) -> None:
        """health: of the rig; the wheels have no pose to turn by until the first pairs were judged."""
        self._link, self._T_base_rig, self._health = link, T_base_rig, health

    def process(self, message: OdometryUpdate | ObstacleScan | NavigationUpdate) -> None:
        """Send a message; a setpoint with a stamp of now: a source of higher priority overrides it."""
        match message:
            case OdometryUpdate():
                if not self._health.is_undecided:
                    self._link.send(controller_pose(message, self._T_base_rig))
            case ObstacleScan():
                self._link.send(controller_scan(message))
            case NavigationUpdate(setpoint=Setpoint() as setpoint):
                self._link.send(TimedSetpoint(time.monotonic_ns(), setpoint, PLANNER, NAVIGATION_SENDER))

    def finish(self) -> None:
        """Have the wheels slow down to a stop: there will be no more poses."""
        self._link.end()


def arming_answers(state: ControllerState) -> Answers:
    """Return the answer to the newest request to arm; a repeated answer has no effect."""
    answer = state.arm_answer
    text = answer.refusal or "armed: it obeys commands from now on"
    if answer.refusal == AWAITED:
        text = f"{AWAITED}: {state.problem}"
    return {answer.id: Answer(not answer.refusal, text)}


def navigation_answers(update: NavigationUpdate) -> Answers | None:
    """Return the answer to the newest request to the navigation; a repeated answer has no effect."""
    if update.answer is None:
        return None
    refusal, state = update.answer.refusal, update.state
    is_idle = state.is_end and state is not NavigationState.CANCELLED
    words = "no drive is under way" if is_idle else f"navigation: {with_reason(state, update.reason)}"
    return {update.answer.id: Answer(not refusal, refusal or f"accepted; {words}")}


def controller_pose(odometry: OdometryUpdate, T_base_rig: NDArray[np.float64]) -> ControllerPose:
    """Return the part of a pose that the controller needs; one that is not finite is LOST."""
    T_odom_base, _, velocity, covariance = odometry.of_base(T_base_rig)
    heading_rad, velocity_mps, rate_radps = float(se3.yaw(T_odom_base)), float(velocity[0]), float(velocity[5])
    # NaN must come first: `max` returns its first argument then.
    sigma_mps, sigma_radps = (math.sqrt(max(float(covariance[axis, axis]), 0.0)) for axis in (0, 5))
    finite = all(map(math.isfinite, (heading_rad, velocity_mps, rate_radps, sigma_mps, sigma_radps)))
    return ControllerPose(
        odometry.stamp_ns,
        heading_rad,
        rate_radps,
        odometry.state if finite else TrackingState.LOST,
        velocity_mps,
        sigma_mps,
        sigma_radps,
        odometry.reset_counter,
        odometry.conflict,
    )
