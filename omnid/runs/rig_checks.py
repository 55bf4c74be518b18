"""Drivers of the rig's state machine: the first pairs of a log before a replay, and the pairs of a live run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config
from omnid.core.rig.rig_health import RigContradictedError, RigHealth
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.stages.dewarp import Dewarp
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.stages.synchronise import Synchronise

# Pairs that are read before a replay: ten seconds of a log at 30 Hz. In the dark the run continues to check.
MOST_PAIRS: Final = 300


def examined_rig(reader: LogReader, log: Path, place: Geometry, config: Config) -> RigHealth:
    """Return the rig of a replay, decided as far as its first pairs show; RigContradictedError for a wrong rig.

    It is examined before the replay opens its outputs: a wrong rig leaves no file behind.
    """
    mode = config.rig.check
    health = RigHealth(place.cylinder, mode)
    if mode != "refuse":
        return health
    # 1. Columns of the first pairs; with the motion between their exposures where the cameras are not synchronised.
    # A damaged log is reported by the run, after the poses that there are.
    with suppress(DriverError):
        if not _examine_panoramas(health, reader, place, config):
            _examine_poses(health, tracked_updates(reader, FrontEnd(place, config, health), config, log))
    # 2. Where too little was seen, the run checks from its beginning.
    return RigHealth(place.cylinder, mode) if health.is_checking else health


def _examine_panoramas(health: RigHealth, reader: LogReader, place: Geometry, config: Config) -> bool:
    """Check the first pairs; return False if their pixels were not exposed at once, which takes odometry to check."""
    pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama)
    for frame in reader.frames():
        pair = pairing.process(frame)
        if pair is None:
            continue
        panoramas = dewarp.process(pair)
        if not panoramas.times.is_at_once:
            return False
        health.begin(panoramas)
        if not health.is_checking or pair.seq >= MOST_PAIRS:
            break
    return True


def _examine_poses(health: RigHealth, updates: Iterator[OdometryUpdate]) -> None:
    """Check the first pairs together with the motion between their exposures, which odometry finds."""
    try:
        for update in updates:
            if not health.is_checking or update.seq >= MOST_PAIRS:
                break
    except RigContradictedError:
        raise
    except OmnidError:
        return  # The poses are lost too often, which the run reports.


class RigViews:
    """A sink of poses that shows their pairs to the rig's state, with the motion during their exposures."""

    def __init__(self, health: RigHealth) -> None:
        self._health = health

    def process(self, odometry: OdometryUpdate) -> None:
        """Pass a pair on."""
        self._health.drive(odometry.depth.panoramas, odometry.depth.exposure)
