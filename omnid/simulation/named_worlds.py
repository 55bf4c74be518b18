"""Worlds like buildings by name and seed, with what is asked of a robot in them: `trial(name, seed)`.

In the harmless ones nothing is in the way of what is asked, whatever the floor looks like. In the hazards something is.
A corridor or hall is along x, and the robot starts at the origin.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import replace
from typing import Final

import numpy as np

from omnid.errors import OmnidError
from omnid.simulation import harmless_worlds, hazard_worlds
from omnid.simulation.building_parts import Builder
from omnid.simulation.trials import Trial
from omnid.simulation.world import World

FLOORS: Final = tuple(harmless_worlds.FLOORS)
HARMLESS: Final = harmless_worlds.NAMES
HAZARDS: Final = hazard_worlds.NAMES
PATTERNED: Final = ("marbled", "carpet", "parquet_across")  # floors of worlds in which something else is tried
_MAKERS: Final = harmless_worlds.MAKERS | hazard_worlds.MAKERS


def trial(name: str, seed: int, floor: str | None = None) -> Trial:
    """Return the trial of a name: same name and seed, same world; floor: another one of FLOORS."""
    for pattern, (kind, make) in _MAKERS.items():
        if found := re.fullmatch(pattern, name):
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            kind = kind or str(rng.choice(PATTERNED))
            if floor is not None:
                kind = harmless_worlds.FLOORS[floor]
            made = make(Builder(rng, kind), *found.groups())
            return replace(made, world=replace(made.world, name=name))
    raise OmnidError(f"world {name!r} is not known; the worlds like buildings are {', '.join((*HARMLESS, *HAZARDS))}")


def is_named(name: str) -> bool:
    """True if there is a world of that name."""
    return any(re.fullmatch(pattern, name) for pattern in _MAKERS)


def world(name: str, seed: int) -> World:
    """Return the world of a trial."""
    return trial(name, seed).world
