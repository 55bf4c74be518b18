"""The ring of a rendered run: the walls are where they are, and threads give the same bytes as inline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnid.config import load_config
from omnid.messages import ObstacleRing, OdometryUpdate
from omnid.runs.replay import ReplayOptions, run_log
from omnid.sinks.encoder import Outgoing


class Rings:
    """Rings of a run, and the number of its poses."""

    def __init__(self) -> None:
        self.rings: list[ObstacleRing] = []
        self.poses = 0

    def process(self, message: Outgoing) -> None:
        """Keep a ring."""
        self.poses += isinstance(message, OdometryUpdate)
        if isinstance(message, ObstacleRing):
            self.rings.append(message)


def rings_of(scene: Path, *settings: str, inline: bool = True) -> Rings:
    """Return the rings of the rendered run."""
    found = Rings()
    config = load_config(None, ["places.enabled=false", *settings])
    run_log(
        scene / "log.mcap",
        config,
        ReplayOptions(rig=scene / "rig.toml", inline=inline, observer=lambda geometry, telemetry: found),
    )
    return found


@pytest.fixture(scope="module")
def inline(scene: Path) -> Rings:
    return rings_of(scene)


def test_the_walls_of_the_corridor_stand_left_and_right(inline: Rings) -> None:
    # Left wall between 0.9 and 1.6 m, right wall between 0.8 and 1.4 m from the middle; see corridor().
    ring = inline.rings[len(inline.rings) // 2]
    left, right = ring.ranges_m[260:280], ring.ranges_m[80:100]
    assert np.isfinite(left).any() and np.isfinite(right).any()
    assert 0.6 < np.nanmedian(left) < 2.0 and 0.5 < np.nanmedian(right) < 1.8
    assert np.isfinite(ring.ranges_m).sum() > 150


def test_rings_come_at_the_rate(inline: Rings) -> None:
    # 10 pairs a second.
    assert len(inline.rings) == inline.poses


def test_rings_come_at_a_lower_rate(scene: Path, inline: Rings) -> None:
    assert abs(len(rings_of(scene, "obstacles.rate_hz=5").rings) - len(inline.rings) / 2) <= 1


def test_threads_give_the_same_bytes(scene: Path, inline: Rings) -> None:
    threaded = rings_of(scene, inline=False)
    assert [ring.seq for ring in threaded.rings] == [ring.seq for ring in inline.rings]
    for one, other in zip(threaded.rings, inline.rings, strict=True):
        assert one.ranges_m.tobytes() == other.ranges_m.tobytes()
        assert one.sigma_m.tobytes() == other.sigma_m.tobytes()


def test_off_means_off(scene: Path) -> None:
    assert not rings_of(scene, "obstacles.enabled=false").rings
