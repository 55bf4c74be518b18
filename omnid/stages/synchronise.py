"""Pair the images of the two cameras by their stamps: one stage for live cameras and for logs."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from statistics import median_low
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.errors import FrameDecodeError
from drivers.frame import Camera, Frame, coding_steps, gray
from drivers.motion import MotionSample
from omnid.camera_config import PairConfig
from omnid.errors import OmnidError
from omnid.load_level import LoadLevel
from omnid.messages import FramePair
from omnid.stages.image_loss import ImageLoss, image_loss, unpaired_by_chance
from omnid.stages.motion_inbox import MotionInbox

SKEW_GAIN: Final = 0.02  # weight of a new skew in the running mean: a memory of about 50 pairs
RECENT: Final = 30  # pairs to which a line is fitted
MIN_FITTED: Final = 8  # Of fewer pairs the median is taken.
JUMP_NS: Final = 5_000_000  # A larger distance from the line means a lost image, or a camera that was started again.
# Cameras that are triggered together have stamps that scatter about each other. Their mean difference is 0 unless it is
# larger than twice the scatter and than the least that stamps resolve.
SCATTERS: Final = 2.0
LEAST_NS, LEAST_AT_START_NS = 1_000_000, 3_000_000


class Skew:
    """Statistics of the skew, the upper camera's stamp minus the lower's, in ns."""

    def __init__(self) -> None:
        self.mean_ns = math.nan  # running mean
        self.max_ns = 0  # largest absolute value
        self._settled_ns = math.nan  # running mean once it has averaged over its whole memory
        self._pairs = 0
        self._recent: deque[int] = deque(maxlen=RECENT)
        self.exposure_ns = 0.0  # upper minus lower exposure of the newest pair

    def add(self, skew_ns: int) -> None:
        """Add the skew of a pair."""
        self._pairs += 1
        gain = max(SKEW_GAIN, 1 / self._pairs)
        self.mean_ns = skew_ns if self._pairs == 1 else self.mean_ns + gain * (skew_ns - self.mean_ns)
        self.max_ns = max(self.max_ns, abs(skew_ns))
        if self._pairs == round(1 / SKEW_GAIN):
            self._settled_ns = self.mean_ns
        self.exposure_ns = self._between_exposures(skew_ns)

    @property
    def drift_ns(self) -> float:
        """Change of the running mean since it had settled; NaN before."""
        return self.mean_ns - self._settled_ns

    def _between_exposures(self, skew_ns: int) -> float:
        """Return the skew without the scatter of the stamps; 0 where the exposures may be simultaneous.

        Free-running cameras drift against each other, so a line is fitted to the recent skews.
        """
        recent = self._recent
        if recent and abs(skew_ns - recent[-1]) > JUMP_NS:
            recent.clear()
        recent.append(skew_ns)
        if len(recent) < MIN_FITTED:
            median = float(np.median(recent))
            return median if abs(median) > LEAST_AT_START_NS else 0.0
        # Least squares in closed form: sums of whole numbers are exact.
        count, total, moment = len(recent), sum(recent), sum(index * each for index, each in enumerate(recent))
        indices, squares = count * (count - 1) // 2, count * (count - 1) * (2 * count - 1) // 6
        slope = (count * moment - indices * total) / (count * squares - indices**2)
        start = (total - slope * indices) / count
        newest = start + slope * (count - 1)
        squared = sum((each - start - slope * index) ** 2 for index, each in enumerate(recent))
        return newest if abs(newest) > max(SCATTERS * math.sqrt(squared / (count - 2)), LEAST_NS) else 0.0


Image = NDArray[np.uint8]


class Decoder:
    """Grey images of the size that the rig was calibrated for.

    `broken` counts the frames that could not be used, `other_size` those of them that have another size than the ones
    before, `fault` is the reason of the first of them.
    """

    def __init__(self, rig: Rig) -> None:
        self._sizes: dict[Camera, tuple[int, int]] = {"lower": rig.lower.camera.size, "upper": rig.upper.camera.size}
        self._fitted: set[Camera] = set()
        self.broken = self.other_size = 0
        self.fault = ""

    def __call__(self, frame: Frame) -> Image | None:
        """Return the image (H, W), or None for a frame that cannot be used.

        OmnidError if a camera's first image has another size than the rig's camera.
        """
        try:
            image = gray(frame)
        except FrameDecodeError as error:
            self._skip(str(error))
            return None
        found, expected = image.shape[::-1], self._sizes[frame.camera]
        if found == expected:
            self._fitted.add(frame.camera)
            return image
        if frame.camera not in self._fitted:
            raise OmnidError(
                f"the {frame.camera} camera's images are {found[0]}x{found[1]} px, the rig's are {expected[0]}x"
                f"{expected[1]} px: give the rig of these cameras with --rig"
            )
        self.other_size += 1
        self._skip(f"{frame.camera} frame {frame.seq} is {found[0]}x{found[1]} px, unlike those before")
        return None

    def _skip(self, fault: str) -> None:
        self.broken += 1
        self.fault = self.fault or fault


KEPT: Final = 4  # earlier images compared with: a driver that is stuck may hand out its buffers in turn
SAMPLED_PX: Final = 16  # rows and columns of the first comparison: the noise of any real image differs there
FROZEN_IMAGES: Final = 5  # repeated images in a row after which a camera counts as frozen: a single one may be a glitch


class RepeatedImages:
    """Compare the images of one camera with the KEPT ones before; all pixels must be equal.

    An image repeats if it equals the one before, or if the last images equal those a period of up to KEPT images
    earlier, all of that period. A log that is played forwards and backwards repeats one image at each end only.
    """

    def __init__(self) -> None:
        self._earlier: deque[tuple[bytes, Image]] = deque(maxlen=KEPT)  # with samples of them, the newest first
        self._equal = [0] * KEPT  # consecutive images that equal the one 1, 2 ... KEPT images earlier
        self.count = 0  # repeated images in all
        self.longest = 0  # most of them in a row
        self._in_a_row = 0

    @property
    def frozen(self) -> bool:
        """True if the newest images are repeated ones."""
        return self._in_a_row >= FROZEN_IMAGES

    def add(self, image: Image) -> bool:
        """Take the next image (H, W); return True if it repeats earlier ones."""
        sample = image[::SAMPLED_PX, ::SAMPLED_PX].tobytes()  # decides at once for images that are not equal
        for index, (earlier_sample, earlier) in enumerate(self._earlier):
            is_equal = sample == earlier_sample and np.array_equal(image, earlier)
            self._equal[index] = self._equal[index] + 1 if is_equal else 0
        self._earlier.appendleft((sample, image))
        repeated = any(count > index for index, count in enumerate(self._equal))
        self.count += repeated
        self._in_a_row = self._in_a_row + 1 if repeated else 0
        self.longest = max(self.longest, self._in_a_row)
        return repeated


MAX_WAITING = 4  # frames of a camera that wait for a partner: the other camera may be delivered a few periods later
PERIOD_STEPS = 16  # recent steps between the stamps of a camera, whose median is its period
SURE_NS = 5_000_000  # stamps so close make a pair also before the period is known
SURE_STEPS = 3  # Steps after which the period is known ...
FIRST_NS = 100_000_000  # ... and the largest difference of a pair before: half the period at 5 Hz.
OTHER: dict[Camera, Camera] = {"lower": "upper", "upper": "lower"}


class Period:
    """Period of a camera's images, by their stamps."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._steps: deque[int] = deque(maxlen=PERIOD_STEPS)
        self.ns: float | None = None  # median of the recent ones; None before the second image

    @property
    def is_sure(self) -> bool:
        """True if a single pause, as at the start of a camera, cannot be taken for the period."""
        return len(self._steps) >= SURE_STEPS

    def add(self, stamp_ns: int) -> None:
        """Add an image."""
        if self._newest_ns is not None and stamp_ns > self._newest_ns:
            self._steps.append(stamp_ns - self._newest_ns)
            self.ns = float(median_low(self._steps))
        self._newest_ns = stamp_ns


class FrameMatcher:
    """Nearest-stamp matching of the frames of two cameras; reads stamps only, no images and no clock.

    Frames of one camera come in the order of their stamps, those of both in any order. A match is final as soon as
    there is one within the tolerance: waiting for a nearer one would delay every pair by a period.

    tolerance_ns 0: half the period of the faster camera, so that every image of the slower one finds its nearest
    partner whatever the phase between the cameras. Before the period is known, all but very close frames wait; a
    pause between the first images may be taken for it, so at first no more than FIRST_NS counts.
    """

    def __init__(self, tolerance_ns: int) -> None:
        self.fixed_ns = tolerance_ns  # 0: none
        self._periods: dict[Camera, Period] = {"lower": Period(), "upper": Period()}
        self._waiting: dict[Camera, deque[Frame]] = {"lower": deque(), "upper": deque()}
        self._arrived: Counter[Camera] = Counter()
        self.unpaired: Counter[Camera] = Counter()
        self.closest_miss_ns: int | None = None  # smallest gap between frames of both cameras that made no pair

    @property
    def waiting(self) -> int:
        """Number of frames that wait for a partner."""
        return sum(map(len, self._waiting.values()))

    @property
    def unpaired_by_chance(self) -> int:
        """Number of unpaired frames, without those of a faster camera that the other has no partners for."""
        periods_ns = {camera: period.ns for camera, period in self._periods.items()}
        return unpaired_by_chance(self._arrived, {camera: self.unpaired[camera] for camera in periods_ns}, periods_ns)

    @property
    def tolerance_ns(self) -> float:
        """Largest difference between the stamps of a pair."""
        periods = [period for period in self._periods.values() if period.ns is not None]
        if self.fixed_ns or not periods:
            return self.fixed_ns or SURE_NS
        half_ns = min(period.ns for period in periods if period.ns is not None) / 2
        return half_ns if any(period.is_sure for period in periods) else min(half_ns, FIRST_NS)

    def arrive(self, frame: Frame) -> None:
        """Take note of a frame's stamp."""
        self._periods[frame.camera].add(frame.stamp_ns)
        self._arrived[frame.camera] += 1

    def couple(self) -> tuple[Frame, Frame] | None:
        """Return the first frames of both cameras that wait within the tolerance; None without any.

        There are such frames only when the period has just become known.
        """
        for lower in self._waiting["lower"]:
            nearest = self._nearest(lower)
            if nearest is not None and _gap_ns(lower, nearest) <= self.tolerance_ns:
                return lower, nearest
        return None

    def partner(self, frame: Frame) -> Frame | None:
        """Return the waiting frame of the other camera that is nearest in time, None without one in the tolerance."""
        nearest = self._nearest(frame)
        return nearest if nearest is not None and _gap_ns(frame, nearest) <= self.tolerance_ns else None

    def wait(self, frame: Frame) -> None:
        """Let a frame without a partner wait; the oldest one gives way when too many wait."""
        nearest = self._nearest(frame)
        if nearest is not None:
            gap_ns = _gap_ns(frame, nearest)
            self.closest_miss_ns = gap_ns if self.closest_miss_ns is None else min(gap_ns, self.closest_miss_ns)
        waiting = self._waiting[frame.camera]
        waiting.append(frame)
        if len(waiting) > MAX_WAITING:
            waiting.popleft()
            self.unpaired[frame.camera] += 1

    def remove(self, frame: Frame) -> None:
        """Remove a waiting frame that turned out to be of no use; it does not count as unpaired."""
        self._waiting[frame.camera].remove(frame)

    def join(self, *pair: Frame) -> None:
        """Make frames a pair. Older waiting frames can match no later one: they are dropped and counted."""
        for frame in pair:
            waiting = self._waiting[frame.camera]
            while waiting and waiting[0].stamp_ns <= frame.stamp_ns:
                dropped = waiting.popleft()
                if dropped is not frame:
                    self.unpaired[frame.camera] += 1

    def drain(self) -> None:
        """Drop and count all frames that wait."""
        for camera, waiting in self._waiting.items():
            self.unpaired[camera] += len(waiting)
            waiting.clear()

    def _nearest(self, frame: Frame) -> Frame | None:
        return min(self._waiting[OTHER[frame.camera]], key=lambda other: _gap_ns(frame, other), default=None)


class Synchronise:
    """Joins each frame with the frame of the other camera that is nearest in time.

    Live cameras and logs need no different policy. A log's frames come in the order of all stamps, a live camera's in
    that of its own: the first is a case of the second. Images are decoded once they have a partner, so that a camera
    without the other one costs no time. A frame that cannot be decoded counts as `broken` and is treated as if it
    had never come; one that never finds a partner is not decoded and counts as unpaired.

    A pair with an image that repeats an earlier one of its camera is no new evidence: it is counted and not returned,
    unless pair.repeated_images is "use".

    Samples of wheels and gyro go along with the next pair. Those of a log come in its order; live ones are added to
    `motion` by their sources.
    """

    def __init__(self, rig: Rig, config: PairConfig, R_base_imu: NDArray[np.float64] | None = None) -> None:
        """R_base_imu: rotation from the axes of the gyro to those of the base; None: they are the same."""
        self._decode = Decoder(rig)
        self._matcher = FrameMatcher(round(config.tolerance_ms * 1e6))
        self._pairs = 0
        self._use_repeated = config.repeated_images == "use"
        self.repeated: dict[Camera, RepeatedImages] = {"lower": RepeatedImages(), "upper": RepeatedImages()}
        self.skew = Skew()
        self.motion = MotionInbox(R_base_imu)
        self.load = LoadLevel.FULL  # of the next pairs: a live run sets it
        self.newest_ns: dict[Camera, int] = {"lower": 0, "upper": 0}  # stamp of each camera's newest frame

    @property
    def fault(self) -> str:
        """Reason why the first of the broken images could not be decoded; empty without one."""
        return self._decode.fault

    @property
    def closest_miss_ms(self) -> float | None:
        """Smallest gap between images of both cameras that made no pair, ms; None without such images."""
        miss_ns = self._matcher.closest_miss_ns
        return None if miss_ns is None else miss_ns * 1e-6

    @property
    def has_fixed_tolerance(self) -> bool:
        """True if the tolerance was set: cameras whose clocks drift apart then make no pairs some day."""
        return self._matcher.fixed_ns > 0

    @property
    def tolerance_ms(self) -> float:
        """Largest difference between the stamps of a pair, ms, as set or as it follows from the period."""
        return self._matcher.tolerance_ns * 1e-6

    @property
    def waiting(self) -> int:
        """Number of frames that wait for a partner."""
        return self._matcher.waiting

    def loss(self, read: Mapping[str, int]) -> ImageLoss:
        """Return the images of a log that made no pair; read: counts of its reader."""
        broken, other_size = self._decode.broken, self._decode.other_size
        unpaired = self._matcher.unpaired_by_chance
        return image_loss(read, unpaired=unpaired, undecodable=broken - other_size, other_size=other_size)

    @property
    def counts(self) -> dict[str, int]:
        """Pairs made, frames without a partner, images that could not be decoded, images that repeat earlier ones."""
        unpaired = self._matcher.unpaired
        return {
            "pairs": self._pairs,
            "unpaired_lower": unpaired["lower"],
            "unpaired_upper": unpaired["upper"],
            "broken": self._decode.broken,
            "repeated_lower": self.repeated["lower"].count,
            "repeated_upper": self.repeated["upper"].count,
        }

    @property
    def frozen(self) -> list[Camera]:
        """The cameras whose newest images are repeated ones."""
        return [camera for camera, images in self.repeated.items() if images.frozen]

    def process(self, message: Frame | MotionSample) -> FramePair | None:
        """Return the pair that a frame completes; None where the frame waits, is broken or shows nothing new."""
        if isinstance(message, Frame):
            return self._completed(message)
        self.motion.add(message)
        return None

    def _completed(self, frame: Frame) -> FramePair | None:
        self.newest_ns[frame.camera] = frame.stamp_ns
        self._matcher.arrive(frame)
        waiting = self._matcher.couple()
        if waiting is not None:
            pair = self._decoded(*waiting)
            self._matcher.wait(frame)  # afterwards: it may push out the oldest one that waits
            return pair
        image: Image | None = None
        while (partner := self._matcher.partner(frame)) is not None:
            image = self._decode(frame) if image is None else image
            partner_image = self._decode(partner)
            if partner_image is None:
                self._matcher.remove(partner)
            if image is None:
                return None
            if partner_image is not None:
                return self._joined({frame.camera: (frame, image), partner.camera: (partner, partner_image)})
        self._matcher.wait(frame)
        return None

    def _decoded(self, lower: Frame, upper: Frame) -> FramePair | None:
        """Return the pair of two frames that wait; None where one is broken, which no longer waits."""
        lower_image, upper_image = self._decode(lower), self._decode(upper)
        for frame, image in ((lower, lower_image), (upper, upper_image)):
            if image is None:
                self._matcher.remove(frame)
        if lower_image is None or upper_image is None:
            return None
        return self._joined({"lower": (lower, lower_image), "upper": (upper, upper_image)})

    def finish(self) -> tuple[()]:
        """Count the frames that still wait."""
        self._matcher.drain()
        return ()

    def _joined(self, pair: dict[Camera, tuple[Frame, Image]]) -> FramePair | None:
        (lower, lower_image), (upper, upper_image) = pair["lower"], pair["upper"]
        self._matcher.join(lower, upper)
        self.skew.add(upper.stamp_ns - lower.stamp_ns)
        repeated = [self.repeated[camera].add(image) for camera, (_, image) in pair.items()]
        if any(repeated) and not self._use_repeated:
            return None
        seq = self._pairs
        self._pairs += 1
        return FramePair(
            seq,
            lower.stamp_ns,
            lower_image,
            upper_image,
            self.skew.exposure_ns * 1e-9,
            self.motion.take(lower.stamp_ns),
            (coding_steps(lower), coding_steps(upper)),
            self.load,
        )


def _gap_ns(frame: Frame, other: Frame) -> int:
    return abs(other.stamp_ns - frame.stamp_ns)
