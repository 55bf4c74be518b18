"""Frames to grey pixels: raw encodings, JPEG and PNG, whole, damaged and hostile; steps of a JPEG."""

from __future__ import annotations

import random
import re
import struct
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import FrameDecodeError
from drivers.frame import MAX_PIXELS, Frame, coding_steps, gray
from drivers.jpeg import coding_sigma

WIDTH, HEIGHT = 37, 23
COLOURS = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
SMOOTH = cv2.GaussianBlur(COLOURS, (0, 0), 3)


def frame(encoding: str, data: object, **fields: object) -> Frame:
    layout = {"width": WIDTH, "height": HEIGHT} | fields
    return Frame(7, 1, "lower", encoding, data, **layout)  # type: ignore[arg-type]


def jpeg(data: bytes) -> Frame:
    return frame("jpeg", data)


def encoded(suffix: str, image: NDArray[Any] = SMOOTH[..., :3]) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def padded_rows(pixels: NDArray[Any], padding: int) -> tuple[bytes, int]:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(HEIGHT, -1)
    return np.pad(rows, ((0, 0), (0, padding)), constant_values=99).tobytes(), rows.shape[1] + padding


RAW = {  # encoding -> channels of COLOURS, and the grey image of them
    "mono8": (1, lambda pixels: pixels[..., 0]),
    "bgr8": (3, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)),
    "rgb8": (3, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)),
    "bgra8": (4, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_BGRA2GRAY)),
    "rgba8": (4, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_RGBA2GRAY)),
    "yuyv": (2, lambda pixels: pixels[..., 0]),
    "uyvy": (2, lambda pixels: pixels[..., 1]),
    **dict.fromkeys(("nv12", "nv21", "nv24"), (1, lambda pixels: pixels[..., 0])),
}
# Encoding -> rows and columns of the samples that are red, from the first ones on.
BAYER = {"bayer_rggb": (0, 0), "bayer_bggr": (1, 1), "bayer_gbrg": (1, 0), "bayer_grbg": (0, 1)}


@pytest.mark.parametrize("name", BAYER)
@pytest.mark.parametrize(("dtype", "bits"), [("u1", 16), ("<u2", 10), (">u2", 12)])
def test_bayer_patterns_are_interpolated(name: str, dtype: str, bits: int) -> None:
    """Red light, which is 0.299 of the grey level of white."""
    full = 255 if dtype == "u1" else 2**bits - 1
    samples = np.zeros((HEIGHT, WIDTH), dtype)
    row, column = BAYER[name]
    samples[row::2, column::2] = full
    encoding = f"{name}{8 * samples.itemsize}"
    found = gray(frame(encoding, samples.tobytes(), bits=bits, bigendian=dtype == ">u2"))
    assert found.shape == (HEIGHT, WIDTH) and np.abs(found[2:-2, 2:-2].astype(float) - 0.299 * 255).max() < 2


@pytest.mark.parametrize("encoding", RAW)
@pytest.mark.parametrize("padding", [0, 6])
def test_raw_images_are_decoded_with_and_without_padding_of_rows(encoding: str, padding: int) -> None:
    channels, expected = RAW[encoding]
    pixels = np.ascontiguousarray(COLOURS[..., :channels])
    data, step = padded_rows(pixels, padding)
    if encoding == "nv12":
        data += bytes(step * (HEIGHT + 1) // 2)  # the plane of chroma
    else:
        data = data[: len(data) - padding]  # the last row needs no padding
    np.testing.assert_array_equal(gray(frame(encoding, memoryview(data), step=step)), expected(pixels))


def test_jpeg_without_huffman_tables_is_decoded() -> None:
    """Motion JPEG leaves the standard tables out (USB Video Class 1.5, payload of MJPEG, 3.1)."""
    data, bare, at = encoded(".jpg"), b"\xff\xd8", 2
    while data[at + 1] != 0xDA:
        size = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        bare += b"" if data[at + 1] == 0xC4 else data[at : at + size]
        at += size
    bare += data[at:]
    assert b"\xff\xc4" not in bare[: len(bare) - len(data) + at] and len(bare) < len(data)
    np.testing.assert_array_equal(gray(frame("jpeg", bare)), gray(frame("jpeg", data)))


def interrupted(sampling: int) -> tuple[bytes, list[int]]:
    """Return a colour JPEG of 96 x 256 px with a restart marker after each row of blocks, and their offsets."""
    noise = np.random.default_rng(2).integers(0, 256, (256, 96, 3), np.uint8)
    across = {cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422: 16, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444: 8}[sampling]
    words = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling, cv2.IMWRITE_JPEG_RST_INTERVAL, 96 // across]
    data = cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 3), words)[1].tobytes()
    return data, [found.start() for found in re.finditer(rb"\xff[\xd0-\xd7]", data)]


@pytest.mark.parametrize("sampling", [cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444])
@pytest.mark.parametrize("lost", [1, 8])
def test_a_jpeg_that_lost_rows_of_blocks_is_refused(sampling: int, lost: int) -> None:
    """OpenCV reports success, and shows what follows a gap of three rows 24 px higher up."""
    whole, markers = interrupted(sampling)
    broken = whole[: markers[9]] + whole[markers[9 + lost] :]
    assert cv2.imdecode(np.frombuffer(broken, np.uint8), cv2.IMREAD_GRAYSCALE).shape == gray(jpeg(whole)).shape
    with pytest.raises(FrameDecodeError, match=r"found marker 0xd. instead of RST"):
        gray(jpeg(broken))


@pytest.mark.parametrize("after", [b"", bytes(5000), b"\xff\xd8 a thumbnail \xff\xd9"])
@pytest.mark.parametrize("zeros", [0, 1, 20])
def test_bytes_about_the_end_of_a_jpeg_do_not_matter(after: bytes, zeros: int) -> None:
    """Webcams write zeros before the end of image, and fill their buffers after it; telephones add other images."""
    whole = encoded(".jpg")
    found = gray(jpeg(whole[:-2] + bytes(zeros) + whole[-2:] + after))
    np.testing.assert_array_equal(found, gray(jpeg(whole)))


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


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_truncation_at_any_byte_is_detected(suffix: str) -> None:
    data, encoding = encoded(suffix), {".jpg": "jpeg", ".png": "png"}[suffix]
    for size in range(len(data)):
        for padding in (0, 300):
            with pytest.raises(FrameDecodeError):
                gray(frame(encoding, data[:size] + bytes(padding)))


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (frame("mono8", bytes(WIDTH * HEIGHT - 1)), "bytes"),
        (frame("mono16", bytes(WIDTH * HEIGHT * 2), step=WIDTH), "step"),
        (frame("mono8", bytes(100), width=0), "size"),
        (frame("mono8", bytes(100), width=2**31, height=2**31), "size"),
        (frame("mono8", bytes(10**4), step=2**62), "bytes"),
        (frame("bayer_rggb9", bytes(10**4)), "known encodings"),
        (frame("jpeg", encoded(".jpg")[:-40] + bytes(9000)), "Premature end"),
        (frame("jpeg", b"BM" + bytes(100)), "starts with"),
        (frame("png", encoded(".jpg")), "starts with"),
        (frame("mono8", np.zeros((HEIGHT, 2 * WIDTH), np.uint8)[:, ::2]), "contiguous"),
    ],
)
def test_malformed_frames_are_refused_in_one_line(broken: Frame, reason: str) -> None:
    with pytest.raises(FrameDecodeError, match=reason) as caught:
        gray(broken)
    assert "\n" not in str(caught.value) and "lower frame 7" in str(caught.value)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_damaged_images_raise_only_decode_errors(suffix: str) -> None:
    chance, whole = random.Random(3), encoded(suffix)
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        try:
            assert gray(frame({".jpg": "jpeg", ".png": "png"}[suffix], bytes(data))).ndim == 2
        except FrameDecodeError:
            continue


@pytest.mark.parametrize(("suffix", "encoding"), [(".jpg", "jpeg"), (".png", "png")])
@pytest.mark.parametrize(("side", "words"), [(60000, "60000 x 60000"), (5000, "5000 x 5000 px of")])
def test_images_that_would_fill_the_memory_are_refused(suffix: str, encoding: str, side: int, words: str) -> None:
    """Decoders of progressive JPEG and interlaced PNG store the samples of all channels."""
    data = encoded(suffix)
    assert 3 * side * side > MAX_PIXELS
    at, layout = (16, ">II") if encoding == "png" else (data.index(b"\xff\xc0") + 5, ">HH")
    large = data[:at] + struct.pack(layout, side, side) + data[at + struct.calcsize(layout) :]
    with pytest.raises(FrameDecodeError, match=words):
        gray(frame(encoding, large))
