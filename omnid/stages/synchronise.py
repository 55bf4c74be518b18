"""Pair the images of the two cameras by their stamps: one stage for live cameras and for logs."""

from __future__ import annotations

import math
from collections import deque
from itertools import product
from statistics import median_low
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.errors import FrameDecodeError
from drivers.frame import CAMERAS, Camera, Frame, coding_steps, gray
from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.config import PairConfig
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.errors import OmnidError
from omnid.messages import FramePair

Image = NDArray[np.uint8]

RECENT: Final = 30  # pairs, and steps between the stamps of a camera, by which skew and period are known
STAMP_SIGMA_NS: Final = 1_500_000  # scatter of the stamps of cameras that are triggered together, before it is known
FROZEN_IMAGES: Final = 5  # repeated images in a row after which a camera counts as frozen: a single one may be a glitch
MAX_FRAMES: Final = 4  # of a camera that wait: those of the other may be delivered a few periods later
MAX_SAMPLES: Final = 4096  # of wheels and gyro that wait: ten seconds of a gyro of 400 Hz
AHEAD_NS: Final = 5 * NS_PER_S  # a sample that is later than a pair by more has a stamp of another clock


class Skew:
    """The time between the exposures of a pair [ns], by the stamps of the recent ones, upper minus lower."""

    def __init__(self) -> None:
        self.median_ns = math.nan
        self.exposure_ns = 0.0  # 0 where the exposures may be simultaneous
        self._recent: deque[int] = deque(maxlen=RECENT)
        self._limit_ns = math.inf

    def add(self, skew_ns: int) -> None:
        """Add the skew of a pair: the median of the recent ones counts, where it exceeds what their scatter explains.

        A value that is far from the others means a lost image, or a camera that was started again: the older ones go.
        """
        recent = self._recent
        if abs(skew_ns - self.median_ns) > 2 * self._limit_ns:  # never before the first
            recent.clear()
        recent.append(skew_ns)
        self.median_ns = float(np.median(recent))
        self._limit_ns = 2 * math.hypot(STAMP_SIGMA_NS / math.sqrt(len(recent)), float(np.std(recent)))
        self.exposure_ns = self.median_ns if abs(self.median_ns) > self._limit_ns else 0.0


class Decoder:
    """Grey images of the size that the rig was calibrated for.

    `broken` counts the frames that could not be used, `first_error` is the reason of the first of them.
    """

    def __init__(self, rig: Rig) -> None:
        self._sizes = {name: mounted.camera.size for name, mounted in rig.sides}
        self._fitted: set[Camera] = set()
        self.broken = 0
        self.first_error = ""

    def __call__(self, frame: Frame) -> Image | None:
        """Return the image (H, W), or None for a frame that cannot be used.

        OmnidError if a camera's first image has another size than the rig's camera.
        """
        try:
            image = gray(frame)
            found, expected = image.shape[::-1], self._sizes[frame.camera]
            if found == expected:
                self._fitted.add(frame.camera)
                return image
            error_text = f"{frame.camera} frame {frame.seq} is {found[0]}x{found[1]} px, unlike those before"
            if frame.camera not in self._fitted:
                raise OmnidError(
                    f"the {frame.camera} camera's images are {found[0]}x{found[1]} px, the rig's are {expected[0]}x"
                    f"{expected[1]} px: the rig is of other cameras; name the rig.toml of these, or calibrate them"
                )
        except FrameDecodeError as error:
            error_text = str(error)
        self.broken += 1
        self.first_error = self.first_error or error_text
        return None


class MotionInbox:
    """Samples of wheels and gyro on their way to the next pair: a bounded queue that drops its oldest samples.

    `add` may be called from any thread: samples come faster than images, from several sources, and must not replace
    each other, as the messages in a stage's inbox do.
    """

    def __init__(self, R_base_imu: NDArray[np.float64] | None = None) -> None:
        """R_base_imu: rotation (3, 3) from the axes of the gyro to those of the base; None: they are the same."""
        self._R_base_imu = R_base_imu
        self._waiting: deque[MotionSample] = deque(maxlen=MAX_SAMPLES)
        self.wheels = self.gyro = 0  # samples that have come
        self.dropped = 0  # because no pair took them, or their stamps are far ahead

    def add(self, sample: MotionSample) -> None:
        """Add a sample, whose rates are finite: where it came from saw to that."""
        self.wheels += isinstance(sample, WheelSample)
        self.gyro += isinstance(sample, GyroSample)
        if isinstance(sample, GyroSample) and self._R_base_imu is not None and not sample.of_base:
            x, y, z = (self._R_base_imu @ (sample.x_radps, sample.y_radps, sample.z_radps)).tolist()
            sample = GyroSample(sample.stamp_ns, x, y, z, of_base=True)
        self.dropped += len(self._waiting) == MAX_SAMPLES
        self._waiting.append(sample)

    def take(self, stamp_ns: int) -> tuple[MotionSample, ...]:
        """Return the samples up to a stamp and the first ones after it, which end the step there; others wait."""
        waiting = sorted((self._waiting.popleft() for _ in range(len(self._waiting))), key=lambda each: each.stamp_ns)
        sane = [sample for sample in waiting if sample.stamp_ns - stamp_ns <= AHEAD_NS]
        self.dropped += len(waiting) - len(sane)
        later = [sample for sample in sane if sample.stamp_ns > stamp_ns]
        self._waiting.extendleft(reversed(later))
        first = {type(sample): sample for sample in reversed(later)}
        return tuple(sample for sample in sane if sample.stamp_ns <= stamp_ns or sample is first[type(sample)])


class _Camera:
    """The frames of one camera on their way to pairs, and what is counted of them."""

    def __init__(self) -> None:
        self.waiting: deque[Frame] = deque()
        self.steps_ns: deque[int] = deque(maxlen=RECENT)  # between the stamps of its frames
        self.newest_ns = 0  # stamp of its newest frame
        self.arrived = self.unpaired = self.repeated = 0  # numbers of frames
        self.repeated_in_a_row = 0  # of the newest images of pairs
        self._image: Image | None = None  # of the newest pair

    @property
    def period_ns(self) -> float:
        """Median of the recent steps; NaN before the second image."""
        return float(median_low(self.steps_ns)) if self.steps_ns else math.nan

    def drop_until(self, count: int) -> None:
        """Give up the oldest frames, which have found no partner, until this number waits."""
        while len(self.waiting) > count:
            self.waiting.popleft()
            self.unpaired += 1

    def repeats(self, image: Image) -> bool:
        """Return True for an image (H, W) whose pixels all equal those of the one before."""
        earlier, self._image = self._image, image
        repeated = earlier is not None and np.array_equal(image, earlier)
        self.repeated += repeated
        self.repeated_in_a_row = self.repeated_in_a_row + 1 if repeated else 0
        return repeated


class Synchronise:
    """Joins the frames of both cameras that are nearest in time.

    A pair is made as soon as two frames that wait are within the tolerance: to wait for a nearer one would delay each
    pair by a period. The tolerance is pair.tolerance_ms; 0: half the period of the faster camera, so that every image
    of the slower one finds its nearest partner whatever the phase between the cameras.

    A log's frames come in the order of all stamps, a live camera's in that of its own: the first is a case of the
    second. Images are decoded once they have a partner. A frame that cannot be decoded counts as `broken` and is
    treated as if it had never come; one that never finds a partner counts as unpaired.

    A pair with an image that repeats the one before of its camera is no new evidence: it is counted and not returned,
    unless pair.repeated_images is "use".

    Samples of wheels and gyro go along with the next pair. Those of a log come in its order; live ones are added to
    `motion` by their sources.
    """

    def __init__(self, rig: Rig, config: PairConfig, R_base_imu: NDArray[np.float64] | None = None) -> None:
        """R_base_imu: rotation from the axes of the gyro to those of the base; None: they are the same."""
        self._config, self._decode = config, Decoder(rig)
        self._cameras: dict[Camera, _Camera] = {name: _Camera() for name in CAMERAS}
        self._pairs = 0
        self.skew = Skew()
        self.motion = MotionInbox(R_base_imu)

    @property
    def newest_ns(self) -> dict[Camera, int]:
        """Stamp of each camera's newest frame; 0 before the first."""
        return {name: camera.newest_ns for name, camera in self._cameras.items()}

    def stats(self) -> dict[str, Any]:
        """Return the numbers of the pairing, for the status and for warnings at the end of a run."""
        cameras = self._cameras.items()
        return {
            "pairs": self._pairs,
            **{f"unpaired_{name}": one.unpaired for name, one in cameras},  # frames without a partner
            "broken": self._decode.broken,  # images that could not be decoded
            **{f"repeated_{name}": one.repeated for name, one in cameras},  # images that repeat those before
            "skew_ms": self.skew.median_ns * 1e-6,
            "exposure_skew_ms": self.skew.exposure_ns * 1e-6,
            "tolerance_ms": self._tolerance_ns * 1e-6,  # largest difference between the stamps of a pair
            "_first_error": self._decode.first_error,  # reason why the first of the broken images could not be decoded
            "_frozen": " and the ".join(name for name, one in cameras if one.repeated_in_a_row >= FROZEN_IMAGES),
        }

    @property
    def possible(self) -> float:
        """Number of pairs if no image were lost: the images of a camera at the rate of the slower one."""
        lower, upper = self._cameras.values()
        if not lower.steps_ns or not upper.steps_ns:
            return max(lower.arrived, upper.arrived)
        slower_ns = max(lower.period_ns, upper.period_ns)
        return max(camera.arrived * camera.period_ns / slower_ns for camera in (lower, upper))

    @property
    def _tolerance_ns(self) -> float:
        periods_ns = [camera.period_ns for camera in self._cameras.values() if camera.steps_ns]
        # Before the period is known, the tolerance is what the scatter of the stamps explains.
        return round(self._config.tolerance_ms * 1e6) or min(periods_ns, default=8 * STAMP_SIGMA_NS) / 2

    def process(self, message: Frame | MotionSample) -> FramePair | None:
        """Return the pair that a frame completes; None where the frame waits, is broken or shows nothing new."""
        if not isinstance(message, Frame):
            self.motion.add(message)
            return None
        # 1. The frame waits for a partner.
        camera = self._cameras[message.camera]
        if camera.newest_ns and message.stamp_ns > camera.newest_ns:
            camera.steps_ns.append(message.stamp_ns - camera.newest_ns)
        camera.newest_ns = message.stamp_ns
        camera.arrived += 1
        camera.waiting.append(message)
        # 2. The two frames that are nearest in time make a pair, unless one of them is broken.
        lower, upper = cameras = tuple(self._cameras.values())
        while lower.waiting and upper.waiting:
            frames = min(product(lower.waiting, upper.waiting), key=_gap_ns)
            if _gap_ns(frames) > self._tolerance_ns:
                break
            images = [self._decode(frame) for frame in frames]
            for one, frame, image in zip(cameras, frames, images, strict=True):
                if image is None:
                    one.waiting.remove(frame)
            if images[0] is not None and images[1] is not None:
                return self._joined(frames, (images[0], images[1]))
        # 3. The oldest that wait beyond a number are given up.
        camera.drop_until(MAX_FRAMES)
        return None

    def finish(self) -> tuple[()]:
        """Count the frames that still wait."""
        for camera in self._cameras.values():
            camera.drop_until(0)
        return ()

    def _joined(self, frames: tuple[Frame, Frame], images: tuple[Image, Image]) -> FramePair | None:
        # 1. Frames that waited before these can match no later one: they are given up.
        for camera, frame in zip(self._cameras.values(), frames, strict=True):
            camera.drop_until(len(camera.waiting) - camera.waiting.index(frame))
            camera.waiting.popleft()
        # 2. Images that show nothing new.
        lower, upper = frames
        self.skew.add(upper.stamp_ns - lower.stamp_ns)
        repeated = [camera.repeats(image) for camera, image in zip(self._cameras.values(), images, strict=True)]
        if any(repeated) and self._config.repeated_images != "use":
            return None
        # 3. The pair.
        self._pairs += 1
        skew_s, motion = self.skew.exposure_ns * S_PER_NS, self.motion.take(lower.stamp_ns)
        steps = coding_steps(lower), coding_steps(upper)
        return FramePair(self._pairs - 1, lower.stamp_ns, *images, skew_s, motion, steps, frames)


def _gap_ns(frames: tuple[Frame, Frame]) -> int:
    return abs(frames[1].stamp_ns - frames[0].stamp_ns)
