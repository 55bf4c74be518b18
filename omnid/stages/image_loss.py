"""Images of a log that make no pair: how many, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.frame import Camera

LOSSY_SHARE: Final = 0.1  # of the images; where more make no pair, a run over a log has failed


@dataclass(frozen=True, slots=True)
class ImageLoss:
    """The images of both cameras in a log, and those of them that make no pair, by the reason."""

    images: int
    lost: Mapping[str, int]

    @property
    def is_lossy(self) -> bool:
        """True if more than a tenth of the images make no pair."""
        return sum(self.lost.values()) > LOSSY_SHARE * self.images

    def __str__(self) -> str:
        """Return one line for the user; empty where few images are lost."""
        if not self.is_lossy:
            return ""
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.lost.items() if count)
        return f"{sum(self.lost.values())} of {self.images} images made no pair: {reasons}"


def unpaired_by_chance(
    arrived: Mapping[Camera, int], unpaired: Mapping[Camera, int], periods_ns: Mapping[Camera, float | None]
) -> int:
    """Return the number of unpaired images, without those of a faster camera that the other has no partners for.

    periods_ns: usual time between two images of each camera; None: unknown.
    """
    by_chance = dict(unpaired)
    if (lower_ns := periods_ns["lower"]) and (upper_ns := periods_ns["upper"]):
        faster: Camera = "lower" if lower_ns < upper_ns else "upper"
        surplus = 1 - min(lower_ns, upper_ns) / max(lower_ns, upper_ns)
        by_chance[faster] = max(0, by_chance[faster] - round(surplus * arrived[faster]))
    return sum(by_chance.values())


def image_loss(read: Mapping[str, int], *, unpaired: int = 0, undecodable: int = 0, other_size: int = 0) -> ImageLoss:
    """Return the loss of a log. read: counts of its reader; the others: of its images that the reader delivered."""
    equal = read["duplicate"] - read["repeated"]
    return ImageLoss(
        read["lower"] + read["upper"] + equal + read["broken"],
        {
            "without a partner": unpaired,
            "not decodable": read["broken"] + undecodable,
            "of another size": other_size,
            "with the stamp of the one before": equal,
        },
    )
