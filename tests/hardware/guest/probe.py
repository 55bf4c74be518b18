"""Run in the guest as ExecStartPre= of the unit: writes what the unit's sandbox permits to /var/lib/omnid."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Final

REPORT: Final = Path("/var/lib/omnid/sandbox.json")
FOLDERS: Final = ("/etc/omnid", "/opt/omnid", "/var/lib", "/var/lib/omnid", "/run/omnid")
DEVICES: Final = ("/dev/ttyS1", "/dev/video10", "/dev/vda", "/dev/kmsg")
HOSTS: Final = ("127.0.0.1", "192.168.1.5")
PORT: Final = 7000


def is_possible(action: Callable[[], object]) -> bool:
    """True if an action raises no error of the system."""
    try:
        action()
    except OSError:
        return False
    return True


def main() -> None:
    """Write the report."""
    flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
    report = {
        "written": {path: is_possible(Path(path, "probe").touch) for path in FOLDERS},
        "opened": {path: is_possible(lambda path=path: os.close(os.open(path, flags))) for path in DEVICES},  # type: ignore[misc]
        "reached": {
            host: is_possible(lambda host=host: socket.create_connection((host, PORT), 3).close())  # type: ignore[misc]
            for host in HOSTS
        },
    }
    REPORT.write_text(json.dumps(report))


if __name__ == "__main__":
    main()
