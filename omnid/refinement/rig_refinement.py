"""Watch the rig of a run by the same landmarks seen from near and from far, which shows errors of elevation and scale.

Landmarks of a window of keyframes are followed in a thread of the daemon; the bundle adjustment runs in a process of
its own at the lowest priority, because a thread would hold Python's global lock. One window at a time, then a pause.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, TypeAlias

import numpy as np

from calib import se3
from calib.fit.drive_parameters import UPPER_DELAY
from omnid.calibration.drive_observations import DriveCollector, KeyframeChoice
from omnid.config import RigConfig
from omnid.messages import OdometryUpdate
from omnid.refinement.estimate import RefinementRequest, RigChange
from omnid.stages.geometry import Geometry, GeometryVersions
from omnid.tracking_state import TrackingState
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.status_names import RIG_REFINEMENT

PROCESS = "omnid.refinement.process"
KEYFRAME_M, KEYFRAME_RAD = 0.25, np.deg2rad(15)
LANDMARKS = 200  # in view of a keyframe
TIMEOUT_S = 300.0  # of an estimate, which takes some seconds of processor time
ADVICE = ("the landmarks of this run do not fit the rig: a camera or a mirror has moved, or the calibration was not "
          "good: run omnid calibrate drive on a recording")


DELAY_ADVICE = ("the upper camera is exposed at other times than its stamps say: set camera.upper_delay_ms, or run "
                "omnid calibrate drive on a recording")
PENDING = "the landmarks of this run do not fit the rig: the refined one is used as soon as the robot stands"
TOO_LARGE = ADVICE + "; the change is too large to be applied while the robot runs"
APPLIED = "a refined rig is in use: not estimated again yet"
# A robot stands if its pose stays that near for that time.
STAND_M, STAND_RAD, STAND_S = 0.01, np.deg2rad(0.3), 2.0


@dataclass(frozen=True, slots=True)
class AppliedChange:
    """A change that the run has begun to use, when, and the file into which it was written, or why it was not."""

    change: RigChange
    stamp_ns: int
    file: str


Apply: TypeAlias = Callable[[RigChange], str]


def always() -> bool:
    """Return True."""
    return True


class RigRefinement:
    """A sink of poses that estimates the rig's errors; its inbox drops the oldest (policy NEWEST)."""

    def __init__(self, place: Geometry | GeometryVersions, settings: RigConfig,
                 has_time: Callable[[], bool] = always, apply: Apply | None = None, *, has_delay: bool = True) -> None:
        """has_time: False under overload, when no keyframe is added.

        has_delay: False if the upper camera's delay is given by the configuration, and not estimated.
        apply: takes a change that counts, once the robot stands, and begins a version of the geometry with its rig;
        None: changes are only told.
        """
        self._versions = place if isinstance(place, GeometryVersions) else GeometryVersions(place)
        self._settings, self._has_time, self._apply, self._has_delay = settings, has_time, apply, has_delay
        self._version = 0
        self._standing = _Standing()
        self._pending: RigChange | None = None  # to be applied when the robot stands
        self._applied: AppliedChange | None = None
        self._count = 0
        self._window: DriveCollector | None = None
        self._choice = KeyframeChoice()
        self._resets = 0
        self._next_ns: float = -float("inf")
        self._newest_ns = 0
        self._child: _Estimate | None = None
        self._windows = self._failed = 0
        self._reason = ""  # of the newest window that told nothing
        # With its stamp, set in one assignment: status() runs in another thread.
        self._found: tuple[RigChange, int] | None = None

    @property
    def found(self) -> RigChange | None:
        """The newest estimate; None before the first."""
        return self._found[0] if self._found else None

    def process(self, update: OdometryUpdate) -> None:
        """Add a keyframe to the window if it is one, start the estimate of a full window, take its result."""
        self._newest_ns = update.stamp_ns
        version = update.depth.panoramas.rig_version
        if version != self._version:  # keyframes and estimates of the rig of before tell nothing about this one
            self.close()
            self._version, self._window, self._found, self._next_ns = version, None, None, update.stamp_ns
        self._standing.observe(update)
        if self._pending is not None and self._standing.lasts:
            self._apply_pending(update.stamp_ns)
        if self._versions.newest != self._version:
            return  # the next pairs are of the new version
        if self._child is not None:
            self._take_answer()
        elif self._has_time() and not self._next_ns - self._settings.refine_s * 1e9 <= update.stamp_ns < self._next_ns:
            self._extend(update)

    def finish(self) -> None:
        """Wait for the estimate under way: a log has ended."""
        if self._child is not None:
            self._child.wait()
            self._take_answer()

    def close(self) -> None:
        """End the estimate under way."""
        if self._child is not None:
            self._child.close()
            self._child = None

    def _extend(self, update: OdometryUpdate) -> None:
        window = self._window
        if window is None or update.state is TrackingState.LOST or update.reset_counter != self._resets:
            window = self._window = DriveCollector(self._versions[self._version], LANDMARKS)
            self._choice, self._resets = KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD), update.reset_counter
        if not self._choice.takes(update) or update.state is TrackingState.LOST:
            return
        window.add(update, update.velocity)
        if window.keyframes >= self._settings.refine_keyframes:
            drives = window.drives(update.T_odom_rig)
            rig = self._versions[self._version].rig
            self._child = _Estimate(RefinementRequest(rig, drives.state, drives.observations, self._has_delay))
            self._window, self._next_ns = None, update.stamp_ns + self._settings.refine_s * 1e9

    def _take_answer(self) -> None:
        """Take the result of the estimate if it has ended, or end it if it takes too long."""
        assert self._child is not None
        answer = self._child.answer()
        if answer is None:
            return
        self._child = None
        self._windows += 1
        if isinstance(answer, RigChange):
            self._found = answer, self._newest_ns
            self._reason = ""
            counts = self._apply is not None and answer.is_significant and answer.is_small
            self._pending = answer if counts else None
        else:
            self._failed, self._reason = self._failed + 1, answer

    def _apply_pending(self, stamp_ns: int) -> None:
        """Let the run go on with the pending rig."""
        assert self._apply is not None and self._pending is not None
        change, self._pending = self._pending, None
        self._applied = AppliedChange(change, stamp_ns, self._apply(change))
        self._count += 1

    def status(self) -> DiagnosticStatus:
        """Return the newest estimate as a status; age_s is the time since then, by the stamps."""
        window, found, applied = self._window, self._found, self._applied
        values = {"windows": str(self._windows), "windows_without_result": str(self._failed),
                  "keyframes": str(window.keyframes if window else 0),
                  "needed_keyframes": str(self._settings.refine_keyframes), "applied": str(self._count)}
        if applied is not None:
            values |= _parameters(applied.change, "applied_") | {
                "applied_age_s": f"{(self._newest_ns - applied.stamp_ns) * 1e-9:.0f}", "applied_file": applied.file}
        if found is None:
            message = self._reason.replace("calibrate drive: ", "") or "not estimated yet: the robot must drive"
            return DiagnosticStatus(RIG_REFINEMENT, OK, message if applied is None else APPLIED, values)
        change, stamp_ns = found
        values |= {"error_px": f"{change.error_px:.3f}", "refined_error_px": f"{change.refined_error_px:.3f}",
                   "landmarks": str(change.landmarks), "age_s": f"{(self._newest_ns - stamp_ns) * 1e-9:.0f}"}
        if not change.is_significant:
            return DiagnosticStatus(RIG_REFINEMENT, OK, "the rig fits the landmarks of this run",
                                    values | _lengths(change) | _delay(change))
        values |= _parameters(change)
        if self._pending is not None:
            return DiagnosticStatus(RIG_REFINEMENT, WARN, PENDING, values)
        if not change.has_moved:
            return DiagnosticStatus(RIG_REFINEMENT, WARN, DELAY_ADVICE, values)
        return DiagnosticStatus(RIG_REFINEMENT, WARN, ADVICE if change.is_small else TOO_LARGE, values)


def _lengths(change: RigChange, prefix: str = "") -> dict[str, str]:
    """Return the change of lengths, with its sigma."""
    return {f"{prefix}lengths_percent": f"{100 * change.lengths:+.3f}",
            f"{prefix}lengths_sigma_percent": f"{100 * change.lengths_sigma:.3f}"}


def _delay(change: RigChange, prefix: str = "") -> dict[str, str]:
    """Return the estimated delay of the upper camera's exposures against the stamps, with its sigma."""
    if change.delay_ms is None:
        return {}
    before, after, sigma = change.delay_ms
    return {f"{prefix}upper_delay_ms_before": f"{before:.3f}", f"{prefix}upper_delay_ms_after": f"{after:.3f}",
            f"{prefix}upper_delay_ms_sigma": f"{sigma:.3f}"}


def _parameters(change: RigChange, prefix: str = "") -> dict[str, str]:
    """Return every parameter before and after a change, with its sigma, and the change of lengths."""
    values = _lengths(change, prefix) | _delay(change, prefix)
    for name, before, after, sigma in zip(change.names, change.before, change.after, change.sigmas, strict=True):
        if name == UPPER_DELAY:
            continue
        key = prefix + name.replace(" ", "_")
        values |= {f"{key}_before": f"{before:.6g}", f"{key}_after": f"{after:.6g}", f"{key}_sigma": f"{sigma:.2g}"}
    return values


class _Standing:
    """Time for which the robot has stood, by the poses."""

    def __init__(self) -> None:
        self._T_odom_rig, self._since_ns, self._resets = np.eye(4), 0, -1  # of the first pose since it stands
        self.lasts = False  # True once it has stood for STAND_S

    def observe(self, update: OdometryUpdate) -> None:
        """Take a pose."""
        moved = se3.log(se3.inverse(self._T_odom_rig) @ update.T_odom_rig)
        stands = np.linalg.norm(moved[:3]) < STAND_M and np.linalg.norm(moved[3:]) < STAND_RAD
        if stands and update.reset_counter == self._resets and update.state is not TrackingState.LOST:
            self.lasts = update.stamp_ns - self._since_ns >= STAND_S * 1e9
        else:
            self._T_odom_rig, self._since_ns, self._resets = update.T_odom_rig, update.stamp_ns, update.reset_counter
            self.lasts = False


class _Estimate:
    """A process that works on one request."""

    def __init__(self, request: RefinementRequest) -> None:
        self._started_s = time.monotonic()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1",
                                    "OPENBLAS_NUM_THREADS": "1"}
        self._out: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed when the answer is read)
        with tempfile.TemporaryFile() as file:
            pickle.dump(request, file)
            file.seek(0)
            self._process = subprocess.Popen([sys.executable, "-P", "-m", PROCESS], stdin=file, stdout=self._out,
                                             stderr=subprocess.DEVNULL, env=environment, start_new_session=True)

    def answer(self) -> RigChange | str | None:
        """Return the result, or the reason of none; None while it works."""
        if self._process.poll() is None:
            if time.monotonic() - self._started_s < TIMEOUT_S:
                return None
            self.close()
            return "the estimate took too long: the computer is busy"
        if self._process.returncode != 0:
            self._out.close()
            return f"the estimate ended with exit code {self._process.returncode}"
        with self._out:
            self._out.seek(0)
            answer = pickle.load(self._out)
        assert isinstance(answer, RigChange | str)
        return answer

    def wait(self) -> None:
        """Wait until it ends, or has taken too long."""
        try:
            self._process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._started_s = -TIMEOUT_S

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._out.close()
