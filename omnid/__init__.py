"""Odometry and map for a robot with two stacked omnidirectional cameras: a daemon, its tools, and a Python API.

    import omnid

    result = omnid.replay("log.mcap", rig="rig.toml")     # a recorded log -> RunResult with poses and map
    result.save_tum("trajectory.tum")

    odometry = omnid.Odometry("rig.toml")                 # images in, poses out
    pose = odometry.process(stamp_ns, lower, upper)       # grey images (H, W) uint8 -> OdometryUpdate

The geometry (camera models, rigs, panoramas) is the package `calib`, a client of a running daemon is `omnid.client`.
`omnid/examples` has a program for each. Names are imported when they are first used: `import omnid` loads no numpy.
"""

import os
from typing import TYPE_CHECKING

from omnid.version import __version__

# OpenCV reads this when it is loaded. It is drivers.frame.MAX_PIXELS, which is not imported here.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(64 * 2**20))

if TYPE_CHECKING:
    from omnid.api import Odometry, replay
    from omnid.config import Config, load_config
    from omnid.errors import OmnidError
    from omnid.messages import OdometryUpdate
    from omnid.runs.run_result import RunResult
    from omnid.tracking_state import TrackingState

__all__ = ["Config", "Odometry", "OdometryUpdate", "OmnidError", "RunResult", "TrackingState", "__version__",
           "load_config", "replay"]
_MODULES = {"Config": "config", "Odometry": "api", "OdometryUpdate": "messages", "OmnidError": "errors",
            "RunResult": "runs.run_result", "TrackingState": "tracking_state", "load_config": "config", "replay": "api"}

if not TYPE_CHECKING:  # a type checker would take any name for one of this package

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used (PEP 562)."""
        from importlib import import_module

        if name not in _MODULES:
            raise AttributeError(f"module 'omnid' has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"omnid.{_MODULES[name]}"), name)
        return value

    def __dir__() -> list[str]:
        """The names of the public API."""
        return sorted({*globals(), *__all__})
