"""The sample on an emulated aarch64 processor: `python -m tests.hardware.aarch64 FOLDER` (root, network, an hour).

Makes a minimal Debian of that processor in FOLDER, installs omnid and its dependencies there from wheels, compiles its
functions, replays the sample, and compares the poses with those of this machine. Exit code 1 where one differs by more
than TOLERANCE: decoded and warped images differ in their last digit, by which another landmark is chosen some time, and
from then on the two are two estimates of one path. Needs debootstrap and qemu-user-static, whose entry in
/proc/sys/fs/binfmt_misc runs programs of aarch64 as others. Nothing of it is a measurement of time.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

import numpy as np

from omnid.formats.tum import read_tum

ROOT: Final = Path(__file__).parents[2]
SUITE: Final = "bookworm"  # its Python is 3.11, its glibc 2.36
PYTHON: Final = "3.11"
PLATFORMS: Final = (*(f"manylinux_2_{minor}_aarch64" for minor in (28, 27, 26, 24, 17)), "manylinux2014_aarch64")
BINFMT: Final = Path("/proc/sys/fs/binfmt_misc/qemu-aarch64")
SAMPLE: Final = f"/omnid/lib/python{PYTHON}/site-packages/omnid/sample/log.mcap"
# m, and of the numbers of a rotation matrix. Both estimates err by a millimetre; the first pairs differ by 1e-6.
TOLERANCE: Final = 5e-3


def run(*words: str | Path, environment: dict[str, str] | None = None) -> None:
    """Run a command; raises CalledProcessError."""
    print("+", shlex.join(map(str, words)), flush=True)
    subprocess.run([str(word) for word in words], check=True, env={**os.environ, **(environment or {})})


def in_root(root: Path, command: str) -> None:
    """Run a shell command in the other Debian, with the files that Python and OpenMP look for."""
    mounts = f"mount -t proc proc {root}/proc && mount --rbind /dev {root}/dev"
    inner = f"{mounts} && exec chroot {root} sh -c {shlex.quote(command)}"
    run("unshare", "--mount", "sh", "-ec", inner, environment={"HOME": "/root", "LC_ALL": "C.UTF-8"})


def make_root(root: Path) -> None:
    """Make the other Debian with Python, where it is missing."""
    if not (root / "usr" / "bin" / "python3").exists():
        shutil.rmtree(root, ignore_errors=True)
        packages = "python3,python3-venv"
        run("debootstrap", "--arch=arm64", "--variant=minbase", f"--include={packages}", SUITE, root)


def fetch_wheels(wheels: Path) -> None:
    """Fetch the dependencies for aarch64, and build omnid's own wheel, which is for all processors."""
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["dependencies"]
    platforms = [word for name in PLATFORMS for word in ("--platform", name)]
    pip = (sys.executable, "-m", "pip")
    run(*pip, "download", "-q", "-d", wheels, *platforms, "--python-version", PYTHON, "--only-binary=:all:", *needed)
    for old in wheels.glob("omnid-*.whl"):
        old.unlink()
    run(*pip, "wheel", "-q", "--no-deps", "-w", wheels, ROOT)


def largest_difference(theirs: Path, ours: Path) -> float:
    """Return the largest difference of two trajectories; raises ValueError where they have other stamps."""
    a, b = read_tum(theirs), read_tum(ours)
    if not np.array_equal(a.stamps_ns, b.stamps_ns):
        raise ValueError(f"{theirs}: {len(a.stamps_ns)} poses of other stamps than the {len(b.stamps_ns)} of {ours}")
    return float(np.abs(a.T - b.T).max())


def main() -> int:
    """Run the sample on both processors; return 1 where the poses differ."""
    parser = argparse.ArgumentParser(prog="python -m tests.hardware.aarch64", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    folder = parser.parse_args().folder.resolve()
    if not BINFMT.exists():
        parser.error(f"{BINFMT} is missing: install qemu-user-static and binfmt-support, or register it")
    root, wheels, ours = folder / "root", folder / "root" / "wheels", folder / "here.txt"
    make_root(root)
    wheels.mkdir(exist_ok=True)
    fetch_wheels(wheels)
    in_root(root, "test -x /omnid/bin/omnid || python3 -m venv /omnid")
    in_root(root, "/omnid/bin/pip install -q --no-index --find-links /wheels --force-reinstall --no-deps /wheels/*.whl")
    in_root(root, f"/omnid/bin/omnid replay {SAMPLE} --inline --quiet --tum /there.txt")
    run(sys.executable, "-m", "omnid", "replay", f"{root}{SAMPLE}", "--inline", "--quiet", "--tum", ours)
    off = largest_difference(root / "there.txt", ours)
    print(f"largest difference of a pose: {off:.2g}, at most {TOLERANCE:g} was expected")
    return int(off > TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
