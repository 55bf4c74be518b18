"""The scan of a rendered run: the walls are where they are, and threads give the same bytes as inline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnid.config import load_config
from omnid.messages import ObstacleScan, OdometryUpdate
from omnid.runs.replay import ReplayOptions, run_log
from omnid.sinks.encoder import Outgoing


class Scans:
    """Scans of a run, and the number of its poses."""

    def __init__(self) -> None:
        self.scans: list[ObstacleScan] = []
        self.poses = 0

    def process(self, message: Outgoing) -> None:
        """Keep a scan."""
        self.poses += isinstance(message, OdometryUpdate)
        if isinstance(message, ObstacleScan):
            self.scans.append(message)


def scans_of(scene: Path, *settings: str, inline: bool = True) -> Scans:
    """Return the scans of the rendered run."""
    found = Scans()
    config = load_config(None, ["places.enabled=false", *settings])
    run_log(
        scene / "log.mcap",
        config,
        ReplayOptions(rig=scene / "rig.toml", inline=inline, observer=lambda geometry, telemetry: found),
    )
    return found


@pytest.fixture(scope="module")
def inline(scene: Path) -> Scans:
    return scans_of(scene)


def test_the_walls_of_the_corridor_stand_left_and_right(inline: Scans) -> None:
    # Left wall between 0.9 and 1.6 m, right wall between 0.8 and 1.4 m from the middle; see corridor().
    scan = inline.scans[len(inline.scans) // 2]
    left, right = scan.ranges_m[260:280], scan.ranges_m[80:100]
    assert np.isfinite(left).any() and np.isfinite(right).any()
    assert 0.6 < np.nanmedian(left) < 2.0 and 0.5 < np.nanmedian(right) < 1.8
    assert np.isfinite(scan.ranges_m).sum() > 150


def test_scans_come_at_the_rate(inline: Scans) -> None:
    # 10 pairs a second.
    assert len(inline.scans) == inline.poses


def test_scans_come_at_a_lower_rate(scene: Path, inline: Scans) -> None:
    assert abs(len(scans_of(scene, "obstacles.rate_hz=5").scans) - len(inline.scans) / 2) <= 1


def test_threads_give_the_same_bytes(scene: Path, inline: Scans) -> None:
    threaded = scans_of(scene, inline=False)
    assert [scan.seq for scan in threaded.scans] == [scan.seq for scan in inline.scans]
    for one, other in zip(threaded.scans, inline.scans, strict=True):
        assert one.ranges_m.tobytes() == other.ranges_m.tobytes()
        assert one.sigma_m.tobytes() == other.sigma_m.tobytes()


def test_off_means_off(scene: Path) -> None:
    assert not scans_of(scene, "obstacles.enabled=false").scans
