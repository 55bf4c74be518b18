"""Examine the rig by the first pairs of a log, before a replay opens its outputs: a wrong rig leaves no file behind."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config
from omnid.refinement.foreign_rig import is_suspicious, other_rig
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry
from omnid.stages.rig_gate import RigContradictedError, RigGate
from omnid.stages.synchronise import Synchronise

MOST_PAIRS: Final = 300  # that are read, in the dark, before the run decides on its way
REMEDY: Final = ("give the rig of these cameras with --rig, or go on all the same with --set stereo.rig_check=warn")


def examined_gate(reader: LogReader, log: Path, place: Geometry, config: Config) -> RigGate:
    """Return the gate of a replay, which has decided if the first pairs tell; RigContradictedError for a wrong rig.

    Cameras that are not synchronised are left to the run, which knows the motion between their exposures.
    """
    mode = config.stereo.rig_check
    gate = RigGate(place.cylinder, mode)
    if mode != "refuse":
        return gate
    pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama, config.camera)
    with suppress(DriverError):  # of a damaged log: the run tells after the poses that there are
        for frame in reader.frames():
            pair = pairing.process(frame)
            if pair is None:
                continue
            panoramas = dewarp.process(pair)
            if panoramas.times is not None:
                return gate
            gate.process(panoramas)
            if not gate.is_active or pair.seq >= MOST_PAIRS:
                break
    if is_suspicious(gate.finding):
        reason = other_rig(tracked_updates(reader, place, config, log), place)
        if reason:
            raise RigContradictedError(f"the images contradict the rig: {reason}: {REMEDY}")
    return gate if not gate.is_active else RigGate(place.cylinder, mode)
