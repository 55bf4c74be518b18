"""Check of the rig of a log by its first pairs, before a replay."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config
from omnid.core.rig.rig_health import RigContradictedError, RigHealth
from omnid.errors import OmnidError
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry

# Pairs that are read before a replay: ten seconds of a log at 30 Hz. In the dark the run continues to check.
MOST_PAIRS: Final = 300


def examined_rig(reader: LogReader, log: Path, place: Geometry, config: Config) -> RigHealth:
    """Return the rig of a replay, decided as far as its first pairs show; RigContradictedError for a wrong rig.

    It is examined before the replay opens its outputs: a wrong rig leaves no file behind. Odometry finds the motion
    between the exposures of a pair, where these are not simultaneous.
    """
    mode = config.rig.check
    health = RigHealth(place.cylinder, mode)
    if mode != "refuse":
        return health
    try:
        for update in tracked_updates(reader, FrontEnd(place, config, health), config, log):
            if not health.is_checking or update.seq >= MOST_PAIRS:
                break
    except RigContradictedError:
        raise
    except (OmnidError, DriverError):
        pass  # A damaged log, or poses that are lost too often: the run reports them, after the poses that there are.
    # Where too little was seen, the run checks from its beginning.
    return RigHealth(place.cylinder, mode) if health.is_checking else health
