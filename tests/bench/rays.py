"""Pictures of the posterior of rays: `python -m tests.bench.rays FILE.png [WORLD ...]`.

The base drives ahead for some seconds; of the last pair a panel shows for each direction the probability by range that
the first object begins there (dark), and the range up to which floor is likelier than an object (blue).
"""

from __future__ import annotations

import sys
from collections import deque
from typing import Any, Final

import matplotlib.figure
import numpy as np

from omnid.config import load_config
from omnid.core.obstacles import ray_scans
from omnid.core.obstacles.plane_view import AZIMUTHS
from omnid.core.obstacles.posterior import RayBelief
from tests.bench.obstacles import Array, Asker, Planned, prepared, settings_for
from tests.simulation.disturbed import simulate

WORLDS: Final = ("plain", "ramp_5", "plain_pole", "edge_15cm", "plain_open_door")
SEED: Final = 120
DRIVES_S: Final = 4.0
HALF_RAD: Final = np.pi / 2  # about the way ahead that is shown
RANGES_M: Final = np.arange(0.6, 4.5, 0.02)


def last_belief(world: str) -> RayBelief:
    """Return the belief of the last pair of a drive."""
    planned, beliefs = Planned(world, SEED), deque[RayBelief](maxlen=1)
    asked, robot = prepared(planned)
    config, asker = load_config(None, settings_for(planned)), Asker(asked, planned)
    original = ray_scans.ray_belief

    def kept(*given: Any) -> RayBelief:
        beliefs.append(original(*given))
        return beliefs[0]

    ray_scans.ray_belief = kept
    try:
        simulate(asked.world, robot, asker, seconds=DRIVES_S, seed=SEED, config=config)
    finally:
        ray_scans.ray_belief = original
    return beliefs[0]


def draw(axes: Any, world: str, belief: RayBelief) -> None:
    """Draw a panel."""
    shown = np.flatnonzero(np.abs(AZIMUTHS) < HALF_RAD)[::-1]
    bins = np.clip(np.searchsorted(belief.ends_m, RANGES_M) - 1, 0, len(belief.ends_m) - 2)
    by_range: Array = belief.first[shown][:, bins]
    degrees = np.degrees(AZIMUTHS[shown])
    extent = (degrees[0], degrees[-1], RANGES_M[0], RANGES_M[-1])
    axes.imshow(by_range.T, origin="lower", aspect="auto", extent=extent, cmap="Greys", vmin=0.0, vmax=0.5)
    is_floor = np.cumsum(belief.first[shown], axis=1) < 0.5
    axes.plot(degrees, belief.ends_m[is_floor.sum(axis=1).clip(0, len(belief.ends_m) - 1)], lw=1)
    axes.set_title(world)
    axes.set_xlabel("azimuth, deg")
    axes.set_xlim(degrees[-1], degrees[0])
    axes.set_ylim(0.6, 4.5)


def main() -> None:
    """Write the picture."""
    file, *worlds = sys.argv[1:]
    names = worlds or WORLDS
    figure = matplotlib.figure.Figure(figsize=(2.6 * len(names), 2.8), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
    for axes, world in zip(panels, names, strict=True):
        draw(axes, world, last_belief(world))
    panels[0].set_ylabel("range, m")
    figure.savefig(file, dpi=72, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
