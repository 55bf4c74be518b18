"""Settings of three levels, with knobs of each kind, for the tests of settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class Stereo:
    window_px: int = knob(11, "side of the matching window, px", low=3, high=31)
    ratio: float = knob(0.8, "second best over best, 1", low=0.0, high=1.0)
    method: str = knob("sad", "cost of a match", choices=("sad", "census"))
    subpixel: bool = knob(True, "whether to refine")
    horizon_s: float = knob(1.5, "how long a match is kept, s", low=0.0)


@dataclass(frozen=True, slots=True)
class Serial:
    port: str = knob('/dev/"omnid"\t\x7f\n\\ü', "device of the motor")
    bauds: tuple[int, ...] = knob((115200, 9600), "rates to try, baud", low=1)


@dataclass(frozen=True, slots=True)
class Motor:
    limit_mps: float = knob(1.0, "speed limit, m/s", high=0)
    serial: Serial = field(default_factory=lambda: Serial(bauds=(57600,)))


@dataclass(frozen=True, slots=True)
class Config:
    robot: str = knob("robot", "name on the bus")
    offset_m: tuple[float, float, float] = knob((0.0, 1e-5, 1e16), "where the rig is, m")
    topics: tuple[str, ...] = knob((), "topics to record")
    stereo: Stereo = field(default_factory=Stereo)
    motor: Motor = field(default_factory=lambda: Motor(limit_mps=-1.0))


def written(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "omnid.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path
