"""The time between the exposures of a pair, by the stamps of many."""

from __future__ import annotations

import random

import pytest

from omnid.stages.synchronise import Skew

MS = 1_000_000


def after(skews_ns: list[float]) -> float:
    """The time between the exposures of the last pair, in ms."""
    skew = Skew()
    for value in skews_ns:
        skew.add(round(value))
    return skew.exposure_ns / MS


def test_cameras_that_are_triggered_together_are_simultaneous_however_their_stamps_scatter() -> None:
    rng = random.Random(1)
    for count in (1, 5, 8, 20, 100):
        assert after([rng.uniform(-2, 2) * MS for _ in range(count)]) == 0.0


def test_the_skew_of_free_cameras_is_found_below_the_scatter_of_the_stamps() -> None:
    rng = random.Random(2)
    assert after([15 * MS]) == 15.0
    assert after([15 * MS + rng.gauss(0, MS) for _ in range(60)]) == pytest.approx(15.0, abs=1.0)
    assert after([-9 * MS + rng.gauss(0, 0.1 * MS) for _ in range(60)]) == pytest.approx(-9.0, abs=0.1)


def test_the_skew_of_drifting_clocks_is_followed() -> None:
    rng = random.Random(3)
    drifting = [5 * MS + 0.2 * MS * index + rng.gauss(0, 0.1 * MS) for index in range(100)]
    assert after(drifting) == pytest.approx(5 + 0.2 * 99, abs=0.15)


def test_another_skew_after_a_lost_image_counts_at_once() -> None:
    assert after([14 * MS] * 40 + [-19 * MS]) == -19.0
