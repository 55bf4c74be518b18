"""Level of load shedding: what a live run gives up while the computer is too slow. Imports no numpy."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import TypeAlias


class LoadLevel(IntEnum):
    """Level of load shedding; each level gives up what the levels before it do, and more.

    The map gives way first: it changes slowly, and its dense stereo costs half as much as a pose.
    """

    FULL = 0  # all is computed
    SPARSE_MAP = 1  # one pair a second enters the map
    NO_MAP = 2  # nothing enters the map, no place is recognised, and obstacle rings come more slowly
    REDUCED = 3  # keyframes have half the landmarks too, and obstacle rings come more slowly still


Load: TypeAlias = Callable[[], LoadLevel]  # the level now; stages call it for each pair


def full_load() -> LoadLevel:
    """Return the level of a run that gives up nothing, such as a replay."""
    return LoadLevel.FULL
