"""Steps of the stages whose processor time is measured, and the clock that measures them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from importlib import import_module
from typing import Any, Final, NamedTuple


class Step(NamedTuple):
    """A function of the program, as the module that calls it names it."""

    label: str
    module: str
    name: str  # of a function, or CLASS.METHOD


STEPS: Final = (
    Step("pair", "omnid.stages.synchronise", "Synchronise.process"),
    Step("dewarp", "omnid.stages.dewarp", "Dewarp.process"),
    Step("odometry", "omnid.stages.odometry", "OdometryStage.process"),
    Step("mapping", "omnid.stages.mapping", "Mapping.process"),
    Step("decode", "omnid.stages.decoder", "gray"),
    Step("remap", "omnid.stages.dewarp", "Dewarp._remapped"),
    Step("dense stereo", "omnid.stages.dense_stereo", "DenseStereo.compute"),
    Step("smooth", "omnid.core.stereo.matcher", "smooth"),
    Step("edges", "omnid.core.stereo.matcher", "edge_pixels"),
    Step("semi-global prior", "omnid.core.stereo.semiglobal", "SemiGlobalPrior.disparity"),
    Step("SAD near the prior", "omnid.core.stereo.semiglobal", "WarpedSad.costs"),
    Step("triangulate", "omnid.stages.dense_stereo", "triangulate"),
    Step("track landmarks", "omnid.core.odometry.local_map", "LocalMap.track"),
    Step("rows in upper", "omnid.core.odometry.frame_to_map", "pixels_in_upper"),
    Step("RANSAC", "omnid.core.odometry.frame_to_map", "ransac"),
    Step("Gauss-Newton", "omnid.core.odometry.frame_to_map", "gauss_newton"),
    Step("align patches", "omnid.core.odometry.local_map", "LocalMap.align"),
    Step("templates", "omnid.core.odometry.local_map", "plane_templates"),
    Step("align rows", "omnid.core.odometry.frame_to_map", "align_rows"),
    Step("templates", "omnid.core.odometry.patch_alignment", "plane_templates"),
    Step("fit patches", "omnid.core.odometry.patch_alignment", "fit_patches"),
    Step("depths of landmarks", "omnid.core.odometry.landmarks", "LandmarkStore.update_depths"),
    Step("motion filter", "omnid.core.odometry.motion_filter", "MotionFilter.predict"),
    Step("motion filter", "omnid.core.odometry.motion_filter", "MotionFilter.update"),
    Step("static mask", "omnid.core.odometry.static_mask", "StaticMask.observe"),
    Step("yaw hypotheses", "omnid.core.odometry.frame_to_map", "FrameToMap.best_yaw"),
    Step("update of the store", "omnid.core.odometry.local_map", "LocalMap.update_tracked"),
    Step("add a keyframe", "omnid.core.odometry.keyframes", "Keyframes.add"),
    Step("corners", "omnid.core.odometry.keyframes", "corners"),
    Step("free pixels", "omnid.core.odometry.keyframes", "clear_around"),
    Step("rows in upper", "omnid.core.odometry.new_landmarks", "pixels_in_upper"),
    Step("slopes", "omnid.core.odometry.new_landmarks", "disparity_slopes"),
    Step("slopes by patches", "omnid.core.odometry.new_landmarks", "fitted_slopes"),
    Step("relocaliser", "omnid.core.places.relocalisation", "Relocaliser.add"),
    Step("LK", "cv2", "calcOpticalFlowPyrLK"),
)


class StepClock:
    """Processor time of the calling thread [ns] in steps, by the path of their labels; the time of inner steps is not
    counted again in outer ones.
    """

    def __init__(self) -> None:
        self.own_ns: Counter[tuple[str, ...]] = Counter()
        self.calls: Counter[tuple[str, ...]] = Counter()
        self._path: tuple[str, ...] = ()
        self._since_ns = 0

    def timed(self, label: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, timed as a step."""

        @wraps(call)
        def measured(*args: Any, **kwargs: Any) -> Any:
            outer = self._path
            self._switch((*outer, label))
            self.calls[self._path] += 1
            try:
                return call(*args, **kwargs)
            finally:
                self._switch(outer)

        return measured

    def clear(self) -> None:
        """Forget what was measured so far."""
        self.own_ns.clear()
        self.calls.clear()

    def _switch(self, path: tuple[str, ...]) -> None:
        now_ns = time.thread_time_ns()
        self.own_ns[self._path] += now_ns - self._since_ns
        self._path, self._since_ns = path, now_ns


@contextmanager
def measured_steps(clock: StepClock) -> Iterator[None]:
    """Replace the functions of STEPS by timed ones within the block."""
    with ExitStack() as ends:
        for step in STEPS:
            owner, name = owner_of(step)
            original = getattr(owner, name)
            setattr(owner, name, clock.timed(step.label, original))
            ends.callback(setattr, owner, name, original)
        yield


def owner_of(step: Step) -> tuple[Any, str]:
    """Return the module or class of a step, and its name there; AttributeError where the program has no such name."""
    owner: Any = import_module(step.module)
    *classes, name = step.name.split(".")
    for cls in classes:
        owner = getattr(owner, cls)
    getattr(owner, name)
    return owner, name
