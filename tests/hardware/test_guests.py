"""The guest itself: its input, its results, and its failures."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest

from tests.hardware.machine import Guest, GuestError, run_in_vm

pytestmark = pytest.mark.vm
SCRIPT = b"""
import pathlib, serial, subprocess, sys
import omnid
with serial.Serial("/dev/ttyS1", 115200, timeout=20) as port:
    port.write(b"hello\\n")
    pathlib.Path("/mnt/job/results/answer").write_bytes(port.readline())
print(omnid.__file__, pathlib.Path("/proc/1/comm").read_text(), pathlib.Path("/mnt/share/given").read_text())
print(subprocess.run(["systemctl", "is-active", "basic.target"], capture_output=True, text=True).stdout)
sys.exit(7)
"""


def test_a_guest_with_systemd_a_serial_port_and_files(tmp_path: Path) -> None:
    (tmp_path / "given").write_text("shared")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "port"))
        listener.listen()
        threading.Thread(target=_shout, args=(listener,), daemon=True).start()
        guest = Guest(systemd=True, files={"script.py": SCRIPT}, share=tmp_path, serial=(f"unix:{tmp_path / 'port'}",))
        result = run_in_vm(["python3", "/mnt/job/script.py"], guest)
    assert result.code == 7, result.output
    assert result.files == {"answer": b"HELLO\n"}
    assert result.output.split() == ["/opt/omnid/omnid/__init__.py", "systemd", "shared", "active"]


def _shout(listener: socket.socket) -> None:
    """Send everything back in capitals."""
    port, _ = listener.accept()
    with port:
        while data := port.recv(100):
            port.sendall(data.upper())


def test_a_kernel_panic_is_an_error() -> None:
    with pytest.raises(GuestError, match="kernel panicked"):
        run_in_vm(["sh", "-c", "echo before; echo c >/proc/sysrq-trigger; sleep 60"])


def test_a_command_without_end_is_an_error() -> None:
    with pytest.raises(GuestError, match=r"did not come to an end(.|\n)*before"):
        run_in_vm(["sh", "-c", "echo before; sleep 600"], Guest(timeout_s=45))
