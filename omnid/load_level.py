"""Level of load shedding: the work that a live run omits while the computer is too slow. Imports no numpy."""

from __future__ import annotations

from enum import IntEnum


class LoadLevel(IntEnum):
    """Level of load shedding; each level omits the work that the levels before it omit, and more.

    The map is omitted first: it changes slowly, and its dense stereo costs half as much as a pose. Each pair of images
    carries the level to all stages. A replay omits nothing.
    """

    FULL = 0  # all is computed
    SPARSE_MAP = 1  # one pair a second enters the map
    NO_MAP = 2  # nothing enters the map, no place is recognised, and obstacle rings come more slowly
    REDUCED = 3  # keyframes have half the landmarks too, and obstacle rings come more slowly still
