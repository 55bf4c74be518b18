"""Checks of access to devices: permissions, groups, processes that use them."""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from omnid.doctor.finding import Finding

GROUPS: Final = ("video", "dialout")  # the unit's SupplementaryGroups
OWN_NAME: Final = "omnid"  # Name of the daemon's processes.
_MAX_PROCESSES: Final = 100_000


def access(subject: str, device: Path) -> Iterator[Finding]:
    """Yield a finding if this user or the service may not open the device."""
    found = device.stat()
    group = _group(found.st_gid)
    if group not in GROUPS and found.st_mode & 0o006 != 0o006:
        yield Finding(
            "warning",
            subject,
            f"{device} is of group {group}, the service is in {' and '.join(GROUPS)}",
            'set GROUP="video" or GROUP="dialout" in its udev rule, see 90-omnid.rules',
        )
    elif not os.access(device, os.R_OK | os.W_OK):
        yield Finding(
            "error",
            subject,
            f"no permission for {device} of group {group}",
            f"`sudo usermod -aG {group} $USER`, then log in again",
        )


def memberships(names: Sequence[str] = GROUPS) -> Finding:
    """Check that this user is in the groups of cameras and serial ports."""
    missing = [name for name in names if _gid(name) not in {*os.getgroups(), os.getegid()}]
    if os.geteuid() == 0:
        return Finding("ok", "groups", "root may open all devices")
    if missing:
        return Finding(
            "warning",
            "groups",
            f"you are not in group {' and '.join(missing)}; the service is",
            f"`sudo usermod -aG {','.join(missing)} $USER`, then log in again",
        )
    return Finding("ok", "groups", f"you are in {' and '.join(names)}")


def holders(device: Path, root: Path = Path("/")) -> list[str]:
    """Return the programs but omnid that have the device open: "name (pid 12)"; without root those of this user."""
    target, found = device.resolve(), []
    processes = [entry for entry in (root / "proc").glob("[0-9]*") if entry.name != str(os.getpid())]
    for process in processes[:_MAX_PROCESSES]:
        with suppress(OSError):  # it has ended, or belongs to another user
            if any(_leads_to(entry, target) for entry in (process / "fd").iterdir()):
                name = (process / "comm").read_text("utf-8", "replace").strip()
                if not name.startswith(OWN_NAME):
                    found.append(f"{name} (pid {process.name})")
    return found


def _leads_to(entry: Path, target: Path) -> bool:
    with suppress(OSError):
        return os.readlink(entry) == str(target)
    return False


def _group(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def _gid(name: str) -> int | None:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        return None
