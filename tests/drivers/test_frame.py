from __future__ import annotations

import os
import random
import struct
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import FrameDecodeError
from drivers.frame import MAX_PIXELS, MAX_SAMPLES, Frame, gray
from omnid import cli
from tests.limited import run_limited

WIDTH, HEIGHT = 37, 23
COLOURS = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
SMOOTH = cv2.GaussianBlur(COLOURS, (0, 0), 3)


def frame(encoding: str, data: object, **fields: object) -> Frame:
    layout = {"width": WIDTH, "height": HEIGHT} | fields
    return Frame(7, 1, "lower", encoding, data, **layout)  # type: ignore[arg-type]


def encoded(suffix: str, image: NDArray[Any] = SMOOTH[..., :3]) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def padded_rows(pixels: NDArray[Any], padding: int) -> tuple[bytes, int]:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(HEIGHT, -1)
    return np.pad(rows, ((0, 0), (0, padding)), constant_values=99).tobytes(), rows.shape[1] + padding


@pytest.mark.parametrize(
    ("encoding", "channels", "code"),
    [
        ("bgr8", 3, cv2.COLOR_BGR2GRAY),
        ("rgb8", 3, cv2.COLOR_RGB2GRAY),
        ("bgra8", 4, cv2.COLOR_BGRA2GRAY),
        ("rgba8", 4, cv2.COLOR_RGBA2GRAY),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_converts_colours_with_opencvs_weights(encoding: str, channels: int, code: int, padding: int) -> None:
    pixels = np.ascontiguousarray(COLOURS[..., :channels])
    data, step = padded_rows(pixels, padding)
    np.testing.assert_array_equal(gray(frame(encoding, data, step=step)), cv2.cvtColor(pixels, code))


@pytest.mark.parametrize("padding", [0, 3])
def test_does_not_change_mono8(padding: int) -> None:
    data, step = padded_rows(COLOURS[..., 0], padding)
    np.testing.assert_array_equal(gray(frame("mono8", memoryview(data), step=step)), COLOURS[..., 0])


@pytest.mark.parametrize(("encoding", "luma"), [("yuyv", 0), ("uyvy", 1)])
@pytest.mark.parametrize("padding", [0, 6])
def test_luma_of_packed_colours_is_every_second_byte(encoding: str, luma: int, padding: int) -> None:
    data, step = padded_rows(np.ascontiguousarray(COLOURS[..., :2]), padding)
    np.testing.assert_array_equal(gray(frame(encoding, data, step=step)), COLOURS[..., luma])


def test_packed_colours_agree_with_opencv() -> None:
    even = np.ascontiguousarray(COLOURS[:, :36, :2])
    for encoding, code in (("yuyv", cv2.COLOR_YUV2GRAY_YUYV), ("uyvy", cv2.COLOR_YUV2GRAY_UYVY)):
        np.testing.assert_array_equal(gray(frame(encoding, even.tobytes(), width=36)), cv2.cvtColor(even, code))


@pytest.mark.parametrize("padding", [0, 3])
def test_luma_of_nv12_is_its_first_plane(padding: int) -> None:
    data, step = padded_rows(COLOURS[..., 0], padding)
    chroma = bytes(step * (HEIGHT + 1) // 2)
    np.testing.assert_array_equal(gray(frame("nv12", data + chroma, step=step)), COLOURS[..., 0])


def test_decodes_jpeg_without_huffman_tables() -> None:
    """Motion JPEG leaves the standard tables out (USB Video Class 1.5, payload of MJPEG, 3.1)."""
    data, bare, at = encoded(".jpg"), b"\xff\xd8", 2
    while data[at + 1] != 0xDA:
        size = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        bare += b"" if data[at + 1] == 0xC4 else data[at : at + size]
        at += size
    bare += data[at:]
    assert b"\xff\xc4" not in bare[: len(bare) - len(data) + at] and len(bare) < len(data)
    np.testing.assert_array_equal(gray(frame("jpeg", bare)), gray(frame("jpeg", data)))


@pytest.mark.parametrize(("order", "bigendian"), [("<u2", False), (">u2", True)])
@pytest.mark.parametrize("padding", [0, 3])
def test_mono16_keeps_its_upper_byte(order: str, bigendian: bool, padding: int) -> None:
    values = (COLOURS[..., 0].astype(np.uint16) << 8) | COLOURS[..., 1]
    data, step = padded_rows(values.astype(order), padding)
    np.testing.assert_array_equal(gray(frame("mono16", data, step=step, bigendian=bigendian)), COLOURS[..., 0])


def test_the_last_row_needs_no_padding() -> None:
    data, step = padded_rows(COLOURS[..., 0], 6)
    np.testing.assert_array_equal(gray(frame("mono8", data[:-6], step=step)), COLOURS[..., 0])


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("padding", [0, 1, 5000])
def test_compressed_images_and_the_padding_of_cameras(suffix: str, padding: int) -> None:
    data = encoded(suffix)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    encoding = {".jpg": "jpeg", ".png": "png"}[suffix]
    np.testing.assert_array_equal(gray(Frame(0, 0, "upper", encoding, data + bytes(padding))), expected)


def test_ignores_the_exif_orientation() -> None:
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    data = encoded(".jpg")
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + data[2:]
    turned_by_opencv: Any = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert turned_by_opencv.shape == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(gray(frame("jpeg", turned)), gray(frame("jpeg", data)))


@pytest.mark.parametrize("encoding", ["jpeg", "mono8", "mono16", "bgr8", "rgba8", "yuyv", "uyvy", "nv12"])
def test_the_image_is_read_only_and_independent_of_the_buffer(encoding: str) -> None:
    buffer = np.frombuffer(encoded(".jpg") if encoding == "jpeg" else COLOURS.tobytes(), np.uint8).copy()
    image = gray(frame(encoding, buffer))
    before = image.copy()
    buffer[:] = 0
    assert image.flags.c_contiguous and not image.flags.writeable and image.dtype == np.uint8
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_detects_truncation_at_any_byte(suffix: str) -> None:
    data, encoding = encoded(suffix), {".jpg": "jpeg", ".png": "png"}[suffix]
    for size in range(len(data)):
        with pytest.raises(FrameDecodeError):
            gray(frame(encoding, data[:size]))


def test_detects_truncation_before_padding() -> None:
    with pytest.raises(FrameDecodeError, match="end is missing"):
        gray(frame("jpeg", encoded(".jpg")[:-40] + bytes(9000)))


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (frame("mono8", bytes(WIDTH * HEIGHT - 1)), "bytes"),
        (frame("bgr8", bytes(WIDTH * HEIGHT)), "bytes"),
        (frame("yuyv", bytes(WIDTH * HEIGHT * 2 - 1)), "bytes"),
        (frame("nv12", bytes(WIDTH * HEIGHT - 1)), "bytes"),
        (frame("mono16", bytes(WIDTH * HEIGHT * 2), step=WIDTH), "step"),
        (frame("mono8", bytes(100), width=0), "size"),
        (frame("mono8", bytes(100), width=-3), "size"),
        (frame("mono8", bytes(100), width=2**31, height=2**31), "size"),
        (frame("mono8", bytes(10**4), step=2**62), "bytes"),
        (frame("bayer_rggb8", bytes(10**4)), "known encodings"),
        (frame("jpeg", b""), "nothing"),
        (frame("jpeg", b"BM" + bytes(100)), "starts with"),
        (frame("png", encoded(".jpg")), "starts with"),
        (frame("mono8", np.zeros((HEIGHT, 2 * WIDTH), np.uint8)[:, ::2]), "contiguous"),
    ],
)
def test_refuses_malformed_frames_in_one_line(broken: Frame, reason: str) -> None:
    with pytest.raises(FrameDecodeError, match=reason) as caught:
        gray(broken)
    assert "\n" not in str(caught.value) and "lower frame 7" in str(caught.value)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_refuses_an_excessive_size_before_decoding(suffix: str) -> None:
    data = bytearray(encoded(suffix))
    if suffix == ".png":
        data[16:24] = struct.pack(">II", 60000, 60000)
    else:
        start = data.index(b"\xff\xc0")
        data[start + 5 : start + 9] = struct.pack(">HH", 60000, 60000)
    with pytest.raises(FrameDecodeError, match="60000 x 60000"):
        gray(frame({".jpg": "jpeg", ".png": "png"}[suffix], bytes(data)))


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


def with_size(data: bytes, width: int, height: int, marker: bytes = b"\xff\xc0") -> tuple[bytes, bytes, bytes]:
    """Return a JPEG's bytes before its frame header, that header with another size, and the bytes after it."""
    start = data.index(marker)
    end = start + 2 + int.from_bytes(data[start + 2 : start + 4], "big")
    header = data[start : start + 5] + struct.pack(">HH", height, width) + data[start + 9 : end]
    return data[:start], header, data[end:]


@pytest.mark.parametrize("marker", [b"\xff\x01", b"\xff\xd0", b"\xff\xe0\0\0", b"\xff\xe0\0\1"])
def test_refuses_markers_that_hide_the_size_from_a_walk_over_the_segments(marker: bytes) -> None:
    """libjpeg goes on right after such a marker; a walk that adds a length arrives at a second, small header."""
    data = encoded(".jpg")
    before, large, after = with_size(data, 30_000, 30_000)
    small = with_size(data, WIDTH, HEIGHT)[1]
    hidden = before[:2] + marker + before[2:] + large + after[:-2]
    for jump in (2, 2 + int.from_bytes(hidden[4:6], "big")):
        tail = bytes(max(0, 2 + jump - len(hidden))) + small + after
        with pytest.raises(FrameDecodeError, match="its size is"):
            gray(frame("jpeg", hidden + tail))


def test_refuses_a_second_frame_header() -> None:
    before, small, after = with_size(encoded(".jpg"), WIDTH, HEIGHT)
    with pytest.raises(FrameDecodeError, match="its size is 0 x 0"):
        gray(frame("jpeg", before + small + small + after))


def test_refuses_an_animated_png() -> None:
    data = encoded(".png")
    with pytest.raises(FrameDecodeError, match="its size is 0 x 0"):
        gray(frame("png", data[:33] + b"\0\0\0\x04tEXtIDAT\0\0\0\0" + b"\0\0\0\x08acTL" + bytes(12) + data[33:]))


def test_refuses_a_png_whose_first_chunk_is_no_header() -> None:
    data = encoded(".png")
    with pytest.raises(FrameDecodeError, match="its size is 0 x 0"):
        gray(frame("png", data[:8] + b"\0\0\0\0tIME\0\0\0\0" + data[8:]))


@pytest.mark.parametrize(("suffix", "encoding"), [(".jpg", "jpeg"), (".png", "png")])
def test_refuses_colour_images_whose_samples_would_fill_the_memory(suffix: str, encoding: str) -> None:
    """Decoders of progressive JPEG and interlaced PNG store all samples."""
    data, side = encoded(suffix), 5000
    assert side * side < MAX_PIXELS and 3 * side * side > MAX_SAMPLES
    large = data[:16] + struct.pack(">II", side, side) + data[24:]
    if encoding == "jpeg":
        large = b"".join(with_size(data, side, side))
    with pytest.raises(FrameDecodeError, match="5000 x 5000 px of 3 channels"):
        gray(frame(encoding, large))


DECODE = """
from omnid import cli
cli.bound_image_size()
import cv2
import numpy as np
size = np.array([9000, 9000], "<i4").tobytes()
bmp = b"BM" + bytes(8) + b"\\x36\\0\\0\\0\\x28\\0\\0\\0" + size + b"\\1\\0\\x18\\0" + bytes(2000)
try:
    print(cv2.imdecode(np.frombuffer(bmp, np.uint8), 0))
except cv2.error as error:
    print("CV_IO_MAX_IMAGE_PIXELS" in str(error))
"""


def test_opencv_itself_refuses_larger_images_in_the_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Formats whose header is not read here are bounded as well."""
    printed, memory_mb = run_limited(DECODE)
    assert printed == "True" and memory_mb < 200
    monkeypatch.delenv("OPENCV_IO_MAX_IMAGE_PIXELS", raising=False)
    cli.bound_image_size()
    assert os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] == str(MAX_PIXELS)


def test_import_leaves_the_environment_as_it_is() -> None:
    printed, _ = run_limited("import os\nbefore = dict(os.environ)\nimport omnid\nprint(before == dict(os.environ))")
    assert printed == "True"
