"""Odometry and map for a robot with two stacked omnidirectional cameras: a daemon, its tools, and a Python API.

    import omnid

    result = omnid.replay("log.mcap", rig="rig.toml")     # a recorded log -> RunResult with poses and map
    result.save_tum("trajectory.tum")

    odometry = omnid.Odometry("rig.toml")                 # images in, poses out
    pose = odometry.process(stamp_ns, lower, upper)       # grey images (H, W) uint8 -> OdometryUpdate

    found = omnid.calibrate_rig("boards/", omnid.Board(6, 7, 0.03), view="mirror")   # also calibrate_drive
    print(found)
    found.save("rig.toml")

The geometry (camera models, rigs, panoramas) is the package `calib`, a client of a running daemon is `omnid.client`.
`omnid/examples` has a program for each. Names are imported when they are first used: `import omnid` loads no numpy.
"""

from typing import TYPE_CHECKING

from omnid.version import __version__

if TYPE_CHECKING:
    from calib.boards.board import Board as Board
    from omnid.api import Odometry as Odometry
    from omnid.api import replay as replay
    from omnid.calibration.drive import calibrate_drive as calibrate_drive
    from omnid.calibration.from_log import calibrate_height as calibrate_height
    from omnid.calibration.from_log import calibrate_mask as calibrate_mask
    from omnid.calibration.rig import calibrate_rig as calibrate_rig
    from omnid.config import Config as Config
    from omnid.config import load_config as load_config
    from omnid.errors import OmnidError as OmnidError
    from omnid.messages import OdometryUpdate as OdometryUpdate
    from omnid.runs.replay import RunResult as RunResult
    from omnid.tracking_state import TrackingState as TrackingState

_MODULES = {
    "Board": "calib.boards.board",
    "Config": "omnid.config",
    "Odometry": "omnid.api",
    "OdometryUpdate": "omnid.messages",
    "OmnidError": "omnid.errors",
    "RunResult": "omnid.runs.replay",
    "TrackingState": "omnid.tracking_state",
    "calibrate_drive": "omnid.calibration.drive",
    "calibrate_height": "omnid.calibration.from_log",
    "calibrate_mask": "omnid.calibration.from_log",
    "calibrate_rig": "omnid.calibration.rig",
    "load_config": "omnid.config",
    "replay": "omnid.api",
}
__all__ = ["__version__", *_MODULES]

if not TYPE_CHECKING:  # a type checker would take any name for one of this package

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used (PEP 562)."""
        from importlib import import_module

        if name not in _MODULES:
            raise AttributeError(f"module 'omnid' has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_MODULES[name]), name)
        return value
