"""Calibration files of unknown origin: short texts that describe huge values are refused in bounded memory."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.models.unified import UnifiedCamera
from calib.panorama import fit_cylinder
from calib.rig import MountedCamera, Rig
from calib.rig_file import parse_rig, rig_toml
from calib.validation import read_bytes
from tests.limited import run_limited

MAX_MEMORY_MB = 200
PARSE = """
from calib.errors import CalibError
from calib.{module} import {function}
try:
    {function}({text})
except CalibError as error:
    print(error)
"""


def refusal(module: str, function: str, text: str) -> str:
    """Return the error for a text, an expression of Python, that is parsed in limited memory."""
    printed, memory_mb = run_limited(PARSE.format(module=module, function=function, text=text))
    assert memory_mb < MAX_MEMORY_MB
    assert printed and "\n" not in printed and len(printed) < 400
    return printed


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("'a.' * 20_000 + 'a = 1'", "a key of more than 65 parts"),
        ("'a . ' * 3_000_000 + 'a = 1'", "characters beside images of masks"),
        ("'[' + '\"\".' * 100_000 + 'a]'", "a key of more than 65 parts"),
        ("'schema = 0x' + 'f' * 200_000", "schema: expected version 1, found a huge int"),
        ("'a = [' + '1,' * 7_000_000 + ']'", "characters beside images of masks"),
        ("'a = [' + '\"\",' * 1_000_000 + ']'", "characters beside images of masks"),
        ("'\\n' * 200_000", "schema: expected version 1, found nothing"),
        ("'a = ' + '[' * 100_000", "TOML"),
        ("'a = \"' + 'x' * 15_000_000", "characters beside images of masks"),
        ("'a = \"' + '\\\\\\\\' * 1_000_000 + '\"'", "characters beside images of masks"),
        ("'# ' + '.' * 400_000 + '\\na = 1'", "schema: expected version 1, found nothing"),
    ],
)
def test_refuses_a_rig_that_would_fill_the_memory(text: str, reason: str) -> None:
    assert reason in refusal("rig_file", "parse_rig", text)


def test_refuses_many_ocam_coefficients(ocam_rig: Rig) -> None:
    text = rig_toml(ocam_rig).replace("polynomial = [", "polynomial = [" + "-1.0, " * 5000, 1)
    with pytest.raises(CalibError, match="at most 64 polynomial coefficients"):
        parse_rig(text)


def test_refuses_a_rig_with_huge_images(omni_rig: Rig) -> None:
    width, height = omni_rig.lower.camera.size
    with pytest.raises(CalibError, match="at most 67108864 in all"):
        parse_rig(rig_toml(omni_rig).replace(f"size = [{width}, {height}]", "size = [32767, 32767]"))


def png_of(width: int, height: int, content: bytes) -> bytes:
    """Return a grey PNG with the given header."""
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", content), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


def test_refuses_a_mask_of_another_size_before_it_is_decoded(omni_rig: Rig) -> None:
    image = base64.b64encode(png_of(8000, 8000, zlib.compress(bytes(8001 * 8000)))).decode()
    mask = f'\n[lower.mask]\ncenter = [1, 1]\nimage = "data:image/png;base64,{image}"\n'
    reason = refusal("rig_file", "parse_rig", repr(rig_toml(omni_rig) + mask))
    assert "lower.mask.image: expected" in reason and "found (8000, 8000)" in reason


@pytest.mark.parametrize("name", ["jpg", "bmp"])
def test_an_embedded_mask_is_a_png(omni_rig: Rig, name: str) -> None:
    start = {"jpg": b"\xff\xd8\xff", "bmp": b"BM"}[name]
    image = base64.b64encode(start + bytes(100)).decode()
    with pytest.raises(CalibError, match=r"lower\.mask\.image: expected a PNG"):
        parse_rig(rig_toml(omni_rig) + f'\n[lower.mask]\ncenter = [1, 1]\nimage = "data:image/png;base64,{image}"\n')


def enlarged(rig: Rig, factor: float) -> Rig:
    """Return the rig with images that are larger and have the same field of view."""
    mounted = []
    for side in (rig.lower, rig.upper):
        camera = side.camera
        assert isinstance(camera, UnifiedCamera)
        width, height = (round(side_px * factor) for side_px in camera.size)
        focal, center = (tuple(factor * value for value in values) for values in (camera.focal, camera.center))
        larger = UnifiedCamera(
            camera.xi, (focal[0], focal[1]), (center[0], center[1]), (width, height), camera.distortion
        )
        mounted.append(MountedCamera(larger, side.T_cam_rig))
    return Rig(mounted[0], mounted[1])


@pytest.mark.parametrize(("factor", "reason"), [(11, "16384 columns"), (400, "columns"), (1e30, "columns")])
def test_refuses_a_rig_that_asks_for_a_huge_panorama(omni_rig: Rig, factor: float, reason: str) -> None:
    with pytest.raises(CalibError, match=reason) as caught:
        fit_cylinder(enlarged(omni_rig, factor))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


TABLES = """
from tests.calib.conftest import misaligned, omni_cameras
from calib.panorama import Cylinder, remap_tables
rig = misaligned(*omni_cameras())
u, v = remap_tables(rig, rig.lower, Cylinder(4096, 1500, 700.0))
print(u.shape)
"""


def test_tables_take_little_more_memory_than_they_need(omni_rig: Rig) -> None:
    """6 million pixels: 49 MB of tables; all at once the projection would take more than 1 GB."""
    printed, memory_mb = run_limited(TABLES)
    assert printed == "(1500, 4096)" and memory_mb < 250


def test_files_are_bounded(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(CalibError, match="more than 4 bytes"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(CalibError, match="cannot be read: No such file"):
        read_bytes(tmp_path / "b")
