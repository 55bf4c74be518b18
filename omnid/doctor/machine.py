"""Checks of the machine: clocks, real-time rights, disk, packages, compiled functions."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from omnid.config import RecordConfig
from omnid.doctor.finding import Finding
from omnid.engine.kernel_cache import kept_kernels
from omnid.engine.realtime import LOCK_ADVICE, highest_priority, may_lock, priority_advice

PACKAGES: Final = {
    "numpy": "numpy",
    "opencv-python-headless": "cv2",
    "eclipse-zenoh": "zenoh",
    "mcap": "mcap",
    "rosbags": "rosbags",
    "pyserial": "serial",
    "filterpy": "filterpy",
}  # package: module
BUILT_S: Final = 1_735_689_600  # the start of 2025: an earlier time is wrong
_UNSYNCHRONISED: Final = 5  # TIME_ERROR of adjtimex(2)
_TIMEX_BYTES: Final = 1024  # more than struct timex has on any platform
_SLOW_CLOCKS: Final = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
STATE: Final = Path("/var/lib/omnid")  # StateDirectory and working directory of the unit
CACHE: Final = Path("/var/cache/omnid")  # CacheDirectory of the unit


def clock(now_s: float | None = None, synchronised: bool | None = None, root: Path = Path("/")) -> Iterator[Finding]:
    """Check that the system's time is plausible and synchronised, and that the monotonic clock is fast."""
    now_s = time.time() if now_s is None else now_s
    synchronised = is_synchronised() if synchronised is None else synchronised
    shown = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    if now_s < BUILT_S:
        yield Finding(
            "error", "clock", f"the time is wrong: {shown}", "`timedatectl set-ntp true`, or `sudo date -s ...`"
        )
    elif not synchronised:
        yield Finding(
            "warning",
            "clock",
            f"{shown}, not synchronised: logs of several machines will not match",
            "`timedatectl set-ntp true`, or install chrony",
        )
    else:
        yield Finding("ok", "clock", f"{shown}, synchronised")
    source = _word(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    if source in _SLOW_CLOCKS:
        yield Finding(
            "warning",
            "monotonic",
            f"the kernel reads time from {source}, which takes microseconds",
            "`dmesg | grep -i clocksource` has the reason why the processor's counter is not used",
        )
    else:
        yield Finding("ok", "monotonic", f"CLOCK_MONOTONIC from {source or 'an unnamed source'}")


def is_synchronised() -> bool:
    """True if the kernel's clock is synchronised, by chrony, ntpd or systemd-timesyncd."""
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))  # all zeros: read only
    return state not in (-1, _UNSYNCHRONISED)


def rights(priority: int, lock_memory: bool) -> Iterator[Finding]:
    """Check that this user may have the real-time priority, and may lock memory."""
    highest = highest_priority()
    if priority > highest:
        yield Finding(
            "warning",
            "real time",
            f"priority {priority} is not allowed, this user may have {highest}; the unit sets LimitRTPRIO",
            priority_advice(priority),
        )
    else:
        yield Finding("ok", "real time", f"priorities up to {highest} are allowed")
    if lock_memory and not may_lock():
        yield Finding("warning", "memory", "this user may not lock memory; the unit sets LimitMEMLOCK", LOCK_ADVICE)
    else:
        yield Finding("ok", "memory", "may be locked" if may_lock() else "not locked: realtime.lock_memory = false")


def disk(folder: Path, config: RecordConfig, bytes_per_s: float) -> Iterator[Finding]:
    """Check the space for recordings in the folder (or where it will be), and that the service may write there."""
    place = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(place).free
    room = min(free - config.free_mb * 10**6, config.keep_mb * 10**6)
    if room <= 0:
        yield Finding(
            "error" if config.enabled else "warning",
            "disk",
            f"{free / 1e9:.1f} GB free at {place}: nothing is recorded below record.free_mb = {config.free_mb}",
            "delete files, or change record.folder",
        )
    else:
        yield Finding(
            "ok",
            "disk",
            f"{free / 1e9:.1f} GB free at {place}: the newest {room / 1e9:.1f} GB, about "
            f"{room / bytes_per_s / 3600:.1f} h, are kept of what is recorded",
        )
    if not folder.is_relative_to(STATE):
        yield Finding(
            "warning",
            "disk",
            f"the service may write in {STATE} only, record.folder is {folder}",
            f"`systemctl edit omnid`: [Service], ReadWritePaths={folder}",
        )


def programs() -> Iterator[Finding]:
    """Check that the packages omnid depends on can be imported; list their versions."""
    loaded: list[str] = []
    for package, module in PACKAGES.items():
        try:
            import_module(module)
            loaded.append(f"{module} {_version(package)}")
        except ImportError as error:
            yield Finding("error", "programs", f"{package}: {error}", f"/opt/omnid/bin/pip install {package}")
    yield Finding("ok", "programs", f"Python {platform.python_version()}, {', '.join(loaded)}")


def compiled_functions(service: Path = CACHE) -> Iterator[Finding]:
    """Check that functions can be compiled, and whether the next start finds them compiled.

    service: the cache of the unit, which root asks about once the unit has made it; other users ask about their own.
    """
    try:
        kept = kept_kernels(service if os.geteuid() == 0 and service.is_dir() else None)
    except (ImportError, OSError) as error:
        yield Finding(
            "error",
            "compiled code",
            f"numba cannot be used: {error}",
            "`/opt/omnid/bin/pip install numba`; "
            "remove MemoryDenyWriteExecute= from the unit, or what else denies executable memory",
        )
        return
    if kept.unusable:
        yield Finding(
            "warning",
            "compiled code",
            f"cannot be kept in {kept.folder}: {kept.unusable}: every start takes some 20 s longer",
            "make that folder writable, or set OMNID_CACHE_DIR to another one",
        )
    elif kept.missing:
        yield Finding(
            "ok",
            "compiled code",
            f"{kept.missing} functions will be compiled at the next start, which "
            f"takes some 20 s, and be kept in {kept.folder}",
        )
    else:
        yield Finding("ok", "compiled code", f"{kept.kept} functions in {kept.folder}")


def _version(package: str) -> str:
    with suppress(PackageNotFoundError):
        return version(package)
    return "(of another package)"  # OpenCV has four, and distributions have their own


def _word(path: Path) -> str:
    with suppress(OSError):
        return path.read_text("utf-8", "replace").strip()[:40]
    return ""
