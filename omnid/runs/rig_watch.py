"""Watch over the rig of a live run: the monitor of its calibration, and the refinement."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from calib.rig import Rig
from omnid.config import Config
from omnid.diagnostics.load_ladder import LoadLadder
from omnid.diagnostics.rig_monitor import RigMonitor, RigMonitorSink
from omnid.engine.graph import Sink
from omnid.messages import OdometryUpdate
from omnid.refinement.rig_application import RigApplication
from omnid.refinement.rig_refinement import RigRefinement
from omnid.runs.session import Session
from omnid.stages.geometry import GeometryVersions


class RigWatch:
    """Monitor and refinement, as far as the configuration asks for them; `parts` are those there are."""

    def __init__(self, session: Session, versions: GeometryVersions, config: Config, ladder: LoadLadder,
                 publish: Callable[[Rig], None], *, from_log: bool) -> None:
        """publish: takes a refined rig. from_log: the rig is the attachment of a log, so that no file is changed.

        ladder: the rig is refined while all landmarks are computed.
        """
        self.monitor = RigMonitor(versions[0].cylinder, config.live.check_s) if config.live.check_s else None
        self.refinement: RigRefinement | None = None
        if config.rig.refine == "off":
            return
        application: RigApplication | None = None
        if config.rig.refine == "apply":
            path = None if from_log else Path(config.cameras.rig)
            application = RigApplication(versions, path, publish, session.warn)
        self.refinement = session.outputs.enter_context(closing(
            RigRefinement(versions, config.rig, lambda: ladder.level.features >= 1, application,
                          has_delay=config.camera.upper_delay_ms == 0)))

    @property
    def parts(self) -> list[RigMonitor | RigRefinement]:
        """The parts with a status."""
        return [part for part in (self.monitor, self.refinement) if part]

    @property
    def sink(self) -> Sink[OdometryUpdate] | None:
        """The monitor as a sink of poses."""
        return RigMonitorSink(self.monitor) if self.monitor else None

    @property
    def pose_sinks(self) -> dict[str, Sink[OdometryUpdate]]:
        """The refinement as a sink of poses."""
        return {"refine": self.refinement} if self.refinement else {}

    def is_broken(self) -> bool:
        """True while the monitor finds the rig broken."""
        return self.monitor is not None and self.monitor.contradicted
