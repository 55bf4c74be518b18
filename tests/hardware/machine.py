"""A temporary Debian guest with virtual cameras and UARTs, in which pytest runs on a copy of the project."""

from __future__ import annotations

import ast
import shlex
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.hardware.image import ROOT, image

HERE = Path(__file__).parent
TREE = ("omnid", "drivers", "calib", "systemd", "tests", "pyproject.toml", "README.md")
KERNEL_OPTIONS = (
    "console=ttyS0 quiet panic=-1 tsc=reliable no_timer_check mitigations=off random.trust_cpu=on "
    "systemd.unit=guest-job.target systemd.show_status=0"
)


class GuestError(Exception):
    """The guest ended without a result: by a kernel panic, an error of QEMU, or at the timeout."""


@dataclass(frozen=True, slots=True)
class Result:
    """Result of the tests of a script in the guest."""

    output: str  # stdout and stderr
    report: bytes  # JUnit's XML

    def require_passed(self, name: str) -> None:
        """Raise AssertionError, with the output of the test, unless it ran and passed with all parameters."""
        cases = [
            case
            for case in ElementTree.fromstring(self.report).iter("testcase")
            if str(case.get("name")).partition("[")[0] == name
        ]
        assert cases, f"{name} was not run:\n{self.output[-4000:]}"
        if any(case.find(kind) is not None for case in cases for kind in ("failure", "error", "skipped")):
            raise AssertionError("\n".join(str(part.text) for case in cases for part in case))


def names_in(script: str) -> list[str]:
    """Return the tests of a script of the guest, in their order."""
    tree = ast.parse((HERE / "guest" / script).read_text("utf-8"))
    return [entry.name for entry in tree.body if isinstance(entry, ast.FunctionDef) and entry.name.startswith("test_")]


def run_tests(
    script: str,
    timeout_s: float,
    *,
    systemd: bool = False,
    files: Mapping[str, bytes] | None = None,
    serial: Sequence[str] = (),
) -> Result:
    """Run a script of the folder `guest` with pytest in a guest, in /opt/omnid, a copy of the project.

    systemd: PID 1; else only udev runs. files are copied to /mnt/job. /dev/ttyS1, ttyS2 and ttyS3 are connected to
    `serial`, as QEMU's -serial: "unix:/path" for a socket on which the caller listens. GuestError where the guest
    left no result; ImageUnavailableError without QEMU or an image.
    """
    words = ["python3", "-m", "pytest", "--noconftest", "-p", "no:cacheprovider", "--durations=10"]
    words += ["--junitxml=/mnt/job/report.xml", "-o", "junit_logging=system-out", f"tests/hardware/guest/{script}"]
    with tempfile.TemporaryDirectory(prefix="omnid-guest-") as name:
        # 1. The job: the project, the command, the caller's files.
        job, ignored = Path(name), shutil.ignore_patterns("__pycache__", ".*")
        (job / "tree").mkdir()
        for part in TREE:
            copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
            copy(ROOT / part, job / "tree" / part, **({"ignore": ignored} if copy is shutil.copytree else {}))
        shutil.copy(HERE / "guest" / "job.sh", job / "start")
        (job / "command").write_text(f"exec {shlex.join(words)}\n", "utf-8")
        for part, data in (files or {}).items():
            (job / part).write_bytes(data)
        # 2. The machine.
        try:
            done = subprocess.run(
                _qemu(job, systemd, serial),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=timeout_s,
            )
            console, end = done.stdout.decode("utf-8", "replace"), f"QEMU ended with exit code {done.returncode}"
        except subprocess.TimeoutExpired as error:
            console, end = (error.stdout or b"").decode("utf-8", "replace"), f"no end within {timeout_s:g} s"
        # 3. The result.
        output = (job / "output").read_text("utf-8", "replace") if (job / "output").exists() else ""
        if not (job / "code").exists():
            panicked = "Kernel panic - not syncing" in console
            reason = "the guest's kernel panicked" if panicked else end
            raise GuestError(f"the guest left no result: {reason}\n{console[-4000:]}\n{output[-20000:]}")
        return Result(output, (job / "report.xml").read_bytes())


def _qemu(job: Path, systemd: bool, serial: Sequence[str]) -> list[str]:
    """Return QEMU's command line, without KVM: where it is nested in another machine, Debian's kernel may hang.

    AVX2 is off, since QEMU 7.2 emulates it wrongly: numpy's argsort returns a wrong order with it, or crashes. So is
    VAES, of which LLVM concludes that there is AVX2: what numba compiled ended with an illegal instruction.
    """
    made = image()
    words = ["qemu-system-x86_64", "-accel", "tcg,thread=multi,tb-size=512", "-cpu", "max,-avx2,-vaes", "-smp", "2"]
    words += ["-m", "2048", "-nodefaults", "-nic", "none", "-display", "none", "-no-reboot"]
    words += ["-kernel", str(made / "vmlinux"), "-initrd", str(made / "initramfs.cpio"), "-serial", "stdio"]
    words += ["-drive", f"file={made / 'root.ext4'},format=raw,if=virtio,snapshot=on,cache=unsafe"]
    words += ["-append", KERNEL_OPTIONS + (" start=/lib/systemd/systemd" if systemd else "")]
    words += ["-virtfs", f"local,path={job},mount_tag=job,security_model=none"]
    return words + [word for port in serial for word in ("-serial", port)]
