"""Load shedding: given up step by step under overload, taken up again later, with patience where that was too soon."""

from __future__ import annotations

from omnid.diagnostics.load_ladder import OBSERVATIONS_DOWN, OBSERVATIONS_UP, LoadLadder
from omnid.engine.telemetry import StageStats
from omnid.load_level import LoadLevel


class Observed:
    """A ladder, and the counters that it observes."""

    def __init__(self) -> None:
        self.ladder, self._stats = LoadLadder(), StageStats("pair")

    def level_after(self, count: int, *, dropped: int) -> int:
        """Return the level after so many observations, with so many of 60 images dropped in each."""
        for _ in range(count):
            self._stats.processed += 60 - dropped
            self._stats.dropped += dropped
            self.ladder.observe(self._stats)
        return self.ladder.level


def test_under_lasting_overload_everything_is_given_up_in_order() -> None:
    observed = Observed()
    assert observed.level_after(OBSERVATIONS_UP - 1, dropped=30) == 0
    assert [observed.level_after(1, dropped=30)] + [
        observed.level_after(OBSERVATIONS_UP, dropped=30) for _ in range(4)
    ] == [1, 2, 3, 3, 3]
    assert observed.ladder.level is LoadLevel.REDUCED


def test_it_waits_longer_each_time_that_was_too_soon() -> None:
    observed = Observed()
    waits = []
    for _ in range(8):
        observed.level_after(OBSERVATIONS_UP, dropped=30)
        waits.append(next(k for k in range(1, 1000) if observed.level_after(1, dropped=0) == 0))
    assert waits[:3] == [OBSERVATIONS_DOWN, 2 * OBSERVATIONS_DOWN, 4 * OBSERVATIONS_DOWN]
    assert waits[-1] == waits[-2] == 320
