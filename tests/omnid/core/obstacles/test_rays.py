"""Rings by the posterior of rays: plain floor is free, what stands on it is not, and what is not seen is not free."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from omnid.core.mapping.range_scan import azimuths
from omnid.core.obstacles.rays.belief_grid import BeliefRing
from omnid.core.obstacles.rays.pair_rings import RayRings
from omnid.core.obstacles.settings import RingSettings
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    T_RECT_BASE,
    Pattern,
    Pole,
    panoramas,
    plain,
    stains,
    striped,
    worn,
    worn_with_line,
)

WALL_M = 3.0
PAIRS, PERIOD_NS = 5, 100_000_000
AHEAD, BEHIND = np.abs(azimuths()) < math.radians(1.5), np.abs(azimuths()) > math.radians(90)


def ring_of(
    floor: Pattern,
    wall_m: float = WALL_M,
    drop_m: float = 0.0,
    pole: Pole | None = None,
    visible: np.ndarray | None = None,
    lost: np.ndarray | None = None,
) -> BeliefRing:
    """Return the ring of a base that stands, after some pairs."""
    rings = RayRings(CYLINDER, BASELINE_M, RingSettings())
    shape = CYLINDER.height, CYLINDER.width
    rings.set_floor(T_RECT_BASE, np.ones(shape, bool) if visible is None else visible)
    for pair in range(PAIRS):
        lower, upper = panoramas(floor, wall_m, striped, drop_m, pole, seed=pair)
        ring = rings.add(pair * PERIOD_NS, np.eye(4), lower, upper, lost)
    return ring


@pytest.mark.parametrize("floor", [plain, worn, stains, worn_with_line])
def test_floor_is_free_up_to_the_wall_whatever_it_shows(floor: Pattern) -> None:
    """A plain floor shows nothing, and no edge at which something could begin; a painted line is a mark."""
    ring = ring_of(floor)
    assert np.median(ring.free_m) > 0.75 * WALL_M
    assert (ring.free_m < WALL_M + 0.1).all()


@dataclass(frozen=True)
class Standing:
    """A pole straight ahead."""

    floor: Pattern
    pole: Pole


@pytest.mark.hazard("H19")
@pytest.mark.parametrize(
    "case",
    [
        Standing(plain, Pole(1.6, 0.08)),
        Standing(plain, Pole(1.3, 0.06, 90.0)),
        Standing(worn, Pole(2.0, 0.08)),
        Standing(stains, Pole(1.5, 0.08)),
        Standing(plain, Pole(0.45, 0.08)),
        Standing(worn, Pole(0.45, 0.08)),
    ],
)
def test_floor_behind_a_plain_pole_is_not_free(case: Standing) -> None:
    """What begins nearer than the floor in view shows no foot, and may stand anywhere before what it hides."""
    ring = ring_of(case.floor, pole=case.pole)
    assert ring.free_m[AHEAD].max() < max(case.pole.range_m, 0.3) + 0.15
    assert np.median(ring.free_m[BEHIND]) > 0.75 * WALL_M


def test_floor_that_falls_is_not_free() -> None:
    """The base states a floor that the images show 12 cm lower, all around."""
    assert np.median(ring_of(stains, drop_m=0.12).free_m) < 0.5


@pytest.mark.parametrize("is_lost", [False, True])
def test_what_is_not_in_view_is_not_free(is_lost: bool) -> None:
    """A quarter of the turn is masked, or its tiles are dead."""
    visible = np.ones((CYLINDER.height, CYLINDER.width), bool)
    middle = CYLINDER.width // 2
    visible[:, middle - CYLINDER.width // 8 : middle + CYLINDER.width // 8] = False
    ring = ring_of(plain, lost=~visible) if is_lost else ring_of(plain, visible=visible)
    assert ring.free_m[np.abs(azimuths()) < math.radians(35)].max() < 1.1


def test_without_floor_in_view_nothing_is_free() -> None:
    """All rows below the horizon are masked."""
    visible = np.ones((CYLINDER.height, CYLINDER.width), bool)
    visible[round(CYLINDER.row0) + 5 :] = False
    ring = ring_of(plain, visible=visible)
    assert ring.free_m.max() < 0.3
    assert not np.isinf(ring.ranges_m).any()
