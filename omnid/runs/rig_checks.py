"""Drivers of the rig's state machine: the first pairs of a log before a replay, and the pairs of a live run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.config import Config
from omnid.core.rig.rig_health import GO_ON, RigContradictedError, RigHealth
from omnid.diagnostics.load_ladder import LoadLadder
from omnid.diagnostics.rig_status import rig_status
from omnid.engine.graph import Sink
from omnid.errors import OmnidError
from omnid.load_level import LoadLevel
from omnid.messages import OdometryUpdate
from omnid.refinement.other_rig import is_suspicious, other_rig
from omnid.refinement.refined_file import RefinedRigFile
from omnid.refinement.rig_refinement import RigRefinement
from omnid.runs.session import Session
from omnid.stages.dewarp import Dewarp
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.stages.synchronise import Synchronise
from omnid.transport.records import DiagnosticStatus

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
    reason = ""
    # A damaged log is reported by the run, after the poses that there are.
    with suppress(DriverError):
        # 1. Columns of the first pairs; with the motion between their exposures where the cameras are not synchronised.
        at_once = _examine_panoramas(health, reader, place, config)
        if not at_once:
            _examine_poses(health, tracked_updates(reader, FrontEnd(place, config, health), config, log))
        # 2. Landmarks of the first keyframes, where the columns leave it open whether the rig is of other cameras.
        if is_suspicious(health.start_finding):
            finding = health.start_finding if at_once else None
            front_end = FrontEnd(place, config, RigHealth(place.cylinder, "warn"))
            reason = other_rig(tracked_updates(reader, front_end, config, log), front_end, finding)
    if reason:
        raise RigContradictedError(f"the images contradict the rig: {reason}: {GO_ON}")
    # 3. Where too little was seen, the run checks from its beginning.
    return RigHealth(place.cylinder, mode) if health.is_checking else health


def _examine_panoramas(health: RigHealth, reader: LogReader, place: Geometry, config: Config) -> bool:
    """Check the first pairs; return False if their pixels were not exposed at once, which takes odometry to check."""
    pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama, config.camera)
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


def live_health(geometry: Geometry, config: Config, file: RefinedRigFile | None) -> RigHealth:
    """Return the state of the rig of a live run; a refusal names the file of the refined rig where it is in use."""
    hint = "" if file is None or file.used is None else f"; the rig in use is {file.path}, {file.used.summary}"
    return RigHealth(geometry.cylinder, config.rig.check, config.rig.check_s, hint)


class LiveRig:
    """The rig of a live run: its state, and its refinement as far as the configuration asks for it."""

    def __init__(self, session: Session, front_end: FrontEnd, ladder: LoadLadder, file: RefinedRigFile | None) -> None:
        """ladder: the rig is refined while all landmarks are computed. file: of the refined rig; None: no file."""
        config = session.config
        self._health = front_end.health
        self._refinement: RigRefinement | None = None
        if config.rig.refine != "off":
            self._refinement = session.outputs.enter_context(
                closing(
                    RigRefinement(
                        front_end,
                        config.rig,
                        lambda: ladder.level < LoadLevel.REDUCED,
                        file,
                        session.warn,
                        has_delay=config.camera.upper_delay_ms == 0,
                    )
                )
            )
        self._used = str(file.path) if file is not None and file.used is not None else ""

    @property
    def pose_sinks(self) -> dict[str, Sink[OdometryUpdate]]:
        """Sinks of poses: the views of the drive, and the refinement."""
        sinks: dict[str, Sink[OdometryUpdate]] = {}
        if self._health.uses_views:
            sinks["rig"] = RigViews(self._health)
        if self._refinement is not None:
            sinks["refine"] = self._refinement
        return sinks

    def status(self) -> DiagnosticStatus:
        """Return the status of the rig."""
        return rig_status(self._health, self._refinement.report() if self._refinement else None, self._used)


class RigViews:
    """A sink of poses that shows their pairs to the rig's state, with the motion during their exposures."""

    def __init__(self, health: RigHealth) -> None:
        self._health = health

    def process(self, odometry: OdometryUpdate) -> None:
        """Pass a pair on."""
        self._health.drive(odometry.depth.panoramas, odometry.depth.exposure)
