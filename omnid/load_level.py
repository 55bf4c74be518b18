"""Level of load shedding: the work that a live run omits while the computer is too slow. Imports no numpy."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import TypeAlias


class LoadLevel(IntEnum):
    """Level of load shedding; each level omits the work that the levels before it omit, and more.

    The map is omitted first: it changes slowly, and its dense stereo costs half as much as a pose.
    """

    FULL = 0  # all is computed
    SPARSE_MAP = 1  # one pair a second enters the map
    NO_MAP = 2  # nothing enters the map, no place is recognised, and obstacle rings come more slowly
    REDUCED = 3  # keyframes have half the landmarks too, and obstacle rings come more slowly still


Load: TypeAlias = Callable[[], LoadLevel]  # the level now; stages call it for each pair


def full_load() -> LoadLevel:
    """Return the level of a run that omits nothing, such as a replay."""
    return LoadLevel.FULL
