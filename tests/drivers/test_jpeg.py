"""JPEG images: restart markers of all samplings, images of which a part was lost, and steps of the quantisation."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from drivers.errors import FrameDecodeError
from drivers.frame import Frame, coding_steps, gray
from drivers.jpeg import coding_sigma


def jpeg(data: bytes) -> Frame:
    return Frame(7, 1, "lower", "jpeg", data)


def interrupted(sampling: int, height: int = 256) -> tuple[bytes, list[int]]:
    """Return a colour JPEG of 96 px with a restart marker after each row of blocks, and their offsets."""
    noise = np.random.default_rng(2).integers(0, 256, (height, 96, 3), np.uint8)
    across = {cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422: 16, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444: 8}[sampling]
    words = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling, cv2.IMWRITE_JPEG_RST_INTERVAL, 96 // across]
    data = cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 3), words)[1].tobytes()
    return data, [found.start() for found in re.finditer(rb"\xff[\xd0-\xd7]", data)]


@pytest.mark.parametrize("sampling", [cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444])
@pytest.mark.parametrize("lost", [1, 3, 8])
def test_refuses_a_jpeg_of_which_rows_of_blocks_were_lost(sampling: int, lost: int) -> None:
    """The decoder itself reports success, and shows what follows a gap of three rows 24 px higher up."""
    whole, markers = interrupted(sampling)
    expected = gray(jpeg(whole))
    broken = whole[: markers[9]] + whole[markers[9 + lost] :]
    shown = cv2.imdecode(np.frombuffer(broken, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown.shape == expected.shape and not np.array_equal(shown, expected)
    if lost == 3:
        np.testing.assert_array_equal(shown[100:160], expected[124:184])
    with pytest.raises(FrameDecodeError, match=f"{31 - lost} of 31 restart markers"):
        gray(jpeg(broken))


def test_refuses_restart_markers_in_another_order_and_where_none_belong() -> None:
    whole, markers = interrupted(cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422)
    at = markers[5] + 1
    with pytest.raises(FrameDecodeError, match="not in order"):
        gray(jpeg(whole[:at] + b"\xd0" + whole[at + 1 :]))
    interval = whole.index(b"\xff\xdd")
    with pytest.raises(FrameDecodeError, match="31 of 0 restart markers"):
        gray(jpeg(whole[:interval] + whole[interval + 6 :]))


@pytest.mark.parametrize("size", [(96, 250), (90, 9), (16, 8)])
@pytest.mark.parametrize("interval", [1, 5, 6, 1000])
@pytest.mark.parametrize("mode", ["grey", "420", "422", "440", "444", "progressive"])
def test_accepts_restart_markers_of_all_samplings(size: tuple[int, int], interval: int, mode: str) -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (size[1], size[0], 3), np.uint8)
    words = [cv2.IMWRITE_JPEG_RST_INTERVAL, interval]
    if mode == "progressive":
        words += [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    elif mode != "grey":
        words += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{mode}")]
    data = cv2.imencode(".jpg", pixels[..., 0] if mode == "grey" else pixels, words)[1]
    expected = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(gray(jpeg(data.tobytes() + bytes(7))), expected)


def test_the_units_of_a_grey_jpeg_are_blocks_whatever_its_sampling_factors() -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (23, 37), np.uint8)
    data = bytearray(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1].tobytes())
    data[data.index(b"\xff\xc0") + 11] = 0x22
    assert gray(jpeg(bytes(data))).shape == pixels.shape


def test_the_steps_of_the_luminance_are_read_in_zigzag_order() -> None:
    """Quality 50 has the tables of annex K.1, of which the steps of a higher quality are a part."""
    assert coding_steps(jpeg(_coded(50)))[:10] == (16, 11, 12, 14, 12, 10, 16, 14, 13, 14)
    assert coding_steps(jpeg(_coded(75)))[:6] == (8, 6, 6, 7, 6, 5)
    assert coding_steps(Frame(0, 0, "lower", "mono8", np.zeros(64, np.uint8), 8, 8)) == ()


def test_a_cut_table_has_no_steps() -> None:
    whole = _coded(75)
    at = whole.index(b"\xff\xdb")
    assert coding_steps(jpeg(whole[: at + 30])) == ()
    # The length says that the segment ends within the table, and the rest of it is no marker.
    assert coding_steps(jpeg(whole[: at + 2] + b"\x00\x20" + whole[at + 4 :])) == ()
    # Steps of 16 bits would need twice the bytes.
    assert coding_steps(jpeg(whole[: at + 4] + b"\x10" + whole[at + 5 :])) == ()


@pytest.mark.parametrize("quality", [50, 75, 90])
@pytest.mark.parametrize("highest", [2, 3, 8])
def test_images_differ_from_their_jpegs_by_the_stated_error(quality: int, highest: int) -> None:
    """Of noise, whose coefficients exceed the steps, each frequency is off by a twelfth of the step's square."""
    grey = np.clip(np.rint(np.random.default_rng(8).normal(128.0, 40.0, (256, 256))), 0, 255).astype(np.uint8)
    data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    error = gray(jpeg(data)).astype(np.float32) - grey
    blocks = [cv2.dct(error[v : v + 8, u : u + 8].copy()) for v in range(0, 256, 8) for u in range(0, 256, 8)]
    squares = np.mean(np.square(blocks), axis=0)[:highest, :highest]
    found = np.sqrt((squares.sum() - squares[0, 0]) / 64)
    # Pixels are rounded as well, and coefficients below half a step are lost with an error as large as themselves.
    assert found == pytest.approx(coding_sigma(coding_steps(jpeg(data)), highest), rel=0.15 if highest < 8 else 0.25)


def _coded(quality: int) -> bytes:
    noise = np.random.default_rng(2).integers(0, 256, (64, 96, 3), np.uint8)
    return cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
