"""The public Python API: replay of a log, and odometry of images at hand. Import it from `omnid`."""

from __future__ import annotations

import operator
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera, Frame
from omnid.config import Config, load_config, unused_settings
from omnid.engine.graph import Lock
from omnid.errors import OmnidError
from omnid.messages import DensePoints, OdometryUpdate
from omnid.runs.replay import ReplayOptions, RunResult, run_log
from omnid.settings import dump, parse
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry

FilePath: TypeAlias = str | PathLike[str]
GreyImage: TypeAlias = NDArray[np.uint8]  # (H, W)
MAX_SKEW_S = 1.0  # Stamps of a pair that differ by more are a mistake of clocks or units.
InputImage: TypeAlias = NDArray[Any] | None  # what cv2.imread gives; a GreyImage is expected and checked


def replay(
    log: FilePath,
    rig: FilePath | Rig | None = None,
    *,
    config: FilePath | Config | None = None,
    overrides: Sequence[str] = (),
    method: Literal["default", "paper"] | None = None,
    lower: str | None = None,
    upper: str | None = None,
    progress: Callable[[int, int | None], object] | None = None,
) -> RunResult:
    """Run a recorded log through the stages and return poses, covariances, map, counters, timings and warnings.

    log: an MCAP file, or the folder of `ros2 bag record -s mcap`. rig: a rig.toml or a Rig; None: the one attached to
    the log. config: a TOML file or a Config; None: the defaults. overrides: settings such as "stereo.min_range_m=0.5"
    over those of the file. method: odometry.method. lower, upper: topics of the images; None: those of the rig, else
    by their names. progress: called several times a second, in a thread of the run, with the number of pairs so far
    and the expected number, None if unknown.

    All poses and the map stay in memory (about 75 MB an hour at 30 Hz). Ctrl-C ends the run and
    raises KeyboardInterrupt. Raises OmnidError for input that cannot be used.
    """
    given = [overrides] if isinstance(overrides, str) else overrides
    settings = [*given, *([f"odometry.method={method}"] if method else [])]
    with _user_errors():
        loaded = _config(config, settings)
        ignored = unused_settings(loaded, "replay", settings)
        options = ReplayOptions(
            rig=rig if rig is None or isinstance(rig, Rig) else Path(rig),
            topics=(lower, upper),
            collect=True,
            progress=progress
            and (lambda run, expected, _: progress(run.newest.seq + 1 if run.newest else 0, expected)),
        )
        result = run_log(Path(log), loaded, options)
    if result.signal:
        signal.raise_signal(result.signal)  # The run has ended in order; the caller's own handler comes now.
    return replace(result, warnings=(*ignored, *result.warnings))


class Odometry:
    """Odometry of image pairs at hand, one call a pair, in the caller's thread.

    The poses are the same, to the last bit, as those of a replay of the same images. The settings of the stages apply;
    those of threads, bus, motor and recording do not. Calls from several threads wait for each other.
    """

    def __init__(
        self,
        rig: FilePath | Rig,
        config: FilePath | Config | None = None,
        *,
        overrides: Sequence[str] = (),
    ) -> None:
        """Prepare the stages; that takes about a second, and some 20 s where functions are to be compiled.

        rig, config, overrides: as in `replay`. A camera without a mask counts as far as its image reaches, which costs
        accuracy where the image shows more than the mirror: calibrate_mask gives a rig the masks that a log shows.
        Raises OmnidError for a rig or a configuration that cannot be used.
        """
        with _user_errors():
            settings = _config(config, overrides)
            loaded = rig if isinstance(rig, Rig) else read_rig(Path(rig))
            self._sizes = {name: mounted.camera.size for name, mounted in loaded.sides}
            run_geometry = geometry(loaded, settings.panorama)
            # `process` gets both images of a pair at once, whatever the time between their exposures.
            pair_config = replace(settings.pair, tolerance_ms=1e3 * MAX_SKEW_S)
            self._front_end = FrontEnd(run_geometry, replace(settings, pair=pair_config))
        self.rig = run_geometry.rig
        self._lock = Lock()
        self._seq = 0
        self._stamp_ns: int | None = None

    def process(
        self, stamp_ns: int, lower: InputImage, upper: InputImage, upper_stamp_ns: int | None = None
    ) -> OdometryUpdate:
        """Return the pose at a pair of grey images (H, W) uint8 that were captured at stamp_ns, in ns of any clock.

        upper_stamp_ns: of the upper image, in the same clock, where the cameras are not synchronised; the motion in
        between is then corrected as in a replay. None: both images are synchronised.

        Of the result: `T_odom_rig` (4, 4) maps points of the rig frame into odom, which is the rig frame of the first
        pair (m); `covariance` (6, 6) of [x y z; rx ry rz] in the axes of the rig (m^2, rad^2); `velocity` (6,) in them;
        `state`; `inliers` of `tracks` landmarks; the panoramas `depth.panoramas.lower.panorama` and `.upper.panorama`
        (H, W) uint8. Points and disparities are those of the method `depth`.

        Raises OmnidError for an image of another type or size than the rig's, for a stamp that is not later than the
        previous one, and for stamps of a pair that are MAX_SKEW_S or more apart; such a pair changes nothing. Raises it
        for an image that repeats an earlier one to the last pixel, unless pair.repeated_images is "use": a frozen
        camera shows no motion, and a replay drops such a pair; later images are compared with those of this pair, too.
        Raises it where one of the first pairs shows that the images cannot be of this rig, unless rig.check says
        otherwise.
        """
        with self._lock:
            # 1. Refuse images and stamps that are no pair of this rig, before any state changes.
            stamp_ns = _nanoseconds("stamp_ns", stamp_ns)
            if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
                raise OmnidError(
                    f"stamp_ns: expected a stamp after that of the previous pair, {self._stamp_ns}, found "
                    f"{stamp_ns}: give the pairs in the order of time, each once"
                )
            images = (self._checked("lower", lower), self._checked("upper", upper))
            stamps_ns = stamp_ns, stamp_ns if upper_stamp_ns is None else _nanoseconds("upper_stamp_ns", upper_stamp_ns)
            if abs(stamps_ns[1] - stamp_ns) >= MAX_SKEW_S * 1e9:
                raise OmnidError(
                    f"upper_stamp_ns: expected a stamp less than {MAX_SKEW_S:g} s from stamp_ns, {stamp_ns}, "
                    f"found {upper_stamp_ns}: give both in nanoseconds of one clock"
                )
            # 2. Pair them; an image that repeats an earlier one gives no pair.
            _, pair = [
                self._front_end.pairing.process(Frame(self._seq, at_ns, name, "mono8", image, *image.shape[::-1]))
                for name, at_ns, image in zip(CAMERAS, stamps_ns, images, strict=True)
            ]
            self._seq += 1
            if pair is None:
                raise OmnidError(
                    "an image is the one before of its camera, to the last pixel: leave such pairs out, as a frozen "
                    'camera shows no motion, or set pair.repeated_images="use"'
                )
            # 3. Estimate the motion.
            self._stamp_ns = stamp_ns
            return self._front_end.pose(pair)

    def depth(self, pose: OdometryUpdate) -> DensePoints:
        """Return the dense depth of a pair that `process` has given the pose of; it is computed the first time.

        `points` (N, 3) in the rig frame (m) with `variance_m2` (N,) along the ray; `disparity` (H, W) in px, NaN where
        unknown, and `pixels` (N, 2) of the points in the lower panorama.
        """
        with self._lock:
            return self._front_end.dense.of(pose.depth)

    def _checked(self, name: Camera, image: InputImage) -> GreyImage:
        """Return the image, contiguous; OmnidError where it is not one of this camera."""
        width, height = self._sizes[name]
        found = type(image).__name__
        if isinstance(image, np.ndarray):
            if image.shape == (height, width) and image.dtype == np.uint8:
                return np.ascontiguousarray(image)
            found = f"{image.shape} {image.dtype}"
        raise OmnidError(f"{name} image: expected a grey one ({height}, {width}) uint8 as the rig's, found {found}")


def _nanoseconds(name: str, value: int) -> int:
    try:
        return operator.index(value)
    except TypeError as error:
        raise OmnidError(f"{name}: expected an integer number of nanoseconds, found {value!r}") from error


def _config(config: FilePath | Config | None, overrides: Sequence[str]) -> Config:
    if isinstance(config, Config):
        return parse(Config, dump(config).encode(), origin="config", overrides=overrides) if overrides else config
    return load_config(config, overrides)


@contextmanager
def _user_errors() -> Iterator[None]:
    """Raise the errors of calib and drivers as OmnidError, the one error class of this API."""
    try:
        yield
    except (CalibError, DriverError) as error:
        raise OmnidError(str(error)) from error
