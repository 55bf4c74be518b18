"""Sizes, offsets and numbers compared with gcc 12 and linux/videodev2.h (linux-libc-dev 6.1), with -m64 and -m32."""

from __future__ import annotations

import ctypes
import runpy
from typing import Any

import pytest

from drivers.cameras import v4l2_ioctl

SIZES = {  # struct v4l2_...: (64 bits, 32 bits)
    "Capability": (104, 104), "PixelFormat": (48, 48), "Format": (208, 204), "StreamParameters": (204, 204),
    "BufferRequest": (20, 20), "V4l2Buffer": (88, 68), "QueryControl": (68, 68), "QueryMenu": (44, 44),
    "V4l2Control": (8, 8),
}  # fmt: skip
OFFSETS = {
    ("V4l2Buffer", "flags"): (12, 12), ("V4l2Buffer", "timestamp"): (24, 20), ("V4l2Buffer", "sequence"): (56, 44),
    ("V4l2Buffer", "m"): (64, 52), ("V4l2Buffer", "length"): (72, 56), ("Format", "fmt"): (8, 4),
    ("StreamParameters", "capability"): (4, 4), ("StreamParameters", "timeperframe"): (12, 12),
}  # fmt: skip
REQUESTS = {
    "QUERYCAP": (0x80685600, 0x80685600), "G_FMT": (0xC0D05604, 0xC0CC5604),
    "S_FMT": (0xC0D05605, 0xC0CC5605), "REQBUFS": (0xC0145608, 0xC0145608), "QUERYBUF": (0xC0585609, 0xC0445609),
    "QBUF": (0xC058560F, 0xC044560F), "DQBUF": (0xC0585611, 0xC0445611), "STREAMON": (0x40045612, 0x40045612),
    "STREAMOFF": (0x40045613, 0x40045613), "G_PARM": (0xC0CC5615, 0xC0CC5615), "S_PARM": (0xC0CC5616, 0xC0CC5616),
    "G_CTRL": (0xC008561B, 0xC008561B), "S_CTRL": (0xC008561C, 0xC008561C), "QUERYCTRL": (0xC0445624, 0xC0445624),
    "QUERYMENU": (0xC02C5625, 0xC02C5625),
}  # fmt: skip


@pytest.fixture(params=[0, 1], ids=["64 bits", "32 bits"])
def abi(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[dict[str, Any], int]:
    """The module's names where a long has 64 or 32 bits, and the index of that case."""
    monkeypatch.setattr(ctypes, "c_long", (ctypes.c_int64, ctypes.c_int32)[request.param])
    return runpy.run_path(v4l2_ioctl.__file__), request.param


def test_structures_and_requests_are_the_kernels(abi: tuple[dict[str, Any], int]) -> None:
    names, bits = abi
    assert {name: ctypes.sizeof(names[name]) for name in SIZES} == {name: sizes[bits] for name, sizes in SIZES.items()}
    found = {(struct, member): getattr(names[struct], member).offset for struct, member in OFFSETS}
    assert found == {member: offsets[bits] for member, offsets in OFFSETS.items()}
    assert {name: names[name] for name in REQUESTS} == {name: numbers[bits] for name, numbers in REQUESTS.items()}
