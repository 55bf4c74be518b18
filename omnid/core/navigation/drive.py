"""A drive that is under way, and the motion that follows from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.follower import Follower
from omnid.core.navigation.giving_way import GivingWay
from omnid.core.navigation.path import DrivePath
from omnid.core.navigation.requests import NavigationFrame
from omnid.navigation_state import NavigationState

Array = NDArray[np.float64]


@dataclass(slots=True)
class Drive:
    """A drive that is under way."""

    task: str  # in words
    frame: NavigationFrame
    paths: list[DrivePath]  # one after the other
    follower: Follower
    resets: int
    command_ns: int = 0  # stamp of the request
    paused: str = ""  # the reason; empty: it is not paused
    waits: dict[NavigationState, float] = field(default_factory=dict)  # s, by what is waited for
    unlocalised_m: float = 0.0  # way since the pose in the map was known
    nearest_m: float = math.inf  # way left, at the last progress
    heading_rad: float = 0.0  # at the last progress
    stuck_s: float = 0.0  # since then
    last_xy: Array | None = None  # in odom
    giving_way: GivingWay | None = None  # while it does
    gave_way: int = 0  # times, at the block before which it was
    gave_way_m: float = math.inf  # way left there


class Navigation(NamedTuple):
    """The result of a step."""

    setpoint: Setpoint | None  # in odom; None: nothing is sent
    state: NavigationState
    reason: str
    left_m: float = math.nan  # way to the end of the path
    offset_m: float = math.nan  # of the base to the left of the path
