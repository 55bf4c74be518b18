"""The tampering of images: what it changes, and what it leaves."""

from __future__ import annotations

import numpy as np

from drivers.frame import Frame
from tests.bench.faults.images import SIZE_PX, STARTS_S, Frozen, blurred, pixels, repeated, sector

PART = sector(SIZE_PX, 0.0, 90.0)


def frame(seq: int) -> Frame:
    """Return a frame of noise whose mean is its number."""
    rng = np.random.default_rng(seq)
    image = np.clip(rng.normal(100 + seq, 5, (SIZE_PX, SIZE_PX)), 0, 255).astype(np.uint8)
    return Frame(seq, seq * 100_000_000, "lower", "mono8", image, SIZE_PX, SIZE_PX)


def test_a_frozen_part_stays_and_the_rest_goes_on() -> None:
    """From the start of the fault on."""
    tamper = Frozen(PART)
    assert tamper(STARTS_S - 0.1, frame(0)).data is not None
    first, later = (pixels(tamper(STARTS_S + 0.1 * seq, frame(seq))) for seq in (1, 2))
    assert (first[PART] == later[PART]).all() and (later[~PART] == pixels(frame(2))[~PART]).all()


def test_each_second_image_repeats_and_a_drop_takes_the_texture() -> None:
    """After the start of the fault."""
    kept: dict[str, np.ndarray] = {}
    images = [pixels(repeated(STARTS_S + 0.1 * seq, frame(seq), kept)) for seq in range(4)]  # type: ignore[arg-type]
    assert (images[0] == images[1]).all() and (images[2] == images[3]).all() and (images[1] != images[2]).any()
    found = pixels(blurred(STARTS_S, frame(1), PART)).astype(float)
    assert found[PART].std() < 3.0 < found[~PART].std()
