"""Examine the rig by the first pairs of a log, before a replay opens its outputs: a wrong rig leaves no file behind."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.refinement.foreign_rig import is_suspicious, other_rig
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry
from omnid.stages.rig_gate import RigContradictedError, RigGate
from omnid.stages.synchronise import Synchronise

MOST_PAIRS: Final = 300  # that are read, in the dark, before the run decides on its way
REMEDY: Final = ("give the rig of these cameras with --rig, or go on all the same with --set stereo.rig_check=warn")


def examined_gate(reader: LogReader, log: Path, place: Geometry, config: Config) -> RigGate:
    """Return the gate of a replay, which has decided if the first pairs tell; RigContradictedError for a wrong rig."""
    mode = config.stereo.rig_check
    gate = RigGate(place.cylinder, mode)
    if mode != "refuse":
        return gate
    reason = ""
    with suppress(DriverError):  # of a damaged log: the run tells after the poses that there are
        at_once = _examine_panoramas(gate, reader, place, config)
        if not at_once:
            _examine_poses(gate, tracked_updates(reader, place, config, log, gate))
        if is_suspicious(gate.finding):
            finding = gate.finding if at_once else None
            reason = other_rig(tracked_updates(reader, place, config, log), place, finding)
    if reason:
        raise RigContradictedError(f"the images contradict the rig: {reason}: {REMEDY}")
    return gate if not gate.is_active else RigGate(place.cylinder, mode)


def _examine_panoramas(gate: RigGate, reader: LogReader, place: Geometry, config: Config) -> bool:
    """Show the gate the first pairs; return False where it takes odometry, as they were not exposed at one time."""
    pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama, config.camera)
    for frame in reader.frames():
        pair = pairing.process(frame)
        if pair is None:
            continue
        panoramas = dewarp.process(pair)
        if panoramas.times is not None:
            return False
        gate.process(panoramas)
        if not gate.is_active or pair.seq >= MOST_PAIRS:
            break
    return True


def _examine_poses(gate: RigGate, updates: Iterator[OdometryUpdate]) -> None:
    """Let the gate see the first pairs together with the motion between their exposures, which odometry finds."""
    try:
        for update in updates:
            if not gate.is_active or update.seq >= MOST_PAIRS:
                break
    except RigContradictedError:
        raise
    except OmnidError:
        return  # the poses are lost too often: the run tells
