"""Estimate the rig's errors by the same landmarks seen from near and from far, which shows elevation and scale.

Landmarks of a window of keyframes are followed in a thread of the daemon; the bundle adjustment runs in a process of
its own at a low priority, because a thread would hold Python's global lock. One window at a time, then a pause.
"""

from __future__ import annotations

import pickle
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import IO, Final

import numpy as np

from calib.errors import CalibError
from calib.fit.drive.rig_parameters import UPPER_DELAY
from omnid.calibration.drive_observations import DriveCollector, KeyframeChoice
from omnid.config import RigConfig
from omnid.diagnostics.rig_status import RefinementReport
from omnid.engine.python_program import python, python_environment
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.refinement.estimate import RefinementRequest, RigChange
from omnid.refinement.refined_file import RefinedRigFile
from omnid.stages.front_end import FrontEnd
from omnid.tracking_state import TrackingState
from omnid.transport.codec import OK, WARN

PROCESS = "omnid.refinement.process"
# Distance of keyframes: a window of 20 then covers some metres, so that landmarks come from far to near.
KEYFRAME_M, KEYFRAME_RAD = 0.25, np.deg2rad(15)
# Landmarks in view of a keyframe: fewer than for a calibration, as the daemon follows them while it runs.
LANDMARKS: Final = 200
# Longest time of an estimate, which takes some seconds of processor time, at a low priority.
TIMEOUT_S: Final = 300.0
ADVICE = (
    "the landmarks of this run do not fit the rig: a camera or a mirror has moved, or the calibration was not "
    "good: run omnid calibrate drive on a recording"
)
DELAY_ADVICE = (
    "the upper camera is exposed at other times than its stamps say: set camera.upper_delay_ms, or run "
    "omnid calibrate drive on a recording"
)


def always() -> bool:
    """Return True."""
    return True


def ignore(_: str) -> None:
    """Do nothing with a line."""


class RigRefinement:
    """A sink of poses that estimates the rig's errors; its inbox drops the oldest (policy NEWEST)."""

    def __init__(
        self,
        front_end: FrontEnd,
        settings: RigConfig,
        has_time: Callable[[], bool] = always,
        file: RefinedRigFile | None = None,
        report: Callable[[str], None] = ignore,
        *,
        has_delay: bool = True,
    ) -> None:
        """front_end: of the poses. has_time: False under overload, when no keyframe is added.

        file: into which a change that counts is written; None: changes are only reported. report: takes a line for the
        log. has_delay: False if the upper camera's delay is given by the configuration, and not estimated.
        """
        self._place, self._dense = front_end.geometry, front_end.dense
        self._settings, self._has_time, self._has_delay = settings, has_time, has_delay
        self._file, self._report = file, report
        self._outcome = ""  # what became of the newest change that counts
        self._window: DriveCollector | None = None
        self._choice = KeyframeChoice()
        self._resets = 0
        self._next_ns: float = -float("inf")
        self._newest_ns = 0
        self._child: _Estimate | None = None
        self._windows = self._failed = 0
        self._reason = ""  # why the newest window has no result
        # With its stamp, set in one assignment: report() runs in another thread.
        self._found: tuple[RigChange, int] | None = None

    @property
    def found(self) -> RigChange | None:
        """The newest estimate; None before the first."""
        return self._found[0] if self._found else None

    def process(self, update: OdometryUpdate) -> None:
        """Add a keyframe to the window if it is one, start the estimate of a full window, take its result."""
        self._newest_ns = update.stamp_ns
        if self._child is not None:
            self._take_answer()
        elif self._has_time() and not self._next_ns - self._settings.refine_s * 1e9 <= update.stamp_ns < self._next_ns:
            self._extend(update)

    def finish(self) -> None:
        """Wait for the running estimate: a log has ended."""
        if self._child is not None:
            self._child.wait()
            self._take_answer()

    def close(self) -> None:
        """End the running estimate."""
        if self._child is not None:
            self._child.close()
            self._child = None

    def _extend(self, update: OdometryUpdate) -> None:
        # 1. A new window where there is none, and after a gap in the poses.
        window = self._window
        if window is None or update.state is TrackingState.LOST or update.reset_counter != self._resets:
            window = self._window = DriveCollector(self._place, self._dense, LANDMARKS)
            self._choice, self._resets = KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD), update.reset_counter
        # 2. A keyframe of it.
        if not self._choice.takes(update) or update.state is TrackingState.LOST:
            return
        window.add(update, update.velocity)
        # 3. The estimate of a full one.
        if window.keyframes >= self._settings.refine_keyframes:
            drives = window.drives(update.T_odom_rig)
            request = RefinementRequest(self._place.rig, drives.state, drives.observations, self._has_delay)
            self._window, self._next_ns = None, update.stamp_ns + self._settings.refine_s * 1e9
            try:
                self._child = _Estimate(request)
            except OSError as error:
                # The temporary folder is full, or there are too many processes: the run continues without an estimate.
                self._windows, self._failed = self._windows + 1, self._failed + 1
                self._reason = f"the estimate cannot start: {error}"

    def _take_answer(self) -> None:
        """Take the result of the estimate if it has ended, or end it if it takes too long."""
        assert self._child is not None
        answer = self._child.answer()
        if answer is None:
            return
        self._child = None
        self._windows += 1
        if isinstance(answer, RigChange):
            self._reason, self._outcome = "", self._keep(answer)
            self._found = answer, self._newest_ns
        else:
            self._failed, self._reason = self._failed + 1, answer

    def _keep(self, change: RigChange) -> str:
        """Write the rig of a change that counts, or withdraw that of an earlier window; return what was done."""
        if self._file is None:
            return ""
        try:
            if change.is_significant:
                outcome = f"{self._file.path}: {self._file.write(change).summary}; {self._next_start}"
            elif self._file.withdraw():
                outcome = f"{self._file.path}: withdrawn, as the rig of this run fits the landmarks of a later window"
            else:
                return ""
        except (OmnidError, CalibError, OSError) as error:
            outcome = f"the refined rig is not written: {error}"
        self._report(outcome)
        return outcome

    @property
    def _next_start(self) -> str:
        return (
            "the next start uses it"
            if self._settings.refine == "use"
            else "rig.refine = 'use' lets the next start use it"
        )

    def report(self) -> RefinementReport:
        """Return the newest estimate for the status; refine_age_s is the time since then, by the stamps."""
        window, found = self._window, self._found
        values = {
            "windows": str(self._windows),
            "windows_without_result": str(self._failed),
            "keyframes": str(window.keyframes if window else 0),
            "needed_keyframes": str(self._settings.refine_keyframes),
            "refined_file": self._outcome,
            "window_problem": self._reason.replace("calibrate drive: ", ""),
        }
        if found is None:
            return RefinementReport(OK, "", values)
        change, stamp_ns = found
        values |= {
            "error_px": f"{change.error_px:.3f}",
            "refined_error_px": f"{change.refined_error_px:.3f}",
            "landmarks": str(change.landmarks),
            "refine_age_s": f"{(self._newest_ns - stamp_ns) * 1e-9:.0f}",
        }
        if not change.is_significant:
            return RefinementReport(OK, "", values | _lengths(change) | _delay(change))
        return RefinementReport(WARN, ADVICE if change.has_moved else DELAY_ADVICE, values | _parameters(change))


def _lengths(change: RigChange) -> dict[str, str]:
    """Return the change of lengths, with its sigma."""
    return {
        "lengths_percent": f"{100 * change.lengths:+.3f}",
        "lengths_sigma_percent": f"{100 * change.lengths_sigma:.3f}",
    }


def _delay(change: RigChange) -> dict[str, str]:
    """Return the estimated delay of the upper camera's exposures against the stamps, with its sigma."""
    if change.delay_ms is None:
        return {}
    before, after, sigma = change.delay_ms
    return {
        "upper_delay_ms_before": f"{before:.3f}",
        "upper_delay_ms_after": f"{after:.3f}",
        "upper_delay_ms_sigma": f"{sigma:.3f}",
    }


def _parameters(change: RigChange) -> dict[str, str]:
    """Return every parameter before and after a change, with its sigma, and the change of lengths."""
    values = _lengths(change) | _delay(change)
    for name, before, after, sigma in zip(change.names, change.before, change.after, change.sigmas, strict=True):
        if name == UPPER_DELAY:
            continue
        key = name.replace(" ", "_")
        values |= {f"{key}_before": f"{before:.6g}", f"{key}_after": f"{after:.6g}", f"{key}_sigma": f"{sigma:.2g}"}
    return values


class _Estimate:
    """A process that works on one request."""

    def __init__(self, request: RefinementRequest) -> None:
        self._started_s = time.monotonic()
        environment = python_environment(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        with ExitStack() as opened:
            self._out: IO[bytes] = opened.enter_context(tempfile.TemporaryFile())
            with tempfile.TemporaryFile() as file:
                pickle.dump(request, file)
                file.seek(0)
                self._process = subprocess.Popen(
                    python("-m", PROCESS),
                    stdin=file,
                    stdout=self._out,
                    stderr=subprocess.DEVNULL,
                    env=environment,
                    start_new_session=True,
                )
            opened.pop_all()  # `_out` is closed when the answer is read.

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
