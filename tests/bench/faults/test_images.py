"""The tampering of images: what it changes, and what it leaves."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.frame import Frame
from tests.bench.faults.images import CASES, SIZE_PX, STARTS_S, Frozen, Late, blurred, pixels, repeated, sector

PART = sector(SIZE_PX, 0.0, 90.0)


def frame(seq: int) -> Frame:
    """Return a frame of noise whose mean is its number."""
    rng = np.random.default_rng(seq)
    image = np.clip(rng.normal(100 + seq, 5, (SIZE_PX, SIZE_PX)), 0, 255).astype(np.uint8)
    return Frame(seq, seq * 100_000_000, "lower", "mono8", image, SIZE_PX, SIZE_PX)


def test_a_sector_lies_about_its_azimuth() -> None:
    """Up in the image is forward, left is left."""
    assert PART[10, SIZE_PX // 2] and not PART[-10, SIZE_PX // 2] and PART.mean() == pytest.approx(0.25, abs=0.01)
    assert sector(SIZE_PX, 90.0, 40.0)[SIZE_PX // 2, 10]


def test_a_frozen_part_stays_and_the_rest_goes_on() -> None:
    """From the start of the fault on."""
    tamper = Frozen(PART)
    assert tamper(STARTS_S - 0.1, frame(0)).data is not None
    first, later = (pixels(tamper(STARTS_S + 0.1 * seq, frame(seq))) for seq in (1, 2))
    assert (first[PART] == later[PART]).all() and (later[~PART] == pixels(frame(2))[~PART]).all()


def test_late_and_slow_images_show_earlier_ones_with_stamps_of_now() -> None:
    """The noise of a sensor is added again: whole images that repeat would be left out."""
    late, slow = Late(0.5), Late(speed=0.5)
    for seq in range(60):
        shown = [tamper(0.1 * seq, frame(seq)) for tamper in (late, slow)]
    assert {one.stamp_ns for one in shown} == {frame(59).stamp_ns}
    behind_s = 0.5 * (5.9 - STARTS_S)
    means = [float(pixels(one).mean()) - 100 for one in shown]
    assert means == [pytest.approx(54, abs=0.5), pytest.approx(59 - 10 * behind_s, abs=0.7)]
    assert not (pixels(shown[0]) == pixels(frame(54))).all()


def test_each_second_image_repeats_and_a_drop_takes_the_texture() -> None:
    """After the start of the fault."""
    kept: dict[str, np.ndarray] = {}
    images = [pixels(repeated(STARTS_S + 0.1 * seq, frame(seq), kept)) for seq in range(4)]  # type: ignore[arg-type]
    assert (images[0] == images[1]).all() and (images[2] == images[3]).all() and (images[1] != images[2]).any()
    found = pixels(blurred(STARTS_S, frame(1), PART)).astype(float)
    assert found[PART].std() < 3.0 < found[~PART].std()


def test_the_campaign_has_every_case_of_its_table() -> None:
    """Half, quarter, sector, darkness, blur, delay, speed and repetition."""
    for word in ("half", "quarter", "sector frozen", "sector blurred", "dark", "0.5 s", "1 s", "half speed", "second"):
        assert any(word in name for name in CASES), word
