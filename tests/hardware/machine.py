"""A temporary Debian guest with virtual cameras and UARTs that runs a command on a copy of the project."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.hardware.image import ROOT, Image, image

TREE = ("omnid", "drivers", "calib", "systemd", "tests", "pyproject.toml", "README.md")
KERNEL_OPTIONS = (
    "console=ttyS0 quiet panic=-1 tsc=reliable no_timer_check mitigations=off random.trust_cpu=on "
    "systemd.unit=guest-job.target systemd.show_status=0"
)
PANIC = "Kernel panic - not syncing"


class GuestError(Exception):
    """The guest ended without a result: by a kernel panic, or at the timeout."""


@dataclass(frozen=True, slots=True)
class Guest:
    """Configuration of a guest.

    `files` are copied to /mnt/job. /dev/ttyS1, ttyS2 and ttyS3 are connected to `serial`, as QEMU's -serial:
    "unix:/path" for a socket on which the caller listens, "pty", "null".
    """

    systemd: bool = False  # PID 1; else only udev runs
    files: Mapping[str, bytes] = field(default_factory=dict)
    serial: Sequence[str] = ()
    timeout_s: float = 240.0
    memory_mb: int = 2048


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a command in the guest."""

    code: int
    output: str  # stdout and stderr
    console: str  # output of the kernel
    files: Mapping[str, bytes]  # content of /mnt/job/results
    elapsed_s: float


def run_in_vm(command: Sequence[str], guest: Guest | None = None) -> Result:
    """Run a command in the guest, in /opt/omnid, a copy of the project, and return its result.

    GuestError where the guest panicked or took too long; ImageUnavailableError without QEMU or an image.
    """
    guest = guest or Guest()
    with tempfile.TemporaryDirectory(prefix="omnid-guest-") as name:
        job = Path(name)
        _write_job(job, command, guest)
        started = time.monotonic()
        console = _emulate(_qemu(image(), job, guest), guest.timeout_s)
        elapsed_s = time.monotonic() - started
        return _result(job, console, elapsed_s)


def _write_job(job: Path, command: Sequence[str], guest: Guest) -> None:
    ignored = shutil.ignore_patterns("__pycache__", ".*")
    for name in TREE:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, job / "tree" / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, job / "tree" / name)
    shutil.copy(Path(__file__).with_name("guest") / "job.sh", job / "start")
    (job / "command").write_text(f"exec {shlex.join(command)}\n", "utf-8")
    (job / "results").mkdir()
    for name, data in guest.files.items():
        (job / name).write_bytes(data)


def _qemu(image: Image, job: Path, guest: Guest) -> list[str]:
    """Return QEMU's command line, without KVM: where it is nested in another machine, Debian's kernel may hang.

    AVX2 is off, since QEMU 7.2 emulates it wrongly: numpy's argsort returns a wrong order with it, or crashes. So is
    VAES, of which LLVM concludes that there is AVX2: what numba compiled ended with an illegal instruction.
    """
    words = ["qemu-system-x86_64", "-accel", "tcg,thread=multi,tb-size=512", "-cpu", "max,-avx2,-vaes", "-smp", "2"]
    words += ["-m", str(guest.memory_mb), "-nodefaults", "-nic", "none", "-display", "none", "-no-reboot"]
    words += ["-kernel", str(image.kernel), "-initrd", str(image.initramfs), "-serial", "stdio"]
    words += ["-drive", f"file={image.disk},format=raw,if=virtio,snapshot=on,cache=unsafe"]
    words += ["-append", KERNEL_OPTIONS + (" start=/lib/systemd/systemd" if guest.systemd else "")]
    words += ["-virtfs", f"local,path={job},mount_tag=job,security_model=none"]
    for port in guest.serial:
        words += ["-serial", port]
    return words


def _emulate(words: list[str], timeout_s: float) -> str:
    """Run the machine for at most timeout_s and return the output of its console."""
    try:
        done = subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=timeout_s,
            check=False,
        )
        return done.stdout.decode("utf-8", "replace")
    except subprocess.TimeoutExpired as error:
        return (error.stdout or b"").decode("utf-8", "replace")


def _result(job: Path, console: str, elapsed_s: float) -> Result:
    output = (job / "output").read_text("utf-8", "replace") if (job / "output").exists() else ""
    if not (job / "code").exists():
        reason = "the guest's kernel panicked" if PANIC in console else "the guest did not come to an end"
        raise GuestError(f"{reason} after {elapsed_s:.0f} s\n{console[-4000:]}\n{output[-20000:]}")
    files = {path.name: path.read_bytes() for path in (job / "results").iterdir() if path.is_file()}
    return Result(int((job / "code").read_text("ascii")), output, console, files, elapsed_s)
